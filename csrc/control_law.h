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

/* Where a law begins. Parameters are in the order of its table, and finite. The ranges of the table are
 * those of test files; who asks the core itself may go beyond them, so a law must not trust them with its
 * memory. */
typedef struct {
    const double *parameters;
    double period_s;
    double x0_m;         /* command and specimen stand here */
    double rest_noise_m; /* standard deviation of x_m measured at rest */
} rthyb_law_start;

/* State is the law's own, state_size plain bytes without a pointer in them: who copies them has all of
 * it. None of these allocates, locks or calls the system; each is done within a bounded time. */
struct rthyb_control_law {
    rthyb_law_description is;
    size_t state_size;
    /* What parameters that are each within their range do wrong together at this sampling period: -1, or
     * the index of the one to blame. What only the rig knows may be NaN still. May be NULL. */
    int (*check)(const double *parameters, double period_s, rthyb_law_complaint *complaint);
    /* 0 or enum rthyb_error. The state is all zeros before. */
    int (*init)(void *state, const rthyb_law_start *start);
    /* Command and specimen stand at x_m now: leading x_m next gives x_m. What has been learnt stays. */
    void (*rest)(void *state, double x_m);
    /* The newest pair: the command that the drive had, and what was measured. frozen: take it in, but
     * learn nothing from it. Status bits. */
    int (*observe)(void *state, double x_p_m, double x_m_m, int frozen);
    /* x_c -> x_p for the same instant. What has been learnt since the last call may move x_p by no more
     * than allowed_m: 0 for not at all, INFINITY for as far as it likes. Status bits; *x_p_m is finite
     * whatever x_c_m is. */
    int (*lead)(void *state, double x_c_m, double allowed_m, double *x_p_m);
};

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
