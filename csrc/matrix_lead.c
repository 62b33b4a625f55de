/* Lead for several coupled axes, estimated by recursive least squares.
 *
 * As in gain_lead.c, with a matrix for each of its numbers:
 *   v = x + [S (G x + A dx + B d2x) - W2 e1 - e2] / W1,   e = v - x,
 *   u = C(z) v,   C(z) = C_0 + sum of C_k (1 - 1/z) / (1 - rho_k / z),
 * where C is the inverse of the axes as identified: its poles are given, so that it is stable
 * whatever was fitted, and it acts on differences, so that a state of rest stays exact. Rows of u
 * and v are axes. Estimator: with the measured m in place of x, row by row
 *   W1 (v - m) + W2 (v1 - m1) + (v2 - m2) = S (G m + A dm + B d2m),
 * where v is the drives' commands passed through the fitted model of the axes. The right-hand sides
 * of all rows contain the same terms, so that one matrix of moments serves them all. */
#include "control_law.h"
#include "learning.h"
#include "lowpass.h"
#include "small_solve.h"

#define NOISE_TRIES 4       /* halvings of the noise that is subtracted */
#define PIVOT_MIN 1e-12     /* of equations with a diagonal of 1 */
#define COEFFICIENT_MAX 1e6 /* of the inverse */
#define SQUARINGS 40        /* enough for a root within 1e-9 of the unit circle to grow or decay */

enum {
    MOST = RTHYB_COUPLED_MAX,
    TERMS = RTHYB_MATRIX_TERMS,
    UNKNOWNS = RTHYB_MATRIX_UNKNOWNS,
    STATES = RTHYB_COUPLED_MAX * (RTHYB_MATRIX_POLES + 1)
};

/* ---- the inverse of the axes --------------------------------------------------------------------- */

static void inverse_rest(const rthyb_matrix_lead *s, rthyb_matrix_inverse *inv, const double *x)
{
    for (int i = 0; i < s->cfg.size; i++) {
        inv->x1[i] = x[i];
        for (int k = 0; k < s->cfg.poles; k++)
            inv->pole[k][i] = 0.0;
    }
}

static void inverse_take(const rthyb_matrix_lead *s, rthyb_matrix_inverse *inv, const double *x)
{
    for (int i = 0; i < s->cfg.size; i++) {
        for (int k = 0; k < s->cfg.poles; k++)
            inv->pole[k][i] = s->rho[k] * inv->pole[k][i] + (x[i] - inv->x1[i]);
        inv->x1[i] = x[i];
    }
}

/* Output of C for the input taken last. */
static double inverse_row(const rthyb_matrix_lead *s, const rthyb_matrix_inverse *inv, int row)
{
    double sum = 0.0;
    for (int j = 0; j < s->cfg.size; j++) {
        sum += s->cfg.inverse[0][row][j] * inv->x1[j];
        for (int k = 0; k < s->cfg.poles; k++)
            sum += s->cfg.inverse[k + 1][row][j] * inv->pole[k][j];
    }
    return sum;
}

/* The input for which the output is u; takes it as the next input. */
static void inverse_undo(const rthyb_matrix_lead *s, rthyb_matrix_inverse *inv, const double *u,
                         double *v)
{
    const int n = s->cfg.size;
    double left[MOST];
    for (int i = 0; i < n; i++) {
        left[i] = u[i];
        for (int k = 0; k < s->cfg.poles; k++)
            for (int j = 0; j < n; j++)
                left[i] -= s->cfg.inverse[k + 1][i][j] * (s->rho[k] * inv->pole[k][j] - inv->x1[j]);
    }
    int code = RTHYB_OK;
    for (int i = 0; i < n; i++) {
        double sum = 0.0;
        for (int j = 0; j < n; j++)
            sum += s->taken[i][j] * left[j];
        v[i] = confine(sum, RTHYB_DISPLACEMENT_MAX_M, &code);
    }
    if (code == RTHYB_OK)
        inverse_take(s, inv, v);
    else
        inverse_rest(s, inv, v);
}

