#include "phase_lead.h"

int rthyb_lead_check(const double *p, double period_s, rthyb_law_complaint *why)
{
    (void)period_s;
    const double w1 = p[LEAD_W1], w2 = p[LEAD_W2], alpha0 = p[LEAD_ALPHA0];
    const double low = p[LEAD_ALPHA_MIN], high = p[LEAD_ALPHA_MAX], beta_max = 0.5 * high * high;
    if (!rthyb_plc_is_stable(w1, w2)) {
        *why = (rthyb_law_complaint){
            "w1 = {}, w2 = {} make the phase-lead compensator unstable; a stable one needs "
            "|w1| > 1 and |w2| < |w1 + 1| = {}; the paper uses w1 = 3, w2 = 2",
            {w1, w2, fabs(w1 + 1.0)}};
        return LEAD_W1;
    }
    if (!(low < high)) {
        *why = (rthyb_law_complaint){"found {}; must be greater than alpha_min = {} samples",
                                     {high, low}};
        return LEAD_ALPHA_MAX;
    }
    /* NaN: neither the test file nor the rig file has a value yet. */
    if (alpha0 < low || alpha0 > high) {
        *why = (rthyb_law_complaint){"found {}; must be from alpha_min = {} to alpha_max = {} "
                                     "samples, as set in controller.delay_estimator",
                                     {alpha0, low, high}};
        return LEAD_ALPHA0;
    }
    if (fabs(p[LEAD_BETA0]) > beta_max) {
        *why = (rthyb_law_complaint){"found {}; must be from {} to {} (half of alpha_max squared)",
                                     {p[LEAD_BETA0], -beta_max, beta_max}};
        return LEAD_BETA0;
    }
    return -1;
}

int rthyb_lead_check_filtered(const double *p, double period_s, rthyb_law_complaint *why)
{
    const int at = LEAD_OWN + 1;
    if (!rthyb_below_half_rate(p[at], period_s, why))
        return at;
    return rthyb_lead_check(p, period_s, why);
}

/* The change per sample is proportional to the period. The reference is scaled likewise, so that
 * phi is the same at any sampling rate; and the gain, so that adaptation per second is the same. */
rthyb_estimator_config rthyb_lead_settings(const rthyb_law_start *start, double gain)
{
    const double *p = start->parameters;
    const double pace = rthyb_pace(start->period_s);
    return (rthyb_estimator_config){
        .alpha0 = p[LEAD_ALPHA0] * pace,
        .beta0 = p[LEAD_BETA0] * pace * pace,
        .period_s = start->period_s,
        .reference_m = p[LEAD_REFERENCE] / pace,
        .gain = gain / pace,
        .alpha_min = p[LEAD_ALPHA_MIN] * pace,
        .alpha_max = p[LEAD_ALPHA_MAX] * pace,
        .rest_noise_m = start->rest_noise_m,
    };
}

int rthyb_lead_init(rthyb_phase_lead *lead, const rthyb_estimator_config *cfg,
                    const rthyb_law_start *start)
{
    const double w1 = start->parameters[LEAD_W1], w2 = start->parameters[LEAD_W2];
    const int error = rthyb_plc_init(&lead->plc, w1, w2, start->x0_m);
    lead->alpha = cfg->alpha0;
    lead->beta = cfg->beta0;
    return error ? error : rthyb_estimator_init(&lead->estimator, cfg, w1, w2, start->x0_m);
}

void rthyb_lead_rest(void *state, double x_m)
{
    rthyb_phase_lead *lead = state;
    (void)rthyb_plc_init(&lead->plc, lead->plc.w1, lead->plc.w2, x_m);
}

int rthyb_lead_observe(void *state, double x_p_m, double x_m_m, int frozen)
{
    rthyb_phase_lead *lead = state;
    return rthyb_estimator_step(&lead->estimator, x_p_m, x_m_m, frozen);
}

/* alpha and beta follow the estimator as far as it may move the command in this sample. */
static void follow_estimate(rthyb_phase_lead *lead, double x_c_m, double allowed_m)
{
    const rthyb_estimator *est = &lead->estimator;
    const rthyb_plc *plc = &lead->plc;
    /* The printed law has no bounds; the values passed to the compensator have. */
    const double alpha = clamp(est->alpha, est->cfg.alpha_min, est->cfg.alpha_max);
    if (isinf(allowed_m)) {
        lead->alpha = alpha;
        lead->beta = est->beta;
        return;
    }
    const double slope = x_c_m - plc->x1, curvature = x_c_m - 2.0 * plc->x1 + plc->x2;
    const double s = (plc->w1 + plc->w2 + 1.0) / plc->w1;
    const double d_alpha = alpha - lead->alpha, d_beta = est->beta - lead->beta;
    const double effect = fabs(s) * (fabs(d_alpha * slope) + fabs(d_beta * curvature));
    const double share = rthyb_allowed_share(effect, allowed_m);
    lead->alpha += share * d_alpha;
    lead->beta += share * d_beta;
}

int rthyb_lead_lead(void *state, double x_c_m, double allowed_m, double *x_p_m)
{
    rthyb_phase_lead *lead = state;
    if (allowed_m > 0.0 && judge(x_c_m, RTHYB_DISPLACEMENT_MAX_M) == RTHYB_OK)
        follow_estimate(lead, x_c_m, allowed_m);
    return rthyb_plc_step(&lead->plc, lead->alpha, lead->beta, x_c_m, x_p_m);
}
