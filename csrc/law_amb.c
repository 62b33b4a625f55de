/* Adaptive model-based compensation (Galmez & Fermandois, Struct. Control Health Monit. 29 (2022)
 * e2962): the inverse of a third-order actuator,
 *   x_p = a0 x_c + a1 x_c' + a2 x_c'' + a3 x_c'''
 * with backward differences, adapted by a normalised gradient: after the same fourth-order
 * low-pass, with p the command and phi = (m, m', m'', m''') from the measurement,
 *   e = (p - a . phi) / (1 + phi . phi),   da/dt = Gamma e phi,   a >= 0,
 * in metres and seconds, Gamma diagonal. The numbers are those of the authors' own model of the
 * benchmark. */
#include "derivative_lead.h"
#include "filter_pair.h"

#define SECTIONS 2 /* of the low-pass: fourth order */
#define TERMS RTHYB_DERIVATIVES

enum { A1, A2_SHARE, A3_SHARE, CUTOFF, GAIN0, GAIN1, GAIN2, GAIN3, MOST0 };

/* clang-format off */
static const rthyb_law_parameter amb_parameters[] = {
    {"amb.a1_s", "s", 0.0, 1.0, 0.01986, "the initial a1, the delay", 0, "identified.delay_s", NULL},
    {"amb.a2_share", "", 0.0, 1.0, 0.214, "the initial a2 / a1^2 (0.5 for a pure delay)", 0, NULL, NULL},
    {"amb.a3_share", "", 0.0, 1.0, 0.0254, "the initial a3 / a1^3 (0.167 for a pure delay)", 0, NULL, NULL},
    {"amb.cutoff_hz", "Hz", 0.5, 400.0, 20.0, "the cut-off of the low-pass pair", 0, NULL, NULL},
    {"amb.log_gain0", "", -12.0, 12.0, 8.4, "the decimal logarithm of the gain of a0", 0, NULL, NULL},
    {"amb.log_gain1", "", -12.0, 12.0, 6.2, "the decimal logarithm of the gain of a1", 0, NULL, NULL},
    {"amb.log_gain2", "", -12.0, 12.0, 2.1, "the decimal logarithm of the gain of a2", 0, NULL, NULL},
    {"amb.log_gain3", "", -12.0, 12.0, 0.8, "the decimal logarithm of the gain of a3", 0, NULL, NULL},
    {"amb.a0_max", "", 1.0, 10.0, 10.0, "the largest a0", 0, NULL, NULL},
    {"amb.a1_max_s", "s", 0.0, 1.0, 1.0, "the largest a1", 0, NULL, NULL},
    {"amb.a2_max_s2", "s^2", 0.0, 1.0, 0.1, "the largest a2", 0, NULL, NULL},
    {"amb.a3_max_s3", "", 0.0, 1.0, 0.01, "the largest a3, s^3", 0, NULL, NULL},
};
/* clang-format on */

typedef struct {
    rthyb_filter_pair pair;
    double step[TERMS], high[TERMS]; /* gain times sampling period; upper bounds */
    rthyb_derivative_lead lead;      /* a0 to a3 */
    rthyb_differences m;             /* of x_m after the low-pass */
} amb_state;

/* clang-format off */
static const rthyb_law_value amb_values[] = {
    {"alpha", "samples", "delay estimate", offsetof(amb_state, lead.alpha)},
    {"beta", "samples²", "curvature term", offsetof(amb_state, lead.beta)},
    {"a0", "", "a0", offsetof(amb_state, lead.used[0])},
    {"a1", "s", "a1", offsetof(amb_state, lead.used[1])},
    {"a2", "s²", "a2", offsetof(amb_state, lead.used[2])},
    {"a3", "s³", "a3", offsetof(amb_state, lead.used[3])},
};
/* clang-format on */

static void first_coefficients(const double *p, double *first)
{
    const double a1 = p[A1];
    first[0] = 1.0;
    first[1] = a1;
    first[2] = p[A2_SHARE] * a1 * a1;
    first[3] = p[A3_SHARE] * a1 * a1 * a1;
}

static int amb_check(const double *p, double period_s, rthyb_law_complaint *why)
{
    double first[TERMS];
    if (!rthyb_below_half_rate(p[CUTOFF], period_s, why))
        return CUTOFF;
    first_coefficients(p, first);
    for (int i = 1; i < TERMS; i++) {
        if (first[i] > p[MOST0 + i]) {
            *why = (rthyb_law_complaint){
                "found {}; must be at least {}, which a1_s and the shares begin with",
                {p[MOST0 + i], first[i]}};
            return MOST0 + i;
        }
    }
    return -1;
}

static int amb_init(void *state, const rthyb_law_start *start)
{
    amb_state *s = state;
    const double *p = start->parameters;
    double first[TERMS];
    if (!(p[CUTOFF] > 0.0))
        return RTHYB_E_LAW;
    rthyb_pair_init(&s->pair, SECTIONS, p[CUTOFF], start->period_s, start->x0_m);
    first_coefficients(p, first);
    for (int i = 0; i < TERMS; i++) {
        s->high[i] = p[MOST0 + i];
        s->step[i] = start->period_s * pow(10.0, p[GAIN0 + i]);
        if (!(s->high[i] <= 1e3 && isfinite(s->step[i]) && fabs(first[i]) <= 1e3))
            return RTHYB_E_LAW;
    }
    rthyb_derivative_init(&s->lead, TERMS, start->period_s, first, start->x0_m);
    return 0;
}

static void amb_rest(void *state, double x_m)
{
    rthyb_derivative_rest(&((amb_state *)state)->lead, x_m);
}

static void learn(amb_state *s, double u, const double *phi)
{
    double error = u, power = 1.0;
    for (int i = 0; i < TERMS; i++) {
        error -= s->lead.learnt[i] * phi[i];
        power += phi[i] * phi[i];
    }
    for (int i = 0; i < TERMS; i++)
        s->lead.learnt[i] =
            clamp(s->lead.learnt[i] + s->step[i] * error * phi[i] / power, 0.0, s->high[i]);
}

static int amb_observe(void *state, double x_p_m, double x_m_m, int frozen)
{
    amb_state *s = state;
    double phi[TERMS];
    const int first = !s->pair.primed;
    double u, m;
    const int code = rthyb_pair_step(&s->pair, x_p_m, x_m_m, &u, &m);
    if (first)
        rthyb_differences_rest(&s->m, s->pair.last_m);
    rthyb_differences_step(&s->m, TERMS, s->lead.h, m, phi);
    if (!frozen && code == RTHYB_OK)
        learn(s, u, phi);
    return code;
}

static int amb_lead(void *state, double x_c_m, double allowed_m, double *x_p_m)
{
    return rthyb_derivative_step(&((amb_state *)state)->lead, x_c_m, allowed_m, x_p_m);
}

static const rthyb_control_law amb = {
    .is = {.name = "amb",
           .meaning = "adaptive model-based: third-order inverse, adapted by a normalised gradient",
           .calmer = "lower controller.amb.log_gain0 to log_gain3",
           .parameters = amb_parameters,
           .values = amb_values,
           .parameter_count = RTHYB_COUNT(amb_parameters),
           .value_count = RTHYB_COUNT(amb_values),
           .benchmark_start = RTHYB_START_TABLE},
    .state_size = sizeof(amb_state),
    .check = amb_check,
    .init = amb_init,
    .rest = amb_rest,
    .observe = amb_observe,
    .lead = amb_lead,
};

RTHYB_LAW(amb);
