/* Paths between two states of motion: quintics, half-cosine ramps, and brakes. */
#include "path.h"

#include <string.h>

#include "numeric.h"

enum { MOST = RTHYB_COUPLED_MAX };

#define SEARCH_STEPS 80 /* factors of 1.25: from 8 ms to longer than any test */
/* Pins: factor by which a path is lengthened each time, and how often; in total by a factor of 3.
 * The axes of a specimen that rotates by 80 mrad are 5 to 10 % faster than without rotation. */
#define STRETCH 1.08
#define STRETCHES 15
#define POINTS 32          /* of a path, at which the axes are checked */
#define PEAK_BETWEEN 1.005 /* factor for a higher acceleration of a quintic between two points */

static int64_t whole_ticks(double duration_s, double h)
{
    return (int64_t)clamp(ceil(duration_s / h - 1e-9), 1.0, 1e15);
}

/* Quintic from (x0, v0, a0) to (x1, v1, a1) in the given number of ticks of h. */
static rthyb_path quintic(const double from[3], const double to[3], int64_t ticks, double h)
{
    const double T = (double)ticks * h;
    const double v0 = from[1] * T, a0 = from[2] * T * T, v1 = to[1] * T, a1 = to[2] * T * T;
    const double d = to[0] - from[0] - v0 - 0.5 * a0, e = v1 - v0 - a0, g = a1 - a0;
    return (rthyb_path){
        .c = {from[0], v0, 0.5 * a0, 10.0 * d - 4.0 * e + 0.5 * g, -15.0 * d + 7.0 * e - g,
              6.0 * d - 3.0 * e + 0.5 * g},
        .end = to[0],
        .ticks = ticks,
    };
}

/* x, or its first or second derivative with respect to u (order 0, 1, 2), of a polynomial path. */
static double polynomial(const rthyb_path *p, double u, int order)
{
    double sum = 0.0;
    for (int i = 5; i >= order; i--) {
        const double factor = order == 0 ? 1.0 : (order == 1 ? i : (double)i * (i - 1));
        sum = sum * u + factor * p->c[i];
    }
    return sum;
}

/* Displacement, velocity and acceleration after the given number of ticks of a brake: its
 * acceleration changes linearly to the deceleration, stays constant, and changes linearly to 0. */
static void braked(const rthyb_path *p, double ticks, double h, double now[3])
{
    const double turn = (double)p->turn * h, steady = (double)(p->ticks - 2 * p->turn) * h;
    const double lasts[3] = {turn, steady, turn}, ends[3] = {p->c[3], p->c[3], 0.0};
    double left = ticks * h;
    memcpy(now, p->c, 3 * sizeof now[0]);
    for (int i = 0; i < 3 && left > 0.0; i++) {
        const double t = fmin(left, lasts[i]);
        const double jerk = lasts[i] > 0.0 ? (ends[i] - now[2]) / lasts[i] : 0.0;
        now[0] += t * (now[1] + t * (0.5 * now[2] + t * jerk / 6.0));
        now[1] += t * (now[2] + 0.5 * t * jerk);
        now[2] += t * jerk;
        left -= t;
    }
}

/* The same for a path of any kind. */
static void path_at(const rthyb_path *p, double ticks, double h, double now[3])
{
    const double T = (double)p->ticks * h, u = ticks / (double)p->ticks;
    const double turned = RTHYB_PI * u, size = p->c[1], rate = RTHYB_PI / T;
    if (p->turn > 0) {
        braked(p, ticks, h, now);
    } else if (p->cosine) {
        now[0] = p->c[0] + size * cos(turned);
        now[1] = -size * rate * sin(turned);
        now[2] = -size * rate * rate * cos(turned);
    } else {
        now[0] = polynomial(p, u, 0);
        now[1] = polynomial(p, u, 1) / T;
        now[2] = polynomial(p, u, 2) / (T * T);
    }
}

void path_along(const rthyb_path *p, double h, double now[3])
{
    path_at(p, (double)p->elapsed, h, now);
}

/* Values of the axes for values in interface coordinates. */
static void of_axes(const path_limits *limits, const double *direction, double *axis)
{
    for (int i = 0; i < limits->axes; i++) {
        axis[i] = 0.0;
        for (int j = 0; j < limits->directions; j++)
            axis[i] += limits->jacobian[i * limits->directions + j] * direction[j];
    }
}

