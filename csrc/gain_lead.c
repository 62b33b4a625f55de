/* Phase lead with a gain, estimated by recursive least squares; see gain_lead.h.
 *
 * Lead, Eqn 2.5 with one more term, S = W1 + W2 + 1:
 *   y = x + [S (g x + a dx + b d2x) - W2 (y1 - x1) - (y2 - x2)] / W1,   W1 = 1/rho^2, W2 = -2/rho,
 * where dx and d2x are the first and second backward difference of x. Both poles are at rho =
 * exp(-2 pi f h).
 * Estimator, the same relation with the measured displacement in place of x:
 *   W1 (y - m) + W2 (y1 - m1) + (y2 - m2) = S (g m + a dm + b d2m),
 * where y is not the output of the lead, but the drive's command passed through the fitted model of
 * the rig, so that it includes the limits and the rounding on the wire. (Applying the inverse to m
 * instead would be equivalent, but would amplify its noise.) */
#include "gain_lead.h"
#include "learning.h"
#include "lowpass.h"

/* ---- the fitted inverse -------------------------------------------------------------------------- */

static double rho_of(double roll_off_hz, double h)
{
    return exp(-2.0 * RTHYB_PI * roll_off_hz * h);
}

static void inverse_init(rthyb_inverse *inv, const double *b, double roll_off_hz, double h)
{
    *inv = (rthyb_inverse){.gain = 1.0};
    if (!b)
        return;
    inv->gain = 1.0 + b[0];
    inv->rho = rho_of(roll_off_hz, h);
    const double r = inv->rho / (1.0 - inv->rho);
    double taken = b[0], per_h = 1.0, unit = 1.0;
    for (int j = 0; j < INVERSE_ORDER; j++)
        unit *= 1.0 - inv->rho;
    for (int j = 1; j <= INVERSE_ORDER; j++) {
        taken *= r * (INVERSE_ORDER + 1 - j) / j;
        per_h /= h;
        inv->c[j - 1] = unit * (b[j] * per_h - taken);
    }
}

static void inverse_rest(rthyb_inverse *inv, double x)
{
    inv->x1 = x;
    for (int j = 0; j < INVERSE_ORDER; j++)
        inv->past[j] = inv->pole[j] = 0.0;
}

static double inverse_step(rthyb_inverse *inv, double x)
{
    double difference = x - inv->x1, deviation = 0.0;
    for (int j = 0; j < INVERSE_ORDER; j++) {
        deviation += inv->c[j] * difference;
        const double next = difference - inv->past[j];
        inv->past[j] = difference;
        difference = next;
    }
    for (int j = 0; j < INVERSE_ORDER; j++)
        deviation = inv->pole[j] = deviation + inv->rho * inv->pole[j];
    inv->x1 = x;
    return inv->gain * x + deviation;
}

/* First sample of the response to a unit step. */
static double inverse_first(const rthyb_inverse *inv)
{
    double sum = inv->gain;
    for (int j = 0; j < INVERSE_ORDER; j++)
        sum += inv->c[j];
    return sum;
}

/* The reverse: the input that gives this output. */
static double inverse_undo(rthyb_inverse *inv, double output)
{
    double past = inv->x1, known = 0.0;
    for (int j = 0; j < INVERSE_ORDER; j++) {
        known += inv->rho * inv->pole[j] - inv->c[j] * past;
        past += inv->past[j];
    }
    int code = RTHYB_OK;
    const double x =
        confine((output - known) / inverse_first(inv), RTHYB_DISPLACEMENT_MAX_M, &code);
    if (code == RTHYB_OK)
        (void)inverse_step(inv, x);
    else
        inverse_rest(inv, x);
    return x;
}

int rthyb_inverse_is_stable(const double *b, double roll_off_hz, double period_s)
{
    const double rho = rho_of(roll_off_hz, period_s), r = rho / (1.0 - rho);
    /* The numerator (1 + r d)^5 + sum of b_j (d / h)^j, d = 1 - 1/z, in powers of 1/z. */
    double a[INVERSE_ORDER + 1] = {0.0}, power[INVERSE_ORDER + 1] = {1.0};
    double own = 1.0, per_h = 1.0;
    for (int j = 0; j <= INVERSE_ORDER; j++) {
        for (int i = 0; i <= j; i++)
            a[i] += (own + b[j] * per_h) * power[i];
        own *= r * (INVERSE_ORDER - j) / (j + 1);
        per_h /= period_s;
        for (int i = j + 1; i > 0 && j < INVERSE_ORDER; i--)
            power[i] -= power[i - 1];
    }
    /* Schur-Cohn test: each step removes one zero; all of them were inside the unit circle. */
    for (int n = INVERSE_ORDER; n > 0; n--) {
        const double k = a[n] / a[0];
        double next[INVERSE_ORDER];
        if (!(fabs(k) < 1.0))
            return 0;
        for (int i = 0; i < n; i++)
            next[i] = a[i] - k * a[n - i];
        for (int i = 0; i < n; i++)
            a[i] = next[i];
    }
    return 1;
}

