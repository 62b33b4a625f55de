/* Extrapolation by velocity and acceleration, over a delay that is corrected during the test
 * (Ahmadizadeh, Mosqueda & Reinhorn, EESD 37 (2008) 21):
 *   x_p = x_c + tau x_c' + tau^2 / 2 x_c'',   tau += g mean((x_c - x_m) / v)
 * with v the velocity of x_c; the mean is over those samples of a window in which command and
 * measurement move in the same direction and fast enough. Window, gain and threshold were chosen
 * for this program, for motions of millimetres. */
#include "derivative_lead.h"

#define TERMS 3
#define SLOPE_S 0.005 /* over which the measured velocity is computed, to reduce its noise */
#define SLOPE_MAX 32u

enum { DELAY, WINDOW, GAIN, SLOWEST, DELAY_MAX };

/* clang-format off */
static const rthyb_law_parameter ahmadizadeh_parameters[] = {
    {"ahmadizadeh.delay_s", "s", 0.0, 1.0, 0.02, "the initial delay", 0, "identified.delay_s", NULL},
    {"ahmadizadeh.window_s", "s", 0.01, 60.0, 0.5, "the window of the mean", 0, NULL, "window {} s"},
    {"ahmadizadeh.gain", "", 0.0, 1.0, 0.3, "the fraction of the mean that is corrected", 0, NULL, NULL},
    {"ahmadizadeh.slowest_m_per_s", "m/s", 0.0, 10.0, 0.01, "the smallest velocity at which the law adapts", RTHYB_OPEN_LOW, NULL, NULL},
    {"ahmadizadeh.delay_max_s", "s", 0.0, 1.0, 0.06, "the largest delay", 0, NULL, NULL},
};
/* clang-format on */

typedef struct {
    rthyb_derivative_lead lead;
    double m[SLOPE_MAX]; /* newest readings */
    double delay, most, gain, slowest;
    double sum, count; /* in the window so far */
    double last_u, last_m;
    uint32_t window, since, span, at;
    int32_t primed;
} ahmadizadeh_state;

/* clang-format off */
static const rthyb_law_value ahmadizadeh_values[] = {
    {"alpha", "samples", "delay estimate", offsetof(ahmadizadeh_state, lead.alpha)},
    {"beta", "samples²", "curvature term", offsetof(ahmadizadeh_state, lead.beta)},
};
/* clang-format on */

static int ahmadizadeh_check(const double *p, double period_s, rthyb_law_complaint *why)
{
    (void)period_s;
    if (!(p[DELAY] > p[DELAY_MAX]))
        return -1;
    *why = (rthyb_law_complaint){"found {} s; must be at most delay_max_s = {} s",
                                 {p[DELAY], p[DELAY_MAX]}};
    return DELAY;
}

static void lead_by(double delay_s, double *terms)
{
    terms[0] = 1.0;
    terms[1] = delay_s;
    terms[2] = 0.5 * delay_s * delay_s;
}

static int ahmadizadeh_init(void *state, const rthyb_law_start *start)
{
    ahmadizadeh_state *s = state;
    const double *p = start->parameters, h = start->period_s;
    if (!(p[DELAY] >= 0.0 && p[DELAY_MAX] <= 1e3 && p[WINDOW] > 0.0 && p[SLOWEST] > 0.0 &&
          fabs(p[GAIN]) <= 1e3))
        return RTHYB_E_LAW;
    s->delay = p[DELAY];
    s->most = p[DELAY_MAX];
    s->gain = p[GAIN];
    s->slowest = fmax(p[SLOWEST], 1e-9);
    s->window = ticks_of(p[WINDOW], h);
    const uint32_t span = ticks_of(SLOPE_S, h);
    s->span = span < SLOPE_MAX ? span : SLOPE_MAX - 1;
    s->last_u = s->last_m = start->x0_m;
    double first[TERMS];
    lead_by(s->delay, first);
    rthyb_derivative_init(&s->lead, TERMS, h, first, start->x0_m);
    return 0;
}

static void ahmadizadeh_rest(void *state, double x_m)
{
    rthyb_derivative_rest(&((ahmadizadeh_state *)state)->lead, x_m);
}

/* Processes the pair of this tick: x_c and its velocity are those of the last call of `lead`. */
static void learn(ahmadizadeh_state *s, double measured_slope)
{
    const double x = s->lead.before.d[0], v = s->lead.before.d[1];
    if (fabs(v) > s->slowest && fabs(measured_slope) > s->slowest && v * measured_slope > 0.0) {
        s->sum += (x - s->last_m) / v;
        s->count += 1.0;
    }
    if (++s->since < s->window)
        return;
    if (s->count > 0.0)
        s->delay = clamp(s->delay + s->gain * s->sum / s->count, 0.0, s->most);
    s->sum = s->count = 0.0;
    s->since = 0;
    lead_by(s->delay, s->lead.learnt);
}

static int ahmadizadeh_observe(void *state, double x_p_m, double x_m_m, int frozen)
{
    ahmadizadeh_state *s = state;
    int code = RTHYB_OK;
    s->last_u = accept(x_p_m, RTHYB_DISPLACEMENT_MAX_M, s->last_u, &code);
    s->last_m = accept(x_m_m, RTHYB_DISPLACEMENT_MAX_M, s->last_m, &code);
    for (uint32_t i = 0; !s->primed && i < SLOPE_MAX; i++)
        s->m[i] = s->last_m;
    s->primed = 1;
    s->at = (s->at + 1) % SLOPE_MAX;
    s->m[s->at] = s->last_m;
    const double before = s->m[(s->at + SLOPE_MAX - s->span) % SLOPE_MAX];
    if (!frozen && code == RTHYB_OK)
        learn(s, (s->last_m - before) / (s->span * s->lead.h));
    return code;
}

static int ahmadizadeh_lead(void *state, double x_c_m, double allowed_m, double *x_p_m)
{
    return rthyb_derivative_step(&((ahmadizadeh_state *)state)->lead, x_c_m, allowed_m, x_p_m);
}

static const rthyb_control_law ahmadizadeh = {
    .is = {.name = "ahmadizadeh",
           .meaning = "extrapolation with velocity and acceleration; adapts the delay to the error",
           .calmer = "lower controller.ahmadizadeh.gain, or raise its window_s",
           .parameters = ahmadizadeh_parameters,
           .values = ahmadizadeh_values,
           .parameter_count = RTHYB_COUNT(ahmadizadeh_parameters),
           .value_count = RTHYB_COUNT(ahmadizadeh_values)},
    .state_size = sizeof(ahmadizadeh_state),
    .check = ahmadizadeh_check,
    .init = ahmadizadeh_init,
    .rest = ahmadizadeh_rest,
    .observe = ahmadizadeh_observe,
    .lead = ahmadizadeh_lead,
};

RTHYB_LAW(ahmadizadeh);
