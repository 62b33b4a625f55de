/* Inverse of the rig's identified response; gain, delay and curvature compensate for the
 * remainder. */
#include "gain_lead.h"

typedef rthyb_gain_lead inverse_state;

enum { FIT_ROLL_OFF = GAIN_LEAD_OWN, B0 };

/* clang-format off */
#define COEFFICIENT(n, unit, high)                                                                 \
    {"inverse.b" #n, unit, -(high), high, 0.0, "the coefficient b" #n " of the fitted inverse", 0,     \
     "identified.frequency_hz", NULL}
/* clang-format on */

static const rthyb_law_parameter inverse_parameters[] = {
    /* The remainder is learnt up to the cut-off of the filter pair, and compensated up to twice
     * that frequency. */
    GAIN_LEAD_PARAMETERS("inverse", -0.05859375, 20.0, NULL),
    {"inverse.fit_roll_off_hz", "Hz", 1.0, 400.0, 120.0, "the roll-off of the fitted inverse", 0,
     NULL, NULL},
    {"inverse.b0", "", -0.99, 100.0, 0.0, "the coefficient b0 of the fitted inverse", 0,
     "identified.frequency_hz", NULL},
    COEFFICIENT(1, "s", 10.0),
    COEFFICIENT(2, "s^2", 10.0),
    COEFFICIENT(3, "s^3", 10.0),
    COEFFICIENT(4, "s^4", 10.0),
    COEFFICIENT(5, "s^5", 10.0),
};

/* clang-format off */
static const rthyb_law_value inverse_values[] = {
    {"alpha", "samples", "delay estimate", offsetof(rthyb_gain_lead, delay)},
    {"gain", "", "gain", offsetof(rthyb_gain_lead, gain)},
    {"delay_left", "samples", "delay beside the inverse", offsetof(rthyb_gain_lead, shift)},
    {"curvature_left", "samples²", "curvature beside the inverse", offsetof(rthyb_gain_lead, curvature)},
};
/* clang-format on */

static int inverse_check(const double *p, double period_s, rthyb_law_complaint *why)
{
    if (!rthyb_below_half_rate(p[FIT_ROLL_OFF], period_s, why))
        return FIT_ROLL_OFF;
    if (!rthyb_inverse_is_stable(p + B0, p[FIT_ROLL_OFF], period_s)) {
        *why = (rthyb_law_complaint){"with b0 = {} and the coefficients after it the rig as fitted "
                                     "is unstable: a zero of the "
                                     "inverse lies outside the unit circle; leave all of b0 to b5 "
                                     "out, so that they are fitted "
                                     "to what rthyb identify has found",
                                     {p[B0]}};
        return B0;
    }
    return rthyb_gain_lead_check(p, period_s, why);
}

static int inverse_init(void *state, const rthyb_law_start *start)
{
    static const double nothing[LEAD_TERMS] = {0.0};
    const double *p = start->parameters;
    return rthyb_gain_lead_init(state, p, nothing, p + B0, p[FIT_ROLL_OFF], start);
}

static const rthyb_control_law inverse = {
    .is = {.name = "inverse",
           .meaning =
               "inverse of the identified rig; adapts gain, delay and curvature of the remainder",
           .calmer = "raise controller.inverse.memory_s",
           .parameters = inverse_parameters,
           .parameter_count = RTHYB_COUNT(inverse_parameters),
           .values = inverse_values,
           .value_count = RTHYB_COUNT(inverse_values),
           .uses_rest_noise = 1,
           .with_rfc = 1},
    .state_size = sizeof(inverse_state),
    .check = inverse_check,
    .init = inverse_init,
    .rest = rthyb_gain_lead_rest,
    .observe = rthyb_gain_lead_observe,
    .lead = rthyb_gain_lead_lead,
};

RTHYB_LAW(inverse);