/* ---- setting up ---------------------------------------------------------------------------------- */

int rthyb_gain_lead_check(const double *p, double period_s, rthyb_law_complaint *why)
{
    for (int at = GAIN_LEAD_ROLL_OFF; at <= GAIN_LEAD_CUTOFF; at++) {
        if (!rthyb_below_half_rate(p[at], period_s, why))
            return at;
    }
    if (!(p[GAIN_LEAD_LEAST] < p[GAIN_LEAD_MOST])) {
        *why = (rthyb_law_complaint){"found {} s; must be greater than delay_least_s = {} s",
                                     {p[GAIN_LEAD_MOST], p[GAIN_LEAD_LEAST]}};
        return GAIN_LEAD_MOST;
    }
    return -1;
}

/* mu and phi of the newest pair, after the filters; shifts the histories. */
static double form_regressor(rthyb_gain_lead *s, double p, double m, double phi[LEAD_TERMS])
{
    const double slope = m - s->m1, unit = UNIT * s->s;
    const double mu = UNIT * (s->w1 * (p - m) + s->w2 * (s->p1 - s->m1) + (s->p2 - s->m2));
    phi[0] = unit * m;
    phi[1] = unit * slope;
    phi[2] = unit * (slope - (s->m1 - s->m2));
    s->p2 = s->p1;
    s->p1 = p;
    s->m2 = s->m1;
    s->m1 = m;
    return mu;
}

static double filter_step(rthyb_gain_lead *s, double *state, double *level, double x)
{
    const double low = lowpass_step(&s->filter, state, x);
    *level += (low - *level) * s->level_weight;
    return low - *level;
}

/* The first pair is taken as the state of rest, so that an offset between command and sensor causes
 * no transient; averaging over all samples so far then removes the noise of the first one. */
static void prime(rthyb_gain_lead *s, double p, double m)
{
    const double y = p / s->rig.gain;
    inverse_rest(&s->rig, y);
    lowpass_rest(&s->filter, s->filter_p, y);
    lowpass_rest(&s->filter, s->filter_m, m);
    s->level_p = y;
    s->level_m = m;
    s->p1 = s->p2 = s->m1 = s->m2 = 0.0;
}

/* Index of (i, j), i <= j, in the upper triangle. */
static inline int at(int i, int j)
{
    return i * (5 - i) / 2 + j;
}

static void add_products(double *r, double *q, const double *phi, double mu)
{
    for (int i = 0; i < LEAD_TERMS; i++) {
        for (int j = i; j < LEAD_TERMS; j++)
            r[at(i, j)] += phi[i] * phi[j];
        q[i] += phi[i] * mu;
    }
}

/* Contribution of white noise on x_m alone to the moments, and the weight of the initial values:
 * that of measurements that determine each term within its sigma. Filtered noise is correlated over
 * half a period of the cut-off frequency: the samples within it count as one. */
static void noise_moments(rthyb_gain_lead *s, double rest_noise_m, const double *p)
{
    rthyb_gain_lead probe = *s;
    prime(&probe, 0.0, 0.0);
    probe.level_weight = s->least_weight;
    double residual = 0.0;
    const uint32_t wanted = ticks_of(RESPONSE_S, s->h);
    const uint32_t samples = wanted < RESPONSE_MAX ? wanted : RESPONSE_MAX;
    for (uint32_t n = 0; n < samples; n++) {
        double phi[LEAD_TERMS];
        const double impulse = n == 0 ? rest_noise_m : 0.0;
        const double m = filter_step(&probe, probe.filter_m, &probe.level_m, impulse);
        const double mu = form_regressor(&probe, 0.0, m, phi);
        double e = mu;
        for (int i = 0; i < LEAD_TERMS; i++)
            e -= s->first[i] * phi[i];
        residual += e * e;
        add_products(s->noise_r, s->noise_q, phi, mu);
    }
    s->gate_power = p[GAIN_LEAD_GATE] * s->noise_r[at(1, 1)];
    const double repeats = 0.5 / (p[GAIN_LEAD_CUTOFF] * s->h);
    double scale = 1.0;
    for (int i = 0; i < LEAD_TERMS; i++) {
        const double sigma = p[GAIN_LEAD_SIGMA + i] * scale;
        s->ridge[i] = repeats * fmax(residual, NUMB_MM * NUMB_MM) / (sigma * sigma);
        scale /= s->h;
    }
}

static void note(rthyb_gain_lead *s)
{
    s->gain = 1.0 + s->used[0];
    s->shift = s->used[1];
    s->curvature = s->used[2];
    s->delay = s->led_first + s->used[1] / s->gain;
}

