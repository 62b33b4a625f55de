/* Time: histograms (latency.c), the clock (ticker.c), real-time threads (thread.c), and the measurement of
 * a PC's punctuality (jitter.c). */
#ifndef RTHYB_PART_TIME_H
#define RTHYB_PART_TIME_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_controller.h"
#include "rthyb_ring.h"

/* cffi: begin */

/* This is the only part of the core that waits and, for measurements, starts threads. It never allocates
 * memory, and no _step function uses it. */

enum rthyb_time_size {
    RTHYB_LATENCY_BUCKETS = 1024, /* plus one for times longer than 2^36 ns */
    /* Range of ticks per second, an integer. A station has room for one second of ticks at the highest rate. */
    RTHYB_RATE_LEAST_HZ = 256,
    RTHYB_RATE_MOST_HZ = 4096,
    RTHYB_TRIM_MAX_PPM = 200 /* of a period: largest shift of a tick relative to the previous one */
};

/* Histogram of times in ns: one bucket per ns below 32, then 32 buckets per factor of two (3 %).
 * One thread records. Any thread may read at the same time; each number is consistent in itself. */
typedef struct {
    uint64_t count, sum_ns, max_ns;
    uint64_t bucket[RTHYB_LATENCY_BUCKETS + 1]; /* the last one: 2^36 ns (69 s) and longer */
} rthyb_latency;

/* Negative times count as zero. */
void rthyb_latency_record(rthyb_latency *latency, int64_t ns);
/* Time that the given fraction of the recorded times did not exceed, between the true value and 3 % more.
 * 0 if nothing was recorded. */
uint64_t rthyb_latency_percentile(const rthyb_latency *latency, double fraction);
/* Lower bound of a bucket, which is the upper bound of the previous one. */
uint64_t rthyb_latency_edge_ns(uint32_t bucket);
/* Adds the contents of `from`. With a zeroed `into`, this copies a histogram that is in use. */
void rthyb_latency_merge(rthyb_latency *into, const rthyb_latency *from);

enum rthyb_clock {
    RTHYB_CLOCK_HOST,    /* CLOCK_MONOTONIC */
    RTHYB_CLOCK_STEPPED, /* no wall clock: the caller requests each tick */
    RTHYB_CLOCK_LINK /* CLOCK_MONOTONIC, synchronised with the drive's samples by a control loop */
};

/* Tick k is due at t0 + k 1e9/rate ns, rounded down; rounded periods are never accumulated. If the thread
 * wakes after the next due time, the ticks in between are skipped: the phase is kept, and two ticks
 * never run between one due time and the next. */
typedef struct {
    int64_t t0_ns;    /* on CLOCK_MONOTONIC */
    int64_t shift_ns; /* sum of all trims */
    uint32_t rate_hz; /* ticks per second */
    int32_t clock;    /* enum rthyb_clock */
    uint32_t stop, bell;
    uint64_t granted, missed,
        missed_taken; /* stepped: ticks granted and missed, and those already processed */
    uint64_t elapsed, executed, skipped, longest_skip;
    rthyb_latency wake;   /* host, link: wake-up after the due time of the awaited tick */
    int64_t asleep_ns;    /* rthyb_asleep_ns at the last call of _slept_ns, */
    int32_t asleep_known; /* if there was one */
} rthyb_ticker;

typedef struct {
    uint64_t k;
    uint64_t skipped; /* ticks directly before k that were not executed */
    int64_t due_ns;   /* due time of tick k; woken_ns - due_ns is less than a period */
    int64_t woken_ns; /* stepped: due_ns */
} rthyb_tick;

/* executed + skipped == elapsed after every tick. When read from another thread while the ticker runs,
 * the values may belong to two successive ticks. */
typedef struct {
    uint64_t elapsed, executed, skipped, longest_skip;
} rthyb_ticker_counts;