/* Velocity (order 1) or acceleration (order 2) of each axis, for a state in interface
 * coordinates. */
static void states_of_axes(const path_limits *limits, const double state[][3], int order,
                           double *axis)
{
    double direction[MOST] = {0.0};
    for (int j = 0; j < limits->directions; j++)
        direction[j] = state[j][order];
    of_axes(limits, direction, axis);
}

/* Largest ratio of velocity or acceleration to its limit along polynomial paths; up to 1, they are
 * within the limits. */
static double path_share(const path_limits *limits, const rthyb_path *paths, const double *v_max,
                         const double *a_max)
{
    const double T = (double)paths[0].ticks * limits->period_s;
    double share = 0.0;
    for (int i = 0; i <= 32; i++) {
        const double u = i / 32.0;
        double v[MOST] = {0.0}, a[MOST] = {0.0}, axis_v[MOST], axis_a[MOST];
        for (int j = 0; j < limits->directions; j++) {
            v[j] = polynomial(&paths[j], u, 1);
            a[j] = polynomial(&paths[j], u, 2);
        }
        of_axes(limits, v, axis_v);
        of_axes(limits, a, axis_a);
        for (int k = 0; k < limits->axes; k++) {
            share = fmax(share, fabs(axis_v[k]) / (v_max[k] * T));
            share = fmax(share, fabs(axis_a[k]) / (a_max[k] * T * T));
        }
    }
    return share;
}

/* Velocity and acceleration of each axis, for a state in interface coordinates; with pins, at that
 * pose. */
static void rates_of_axes(const path_limits *limits, const double state[][3], double *v, double *a)
{
    double pose[MOST] = {0.0}, velocity[MOST] = {0.0}, acceleration[MOST] = {0.0};
    if (!limits->pins) {
        states_of_axes(limits, state, 1, v);
        states_of_axes(limits, state, 2, a);
        return;
    }
    for (int j = 0; j < limits->directions; j++) {
        pose[j] = state[j][0];
        velocity[j] = state[j][1];
        acceleration[j] = state[j][2];
    }
    rthyb_kinematics_rates(limits->pins, pose, velocity, acceleration, v, a);
}

/* Largest ratios of the axes' velocity and acceleration to their limits, along a path of any
 * kind. */
typedef struct {
    double velocity, acceleration;
} shares;

static shares shares_along(const path_limits *limits, const rthyb_path *paths, const double *v_max,
                           const double *a_max)
{
    shares most = {0.0, 0.0};
    for (int i = 0; i <= POINTS; i++) {
        double now[MOST][3] = {{0.0}}, v[MOST] = {0.0}, a[MOST] = {0.0};
        for (int j = 0; j < limits->directions; j++)
            path_at(&paths[j], (double)paths[j].ticks * i / POINTS, limits->period_s, now[j]);
        rates_of_axes(limits, now, v, a);
        for (int k = 0; k < limits->axes; k++) {
            most.velocity = fmax(most.velocity, PEAK_BETWEEN * fabs(v[k]) / v_max[k]);
            most.acceleration = fmax(most.acceleration, PEAK_BETWEEN * fabs(a[k]) / a_max[k]);
        }
    }
    return most;
}

static double larger(shares of)
{
    return fmax(of.velocity, of.acceleration);
}

static void quintics(const path_limits *limits, const double from[][3], const double to[][3],
                     double T, rthyb_path *paths)
{
    const double h = limits->period_s;
    for (int j = 0; j < limits->directions; j++)
        paths[j] = quintic(from[j], to[j], whole_ticks(T, h), h);
}

/* Limits that the axes keep to: if an end state itself exceeds a limit, its value instead. */
static void keep_to(const path_limits *limits, const double from[][3], const double to[][3],
                    double *v_max, double *a_max)
{
    double begin_v[MOST], begin_a[MOST], end_v[MOST], end_a[MOST];
    rates_of_axes(limits, from, begin_v, begin_a);
    rates_of_axes(limits, to, end_v, end_a);
    for (int k = 0; k < limits->axes; k++) {
        v_max[k] = fmax(limits->velocity_m_per_s[k], 1.01 * fmax(fabs(begin_v[k]), fabs(end_v[k])));
        a_max[k] =
            fmax(limits->acceleration_m_per_s2[k], 1.01 * fmax(fabs(begin_a[k]), fabs(end_a[k])));
    }
}

