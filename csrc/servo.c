/* Actuator models of the virtual rig. One sample: latch the table's displacement at t_n, take
 * x_p[n], and advance to t_{n+1} with the command held (zoh) or interpolated from the previous one
 * (foh). */
#include <string.h>

#include "hydraulic.h"
#include "internal.h"
#include "numeric.h"

#define SUBSTEPS_MAX 4096 /* per sample: at 256 Hz as many per second as 1024 at 1024 Hz */

static int config_error(const rthyb_servo_config *c)
{
    if (!(c->period_s > 0.0 && c->period_s <= 1.0))
        return RTHYB_E_PERIOD;
    if (c->kind < RTHYB_PURE_DELAY || c->kind > RTHYB_SERVO_VALVE ||
        (c->hold != RTHYB_ZOH && c->hold != RTHYB_FOH) ||
        !(c->delay_samples >= 0.0 && c->delay_samples <= RTHYB_DELAY_MAX))
        return RTHYB_E_SERVO;
    const int whole = c->delay_samples == floor(c->delay_samples);
    switch (c->kind) {
    case RTHYB_PURE_DELAY:
        return whole ? 0 : RTHYB_E_SERVO;
    case RTHYB_FIRST_ORDER:
        return whole && c->roll_off_hz > 0.0 && c->roll_off_hz <= 1e6 ? 0 : RTHYB_E_SERVO;
    case RTHYB_SECOND_ORDER:
        return c->natural_frequency_hz > 0.0 && c->natural_frequency_hz <= 1e5 &&
                       c->damping_ratio >= 0.0 && c->damping_ratio <= 1e3 && fabs(c->gain) <= 1e3
                   ? 0
                   : RTHYB_E_SERVO;
    case RTHYB_SERVO_VALVE:
        return whole ? 0 : RTHYB_E_SERVO; /* the rest is checked by rthyb_valve_init */
    default:
        break;
    }
    const int loop_ok = c->kp_per_s > 0.0 && c->kp_per_s <= 1e5 && c->ki_per_s2 >= 0.0 &&
                        c->ki_per_s2 <= 1e6 && c->valve_time_constant_s > 0.0 &&
                        c->valve_time_constant_s <= 10.0;
    const int power_ok = c->stall_force_n > 0.0 && c->stall_force_n <= RTHYB_FORCE_MAX_N &&
                         c->flow_limit_m_per_s > 0.0 && c->flow_limit_m_per_s <= 1e3;
    const int table_ok = c->oil_stiffness_n_per_m > 0.0 && c->oil_stiffness_n_per_m <= 1e13 &&
                         c->oil_damping_n_s_per_m >= 0.0 && c->oil_damping_n_s_per_m <= 1e12 &&
                         c->moving_mass_kg > 0.0 && c->moving_mass_kg <= 1e9 &&
                         c->friction_n >= 0.0 && c->friction_n <= RTHYB_FORCE_MAX_N &&
                         c->friction_width_m_per_s > 0.0 && c->friction_width_m_per_s <= 1e3 &&
                         c->viscous_n_s_per_m >= 0.0 && c->viscous_n_s_per_m <= 1e12;
    const int steps_ok = c->substeps >= 1 && c->substeps <= SUBSTEPS_MAX && whole;
    /* The period of the oil column must be longer than pi substeps, otherwise they diverge. */
    const double h = c->period_s / (c->substeps > 0 ? c->substeps : 1);
    if (!(h * h * c->oil_stiffness_n_per_m < 4.0 * c->moving_mass_kg))
        return RTHYB_E_SERVO;
    return loop_ok && power_ok && table_ok && steps_ok ? 0 : RTHYB_E_SERVO;
}

/* Free motion of y'' + 2 zeta w y' + w^2 y = 0 over time t: (y, y') -> phi (y, y'). */
static void free_motion(double w, double zeta, double t, double phi[4])
{
    const double decay = zeta * w, shape = w * w - decay * decay, e = exp(-decay * t);
    double c, s; /* in place of cosine, and of sine / damped frequency */
    if (shape > 1e-9 * w * w) {
        const double wd = sqrt(shape);
        c = e * cos(wd * t);
        s = e * sin(wd * t) / wd;
    } else if (shape < -1e-9 * w * w) {
        /* e^{-decay t} cosh and sinh as two decreasing exponentials: no overflow for large t. */
        const double root = sqrt(-shape);
        const double slow = exp(-(w * w / (decay + root)) * t), fast = exp(-(decay + root) * t);
        c = 0.5 * (slow + fast);
        s = 0.5 * (slow - fast) / root;
    } else {
        c = e;
        s = e * t;
    }
    phi[0] = c + decay * s;
    phi[1] = s;
    phi[2] = -w * w * s;
    phi[3] = c - decay * s;
}

