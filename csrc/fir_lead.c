/* See fir_lead.h. */
#include "fir_lead.h"

/* Orthonormal polynomials of degree 0 to 3 over four points. */
static const double BASE[RTHYB_TAPS][RTHYB_TAPS] = {
    {0.5, 0.5, 0.5, 0.5},
    {-0.67082039324993691, -0.22360679774997896, 0.22360679774997896, 0.67082039324993691},
    {0.5, -0.5, -0.5, 0.5},
    {-0.22360679774997896, 0.67082039324993691, -0.67082039324993691, 0.22360679774997896},
};

static double tap(const rthyb_fir_line *line, uint32_t back)
{
    return line->x[(line->at + RTHYB_FIR_HISTORY - back) % RTHYB_FIR_HISTORY];
}

static void push(rthyb_fir_line *line, double x)
{
    line->at = (line->at + 1) % RTHYB_FIR_HISTORY;
    line->x[line->at] = x;
}

static void fill(rthyb_fir_line *line, double x)
{
    for (uint32_t i = 0; i < RTHYB_FIR_HISTORY; i++)
        line->x[i] = x;
}

static double sum_of(const double *th)
{
    double sum = 0.0;
    for (int i = 0; i < RTHYB_TAPS; i++)
        sum += th[i];
    return sum;
}

static void note(rthyb_fir_lead *s)
{
    s->alpha = 0.0;
    for (int i = 1; i < RTHYB_TAPS; i++)
        s->alpha -= (double)i * s->apart * s->used[i];
}

void rthyb_fir_rest(rthyb_fir_lead *s, double x_m)
{
    fill(&s->x, x_m);
    s->offset = (1.0 - sum_of(s->used)) * x_m;
}

int rthyb_fir_check(double cutoff_hz, double apart_s, double period_s,
                    rthyb_law_complaint *complaint)
{
    if (!rthyb_below_half_rate(cutoff_hz, period_s, complaint))
        return 1;
    const uint32_t most_apart = RTHYB_FIR_HISTORY / RTHYB_TAPS;
    const double most = most_apart * period_s;
    if (!(apart_s <= most)) {
        *complaint =
            (rthyb_law_complaint){"found {} s; must be at most 64 samples, {} s", {apart_s, most}};
        return 2;
    }
    return -1;
}

int rthyb_fir_init(rthyb_fir_lead *s, const rthyb_fir_settings *given, const rthyb_law_start *start)
{
    const int ok = given->cutoff_hz > 0.0 && given->most > 0.0 && given->most <= 1e6 &&
                   given->noise2 > 0.0 && given->walk2 >= 0.0 && given->walk2 <= 1e6 &&
                   given->apart_s >= 0.0 && fabs(given->delay_s) <= 1e3 && given->p_sum >= 0.0 &&
                   given->p_delay >= 0.0 && given->p_rest >= 0.0;
    const double variance[RTHYB_TAPS] = {given->p_sum, given->p_delay, given->p_rest,
                                         given->p_rest};
    const double largest = fmax(fmax(given->p_sum, given->p_delay), given->p_rest);
    if (!ok || !(largest <= 1e18) || !(given->noise2 <= 1e18))
        return RTHYB_E_LAW;
    s->h = start->period_s;
    s->apart = ticks_of(given->apart_s, s->h);
    if (s->apart > RTHYB_FIR_HISTORY / RTHYB_TAPS)
        return RTHYB_E_LAW;
    rthyb_pair_init(&s->pair, RTHYB_FIR_SECTIONS, given->cutoff_hz, s->h, start->x0_m);
    /* The smallest th with the sum 1 and a lead equal to the delay. */
    const double slope = -(1.5 + given->delay_s / s->h / s->apart) / 5.0;
    for (int i = 0; i < RTHYB_TAPS; i++) {
        s->learnt[i] = s->used[i] = 0.25 + slope * (i - 1.5);
        for (int j = 0; j < RTHYB_TAPS; j++)
            for (int k = 0; k < RTHYB_TAPS; k++)
                s->p[i][j] += variance[k] * BASE[k][i] * BASE[k][j];
    }
    s->most = given->most;
    s->noise2 = given->noise2;
    s->walk2 = given->walk2 * s->h;
    s->p_max = largest;
    rthyb_fir_rest(s, start->x0_m);
    note(s);
    return 0;
}

static void learn(rthyb_fir_lead *s, double u, const double *phi)
{
    double gain[RTHYB_TAPS], error = u, spread = s->noise2;
    for (int i = 0; i < RTHYB_TAPS; i++) {
        gain[i] = 0.0;
        for (int j = 0; j < RTHYB_TAPS; j++)
            gain[i] += s->p[i][j] * phi[j];
        error -= s->learnt[i] * phi[i];
    }
    for (int i = 0; i < RTHYB_TAPS; i++)
        spread += phi[i] * gain[i];
    /* After rounding, P may be slightly indefinite: this sample is then not used. */
    if (!(spread >= s->noise2))
        return;
    for (int i = 0; i < RTHYB_TAPS; i++) {
        const double next = s->learnt[i] + gain[i] * (error / spread);
        s->learnt[i] = clamp(next, -s->most, s->most);
        for (int j = 0; j <= i; j++) {
            s->p[i][j] -= gain[i] * (gain[j] / spread);
            if (i == j && s->p[i][i] < s->p_max)
                s->p[i][i] = fmax(s->p[i][i], 0.0) + s->walk2;
            s->p[j][i] = s->p[i][j];
        }
    }
}

int rthyb_fir_observe(rthyb_fir_lead *s, double x_p_m, double x_m_m, int frozen)
{
    const int first = !s->pair.primed;
    double u, m, phi[RTHYB_TAPS];
    const int code = rthyb_pair_step(&s->pair, x_p_m, x_m_m, &u, &m);
    if (first)
        fill(&s->m, s->pair.last_m);
    push(&s->m, m);
    for (uint32_t i = 0; i < RTHYB_TAPS; i++)
        phi[i] = tap(&s->m, i * s->apart);
    if (!frozen && code == RTHYB_OK)
        learn(s, u, phi);
    return code;
}

int rthyb_fir_step(rthyb_fir_lead *s, double x_c_m, double allowed_m, double *x_p_m)
{
    int code = RTHYB_OK;
    const double x1 = tap(&s->x, 0);
    const double x = accept(x_c_m, RTHYB_DISPLACEMENT_MAX_M, x1, &code);
    push(&s->x, x);
    double effect = 0.0, led = 0.0;
    for (uint32_t i = 0; i < RTHYB_TAPS; i++)
        effect += fabs((s->learnt[i] - s->used[i]) * tap(&s->x, i * s->apart));
    const double share = rthyb_allowed_share(effect, allowed_m);
    for (uint32_t i = 0; i < RTHYB_TAPS; i++) {
        s->used[i] += share * (s->learnt[i] - s->used[i]);
        led += s->used[i] * tap(&s->x, i * s->apart);
    }
    led += rthyb_fade(&s->offset, sum_of(s->used), x - x1);
    note(s);
    *x_p_m = led;
    return code;
}
