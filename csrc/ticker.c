/* The ticker: an exact number of due times per second, and what happens if one was missed. */
#define _GNU_SOURCE /* NOLINT(bugprone-reserved-identifier,cert-dcl37-c,cert-dcl51-cpp) */

#include <errno.h>
#include <limits.h>
#include <linux/futex.h>
#include <math.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#include "relaxed.h"
#include "rthyb.h"

#define SECOND_NS 1000000000
#define RATE_TOLERANCE 1e-9 /* relative, because 1/rate is rounded */

int64_t rthyb_now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * SECOND_NS + now.tv_nsec;
}

int64_t rthyb_asleep_ns(void)
{
    struct timespec whole;
    const int64_t awake_ns = rthyb_now_ns();
    clock_gettime(CLOCK_BOOTTIME, &whole);
    return (int64_t)whole.tv_sec * SECOND_NS + whole.tv_nsec - awake_ns;
}

int64_t rthyb_ticker_slept_ns(rthyb_ticker *ticker)
{
    const int64_t asleep_ns = rthyb_asleep_ns(), before_ns = ticker->asleep_ns;
    const int known = ticker->asleep_known;
    ticker->asleep_ns = asleep_ns;
    ticker->asleep_known = 1;
    return known ? asleep_ns - before_ns : 0;
}

static int rate_ok(uint32_t rate_hz)
{
    return rate_hz >= RTHYB_RATE_LEAST_HZ && rate_hz <= RTHYB_RATE_MOST_HZ;
}

int rthyb_ticker_init(rthyb_ticker *ticker, int32_t clock, uint32_t rate_hz, int64_t t0_ns)
{
    if (clock < RTHYB_CLOCK_HOST || clock > RTHYB_CLOCK_LINK || !rate_ok(rate_hz) || t0_ns < 0)
        return RTHYB_E_PERIOD;
    *ticker = (rthyb_ticker){.clock = clock, .rate_hz = rate_hz, .t0_ns = t0_ns};
    return 0;
}

uint32_t rthyb_ticker_rate_hz(double period_s)
{
    const double hz = 1.0 / period_s;
    if (!(hz >= RTHYB_RATE_LEAST_HZ - 0.5 && hz <= RTHYB_RATE_MOST_HZ + 0.5))
        return 0;
    const double whole = rint(hz);
    return fabs(hz - whole) <= RATE_TOLERANCE * whole ? (uint32_t)whole : 0u;
}

int64_t rthyb_ticker_trim_max_ns(uint32_t rate_hz)
{
    const uint32_t ppm_ns = RTHYB_TRIM_MAX_PPM * (SECOND_NS / 1000000);
    return rate_hz ? (int64_t)((ppm_ns + rate_hz / 2u) / rate_hz) : 0;
}

/* Seconds and the remaining ticks separately: the product of both would overflow within a hundred
 * years. */
int64_t rthyb_ticker_due_ns(const rthyb_ticker *ticker, uint64_t k)
{
    const uint64_t rate = ticker->rate_hz, second = k / rate;
    const uint64_t since = second * SECOND_NS + (k - second * rate) * SECOND_NS / rate;
    return ticker->t0_ns + ticker->shift_ns + (int64_t)since;
}

/* The last tick that is due at `now_ns`: the largest k with floor(k 1e9/rate) <= now - t0, which is
 * the largest integer below (now - t0 + 1) rate/1e9. */
static uint64_t newest_due(const rthyb_ticker *ticker, int64_t now_ns)
{
    const int64_t since = now_ns - ticker->t0_ns - ticker->shift_ns;
    if (since < 0)
        return 0u;
    const uint64_t end = (uint64_t)since + 1u, second = end / SECOND_NS;
    const uint64_t part = (end - second * SECOND_NS) * ticker->rate_hz;
    return second * ticker->rate_hz + (part + SECOND_NS - 1u) / SECOND_NS - 1u;
}

/* Makes k the current tick; the ticks between the last one and k are skipped. */
static void take(rthyb_ticker *ticker, uint64_t k, rthyb_tick *tick)
{
    const uint64_t skipped = k - ticker->elapsed;
    *tick = (rthyb_tick){.k = k, .skipped = skipped, .due_ns = rthyb_ticker_due_ns(ticker, k)};
    tick->woken_ns = tick->due_ns;
    add(&ticker->skipped, skipped);
    raise_to(&ticker->longest_skip, skipped);
    add(&ticker->executed, 1u);
    put(&ticker->elapsed, k + 1u);
}

