/* What a control law is to the core. One file each, law_NAME.c, which ends with RTHYB_LAW: the linker
 * gathers what it finds there, so that nothing else needs to name it. */
#ifndef RTHYB_CONTROL_LAW_H
#define RTHYB_CONTROL_LAW_H

#include "numeric.h"
#include "rthyb.h"

#define RTHYB_COUNT(array) (sizeof(array) / sizeof(array)[0])

/* What is counted in samples in a test file is of 1/1024 s, whatever the rate: so many of the loop's. */
static inline double rthyb_pace(double period_s)
{
    return 1.0 / 1024.0 / period_s;
}

#define RTHYB_LAW(law)                                                                             \
    _Static_assert(RTHYB_LAW_STATE_BYTES >= sizeof(law##_state),                                   \
                   "the state of a law is too large");                                             \
    static const rthyb_control_law *const law##_entry                                              \
        __attribute__((used, section("rthyb_laws"))) = &law

/* Whether a setting lies below half of the sample rate; says what is wrong where it does not. */
static inline int rthyb_below_half_rate(double hz, double period_s, rthyb_law_complaint *why)
{
    const int below = hz * period_s < 0.5;
    if (!below)
        *why =
            (rthyb_law_complaint){"found {} Hz; must be below half of test.sample_rate_hz = {} Hz; "
                                  "lower it, or raise the rate (256 to 4096 Hz)",
                                  {hz, 1.0 / period_s}};
    return below;
}

/* NULL: no such law. */
const rthyb_control_law *rthyb_law_at(int32_t kind);

/* A law whose gain on slow motions is not 1 leads a specimen that stands at x to gain x. Not at once:
 * rest() takes the difference as an offset, which fades as the command moves, so that nothing creeps
 * at rest, and the way back to 0 ends there. step: the command's; returns what to add to the lead. */
static inline double rthyb_fade(double *offset, double gain, double step)
{
    const double most = fabs(1.0 - gain) * fabs(step);
    *offset -= clamp(*offset, -most, most);
    return *offset;
}

/* How much of a step that would move the command by effect_m is taken. */
static inline double rthyb_allowed_share(double effect_m, double allowed_m)
{
    return effect_m > allowed_m ? allowed_m / effect_m : 1.0;
}

#endif
