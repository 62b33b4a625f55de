/* The link clock: a PI loop moves the due times so that the drive's samples arrive a set time before
 * the tick, whatever the two clocks think of one another. Pure: stamps in, trims out. */
#include "numeric.h"

#define TICK_NS 976562.5
#define PER_TICK (2.0 * RTHYB_PI * 0.3 / 1024.0) /* natural frequency 0.3 Hz, damping 1 */
#define PROPORTIONAL (2.0 * PER_TICK)
#define INTEGRAL (PER_TICK * PER_TICK)
#define SMOOTHING 16.0   /* ticks of jitter that one error is the mean of */
#define OUTLIER_NS 100e3 /* nothing that is further off counts for more */
#define SILENCE 20       /* ticks without a pair, then all but the drift is forgotten */
#define NEAR_NS 100e3    /* smoothed error of a loop that has locked */
#define NEAR_TICKS 256   /* in a row */
#define FAR_NS 150e3     /* here the trim is as large as it gets, whatever the drift */
#define WAY_FROM 64      /* ticks in which the speed of approach is measured */
#define WAY_TO 512
#define TRIM_MEMORY 4096.0 /* ticks that the trim shown is the mean of */
#define LEAD_MIN_NS 10e3
#define STAMP_MAX_NS 1e9

static const double trim_max = RTHYB_TRIM_MAX_NS;

int rthyb_phase_init(rthyb_phase *phase, double lead_ns)
{
    if (!(lead_ns >= LEAD_MIN_NS && lead_ns <= 0.5 * TICK_NS))
        return RTHYB_E_PERIOD;
    *phase = (rthyb_phase){.lead_ns = lead_ns};
    return 0;
}

/* The nearest of the errors that are whole periods apart. */
static double wrapped(double ns)
{
    return ns - TICK_NS * rint(ns / TICK_NS);
}

/* An error of half a period may be closed from either side. Against a drift one side is a third as
 * fast as the other, and which one that is shows on the way. Another side must save half a second;
 * what gets away against the largest trim will not be held from there either. */
static void choose_side(rthyb_phase *p)
{
    const double size = fabs(p->error_ns);
    if (p->ticks == WAY_FROM)
        p->mark_ns = p->error_ns;
    if (p->ticks < WAY_TO)
        return;
    p->ticks = 0;
    if (size < FAR_NS || fabs(p->mark_ns) < FAR_NS)
        return;
    const double speed = fmin((fabs(p->mark_ns) - size) / (WAY_TO - WAY_FROM), trim_max);
    if (speed > 0.0 && size / speed > (TICK_NS - size) / (2.0 * trim_max - speed) + WAY_TO)
        p->error_ns -= copysign(TICK_NS, p->error_ns);
}

/* The error is followed across the half period, or jitter there would turn it round again and
 * again. */
static void follow(rthyb_phase *p, double error_ns)
{
    if (!p->following) {
        p->following = 1;
        p->ticks = p->near = 0;
        p->error_ns = wrapped(error_ns);
    }
    const double step = clamp(wrapped(error_ns - p->error_ns), -OUTLIER_NS, OUTLIER_NS);
    p->error_ns += step / SMOOTHING;
    if (fabs(p->error_ns) > TICK_NS)
        p->error_ns -= copysign(TICK_NS, p->error_ns);
    p->silent = 0;
}

static void judge_lock(rthyb_phase *p)
{
    const double size = fabs(p->error_ns), near_ns = fmin(NEAR_NS, 0.5 * p->lead_ns);
    p->near = size > near_ns ? 0 : p->near + (p->near < NEAR_TICKS);
    if (p->near == NEAR_TICKS)
        p->locked = 1;
    if (size > 2.0 * near_ns)
        p->locked = 0;
}

static void lose(rthyb_phase *p)
{
    p->silent += p->silent < SILENCE;
    if (p->silent == SILENCE)
        p->following = p->locked = 0;
}

static int64_t whole_ns(rthyb_phase *p, double trim_ns)
{
    p->carry_ns += trim_ns;
    const double whole = trunc(p->carry_ns);
    p->carry_ns -= whole;
    return (int64_t)whole;
}

int64_t rthyb_phase_step(rthyb_phase *p, int came, double after_due_ns)
{
    const int usable = came && fabs(after_due_ns) <= STAMP_MAX_NS;
    if (usable)
        follow(p, after_due_ns + p->lead_ns);
    else
        lose(p);
    if (p->following) {
        p->ticks++;
        choose_side(p);
        judge_lock(p);
    }
    const double wanted = p->drift_ns + (p->following ? PROPORTIONAL * p->error_ns : 0.0);
    if (usable && fabs(wanted) < trim_max)
        p->drift_ns = clamp(p->drift_ns + INTEGRAL * p->error_ns, -trim_max, trim_max);
    const double trim = clamp(wanted, -trim_max, trim_max);
    p->trim_ns += (trim - p->trim_ns) / TRIM_MEMORY;
    return whole_ns(p, trim);
}
