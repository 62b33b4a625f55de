/* Adaptive delay estimator, for the parametric model of Eqn 2.6-2.8 with the curvature term,
 *   mu = alpha phi1 + beta phi2
 *   mu   = W1 x_p[n] + W2 x_p[n-1] + x_p[n-2] - (the same for x_m)
 *   phi1 = S (x_m[n] - x_m[n-1]),   phi2 = S (x_m[n] - 2 x_m[n-1] + x_m[n-2]),   S = W1+W2+1
 * in units of reference_m, so that the normalisation 1 + phi^2 of Eqn 2.9 has a defined unit.
 *
 * Robust and RLS pass x_p and x_m through the same band-pass. The model remains valid, while the
 * noise that would pull alpha towards -1/12 (errors in variables) is removed from phi, and the
 * offset of a sensor without tare from mu. */
#include "lowpass.h"

#define ALPHA_GUARD 1e4        /* the printed law has no projection; keeps its state finite */
#define POWER_TIME_S 2.0       /* averaging time of phi^2 in the normalisation of the robust law */
#define OFFSET_TIME_S 3.2      /* lower end of the filter pair: 0.05 Hz */
#define GATE_TIME_S 0.2        /* averaging time of phi^2 for the gate */
#define RESPONSE_S 8.0         /* length of the impulse response summed by _init, */
#define RESPONSE_MAX 32768u    /* and its largest number of samples: at 4096 Hz */
#define PRIOR_S (1.0 / 1024.0) /* initial uncertainty of alpha, in addition to a quarter of alpha */
#define QUIET_M 1e-6           /* no displacement channel has less noise: the step of an encoder */
#define RIDGE_FLOOR 1e-9       /* reference^2: keeps the normal equations regular without noise */
#define NOISE_SHARE_MAX 0.5 /* largest fraction of a moment that noise compensation may subtract */

typedef struct {
    double mu, phi1, phi2;
} regressor;

/* The band-pass of the pair: low-pass, then subtraction of the slow mean. */
static double filter_step(const rthyb_estimator *est, double *s, double *level, double x)
{
    const double low = lowpass_step(&est->filter, s, x);
    *level += (low - *level) * est->level_weight;
    return low - *level;
}

/* The first pair is taken as the state of rest, so that an offset between command and sensor causes
 * no transient; averaging over all samples so far then removes the noise of the first one. */
static void prime(rthyb_estimator *est, double p, double m)
{
    lowpass_rest(&est->filter, est->filter_p, p);
    lowpass_rest(&est->filter, est->filter_m, m);
    est->level_p = p;
    est->level_m = m;
    est->p1 = est->p2 = est->m1 = est->m2 = 0.0;
}

static void filter_pair(rthyb_estimator *est, double *p, double *m)
{
    if (est->level_weight == 1.0)
        prime(est, *p, *m);
    *p = filter_step(est, est->filter_p, &est->level_p, *p);
    *m = filter_step(est, est->filter_m, &est->level_m, *m);
    const double least = less_of(est->cfg.period_s / OFFSET_TIME_S, 1.0);
    est->level_weight = greater_of(est->level_weight / (1.0 + est->level_weight), least);
}

static int is_filtered(const rthyb_estimator *est)
{
    return est->cfg.law == RTHYB_LAW_ROBUST || est->cfg.law == RTHYB_LAW_RLS;
}

/* mu, phi1, phi2 (Eqn 2.8) of the newest pair; shifts the histories. */
static regressor form_regressor(rthyb_estimator *est, double p, double m)
{
    const double w1 = est->w1, w2 = est->w2;
    const double s = w1 + w2 + 1.0, unit = est->unit;
    const double slope = m - est->m1;
    const regressor g = {
        .mu = unit * (w1 * (p - m) + w2 * (est->p1 - est->m1) + (est->p2 - est->m2)),
        .phi1 = unit * s * slope,
        .phi2 = unit * s * (slope - (est->m1 - est->m2)),
    };
    est->p2 = est->p1;
    est->p1 = p;
    est->m2 = est->m1;
    est->m1 = m;
    return g;
}

/* Contribution of white noise of rest_noise_m on x_m alone to the products of mu, phi1, phi2.
 *
 * The weight of the initial values follows from that noise. If the rig file states none, or less
 * than any sensor has, QUIET_M is used for it: otherwise, the first nanometres of a motion, in
 * which the actuator is still at rest and the model does not hold yet, would outweigh the initial
 * values, and the estimate would jump between its bounds. */