static int inverted(double a[MOST][MOST], int n, double out[MOST][MOST])
{
    double matrix[MOST * MOST] = {0.0}, unit[MOST * MOST] = {0.0};
    for (int i = 0; i < n; i++) {
        unit[i * n + i] = 1.0;
        for (int j = 0; j < n; j++)
            matrix[i * n + j] = a[i][j];
    }
    if (!small_solve(matrix, unit, n, n, 1e-9))
        return 0;
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            out[i][j] = unit[i * n + j];
    return 1;
}

/* Whether the powers of a matrix, with rows of `width`, decay to zero: repeated squaring gives its
 * powers 2, 4, 8, ... */
static int decays(double a[STATES][STATES], double next[STATES][STATES], int width)
{
    for (int round = 0; round < SQUARINGS; round++) {
        double largest = 0.0;
        for (int i = 0; i < width; i++)
            for (int j = 0; j < width; j++) {
                next[i][j] = 0.0;
                for (int k = 0; k < width; k++)
                    next[i][j] += a[i][k] * a[k][j];
            }
        for (int i = 0; i < width; i++)
            for (int j = 0; j < width; j++) {
                a[i][j] = next[i][j];
                largest = fmax(largest, fabs(a[i][j]));
            }
        if (largest < 1e-9)
            return 1;
        if (!(largest < 1e100))
            return 0;
    }
    return 0;
}

/* Stability of the axes as fitted, without a command: each state alone, advanced by one sample. */
static int inverse_is_stable(const rthyb_matrix_lead *s)
{
    const int n = s->cfg.size, width = n * (s->cfg.poles + 1);
    const double none[MOST] = {0.0};
    double a[STATES][STATES] = {{0.0}}, next[STATES][STATES];
    for (int column = 0; column < width; column++) {
        rthyb_matrix_inverse state = {.x1 = {0.0}};
        double *const place = column < n ? state.x1 : state.pole[(column - n) / n];
        double v[MOST];
        place[column % n] = 1.0;
        inverse_undo(s, &state, none, v);
        for (int row = 0; row < width; row++)
            a[row][column] = row < n ? state.x1[row] : state.pole[(row - n) / n][row % n];
    }
    return decays(a, next, width);
}

/* ---- setting up ---------------------------------------------------------------------------------- */

static int settings_ok(const rthyb_matrix_lead_config *c)
{
    if (c->size < 1 || c->size > MOST || c->poles < 0 || c->poles > RTHYB_MATRIX_POLES ||
        !(c->period_s > 0.0 && c->period_s <= 1.0))
        return 0;
    int ok = c->roll_off_hz > 0.0 && c->roll_off_hz * c->period_s < 0.5 && c->cutoff_hz > 0.0 &&
             c->cutoff_hz * c->period_s < 0.5 && c->gate_factor >= 0.0 && c->gate_factor <= 1e6 &&
             c->memory_s > c->period_s && c->memory_s <= 1e6 && c->gain_most >= 0.0 &&
             c->gain_most < 1.0 && c->delay_most_s > 0.0 && c->delay_most_s <= 1.0;
    for (int t = 0; t < TERMS; t++)
        ok = ok && c->sigma[t] > 0.0 && c->sigma[t] <= 10.0;
    for (int i = 0; i < c->size; i++)
        ok = ok && c->rest_noise_m[i] >= 0.0 && c->rest_noise_m[i] <= 1.0;
    for (int k = 0; k < c->poles; k++)
        ok = ok && c->pole_hz[k] > 0.0 && c->pole_hz[k] * c->period_s < 0.5;
    for (int i = 0; i < c->size; i++)
        for (int j = 0; j < c->size; j++) {
            for (int t = 0; t < TERMS; t++)
                ok = ok && fabs(c->first[t][i][j]) <= 1.0 &&
                     (c->coupled || i == j || c->first[t][i][j] == 0.0);
            for (int k = 0; k <= c->poles; k++)
                ok = ok && fabs(c->inverse[k][i][j]) <= COEFFICIENT_MAX;
        }
    return ok;
}

