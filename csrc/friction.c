/* Friction laws of the catalogue of elements that are more than a function of the velocity. */
#include "laws.h"
#include "numeric.h"

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

#define VALUE_MAX 1e30
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

/* tanh(y), and its slope, by one exponential. Its error is that of rounding 1: friction of at most its level. */
static double sign_of(double y, double *slope)
{
    if (fabs(y) > 19.0) {
        *slope = 0.0;
        return copysign(1.0, y);
    }
    const double e = exp(-2.0 * fabs(y)), by = 1.0 / (1.0 + e);
    *slope = 4.0 * e * by * by;
    return copysign((1.0 - e) * by, y);
}

/* The peak of a Stribeck curve as in rthyb_stribeck_level, and its slope, -n r^n / v of it. */
static double peak(const double *p, double v, double *slope)
{
    const double r = fabs(v / p[2]);
    const double power = p[4] == 2.0 ? r * r : (p[4] == 1.0 ? r : pow(r, p[4]));
    const double high = (p[1] - p[0]) * exp(-power);
    *slope = v == 0.0 ? 0.0 : -p[4] * power / v * high;
    return high;
}

static double width_of(const rthyb_element *e)
{
    switch (e->kind) {
    case RTHYB_COULOMB:
        return e->params[1];
    case RTHYB_COULOMB_UNEVEN:
        return e->params[2];
    default:
        return e->params[3];
    }
}

double rthyb_friction_scale(const rthyb_element *e, double v)
{
    const double width = width_of(e), size = fabs(v);
    return size > (e->kind == RTHYB_POWER_DAMPING ? 1.0 : 25.0) * width ? size : width;
}

rthyb_friction_point rthyb_friction_at(const rthyb_element *e, double v)
{
    const double *p = e->params, width = width_of(e);
    if (e->kind == RTHYB_POWER_DAMPING) {
        const double r = v / p[1], small = width / p[1], square = r * r + small * small;
        const double by = p[0] * pow(square, 0.5 * (p[2] - 1.0));
        return (rthyb_friction_point){v, by * r,
                                      by / p[1] * (p[2] * r * r + small * small) / square};
    }
    double steep, falls = 0.0;
    const double sign = sign_of(v / width, &steep);
    double level = e->kind == RTHYB_COULOMB_UNEVEN && v < 0.0 ? p[1] : p[0];
    if (e->kind == RTHYB_STRIBECK)
        level += peak(p, v, &falls);
    return (rthyb_friction_point){v, level * sign, falls * sign + level / width * steep};
}

/* Largest force of a law in the direction of r. */
static double most_of(const rthyb_element *e, double r)
{
    const double *p = e->params;
    if (e->kind == RTHYB_COULOMB_UNEVEN && r < 0.0)
        return p[1];
    return e->kind == RTHYB_STRIBECK ? greater_of(p[0], p[1]) : p[0];
}

/* Where the search begins: near the solution if the law is steep at 0, where it holds, and where it slides. The law
 * falls off from its slope at 0, so f <= r / (g + 1 / slope); the velocity is the one at which it has that force. */
static double beginning(const rthyb_element *e, double r, double g)
{
    const double *p = e->params, width = width_of(e), size = fabs(r);
    if (e->kind == RTHYB_POWER_DAMPING) {
        if (p[0] == 0.0)
            return size;
        const double f = size / (g + p[4]), u = p[1] * pow(f / p[0], 1.0 / p[2]);
        const double small = f * p[4], both = sqrt(u * u + small * small);
        return both > 0.0 && both < VALUE_MAX ? both * size / (both + size) : less_of(both, size);
    }
    const double most = most_of(e, r), slides = size - g * most;
    if (slides > 19.0 * width)
        return slides;
    const double steep = g * most / width;
    const double below_1 = 1.0 - greater_of(0.5 / (1.0 + steep), 1e-15);
    const double x = less_of(size / (width * (1.0 + steep)), below_1);
    return greater_of(0.5 * width * log((1.0 + x) / (1.0 - x)), slides);
}

static int cost_of(const rthyb_element *e)
{
    if (e->kind == RTHYB_STRIBECK)
        return e->params[4] == 2.0 || e->params[4] == 1.0 ? 3 : 4;
    return e->kind == RTHYB_POWER_DAMPING ? 4 : 2;
}

/* The force opposes the velocity, so u is between 0 and r. Newton's method, within the bracket; from `last`, if what
 * has changed since then is small beside the width of the law. */
rthyb_friction_point rthyb_friction_for(const rthyb_element *e, double r, double g,
                                        const rthyb_friction_point *last, double solved, int most,
                                        int *left)
{
    const int cost = cost_of(e);
    double near = 0.0, far = r, u = 0.0;
    int known = 0;
    if (last) {
        const double change = (r - last->velocity - g * last->force) / (1.0 + g * last->slope);
        u = last->velocity + change;
        known = u * r > 0.0 && fabs(u) < fabs(r) &&
                fabs(change) < 0.2 * rthyb_friction_scale(e, last->velocity);
    }
    if (!known)
        u = copysign(beginning(e, r, g), r);
    rthyb_friction_point at = rthyb_friction_at(e, u);
    for (*left -= cost; --most > 0; *left -= cost) {
        const double excess = u + g * at.force - r;
        if (!(fabs(excess) > solved * fabs(r)))
            break;
        if ((excess > 0.0) == (r > 0.0))
            far = u;
        else
            near = u;
        const double next = u - excess / (1.0 + g * at.slope);
        u = (next - near) * (far - next) > 0.0 ? next : 0.5 * (near + far);
        at = rthyb_friction_at(e, u);
    }
    return at;
}
