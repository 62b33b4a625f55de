/* A linear numerical part with up to RTHYB_DENSE_MAX degrees of freedom,
 *   M x'' + C x' + K x + e force = -load ag,   e = 1 at the interface,
 * one of which drives the specimen. With force and excitation held over the step, every linear
 * integrator is one matrix for (x, v):
 *   s[n+1] = s[n] + D s[n] + b_f force[n] + b_a ag[n],
 * so that once the force is known, x_c[n+1] takes only two more products. */
#include <string.h>

#include "numeric.h"
#include "numerical.h"

enum { N_MAX = RTHYB_DENSE_MAX, S_MAX = 2 * RTHYB_DENSE_MAX };

#define VELOCITY_MAX 1e9

/* Square matrices are stored row by row, with rows of the part's own size n. */
static void multiply(const double *a, const double *b, size_t n, double *out)
{
    for (size_t i = 0; i < n; i++)
        for (size_t j = 0; j < n; j++) {
            double sum = 0.0;
            for (size_t k = 0; k < n; k++)
                sum += a[i * n + k] * b[k * n + j];
            out[i * n + j] = sum;
        }
}

static size_t pivot_row(const double *a, size_t n, size_t column)
{
    size_t best = column;
    for (size_t i = column + 1; i < n; i++)
        if (fabs(a[i * n + column]) > fabs(a[best * n + column]))
            best = i;
    return best;
}

static void swap_rows(double *a, size_t n, size_t i, size_t j)
{
    for (size_t k = 0; k < n; k++) {
        const double kept = a[i * n + k];
        a[i * n + k] = a[j * n + k];
        a[j * n + k] = kept;
    }
}

/* a^-1 b by elimination with partial pivoting; both are overwritten, b by the result. 0, or
 * RTHYB_E_MOTION for a singular matrix. */
static int solve(double *a, double *b, size_t n)
{
    for (size_t c = 0; c < n; c++) {
        const size_t p = pivot_row(a, n, c);
        const double pivot = a[p * n + c];
        if (!(fabs(pivot) > 1e-12 && isfinite(pivot)))
            return RTHYB_E_MOTION;
        swap_rows(a, n, c, p);
        swap_rows(b, n, c, p);
        for (size_t k = 0; k < n; k++) {
            a[c * n + k] /= pivot;
            b[c * n + k] /= pivot;
        }
        for (size_t i = 0; i < n; i++) {
            const double factor = i == c ? 0.0 : a[i * n + c];
            for (size_t k = 0; k < n; k++) {
                a[i * n + k] -= factor * a[c * n + k];
                b[i * n + k] -= factor * b[c * n + k];
            }
        }
    }
    return 0;
}

static int matrix_ok(const double *a, int n, double most)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            const double upper = a[i * n + j], lower = a[j * n + i];
            const double scale = fmax(fabs(upper), fabs(lower));
            if (!(fabs(upper) <= most && fabs(upper - lower) <= 1e-9 * scale))
                return 0;
        }
    return 1;
}

static int config_error(const rthyb_dense_config *c)
{
    if (!(c->period_s > 0.0 && c->period_s <= 1.0))
        return RTHYB_E_PERIOD;
    const int n = c->size;
    const int shape_ok = n >= 1 && n <= N_MAX && c->at >= 0 && c->at < n &&
                         (c->integrator == RTHYB_CR || c->integrator == RTHYB_RK4) &&
                         (c->force_delay == 0 || c->force_delay == 1);
    if (!shape_ok || !matrix_ok(c->mass_kg, n, 1e12) || !matrix_ok(c->damping_n_s_per_m, n, 1e15) ||
        !matrix_ok(c->stiffness_n_per_m, n, 1e15))
        return RTHYB_E_MOTION;
    for (int i = 0; i < n; i++)
        if (!(c->mass_kg[i * n + i] >= 1e-6 && fabs(c->load_kg[i]) <= 1e12))
            return RTHYB_E_MOTION;
    const int specimen_ok = c->specimen_mass_kg >= 0.0 && c->specimen_mass_kg <= 1e12 &&
                            c->specimen_damping_n_s_per_m >= 0.0 &&
                            c->specimen_damping_n_s_per_m <= 1e15 && c->k_e_n_per_m >= 0.0 &&
                            c->k_e_n_per_m <= 1e15;
    return specimen_ok ? 0 : RTHYB_E_MOTION;
}

/* Accelerations for unit states and inputs: M^-1 K, M^-1 C, M^-1 e, M^-1 load. */
typedef struct {
    double k[N_MAX * N_MAX], c[N_MAX * N_MAX], e[N_MAX], load[N_MAX];
} accelerations;

