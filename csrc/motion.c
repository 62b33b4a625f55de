/* The equation of motion of the numerical part,
 *   (m + m_added) x'' + c x' + k x + force = -m ag,
 * advanced from t_n, where the specimen's force is known, to the command x[n+1]. */
#include "numeric.h"
#include "numerical.h"

/* Chen & Ricles (2008): x[n+1] = x + h v + h^2 a2 x'', v[n+1] = v + h a1 x'', a1 = a2. */
static void cr_coefficients(rthyb_motion *m, double mass)
{
    const rthyb_motion_config *c = &m->cfg;
    const double h = c->period_s, k = c->stiffness_n_per_m + c->k_e_n_per_m;
    m->a1c = 4.0 * mass / (4.0 * mass + 2.0 * h * c->damping_n_s_per_m + h * h * k);
    m->a2c = m->a1c;
    m->a3c = 0.0;
    m->alpha_f = 0.0;
}

/* Kolay & Ricles (2014), parameters from the spectral radius at infinite frequency. */
static void kr_coefficients(rthyb_motion *m, double mass)
{
    const rthyb_motion_config *c = &m->cfg;
    const double h = c->period_s, k = c->stiffness_n_per_m + c->k_e_n_per_m, rho = c->rho_inf;
    const double alpha_m = (2.0 * rho - 1.0) / (rho + 1.0);
    m->alpha_f = rho / (rho + 1.0);
    const double gamma = 0.5 - alpha_m + m->alpha_f;
    const double beta = 0.25 * (0.5 + gamma) * (0.5 + gamma);
    const double damping = c->damping_n_s_per_m;
    const double denominator = mass + gamma * h * damping + beta * h * h * k;
    m->a1c = mass / denominator;
    m->a2c = (0.5 + gamma) * m->a1c;
    m->a3c = (alpha_m * mass + m->alpha_f * gamma * h * damping + m->alpha_f * beta * h * h * k) /
             denominator;
}

static int config_error(const rthyb_motion_config *c)
{
    if (!(c->period_s > 0.0 && c->period_s <= 1.0))
        return RTHYB_E_PERIOD;
    if (c->integrator < RTHYB_CENTRAL_DIFFERENCE || c->integrator > RTHYB_PRESCRIBED)
        return RTHYB_E_MOTION;
    if (c->integrator == RTHYB_PRESCRIBED)
        return 0;
    const int mass_ok = c->mass_kg >= 1e-6 && c->mass_kg <= 1e12 && c->added_mass_kg >= 0.0 &&
                        c->added_mass_kg <= 1e12;
    const int rest_ok = c->damping_n_s_per_m >= 0.0 && c->damping_n_s_per_m <= 1e15 &&
                        fabs(c->stiffness_n_per_m) <= 1e15 && c->k_e_n_per_m >= 0.0 &&
                        c->k_e_n_per_m <= 1e15 && c->rho_inf >= 0.0 && c->rho_inf <= 1.0;
    if (!mass_ok || !rest_ok)
        return RTHYB_E_MOTION;
    /* A negative stiffness must not cancel the effective mass of an implicit step. */
    const double h = c->period_s, mass = c->mass_kg + c->added_mass_kg;
    const double stiffness = c->stiffness_n_per_m + c->k_e_n_per_m;
    return 4.0 * mass + h * h * fmin(stiffness, 0.0) > 0.0 ? 0 : RTHYB_E_MOTION;
}

int rthyb_motion_init(rthyb_motion *motion, const rthyb_motion_config *cfg, double x0_m)
{
    const int error = config_error(cfg);
    if (error)
        return error;
    if (judge(x0_m, RTHYB_DISPLACEMENT_MAX_M) != RTHYB_OK)
        return RTHYB_E_LIMIT;
    *motion = (rthyb_motion){.cfg = *cfg, .x = x0_m, .x1 = x0_m, .x2 = x0_m};
    const double mass = cfg->mass_kg + cfg->added_mass_kg;
    const double half = cfg->integrator == RTHYB_CENTRAL_DIFFERENCE
                            ? 0.5 * cfg->period_s * cfg->damping_n_s_per_m
                            : 0.0;
    motion->per_mass = 1.0 / (mass + half);
    motion->per_step = 1.0 / cfg->period_s;
    if (cfg->integrator == RTHYB_PRESCRIBED)
        motion->last_excitation = x0_m;
    else if (cfg->integrator == RTHYB_CR)
        cr_coefficients(motion, cfg->mass_kg + cfg->added_mass_kg);
    else if (cfg->integrator == RTHYB_KR_ALPHA)
        kr_coefficients(motion, cfg->mass_kg + cfg->added_mass_kg);
    return 0;
}

/* x' by central difference, which makes the damping term implicit. */
static double central_difference(rthyb_motion *s, double net, double mass)
{
    const double h = s->cfg.period_s, half = 0.5 * h * s->cfg.damping_n_s_per_m;
    const double next = s->x + ((mass - half) * (s->x - s->x1) + h * h * net) * s->per_mass;
    s->v = 0.5 * s->per_step * (next - s->x1);
    s->a = s->per_step * s->per_step * (next - 2.0 * s->x + s->x1);
    return next;
}