/* mu of each row and phi of the newest pair, after the filters; shifts the histories. */
static void form_regressor(rthyb_matrix_lead *s, const double *p, const double *m, double *mu,
                           double *phi)
{
    const double unit = UNIT * s->s;
    for (int i = 0; i < s->cfg.size; i++) {
        const double slope = m[i] - s->m1[i];
        mu[i] =
            UNIT * (s->w1 * (p[i] - m[i]) + s->w2 * (s->p1[i] - s->m1[i]) + (s->p2[i] - s->m2[i]));
        double *own = phi + (ptrdiff_t)TERMS * i;
        own[0] = unit * m[i];
        own[1] = unit * slope;
        own[2] = unit * (slope - (s->m1[i] - s->m2[i]));
        s->p2[i] = s->p1[i];
        s->p1[i] = p[i];
        s->m2[i] = s->m1[i];
        s->m1[i] = m[i];
    }
}

static double filter_step(const rthyb_matrix_lead *s, double *state, double *level, double x)
{
    const double low = lowpass_step(&s->filter, state, x);
    *level += (low - *level) * s->level_weight;
    return low - *level;
}

/* The first pair is taken as the state of rest, so that an offset between command and sensor causes
 * no transient; averaging over all samples so far then removes the noise of the first one. */
static void prime(rthyb_matrix_lead *s, const double *p, const double *m)
{
    const int n = s->cfg.size;
    double v[MOST] = {0.0};
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            v[i] += s->still[i][j] * p[j];
    inverse_rest(s, &s->rig, v);
    for (int i = 0; i < n; i++) {
        lowpass_rest(&s->filter, s->filter_p[i], v[i]);
        lowpass_rest(&s->filter, s->filter_m[i], m[i]);
        s->level_p[i] = v[i];
        s->level_m[i] = m[i];
        s->p1[i] = s->p2[i] = s->m1[i] = s->m2[i] = 0.0;
    }
}

/* Contribution of white noise of 1 m on the first axis alone to the moments; returns the mean
 * square of its mu. */
static double noise_moments(rthyb_matrix_lead *s)
{
    rthyb_matrix_lead probe = *s;
    const double none[MOST] = {0.0};
    double power = 0.0;
    prime(&probe, none, none);
    probe.level_weight = s->least_weight;
    const uint32_t wanted = ticks_of(RESPONSE_S, s->cfg.period_s);
    const uint32_t samples = wanted < RESPONSE_MAX ? wanted : RESPONSE_MAX;
    for (uint32_t n = 0; n < samples; n++) {
        double mu[MOST] = {0.0}, phi[UNKNOWNS] = {0.0}, m[MOST] = {0.0};
        m[0] = filter_step(&probe, probe.filter_m[0], &probe.level_m[0], n == 0 ? 1.0 : 0.0);
        form_regressor(&probe, none, m, mu, phi);
        power += mu[0] * mu[0];
        for (int i = 0; i < TERMS; i++) {
            s->noise_q[i] += phi[i] * mu[0];
            for (int j = 0; j < TERMS; j++)
                s->noise_r[i][j] += phi[i] * phi[j];
        }
    }
    return power;
}

/* Mean square of the noise in a row of the equation, for the initial terms. */
static double residual_of(const rthyb_matrix_lead *s, double power, int row)
{
    double sum = 0.0;
    for (int j = 0; j < s->cfg.size; j++) {
        double own = j == row ? power : 0.0;
        for (int t = 0; t < TERMS; t++) {
            const double first = s->first[t][row][j];
            own -= j == row ? 2.0 * first * s->noise_q[t] : 0.0;
            for (int u = 0; u < TERMS; u++)
                own += first * s->noise_r[t][u] * s->first[u][row][j];
        }
        sum += s->cfg.rest_noise_m[j] * s->cfg.rest_noise_m[j] * own;
    }
    return sum;
}

