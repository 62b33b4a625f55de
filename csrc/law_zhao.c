/* First-order lead (Zhao, French, Shield & Posbergh, EESD 32 (2003) 1773): the inverse of 1 / (tau
 * s + 1),
 *   C(s) = (1 + tau s) / (1 + tau_f s)
 * by backward Euler; tau_f provides the roll-off. It does not adapt. */
#include "control_law.h"

enum { TAU, FILTER };

/* clang-format off */
static const rthyb_law_parameter zhao_parameters[] = {
    {"zhao.tau_s", "s", 0.0, 1.0, 0.02, "the time constant of the actuator", 0, "identified.delay_s", NULL},
    {"zhao.filter_s", "s", 0.0, 1.0, 0.001, "the time constant of the roll-off", 0, NULL, NULL},
};
/* clang-format on */

typedef struct {
    double h, tau, filter;
    double x1, d;       /* x_c[n-1], and the lead of the command over it */
    double alpha, beta; /* reported */
} zhao_state;

/* clang-format off */
static const rthyb_law_value zhao_values[] = {
    {"alpha", "samples", "lead", offsetof(zhao_state, alpha)},
    {"beta", "samples²", "curvature term", offsetof(zhao_state, beta)},
};
/* clang-format on */

static int zhao_check(const double *p, double period_s, rthyb_law_complaint *why)
{
    (void)period_s;
    if (!(p[FILTER] > p[TAU]))
        return -1;
    *why = (rthyb_law_complaint){"found {} s; must be at most tau_s = {} s, or nothing is led",
                                 {p[FILTER], p[TAU]}};
    return FILTER;
}

static int zhao_init(void *state, const rthyb_law_start *start)
{
    zhao_state *s = state;
    s->h = start->period_s;
    s->tau = start->parameters[TAU];
    s->filter = start->parameters[FILTER];
    s->x1 = start->x0_m;
    s->alpha = (s->tau - s->filter) / s->h;
    return s->filter >= 0.0 && s->tau <= 1e3 ? 0 : RTHYB_E_LAW;
}

static void zhao_rest(void *state, double x_m)
{
    zhao_state *s = state;
    s->x1 = x_m;
    s->d = 0.0;
}

static int zhao_observe(void *state, double x_p_m, double x_m_m, int frozen)
{
    (void)state, (void)frozen;
    return judge(x_p_m, RTHYB_DISPLACEMENT_MAX_M) | judge(x_m_m, RTHYB_DISPLACEMENT_MAX_M);
}

static int zhao_lead(void *state, double x_c_m, double allowed_m, double *x_p_m)
{
    zhao_state *s = state;
    int code = RTHYB_OK;
    (void)allowed_m;
    const double x = accept(x_c_m, RTHYB_DISPLACEMENT_MAX_M, s->x1, &code);
    s->d = (s->filter * s->d + (s->tau - s->filter) * (x - s->x1)) / (s->filter + s->h);
    s->x1 = x;
    *x_p_m = x + s->d;
    return code;
}

static const rthyb_control_law zhao = {
    .is = {.name = "zhao",
           .meaning = "first-order lead, the inverse of a known lag; does not adapt",
           .parameters = zhao_parameters,
           .values = zhao_values,
           .parameter_count = RTHYB_COUNT(zhao_parameters),
           .value_count = RTHYB_COUNT(zhao_values)},
    .state_size = sizeof(zhao_state),
    .check = zhao_check,
    .init = zhao_init,
    .rest = zhao_rest,
    .observe = zhao_observe,
    .lead = zhao_lead,
};

RTHYB_LAW(zhao);