/* Returns 0, or RTHYB_E_PERIOD for an unknown clock, a rate out of range, or a t0 before the zero of the clock. */
int rthyb_ticker_init(rthyb_ticker *ticker, int32_t clock, uint32_t rate_hz, int64_t t0_ns);
/* Ticks per second for a period, if this is an integer within the ticker's range; otherwise 0. */
uint32_t rthyb_ticker_rate_hz(double period_s);
/* 200 ppm of one period, to the nearest ns: 195 at 1024 Hz. */
int64_t rthyb_ticker_trim_max_ns(uint32_t rate_hz);
int64_t rthyb_ticker_due_ns(const rthyb_ticker *ticker, uint64_t k);
/* Waits for the next tick, regardless of signals. 1: next tick; 0: the ticker was stopped. */
int rthyb_ticker_wait(rthyb_ticker *ticker, rthyb_tick *tick);
/* The part of _wait after waiting: determines the tick at now_ns. */
void rthyb_ticker_woken(rthyb_ticker *ticker, int64_t now_ns, rthyb_tick *tick);
/* Executes the next tick at once, at the request of the calling thread. */
void rthyb_ticker_step(rthyb_ticker *ticker, rthyb_tick *tick);
/* Shifts all later due times, by at most _trim_max_ns per call and once per tick. To be called from the
 * ticker's own thread; used to follow the drive's clock. */
void rthyb_ticker_trim(rthyb_ticker *ticker, int64_t ns);
/* From any thread, stepped clock: allows more ticks to run; makes the next tick skip some ticks first. */
void rthyb_ticker_grant(rthyb_ticker *ticker, uint64_t ticks);
void rthyb_ticker_miss(rthyb_ticker *ticker, uint64_t ticks);
/* From any thread; cannot be undone: _wait returns 0 within one period. */
void rthyb_ticker_stop(rthyb_ticker *ticker);
void rthyb_ticker_read(const rthyb_ticker *ticker, rthyb_ticker_counts *counts);
int64_t rthyb_now_ns(void); /* CLOCK_MONOTONIC */
/* Time for which the PC has been suspended since it was booted; CLOCK_MONOTONIC stood still meanwhile. */
int64_t rthyb_asleep_ns(void);
/* The same since the previous call; once per tick, from the ticker's own thread. The first call returns 0. */
int64_t rthyb_ticker_slept_ns(rthyb_ticker *ticker);

/* The control loop of the link clock (phase.c). The error is the arrival time of a tick's pair minus the
 * desired time, which is lead_ns before the tick. */
typedef struct {
    double lead_ns;
    double period_ns, trim_max_ns;
    double per_tick; /* angular natural frequency of the control loop times the period */
    double smoothing, trim_memory; /* averaging lengths of the displayed error and trim, in ticks */
    uint32_t silence, near_ticks;  /* limits for `silent` and `near`, as in phase.c */
    uint32_t way_from, way_to;
    double error_ns; /* smoothed */
    double drift_ns; /* integral part: by how much the drive's clock is slow, ns per tick */
    double trim_ns;  /* mean of the last 4 s, ns per tick */
    double carry_ns; /* remainder of the trim, less than 1 ns */
    double mark_ns;  /* error when measuring the speed of approach began */
    uint32_t ticks;  /* since following began, or since the speed of approach was evaluated */
    uint32_t silent; /* consecutive ticks without a pair */
    uint32_t near;   /* consecutive ticks with a small error */
    int32_t following;
    int32_t locked; /* the error has been small for a quarter of a second */
} rthyb_phase;

/* 0, or RTHYB_E_PERIOD if the rate is outside the ticker's range, or the lead outside 10 us to half a period. */
int rthyb_phase_init(rthyb_phase *phase, uint32_t rate_hz, double lead_ns);
/* Index of the arrival, among `count` >= 1 arrivals of successive pairs, whose phase within the period is closest to
 * all the others. Late arrivals do not affect the result as long as they are fewer than half. */
