/* Adaptive inverse compensation (Chen & Ricles, J. Struct. Eng. 136 (2010) 432):
 *   x_p[n] = x[n] + (alpha - 1) (x[n] - x[n-1]),   alpha = alpha_es + kp TI + ki integral of TI
 * with the tracking indicator of Mercan & Ricles (EESD 36 (2007) 1523), half the difference of the
 * areas enclosed by command and measurement,
 *   dA = (c[n] + c[n-1]) (m[n] - m[n-1]) / 2,   dTA = (m[n] + m[n-1]) (c[n] - c[n-1]) / 2,
 *   TI = (A - TA) / 2,
 * which increases while m lags c. It is proportional to the square of the motion; here TI is
 * relative to that of a reference displacement, and kp and ki refer to samples of 1/1024 s. alpha -
 * 1 is the delay in samples. */
#include "control_law.h"

enum { DELAY, KP, KI, REFERENCE, DELAY_MAX };

#define INDICATOR_MAX 1e6 /* in reference displacements squared; larger values are meaningless */

/* clang-format off */
static const rthyb_law_parameter aic_parameters[] = {
    {"aic.delay_s", "s", 0.0, 1.0, 0.02, "the initial delay", 0, "identified.delay_s", NULL},
    {"aic.kp", "", 0.0, 1e3, 0.4, "the proportional gain", 0, NULL, NULL},
    {"aic.ki_per_s", "1/s", 0.0, 1e3, 0.04, "the integral gain", 0, NULL, NULL},
    {"aic.reference_displacement_m", "m", 1e-6, 10.0, 1e-3, "the reference displacement of the gains", 0, NULL, NULL},
    {"aic.delay_max_s", "s", 0.0, 1.0, 0.06, "the largest delay", 0, NULL, NULL},
};
/* clang-format on */

typedef struct {
    double h, kp, ki, first, most; /* s per unit of TI; s per unit and second; s; s */
    double unit;                   /* reference displacement squared */
    double indicator, integral;    /* in that unit */
    double learnt, used;           /* delay, s */
    double x1;                     /* x_c[n-1] at lead, x_c[n] at observe */
    double c1, m1, last_u;         /* at the previous sample; last valid command */
    int32_t primed;
    double alpha, beta; /* reported */
} aic_state;

/* clang-format off */
static const rthyb_law_value aic_values[] = {
    {"alpha", "samples", "delay estimate", offsetof(aic_state, alpha)},
    {"beta", "samples²", "curvature term", offsetof(aic_state, beta)},
    {"indicator", "", "tracking indicator", offsetof(aic_state, indicator)},
};
/* clang-format on */

static int aic_check(const double *p, double period_s, rthyb_law_complaint *why)
{
    (void)period_s;
    if (!(p[DELAY] > p[DELAY_MAX]))
        return -1;
    *why = (rthyb_law_complaint){"found {} s; must be at most delay_max_s = {} s",
                                 {p[DELAY], p[DELAY_MAX]}};
    return DELAY;
}

static int aic_init(void *state, const rthyb_law_start *start)
{
    aic_state *s = state;
    const double *p = start->parameters;
    if (!(p[REFERENCE] > 0.0 && p[REFERENCE] <= 1e3 && p[DELAY] >= 0.0 && p[DELAY_MAX] <= 1e3 &&
          fabs(p[KP]) <= 1e6 && fabs(p[KI]) <= 1e6))
        return RTHYB_E_LAW;
    s->h = start->period_s;
    s->kp = p[KP] / 1024.0;
    s->ki = p[KI] / 1024.0;
    s->unit = fmax(p[REFERENCE] * p[REFERENCE], 1e-12);
    s->first = s->learnt = s->used = p[DELAY];
    s->most = p[DELAY_MAX];
    s->x1 = s->c1 = s->m1 = s->last_u = start->x0_m;
    s->alpha = s->used / s->h;
    return 0;
}

static void aic_rest(void *state, double x_m)
{
    aic_state *s = state;
    s->x1 = x_m;
    s->primed = 0;
}

static int aic_observe(void *state, double x_p_m, double x_m_m, int frozen)
{
    aic_state *s = state;
    int code = RTHYB_OK;
    s->last_u = accept(x_p_m, RTHYB_DISPLACEMENT_MAX_M, s->last_u, &code);
    const double c = s->x1, m = accept(x_m_m, RTHYB_DISPLACEMENT_MAX_M, s->m1, &code);
    if (!frozen && code == RTHYB_OK && s->primed) {
        const double area = 0.5 * (c + s->c1) * (m - s->m1);
        const double tracked = 0.5 * (m + s->m1) * (c - s->c1);
        s->indicator =
            clamp(s->indicator + 0.5 * (area - tracked) / s->unit, -INDICATOR_MAX, INDICATOR_MAX);
        const double wanted = s->first + s->kp * s->indicator + s->ki * s->integral;
        /* At a bound, the integral grows no further. */
        if (!((wanted > s->most && s->indicator > 0.0) || (wanted < 0.0 && s->indicator < 0.0)))
            s->integral += s->h * s->indicator;
        s->learnt = clamp(wanted, 0.0, s->most);
    }
    s->primed = 1;
    s->c1 = c;
    s->m1 = m;
    return code;
}

static int aic_lead(void *state, double x_c_m, double allowed_m, double *x_p_m)
{
    aic_state *s = state;
    int code = RTHYB_OK;
    const double x = accept(x_c_m, RTHYB_DISPLACEMENT_MAX_M, s->x1, &code);
    const double slope = (x - s->x1) / s->h;
    const double effect = fabs((s->learnt - s->used) * slope);
    s->used += rthyb_allowed_share(effect, allowed_m) * (s->learnt - s->used);
    s->alpha = s->used / s->h;
    s->x1 = x;
    *x_p_m = x + s->used * slope;
    return code;
}

static const rthyb_control_law aic = {
    .is = {.name = "aic",
           .meaning = "inverse of a first-order lag; adapts the delay by the tracking indicator",
           .calmer = "lower controller.aic.kp and ki_per_s, or raise its reference_displacement_m",
           .parameters = aic_parameters,
           .values = aic_values,
           .parameter_count = RTHYB_COUNT(aic_parameters),
           .value_count = RTHYB_COUNT(aic_values)},
    .state_size = sizeof(aic_state),
    .check = aic_check,
    .init = aic_init,
    .rest = aic_rest,
    .observe = aic_observe,
    .lead = aic_lead,
};

RTHYB_LAW(aic);
