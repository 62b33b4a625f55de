/* Dampers with a memory of their own. */
#include "laws.h"
#include "numeric.h"

#define NEWTON_MAX 24
#define NO_FLOW 1e-30 /* of a step without length */
#define SLIP_MAX 1e100
#define TR_SHARE                                                                                   \
    (2.0 - 1.4142135623730951) /* of a step, by the trapezoidal rule: TR-BDF2 is L-stable with it */

/* The root of f + c f^q = r for r, c >= 0. In the larger of the two powers the equation is convex: Newton's steps
 * from above approach from one side. */
static double force_for(double r, double c, double q)
{
    if (!(r > 0.0) || c < NO_FLOW)
        return fmax(r, 0.0);
    const int steep = q >= 1.0;
    const double n = steep ? q : 1.0 / q;
    /* u + a u^n = s, with u = f, or u = f^q and both sides divided by c */
    const double a = steep ? c : 1.0 / c, s = steep ? r : r / c;
    double u = fmin(s, pow(s / a, 1.0 / n));
    for (int i = 0; i < NEWTON_MAX; i++) {
        const double power = a * pow(u, n), excess = u + power - s;
        if (!(excess > 1e-14 * s))
            break;
        u -= excess / (1.0 + n * power / u);
    }
    return steep ? u : pow(u, n);
}

static double solved(double rhs, double c, double q)
{
    return copysign(force_for(fabs(rhs), c, q), rhs);
}

/* A damper |v|^a in series with a spring: f' = km (v - v0 |f / F|^(1/a) sgn(f)), the nonlinear Maxwell model
 * (Makris & Constantinou, J. Struct. Eng. 117, 1991, with a power as in Constantinou & Symans, NCEER-92-0032, 1992).
 * By TR-BDF2 (Bank et al., IEEE Trans. Comput.-Aided Des. 4, 1985) for x changing linearly; normalised by F.
 * state: x, f / F. */
double rthyb_nonlinear_maxwell(const double *p, double *s, double x, double dt)
{
    const double q = 1.0 / p[3], g = TR_SHARE, per = p[0] / p[1];
    const double way = per * (x - s[0]), flow = fmin(per * p[2] * dt, 1e30);
    const double before = s[1];
    const double slip = copysign(fmin(flow * pow(fabs(before), q), SLIP_MAX), before);
    const double middle = solved(before + g * way - 0.5 * g * slip, 0.5 * g * flow, q);
    s[0] = x;
    if (middle * before < 0.0 && fabs(slip) > fabs(way)) {
        s[1] = solved(before + way, flow,
                      q); /* the explicit half overshot zero: implicit Euler does not */
        return p[1] * s[1];
    }
    const double inner = 1.0 / (g * (2.0 - g)), last = (1.0 - g) / (2.0 - g);
    s[1] = solved(inner * middle - (inner - 1.0) * before + last * way, last * flow, q);
    return p[1] * s[1];
}