uint32_t rthyb_phase_typical(const rthyb_phase *phase, const int64_t *arrived_ns, uint32_t count);
/* Call once per executed tick. came != 0: the tick used a pair that arrived after_due_ns after its due time
 * (usually before it, so that the value is negative). Returns the argument for rthyb_ticker_trim, within
 * +-rthyb_ticker_trim_max_ns. A tick without a pair, or with an outlier, has almost no effect. */
int64_t rthyb_phase_step(rthyb_phase *phase, int came, double after_due_ns);

/* What a thread has obtained, as confirmed by the kernel. */
enum rthyb_privilege {
    RTHYB_P_FIFO = 1,    /* SCHED_FIFO at the requested priority */
    RTHYB_P_CPU = 2,     /* bound to a single processor */
    RTHYB_P_MEMORY = 4,  /* all pages of the process locked, present and future */
    RTHYB_P_AWAKE = 8,   /* processors do not sleep: /dev/cpu_dma_latency held at 0 */
    RTHYB_P_SIGNALS = 16 /* all signals blocked */
};

/* Makes the calling thread, and no other, as punctual as the system permits. priority 0 does not change
 * the scheduling, cpu -1 not the processor; latency_fd: /dev/cpu_dma_latency, to which the caller wrote 0 and
 * which it keeps open, or -1. Touches stack_bytes of the stack, which must be available. */
uint32_t rthyb_thread_become_real_time(int32_t priority, int32_t cpu, int32_t latency_fd,
                                       size_t stack_bytes);
/* Undoes RTHYB_P_MEMORY for the whole process. */
void rthyb_memory_unlock(void);

/* What the system did to a thread. */
typedef struct {
    uint64_t major_faults, minor_faults;
    uint64_t waits;       /* times it yielded the processor */
    uint64_t preemptions; /* times it was preempted */
} rthyb_usage;

/* For the calling thread, since it began. */
void rthyb_thread_usage(rthyb_usage *usage);

enum rthyb_payload {
    RTHYB_PAYLOAD_NONE,
    RTHYB_PAYLOAD_SAMPLE,  /* one sample of controller and virtual rig */
    RTHYB_PAYLOAD_EXCHANGE /* the rig in a separate thread, connected by an AF_UNIX socket pair */
};

typedef struct {
    rthyb_ticker ticker;
    rthyb_latency sent;  /* from wake-up until the command was sent; empty without a payload */
    uint32_t privileges; /* enum rthyb_privilege */
    uint64_t lost;       /* exchange: ticks without a fresh pair */
    uint64_t not_sent;   /* exchange: commands not sent because the queue was full */
    rthyb_usage usage;   /* from the first tick to the last */
} rthyb_timing;

/* Set up by the caller, with all other members zero. Without a payload, controller, rig and excitation are
 * not needed. */
typedef struct {
    int32_t payload;         /* enum rthyb_payload */
    int32_t priority;        /* of the three threads; see rthyb_thread_become_real_time */
    int32_t cpu, latency_fd; /* cpu: of the two measured threads */
    uint32_t rate_hz;        /* of both threads */
    uint64_t ticks;
    rthyb_controller *controller;
    rthyb_rig *rig;
    const double *excitation; /* repeated as long as the run lasts */
    size_t excitation_count;
    rthyb_ring *ring;       /* receives the record of every sample; NULL: no ring */
    rthyb_timing measured;  /* thread with the payload */
    rthyb_timing reference; /* bare thread, half a period later, at the same time */
    uint32_t stop;
} rthyb_jitter;

/* Starts the threads and waits for them to end. Returns 0, or the errno of a call that failed; EINVAL for a rate
 * outside the ticker's range, or a payload without its parts. */
int rthyb_jitter_run(rthyb_jitter *jitter);
/* From any thread: ends the run early. */
void rthyb_jitter_stop(rthyb_jitter *jitter);
/* cffi: end */

#endif
