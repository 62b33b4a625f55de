/* Restoring-force compensation for several axes.
 *
 * As for one axis (rfc.c), with matrices: f + K (LP(x_c - x_m) + tau v_c). K is the slope of the
 * forces over the displacements by least squares, with exponential forgetting, and with what noise
 * could have caused drawn towards k_e:
 *   K (X + R) = F + k_e R,   X = sum of x x' less the mean, F = sum of f x' likewise,
 *   R = diag(16 w sigma^2),  w the sum of weights:
 * coordinates that have moved by no more than four times their noise have no influence. A tangent
 * stiffness is symmetric and lies between 0 and k_e: with k_e = L L', the eigenvalues of L^-1 K
 * L'^-1, of its symmetric part, are limited to 0 ... 1. */
#include "lowpass.h"
#include "small_solve.h"

#define VELOCITY_MAX 1e9 /* m/s */
#define LATENESS_MAX 1.0 /* s, positive or negative */
#define SPREAD_GATE 16.0 /* as for one axis: variance of x in the memory, over that of its noise */
#define NUMB 1e-9        /* m, rad: smallest noise assumed */
#define SWEEPS 8         /* of Jacobi's rotations: 4 x 4 is diagonal to rounding after five */

enum { MOST = RTHYB_COUPLED_MAX };

/* L of a = L L'; 0 if a is not positive definite. */
static int cholesky(double a[MOST][MOST], int n, double root[MOST][MOST])
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j <= i; j++) {
            double left = a[i][j];
            for (int k = 0; k < j; k++)
                left -= root[i][k] * root[j][k];
            if (i == j && !(left > 1e-12 * a[i][i]))
                return 0;
            root[i][j] = i == j ? sqrt(left) : left / root[j][j];
        }
    return 1;
}

static int stiffness_ok(const rthyb_matrix_rfc_config *c)
{
    for (int i = 0; i < c->size; i++) {
        if (!(c->k_e[i][i] > 0.0))
            return 0;
        for (int j = 0; j < c->size; j++) {
            const double one = c->k_e[i][j], other = c->k_e[j][i];
            if (!(fabs(one) <= RTHYB_FORCE_MAX_N &&
                  fabs(one - other) <= 1e-9 * fmax(fabs(one), fabs(other))))
                return 0;
        }
    }
    return 1;
}

int rthyb_matrix_rfc_init(rthyb_matrix_rfc *s, const rthyb_matrix_rfc_config *cfg, const double *x0,
                          const double *f0)
{
    if (!(cfg->period_s > 0.0 && cfg->period_s <= 1.0 && cfg->memory_s > cfg->period_s &&
          cfg->memory_s <= 1e6 && cfg->cutoff_hz >= 0.0 && cfg->cutoff_hz * cfg->period_s < 0.5))
        return RTHYB_E_PERIOD;
    if (cfg->size < 1 || cfg->size > MOST || !stiffness_ok(cfg) ||
        !(fabs(cfg->lateness_s) <= LATENESS_MAX))
        return RTHYB_E_STIFFNESS;
    *s = (rthyb_matrix_rfc){.cfg = *cfg};
    for (int i = 0; i < cfg->size; i++) {
        if (!(cfg->rest_noise[i] >= 0.0 && cfg->rest_noise[i] <= 1.0))
            return RTHYB_E_STIFFNESS;
        if (judge(x0[i], RTHYB_DISPLACEMENT_MAX_M) != RTHYB_OK ||
            judge(f0[i], RTHYB_FORCE_MAX_N) != RTHYB_OK)
            return RTHYB_E_LIMIT;
        s->c1[i] = s->x1[i] = s->x_first[i] = x0[i];
        s->f1[i] = s->f_first[i] = f0[i];
        for (int j = 0; j < cfg->size; j++)
            s->k[i][j] = cfg->k_e[i][j];
    }
    if (!cholesky(s->cfg.k_e, cfg->size, s->root))
        return RTHYB_E_STIFFNESS;
    s->forget = 1.0 - cfg->period_s / cfg->memory_s;
    if (cfg->cutoff_hz > 0.0)
        s->filter = lowpass_design(cfg->cutoff_hz, cfg->period_s, sqrt(2.0));
    return 0;
}