/* Weight of the initial values: that of measurements that determine each term within its sigma.
 * Filtered noise is correlated over half a period of the cut-off frequency: the samples within it
 * count as one. */
static void weigh_beginning(rthyb_matrix_lead *s, double power)
{
    double residual = NUMB_MM * NUMB_MM, scale = 1.0;
    for (int i = 0; i < s->cfg.size; i++) {
        const double noise = s->cfg.rest_noise_m[i];
        residual = fmax(residual, residual_of(s, power, i));
        s->gate_power[i] = s->cfg.gate_factor * noise * noise * s->noise_r[1][1];
    }
    const double repeats = 0.5 / (s->cfg.cutoff_hz * s->cfg.period_s);
    for (int t = 0; t < TERMS; t++) {
        const double sigma = s->cfg.sigma[t] * scale;
        s->ridge[t] = repeats * residual / (sigma * sigma);
        scale /= s->cfg.period_s;
    }
}

static void begin_terms(rthyb_matrix_lead *s)
{
    const double per_s = 1.0 / s->cfg.period_s, longest = s->cfg.delay_most_s * per_s;
    double scale = 1.0;
    s->most[0] = s->cfg.gain_most;
    s->most[1] = longest;
    s->most[2] = 0.5 * longest * longest;
    for (int t = 0; t < TERMS; t++) {
        for (int i = 0; i < s->cfg.size; i++)
            for (int j = 0; j < s->cfg.size; j++)
                s->first[t][i][j] = s->learnt[t][i][j] = s->used[t][i][j] =
                    s->cfg.first[t][i][j] * scale;
        scale *= per_s;
    }
}

static int inverse_init(rthyb_matrix_lead *s)
{
    const rthyb_matrix_lead_config *c = &s->cfg;
    double still[MOST][MOST] = {{0.0}};
    for (int k = 0; k < c->poles; k++)
        s->rho[k] = exp(-2.0 * RTHYB_PI * c->pole_hz[k] * c->period_s);
    for (int i = 0; i < c->size; i++)
        for (int j = 0; j < c->size; j++) {
            still[i][j] = c->inverse[0][i][j];
            s->feed[i][j] = 0.0;
            for (int k = 0; k <= c->poles; k++)
                s->feed[i][j] += c->inverse[k][i][j];
        }
    return inverted(still, c->size, s->still) && inverted(s->feed, c->size, s->taken) &&
           inverse_is_stable(s);
}

int rthyb_matrix_lead_init(rthyb_matrix_lead *s, const rthyb_matrix_lead_config *cfg,
                           const double *x0_m)
{
    if (!settings_ok(cfg))
        return RTHYB_E_LAW;
    for (int i = 0; i < cfg->size; i++)
        if (judge(x0_m[i], RTHYB_DISPLACEMENT_MAX_M) != RTHYB_OK)
            return RTHYB_E_LIMIT;
    *s = (rthyb_matrix_lead){.cfg = *cfg};
    const double rho = exp(-2.0 * RTHYB_PI * cfg->roll_off_hz * cfg->period_s);
    s->w1 = 1.0 / (rho * rho);
    s->w2 = -2.0 / rho;
    s->s = s->w1 + s->w2 + 1.0;
    if (!weights_ok(s->w1, s->w2) || !inverse_init(s))
        return RTHYB_E_LAW;
    begin_terms(s);
    s->filter = lowpass_design(cfg->cutoff_hz, cfg->period_s, sqrt(2.0));
    s->least_weight = fmin(cfg->period_s / OFFSET_TIME_S, 1.0);
    s->level_weight = 1.0;
    s->forget = 1.0 - cfg->period_s / cfg->memory_s;
    weigh_beginning(s, noise_moments(s));
    for (int i = 0; i < cfg->size; i++)
        s->last_p[i] = s->last_m[i] = x0_m[i];
    rthyb_matrix_lead_rest(s, x0_m);
    return 0;
}

