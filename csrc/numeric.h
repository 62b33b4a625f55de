/* Small numerical helpers shared by the kernels; nothing here crosses the library's boundary. */
#ifndef RTHYB_NUMERIC_H
#define RTHYB_NUMERIC_H

#include <math.h>

#include "rthyb.h"

/* No laboratory moves a kilometre or pushes a teranewton: beyond this a value is a fault, and
 * squares and products of what is within it cannot overflow. */
#define RTHYB_DISPLACEMENT_MAX_M 1e3
#define RTHYB_FORCE_MAX_N 1e12
#define RTHYB_WEIGHT_MAX 1e6
#define RTHYB_PI 3.14159265358979323846

/* Of a function of n axes: made once for one axis, where no loop is left, and once for any number. The
 * compiler's own judgement leaves the loops in, and a sample of one axis takes a tenth longer. */
#define PER_COUNT static inline __attribute__((always_inline))

static inline double clamp(double v, double low, double high)
{
    return v < low ? low : (v > high ? high : v);
}

/* fmax and fmin without the call of a library: a second number that is NaN gives the first. */
static inline double greater_of(double a, double b)
{
    return b > a ? b : a;
}

static inline double less_of(double a, double b)
{
    return b < a ? b : a;
}

/* A time in whole ticks of h, at least one. What is a whole number of 1/1024 s is exactly that many at
 * 1024 Hz. */
static inline uint32_t ticks_of(double duration_s, double h)
{
    return (uint32_t)clamp(rint(duration_s / h), 1.0, 1e9);
}

#define STANDARD_S                                                                                 \
    (1.0 / 1024.0) /* what the files count in, and a tick unless a test says otherwise */

/* So many samples of 1/1024 s, in ticks of h. */
static inline uint32_t standard_ticks(double samples, double h)
{
    return ticks_of(samples * STANDARD_S, h);
}

/* Stable, and small enough that no product of them overflows. */
static inline int weights_ok(double w1, double w2)
{
    return rthyb_plc_is_stable(w1, w2) && fabs(w1) <= RTHYB_WEIGHT_MAX &&
           fabs(w2) <= RTHYB_WEIGHT_MAX;
}

/* RTHYB_OK, NOT_FINITE or OUT_OF_RANGE. Written so that NaN fails the comparison. */
static inline int judge(double v, double limit)
{
    if (fabs(v) <= limit)
        return RTHYB_OK;
    return isfinite(v) ? RTHYB_S_OUT_OF_RANGE : RTHYB_S_NOT_FINITE;
}

/* The value, or the last good one with the reason in *code. */
static inline double accept(double v, double limit, double last_good, int *code)
{
    const int verdict = judge(v, limit);
    *code |= verdict;
    return verdict == RTHYB_OK ? v : last_good;
}

/* Clamps a state that an unstable computation drove off, and says so. NaN becomes 0. */
static inline double confine(double v, double limit, int *code)
{
    const int verdict = judge(v, limit);
    if (verdict == RTHYB_OK)
        return v;
    *code |= verdict;
    return isnan(v) ? 0.0 : clamp(v, -limit, limit);
}

/* tanh, without its cost where it is 1 to the last digit: the smoothed sign of friction laws. */
static inline double smooth_sign(double ratio)
{
    return fabs(ratio) > 19.0 ? copysign(1.0, ratio) : tanh(ratio);
}

#endif
