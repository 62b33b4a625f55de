/* Adaptive time series (Chae, Kazemibidokhti & Ricles, EESD 42 (2013) 1697; Chalarca et al.):
 *   x_p = a0 x_c + a1 x_c' + a2 x_c''
 * with backward differences, and (a0, a1, a2) the least-squares fit of the command to (x_m, x_m',
 * x_m'') in a moving window, command and measurement after the same low-pass:
 *   A = (X' X)^-1 X' U
 * The coefficients are held while the measurement has moved less than a threshold, are kept within
 * bounds, and change no faster than a given rate. Initially a0 = 1, and a2 = a1^2 / 2 or another
 * share. The numbers are those of the authors' own set-up file. */
#include "derivative_lead.h"
#include "filter_pair.h"

#define SECTIONS 3    /* of the low-pass: sixth order */
#define ROWS_MAX 320u /* of the window */
#define TERMS 3
#define PIVOT_MIN 1e-12 /* of columns of unit length: below, the three terms are indistinct */

enum {
    A1,
    WINDOW,
    SPACING,
    CUTOFF,
    THRESHOLD,
    A0_MIN,
    A0_MAX,
    A1_MAX,
    A2_MAX,
    A0_RATE,
    A1_RATE,
    A2_RATE,
    A2_SHARE
};

/* clang-format off */
static const rthyb_law_parameter ats_parameters[] = {
    {"ats.a1_s", "s", 0.0, 1.0, 0.02, "the initial a1, the delay", 0, "identified.delay_s", NULL},
    {"ats.window_s", "s", 0.0, 10.0, 1.0, "the window of the least squares", RTHYB_OPEN_LOW, NULL, "window {} s"},
    {"ats.spacing_s", "s", 0.0, 1.0, 0.00390625, "the time between the rows of the window", RTHYB_OPEN_LOW, NULL, NULL},
    {"ats.cutoff_hz", "Hz", 0.5, 400.0, 20.0, "the cut-off of the low-pass pair", 0, NULL, NULL},
    {"ats.threshold_m", "m", 0.0, 1.0, 0.000254, "the smallest motion in the window at which the law adapts", 0, NULL, NULL},
    {"ats.a0_min", "", 0.0, 1.0, 0.7, "the smallest a0", RTHYB_OPEN_LOW, NULL, NULL},
    {"ats.a0_max", "", 1.0, 10.0, 1.3, "the largest a0", 0, NULL, NULL},
    {"ats.a1_max_s", "s", 0.0, 1.0, 0.08, "the largest a1", 0, NULL, NULL},
    {"ats.a2_max_s2", "s^2", 0.0, 1.0, 0.0032, "the largest a2", 0, NULL, NULL},
    {"ats.a0_rate_per_s", "1/s", 0.0, 1e3, 2.0, "the fastest change of a0", 0, NULL, NULL},
    {"ats.a1_rate_s_per_s", "", 0.0, 1e3, 0.05, "the fastest change of a1, s per s", 0, NULL, NULL},
    {"ats.a2_rate_s2_per_s", "s", 0.0, 1e3, 0.001, "the fastest change of a2, s^2 per s", 0, NULL, NULL},
    {"ats.a2_share", "", 0.0, 1.0, 0.5, "the initial a2 / a1^2 (0.5 for a pure delay)", 0, NULL, NULL},
};
/* clang-format on */

typedef struct {
    double m[TERMS]; /* x_m, x_m', x_m'' after the low-pass */
    double u;        /* the command after it */
} row;

typedef struct {
    rthyb_filter_pair pair;
    double h;                                    /* sampling period */
    double low[TERMS], high[TERMS], most[TERMS]; /* bounds; largest change per row */
    double threshold;
    rthyb_derivative_lead lead;  /* a0, a1, a2 */
    rthyb_differences m;         /* of x_m after the low-pass */
    uint32_t spacing, since;     /* ticks between rows; ticks since the last row */
    uint32_t size, head, filled; /* rows in the window; next one to be overwritten; rows filled */
    row rows[ROWS_MAX];
} ats_state;

/* clang-format off */
static const rthyb_law_value ats_values[] = {
    {"alpha", "samples", "delay estimate", offsetof(ats_state, lead.alpha)},
    {"beta", "samples²", "curvature term", offsetof(ats_state, lead.beta)},
    {"a0", "", "a0", offsetof(ats_state, lead.used[0])},
    {"a1", "s", "a1", offsetof(ats_state, lead.used[1])},
    {"a2", "s²", "a2", offsetof(ats_state, lead.used[2])},
};
/* clang-format on */

static int ats_check(const double *p, double period_s, rthyb_law_complaint *why)
{
    const double spacing = fmax(p[SPACING], period_s);
    if (!rthyb_below_half_rate(p[CUTOFF], period_s, why))
        return CUTOFF;
    if (!(p[WINDOW] >= 4.0 * spacing && p[WINDOW] <= 0.9 * ROWS_MAX * spacing)) {
        *why = (rthyb_law_complaint){
            "found {} s; must be from 4 to 288 times spacing_s = {} s (or one sample, {} s)",
            {p[WINDOW], p[SPACING], period_s}};
        return WINDOW;
    }
    if (p[A1] > p[A1_MAX]) {
        *why = (rthyb_law_complaint){"found {} s; must be at most a1_max_s = {} s",
                                     {p[A1], p[A1_MAX]}};
        return A1;
    }
    if (p[A2_SHARE] * p[A1] * p[A1] > p[A2_MAX]) {
        *why = (rthyb_law_complaint){
            "found {} s^2; a2 begins with a2_share times the square of a1_s = {} s and must be at "
            "least that",
            {p[A2_MAX], p[A1]}};
        return A2_MAX;
    }
    return -1;
}

