/* Polynomial extrapolation (Horiuchi, Inoue, Konno & Namita, EESD 28 (1999) 1121): the polynomial
 * of degree N through x[n], x[n-D], ... x[n-ND], with the delay of D samples as spacing, evaluated
 * D samples ahead:
 *   x_p[n] = sum_i (-1)^i binom(N+1, i+1) x[n-iD]
 * N = 1: 2, -1;  N = 2: 3, -3, 1;  N = 3: 4, -6, 4, -1. It does not adapt. Motions of a frequency
 * above about 1 / (4 delay) are amplified. */
#include "control_law.h"

#define HISTORY 1536u /* samples: three times an eighth of a second at 4096 Hz */
#define ORDER_MAX 3

enum { DELAY, ORDER };

/* clang-format off */
static const rthyb_law_parameter horiuchi_parameters[] = {
    {"horiuchi.delay_s", "s", 0.0, 0.125, 0.02, "the delay of the actuator", RTHYB_OPEN_LOW, "identified.delay_s", NULL},
    {"horiuchi.order", "", 1.0, 3.0, 3.0, "the degree of the polynomial", 0, NULL, "degree {}"},
};
/* clang-format on */

typedef struct {
    double weight[ORDER_MAX + 1];
    double x[HISTORY];
    uint32_t delay, order, at; /* samples; degree; index of the newest x */
    double alpha, beta;        /* reported */
} horiuchi_state;

/* clang-format off */
static const rthyb_law_value horiuchi_values[] = {
    {"alpha", "samples", "lead", offsetof(horiuchi_state, alpha)},
    {"beta", "samples²", "curvature term", offsetof(horiuchi_state, beta)},
};
/* clang-format on */

static int horiuchi_check(const double *p, double period_s, rthyb_law_complaint *why)
{
    (void)period_s;
    if (p[ORDER] == rint(p[ORDER]))
        return -1;
    *why = (rthyb_law_complaint){"found {}; must be 1, 2 or 3", {p[ORDER]}};
    return ORDER;
}

static void horiuchi_rest(void *state, double x_m)
{
    horiuchi_state *s = state;
    for (uint32_t i = 0; i < HISTORY; i++)
        s->x[i] = x_m;
}

static int horiuchi_init(void *state, const rthyb_law_start *start)
{
    static const double WEIGHTS[ORDER_MAX][ORDER_MAX + 1] = {
        {2.0, -1.0}, {3.0, -3.0, 1.0}, {4.0, -6.0, 4.0, -1.0}};
    horiuchi_state *s = state;
    const double order = start->parameters[ORDER], delay = start->parameters[DELAY];
    if (!(order >= 1.0 && order <= ORDER_MAX && delay >= 0.0 && delay <= 1.0))
        return RTHYB_E_LAW;
    s->order = (uint32_t)order;
    s->delay = ticks_of(delay, start->period_s);
    s->alpha = s->delay;
    for (int i = 0; i <= ORDER_MAX; i++)
        s->weight[i] = WEIGHTS[s->order - 1][i];
    horiuchi_rest(state, start->x0_m);
    return s->order * s->delay < HISTORY ? 0 : RTHYB_E_LAW;
}

static int horiuchi_observe(void *state, double x_p_m, double x_m_m, int frozen)
{
    (void)state, (void)frozen;
    return judge(x_p_m, RTHYB_DISPLACEMENT_MAX_M) | judge(x_m_m, RTHYB_DISPLACEMENT_MAX_M);
}

static int horiuchi_lead(void *state, double x_c_m, double allowed_m, double *x_p_m)
{
    horiuchi_state *s = state;
    int code = RTHYB_OK;
    (void)allowed_m;
    const double x = accept(x_c_m, RTHYB_DISPLACEMENT_MAX_M, s->x[s->at], &code);
    s->at = (s->at + 1) % HISTORY;
    s->x[s->at] = x;
    double led = 0.0;
    for (uint32_t i = 0; i <= s->order; i++)
        led += s->weight[i] * s->x[(s->at + HISTORY - i * s->delay) % HISTORY];
    *x_p_m = led;
    return code;
}

static const rthyb_control_law horiuchi = {
    .is = {.name = "horiuchi",
           .meaning = "polynomial extrapolation over a known delay; does not adapt",
           .parameters = horiuchi_parameters,
           .values = horiuchi_values,
           .parameter_count = RTHYB_COUNT(horiuchi_parameters),
           .value_count = RTHYB_COUNT(horiuchi_values)},
    .state_size = sizeof(horiuchi_state),
    .check = horiuchi_check,
    .init = horiuchi_init,
    .rest = horiuchi_rest,
    .observe = horiuchi_observe,
    .lead = horiuchi_lead,
};

RTHYB_LAW(horiuchi);