static void set_bounds(rthyb_gain_lead *s, const double *p, const double *first)
{
    const double per_s = 1.0 / s->h;
    const double most = fmax(fabs(p[GAIN_LEAD_LEAST]), fabs(p[GAIN_LEAD_MOST])) * per_s;
    const double low[] = {-p[GAIN_LEAD_GAIN_MOST], p[GAIN_LEAD_LEAST] * per_s, -0.5 * most * most};
    const double high[] = {p[GAIN_LEAD_GAIN_MOST], p[GAIN_LEAD_MOST] * per_s, 0.5 * most * most};
    double scale = 1.0;
    for (int i = 0; i < LEAD_TERMS; i++) {
        s->low[i] = low[i];
        s->high[i] = high[i];
        s->first[i] = s->learnt[i] = s->used[i] = first[i] * scale;
        scale *= per_s;
    }
}

int rthyb_gain_lead_init(rthyb_gain_lead *s, const double *p, const double *first, const double *b,
                         double inverse_roll_off_hz, const rthyb_law_start *start)
{
    s->h = start->period_s;
    const double rho = rho_of(p[GAIN_LEAD_ROLL_OFF], s->h);
    s->w1 = 1.0 / (rho * rho);
    s->w2 = -2.0 / rho;
    s->s = s->w1 + s->w2 + 1.0;
    int sensible = weights_ok(s->w1, s->w2) && p[GAIN_LEAD_MEMORY] > s->h &&
                   p[GAIN_LEAD_CUTOFF] > 0.0 && fabs(p[GAIN_LEAD_GAIN_MOST]) < 1.0 &&
                   fabs(p[GAIN_LEAD_LEAST]) <= 1.0 && fabs(p[GAIN_LEAD_MOST]) <= 1.0;
    for (int i = 0; i < LEAD_TERMS; i++)
        sensible = sensible && p[GAIN_LEAD_SIGMA + i] > 0.0 && fabs(first[i]) <= 1.0;
    for (int j = 0; b && j <= INVERSE_ORDER; j++)
        sensible = sensible && fabs(b[j]) <= 1e3;
    if (!sensible || (b && !(rho_of(inverse_roll_off_hz, s->h) < 1.0 - 1e-9 && b[0] > -1.0 &&
                             rthyb_inverse_is_stable(b, inverse_roll_off_hz, s->h))))
        return RTHYB_E_LAW;
    set_bounds(s, p, first);
    inverse_init(&s->inverse, b, inverse_roll_off_hz, s->h);
    s->rig = s->inverse;
    if (b)
        s->led_first =
            (b[1] / s->h - INVERSE_ORDER * b[0] * s->inverse.rho / (1.0 - s->inverse.rho)) /
            s->inverse.gain;
    s->filter = lowpass_design(p[GAIN_LEAD_CUTOFF], s->h, sqrt(2.0));
    s->least_weight = fmin(s->h / OFFSET_TIME_S, 1.0);
    s->level_weight = 1.0;
    s->forget = 1.0 - s->h / p[GAIN_LEAD_MEMORY];
    noise_moments(s, start->rest_noise_m, p);
    s->last_p = s->last_m = start->x0_m;
    rthyb_gain_lead_rest(s, start->x0_m);
    note(s);
    return 0;
}

/* ---- learning ------------------------------------------------------------------------------------ */

/* Solves a symmetric system of three equations in place, with the diagonal scaled to 1; 0 if it
 * does not determine all three terms. */
static int solve(double *a, double *x)
{
    double scale[LEAD_TERMS];
    for (int i = 0; i < LEAD_TERMS; i++) {
        if (!(a[at(i, i)] > 0.0))
            return 0;
        scale[i] = 1.0 / sqrt(a[at(i, i)]);
    }
    for (int i = 0; i < LEAD_TERMS; i++) {
        x[i] *= scale[i];
        for (int j = i; j < LEAD_TERMS; j++)
            a[at(i, j)] *= scale[i] * scale[j];
    }
    for (int i = 0; i < LEAD_TERMS; i++) {
        if (!(a[at(i, i)] > 1e-12))
            return 0;
        for (int k = i + 1; k < LEAD_TERMS; k++) {
            const double f = a[at(i, k)] / a[at(i, i)];
            for (int j = k; j < LEAD_TERMS; j++)
                a[at(k, j)] -= f * a[at(i, j)];
            x[k] -= f * x[i];
        }
    }
    for (int i = LEAD_TERMS - 1; i >= 0; i--) {
        for (int j = i + 1; j < LEAD_TERMS; j++)
            x[i] -= a[at(i, j)] * x[j];
        x[i] /= a[at(i, i)];
    }
    for (int i = 0; i < LEAD_TERMS; i++)
        x[i] *= scale[i];
    return isfinite(x[0]) && isfinite(x[1]) && isfinite(x[2]);
}