static void noise_moments(rthyb_estimator *est)
{
    const double noise_m = fmax(est->cfg.rest_noise_m, QUIET_M);
    rthyb_estimator probe = *est;
    prime(&probe, 0.0, 0.0);
    probe.level_weight = fmin(est->cfg.period_s / OFFSET_TIME_S, 1.0);
    double residual = 0.0;
    const uint32_t wanted = ticks_of(RESPONSE_S, est->cfg.period_s);
    const uint32_t samples = wanted < RESPONSE_MAX ? wanted : RESPONSE_MAX;
    for (uint32_t i = 0; i < samples; i++) {
        const double impulse = i == 0 ? noise_m : 0.0;
        const double h = filter_step(&probe, probe.filter_m, &probe.level_m, impulse);
        const regressor g = form_regressor(&probe, 0.0, h);
        const double e = g.mu - est->cfg.alpha0 * g.phi1 - est->cfg.beta0 * g.phi2;
        residual += e * e;
        est->noise11 += g.phi1 * g.phi1;
        est->noise12 += g.phi1 * g.phi2;
        est->noise22 += g.phi2 * g.phi2;
        est->noise1 += g.phi1 * g.mu;
        est->noise2 += g.phi2 * g.mu;
    }
    const double share = est->cfg.rest_noise_m < noise_m ? est->cfg.rest_noise_m / noise_m : 1.0;
    est->noise11 *= share * share;
    est->noise12 *= share * share;
    est->noise22 *= share * share;
    est->noise1 *= share * share;
    est->noise2 *= share * share;
    est->gate_power = est->cfg.gate_factor * est->noise11;
    /* The initial values have the weight of measurements that determine alpha within 1 ms +
     * alpha0/4 and beta within the square of that. Filtered noise is correlated over half a period
     * of the cut-off frequency: the samples within it count as one. */
    const double repeats = 0.5 / (est->cfg.cutoff_hz * est->cfg.period_s);
    const double sigma_alpha = PRIOR_S / est->cfg.period_s + 0.25 * fabs(est->cfg.alpha0);
    const double sigma_beta = sigma_alpha * sigma_alpha;
    est->ridge1 = fmax(repeats * residual / (sigma_alpha * sigma_alpha), RIDGE_FLOOR);
    est->ridge2 = fmax(repeats * residual / (sigma_beta * sigma_beta), RIDGE_FLOOR * 1e-3);
}

static int config_error(const rthyb_estimator_config *c)
{
    if (!(c->period_s > 0.0 && c->period_s <= 1.0))
        return RTHYB_E_PERIOD;
    const int law_ok = c->law >= RTHYB_LAW_FIXED && c->law <= RTHYB_LAW_RLS;
    const int start_ok = fabs(c->alpha0) <= ALPHA_GUARD && fabs(c->beta0) <= 1e8;
    const int noise_ok = c->rest_noise_m >= 0.0 && c->rest_noise_m <= 1.0 &&
                         c->gate_factor >= 0.0 && c->gate_factor <= 1e6;
    const int unit_ok = c->reference_m >= 1e-9 && c->reference_m <= 1e3;
    if (!law_ok || !start_ok || !noise_ok || !unit_ok)
        return RTHYB_E_ESTIMATOR;
    if (c->law == RTHYB_LAW_FIXED)
        return 0;
    const int gain_ok = c->law == RTHYB_LAW_RLS
                            ? c->memory_samples >= 1.0 && c->memory_samples < 1e9
                            : c->gain >= 0.0 && c->gain <= 1e6;
    const int cutoff_ok =
        c->law == RTHYB_LAW_GRADIENT || (c->cutoff_hz > 0.0 && c->cutoff_hz * c->period_s < 0.5);
    const int bounds_ok = c->alpha_min <= c->alpha_max && fabs(c->alpha_min) <= ALPHA_GUARD &&
                          fabs(c->alpha_max) <= ALPHA_GUARD;
    return gain_ok && cutoff_ok && bounds_ok ? 0 : RTHYB_E_ESTIMATOR;
}

int rthyb_estimator_init(rthyb_estimator *est, const rthyb_estimator_config *cfg, double w1,
                         double w2, double x0_m)
{
    const int error = config_error(cfg);
    if (error)
        return error;
    if (!weights_ok(w1, w2))
        return RTHYB_E_WEIGHTS;
    if (judge(x0_m, RTHYB_DISPLACEMENT_MAX_M) != RTHYB_OK)
        return RTHYB_E_LIMIT;
    *est = (rthyb_estimator){.cfg = *cfg,
                             .w1 = w1,
                             .w2 = w2,
                             .unit = 1.0 / cfg->reference_m,
                             .alpha = cfg->alpha0,
                             .beta = cfg->beta0};
    est->level_weight = 1.0;
    if (is_filtered(est)) {
        est->filter = lowpass_design(cfg->cutoff_hz, cfg->period_s, sqrt(2.0));
        noise_moments(est);
    }
    if (cfg->law == RTHYB_LAW_RLS)
        est->forget = 1.0 - 1.0 / cfg->memory_samples;
    est->p1 = est->p2 = est->m1 = est->m2 = est->last_p = est->last_m = x0_m;
    return 0;
}

static double residual_of(const rthyb_estimator *est, regressor g)
{
    return g.mu - est->alpha * g.phi1 - est->beta * g.phi2;
}