void rthyb_ticker_woken(rthyb_ticker *ticker, int64_t now_ns, rthyb_tick *tick)
{
    const uint64_t waited_for = ticker->elapsed, newest = newest_due(ticker, now_ns);
    /* Also after a skip: how late the thread was, not how late it is for the tick that it can still
     * execute. */
    rthyb_latency_record(&ticker->wake, now_ns - rthyb_ticker_due_ns(ticker, waited_for));
    take(ticker, newest > waited_for ? newest : waited_for, tick);
    tick->woken_ns = now_ns;
}

void rthyb_ticker_step(rthyb_ticker *ticker, rthyb_tick *tick)
{
    const uint64_t missed = peek(&ticker->missed) - ticker->missed_taken;
    ticker->missed_taken += missed;
    take(ticker, ticker->elapsed + missed, tick);
}

static int stopped(const rthyb_ticker *ticker)
{
    return __atomic_load_n(&ticker->stop, __ATOMIC_ACQUIRE) != 0;
}

/* The bell is read before the values that it announces, so that a ring in between is not missed. */
static int wait_for_grant(rthyb_ticker *ticker, rthyb_tick *tick)
{
    for (;;) {
        const uint32_t bell = __atomic_load_n(&ticker->bell, __ATOMIC_ACQUIRE);
        if (stopped(ticker))
            return 0;
        if (__atomic_load_n(&ticker->granted, __ATOMIC_ACQUIRE) > ticker->executed)
            break;
        syscall(SYS_futex, &ticker->bell, FUTEX_WAIT_PRIVATE, bell, NULL, NULL, 0);
    }
    rthyb_ticker_step(ticker, tick);
    return 1;
}

int rthyb_ticker_wait(rthyb_ticker *ticker, rthyb_tick *tick)
{
    if (ticker->clock == RTHYB_CLOCK_STEPPED)
        return wait_for_grant(ticker, tick);
    const int64_t due_ns = rthyb_ticker_due_ns(ticker, ticker->elapsed);
    const struct timespec due = {.tv_sec = due_ns / SECOND_NS, .tv_nsec = due_ns % SECOND_NS};
    int error = EINTR;
    while (error == EINTR && !stopped(ticker))
        error = clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL);
    if (error || stopped(ticker))
        return 0;
    rthyb_ticker_woken(ticker, rthyb_now_ns(), tick);
    return 1;
}

void rthyb_ticker_trim(rthyb_ticker *ticker, int64_t ns)
{
    const int64_t most = rthyb_ticker_trim_max_ns(ticker->rate_hz);
    ticker->shift_ns += ns < -most ? -most : (ns > most ? most : ns);
}

static void ring(rthyb_ticker *ticker)
{
    __atomic_fetch_add(&ticker->bell, 1u, __ATOMIC_RELEASE);
    syscall(SYS_futex, &ticker->bell, FUTEX_WAKE_PRIVATE, INT_MAX, NULL, NULL, 0);
}

void rthyb_ticker_grant(rthyb_ticker *ticker, uint64_t ticks)
{
    __atomic_fetch_add(&ticker->granted, ticks, __ATOMIC_RELEASE);
    ring(ticker);
}

void rthyb_ticker_miss(rthyb_ticker *ticker, uint64_t ticks)
{
    __atomic_fetch_add(&ticker->missed, ticks, __ATOMIC_RELAXED);
}

void rthyb_ticker_stop(rthyb_ticker *ticker)
{
    __atomic_store_n(&ticker->stop, 1u, __ATOMIC_RELEASE);
    ring(ticker);
}

void rthyb_ticker_read(const rthyb_ticker *ticker, rthyb_ticker_counts *counts)
{
    counts->elapsed = peek(&ticker->elapsed);
    counts->executed = peek(&ticker->executed);
    counts->skipped = peek(&ticker->skipped);
    counts->longest_skip = peek(&ticker->longest_skip);
}
