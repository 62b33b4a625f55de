/* The catalogue of specimen elements. Each gives the force that it resists motion with, from
 * displacement, velocity, acceleration and its own history; a specimen is the sum of its elements.
 * History is advanced by the increment of x, so a law without rate in it stays without rate. */
#include <string.h>

#include "numeric.h"

#define PARAM_MAX 1e15
#define PARAM_MIN 1e-15 /* of a positive one: keeps every quotient finite */
#define ETA_MAX 50.0    /* keeps |z|^eta finite for any z that is accepted */
#define VELOCITY_MAX 1e6
#define ACCELERATION_MAX 1e9
#define BOUC_WEN_STEPS_MAX 64

/* One sign a parameter, in the order of enum rthyb_element_kind: '+' positive, '0' not negative,
 * '-' any. */
/* clang-format off */
static const char *const SIGNS[RTHYB_ELEMENT_KINDS] = {
    [RTHYB_STIFFNESS] = "-",
    [RTHYB_VISCOUS] = "-",
    [RTHYB_COULOMB] = "0+",
    [RTHYB_STRIBECK] = "00++",
    [RTHYB_LUGRE] = "++++00",
    [RTHYB_QUAD_DAMPING] = "-",
    [RTHYB_INERTIA] = "0",
    [RTHYB_GAP] = "00",
    [RTHYB_CUBIC] = "-",
    [RTHYB_QUADRATIC] = "-",
    [RTHYB_STOPPER] = "00",
    [RTHYB_HYSTERESIS] = "+0+--+",
    [RTHYB_PINCHING] = "+0+--+0+",
    [RTHYB_DEGRADATION] = "+0+--+0+",
    [RTHYB_MAXWELL] = "0+",
    [RTHYB_SECOND_MODE] = "0+0",
    [RTHYB_P_DELTA] = "0+",
    [RTHYB_GAP_FRICTION] = "+0000",
};
/* clang-format on */

int rthyb_element_param_count(int32_t kind)
{
    return kind >= 0 && kind < RTHYB_ELEMENT_KINDS ? (int)strlen(SIGNS[kind]) : -1;
}

static int param_ok(double value, char sign)
{
    if (!(fabs(value) <= PARAM_MAX))
        return 0;
    return sign == '-' || value >= (sign == '+' ? PARAM_MIN : 0.0);
}

/* Where the hysteretic variable of Eqn 4.2 comes to rest: A = (B + C) |z|^eta. */
static double bouc_wen_ceiling(const double *p)
{
    const double sum = p[3] + p[4];
    return sum > 0.0 ? pow(p[2] / sum, 1.0 / p[5]) : RTHYB_DISPLACEMENT_MAX_M;
}

int rthyb_element_init(rthyb_element *element, int32_t kind, const double *params, size_t n)
{
    const int count = rthyb_element_param_count(kind);
    if (count < 0 || n != (size_t)count)
        return RTHYB_E_ELEMENT;
    for (int i = 0; i < count; i++) {
        if (!param_ok(params[i], SIGNS[kind][i]))
            return RTHYB_E_ELEMENT;
    }
    *element = (rthyb_element){.kind = kind};
    for (int i = 0; i < count; i++)
        element->params[i] = params[i];
    const int hysteretic =
        kind == RTHYB_HYSTERESIS || kind == RTHYB_PINCHING || kind == RTHYB_DEGRADATION;
    if (hysteretic) {
        element->params[8] = fmin(bouc_wen_ceiling(params), RTHYB_DISPLACEMENT_MAX_M);
        if (kind != RTHYB_HYSTERESIS && params[6] > 1.0) /* depth, loss: shares */
            return RTHYB_E_ELEMENT;
        if (!(element->params[8] > 0.0 && params[5] >= 0.1 && params[5] <= ETA_MAX))
            return RTHYB_E_ELEMENT;
    }
    if (kind == RTHYB_GAP_FRICTION) /* faces meet within the play, and before it slips */
        element->params[5] =
            fmin(fmin(params[4], params[1]), fmin(params[2], params[3]) / params[0]);
    return 0;
}

static double stribeck_level(const double *p, double v)
{
    const double r = v / p[2];
    return p[0] + (p[1] - p[0]) * exp(-r * r);
}

/* Canudas de Wit (1995); exact over dt for a constant velocity. state: z. */
static double lugre(const double *p, double *s, double v, double dt)
{
    const double level = stribeck_level(p, v);
    const double rate = p[3] * fabs(v) / level;
    const double shrink = rate * dt;
    const double decay = exp(-shrink);
    const double travel = shrink > 1e-9 ? -expm1(-shrink) / rate : dt;
    s[0] = s[0] * decay + v * travel;
    const double z_rate = v - rate * s[0];
    return p[3] * s[0] + p[4] * z_rate + p[5] * v;
}

/* What lies beyond +-half. */
static double beyond(double x, double half)
{
    return x > half ? x - half : (x < -half ? x + half : 0.0);
}

/* A slider behind a play and a spring: it takes what the spring cannot hold; Fc depends on the
 * direction. The play's faces meet one by one over +-seat, so that the spring's slope grows evenly
 * there. state: x of the last call, way between specimen and slider. */
static double gap_friction(const double *p, double *s, double x)
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

static double power(double base, double exponent)
{
    if (exponent == 1.0)
        return base;
    if (exponent == 1.5)
        return base * sqrt(base);
    if (exponent == 2.0)
        return base * base;
    return pow(base, exponent);
}

/* dz/du of Eqn 4.2, with v for z as the paper has it; du only gives its sign. Pinching slackens it
 * near z = 0 (Baber & Noori 1985, with their q = 0). */
