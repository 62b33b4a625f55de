/* Phase lead (Eqn 2.5) with curvature and gain, estimated by recursive least squares; with
 * roll-off. */
#include "gain_lead.h"

typedef rthyb_gain_lead gain_alpha_beta_state;

enum { GAIN0 = GAIN_LEAD_OWN, DELAY0, CURVATURE0 };

/* clang-format off */
static const rthyb_law_parameter gain_alpha_beta_parameters[] = {
    GAIN_LEAD_PARAMETERS("gain_alpha_beta", 0.0, 60.0, "identified.roll_off_hz"),
    {"gain_alpha_beta.gain0", "", 0.1, 10.0, 1.0, "the initial gain", 0, "identified.frequency_hz", NULL},
    {"gain_alpha_beta.delay0_s", "s", 0.0, 1.0, 0.02, "the initial delay", 0, "identified.frequency_hz", NULL},
    {"gain_alpha_beta.curvature0_s2", "s^2", -1.0, 1.0, 0.0, "the initial curvature term", 0, "identified.frequency_hz", NULL},
};

static const rthyb_law_value gain_alpha_beta_values[] = {
    {"alpha", "samples", "delay estimate", offsetof(rthyb_gain_lead, shift)},
    {"beta", "samples²", "curvature term", offsetof(rthyb_gain_lead, curvature)},
    {"gain", "", "gain", offsetof(rthyb_gain_lead, gain)},
};
/* clang-format on */

static int gain_alpha_beta_check(const double *p, double period_s, rthyb_law_complaint *why)
{
    const double low = p[GAIN_LEAD_LEAST], high = p[GAIN_LEAD_MOST];
    const double most = 0.5 * fmax(low * low, high * high), off = p[GAIN_LEAD_GAIN_MOST];
    /* NaN: neither the test file nor the rig file has a value yet. */
    if (p[DELAY0] < low || p[DELAY0] > high) {
        *why = (rthyb_law_complaint){
            "found {} s; must be from delay_least_s = {} s to delay_most_s = {} s",
            {p[DELAY0], low, high}};
        return DELAY0;
    }
    if (fabs(p[GAIN0] - 1.0) > off) {
        *why =
            (rthyb_law_complaint){"found {}; must be within gain_most = {} of 1", {p[GAIN0], off}};
        return GAIN0;
    }
    if (fabs(p[CURVATURE0]) > most) {
        *why = (rthyb_law_complaint){
            "found {} s^2; must be from {} to {} s^2 (half of delay_most_s squared)",
            {p[CURVATURE0], -most, most}};
        return CURVATURE0;
    }
    return rthyb_gain_lead_check(p, period_s, why);
}

static int gain_alpha_beta_init(void *state, const rthyb_law_start *start)
{
    const double *p = start->parameters;
    const double first[] = {p[GAIN0] - 1.0, p[DELAY0], p[CURVATURE0]};
    return rthyb_gain_lead_init(state, p, first, NULL, 0.0, start);
}

static const rthyb_control_law gain_alpha_beta = {
    .is = {.name = "gain-alpha-beta",
           .meaning = "phase lead with gain, delay and curvature from recursive least squares",
           .calmer = "raise controller.gain_alpha_beta.memory_s",
           .parameters = gain_alpha_beta_parameters,
           .parameter_count = RTHYB_COUNT(gain_alpha_beta_parameters),
           .values = gain_alpha_beta_values,
           .value_count = RTHYB_COUNT(gain_alpha_beta_values),
           .uses_rest_noise = 1,
           .with_rfc = 1},
    .state_size = sizeof(gain_alpha_beta_state),
    .check = gain_alpha_beta_check,
    .init = gain_alpha_beta_init,
    .rest = rthyb_gain_lead_rest,
    .observe = rthyb_gain_lead_observe,
    .lead = rthyb_gain_lead_lead,
};

RTHYB_LAW(gain_alpha_beta);
