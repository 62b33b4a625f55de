/* The link clock: a PI loop shifts the due times so that the drive's samples arrive a set time
 * before the tick, whatever the difference between the two clocks. Pure: time stamps in, trims
 * out. */
#include "numeric.h"

/* Durations are in seconds, so that they are the same at every rate. */
#define OMEGA (2.0 * RTHYB_PI * 0.3)  /* natural frequency 0.3 Hz, damping 1 */
#define SMOOTHING (16.0 * STANDARD_S) /* averaging time of the error, against jitter */
#define OUTLIER_NS 100e3              /* largest deviation that counts */
#define SILENCE (20.0 * STANDARD_S)   /* without a pair, after which only the drift is kept */
#define NEAR_NS 100e3                 /* largest smoothed error of a loop that is locked */
#define NEAR_S 0.25                   /* within it, without interruption */
#define FAR_NS 150e3                  /* above it the trim is at its limit, whatever the drift */
#define WAY_FROM (64.0 * STANDARD_S)  /* interval in which the rate of approach is measured */
#define WAY_TO (512.0 * STANDARD_S)
#define TRIM_MEMORY 4.0 /* s, averaging time of the trim that is shown */
#define LEAD_MIN_NS 10e3
#define STAMP_MAX_NS 1e9

int rthyb_phase_init(rthyb_phase *phase, uint32_t rate_hz, double lead_ns)
{
    if (rate_hz < RTHYB_RATE_LEAST_HZ || rate_hz > RTHYB_RATE_MOST_HZ)
        return RTHYB_E_PERIOD;
    const double h = 1.0 / rate_hz;
    if (!(lead_ns >= LEAD_MIN_NS && lead_ns <= 0.5e9 * h))
        return RTHYB_E_PERIOD;
    *phase = (rthyb_phase){
        .lead_ns = lead_ns,
        .period_ns = 1e9 * h,
        .trim_max_ns = (double)rthyb_ticker_trim_max_ns(rate_hz),
        .per_tick = OMEGA * h,
        .smoothing = fmax(SMOOTHING * rate_hz, 1.0),
        .trim_memory = TRIM_MEMORY * rate_hz,
        .silence = ticks_of(SILENCE, h),
        .near_ticks = ticks_of(NEAR_S, h),
        .way_from = ticks_of(WAY_FROM, h),
        .way_to = ticks_of(WAY_TO, h),
    };
    return 0;
}

/* The error less whole periods, so that its magnitude is smallest. */
static double wrapped(const rthyb_phase *p, double ns)
{
    return ns - p->period_ns * rint(ns / p->period_ns);
}

uint32_t rthyb_phase_typical(const rthyb_phase *p, const int64_t *arrived_ns, uint32_t count)
{
    uint32_t best = 0;
    double least = HUGE_VAL;
    for (uint32_t i = 0; i < count; i++) {
        double sum = 0.0;
        for (uint32_t k = 0; k < count; k++)
            sum += fabs(wrapped(p, (double)(arrived_ns[k] - arrived_ns[i])));
        if (sum < least)
            best = i;
        least = fmin(least, sum);
    }
    return best;
}

/* An error of half a period can be reduced in either direction. With drift, one direction is only a
 * third as fast as the other, and which one becomes clear only on the way. Changing direction must
 * save half a second; an error that grows despite the largest trim would not be held if approached
 * from the other direction either. */
static void choose_side(rthyb_phase *p)
{
    const double size = fabs(p->error_ns);
    if (p->ticks == p->way_from)
        p->mark_ns = p->error_ns;
    if (p->ticks < p->way_to)
        return;
    p->ticks = 0;
    if (size < FAR_NS || fabs(p->mark_ns) < FAR_NS)
        return;
    const double way = (double)(p->way_to - p->way_from);
    const double speed = fmin((fabs(p->mark_ns) - size) / way, p->trim_max_ns);
    const double other = (p->period_ns - size) / (2.0 * p->trim_max_ns - speed);
    if (speed > 0.0 && size / speed > other + p->way_to)
        p->error_ns -= copysign(p->period_ns, p->error_ns);
}

/* The error is tracked beyond half a period; otherwise, jitter there would change its sign again
 * and again. */
static void follow(rthyb_phase *p, double error_ns)
{
    if (!p->following) {
        p->following = 1;
        p->ticks = p->near = 0;
        p->error_ns = wrapped(p, error_ns);
    }
    const double step = clamp(wrapped(p, error_ns - p->error_ns), -OUTLIER_NS, OUTLIER_NS);
    p->error_ns += step / p->smoothing;
    if (fabs(p->error_ns) > p->period_ns)
        p->error_ns -= copysign(p->period_ns, p->error_ns);
    p->silent = 0;
}

static void judge_lock(rthyb_phase *p)
{
    const double size = fabs(p->error_ns), near_ns = fmin(NEAR_NS, 0.5 * p->lead_ns);
    p->near = size > near_ns ? 0 : p->near + (p->near < p->near_ticks);
    if (p->near == p->near_ticks)
        p->locked = 1;
    if (size > 2.0 * near_ns)
        p->locked = 0;
}

static void lose(rthyb_phase *p)
{
    p->silent += p->silent < p->silence;
    if (p->silent == p->silence)
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
    const double trim_max = p->trim_max_ns, proportional = 2.0 * p->per_tick;
    const double integral = p->per_tick * p->per_tick;
    const double wanted = p->drift_ns + (p->following ? proportional * p->error_ns : 0.0);
    if (usable && fabs(wanted) < trim_max)
        p->drift_ns = clamp(p->drift_ns + integral * p->error_ns, -trim_max, trim_max);
    const double trim = clamp(wanted, -trim_max, trim_max);
    p->trim_ns += (trim - p->trim_ns) / p->trim_memory;
    return whole_ns(p, trim);
}
