/* Dry friction between degrees of freedom of a sparse part. Its force changes from one side to the other within a small
 * velocity: taken at an extrapolated velocity, as other elements are, it changes its sign at every sample as soon as
 * F h > m w. Here the force and the velocity of the same instant,
 *   u = v + gamma h q,   S q = ... - (1 - a_f) sum_k B_k f_k(u_k),
 * satisfy the law together: u + G f(u) = u without friction. The law is monotonic and G positive definite, so that
 * solving one slider after the other converges (Gauss-Seidel; each pass lowers a convex function). */
#include "sliders.h"

#include "laws.h"
#include "numeric.h"

#define VELOCITY_MAX 1e6
#define VALUE_MAX 1e15
#define SETTLED                                                                                    \
    1e-9 /* of the largest force; the step is not that accurate, and nothing accumulates */

static int plausible(const double *values, size_t count)
{
    if (!values)
        return 0;
    for (size_t i = 0; i < count; i++)
        if (!(fabs(values[i]) <= VALUE_MAX))
            return 0;
    return 1;
}

int sliders_ok(const rthyb_sparse_config *cfg)
{
    const int32_t count = cfg->sliders;
    if (count == 0)
        return 1;
    if (count < 0 || count > RTHYB_SLIDERS_MAX || !cfg->slider)
        return 0;
    const size_t n = (size_t)count;
    if (!plausible(cfg->slider_w, n * (size_t)cfg->size) || !plausible(cfg->slider_g, n * n) ||
        !plausible(cfg->slider_x, n * (size_t)cfg->interfaces))
        return 0;
    for (int32_t j = 0; j < count; j++) {
        const int32_t at = cfg->slider[j];
        if (at < (j > 0 ? cfg->slider[j - 1] + 1 : 0) || at >= cfg->joints ||
            !rthyb_is_dry_friction(&cfg->joint[at].element) || cfg->slider_g[j * count + j] < 0.0)
            return 0;
    }
    return 1;
}

void sliders_settle(const rthyb_sparse_config *cfg, const double *velocity_m_per_s, int sweeps,
                    double *force_n)
{
    const int32_t count = cfg->sliders;
    for (int sweep = 0; sweep < (count > 1 ? sweeps : 1); sweep++) {
        double largest = 0.0, change = 0.0;
        for (int32_t j = 0; j < count; j++) {
            const double *g = cfg->slider_g + (size_t)j * (size_t)count;
            double *own = &force_n[cfg->slider[j]];
            double free = velocity_m_per_s[j];
            for (int32_t k = 0; k < count; k++)
                free -= k == j ? 0.0 : g[k] * force_n[cfg->slider[k]];
            if (judge(free, VELOCITY_MAX) != RTHYB_OK)
                continue; /* as an element: the force of the last plausible velocity */
            const double now = rthyb_friction_for(&cfg->joint[cfg->slider[j]].element, free, g[j]);
            change = fmax(change, fabs(now - *own));
            largest = fmax(largest, fabs(now));
            *own = now;
        }
        if (change <= SETTLED * largest)
            break;
    }
}