/* ---- tangent stiffness --------------------------------------------------------------------------- */

/* L^-1 a L'^-1 in place. */
static void whiten(const rthyb_matrix_rfc *s, double a[MOST][MOST])
{
    const int n = s->cfg.size;
    for (int j = 0; j < n; j++)
        for (int i = 0; i < n; i++) {
            for (int k = 0; k < i; k++)
                a[i][j] -= s->root[i][k] * a[k][j];
            a[i][j] /= s->root[i][i];
        }
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            for (int k = 0; k < j; k++)
                a[i][j] -= s->root[j][k] * a[i][k];
            a[i][j] /= s->root[j][j];
        }
}

/* One rotation that makes a[p][q] zero; it is accumulated in v. */
static void rotate(double a[MOST][MOST], double v[MOST][MOST], int n, int p, int q)
{
    if (a[p][q] == 0.0)
        return;
    const double ratio = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
    const double t = fabs(ratio) > 1e150
                         ? 0.5 / ratio
                         : copysign(1.0, ratio) / (fabs(ratio) + sqrt(1.0 + ratio * ratio));
    const double c = 1.0 / sqrt(1.0 + t * t), d = t * c;
    for (int k = 0; k < n; k++) {
        const double kp = a[k][p], kq = a[k][q];
        a[k][p] = c * kp - d * kq;
        a[k][q] = d * kp + c * kq;
    }
    for (int k = 0; k < n; k++) {
        const double pk = a[p][k], qk = a[q][k], vp = v[k][p], vq = v[k][q];
        a[p][k] = c * pk - d * qk;
        a[q][k] = d * pk + c * qk;
        v[k][p] = c * vp - d * vq;
        v[k][q] = d * vp + c * vq;
    }
}

/* Limits the eigenvalues of a symmetric matrix to 0 ... 1. */
static void hold_between(double a[MOST][MOST], int n)
{
    double v[MOST][MOST] = {{0.0}}, value[MOST];
    for (int i = 0; i < n; i++)
        v[i][i] = 1.0;
    for (int sweep = 0; sweep < SWEEPS; sweep++)
        for (int p = 0; p < n; p++)
            for (int q = p + 1; q < n; q++)
                rotate(a, v, n, p, q);
    for (int i = 0; i < n; i++)
        value[i] = clamp(a[i][i], 0.0, 1.0);
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            a[i][j] = 0.0;
            for (int k = 0; k < n; k++)
                a[i][j] += v[i][k] * value[k] * v[j][k];
        }
}

/* The slope of forces over displacements, drawn towards k_e; 0 if it cannot be determined. */
static int slope_of(const rthyb_matrix_rfc *s, double slope[MOST][MOST])
{
    const int n = s->cfg.size;
    double a[MOST * MOST] = {0.0}, b[MOST * MOST] = {0.0}, scale[MOST];
    for (int i = 0; i < n; i++) {
        const double sigma = fmax(s->cfg.rest_noise[i], NUMB);
        const double ridge = SPREAD_GATE * s->weight * sigma * sigma;
        const double spread = fmax(s->xx[i][i] - s->x_sum[i] * s->x_sum[i] / s->weight, 0.0);
        scale[i] = 1.0 / sqrt(spread + ridge);
        a[i * n + i] = ridge;
    }
    /* (X + R) K' = F' + R k_e, with the unknowns scaled so that the diagonal is 1. */
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            const double ridge = a[i * n + i];
            b[i * n + j] = scale[i] * (s->fx[j][i] - s->f_sum[j] * s->x_sum[i] / s->weight +
                                       ridge * s->cfg.k_e[i][j]);
        }
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            const double own = i == j ? a[i * n + i] : 0.0;
            a[i * n + j] =
                scale[i] * scale[j] * (s->xx[i][j] - s->x_sum[i] * s->x_sum[j] / s->weight + own);
        }
    if (!small_solve(a, b, n, n, 1e-12))
        return 0;
    int finite = 1;
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            slope[j][i] = scale[i] * b[i * n + j];
            finite = finite && isfinite(slope[j][i]);
        }
    return finite;
}