int rthyb_servo_init(rthyb_servo *servo, const rthyb_servo_config *cfg)
{
    const int error = config_error(cfg);
    if (error)
        return error;
    *servo = (rthyb_servo){.cfg = *cfg};
    servo->fraction = cfg->delay_samples - floor(cfg->delay_samples);
    if (cfg->kind == RTHYB_SECOND_ORDER) {
        const double w = 2.0 * RTHYB_PI * cfg->natural_frequency_hz;
        const double early = servo->fraction * cfg->period_s;
        free_motion(w, cfg->damping_ratio, early, servo->first);
        free_motion(w, cfg->damping_ratio, cfg->period_s - early, servo->second);
    }
    if (cfg->kind == RTHYB_SERVO_HYDRAULIC) {
        const double h = cfg->period_s / cfg->substeps;
        servo->valve_gain = -expm1(-h / cfg->valve_time_constant_s);
    }
    return cfg->kind == RTHYB_SERVO_VALVE ? rthyb_valve_init(servo) : 0;
}

/* The command that was sent `age` samples ago; age 0 is x_p[n]. */
static double sent(const rthyb_servo *servo, uint32_t age)
{
    const uint32_t length = RTHYB_DELAY_MAX + 2;
    return servo->past[(servo->head + length - age % length) % length];
}

static void remember(rthyb_servo *servo, double x_p)
{
    const uint32_t length = RTHYB_DELAY_MAX + 2;
    servo->head = servo->head + 1 < length ? servo->head + 1 : 0;
    servo->past[servo->head] = x_p;
}

static uint32_t whole_delay(const rthyb_servo *servo)
{
    return (uint32_t)servo->cfg.delay_samples;
}

int rthyb_servo_latch(rthyb_servo *servo, double x_p_m)
{
    int code = RTHYB_OK;
    const double x_p = accept(x_p_m, 1e2 * RTHYB_DISPLACEMENT_MAX_M, servo->last_command, &code);
    servo->last_command = x_p;
    remember(servo, x_p);
    if (servo->cfg.kind == RTHYB_PURE_DELAY) {
        const double h = servo->cfg.period_s, x = sent(servo, whole_delay(servo));
        const double v = (x - servo->x) / h;
        servo->a = (v - servo->v) / h;
        servo->v = v;
        servo->x = x;
    }
    return code;
}

/* One sample of x' = w (u - x) with the command interpolated over the sample, exactly. */
static void advance_first_order(rthyb_servo *s)
{
    const double h = s->cfg.period_s, w = 2.0 * RTHYB_PI * s->cfg.roll_off_hz;
    const uint32_t d = whole_delay(s);
    const double end = sent(s, d), start = s->cfg.hold == RTHYB_FOH ? sent(s, d + 1) : end;
    const double lag = (end - start) / (h * w);
    s->x = end - lag + (s->x - start + lag) * exp(-w * h);
    s->v = w * (end - s->x);
    s->a = w * ((end - start) / h - s->v);
}

/* Part of a sample of x'' + 2 zeta w x' + w^2 x = w^2 gain u, with u starting at u0 with
 * `slope`. */
static void advance_part(rthyb_servo *s, const double phi[4], double t, double u0, double slope)
{
    const double w = 2.0 * RTHYB_PI * s->cfg.natural_frequency_hz, zeta = s->cfg.damping_ratio;
    const double rate = s->cfg.gain * slope, offset = s->cfg.gain * u0 - 2.0 * zeta / w * rate;
    const double y = s->x - offset, yd = s->v - rate; /* distance from the particular solution */
    s->x = offset + rate * t + phi[0] * y + phi[1] * yd;
    s->v = rate + phi[2] * y + phi[3] * yd;
    s->a = w * w * (s->cfg.gain * (u0 + slope * t) - s->x) - 2.0 * zeta * w * s->v;
}

