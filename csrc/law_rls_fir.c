/* Inverse with four samples, by recursive least squares (Quiroz, Galmez & Fermandois, "Robust
 * decentralized adaptive compensation", 2024, for one axis): without forgetting, after a
 * fourth-order low-pass, starting from an offline calibration that knows the sum and the delay of
 * the four coefficients better than the rest. The initial P is that of the authors' two actuators,
 * in 1/m^2. */
#include "fir_lead.h"

enum { DELAY, APART, CUTOFF, P_SUM, P_DELAY, P_REST, MOST };

/* clang-format off */
static const rthyb_law_parameter rls_fir_parameters[] = {
    {"rls_fir.delay_s", "s", 0.0, 1.0, 0.016, "the initial delay", 0, "identified.delay_s", NULL},
    {"rls_fir.apart_s", "s", 0.0, 0.25, 0.0009765625, "the spacing of the samples of the inverse", 0, NULL, NULL},
    {"rls_fir.cutoff_hz", "Hz", 0.5, 400.0, 20.0, "the cut-off of the low-pass pair", 0, NULL, NULL},
    {"rls_fir.p_sum", "", 0.0, 1e15, 5e7, "the initial variance of the gain, 1/m^2", 0, NULL, NULL},
    {"rls_fir.p_delay", "", 0.0, 1e15, 6.8e10, "the initial variance in the direction of the delay, 1/m^2", 0, NULL, NULL},
    {"rls_fir.p_rest", "", 0.0, 1e15, 1.46e11, "the initial variance in the remaining directions, 1/m^2", 0, NULL, NULL},
    {"rls_fir.theta_max", "", 1.0, 1e4, 1000.0, "the largest coefficient", 0, NULL, NULL},
};
/* clang-format on */

typedef struct {
    rthyb_fir_lead fir;
} rls_fir_state;

static const rthyb_law_value rls_fir_values[] = RTHYB_FIR_VALUES(rls_fir_state);

static int rls_fir_check(const double *p, double period_s, rthyb_law_complaint *why)
{
    const int at = rthyb_fir_check(p[CUTOFF], p[APART], period_s, why);
    return at < 0 ? -1 : (at == 1 ? CUTOFF : APART);
}

static int rls_fir_init(void *state, const rthyb_law_start *start)
{
    const double *p = start->parameters;
    const rthyb_fir_settings settings = {
        .delay_s = p[DELAY],
        .apart_s = p[APART],
        .cutoff_hz = p[CUTOFF],
        .most = p[MOST],
        .p_sum = p[P_SUM],
        .p_delay = p[P_DELAY],
        .p_rest = p[P_REST],
        .noise2 = 1.0,
    };
    return rthyb_fir_init(&((rls_fir_state *)state)->fir, &settings, start);
}

static void rls_fir_rest(void *state, double x_m)
{
    rthyb_fir_rest(&((rls_fir_state *)state)->fir, x_m);
}

static int rls_fir_observe(void *state, double x_p_m, double x_m_m, int frozen)
{
    return rthyb_fir_observe(&((rls_fir_state *)state)->fir, x_p_m, x_m_m, frozen);
}

static int rls_fir_lead(void *state, double x_c_m, double allowed_m, double *x_p_m)
{
    return rthyb_fir_step(&((rls_fir_state *)state)->fir, x_c_m, allowed_m, x_p_m);
}

static const rthyb_control_law rls_fir = {
    .is = {.name = "rls-fir",
           .meaning = "four-sample inverse, adapted by recursive least squares without forgetting",
           .calmer = "lower controller.rls_fir.p_rest, p_delay and p_sum",
           .parameters = rls_fir_parameters,
           .values = rls_fir_values,
           .parameter_count = RTHYB_COUNT(rls_fir_parameters),
           .value_count = RTHYB_COUNT(rls_fir_values)},
    .state_size = sizeof(rls_fir_state),
    .check = rls_fir_check,
    .init = rls_fir_init,
    .rest = rls_fir_rest,
    .observe = rls_fir_observe,
    .lead = rls_fir_lead,
};

RTHYB_LAW(rls_fir);
