/* Interface between the core and a control law. Each law is one file, law_NAME.c, that ends with RTHYB_LAW: the linker
 * collects these entries, so that a law need not be listed anywhere else. */
#ifndef RTHYB_CONTROL_LAW_H
#define RTHYB_CONTROL_LAW_H

#include "numeric.h"
#include "rthyb.h"

#define RTHYB_COUNT(array) (sizeof(array) / sizeof(array)[0])

/* Test files count in samples of 1/1024 s at any rate: samples of the loop per 1/1024 s. */
static inline double rthyb_pace(double period_s)
{
    return 1.0 / 1024.0 / period_s;
}

#define RTHYB_LAW(law)                                                                             \
    _Static_assert(RTHYB_LAW_STATE_BYTES >= sizeof(law##_state),                                   \
                   "the state of a law is too large");                                             \
    static const rthyb_control_law *const law##_entry                                              \
        __attribute__((used, section("rthyb_laws"))) = &law

/* Whether a frequency is below half of the sample rate; otherwise *why explains the error. */
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

/* A law with a static gain other than 1 moves a specimen at rest at x to gain x. To avoid a jump, rest() stores the
 * difference as an offset, which decreases only as the command moves: nothing creeps at rest, and a path back to 0
 * ends at 0. step: change of the command. Returns the value to add to the output of the law. */
static inline double rthyb_fade(double *offset, double gain, double step)
{
    const double most = fabs(1.0 - gain) * fabs(step);
    *offset -= clamp(*offset, -most, most);
    return *offset;
}

/* Fraction of an adaptation that may be applied if all of it would change the command by effect_m. */
static inline double rthyb_allowed_share(double effect_m, double allowed_m)
{
    return effect_m > allowed_m ? allowed_m / effect_m : 1.0;
}

#endif
