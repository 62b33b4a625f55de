/* Feed-forward by the inverse of a third-order actuator (Carrion & Spencer, NSEL report 6 (2007);
 * the feed-forward of Phillips & Spencer, J. Struct. Eng. 139 (2013) 1205):
 *   1 / G(s) = a0 + a1 s + a2 s^2 + a3 s^3,   x_p = a0 x_c + a1 x_c' + a2 x_c'' + a3 x_c'''
 * with backward differences. It does not adapt. */
#include "derivative_lead.h"

enum { A0, A1, A2_SHARE, A3_SHARE };

/* clang-format off */
static const rthyb_law_parameter third_order_parameters[] = {
    {"third_order.a0", "", 0.1, 10.0, 1.0, "the inverse of the gain", 0, NULL, NULL},
    {"third_order.a1_s", "s", 0.0, 1.0, 0.02, "a1, the delay", 0, "identified.delay_s", NULL},
    {"third_order.a2_share", "", 0.0, 1.0, 0.3333333333333333, "a2 / a1^2 (1/3 for three equal lags)", 0, NULL, NULL},
    {"third_order.a3_share", "", 0.0, 1.0, 0.037037037037037035, "a3 / a1^3 (1/27 for three equal lags)", 0, NULL, NULL},
};
/* clang-format on */

typedef struct {
    rthyb_derivative_lead lead;
} third_order_state;

/* clang-format off */
static const rthyb_law_value third_order_values[] = {
    {"alpha", "samples", "lead", offsetof(third_order_state, lead.alpha)},
    {"beta", "samples²", "curvature term", offsetof(third_order_state, lead.beta)},
};
/* clang-format on */

static int third_order_init(void *state, const rthyb_law_start *start)
{
    const double *p = start->parameters, a1 = p[A1];
    const double first[] = {p[A0], a1, p[A2_SHARE] * a1 * a1, p[A3_SHARE] * a1 * a1 * a1};
    for (int i = 0; i < RTHYB_DERIVATIVES; i++) {
        if (!(fabs(first[i]) <= 1e3))
            return RTHYB_E_LAW;
    }
    rthyb_derivative_init(&((third_order_state *)state)->lead, RTHYB_DERIVATIVES, start->period_s,
                          first, start->x0_m);
    return 0;
}

static void third_order_rest(void *state, double x_m)
{
    rthyb_derivative_rest(&((third_order_state *)state)->lead, x_m);
}

static int third_order_observe(void *state, double x_p_m, double x_m_m, int frozen)
{
    (void)state, (void)frozen;
    return judge(x_p_m, RTHYB_DISPLACEMENT_MAX_M) | judge(x_m_m, RTHYB_DISPLACEMENT_MAX_M);
}

static int third_order_lead(void *state, double x_c_m, double allowed_m, double *x_p_m)
{
    return rthyb_derivative_step(&((third_order_state *)state)->lead, x_c_m, allowed_m, x_p_m);
}

static const rthyb_control_law third_order = {
    .is = {.name = "third-order",
           .meaning = "inverse of a known third-order actuator; does not adapt",
           .parameters = third_order_parameters,
           .values = third_order_values,
           .parameter_count = RTHYB_COUNT(third_order_parameters),
           .value_count = RTHYB_COUNT(third_order_values),
           .benchmark_start = RTHYB_START_THIRD_ORDER},
    .state_size = sizeof(third_order_state),
    .init = third_order_init,
    .rest = third_order_rest,
    .observe = third_order_observe,
    .lead = third_order_lead,
};

RTHYB_LAW(third_order);