/* ---- learning ------------------------------------------------------------------------------------ */

/* A set of unknowns: `count` of them starting at `from`, in `rows` rows starting at `row`. */
typedef struct {
    int from, count, row, rows;
} part;

/* The normal equations after subtracting the moments of the given noise, with the unknowns scaled
 * so that without noise the diagonal is 1. The call without noise computes `scale`. */
static void form_equations(const rthyb_matrix_lead *s, const part *of, double noise_weight,
                           double *scale, double *a, double *b)
{
    for (int i = 0; i < of->count; i++) {
        const int u = of->from + i, axis = u / TERMS, term = u % TERMS;
        const double sigma = s->cfg.rest_noise_m[axis], noise = noise_weight * sigma * sigma;
        if (noise_weight == 0.0)
            scale[i] = 1.0 / sqrt(s->r[u][u] + s->ridge[term]);
        for (int j = 0; j < of->count; j++) {
            const int w = of->from + j, same = w / TERMS == axis;
            a[i * of->count + j] = s->r[u][w] - (same ? noise * s->noise_r[term][w % TERMS] : 0.0);
        }
        a[i * of->count + i] += s->ridge[term];
        for (int k = 0; k < of->rows; k++)
            b[i * of->rows + k] =
                scale[i] *
                (s->q[of->row + k][u] - (axis == of->row + k ? noise * s->noise_q[term] : 0.0) +
                 s->ridge[term] * s->first[term][of->row + k][axis]);
    }
    for (int i = 0; i < of->count; i++)
        for (int j = 0; j < of->count; j++)
            a[i * of->count + j] *= scale[i] * scale[j];
}

/* Solves a symmetric system in place; 0 if a pivot does not exceed its lower bound. The pivots
 * remain on the diagonal. */
static int eliminated(const part *of, double *a, double *b, const double *least)
{
    const int n = of->count, rows = of->rows;
    for (int i = 0; i < n; i++) {
        if (!(a[i * n + i] > least[i]))
            return 0;
        for (int k = i + 1; k < n; k++) {
            const double f = a[k * n + i] / a[i * n + i];
            for (int j = i; j < n; j++)
                a[k * n + j] -= f * a[i * n + j];
            for (int j = 0; j < rows; j++)
                b[k * rows + j] -= f * b[i * rows + j];
        }
    }
    for (int i = n - 1; i >= 0; i--)
        for (int j = 0; j < rows; j++) {
            for (int k = i + 1; k < n; k++)
                b[i * rows + j] -= a[i * n + k] * b[k * rows + j];
            b[i * rows + j] /= a[i * n + i];
        }
    return 1;
}

/* Adopts the solution of the equations if they determine their unknowns. The moments of the noise
 * are subtracted; if a pivot would lose more than its share, then half of them, a quarter, and so
 * on, and finally none: what axes that move alike reveal about one another is hardly more than
 * noise. */
static void solve_part(rthyb_matrix_lead *s, const part *of)
{
    double a[UNKNOWNS * UNKNOWNS] = {0.0}, b[UNKNOWNS * MOST] = {0.0}, scale[UNKNOWNS] = {0.0},
                        least[UNKNOWNS];
    for (int i = 0; i < UNKNOWNS; i++)
        least[i] = PIVOT_MIN;
    form_equations(s, of, 0.0, scale, a, b);
    if (!eliminated(of, a, b, least))
        return;
    double kept[UNKNOWNS * MOST];
    for (int i = 0; i < UNKNOWNS * MOST; i++)
        kept[i] = b[i];
    for (int i = 0; i < of->count; i++)
        least[i] = fmax(PIVOT_MIN, (1.0 - NOISE_SHARE_MAX) * a[i * of->count + i]);
    double noise_weight = s->weight;
    int found = 0;
    for (int tries = 0; tries < NOISE_TRIES && !found; tries++) {
        form_equations(s, of, noise_weight, scale, a, b);
        found = eliminated(of, a, b, least);
        noise_weight *= 0.5;
    }
    const double *x = found ? b : kept;
    for (int i = 0; i < of->count * of->rows; i++)
        if (!isfinite(x[i]))
            return;
    for (int i = 0; i < of->count; i++)
        for (int k = 0; k < of->rows; k++) {
            const int u = of->from + i, term = u % TERMS;
            s->learnt[term][of->row + k][u / TERMS] =
                clamp(scale[i] * x[i * of->rows + k], -s->most[term], s->most[term]);
        }
}