static int ats_init(void *state, const rthyb_law_start *start)
{
    ats_state *s = state;
    const double *p = start->parameters;
    s->h = start->period_s;
    s->spacing = ticks_of(p[SPACING], s->h);
    const uint32_t rows = ticks_of(p[WINDOW], s->h) / s->spacing;
    if (rows < TERMS || rows > ROWS_MAX || !(p[CUTOFF] > 0.0))
        return RTHYB_E_LAW;
    s->size = rows;
    rthyb_pair_init(&s->pair, SECTIONS, p[CUTOFF], s->h, start->x0_m);
    const double low[] = {p[A0_MIN], 0.0, 0.0}, high[] = {p[A0_MAX], p[A1_MAX], p[A2_MAX]};
    const double first[] = {1.0, p[A1], p[A2_SHARE] * p[A1] * p[A1]};
    const double rate[] = {p[A0_RATE], p[A1_RATE], p[A2_RATE]};
    for (int i = 0; i < TERMS; i++) {
        s->low[i] = low[i];
        s->high[i] = high[i];
        s->most[i] = fabs(rate[i]) * s->h * s->spacing;
    }
    s->threshold = p[THRESHOLD];
    rthyb_derivative_init(&s->lead, TERMS, s->h, first, start->x0_m);
    return 0;
}

static void ats_rest(void *state, double x_m)
{
    rthyb_derivative_rest(&((ats_state *)state)->lead, x_m);
}

/* Solves for X'X and X'U over the window, columns scaled to unit length; 0 if the three terms
 * cannot be distinguished. */
static int solve(const ats_state *s, double *a)
{
    double n[TERMS][TERMS + 1] = {{0.0}}, scale[TERMS];
    for (uint32_t k = 0; k < s->filled; k++) {
        const row *r = &s->rows[k];
        for (int i = 0; i < TERMS; i++) {
            for (int j = i; j < TERMS; j++)
                n[i][j] += r->m[i] * r->m[j];
            n[i][TERMS] += r->m[i] * r->u;
        }
    }
    for (int i = 0; i < TERMS; i++) {
        if (!(n[i][i] > 0.0))
            return 0;
        scale[i] = 1.0 / sqrt(n[i][i]);
    }
    for (int i = 0; i < TERMS; i++) {
        n[i][TERMS] *= scale[i];
        for (int j = i; j < TERMS; j++)
            n[i][j] = n[j][i] = n[i][j] * scale[i] * scale[j];
    }
    for (int i = 0; i < TERMS; i++) {
        if (!(n[i][i] > PIVOT_MIN))
            return 0;
        for (int r = i + 1; r < TERMS; r++) {
            const double f = n[r][i] / n[i][i];
            for (int j = i; j <= TERMS; j++)
                n[r][j] -= f * n[i][j];
        }
    }
    for (int i = TERMS - 1; i >= 0; i--) {
        a[i] = n[i][TERMS];
        for (int j = i + 1; j < TERMS; j++)
            a[i] -= n[i][j] * a[j];
        a[i] /= n[i][i];
    }
    for (int i = 0; i < TERMS; i++)
        a[i] *= scale[i];
    return isfinite(a[0]) && isfinite(a[1]) && isfinite(a[2]);
}

static double largest_motion(const ats_state *s)
{
    double most = 0.0;
    for (uint32_t k = 0; k < s->filled; k++)
        most = fmax(most, fabs(s->rows[k].m[0]));
    return most;
}

static void learn(ats_state *s)
{
    double a[TERMS];
    if (s->filled < s->size || !(largest_motion(s) > s->threshold) || !solve(s, a))
        return;
    for (int i = 0; i < TERMS; i++) {
        const double wanted = clamp(a[i], s->low[i], s->high[i]);
        s->lead.learnt[i] += clamp(wanted - s->lead.learnt[i], -s->most[i], s->most[i]);
    }
}

static int ats_observe(void *state, double x_p_m, double x_m_m, int frozen)
{
    ats_state *s = state;
    const int first = !s->pair.primed;
    double u, m;
    const int code = rthyb_pair_step(&s->pair, x_p_m, x_m_m, &u, &m);
    if (first)
        rthyb_differences_rest(&s->m, s->pair.last_m);
    row now = {.u = u};
    rthyb_differences_step(&s->m, TERMS, s->h, m, now.m);
    s->since++;
    if (s->since < s->spacing || frozen || code != RTHYB_OK)
        return code;
    s->since = 0;
    s->rows[s->head] = now;
    s->head = (s->head + 1) % s->size;
    s->filled += s->filled < s->size;
    learn(s);
    return code;
}

static int ats_lead(void *state, double x_c_m, double allowed_m, double *x_p_m)
{
    return rthyb_derivative_step(&((ats_state *)state)->lead, x_c_m, allowed_m, x_p_m);
}

static const rthyb_control_law ats = {
    .is = {.name = "ats",
           .meaning =
               "adaptive time series: gain, delay and curvature by least squares over a window",
           .calmer = "lower controller.ats.a1_rate_s_per_s, or raise its window_s",
           .parameters = ats_parameters,
           .values = ats_values,
           .parameter_count = RTHYB_COUNT(ats_parameters),
           .value_count = RTHYB_COUNT(ats_values),
           .benchmark_start = RTHYB_START_SECOND_ORDER},
    .state_size = sizeof(ats_state),
    .check = ats_check,
    .init = ats_init,
    .rest = ats_rest,
    .observe = ats_observe,
    .lead = ats_lead,
};

RTHYB_LAW(ats);