static int accelerations_of(const rthyb_dense_config *cfg, accelerations *out)
{
    const int n = cfg->size;
    const size_t bytes = (size_t)(n * n) * sizeof(double);
    double a[N_MAX * N_MAX] = {0}, inverse[N_MAX * N_MAX] = {0};
    memcpy(a, cfg->mass_kg, bytes);
    for (int i = 0; i < n; i++)
        inverse[i * n + i] = 1.0;
    if (solve(a, inverse, (size_t)n))
        return RTHYB_E_MOTION;
    multiply(inverse, cfg->stiffness_n_per_m, (size_t)n, out->k);
    multiply(inverse, cfg->damping_n_s_per_m, (size_t)n, out->c);
    for (int i = 0; i < n; i++) {
        out->e[i] = inverse[i * n + cfg->at];
        out->load[i] = 0.0;
        for (int j = 0; j < n; j++)
            out->load[i] += inverse[i * n + j] * cfg->load_kg[j];
    }
    return 0;
}

/* Chen & Ricles (2008) for many degrees of freedom: x += h v + h^2 alpha a, v += h alpha a with
 *   alpha = (4 M + 2 h C + h^2 K)^-1 4 M
 * of the structure including the specimen. */
static int cr_alpha(const rthyb_dense_config *cfg, double *alpha)
{
    const int n = cfg->size, at = cfg->at * n + cfg->at;
    const double h = cfg->period_s;
    double whole[N_MAX * N_MAX] = {0};
    for (int i = 0; i < n * n; i++) {
        const int here = i == at;
        const double m = cfg->mass_kg[i] + (here ? cfg->specimen_mass_kg : 0.0);
        const double c = cfg->damping_n_s_per_m[i] + (here ? cfg->specimen_damping_n_s_per_m : 0.0);
        const double k = cfg->stiffness_n_per_m[i] + (here ? cfg->k_e_n_per_m : 0.0);
        whole[i] = 4.0 * m + 2.0 * h * c + h * h * k;
        alpha[i] = 4.0 * m;
    }
    return solve(whole, alpha, (size_t)n);
}

static int cr_step_matrix(rthyb_dense *s, const accelerations *acc)
{
    const int n = s->cfg.size, rows = 2 * n;
    const double h = s->cfg.period_s;
    double alpha[N_MAX * N_MAX] = {0}, k[N_MAX * N_MAX] = {0}, c[N_MAX * N_MAX] = {0};
    if (cr_alpha(&s->cfg, alpha))
        return RTHYB_E_MOTION;
    multiply(alpha, acc->k, (size_t)n, k);
    multiply(alpha, acc->c, (size_t)n, c);
    for (int i = 0; i < n; i++) {
        double force = 0.0, load = 0.0;
        for (int j = 0; j < n; j++) {
            const double dx = -h * k[i * n + j], dv = -h * c[i * n + j];
            s->step[i * rows + j] = h * dx;
            s->step[i * rows + n + j] = h * dv + (i == j ? h : 0.0);
            s->step[(n + i) * rows + j] = dx;
            s->step[(n + i) * rows + n + j] = dv;
            force -= alpha[i * n + j] * acc->e[j];
            load -= alpha[i * n + j] * acc->load[j];
        }
        s->by_force[i] = h * h * force;
        s->by_force[n + i] = h * force;
        s->by_excitation[i] = h * h * load;
        s->by_excitation[n + i] = h * load;
    }
    return 0;
}

/* The classical Runge-Kutta method consists of the first terms of exp(z), with z = h times the
 * system matrix; for a constant input D = z + z^2/2 + z^3/6 + z^4/24, b = h (1 + z/2 + z^2/6 +
 * z^3/24) input. */
static void rk4_step_matrix(rthyb_dense *s, const accelerations *acc)
{
    const int n = s->cfg.size, rows = 2 * n;
    const double h = s->cfg.period_s;
    double z[S_MAX * S_MAX] = {0}, sum[S_MAX * S_MAX] = {0}, next[S_MAX * S_MAX] = {0};
    for (int i = 0; i < n; i++) {
        z[i * rows + n + i] = h;
        for (int j = 0; j < n; j++) {
            z[(n + i) * rows + j] = -h * acc->k[i * n + j];
            z[(n + i) * rows + n + j] = -h * acc->c[i * n + j];
        }
    }
    for (int order = 4; order >= 1; order--) { /* sum = (1 + z sum / (order + 1)), by Horner */
        multiply(z, sum, (size_t)rows, next);
        for (int i = 0; i < rows * rows; i++)
            sum[i] = next[i] / (order + 1.0) + (i % (rows + 1) == 0 ? 1.0 : 0.0);
    }
    multiply(z, sum, (size_t)rows, s->step);
    for (int i = 0; i < rows; i++) {
        s->by_force[i] = s->by_excitation[i] = 0.0;
        for (int j = 0; j < n; j++) {
            s->by_force[i] -= h * sum[i * rows + n + j] * acc->e[j];
            s->by_excitation[i] -= h * sum[i * rows + n + j] * acc->load[j];
        }
    }
}

static double row_times_state(const rthyb_dense *s, int row)
{
    const int rows = 2 * s->cfg.size;
    double sum = 0.0;
    for (int j = 0; j < rows; j++)
        sum += s->step[row * rows + j] * s->s[j];
    return sum;
}

