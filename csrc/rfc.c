/* Restoring-force compensator. Instead of the measured force, the equation of motion uses
 *   f + k_exp (x_c - x_m)   (Eqn 3.2),
 * with the tangent stiffness k_exp of the last T0 samples (Eqn 3.3) limited to 0 ... k_e. The window
 * is summed anew in every sample: a running sum would keep the trace of a single implausible sample
 * for ever.
 *
 * Beyond the paper, if the settings ask for it:
 *   f + k_exp (LP(x_c - x_m) + tau v_c).
 * LP, a low-pass: the part of x_m above its cut-off (noise, a resonance of actuator and specimen) is
 * not an error that the structure should feel. If that part were included, f - k_e x_m would remain
 * in the loop, the inertia force of the specimen alone, which grows with the square of the
 * frequency.
 * tau: f is the force at x_m(t - tau), so the force at x_c(t) is
 *   f + k (x_c(t) - x_m(t - tau)) = f + k (x_c - x_m)(t) + k (x_m(t) - x_m(t - tau)),
 * whose last term is k tau x_m' to first order; x_m' is noisy and is replaced by x_c'. */
#include "lowpass.h"

#define RATIO_MAX 1e15
#define VELOCITY_MAX 1e9 /* m/s */
#define LATENESS_MAX 1.0 /* s, positive or negative */
/* Least squares: smallest ratio of the variance of x_m in the window to that of its noise. */
#define SPREAD_GATE 16.0

/* Sums over a window use pairs of lanes of 16 bytes, which every 64-bit processor supports: this
 * fixes the order of the additions, and several of them can run in parallel. */
typedef double lanes __attribute__((vector_size(16)));

static inline lanes load(const double *p)
{
    lanes v;
    __builtin_memcpy(&v, p, sizeof v);
    return v;
}

static inline double sum_lanes(lanes v)
{
    return v[0] + v[1];
}

int rthyb_rfc_init(rthyb_rfc *rfc, const rthyb_rfc_config *cfg, double x0_m, double f0_n)
{
    if (cfg->window < 1 || cfg->window > RTHYB_WINDOW_MAX)
        return RTHYB_E_WINDOW;
    if (!(cfg->k_e_n_per_m > 0.0 && cfg->k_e_n_per_m <= RTHYB_FORCE_MAX_N))
        return RTHYB_E_STIFFNESS;
    if (!(cfg->rest_noise_m >= 0.0 && cfg->rest_noise_m <= 1.0) ||
        cfg->tangent < RTHYB_TANGENT_MEAN_OF_RATIOS || cfg->tangent > RTHYB_TANGENT_LEAST_SQUARES ||
        cfg->divisor < RTHYB_DIVISOR_PRINTED || cfg->divisor > RTHYB_DIVISOR_TERMS)
        return RTHYB_E_STIFFNESS;
    const int filters = cfg->cutoff_hz != 0.0;
    if (filters && !(cfg->cutoff_hz > 0.0 && cfg->period_s > 0.0 && cfg->period_s <= 1.0 &&
                     cfg->cutoff_hz * cfg->period_s < 0.5))
        return RTHYB_E_PERIOD;
    if (!(fabs(cfg->lateness_s) <= LATENESS_MAX) ||
        judge(x0_m, RTHYB_DISPLACEMENT_MAX_M) != RTHYB_OK ||
        judge(f0_n, RTHYB_FORCE_MAX_N) != RTHYB_OK)
        return RTHYB_E_LIMIT;
    *rfc = (rthyb_rfc){.cfg = *cfg, .k_n_per_m = cfg->k_e_n_per_m, .ratio = cfg->k_e_n_per_m};
    rfc->x1 = rfc->c1 = x0_m;
    rfc->f1 = f0_n;
    if (filters)
        rfc->filter = lowpass_design(cfg->cutoff_hz, cfg->period_s, sqrt(2.0));
    return 0;
}

static double low_passed(rthyb_rfc *rfc, double difference)
{
    return rfc->cfg.cutoff_hz > 0.0 ? lowpass_step(&rfc->filter, rfc->filter_s, difference)
                                    : difference;
}

/* The window contains the T0 samples before the newest one, so a value is never read right after it
 * was written. */
static void push(rthyb_rfc *rfc, double x, double f)
{
    const uint32_t length = (uint32_t)rfc->cfg.window;
    rfc->x[rfc->head] = x;
    rfc->f[rfc->head] = f;
    rfc->head = rfc->head + 1 < length ? rfc->head + 1 : 0;
    if (rfc->filled < length)
        rfc->filled++;
}

static double window_sum(const double *x, uint32_t n)
{
    lanes s0 = {0.0, 0.0}, s1 = s0, s2 = s0, s3 = s0;
    uint32_t i = 0;
    for (; i + 8 <= n; i += 8) {
        s0 += load(x + i);
        s1 += load(x + i + 2);
        s2 += load(x + i + 4);
        s3 += load(x + i + 6);
    }
    for (; i + 2 <= n; i += 2)
        s0 += load(x + i);
    const double sum = sum_lanes((s0 + s1) + (s2 + s3));
    return i < n ? sum + x[i] : sum;
}

