/* Polynomial extrapolation over a delay that is corrected by the tracking error (Darby, Williams &
 * Blakeborough, J. Eng. Mech. 128 (2002) 1276):
 *   tau[n+1] = tau[n] + Cp tanh(Cv v) (x_c - x_m)
 * with v the velocity of x_c, and x_p from the polynomial of degree N through x_c now and one, two,
 * ... tau ago (Horiuchi et al. 1999), with linear interpolation between samples. Cp is per sample
 * of 1/1024 s; both constants were chosen for this program, for motions of millimetres. */
#include "control_law.h"

#define HISTORY 1536u
#define ORDER_MAX 3
#define TRIALS 8

enum { DELAY, ORDER, CP, CV, DELAY_MIN, DELAY_MAX };

/* clang-format off */
static const rthyb_law_parameter darby_parameters[] = {
    {"darby.delay_s", "s", 0.0, 0.125, 0.02, "the initial delay", 0, "identified.delay_s", NULL},
    {"darby.order", "", 1.0, 3.0, 3.0, "the degree of the polynomial", 0, NULL, "degree {}"},
    {"darby.cp_s_per_m", "s/m", 0.0, 1e3, 0.05, "the correction of the delay per sample", 0, NULL, NULL},
    {"darby.cv_s_per_m", "s/m", 0.0, 1e6, 200.0, "the steepness of the smoothed sign of the velocity", 0, NULL, NULL},
    {"darby.delay_min_s", "s", 0.0, 0.125, 0.0, "the smallest delay", 0, NULL, NULL},
    {"darby.delay_max_s", "s", 0.0, 0.125, 0.06, "the largest delay", 0, NULL, NULL},
};
/* clang-format on */

typedef struct {
    double weight[ORDER_MAX + 1];
    double x[HISTORY];
    double h, cp, cv, least, most;
    double learnt, used; /* delay, s */
    double last_u, last_m;
    uint32_t order, at;
    double alpha, beta; /* reported */
} darby_state;

/* clang-format off */
static const rthyb_law_value darby_values[] = {
    {"alpha", "samples", "delay estimate", offsetof(darby_state, alpha)},
    {"beta", "samples²", "curvature term", offsetof(darby_state, beta)},
};
/* clang-format on */

static int darby_check(const double *p, double period_s, rthyb_law_complaint *why)
{
    (void)period_s;
    if (p[ORDER] != rint(p[ORDER])) {
        *why = (rthyb_law_complaint){"found {}; must be 1, 2 or 3", {p[ORDER]}};
        return ORDER;
    }
    if (p[DELAY] > p[DELAY_MAX] || p[DELAY] < p[DELAY_MIN]) {
        *why = (rthyb_law_complaint){
            "found {} s; must not be below delay_min_s or above delay_max_s = {} s",
            {p[DELAY], p[DELAY_MAX]}};
        return DELAY;
    }
    return -1;
}

static void darby_rest(void *state, double x_m)
{
    darby_state *s = state;
    for (uint32_t i = 0; i < HISTORY; i++)
        s->x[i] = x_m;
}

static int darby_init(void *state, const rthyb_law_start *start)
{
    static const double WEIGHTS[ORDER_MAX][ORDER_MAX + 1] = {
        {2.0, -1.0}, {3.0, -3.0, 1.0}, {4.0, -6.0, 4.0, -1.0}};
    darby_state *s = state;
    const double *p = start->parameters;
    if (!(p[ORDER] >= 1.0 && p[ORDER] <= ORDER_MAX && p[DELAY] >= 0.0 && p[DELAY_MIN] >= 0.0 &&
          p[DELAY_MAX] >= p[DELAY_MIN] && fabs(p[CP]) <= 1e6 && fabs(p[CV]) <= 1e9))
        return RTHYB_E_LAW;
    s->h = start->period_s;
    s->order = (uint32_t)p[ORDER];
    if (!(s->order * (p[DELAY_MAX] / s->h) < HISTORY - 2.0))
        return RTHYB_E_LAW;
    for (int i = 0; i <= ORDER_MAX; i++)
        s->weight[i] = WEIGHTS[s->order - 1][i];
    s->cp = p[CP] / rthyb_pace(s->h);
    s->cv = p[CV];
    s->least = p[DELAY_MIN];
    s->most = p[DELAY_MAX];
    s->learnt = s->used = clamp(p[DELAY], s->least, s->most);
    s->alpha = s->used / s->h;
    s->last_u = s->last_m = start->x0_m;
    darby_rest(state, start->x0_m);
    return 0;
}

static int darby_observe(void *state, double x_p_m, double x_m_m, int frozen)
{
    darby_state *s = state;
    int code = RTHYB_OK;
    s->last_u = accept(x_p_m, RTHYB_DISPLACEMENT_MAX_M, s->last_u, &code);
    s->last_m = accept(x_m_m, RTHYB_DISPLACEMENT_MAX_M, s->last_m, &code);
    if (frozen || code != RTHYB_OK)
        return code;
    const double x = s->x[s->at], v = (x - s->x[(s->at + HISTORY - 1) % HISTORY]) / s->h;
    const double next = s->learnt + s->cp * tanh(s->cv * v) * (x - s->last_m);
    s->learnt = clamp(next, s->least, s->most);
    return code;
}

static double extrapolated(const darby_state *s, double delay_s)
{
    double led = 0.0;
    for (uint32_t i = 0; i <= s->order; i++) {
        const double back = i * delay_s / s->h, whole = floor(back), part = back - whole;
        const uint32_t at = (s->at + HISTORY - (uint32_t)whole) % HISTORY;
        const uint32_t before = (at + HISTORY - 1) % HISTORY;
        led += s->weight[i] * (s->x[at] + part * (s->x[before] - s->x[at]));
    }
    return led;
}

/* The delay moves towards the estimate as far as the command may move; if no such step is found, it
 * stays. */
static double approached(const darby_state *s, double allowed_m)
{
    const double held = extrapolated(s, s->used);
    double share = 1.0;
    for (int i = 0; i < TRIALS; i++) {
        const double delay = s->used + share * (s->learnt - s->used);
        const double effect = fabs(extrapolated(s, delay) - held);
        if (effect <= allowed_m)
            return delay;
        share *= 0.9 * allowed_m / effect;
    }
    return s->used;
}

static int darby_lead(void *state, double x_c_m, double allowed_m, double *x_p_m)
{
    darby_state *s = state;
    int code = RTHYB_OK;
    const double x = accept(x_c_m, RTHYB_DISPLACEMENT_MAX_M, s->x[s->at], &code);
    s->at = (s->at + 1) % HISTORY;
    s->x[s->at] = x;
    s->used = approached(s, allowed_m);
    s->alpha = s->used / s->h;
    *x_p_m = extrapolated(s, s->used);
    return code;
}

static const rthyb_control_law darby = {
    .is = {.name = "darby",
           .meaning = "polynomial extrapolation; adapts the delay to the tracking error",
           .calmer = "lower controller.darby.cp_s_per_m",
           .parameters = darby_parameters,
           .values = darby_values,
           .parameter_count = RTHYB_COUNT(darby_parameters),
           .value_count = RTHYB_COUNT(darby_values)},
    .state_size = sizeof(darby_state),
    .check = darby_check,
    .init = darby_init,
    .rest = darby_rest,
    .observe = darby_observe,
    .lead = darby_lead,
};

RTHYB_LAW(darby);