/* Lengthens a path until the axes keep to their limits everywhere along it; if no length does, the
 * path becomes the one that exceeds them least. */
static void stretch(const path_limits *limits, const double from[][3], const double to[][3],
                    const double *v_max, const double *a_max, rthyb_path *paths)
{
    double T = (double)paths[0].ticks * limits->period_s;
    double least = larger(shares_along(limits, paths, v_max, a_max));
    for (int i = 0; i < STRETCHES && least > 1.0; i++) {
        rthyb_path others[MOST];
        T *= STRETCH;
        quintics(limits, from, to, T, others);
        const double share = larger(shares_along(limits, others, v_max, a_max));
        if (share < least)
            memcpy(paths, others, (size_t)limits->directions * sizeof *paths);
        least = fmin(share, least);
    }
}

/* The shortest quintics, within a factor of 1.25, that keep to the path limits; if an end state
 * itself exceeds a limit, its value is used instead. A path to a nearby point that is to be passed
 * at speed may lack both time and room, and a longer one only swings farther: then the quintics
 * that exceed the limits least. */
void path_between(const path_limits *limits, const double from[][3], const double to[][3],
                  rthyb_path *paths)
{
    double v_max[MOST], a_max[MOST];
    double T = (double)limits->least_way * limits->period_s;
    keep_to(limits, from, to, v_max, a_max);
    quintics(limits, from, to, T, paths);
    double least = path_share(limits, paths, v_max, a_max);
    for (int i = 0; i < SEARCH_STEPS && least > 1.0; i++) {
        rthyb_path others[MOST];
        T *= 1.25;
        quintics(limits, from, to, T, others);
        const double share = path_share(limits, others, v_max, a_max);
        if (share < least)
            memcpy(paths, others, (size_t)limits->directions * sizeof *paths);
        least = fmin(share, least);
    }
    if (limits->pins)
        stretch(limits, from, to, v_max, a_max, paths);
}

/* Accelerations at the beginning of a brake: if an axis exceeds its limit, the accelerations in all
 * directions are reduced by the same factor. For a single axis and direction, the result is exactly
 * the limit. */
static void begin_braking(const path_limits *limits, const double from[][3], double *a)
{
    double axis[MOST], factor = 1.0;
    states_of_axes(limits, from, 2, axis);
    for (int k = 0; k < limits->axes; k++)
        if (fabs(axis[k]) > limits->brake_m_per_s2[k])
            factor = fmin(factor, limits->brake_m_per_s2[k] / fabs(axis[k]));
    for (int j = 0; j < limits->directions; j++)
        a[j] = factor < 1.0 ? factor * from[j][2] : from[j][2];
    if (limits->axes == 1 && limits->jacobian[0] == 1.0)
        a[0] = clamp(from[0][2], -limits->brake_m_per_s2[0], limits->brake_m_per_s2[0]);
}

/* Duration of a brake for the velocity and acceleration of an axis: ticks of each change, and of
 * the steady part. */
typedef struct {
    int64_t turn, steady;
} braking;

static int64_t turn_of(const path_limits *limits, double b, double v, double a)
{
    const double along = v < 0.0 ? -a : a;
    return (int64_t)clamp(fabs(v) / (b - 0.5 * along) / limits->period_s,
                          (double)limits->least_turn, (double)limits->turn);
}

static int64_t steady_of(const path_limits *limits, double b, double v, double a, int64_t turn)
{
    const double along = v < 0.0 ? -a : a, changes = (double)turn * limits->period_s;
    const double rest = (fabs(v) + 0.5 * along * changes) / b - changes;
    return rest > 0.0 ? whole_ticks(rest, limits->period_s) : 0;
}

static braking longest(const path_limits *limits, const double from[][3], const double *a)
{
    double axis_v[MOST], axis_a[MOST];
    braking most = {limits->least_turn, 0};
    states_of_axes(limits, from, 1, axis_v);
    of_axes(limits, a, axis_a);
    for (int k = 0; k < limits->axes; k++) {
        const int64_t own = turn_of(limits, limits->brake_m_per_s2[k], axis_v[k], axis_a[k]);
        most.turn = own > most.turn ? own : most.turn;
    }
    for (int k = 0; k < limits->axes; k++) {
        const int64_t own =
            steady_of(limits, limits->brake_m_per_s2[k], axis_v[k], axis_a[k], most.turn);
        most.steady = own > most.steady ? own : most.steady;
    }
    return most;
}

