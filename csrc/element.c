/* The catalogue of specimen elements. Each element computes its restoring force from displacement,
 * velocity, acceleration and its own history; a specimen is the sum of its elements. History
 * advances by the increment of x, so that a rate-independent law stays rate-independent. */
#include <string.h>

#include "laws.h"
#include "numeric.h"

#define PARAM_MAX 1e15
#define PARAM_MIN 1e-15  /* smallest positive parameter: keeps every quotient finite */
#define ETA_MAX 50.0     /* keeps |z|^eta finite for any z that is accepted */
#define SHARP_MAX 1000.0 /* beyond it a corner is a corner: 0.07 % of the force */
#define VELOCITY_MAX 1e6
#define ACCELERATION_MAX 1e9
#define EXPONENT_MIN 0.05
#define EXPONENT_MAX 10.0
#define LOSS_MAX 0.99 /* largest loss, because what remains of a strength is a divisor */

/* One sign per parameter, in the order of enum rthyb_element_kind: '+' positive, '0' not negative,
 * '-' any. */
/* clang-format off */
static const char *const SIGNS[RTHYB_ELEMENT_KINDS] = {
    [RTHYB_STIFFNESS] = "-",
    [RTHYB_VISCOUS] = "-",
    [RTHYB_COULOMB] = "0+",
    [RTHYB_STRIBECK] = "00+++",
    [RTHYB_LUGRE] = "++++00",
    [RTHYB_QUAD_DAMPING] = "-",
    [RTHYB_INERTIA] = "0",
    [RTHYB_GAP] = "00",
    [RTHYB_CUBIC] = "-",
    [RTHYB_QUADRATIC] = "-",
    [RTHYB_STOPPER] = "000",
    [RTHYB_HYSTERESIS] = "+0+--+",
    [RTHYB_PINCHING] = "+0+--+0+",
    [RTHYB_DEGRADATION] = "+0+--+0000",
    [RTHYB_MAXWELL] = "0+",
    [RTHYB_SECOND_MODE] = "0+0",
    [RTHYB_P_DELTA] = "0+",
    [RTHYB_GAP_FRICTION] = "+0000",
    [RTHYB_COULOMB_UNEVEN] = "00+",
    [RTHYB_GAP_UNEVEN] = "00000",
    [RTHYB_POWER_DAMPING] = "-+++",
    [RTHYB_POWER_SPRING] = "-+++",
    [RTHYB_PENDULUM] = "-+",
    [RTHYB_FRICTION_PENDULUM] = "++000+",
    [RTHYB_IWAN] = "+0+0",
    [RTHYB_MENEGOTTO_PINTO] = "+0++0+",
    [RTHYB_CHABOCHE] = "++0000",
    [RTHYB_RC_COLUMN] = "+0++0+0+000-+",
    [RTHYB_PEAK_ORIENTED] = "00++0+",
    [RTHYB_TAKEDA] = "+-++000++0",
    [RTHYB_NONLINEAR_MAXWELL] = "++++",
    [RTHYB_ROCKING] = "++-",
    [RTHYB_OWN] = "",
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

static int within(double value, double low, double high)
{
    return value >= low && value <= high;
}

static int none_or_positive(double value)
{
    return value == 0.0 || value >= PARAM_MIN;
}

/* Conditions of a law on its parameters, in addition to their signs. */
static int shape_ok(int32_t kind, const double *p)
{
    switch (kind) {
    case RTHYB_STRIBECK:
        return within(p[4], EXPONENT_MIN, EXPONENT_MAX);
    case RTHYB_NONLINEAR_MAXWELL:
        return within(p[3], EXPONENT_MIN, EXPONENT_MAX);
    case RTHYB_POWER_DAMPING:
    case RTHYB_POWER_SPRING:
        return within(p[2], EXPONENT_MIN, EXPONENT_MAX);
    case RTHYB_DEGRADATION: /* with travel, work, amplitude, or several of them */
        return none_or_positive(p[7]) && none_or_positive(p[8]) && none_or_positive(p[9]) &&
               p[7] + p[8] + p[9] > 0.0;
    case RTHYB_IWAN:
        return p[1] <= 1.0 && p[3] <= 1.0;
    case RTHYB_MENEGOTTO_PINTO:
        return p[1] <= LOSS_MAX && within(p[3], 1.0, ETA_MAX) && p[4] <= LOSS_MAX;
    case RTHYB_RC_COLUMN:
        return p[1] <= 1.0 && within(p[3], 0.1, ETA_MAX) && p[5] > p[2] && p[6] <= LOSS_MAX &&
               p[8] <= LOSS_MAX && p[9] <= LOSS_MAX && p[10] <= 0.5 && fabs(p[11]) <= 1.0 &&
               within(p[12], 0.01, EXPONENT_MAX);
    case RTHYB_PEAK_ORIENTED: /* pinched or straight; a backbone that bends or is straight */
        return within(p[3], 1.0, EXPONENT_MAX) && p[4] <= 1.0 && p[5] < p[2];
    case RTHYB_TAKEDA:
        return fabs(p[1]) <= LOSS_MAX && within(p[3], 1.0, SHARP_MAX) && p[4] <= 1.0 &&
               p[5] <= 1.0 && p[6] <= LOSS_MAX && p[9] <= 1.0;
    case RTHYB_ROCKING:
        return fabs(p[2]) <= LOSS_MAX;
    default:
        return 1;
    }
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
    if (!shape_ok(kind, params))
        return RTHYB_E_ELEMENT;
    *element = (rthyb_element){.kind = kind};
    for (int i = 0; i < count; i++)
        element->params[i] = params[i];
    const int hysteretic =
        kind == RTHYB_HYSTERESIS || kind == RTHYB_PINCHING || kind == RTHYB_DEGRADATION;
    if (hysteretic) {
        const double ceiling = fmin(rthyb_bouc_wen_ceiling(params), RTHYB_DISPLACEMENT_MAX_M);
        element->params[RTHYB_BOUC_WEN_CEILING] = ceiling;
        if (kind != RTHYB_HYSTERESIS && params[6] > 1.0) /* depth or loss: a share */
            return RTHYB_E_ELEMENT;
        if (!(ceiling > 0.0 && params[5] >= 0.1 && params[5] <= ETA_MAX))
            return RTHYB_E_ELEMENT;
    }
    if (kind == RTHYB_POWER_DAMPING && params[0] != 0.0) /* velocity per force at rest */
        element->params[4] = params[1] / params[0] * pow(params[3] / params[1], 1.0 - params[2]);
    if (kind == RTHYB_GAP_FRICTION) /* the faces meet within the play, and before slip */
        element->params[5] =
            fmin(fmin(params[4], params[1]), fmin(params[2], params[3]) / params[0]);
    return 0;
}

int rthyb_is_dry_friction(const rthyb_element *element)
{
    switch (element->kind) {
    case RTHYB_COULOMB:
    case RTHYB_STRIBECK:
    case RTHYB_COULOMB_UNEVEN:
        return 1;
    case RTHYB_POWER_DAMPING:
        return element->params[0] >= 0.0 && element->params[2] < 1.0;
    default:
        return 0;
    }
}

/* A spring in each direction, behind a gap of its own. */
static double beyond(double x, double k_up, double up, double k_down, double down)
{
    return x > up ? k_up * (x - up) : (x < -down ? k_down * (x + down) : 0.0);
}

/* Hunt & Crossley, J. Appl. Mech. 42, 1975: a contact takes up energy in proportion to its depth, 1 + loss v
 * inwards, and never pulls. */
static double impact(double force, double loss, double v)
{
    return force * fmax(1.0 + (force < 0.0 ? -loss : loss) * v, 0.0);
}

/* sgn(r) |r|^n, linear within |r| < width: this keeps the slope at 0 finite for n < 1. */
static double signed_power(double r, double n, double width)
{
    return r * pow(r * r + width * width, 0.5 * (n - 1.0));
}

/* Spring and dashpot in series; exact for x changing linearly. state: x of the last call, force. */
static double maxwell(const double *p, double *s, double x, double dt)
{
    const double ratio = dt / p[1];
    const double gain = ratio > 1e-9 ? -expm1(-ratio) / ratio : 1.0;
    s[1] = s[1] * exp(-ratio) + p[0] * gain * (x - s[0]);
    s[0] = x;
    return s[1];
}

/* A mass m2 on a spring that is attached to the specimen: y'' + 2 zeta w y' + w^2 y = -a, with y
 * relative to the specimen, by the average-acceleration method. state: y, y', y''. */
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

/* A force that is not a number, or larger than in any laboratory, is replaced by the previous
 * one. */
static double own_force(rthyb_element *element, double x, double v, double a, double dt)
{
    double *last = &element->state[RTHYB_ELEMENT_STATES - 1];
    int code = RTHYB_OK;
    if (element->own)
        *last = accept(element->own(element->state, x, v, a, dt), RTHYB_FORCE_MAX_N, *last, &code);
    return *last;
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
        return rthyb_stribeck_level(p, v) * smooth_sign(v / p[3]);
    case RTHYB_LUGRE:
        return rthyb_lugre(p, s, v, dt);
    case RTHYB_QUAD_DAMPING:
        return p[0] * v * fabs(v);
    case RTHYB_INERTIA:
        return p[0] * a;
    case RTHYB_GAP:
        return beyond(x, p[0], p[1], p[0], p[1]);
    case RTHYB_STOPPER:
        return impact(beyond(x, p[0], p[1], p[0], p[1]), p[2], v);
    case RTHYB_CUBIC:
        return p[0] * x * x * x;
    case RTHYB_QUADRATIC:
        return p[0] * x * x;
    case RTHYB_HYSTERESIS:
    case RTHYB_PINCHING:
    case RTHYB_DEGRADATION:
        return rthyb_bouc_wen(element, x);
    case RTHYB_MAXWELL:
        return maxwell(p, s, x, dt);
    case RTHYB_SECOND_MODE:
        return second_mode(p, s, a, dt);
    case RTHYB_P_DELTA:
        return -p[0] / p[1] * x;
    case RTHYB_GAP_FRICTION:
        return rthyb_gap_friction(p, s, x);
    case RTHYB_COULOMB_UNEVEN:
        return (v < 0.0 ? p[1] : p[0]) * smooth_sign(v / p[2]);
    case RTHYB_GAP_UNEVEN:
        return impact(beyond(x, p[0], p[1], p[2], p[3]), p[4], v);
    case RTHYB_POWER_DAMPING: /* Constantinou & Symans, NCEER-92-0032, 1992: C |v|^a sgn(v) */
        return p[0] * signed_power(v / p[1], p[2], p[3] / p[1]);
    case RTHYB_POWER_SPRING:
        return p[0] * signed_power(x / p[1], p[2], p[3] / p[1]);
    case RTHYB_PENDULUM: /* x along the arc; Huygens: weight sin(x / length) */
        return p[0] * sin(x / p[1]);
    case RTHYB_FRICTION_PENDULUM:
        return rthyb_friction_pendulum(p, s, x, v);
    case RTHYB_IWAN:
        return rthyb_iwan(p, s, x);
    case RTHYB_MENEGOTTO_PINTO:
        return rthyb_menegotto_pinto(p, s, x);
    case RTHYB_CHABOCHE:
        return rthyb_chaboche(p, s, x);
    case RTHYB_RC_COLUMN:
        return rthyb_rc_column(p, s, x);
    case RTHYB_PEAK_ORIENTED:
        return rthyb_peak_oriented(p, s, x);
    case RTHYB_TAKEDA:
        return rthyb_takeda(p, s, x);
    case RTHYB_NONLINEAR_MAXWELL:
        return rthyb_nonlinear_maxwell(p, s, x, dt);
    case RTHYB_ROCKING: /* Chopra & Yim, J. Struct. Eng. 111, 1985: a foundation that lifts off */
        return p[0] * x - (1.0 - p[2]) * beyond(x, p[0], p[1], p[0], p[1]);
    case RTHYB_OWN:
        return own_force(element, x, v, a, dt);
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
