/* Inverse compensation, as in Chen & Ricles, EESD 38 (2009) 1237. The model of the actuator,
 *   m[n+1] = m[n] + (c[n+1] - m[n]) / alpha,
 * lags a motion of constant velocity by alpha - 1 samples; its inverse is
 *   C(z) = (alpha z - (alpha - 1)) / z:   x_p[n] = x[n] + (alpha - 1) (x[n] - x[n-1])
 * It does not adapt. */
#include "control_law.h"

enum { DELAY };

/* clang-format off */
static const rthyb_law_parameter chen_ricles_parameters[] = {
    {"chen_ricles.delay_s", "s", 0.0, 1.0, 0.02, "the delay of the actuator, alpha - 1 samples", 0, "identified.delay_s", NULL},
};
/* clang-format on */

typedef struct {
    double alpha; /* alpha - 1, samples */
    double beta;  /* 0 */
    double x1;    /* x_c[n-1] */
} chen_ricles_state;

/* clang-format off */
static const rthyb_law_value chen_ricles_values[] = {
    {"alpha", "samples", "lead", offsetof(chen_ricles_state, alpha)},
    {"beta", "samples²", "curvature term", offsetof(chen_ricles_state, beta)},
};
/* clang-format on */

static int chen_ricles_init(void *state, const rthyb_law_start *start)
{
    chen_ricles_state *s = state;
    s->alpha = start->parameters[DELAY] / start->period_s;
    s->x1 = start->x0_m;
    return s->alpha >= 0.0 && s->alpha <= 1e6 ? 0 : RTHYB_E_LAW;
}

static void chen_ricles_rest(void *state, double x_m)
{
    ((chen_ricles_state *)state)->x1 = x_m;
}

static int chen_ricles_observe(void *state, double x_p_m, double x_m_m, int frozen)
{
    (void)state, (void)frozen;
    return judge(x_p_m, RTHYB_DISPLACEMENT_MAX_M) | judge(x_m_m, RTHYB_DISPLACEMENT_MAX_M);
}

static int chen_ricles_lead(void *state, double x_c_m, double allowed_m, double *x_p_m)
{
    chen_ricles_state *s = state;
    int code = RTHYB_OK;
    (void)allowed_m;
    const double x = accept(x_c_m, RTHYB_DISPLACEMENT_MAX_M, s->x1, &code);
    *x_p_m = x + s->alpha * (x - s->x1);
    s->x1 = x;
    return code;
}

static const rthyb_control_law chen_ricles = {
    .is = {.name = "chen-ricles",
           .meaning = "inverse of a known first-order discrete lag; does not adapt",
           .parameters = chen_ricles_parameters,
           .values = chen_ricles_values,
           .parameter_count = RTHYB_COUNT(chen_ricles_parameters),
           .value_count = RTHYB_COUNT(chen_ricles_values)},
    .state_size = sizeof(chen_ricles_state),
    .init = chen_ricles_init,
    .rest = chen_ricles_rest,
    .observe = chen_ricles_observe,
    .lead = chen_ricles_lead,
};

RTHYB_LAW(chen_ricles);