/* As in the paper: both right-hand sides at t_n. Its damping is too low by omega h/2. */
static double forward_euler(rthyb_motion *s, double net)
{
    const double h = s->cfg.period_s;
    s->a = (net - s->cfg.damping_n_s_per_m * s->v) * s->per_mass;
    const double next = s->x + h * s->v;
    s->v += h * s->a;
    return next;
}

static double cr_step(rthyb_motion *s, double net)
{
    const double h = s->cfg.period_s;
    s->a = (net - s->cfg.damping_n_s_per_m * s->v) * s->per_mass;
    const double next = s->x + h * s->v + h * h * s->a2c * s->a;
    s->v += h * s->a1c * s->a;
    return next;
}

/* Weighted equilibrium between t_{n-1} and t_n gives a[n]; then as CR with its own coefficients. */
static double kr_step(rthyb_motion *s, double net, double mass)
{
    const double h = s->cfg.period_s, af = s->alpha_f;
    const double weighted_net = (1.0 - af) * net + af * s->net1;
    const double weighted_v = (1.0 - af) * s->v + af * s->v1;
    const double a_hat = (weighted_net - s->cfg.damping_n_s_per_m * weighted_v) / mass;
    s->a = (a_hat - s->a3c * s->a) / (1.0 - s->a3c);
    s->net1 = net;
    s->v1 = s->v;
    const double next = s->x + h * s->v + h * h * s->a2c * s->a;
    s->v += h * s->a1c * s->a;
    return next;
}

/* An unstable test ends at rest at the limit of plausible values, not at infinity. */
static void store(rthyb_motion *s, double next, int *code)
{
    int bad = RTHYB_OK;
    next = confine(next, RTHYB_DISPLACEMENT_MAX_M, &bad);
    s->v = confine(s->v, 1e9, &bad);
    s->a = confine(s->a, 1e15, &bad);
    s->x2 = s->x1;
    s->x1 = s->x;
    s->x = next;
    if (bad != RTHYB_OK) {
        s->v = s->v1 = s->a = s->net1 = 0.0;
        s->x1 = s->x2 = next;
    }
    *code |= bad;
}

int rthyb_motion_step(rthyb_motion *motion, double excitation, double force_n, double *x_next_m)
{
    int code = RTHYB_OK;
    const int prescribed = motion->cfg.integrator == RTHYB_PRESCRIBED;
    const double excitation_max = prescribed ? RTHYB_DISPLACEMENT_MAX_M : 1e4;
    const double drive = accept(excitation, excitation_max, motion->last_excitation, &code);
    const double force = accept(force_n, RTHYB_FORCE_MAX_N, motion->last_force, &code);
    motion->last_excitation = drive;
    motion->last_force = force;
    const double mass = motion->cfg.mass_kg + motion->cfg.added_mass_kg;
    const double net =
        -motion->cfg.mass_kg * drive - motion->cfg.stiffness_n_per_m * motion->x - force;
    double next = drive;
    switch (motion->cfg.integrator) {
    case RTHYB_CENTRAL_DIFFERENCE:
        next = central_difference(motion, net, mass);
        break;
    case RTHYB_FORWARD_EULER:
        next = forward_euler(motion, net);
        break;
    case RTHYB_CR:
        next = cr_step(motion, net);
        break;
    case RTHYB_KR_ALPHA:
        next = kr_step(motion, net, mass);
        break;
    default:
        break;
    }
    store(motion, next, &code);
    *x_next_m = motion->x;
    return code;
}

double rthyb_motion_velocity(const rthyb_motion *motion)
{
    if (motion->cfg.integrator == RTHYB_FORWARD_EULER)
        return motion->v;
    /* With central differences, the velocity at t_n is not known before x[n+1]; v of CR and
     * KR-alpha is (x[n] - x[n-1]) / h, half a step old. Hence a backward difference of second
     * order. */
    return (3.0 * motion->x - 4.0 * motion->x1 + motion->x2) / (2.0 * motion->cfg.period_s);
}

/* ---- as a kind of numerical part --------------------------------------------------------------- */

static size_t size(const void *cfg)
{
    (void)cfg;
    return sizeof(rthyb_motion);
}

static int init(const rthyb_numerical *part, double x0_m)
{
    return rthyb_motion_init(part->state, part->cfg, x0_m);
}

static int answer(const rthyb_numerical *part, double excitation, const double *force_n,
                  double *x_next_m)
{
    return rthyb_motion_step(part->state, excitation, *force_n, x_next_m);
}

static void look(const rthyb_numerical *part, rthyb_interface *at)
{
    const rthyb_motion *s = part->state;
    *at = (rthyb_interface){
        .x = s->x, .v = rthyb_motion_velocity(s), .a = s->a, .x1 = s->x1, .x2 = s->x2};
}

static size_t report(const rthyb_numerical *part, double *values, size_t most)
{
    const rthyb_motion *s = part->state;
    if (most > 0)
        values[0] = s->x;
    return most > 0;
}

const rthyb_numerical_ops rthyb_motion_ops = {
    .size = size,
    .init = init,
    .answer = answer,
    .look = look,
    .report = report,
};
