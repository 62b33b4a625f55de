/* Friction laws of the catalogue of elements that are more than a function of the velocity. */
#include "laws.h"
#include "numeric.h"

#define NEWTON_MAX 30
#define TINY 1e-300  /* a velocity at which the side counts, and nothing else */
#define SOLVED 1e-13 /* of the velocity without friction */

/* The peak that LuGre's g(v) has, e^(-(v/vs)^2): Fc, Fs, vs. */
static double gaussian_level(const double *p, double v)
{
    const double r = v / p[2];
    return p[0] + (p[1] - p[0]) * exp(-r * r);
}

/* e^(-|v/vs|^n), n = p[4]: 2 is the Gaussian, 1 Tustin's exponential; 0.5 to 2 is measured
 * (Armstrong-Helouvry, Dupont & Canudas de Wit, Automatica 30, 1994). */
double rthyb_stribeck_level(const double *p, double v)
{
    if (p[4] == 2.0) /* the usual law, without the time of pow() */
        return gaussian_level(p, v);
    return p[0] + (p[1] - p[0]) * exp(-pow(fabs(v / p[2]), p[4]));
}

/* LuGre model (Canudas de Wit 1995); exact over dt for a constant velocity. state: z. */
double rthyb_lugre(const double *p, double *s, double v, double dt)
{
    const double level = gaussian_level(p, v);
    const double rate = p[3] * fabs(v) / level;
    const double shrink = rate * dt;
    const double decay = exp(-shrink);
    const double travel = shrink > 1e-9 ? -expm1(-shrink) / rate : dt;
    s[0] = s[0] * decay + v * travel;
    const double z_rate = v - rate * s[0];
    return p[3] * s[0] + p[4] * z_rate + p[5] * v;
}

/* A slider behind a gap and a spring: it takes what the spring cannot hold; Fc depends on the
 * direction. The faces of the gap come into contact gradually over +-seat, so that the slope of the
 * spring increases linearly there. state: x of the last call, distance between specimen and
 * slider. */
double rthyb_gap_friction(const double *p, double *s, double x)
{
    const double k = p[0], gap = p[1], seat = p[5];
    s[1] = clamp(s[1] + (x - s[0]), -(gap + p[3] / k), gap + p[2] / k);
    s[0] = x;
    const double past = fabs(s[1]) - gap;
    const double closed = past >= seat   ? past
                          : past > -seat ? (past + seat) * (past + seat) / (4.0 * seat)
                                         : 0.0;
    return s[1] < 0.0 ? -k * closed : k * closed;
}

#define UNLOADING 0.8 /* gamma - beta of the sliding contact: 0.9 and 0.1 */

/* Y dZ = [1 - Z^2 (gamma sgn(Z dx) + beta)] dx, exact for any dx (Constantinou, Mokha & Reinhorn,
 * J. Struct. Eng. 116, 1990, Eqn 5): towards its limit Z is a tanh, away from it a tan. */
static double contact(double z, double dx, double y)
{
    const double way = dx < 0.0 ? -1.0 : 1.0, root = sqrt(UNLOADING);
    double left = fabs(dx) / y, ahead = way * z;
    if (ahead < 0.0) {
        const double angle = atan(-root * ahead); /* remaining argument; 0 at Z = 0 */
        if (root * left < angle)
            return -way * tan(angle - root * left) / root;
        left -= angle / root;
        ahead = 0.0;
    }
    const double t = tanh(left);
    return way * clamp((ahead + t) / (1.0 + ahead * t), -1.0, 1.0);
}

/* f = W / R x + mu W Z with mu = fast - (fast - slow) e^(-rate |v|) (Zayas, Low & Mahin, Earthquake
 * Spectra 6, 1990; Mokha, Constantinou & Reinhorn, J. Struct. Eng. 116, 1990). state: x, Z. */
double rthyb_friction_pendulum(const double *p, double *s, double x, double v)
{
    const double weight = p[0], mu = p[3] - (p[3] - p[2]) * exp(-p[4] * fabs(v));
    if (x != s[0])
        s[1] = contact(s[1], x - s[0], p[5]);
    s[0] = x;
    return weight / p[1] * x + mu * weight * s[1];
}

/* Slope of the logarithm of a peak, -n |v/vs|^n / v. */
static double falling(const double *p, double v)
{
    if (p[4] == 2.0)
        return -2.0 * v / (p[2] * p[2]);
    return v == 0.0 ? 0.0 : -p[4] * pow(fabs(v / p[2]), p[4]) / v;
}

/* Force of a law that depends on the velocity alone, as in element.c, and its slope. */
static double velocity_law(const rthyb_element *e, double v, double *slope)
{
    const double *p = e->params;
    if (e->kind == RTHYB_POWER_DAMPING) {
        const double r = v / p[1], width = p[3] / p[1], square = r * r + width * width;
        const double by = p[0] * pow(square, 0.5 * (p[2] - 1.0));
        *slope = by / p[1] * (p[2] * r * r + width * width) / square;
        return by * r;
    }
    const double width = p[e->kind == RTHYB_COULOMB ? 1 : e->kind == RTHYB_STRIBECK ? 3 : 2];
    const double sign = smooth_sign(v / width);
    double level = e->kind == RTHYB_COULOMB_UNEVEN && v < 0.0 ? p[1] : p[0], falls = 0.0;
    if (e->kind == RTHYB_STRIBECK) {
        level = rthyb_stribeck_level(p, v);
        falls = falling(p, v) * (level - p[0]);
    }
    *slope = falls * sign + level / width * (1.0 - sign * sign);
    return level * sign;
}

/* Largest force of a law that depends on the velocity alone, in the direction of r. */
static double most_of(const rthyb_element *e, double r)
{
    const double *p = e->params;
    switch (e->kind) {
    case RTHYB_COULOMB_UNEVEN:
        return r < 0.0 ? p[1] : p[0];
    case RTHYB_STRIBECK:
        return fmax(p[0], p[1]);
    case RTHYB_POWER_DAMPING:
        return INFINITY;
    default:
        return p[0];
    }
}

/* The force opposes the velocity, so u is between 0 and r. Newton's method begins with what the slope at 0 and the
 * largest force give: both come from the side of 0, from which it converges without a detour where the law is steepest
 * at 0. */
double rthyb_friction_for(const rthyb_element *e, double r, double g)
{
    double slope, force = velocity_law(e, copysign(TINY, r), &slope);
    const double straight = fabs(r) / (1.0 + g * slope), slides = fabs(r) - g * most_of(e, r);
    double near = 0.0, far = r, u = copysign(greater_of(straight, slides), r);
    for (int i = 0; i < NEWTON_MAX; i++) {
        force = velocity_law(e, u, &slope);
        const double excess = u + g * force - r;
        if (!(fabs(excess) > SOLVED * fabs(r)))
            break;
        if ((excess > 0.0) == (r > 0.0))
            far = u;
        else
            near = u;
        const double next = u - excess / (1.0 + g * slope);
        u = (next - near) * (far - next) > 0.0 ? next : 0.5 * (near + far);
    }
    return force;
}
