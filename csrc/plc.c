/* Phase-lead compensator, Eqn 2.5, with a curvature term beta:
 *   C(z) = 1 + [alpha S (1 - 1/z) + beta S (1 - 1/z)^2] z^2 / (W1 z^2 + W2 z + 1),  S = W1+W2+1.
 * beta = 0 is Eqn 2.5. The poles and the DC gain do not depend on alpha or beta. */
#include "numeric.h"

#define ALPHA_MAX 1e5
#define BETA_MAX 1e10

int rthyb_plc_is_stable(double w1, double w2)
{
    /* Jury's conditions for z^2 + (W2/W1) z + 1/W1; false for NaN and inf. */
    return isfinite(w1) && isfinite(w2) && fabs(w1) > 1.0 && fabs(w2) < fabs(w1 + 1.0);
}

int rthyb_plc_init(rthyb_plc *plc, double w1, double w2, double x0_m)
{
    if (!weights_ok(w1, w2))
        return RTHYB_E_WEIGHTS;
    if (judge(x0_m, RTHYB_DISPLACEMENT_MAX_M) != RTHYB_OK)
        return RTHYB_E_LIMIT;
    *plc = (rthyb_plc){.w1 = w1, .w2 = w2, .x1 = x0_m, .x2 = x0_m, .y1 = x0_m, .y2 = x0_m};
    return 0;
}

int rthyb_plc_step(rthyb_plc *plc, double alpha, double beta, double x_c_m, double *x_p_m)
{
    int code = RTHYB_OK;
    const double x = accept(x_c_m, RTHYB_DISPLACEMENT_MAX_M, plc->x1, &code);
    const double a = plc->alpha = accept(alpha, ALPHA_MAX, plc->alpha, &code);
    const double b = plc->beta = accept(beta, BETA_MAX, plc->beta, &code);
    const double w1 = plc->w1, w2 = plc->w2, s = w1 + w2 + 1.0;
    const double slope = x - plc->x1;
    const double curvature = slope - (plc->x1 - plc->x2);
    /* Eqn 2.5 as a recursion for the deviation from x, so that a command at rest stays exact. */
    const double lead = a * s * slope + b * s * curvature;
    const double y = x + (lead - w2 * (plc->y1 - plc->x1) - (plc->y2 - plc->x2)) / w1;
    plc->x2 = plc->x1;
    plc->x1 = x;
    plc->y2 = plc->y1;
    plc->y1 = y;
    *x_p_m = y;
    return code;
}

int rthyb_plc_run(rthyb_plc *plc, const double *alpha, const double *beta, const double *x_c_m,
                  double *x_p_m, size_t n)
{
    int code = RTHYB_OK;
    for (size_t i = 0; i < n; i++)
        code |= rthyb_plc_step(plc, alpha[i], beta[i], x_c_m[i], &x_p_m[i]);
    return code;
}