static double bouc_wen_slope(const rthyb_element *e, double z, double du)
{
    const double *p = e->params;
    const double toward = du * z >= 0.0 ? 1.0 : -1.0;
    const double slope = p[2] - (p[3] * toward + p[4]) * power(fabs(z), p[5]);
    if (e->kind != RTHYB_PINCHING)
        return slope;
    const double r = z / (p[7] * p[8]);
    return slope * (1.0 - p[6] * exp(-r * r));
}

/* Eqn 4.1, 4.2: midpoint rule in steps of at most a twentieth of the ceiling of z.
 * state: x of the last call, z, travel. */
static double bouc_wen(rthyb_element *e, double x)
{
    const double *p = e->params;
    double *s = e->state;
    const double du = x - s[0], ceiling = p[8];
    const double most = 0.05 * ceiling;
    int steps = 1;
    if (fabs(du) > most)
        steps = (int)clamp(ceil(fabs(du) / most), 1.0, BOUC_WEN_STEPS_MAX);
    const double h = steps > 1 ? du / steps : du;
    double z = s[1];
    for (int i = 0; i < steps && du != 0.0; i++) {
        const double middle = clamp(z + 0.5 * h * bouc_wen_slope(e, z, du), -ceiling, ceiling);
        z = clamp(z + h * bouc_wen_slope(e, middle, du), -ceiling, ceiling);
    }
    s[0] = x;
    s[1] = z;
    double strength = 1.0;
    if (e->kind == RTHYB_DEGRADATION) {
        s[2] = fmin(s[2] + fabs(du), 1e6);
        strength = 1.0 - p[6] * -expm1(-s[2] / p[7]);
    }
    return p[1] * p[0] * x + (1.0 - p[1]) * p[0] * strength * z;
}

/* Spring and dashpot in series; exact for x running straight. state: x of the last call, force. */
static double maxwell(const double *p, double *s, double x, double dt)
{
    const double ratio = dt / p[1];
    const double gain = ratio > 1e-9 ? -expm1(-ratio) / ratio : 1.0;
    s[1] = s[1] * exp(-ratio) + p[0] * gain * (x - s[0]);
    s[0] = x;
    return s[1];
}

/* A mass m2 on a spring on the specimen: y'' + 2 zeta w y' + w^2 y = -a, y relative to the
 * specimen, by the average-acceleration rule. state: y, y', y''. */
static double second_mode(const double *p, double *s, double a, double dt)
{
    const double w = 2.0 * RTHYB_PI * p[1], damping = 2.0 * p[2] * w;
    const double y = s[0] + dt * s[1] + 0.25 * dt * dt * s[2];
    const double rate = s[1] + 0.5 * dt * s[2];
    s[2] = (-a - damping * rate - w * w * y) / (1.0 + 0.5 * dt * damping + 0.25 * dt * dt * w * w);
    s[0] = y + 0.25 * dt * dt * s[2];
    s[1] = rate + 0.5 * dt * s[2];
    return -p[0] * (damping * s[1] + w * w * s[0]);
}

static double law(rthyb_element *element, double x, double v, double a, double dt)
{
    const double *p = element->params;
    double *s = element->state;
    switch (element->kind) {
    case RTHYB_STIFFNESS:
        return p[0] * x;
    case RTHYB_VISCOUS:
        return p[0] * v;
    case RTHYB_COULOMB:
        return p[0] * smooth_sign(v / p[1]);
    case RTHYB_STRIBECK:
        return stribeck_level(p, v) * smooth_sign(v / p[3]);
    case RTHYB_LUGRE:
        return lugre(p, s, v, dt);
    case RTHYB_QUAD_DAMPING:
        return p[0] * v * fabs(v);
    case RTHYB_INERTIA:
        return p[0] * a;
    case RTHYB_GAP:
    case RTHYB_STOPPER:
        return p[0] * beyond(x, p[1]);
    case RTHYB_CUBIC:
        return p[0] * x * x * x;
    case RTHYB_QUADRATIC:
        return p[0] * x * x;
    case RTHYB_HYSTERESIS:
    case RTHYB_PINCHING:
    case RTHYB_DEGRADATION:
        return bouc_wen(element, x);
    case RTHYB_MAXWELL:
        return maxwell(p, s, x, dt);
    case RTHYB_SECOND_MODE:
        return second_mode(p, s, a, dt);
    case RTHYB_P_DELTA:
        return -p[0] / p[1] * x;
    case RTHYB_GAP_FRICTION:
        return gap_friction(p, s, x);
    default:
        return 0.0;
    }
}

double rthyb_element_force(rthyb_element *element, double x_m, double v_m_per_s, double a_m_per_s2,
                           double dt_s)
{
    int code = RTHYB_OK;
    element->x = accept(x_m, RTHYB_DISPLACEMENT_MAX_M, element->x, &code);
    element->v = accept(v_m_per_s, VELOCITY_MAX, element->v, &code);
    element->a = accept(a_m_per_s2, ACCELERATION_MAX, element->a, &code);
    const double dt = dt_s > 0.0 && dt_s <= 1.0 ? dt_s : 0.0;
    return law(element, element->x, element->v, element->a, dt);
}

int rthyb_element_run(rthyb_element *element, const double *x_m, const double *v_m_per_s,
                      const double *a_m_per_s2, double dt_s, double *force_n, size_t n)
{
    for (size_t i = 0; i < n; i++)
        force_n[i] = rthyb_element_force(element, x_m[i], v_m_per_s[i], a_m_per_s2[i], dt_s);
    return RTHYB_OK;
}
