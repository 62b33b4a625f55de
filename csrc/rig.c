/* The virtual rig: actuator, specimen, and two sensors with noise, bias, quantisation and a limited
 * range. The noise is seeded, so that a test can be repeated bit by bit. */
#include <string.h>

#include "internal.h"
#include "sensor.h"

/* The linear part of the specimen is solved exactly, together with the actuator. */
static void join_specimen(rthyb_rig *rig, rthyb_servo_config *servo)
{
    for (uint32_t i = 0; i < rig->cfg.element_count; i++) {
        rthyb_element *element = &rig->cfg.elements[i];
        double *into = NULL;
        if (element->kind == RTHYB_STIFFNESS)
            into = &servo->specimen_stiffness_n_per_m;
        else if (element->kind == RTHYB_VISCOUS)
            into = &servo->specimen_damping_n_s_per_m;
        else if (element->kind == RTHYB_INERTIA)
            into = &servo->moving_mass_kg;
        if (into) {
            *into += element->params[0];
            element->params[0] = 0.0;
        }
    }
}

int rthyb_rig_init(rthyb_rig *rig, const rthyb_rig_config *cfg)
{
    if (cfg->element_count > RTHYB_ELEMENTS_MAX)
        return RTHYB_E_ELEMENT;
    if (cfg->load_cell != RTHYB_ACTUATOR_END && cfg->load_cell != RTHYB_SPECIMEN_END)
        return RTHYB_E_SENSOR;
    if (!sensor_ok(&cfg->displacement, RTHYB_DISPLACEMENT_MAX_M) ||
        !sensor_ok(&cfg->force, RTHYB_FORCE_MAX_N))
        return RTHYB_E_SENSOR;
    if (!extra_sensors_ok(cfg->extras, cfg->extra_count))
        return RTHYB_E_SENSOR;
    *rig = (rthyb_rig){.cfg = *cfg};
    rthyb_servo_config servo = cfg->servo;
    if (servo.kind == RTHYB_SERVO_HYDRAULIC) {
        /* The specimen's own mass moves with the table; as a force, it would need the acceleration
         * that it determines. */
        for (uint32_t i = 0; i < cfg->element_count; i++) {
            if (cfg->elements[i].kind != RTHYB_INERTIA)
                continue;
            rig->ridden_kg += cfg->elements[i].params[0];
            rig->cfg.elements[i].params[0] = 0.0;
        }
    }
    if (servo.kind == RTHYB_SERVO_VALVE)
        join_specimen(rig, &servo);
    servo.moving_mass_kg += rig->ridden_kg;
    rthyb_rig_reseed(rig);
    return rthyb_servo_init(&rig->servo, &servo);
}

void rthyb_rig_reseed(rthyb_rig *rig)
{
    noise_seed(&rig->noise, rig->cfg.seed);
    /* A generator of their own, so that the other sensors have the same noise without them. */
    noise_seed(&rig->extra_noise, ~rig->cfg.seed);
}

/* Force in the load cell: at the actuator's end that of the oil column, otherwise that of the
 * specimen. The servo-hydraulic actuator has already advanced the specimen to t_n, hence dt = 0. */
static double load_cell_force(rthyb_rig *rig)
{
    const rthyb_servo *servo = &rig->servo;
    const int hydraulic = servo->cfg.kind == RTHYB_SERVO_HYDRAULIC;
    if (servo->cfg.kind == RTHYB_SERVO_VALVE ||
        (hydraulic && rig->cfg.load_cell == RTHYB_ACTUATOR_END))
        return servo->oil_force;
    return rig->ridden_kg * servo->a +
           rthyb_specimen_force(rig->cfg.elements, rig->cfg.element_count, servo->x, servo->v,
                                servo->a, hydraulic ? 0.0 : servo->cfg.period_s);
}

static void latch_extras(rthyb_rig *rig)
{
    const double measured[RTHYB_EXTRA_KINDS] = {
        [RTHYB_EXTRA_DISPLACEMENT] = rig->x_true_m,
        [RTHYB_EXTRA_VELOCITY] = rig->servo.v,
        [RTHYB_EXTRA_ACCELERATION] = rig->servo.a,
        [RTHYB_EXTRA_FORCE] = rig->f_true_n,
    };
    const uint32_t count = rig->cfg.extra_count;
    sense_extras(&rig->extra_noise, rig->cfg.extras, count, measured, rig->extra);
    if (rig->extra_to)
        memcpy(rig->extra_to, rig->extra, count * sizeof *rig->extra);
}

int rthyb_rig_step(rthyb_rig *rig, double x_p_m, double *x_m_m, double *f_n)
{
    int code = rthyb_servo_latch(&rig->servo, x_p_m);
    rig->x_true_m = rig->servo.x;
    rig->f_true_n = load_cell_force(rig);
    *x_m_m = sense(&rig->noise, &rig->cfg.displacement, rig->x_true_m);
    *f_n = sense(&rig->noise, &rig->cfg.force, rig->f_true_n);
    if (rig->cfg.extra_count > 0)
        latch_extras(rig);
    rig->servo.sensed_m = *x_m_m;
    code |= rthyb_servo_advance(&rig->servo, rig->cfg.elements, rig->cfg.element_count);
    return code;
}

int rthyb_rig_run(rthyb_rig *rig, const double *x_p_m, double *x_m_m, double *f_n, size_t n)
{
    int code = RTHYB_OK;
    for (size_t i = 0; i < n; i++)
        code |= rthyb_rig_step(rig, x_p_m[i], &x_m_m[i], &f_n[i]);
    return code;
}
