/* Virtual rigs by kind. A new kind needs a file of its own, a number in rthyb_plant.h and a row
 * here. */
#include <string.h>

#include "internal.h"

typedef struct {
    int32_t (*axes)(const void *state); /* 0: not usable as a rig */
    double (*period_s)(const void *state);
    int (*step)(void *state, const double *x_p_m, double *x_m_m, double *f_n);
    void (*reseed)(void *state);
    void (*truth)(const void *state, double *x_true_m, double *f_true_n);
    const double *(*extra)(const void *state, int32_t axis); /* RTHYB_EXTRAS_MAX readings */
    int32_t (*sensors)(const void *state, double *values);   /* NULL: it has none */
} plant_ops;

/* ---- one actuator ------------------------------------------------------------------------------ */

static int32_t rig_axes(const void *state)
{
    (void)state;
    return 1;
}

static double rig_period_s(const void *state)
{
    return ((const rthyb_rig *)state)->cfg.servo.period_s;
}

static int rig_step(void *state, const double *x_p_m, double *x_m_m, double *f_n)
{
    return rthyb_rig_step(state, *x_p_m, x_m_m, f_n);
}

static void rig_reseed(void *state)
{
    rthyb_rig_reseed(state);
}

static void rig_truth(const void *state, double *x_true_m, double *f_true_n)
{
    *x_true_m = ((const rthyb_rig *)state)->x_true_m;
    *f_true_n = ((const rthyb_rig *)state)->f_true_n;
}

static const double *rig_extra(const void *state, int32_t axis)
{
    (void)axis;
    return ((const rthyb_rig *)state)->extra;
}

/* ---- several ----------------------------------------------------------------------------------- */

static int32_t coupled_axes(const void *state)
{
    return ((const rthyb_coupled_rig *)state)->cfg.size;
}

static double coupled_period_s(const void *state)
{
    return ((const rthyb_coupled_rig *)state)->cfg.period_s;
}

static int coupled_step(void *state, const double *x_p_m, double *x_m_m, double *f_n)
{
    return rthyb_coupled_rig_step(state, x_p_m, x_m_m, f_n);
}

static void coupled_reseed(void *state)
{
    rthyb_coupled_rig_reseed(state);
}

static void coupled_truth(const void *state, double *x_true_m, double *f_true_n)
{
    const rthyb_coupled_rig *rig = state;
    memcpy(x_true_m, rig->x_true_m, (size_t)rig->cfg.size * sizeof *x_true_m);
    memcpy(f_true_n, rig->f_true_n, (size_t)rig->cfg.size * sizeof *f_true_n);
}

static const double *coupled_extra(const void *state, int32_t axis)
{
    return ((const rthyb_coupled_rig *)state)->extra[axis];
}

static int32_t coupled_sensors(const void *state, double *values)
{
    const rthyb_coupled_rig *rig = state;
    const int32_t count = rthyb_kinematics_sensors(&rig->cfg.kinematics);
    memcpy(values, rig->sensor, (size_t)count * sizeof *values);
    return count;
}

static const plant_ops KINDS[RTHYB_PLANT_KINDS] = {
    [RTHYB_PLANT_RIG] = {rig_axes, rig_period_s, rig_step, rig_reseed, rig_truth, rig_extra, NULL},
    [RTHYB_PLANT_COUPLED_RIG] = {coupled_axes, coupled_period_s, coupled_step, coupled_reseed,
                                 coupled_truth, coupled_extra, coupled_sensors},
};

/* ---- whichever it is --------------------------------------------------------------------------- */

int32_t rthyb_plant_axes(const rthyb_plant *plant)
{
    if (plant->kind < 0 || plant->kind >= RTHYB_PLANT_KINDS || !plant->state)
        return 0;
    return KINDS[plant->kind].axes(plant->state);
}

double rthyb_plant_period_s(const rthyb_plant *plant)
{
    return KINDS[plant->kind].period_s(plant->state);
}

int rthyb_plant_step(const rthyb_plant *plant, const double *x_p_m, double *x_m_m, double *f_n)
{
    return KINDS[plant->kind].step(plant->state, x_p_m, x_m_m, f_n);
}

void rthyb_plant_reseed(const rthyb_plant *plant)
{
    KINDS[plant->kind].reseed(plant->state);
}

void rthyb_plant_truth(const rthyb_plant *plant, double *x_true_m, double *f_true_n)
{
    KINDS[plant->kind].truth(plant->state, x_true_m, f_true_n);
}

void rthyb_plant_extra(const rthyb_plant *plant, int32_t axis, double *values)
{
    memcpy(values, KINDS[plant->kind].extra(plant->state, axis), RTHYB_EXTRAS_MAX * sizeof *values);
}

int32_t rthyb_plant_sensors(const rthyb_plant *plant, double *values)
{
    const plant_ops *ops = &KINDS[plant->kind];
    return ops->sensors ? ops->sensors(plant->state, values) : 0;
}