static void advance_second_order(rthyb_servo *s)
{
    const double h = s->cfg.period_s, early = s->fraction * h;
    const uint32_t d = whole_delay(s);
    const int foh = s->cfg.hold == RTHYB_FOH;
    if (early > 0.0) {
        const double end = sent(s, d + 1), slope = foh ? (end - sent(s, d + 2)) / h : 0.0;
        advance_part(s, s->first, early, end - slope * early, slope);
    }
    const double end = sent(s, d), slope = foh ? (end - sent(s, d + 1)) / h : 0.0;
    advance_part(s, s->second, h - early, foh ? end - slope * h : end, slope);
}

double rthyb_specimen_force(rthyb_element *elements, uint32_t element_count, double x, double v,
                            double a, double dt)
{
    double force = 0.0;
    for (uint32_t i = 0; i < element_count; i++)
        force += rthyb_element_force(&elements[i], x, v, a, dt);
    return force;
}

void rthyb_servo_run_up(const rthyb_servo *s, double *start, double *rise)
{
    const uint32_t d = whole_delay(s);
    const double end = sent(s, d);
    *start = s->cfg.hold == RTHYB_FOH ? sent(s, d + 1) : end;
    *rise = (end - *start) / s->cfg.substeps;
}

/* At the actuator's end, the load cell measures the force of the oil column; inertia elements of
 * the specimen move with the table. */
static void advance_hydraulic(rthyb_servo *s, rthyb_element *elements, uint32_t element_count)
{
    const rthyb_servo_config *c = &s->cfg;
    const double h = c->period_s / c->substeps;
    const double damping = 0.5 * h * (c->oil_damping_n_s_per_m + c->viscous_n_s_per_m);
    /* Divisions are outside the loop: four in a row would take half of its time. */
    const double per_h = 1.0 / h, per_stall = 1.0 / c->stall_force_n;
    const double per_mass = 1.0 / (c->moving_mass_kg + damping);
    const double per_width = 1.0 / c->friction_width_m_per_s;
    double start, rise;
    rthyb_servo_run_up(s, &start, &rise);
    for (int i = 0; i < c->substeps; i++) {
        const double push = hydraulic_push(s, start + rise * (i + 0.5), h, per_stall);
        const double specimen = rthyb_specimen_force(elements, element_count, s->x, s->v, s->a, h);
        const double net = push - specimen - c->friction_n * smooth_sign(s->v * per_width);
        const double half = ((c->moving_mass_kg - damping) * s->half_velocity + h * net) * per_mass;
        hydraulic_move(s, half, h, per_h);
    }
}

int rthyb_servo_confine(rthyb_servo *s)
{
    int code = RTHYB_OK;
    s->x = confine(s->x, 1e2 * RTHYB_DISPLACEMENT_MAX_M, &code);
    s->v = confine(s->v, 1e9, &code);
    s->a = confine(s->a, 1e12, &code);
    s->piston = confine(s->piston, 1e2 * RTHYB_DISPLACEMENT_MAX_M, &code);
    s->oil_force = confine(s->oil_force, 1e15, &code);
    (void)confine(s->half_velocity + s->piston_velocity + s->valve + s->integral, 1e9, &code);
    if (code != RTHYB_OK)
        s->v = s->a = s->half_velocity = s->piston_velocity = s->valve = s->integral =
            s->oil_force = 0.0;
    if (code != RTHYB_OK)
        memset(s->valve_state, 0, sizeof s->valve_state);
    return code;
}

int rthyb_servo_advance(rthyb_servo *servo, rthyb_element *elements, uint32_t element_count)
{
    if (servo->cfg.kind == RTHYB_FIRST_ORDER)
        advance_first_order(servo);
    else if (servo->cfg.kind == RTHYB_SECOND_ORDER)
        advance_second_order(servo);
    else if (servo->cfg.kind == RTHYB_SERVO_HYDRAULIC)
        advance_hydraulic(servo, elements, element_count);
    else if (servo->cfg.kind == RTHYB_SERVO_VALVE)
        rthyb_valve_advance(servo, elements, element_count);
    return rthyb_servo_confine(servo);
}
