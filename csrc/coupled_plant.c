/* A virtual rig with several axes. */
#include "noise.h"

#define STATE_MAX 1e15 /* of the plant, in whatever unit its matrices give it */
#define COEFFICIENT_MAX 1e15

static int sensible(const double *values, int count, double most)
{
    for (int i = 0; i < count; i++)
        if (!(fabs(values[i]) <= most))
            return 0;
    return 1;
}

static int matrices_ok(const rthyb_coupled_plant_config *c)
{
    int ok = 1;
    for (int i = 0; i < c->states; i++)
        ok = ok && sensible(c->a[i], c->states, COEFFICIENT_MAX) &&
             sensible(c->b[i], c->size, COEFFICIENT_MAX);
    for (int i = 0; i < c->size; i++)
        ok = ok && sensible(c->c[i], c->states, COEFFICIENT_MAX) && c->noise_m[i] >= 0.0 &&
             c->noise_m[i] <= 1.0 && c->stroke_m[i] > 0.0 &&
             c->stroke_m[i] <= RTHYB_DISPLACEMENT_MAX_M;
    for (int j = 0; j < c->forces; j++)
        ok = ok && sensible(c->stiffness[j], c->size, COEFFICIENT_MAX) &&
             sensible(c->damping[j], c->size, COEFFICIENT_MAX) &&
             sensible(c->mass[j], c->size, COEFFICIENT_MAX);
    return ok;
}

int rthyb_coupled_plant_init(rthyb_coupled_plant *plant, const rthyb_coupled_plant_config *cfg)
{
    if (!(cfg->period_s > 0.0 && cfg->period_s <= 1.0))
        return RTHYB_E_PERIOD;
    if (cfg->size < 1 || cfg->size > RTHYB_COUPLED_MAX || cfg->states < 1 ||
        cfg->states > RTHYB_PLANT_STATES || cfg->forces < 0 || cfg->forces > RTHYB_COUPLED_MAX ||
        cfg->kinematics.size != cfg->size ||
        rthyb_kinematics_directions(&cfg->kinematics) != cfg->size || !matrices_ok(cfg))
        return RTHYB_E_PLANT;
    *plant = (rthyb_coupled_plant){.cfg = *cfg};
    noise_seed(&plant->noise, cfg->seed);
    return rthyb_kinematics_init(&plant->kinematics, &cfg->kinematics);
}

static void forces_of(rthyb_coupled_plant *plant, const double *pose, double *force)
{
    const rthyb_coupled_plant_config *c = &plant->cfg;
    double velocity[RTHYB_COUPLED_MAX] = {0.0}, acceleration[RTHYB_COUPLED_MAX] = {0.0};
    for (int j = 0; j < c->size; j++) {
        velocity[j] = (pose[j] - plant->pose[j]) / c->period_s;
        acceleration[j] = (velocity[j] - plant->velocity[j]) / c->period_s;
    }
    for (int i = 0; i < c->forces; i++) {
        force[i] = 0.0;
        for (int j = 0; j < c->size; j++)
            force[i] += c->stiffness[i][j] * pose[j] + c->damping[i][j] * velocity[j] +
                        c->mass[i][j] * acceleration[j];
    }
    for (int j = 0; j < c->size; j++) {
        plant->pose[j] = pose[j];
        plant->velocity[j] = velocity[j];
    }
}

int rthyb_coupled_plant_latch(rthyb_coupled_plant *plant, double *x_m_m, double *force)
{
    int code = RTHYB_OK;
    const rthyb_coupled_plant_config *c = &plant->cfg;
    double pose[RTHYB_COUPLED_MAX] = {0.0};
    for (int i = 0; i < c->size; i++) {
        double x = 0.0;
        for (int k = 0; k < c->states; k++)
            x += c->c[i][k] * plant->s[k];
        plant->true_m[i] = confine(x, RTHYB_DISPLACEMENT_MAX_M, &code);
        x_m_m[i] = plant->true_m[i];
        if (c->noise_m[i] > 0.0)
            x_m_m[i] += c->noise_m[i] * normal(&plant->noise);
    }
    code |= rthyb_kinematics_pose(&plant->kinematics, x_m_m, pose);
    forces_of(plant, pose, force);
    return code;
}

int rthyb_coupled_plant_apply(rthyb_coupled_plant *plant, const double *x_p_m)
{
    int code = RTHYB_OK;
    const rthyb_coupled_plant_config *c = &plant->cfg;
    double next[RTHYB_PLANT_STATES] = {0.0};
    for (int i = 0; i < c->size; i++) {
        const double x = accept(x_p_m[i], RTHYB_DISPLACEMENT_MAX_M, plant->command[i], &code);
        plant->command[i] = clamp(x, -c->stroke_m[i], c->stroke_m[i]);
        if (plant->command[i] != x)
            code |= RTHYB_S_LIMITED;
    }
    for (int k = 0; k < c->states; k++) {
        for (int j = 0; j < c->states; j++)
            next[k] += c->a[k][j] * plant->s[j];
        for (int j = 0; j < c->size; j++)
            next[k] += c->b[k][j] * plant->command[j];
    }
    for (int k = 0; k < c->states; k++)
        plant->s[k] = confine(next[k], STATE_MAX, &code);
    return code;
}

int rthyb_coupled_plant_run(rthyb_coupled_plant *plant, const double *x_p_m, double *x_m_m,
                            double *force, size_t n)
{
    int code = RTHYB_OK;
    const size_t width = (size_t)plant->cfg.size, forces = (size_t)plant->cfg.forces;
    for (size_t i = 0; i < n; i++) {
        code |= rthyb_coupled_plant_latch(plant, x_m_m + i * width, force + i * forces);
        code |= rthyb_coupled_plant_apply(plant, x_p_m + i * width);
    }
    return code;
}