int rthyb_dense_init(rthyb_dense *s, const rthyb_dense_config *cfg, double x0_m)
{
    const int error = config_error(cfg);
    if (error)
        return error;
    if (judge(x0_m, RTHYB_DISPLACEMENT_MAX_M) != RTHYB_OK)
        return RTHYB_E_LIMIT;
    accelerations acc = {0};
    if (accelerations_of(cfg, &acc))
        return RTHYB_E_MOTION;
    *s = (rthyb_dense){.cfg = *cfg, .x = x0_m, .x1 = x0_m, .x2 = x0_m};
    if (cfg->integrator == RTHYB_RK4)
        rk4_step_matrix(s, &acc);
    else if (cr_step_matrix(s, &acc))
        return RTHYB_E_MOTION;
    const int rows = 2 * cfg->size;
    for (int i = 0; i < rows * rows; i++)
        if (!isfinite(s->step[i]))
            return RTHYB_E_MOTION;
    s->s[cfg->at] = x0_m;
    s->change = row_times_state(s, cfg->at);
    return 0;
}

int rthyb_dense_answer(rthyb_dense *s, double excitation, double force_n, double *x_next_m)
{
    int code = RTHYB_OK;
    s->excitation = accept(excitation, 1e4, s->excitation, &code);
    const double force = accept(force_n, RTHYB_FORCE_MAX_N, s->last_force, &code);
    s->force = s->cfg.force_delay ? s->last_force : force;
    s->last_force = force;
    const int at = s->cfg.at;
    const double next =
        s->x + (s->change + s->by_force[at] * s->force + s->by_excitation[at] * s->excitation);
    int bad = RTHYB_OK;
    s->x2 = s->x1;
    s->x1 = s->x;
    s->x = confine(next, RTHYB_DISPLACEMENT_MAX_M, &bad);
    s->ran_off = bad != RTHYB_OK;
    *x_next_m = s->x;
    return code | bad;
}

/* A part that grows without bound ends at rest at the limit of plausible values, not at
 * infinity. */
static int stop_at_the_edge(rthyb_dense *s, int code)
{
    const int n = s->cfg.size;
    for (int i = 0; i < n; i++)
        s->s[n + i] = 0.0;
    s->x1 = s->x2 = s->x;
    s->a = 0.0;
    return code;
}

int rthyb_dense_advance(rthyb_dense *s)
{
    const int n = s->cfg.size, rows = 2 * n, at = s->cfg.at;
    int code = s->ran_off ? RTHYB_S_OUT_OF_RANGE : RTHYB_OK;
    double next[S_MAX] = {0};
    for (int i = 0; i < rows; i++)
        next[i] = s->s[i] + (row_times_state(s, i) + s->by_force[i] * s->force +
                             s->by_excitation[i] * s->excitation);
    const double v = s->s[n + at];
    for (int i = 0; i < rows; i++)
        s->s[i] = confine(next[i], i < n ? RTHYB_DISPLACEMENT_MAX_M : VELOCITY_MAX, &code);
    s->s[at] = s->x; /* as answered */
    s->a = (s->s[n + at] - v) / s->cfg.period_s;
    if (code != RTHYB_OK)
        code = stop_at_the_edge(s, code);
    s->change = row_times_state(s, at);
    return code;
}

/* ---- as a kind of numerical part --------------------------------------------------------------- */

static size_t size(const void *cfg)
{
    (void)cfg;
    return sizeof(rthyb_dense);
}

static int init(const rthyb_numerical *part, double x0_m)
{
    return rthyb_dense_init(part->state, part->cfg, x0_m);
}

static int answer(const rthyb_numerical *part, double excitation, const double *force_n,
                  double *x_next_m)
{
    return rthyb_dense_answer(part->state, excitation, *force_n, x_next_m);
}

static int advance(const rthyb_numerical *part)
{
    return rthyb_dense_advance(part->state);
}

/* The force before the first sample after a path is the last one of the path. */
static void freeze(const rthyb_numerical *part, const double *force_n)
{
    rthyb_dense *s = part->state;
    int code = RTHYB_OK;
    s->last_force = accept(*force_n, RTHYB_FORCE_MAX_N, s->last_force, &code);
}

/* As in motion.c: the velocity of CR is (x[n] - x[n-1]) / h, half a step old. */
static void look(const rthyb_numerical *part, rthyb_interface *at)
{
    const rthyb_dense *s = part->state;
    const double backward = (3.0 * s->x - 4.0 * s->x1 + s->x2) / (2.0 * s->cfg.period_s);
    const double own = s->s[s->cfg.size + s->cfg.at];
    *at = (rthyb_interface){
        .x = s->x,
        .v = s->cfg.integrator == RTHYB_CR ? backward : own,
        .a = s->a,
        .x1 = s->x1,
        .x2 = s->x2,
    };
}

static size_t report(const rthyb_numerical *part, double *values, size_t most)
{
    const rthyb_dense *s = part->state;
    const size_t n = (size_t)s->cfg.size, count = n < most ? n : most;
    memcpy(values, s->s, count * sizeof(double));
    return count;
}

const rthyb_numerical_ops rthyb_dense_ops = {
    .size = size,
    .init = init,
    .answer = answer,
    .advance = advance,
    .freeze = freeze,
    .look = look,
    .report = report,
};
