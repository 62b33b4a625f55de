/* Ways between two states of motion: quintics, raised cosines, and brakes. */
#include "path.h"

#include <string.h>

#include "numeric.h"

#define SEARCH_STEPS 80 /* of 1.25 each: from 8 ms to longer than any test */

static int64_t whole_ticks(double duration_s, double h)
{
    return (int64_t)clamp(ceil(duration_s / h - 1e-9), 1.0, 1e15);
}

/* Quintic from (x0, v0, a0) to (x1, v1, a1) in so many ticks of h. */
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

/* x or its first or second derivative by u (order 0, 1, 2) of a polynomial path. */
static double polynomial(const rthyb_path *p, double u, int order)
{
    double sum = 0.0;
    for (int i = 5; i >= order; i--) {
        const double factor = order == 0 ? 1.0 : (order == 1 ? i : (double)i * (i - 1));
        sum = sum * u + factor * p->c[i];
    }
    return sum;
}

/* The largest share of the limits that a polynomial path takes; up to 1 it is within them. */
static double path_share(const rthyb_path *p, double h, double v_max, double a_max)
{
    const double T = (double)p->ticks * h;
    double share = 0.0;
    for (int i = 0; i <= 32; i++) {
        const double u = i / 32.0;
        share = fmax(share, fabs(polynomial(p, u, 1)) / (v_max * T));
        share = fmax(share, fabs(polynomial(p, u, 2)) / (a_max * T * T));
    }
    return share;
}

/* The shortest quintic, within a factor of 1.25, that keeps to the path limits; where the end states
 * themselves are beyond them, it keeps to their values. A way to a point that is near but left at speed may
 * be short of time and of room at once, and a longer one only swings the farther: then the one that exceeds
 * the limits least. */
rthyb_path path_between(const path_limits *limits, const double from[3], const double to[3])
{
    const double h = limits->period_s;
    const double v = fmax(limits->velocity_m_per_s, 1.01 * fmax(fabs(from[1]), fabs(to[1])));
    const double a = fmax(limits->acceleration_m_per_s2, 1.01 * fmax(fabs(from[2]), fabs(to[2])));
    double T = (double)limits->least_way * h;
    rthyb_path best = quintic(from, to, whole_ticks(T, h), h);
    double least = path_share(&best, h, v, a);
    for (int i = 0; i < SEARCH_STEPS && least > 1.0; i++) {
        T *= 1.25;
        const rthyb_path path = quintic(from, to, whole_ticks(T, h), h);
        const double share = path_share(&path, h, v, a);
        best = share < least ? path : best;
        least = fmin(share, least);
    }
    return best;
}

/* Displacement, velocity and acceleration on a brake: its acceleration goes over into the deceleration,
 * stays, and goes over into 0. */
static void braked(const rthyb_path *p, double h, double now[3])
{
    const double turn = (double)p->turn * h, steady = (double)(p->ticks - 2 * p->turn) * h;
    const double lasts[3] = {turn, steady, turn}, ends[3] = {p->c[3], p->c[3], 0.0};
    double left = (double)p->elapsed * h;
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

/* Brakes from (x, v, a) to rest. A step of the acceleration would be a leap behind the phase lead: each
 * change takes `turn`, less for a motion that is over sooner: v = (b - a / 2) turn. What a has beyond the
 * limit b is cut off. */
rthyb_path path_to_rest(const path_limits *limits, const double from[3])
{
    const double h = limits->period_s, b = limits->brake_m_per_s2, v = fabs(from[1]);
    const double a = clamp(from[1] < 0.0 ? -from[2] : from[2], -b, b);
    const int64_t turn =
        (int64_t)clamp(v / (b - 0.5 * a) / h, (double)limits->least_turn, (double)limits->turn);
    const double changes = (double)turn * h, rest = (v + 0.5 * a * changes) / b - changes;
    const int64_t steady = rest > 0.0 ? whole_ticks(rest, h) : 0;
    const double needed = (v + 0.5 * a * changes) / (changes + (double)steady * h);
    const double way = from[1] < 0.0 ? -1.0 : 1.0;
    rthyb_path path = {
        .c = {from[0], from[1], way * a, -way * needed},
        .ticks = 2 * turn + steady,
        .turn = turn,
    };
    double at_rest[3];
    path.elapsed = path.ticks;
    braked(&path, h, at_rest);
    path.elapsed = 0;
    path.end = at_rest[0];
    return path;
}

rthyb_path path_ramp(double a, double b, int64_t ticks)
{
    return (rthyb_path){.c = {0.5 * (a + b), 0.5 * (a - b)}, .end = b, .ticks = ticks, .cosine = 1};
}

/* Peak velocity pi/2 way/T and acceleration pi^2/2 way/T^2 of that wave within the limits. */
int64_t path_ramp_ticks(const path_limits *limits, double way)
{
    const double size = fabs(way);
    const double by_velocity = 0.5 * RTHYB_PI * size / limits->velocity_m_per_s;
    const double by_acceleration = RTHYB_PI * sqrt(0.5 * size / limits->acceleration_m_per_s2);
    return whole_ticks(fmax(by_velocity, by_acceleration), limits->period_s);
}

int path_done(const rthyb_path *p)
{
    return p->elapsed >= p->ticks;
}

void path_along(const rthyb_path *p, double h, double now[3])
{
    const double T = (double)p->ticks * h, u = (double)p->elapsed / (double)p->ticks;
    const double turned = RTHYB_PI * u, size = p->c[1], rate = RTHYB_PI / T;
    if (p->turn > 0) {
        braked(p, h, now);
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
