/* No compensation: x_p = x_c. */
#include "control_law.h"

typedef struct {
    double last;        /* last valid command */
    double alpha, beta; /* 0 */
} none_state;

static int none_init(void *state, const rthyb_law_start *start)
{
    ((none_state *)state)->last = start->x0_m;
    return 0;
}

static void none_rest(void *state, double x_m)
{
    ((none_state *)state)->last = x_m;
}

static int none_observe(void *state, double x_p_m, double x_m_m, int frozen)
{
    (void)state, (void)frozen;
    return judge(x_p_m, RTHYB_DISPLACEMENT_MAX_M) | judge(x_m_m, RTHYB_DISPLACEMENT_MAX_M);
}

static int none_lead(void *state, double x_c_m, double allowed_m, double *x_p_m)
{
    none_state *s = state;
    int code = RTHYB_OK;
    (void)allowed_m;
    *x_p_m = s->last = accept(x_c_m, RTHYB_DISPLACEMENT_MAX_M, s->last, &code);
    return code;
}

static const rthyb_law_value none_values[] = {
    {"alpha", "samples", "delay compensated", offsetof(none_state, alpha)},
    {"beta", "samples²", "curvature term", offsetof(none_state, beta)},
};

static const rthyb_control_law none = {
    .is = {.name = "none",
           .meaning = "no compensation: the command is sent as computed",
           .values = none_values,
           .value_count = RTHYB_COUNT(none_values),
           .passes = 1},
    .state_size = sizeof(none_state),
    .init = none_init,
    .rest = none_rest,
    .observe = none_observe,
    .lead = none_lead,
};

RTHYB_LAW(none);
