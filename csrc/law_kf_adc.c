/* Adaptive inverse with four samples, by a Kalman filter (Ning, Wang, Ding & others 2020): p = th'
 * (m[n], m[n-d], ...) + noise, with th a random walk. The form and the filter are published; the
 * values of noise and walk were chosen for this program, for motions of millimetres. */
#include "fir_lead.h"

enum { DELAY, APART, CUTOFF, NOISE, WALK, MOST };

#define FIRST_DEVIATION 10.0 /* initial standard deviation of each coefficient */

/* clang-format off */
static const rthyb_law_parameter kf_adc_parameters[] = {
    {"kf_adc.delay_s", "s", 0.0, 1.0, 0.016, "the initial delay", 0, "identified.delay_s", NULL},
    {"kf_adc.apart_s", "s", 0.0, 0.25, 0.0009765625, "the spacing of the samples of the inverse", 0, NULL, NULL},
    {"kf_adc.cutoff_hz", "Hz", 0.5, 400.0, 20.0, "the cut-off of the low-pass pair", 0, NULL, NULL},
    {"kf_adc.noise_m", "m", 0.0, 1.0, 1e-4, "the noise of the command that the inverse computes", RTHYB_OPEN_LOW, NULL, NULL},
    {"kf_adc.walk_per_root_s", "", 0.0, 100.0, 0.01, "the random walk of each coefficient, per square root of a second", 0, NULL, NULL},
    {"kf_adc.theta_max", "", 1.0, 1e4, 1000.0, "the largest coefficient", 0, NULL, NULL},
};
/* clang-format on */

typedef struct {
    rthyb_fir_lead fir;
} kf_adc_state;

static const rthyb_law_value kf_adc_values[] = RTHYB_FIR_VALUES(kf_adc_state);

static int kf_adc_check(const double *p, double period_s, rthyb_law_complaint *why)
{
    const int at = rthyb_fir_check(p[CUTOFF], p[APART], period_s, why);
    return at < 0 ? -1 : (at == 1 ? CUTOFF : APART);
}

static int kf_adc_init(void *state, const rthyb_law_start *start)
{
    const double *p = start->parameters;
    const double variance = FIRST_DEVIATION * FIRST_DEVIATION;
    const rthyb_fir_settings settings = {
        .delay_s = p[DELAY],
        .apart_s = p[APART],
        .cutoff_hz = p[CUTOFF],
        .most = p[MOST],
        .p_sum = variance,
        .p_delay = variance,
        .p_rest = variance,
        .noise2 = p[NOISE] * p[NOISE],
        .walk2 = p[WALK] * p[WALK],
    };
    return rthyb_fir_init(&((kf_adc_state *)state)->fir, &settings, start);
}

static void kf_adc_rest(void *state, double x_m)
{
    rthyb_fir_rest(&((kf_adc_state *)state)->fir, x_m);
}

static int kf_adc_observe(void *state, double x_p_m, double x_m_m, int frozen)
{
    return rthyb_fir_observe(&((kf_adc_state *)state)->fir, x_p_m, x_m_m, frozen);
}

static int kf_adc_lead(void *state, double x_c_m, double allowed_m, double *x_p_m)
{
    return rthyb_fir_step(&((kf_adc_state *)state)->fir, x_c_m, allowed_m, x_p_m);
}

static const rthyb_control_law kf_adc = {
    .is = {.name = "kf-adc",
           .meaning = "four-sample inverse, adapted by a Kalman filter for a random walk",
           .calmer = "lower controller.kf_adc.walk_per_root_s, or raise its noise_m",
           .parameters = kf_adc_parameters,
           .values = kf_adc_values,
           .parameter_count = RTHYB_COUNT(kf_adc_parameters),
           .value_count = RTHYB_COUNT(kf_adc_values)},
    .state_size = sizeof(kf_adc_state),
    .check = kf_adc_check,
    .init = kf_adc_init,
    .rest = kf_adc_rest,
    .observe = kf_adc_observe,
    .lead = kf_adc_lead,
};

RTHYB_LAW(kf_adc);