static void learn(rthyb_matrix_rfc *s)
{
    const int n = s->cfg.size;
    double slope[MOST][MOST] = {{0.0}}, a[MOST][MOST] = {{0.0}};
    s->weight = s->forget * s->weight + 1.0;
    for (int i = 0; i < n; i++) {
        const double x = s->x1[i] - s->x_first[i], f = s->f1[i] - s->f_first[i];
        s->x_sum[i] = s->forget * s->x_sum[i] + x;
        s->f_sum[i] = s->forget * s->f_sum[i] + f;
        for (int j = 0; j < n; j++) {
            const double other = s->x1[j] - s->x_first[j];
            s->xx[i][j] = s->forget * s->xx[i][j] + x * other;
            s->fx[i][j] = s->forget * s->fx[i][j] + f * other;
        }
    }
    if (!slope_of(s, slope))
        return;
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            a[i][j] = 0.5 * (slope[i][j] + slope[j][i]);
    whiten(s, a);
    hold_between(a, n);
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            double sum = 0.0;
            for (int k = 0; k <= i; k++)
                for (int l = 0; l <= j; l++)
                    sum += s->root[i][k] * a[k][l] * s->root[j][l];
            s->k[i][j] = sum;
        }
}

/* Newest inputs, and x_c - x_m after its low-pass. */
static int take_in(rthyb_matrix_rfc *s, const double *x_c, const double *x_m, const double *f,
                   double *apart)
{
    int code = RTHYB_OK;
    for (int i = 0; i < s->cfg.size; i++) {
        s->c1[i] = accept(x_c[i], RTHYB_DISPLACEMENT_MAX_M, s->c1[i], &code);
        s->x1[i] = accept(x_m[i], RTHYB_DISPLACEMENT_MAX_M, s->x1[i], &code);
        s->f1[i] = accept(f[i], RTHYB_FORCE_MAX_N, s->f1[i], &code);
        apart[i] = s->c1[i] - s->x1[i];
        if (s->cfg.cutoff_hz > 0.0)
            apart[i] = lowpass_step(&s->filter, s->filter_s[i], apart[i]);
    }
    return code;
}

int rthyb_matrix_rfc_step(rthyb_matrix_rfc *s, const double *x_c, const double *v_c,
                          const double *x_m, const double *f, int frozen, double *force)
{
    const int n = s->cfg.size;
    double apart[MOST] = {0.0};
    int code = take_in(s, x_c, x_m, f, apart);
    for (int i = 0; i < n; i++) {
        s->v1[i] = accept(v_c[i], VELOCITY_MAX, s->v1[i], &code);
        apart[i] += s->cfg.lateness_s * s->v1[i];
    }
    if (!frozen && code == RTHYB_OK)
        learn(s);
    for (int i = 0; i < n; i++) {
        force[i] = s->f1[i];
        for (int j = 0; j < n && s->cfg.enabled; j++)
            force[i] += s->k[i][j] * apart[j];
    }
    return code;
}

void rthyb_matrix_rfc_follow(rthyb_matrix_rfc *s, const double *x_c, const double *x_m,
                             const double *f)
{
    double apart[MOST] = {0.0};
    (void)take_in(s, x_c, x_m, f, apart);
}

int rthyb_matrix_rfc_run(rthyb_matrix_rfc *s, const double *x_c, const double *v_c,
                         const double *x_m, const double *f, double *force, double *k, size_t n)
{
    int code = RTHYB_OK;
    const size_t width = (size_t)s->cfg.size;
    for (size_t i = 0; i < n; i++) {
        const size_t at = i * width;
        code |= rthyb_matrix_rfc_step(s, x_c + at, v_c + at, x_m + at, f + at, 0, force + at);
        for (size_t row = 0; row < width; row++)
            for (size_t column = 0; column < width; column++)
                k[(at + row) * width + column] = s->k[row][column];
    }
    return code;
}
