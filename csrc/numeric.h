/* Small numerical helpers shared by the kernels; not part of the interface of the core. */
#ifndef RTHYB_NUMERIC_H
#define RTHYB_NUMERIC_H

#include <math.h>

#include "rthyb.h"

/* No laboratory moves a kilometre or exerts a teranewton: a value beyond these is a fault. Squares and products of
 * values within them cannot overflow. */
#define RTHYB_DISPLACEMENT_MAX_M 1e3
#define RTHYB_FORCE_MAX_N 1e12
#define RTHYB_WEIGHT_MAX 1e6
#define RTHYB_PI 3.14159265358979323846

/* For functions of n axes: compiled once for one axis, without loops, and once for any number. If this were left to
 * the compiler, the loops would remain, and a sample of one axis would take 10 % longer. */
#define PER_COUNT static inline __attribute__((always_inline))

static inline double clamp(double v, double low, double high)
{
    return v < low ? low : (v > high ? high : v);
}

/* fmax and fmin without a library call; if b is NaN, the result is a. */
static inline double greater_of(double a, double b)
{
    return b > a ? b : a;
}

static inline double less_of(double a, double b)
{
    return b < a ? b : a;
}

/* A duration in ticks of h, rounded, at least one. A multiple of 1/1024 s gives exactly that multiple at 1024 Hz. */
static inline uint32_t ticks_of(double duration_s, double h)
{
    return (uint32_t)clamp(rint(duration_s / h), 1.0, 1e9);
}

#define STANDARD_S (1.0 / 1024.0) /* unit of sample counts in files, and the default period */

/* A number of samples of 1/1024 s, in ticks of h. */
static inline uint32_t standard_ticks(double samples, double h)
{
    return ticks_of(samples * STANDARD_S, h);
}

/* Whether the weights give a stable compensator, and are small enough that their products cannot overflow. */
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

/* v, or the last valid value with the reason in *code. */
static inline double accept(double v, double limit, double last_good, int *code)
{
    const int verdict = judge(v, limit);
    *code |= verdict;
    return verdict == RTHYB_OK ? v : last_good;
}

/* Clamps a state that has diverged, and reports this in *code. NaN becomes 0. */
static inline double confine(double v, double limit, int *code)
{
    const int verdict = judge(v, limit);
    if (verdict == RTHYB_OK)
        return v;
    *code |= verdict;
    return isnan(v) ? 0.0 : clamp(v, -limit, limit);
}

/* The smoothed sign of friction laws: tanh, but without its cost where the result is exactly +-1. */
static inline double smooth_sign(double ratio)
{
    return fabs(ratio) > 19.0 ? copysign(1.0, ratio) : tanh(ratio);
}

#endif