/* alpha' = gamma epsilon phi, epsilon = (mu - alpha phi) / (1 + phi^2): Eqn 2.9, 2.11. */
static void gradient_update(rthyb_estimator *est, regressor g)
{
    const double epsilon = residual_of(est, g) / (1.0 + g.phi1 * g.phi1);
    int code = RTHYB_OK;
    est->alpha = confine(est->alpha + est->cfg.gain * epsilon * g.phi1, ALPHA_GUARD, &code);
}

static double project(const rthyb_estimator *est, double alpha)
{
    return clamp(alpha, est->cfg.alpha_min, est->cfg.alpha_max);
}

/* The same law with m_s^2 = mean power of phi: no unit remains, and the gain is a rate per
 * sample. */
static void robust_update(rthyb_estimator *est, regressor g)
{
    const double phi_sq = g.phi1 * g.phi1;
    est->power += (phi_sq - est->power) * less_of(est->cfg.period_s / POWER_TIME_S, 1.0);
    const double power = greater_of(est->power, phi_sq);
    if (!(power > 0.0))
        return;
    const double epsilon = residual_of(est, g) / power;
    est->alpha = project(est, est->alpha + est->cfg.gain * epsilon * g.phi1);
}

static double less_noise(double moment, double noise)
{
    return moment - less_of(noise, NOISE_SHARE_MAX * moment);
}

/* Exponentially weighted least squares, with the moments of the noise at rest subtracted. The
 * normal equations are kept, not their inverse: there are only two unknowns, and no wind-up. */
static void rls_update(rthyb_estimator *est, regressor g)
{
    const double l = est->forget;
    est->r11 = l * est->r11 + g.phi1 * g.phi1;
    est->q1 = l * est->q1 + g.phi1 * g.mu;
    est->weight = l * est->weight + 1.0;
    const double w = est->weight, a0 = est->cfg.alpha0, b0 = est->cfg.beta0;
    const double a11 = less_noise(est->r11, w * est->noise11) + est->ridge1;
    const double c1 = est->q1 - w * est->noise1 + est->ridge1 * a0;
    if (!est->cfg.estimate_beta) {
        est->r12 = l * est->r12 + g.phi1 * g.phi2;
        est->alpha = project(est, (c1 - est->beta * (est->r12 - w * est->noise12)) / a11);
        return;
    }
    est->r12 = l * est->r12 + g.phi1 * g.phi2;
    est->r22 = l * est->r22 + g.phi2 * g.phi2;
    est->q2 = l * est->q2 + g.phi2 * g.mu;
    const double a12 = est->r12 - w * est->noise12;
    const double a22 = less_noise(est->r22, w * est->noise22) + est->ridge2;
    const double c2 = est->q2 - w * est->noise2 + est->ridge2 * b0;
    const double det = a11 * a22 - a12 * a12;
    if (!(det > 1e-12 * a11 * a22))
        return;
    est->alpha = project(est, (c1 * a22 - c2 * a12) / det);
    const double beta_max = 0.5 * est->cfg.alpha_max * est->cfg.alpha_max;
    est->beta = clamp((c2 * a11 - c1 * a12) / det, -beta_max, beta_max);
}

static int gate_is_open(rthyb_estimator *est, regressor g)
{
    const double weight = less_of(est->cfg.period_s / GATE_TIME_S, 1.0);
    est->short_power += (g.phi1 * g.phi1 - est->short_power) * weight;
    return est->short_power > est->gate_power && est->short_power > RIDGE_FLOOR * RIDGE_FLOOR;
}

int rthyb_estimator_step(rthyb_estimator *est, double x_p_m, double x_m_m, int frozen)
{
    int code = RTHYB_OK;
    double p = accept(x_p_m, RTHYB_DISPLACEMENT_MAX_M, est->last_p, &code);
    double m = accept(x_m_m, RTHYB_DISPLACEMENT_MAX_M, est->last_m, &code);
    est->last_p = p;
    est->last_m = m;
    if (is_filtered(est)) {
        filter_pair(est, &p, &m);
    }
    const regressor g = form_regressor(est, p, m);
    est->open = 1;
    if (is_filtered(est))
        est->open = gate_is_open(est, g);
    if (code != RTHYB_OK || !est->open || frozen)
        return code;
    if (est->cfg.law == RTHYB_LAW_GRADIENT)
        gradient_update(est, g);
    else if (est->cfg.law == RTHYB_LAW_ROBUST)
        robust_update(est, g);
    else if (est->cfg.law == RTHYB_LAW_RLS)
        rls_update(est, g);
    return code;
}

int rthyb_estimator_run(rthyb_estimator *est, const double *x_p_m, const double *x_m_m,
                        double *alpha, double *beta, size_t n)
{
    int code = RTHYB_OK;
    for (size_t i = 0; i < n; i++) {
        code |= rthyb_estimator_step(est, x_p_m[i], x_m_m[i], 0);
        alpha[i] = est->alpha;
        beta[i] = est->beta;
    }
    return code;
}