/* Eqn 3.3. If x_m has not changed, the term is 0/0 and takes the value of the previous term. */
static double mean_of_ratios(rthyb_rfc *rfc, double dx, double df)
{
    if (dx != 0.0)
        rfc->ratio = clamp(df / dx, -RATIO_MAX, RATIO_MAX);
    const uint32_t before = rfc->filled;
    const double sum = window_sum(rfc->x, before) + rfc->ratio;
    push(rfc, rfc->ratio, 0.0);
    return sum / (rfc->cfg.divisor == RTHYB_DIVISOR_PRINTED && before > 0 ? before : before + 1);
}

/* Slope of the regression line of f on x_m over the same T0 + 1 samples; keeps k while x_m has not
 * moved beyond its noise. Sums are formed relative to the newest sample, to avoid cancellation. */
static double least_squares(rthyb_rfc *rfc, double x, double f)
{
    const uint32_t before = rfc->filled;
    const lanes x0 = {x, x}, f0 = {f, f};
    lanes vx = {0.0, 0.0}, vf = vx, vxx = vx, vxf = vx, wx = vx, wf = vx, wxx = vx, wxf = vx;
    uint32_t i = 0;
    for (; i + 4 <= before; i += 4) {
        const lanes dx = load(rfc->x + i) - x0, ex = load(rfc->x + i + 2) - x0;
        const lanes df = load(rfc->f + i) - f0, ef = load(rfc->f + i + 2) - f0;
        vx += dx;
        vf += df;
        vxx += dx * dx;
        vxf += dx * df;
        wx += ex;
        wf += ef;
        wxx += ex * ex;
        wxf += ex * ef;
    }
    double sx = sum_lanes(vx + wx), sf = sum_lanes(vf + wf);
    double sxx = sum_lanes(vxx + wxx), sxf = sum_lanes(vxf + wxf);
    for (; i < before; i++) {
        const double dx1 = rfc->x[i] - x, df1 = rfc->f[i] - f;
        sx += dx1;
        sf += df1;
        sxx += dx1 * dx1;
        sxf += dx1 * df1;
    }
    push(rfc, x, f);
    const double n = before + 1.0;
    const double spread = sxx - sx * sx / n;
    const double noise = rfc->cfg.rest_noise_m;
    /* For a window of constant x_m, rounding leaves a spread of up to 1e-14 (sxx + x^2). */
    if (!(spread > SPREAD_GATE * n * noise * noise + 1e-14 * (sxx + x * x)))
        return rfc->k_n_per_m;
    return (sxf - sx * sf / n) / spread;
}

int rthyb_rfc_step(rthyb_rfc *rfc, double x_c_m, double v_c_m_per_s, double x_m_m, double f_n,
                   int frozen, double *force_n)
{
    int code = RTHYB_OK;
    const double c = accept(x_c_m, RTHYB_DISPLACEMENT_MAX_M, rfc->c1, &code);
    const double v = accept(v_c_m_per_s, VELOCITY_MAX, rfc->v1, &code);
    const double x = accept(x_m_m, RTHYB_DISPLACEMENT_MAX_M, rfc->x1, &code);
    const double f = accept(f_n, RTHYB_FORCE_MAX_N, rfc->f1, &code);
    const double k_e = rfc->cfg.k_e_n_per_m;
    const uint64_t n = rfc->tick++;
    const double k = rfc->cfg.tangent == RTHYB_TANGENT_LEAST_SQUARES
                         ? least_squares(rfc, x, f)
                         : mean_of_ratios(rfc, x - rfc->x1, f - rfc->f1);
    /* k_e in stage 1 (t <= 2 T0 dt) and stage 3 (t >= t_ex). In stage 2, Eqn 3.3 between 0 and
     * k_e. */
    if (n <= 2 * (uint64_t)rfc->cfg.window || n >= rfc->cfg.end_tick)
        rfc->k_n_per_m = k_e;
    else if (!frozen && code == RTHYB_OK)
        rfc->k_n_per_m = clamp(k, 0.0, k_e);
    rfc->c1 = c;
    rfc->v1 = v;
    rfc->x1 = x;
    rfc->f1 = f;
    double apart = low_passed(rfc, c - x);
    if (rfc->cfg.lateness_s != 0.0)
        apart += rfc->cfg.lateness_s * v;
    *force_n = rfc->cfg.enabled ? f + rfc->k_n_per_m * apart : f;
    return code;
}

void rthyb_rfc_follow(rthyb_rfc *rfc, double x_c_m, double x_m_m, double f_n)
{
    int code = RTHYB_OK;
    rfc->c1 = accept(x_c_m, RTHYB_DISPLACEMENT_MAX_M, rfc->c1, &code);
    rfc->x1 = accept(x_m_m, RTHYB_DISPLACEMENT_MAX_M, rfc->x1, &code);
    rfc->f1 = accept(f_n, RTHYB_FORCE_MAX_N, rfc->f1, &code);
    (void)low_passed(rfc, rfc->c1 - rfc->x1);
}

int rthyb_rfc_run(rthyb_rfc *rfc, const double *x_c_m, const double *v_c_m_per_s,
                  const double *x_m_m, const double *f_n, double *force_n, double *k_n_per_m,
                  size_t n)
{
    int code = RTHYB_OK;
    for (size_t i = 0; i < n; i++) {
        const double v = v_c_m_per_s ? v_c_m_per_s[i] : 0.0;
        code |= rthyb_rfc_step(rfc, x_c_m[i], v, x_m_m[i], f_n[i], 0, &force_n[i]);
        k_n_per_m[i] = rfc->k_n_per_m;
    }
    return code;
}