static void learn(rthyb_matrix_lead *s, const double *phi, const double *mu)
{
    const int n = s->cfg.size, count = TERMS * n;
    for (int i = 0; i < count; i++) {
        for (int j = 0; j < count; j++)
            s->r[i][j] = s->forget * s->r[i][j] + phi[i] * phi[j];
        for (int row = 0; row < n; row++)
            s->q[row][i] = s->forget * s->q[row][i] + phi[i] * mu[row];
    }
    s->weight = s->forget * s->weight + 1.0;
    const part all = {.from = 0, .count = count, .row = 0, .rows = n};
    if (s->cfg.coupled)
        solve_part(s, &all);
    for (int i = 0; i < n && !s->cfg.coupled; i++) {
        const part own = {.from = TERMS * i, .count = TERMS, .row = i, .rows = 1};
        solve_part(s, &own);
    }
}

static int gate_is_open(rthyb_matrix_lead *s, const double *phi)
{
    int open = 0;
    for (int i = 0; i < s->cfg.size; i++) {
        const double slope = phi[TERMS * i + 1];
        s->power[i] += (slope * slope - s->power[i]) * fmin(s->cfg.period_s / GATE_TIME_S, 1.0);
        open = open || (s->power[i] > s->gate_power[i] && s->power[i] > STANDS_MM2);
    }
    return open;
}

int rthyb_matrix_lead_observe(rthyb_matrix_lead *s, const double *x_p_m, const double *x_m_m,
                              int frozen)
{
    int code = RTHYB_OK;
    const int n = s->cfg.size;
    double v[MOST] = {0.0}, p[MOST] = {0.0}, m[MOST] = {0.0}, mu[MOST] = {0.0},
           phi[UNKNOWNS] = {0.0};
    for (int i = 0; i < n; i++) {
        s->last_p[i] = accept(x_p_m[i], RTHYB_DISPLACEMENT_MAX_M, s->last_p[i], &code);
        s->last_m[i] = accept(x_m_m[i], RTHYB_DISPLACEMENT_MAX_M, s->last_m[i], &code);
    }
    if (s->level_weight == 1.0)
        prime(s, s->last_p, s->last_m);
    inverse_undo(s, &s->rig, s->last_p, v);
    for (int i = 0; i < n; i++) {
        p[i] = filter_step(s, s->filter_p[i], &s->level_p[i], v[i]);
        m[i] = filter_step(s, s->filter_m[i], &s->level_m[i], s->last_m[i]);
    }
    s->level_weight = fmax(s->level_weight / (1.0 + s->level_weight), s->least_weight);
    form_regressor(s, p, m, mu, phi);
    s->open = gate_is_open(s, phi) && code == RTHYB_OK && !frozen;
    if (s->open)
        learn(s, phi, mu);
    return code;
}

/* ---- leading ------------------------------------------------------------------------------------- */

/* Lead for slow motions: C_0 (1 + G). */
static double slow_gain(const rthyb_matrix_lead *s, int row, int column)
{
    double sum = s->cfg.inverse[0][row][column];
    for (int k = 0; k < s->cfg.size; k++)
        sum += s->cfg.inverse[0][row][k] * s->used[0][k][column];
    return sum;
}