/* Brakes from (x, v, a) in each direction to rest. A step of the acceleration would become a jump
 * behind the phase lead, so each change takes `turn` ticks, fewer for a motion that ends sooner:
 * v = (b - a / 2) turn. */
static void brakes(const path_limits *limits, const double from[][3], const double *a,
                   const braking *brake, rthyb_path *paths)
{
    const double h = limits->period_s, changes = (double)brake->turn * h;
    for (int j = 0; j < limits->directions; j++) {
        const double needed =
            (from[j][1] + 0.5 * a[j] * changes) / (changes + (double)brake->steady * h);
        rthyb_path *path = &paths[j];
        *path = (rthyb_path){
            .c = {from[j][0], from[j][1], a[j], -needed},
            .ticks = 2 * brake->turn + brake->steady,
            .turn = brake->turn,
        };
        double at_rest[3];
        braked(path, (double)path->ticks, h, at_rest);
        path->end = at_rest[0];
    }
}

/* Like `stretch`, but lengthens a brake. No brake can remove the acceleration that the rotation of
 * the axes adds while they are fast. */
static void soften(const path_limits *limits, const double from[][3], const double *a,
                   braking brake, rthyb_path *paths)
{
    double no_limit[MOST];
    for (int k = 0; k < MOST; k++)
        no_limit[k] = HUGE_VAL;
    double least = larger(shares_along(limits, paths, no_limit, limits->brake_m_per_s2));
    for (int i = 0; i < STRETCHES && least > 1.0; i++) {
        rthyb_path others[MOST];
        brake.steady += 1 + (int64_t)((STRETCH - 1.0) * (double)(brake.turn + brake.steady));
        brakes(limits, from, a, &brake, others);
        const double share = larger(shares_along(limits, others, no_limit, limits->brake_m_per_s2));
        if (share < least)
            memcpy(paths, others, (size_t)limits->directions * sizeof *paths);
        least = fmin(share, least);
    }
}

void path_to_rest(const path_limits *limits, const double from[][3], rthyb_path *paths)
{
    double a[MOST] = {0.0};
    begin_braking(limits, from, a);
    const braking brake = longest(limits, from, a);
    brakes(limits, from, a, &brake, paths);
    if (limits->pins)
        soften(limits, from, a, brake, paths);
}

rthyb_path path_ramp(double a, double b, int64_t ticks)
{
    return (rthyb_path){.c = {0.5 * (a + b), 0.5 * (a - b)}, .end = b, .ticks = ticks, .cosine = 1};
}

/* All velocities of a ramp are proportional to 1 / T, and all accelerations to 1 / T^2. */
static int64_t stretched_ramp(const path_limits *limits, const double *way, int64_t ticks)
{
    rthyb_path paths[MOST];
    for (int j = 0; j < limits->directions; j++)
        paths[j] = path_ramp(way[j], 0.0, ticks);
    const shares most =
        shares_along(limits, paths, limits->velocity_m_per_s, limits->acceleration_m_per_s2);
    const double longer = fmax(fmax(most.velocity, sqrt(most.acceleration)), 1.0);
    return (int64_t)clamp(ceil((double)ticks * longer), (double)ticks, 1e15);
}

/* Duration that keeps the peak velocity pi/2 way/T and the peak acceleration pi^2/2 way/T^2 of the
 * ramp within the limits. */
int64_t path_ramp_ticks(const path_limits *limits, const double *way)
{
    double axis[MOST];
    int64_t most = 1;
    of_axes(limits, way, axis);
    for (int k = 0; k < limits->axes; k++) {
        const double size = fabs(axis[k]);
        const double by_velocity = 0.5 * RTHYB_PI * size / limits->velocity_m_per_s[k];
        const double by_acceleration =
            RTHYB_PI * sqrt(0.5 * size / limits->acceleration_m_per_s2[k]);
        const int64_t own = whole_ticks(fmax(by_velocity, by_acceleration), limits->period_s);
        most = own > most ? own : most;
    }
    return limits->pins ? stretched_ramp(limits, way, most) : most;
}

int path_done(const rthyb_path *p)
{
    return p->elapsed >= p->ticks;
}

double path_follow(rthyb_path *p, double h)
{
    if (!path_done(p))
        p->elapsed++;
    if (path_done(p))
        return p->end;
    double now[3];
    path_along(p, h, now);
    return now[0];
}