static void learn(rthyb_gain_lead *s, const double *phi, double mu)
{
    for (int i = 0; i < 6; i++)
        s->r[i] *= s->forget;
    for (int i = 0; i < LEAD_TERMS; i++)
        s->q[i] *= s->forget;
    add_products(s->r, s->q, phi, mu);
    s->weight = s->forget * s->weight + 1.0;
    /* One share for all moments, so that the remaining matrix is as regular as before. */
    double share = 1.0;
    for (int i = 0; i < LEAD_TERMS; i++) {
        const double noise = s->weight * s->noise_r[at(i, i)];
        if (noise > NOISE_SHARE_MAX * s->r[at(i, i)])
            share = fmin(share, NOISE_SHARE_MAX * s->r[at(i, i)] / noise);
    }
    const double w = share * s->weight;
    double a[6], x[LEAD_TERMS];
    for (int i = 0; i < 6; i++)
        a[i] = s->r[i] - w * s->noise_r[i];
    for (int i = 0; i < LEAD_TERMS; i++) {
        a[at(i, i)] += s->ridge[i];
        x[i] = s->q[i] - w * s->noise_q[i] + s->ridge[i] * s->first[i];
    }
    if (!solve(a, x))
        return;
    for (int i = 0; i < LEAD_TERMS; i++)
        s->learnt[i] = clamp(x[i], s->low[i], s->high[i]);
}

int rthyb_gain_lead_observe(void *state, double x_p_m, double x_m_m, int frozen)
{
    rthyb_gain_lead *s = state;
    int code = RTHYB_OK;
    s->last_p = accept(x_p_m, RTHYB_DISPLACEMENT_MAX_M, s->last_p, &code);
    s->last_m = accept(x_m_m, RTHYB_DISPLACEMENT_MAX_M, s->last_m, &code);
    if (s->level_weight == 1.0)
        prime(s, s->last_p, s->last_m);
    const double y = inverse_undo(&s->rig, s->last_p);
    const double p = filter_step(s, s->filter_p, &s->level_p, y);
    const double m = filter_step(s, s->filter_m, &s->level_m, s->last_m);
    s->level_weight = fmax(s->level_weight / (1.0 + s->level_weight), s->least_weight);
    double phi[LEAD_TERMS];
    const double mu = form_regressor(s, p, m, phi);
    s->short_power += (phi[1] * phi[1] - s->short_power) * fmin(s->h / GATE_TIME_S, 1.0);
    const int open = s->short_power > s->gate_power && s->short_power > STANDS_MM2;
    if (code == RTHYB_OK && open && !frozen)
        learn(s, phi, mu);
    return code;
}

/* ---- leading ------------------------------------------------------------------------------------- */

void rthyb_gain_lead_rest(void *state, double x_m)
{
    rthyb_gain_lead *s = state;
    s->x1 = s->x2 = x_m;
    s->e1 = s->e2 = s->used[0] * x_m;
    inverse_rest(&s->inverse, x_m + s->e1);
    s->offset = x_m - s->inverse.gain * (x_m + s->e1);
}

/* Gain, delay and curvature follow the estimate as far as it may move the command in this
 * sample. */
static void follow_estimate(rthyb_gain_lead *s, const double *terms, double allowed_m)
{
    double effect = 0.0;
    for (int i = 0; i < LEAD_TERMS; i++)
        effect += fabs((s->learnt[i] - s->used[i]) * terms[i]);
    effect *= s->s / s->w1 * fabs(inverse_first(&s->inverse));
    const double share = rthyb_allowed_share(effect, allowed_m);
    for (int i = 0; i < LEAD_TERMS; i++)
        s->used[i] += share * (s->learnt[i] - s->used[i]);
    note(s);
}

int rthyb_gain_lead_lead(void *state, double x_c_m, double allowed_m, double *x_p_m)
{
    rthyb_gain_lead *s = state;
    int code = RTHYB_OK;
    const double x = accept(x_c_m, RTHYB_DISPLACEMENT_MAX_M, s->x1, &code);
    const double slope = x - s->x1;
    const double terms[] = {x, slope, slope - (s->x1 - s->x2)};
    if (allowed_m > 0.0)
        follow_estimate(s, terms, allowed_m);
    const double *t = s->used;
    const double sum = s->s * (t[0] * terms[0] + t[1] * terms[1] + t[2] * terms[2]);
    const double e = (sum - s->w2 * s->e1 - s->e2) / s->w1;
    const double led = inverse_step(&s->inverse, x + e);
    s->e2 = s->e1;
    s->e1 = e;
    s->x2 = s->x1;
    s->x1 = x;
    *x_p_m = led + rthyb_fade(&s->offset, s->inverse.gain * (1.0 + t[0]), slope);
    return code;
}