void rthyb_matrix_lead_rest(rthyb_matrix_lead *s, const double *x_m)
{
    const int n = s->cfg.size;
    double v[MOST] = {0.0};
    for (int i = 0; i < n; i++) {
        s->x1[i] = s->x2[i] = x_m[i];
        s->e1[i] = 0.0;
        for (int j = 0; j < n; j++)
            s->e1[i] += s->used[0][i][j] * x_m[j];
        s->e2[i] = s->e1[i];
        v[i] = x_m[i] + s->e1[i];
    }
    inverse_rest(s, &s->inverse, v);
    for (int i = 0; i < n; i++)
        s->offset[i] = x_m[i] - inverse_row(s, &s->inverse, i);
}

/* Effect of a row of the terms on the command; with `most`, an upper bound of the change towards
 * the estimate. */
static double moved(const rthyb_matrix_lead *s, int row, const double terms[TERMS][MOST], int most)
{
    double sum = 0.0;
    for (int t = 0; t < TERMS; t++)
        for (int j = 0; j < s->cfg.size; j++)
            sum += most ? fabs((s->learnt[t][row][j] - s->used[t][row][j]) * terms[t][j])
                        : s->used[t][row][j] * terms[t][j];
    return s->s * sum;
}

/* The matrices follow the estimate as far as it may move the command in this sample. */
static void follow_estimate(rthyb_matrix_lead *s, const double terms[TERMS][MOST], double allowed_m)
{
    const int n = s->cfg.size;
    double effect = 0.0;
    for (int i = 0; i < n; i++) {
        double own = 0.0;
        for (int j = 0; j < n; j++)
            own += fabs(s->feed[i][j]) * moved(s, j, terms, 1) / s->w1;
        effect = fmax(effect, own);
    }
    const double share = rthyb_allowed_share(effect, allowed_m);
    for (int t = 0; t < TERMS; t++)
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++)
                s->used[t][i][j] += share * (s->learnt[t][i][j] - s->used[t][i][j]);
}

/* The offset at rest fades by at most the command's own step, times the deviation of its gain from
 * 1. */
static double faded(rthyb_matrix_lead *s, int row, const double *step)
{
    double most = 0.0;
    for (int j = 0; j < s->cfg.size; j++)
        most += fabs((j == row ? 1.0 : 0.0) - slow_gain(s, row, j)) * fabs(step[j]);
    s->offset[row] -= clamp(s->offset[row], -most, most);
    return s->offset[row];
}

int rthyb_matrix_lead_lead(rthyb_matrix_lead *s, const double *x_c_m, double allowed_m,
                           double *x_p_m)
{
    int code = RTHYB_OK;
    const int n = s->cfg.size;
    double terms[TERMS][MOST] = {{0.0}}, v[MOST] = {0.0};
    for (int i = 0; i < n; i++) {
        const double x = accept(x_c_m[i], RTHYB_DISPLACEMENT_MAX_M, s->x1[i], &code);
        terms[0][i] = x;
        terms[1][i] = x - s->x1[i];
        terms[2][i] = terms[1][i] - (s->x1[i] - s->x2[i]);
    }
    if (allowed_m > 0.0)
        follow_estimate(s, terms, allowed_m);
    for (int i = 0; i < n; i++) {
        const double e = (moved(s, i, terms, 0) - s->w2 * s->e1[i] - s->e2[i]) / s->w1;
        s->e2[i] = s->e1[i];
        s->e1[i] = e;
        v[i] = terms[0][i] + e;
    }
    inverse_take(s, &s->inverse, v);
    for (int i = 0; i < n; i++) {
        x_p_m[i] = inverse_row(s, &s->inverse, i) + faded(s, i, terms[1]);
        s->x2[i] = s->x1[i];
        s->x1[i] = terms[0][i];
    }
    return code;
}

int rthyb_matrix_lead_run(rthyb_matrix_lead *s, const double *x_c_m, double *x_p_m, size_t n)
{
    int code = RTHYB_OK;
    const size_t width = (size_t)s->cfg.size;
    for (size_t i = 0; i < n; i++)
        code |= rthyb_matrix_lead_lead(s, x_c_m + i * width, 0.0, x_p_m + i * width);
    return code;
}
