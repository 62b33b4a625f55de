/* Time: histograms (latency.c), the clock (ticker.c), real-time threads (thread.c), and whether a
 * PC is punctual (jitter.c). */
#ifndef RTHYB_PART_TIME_H
#define RTHYB_PART_TIME_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_controller.h"
#include "rthyb_ring.h"

/* cffi: begin */

/* The one part of the core that waits and, for measuring, starts threads. All of it without
 * allocation, and none of it is reached from a _step function. */

enum rthyb_time_size {
    RTHYB_LATENCY_BUCKETS = 1024, /* and one more for what is longer than 2^36 ns */
    RTHYB_TRIM_MAX_NS = 195       /* 200 ppm of one period */
};

/* Histogram of times in ns: every ns of its own below 32, then 32 buckets to each doubling (3 %).
 * One thread records; any thread may read at the same time and sees each number whole. */
typedef struct {
    uint64_t count, sum_ns, max_ns;
    uint64_t bucket[RTHYB_LATENCY_BUCKETS + 1]; /* the last one: 2^36 ns (69 s) and longer */
} rthyb_latency;

/* Less than zero counts as zero. */
void rthyb_latency_record(rthyb_latency *latency, int64_t ns);
/* What the fraction of the times recorded did not exceed: never less than the true value, at most
 * 3 % more. 0 while there is none. */
uint64_t rthyb_latency_percentile(const rthyb_latency *latency, double fraction);
/* Shortest time of a bucket; of bucket i + 1: where bucket i ends. */
uint64_t rthyb_latency_edge_ns(uint32_t bucket);
/* Adds what from has seen; into a zeroed one: a copy of one that is in use. */
void rthyb_latency_merge(rthyb_latency *into, const rthyb_latency *from);

enum rthyb_clock {
    RTHYB_CLOCK_HOST,    /* CLOCK_MONOTONIC */
    RTHYB_CLOCK_STEPPED, /* no wall clock: a tick comes on the caller's word */
    RTHYB_CLOCK_LINK     /* CLOCK_MONOTONIC, trimmed by a loop to the drive's samples */
};

/* Tick k is due at t0 + k 1953125/2 ns, rounded down; a rounded period is never added up. Woken
 * later than the next due time, the ticks in between are skipped: phase is kept, and no two ticks
 * ever run between one due time and the next. */
typedef struct {
    int64_t t0_ns;    /* on CLOCK_MONOTONIC */
    int64_t shift_ns; /* sum of all trims */
    int32_t clock;    /* enum rthyb_clock */
    uint32_t stop, bell;
    uint64_t granted, missed, missed_taken; /* stepped: what was said, and how much of it is done */
    uint64_t elapsed, executed, skipped, longest_skip;
    rthyb_latency wake;   /* host, link: woken after the due time of the tick that was waited for */
    int64_t asleep_ns;    /* rthyb_asleep_ns when _slept_ns was last asked, */
    int32_t asleep_known; /* if it ever was */
} rthyb_ticker;

typedef struct {
    uint64_t k;
    uint64_t skipped; /* ticks just before k that nobody executed */
    int64_t due_ns;   /* of tick k; woken_ns - due_ns is less than a period */
    int64_t woken_ns; /* stepped: due_ns */
} rthyb_tick;

/* executed + skipped == elapsed after every tick; read from another thread while the ticker runs,
 * they may be those of two successive ticks. */
typedef struct {
    uint64_t elapsed, executed, skipped, longest_skip;
} rthyb_ticker_counts;

/* Refuses an unknown clock and a t0 before the clock's own zero with RTHYB_E_PERIOD. */
int rthyb_ticker_init(rthyb_ticker *ticker, int32_t clock, int64_t t0_ns);
int64_t rthyb_ticker_due_ns(const rthyb_ticker *ticker, uint64_t k);
/* Waits for the next tick, signals or not. 1: here it is; 0: the ticker was stopped. */
int rthyb_ticker_wait(rthyb_ticker *ticker, rthyb_tick *tick);
/* What _wait does after waiting: which tick is it at now_ns? */
void rthyb_ticker_woken(rthyb_ticker *ticker, int64_t now_ns, rthyb_tick *tick);
/* Takes the next tick without waiting, on the word of the calling thread. */
void rthyb_ticker_step(rthyb_ticker *ticker, rthyb_tick *tick);
/* Moves all later due times; at most RTHYB_TRIM_MAX_NS a call, once a tick. For a ticker's own
 * thread: what follows the drive's clock. */
void rthyb_ticker_trim(rthyb_ticker *ticker, int64_t ns);
/* From any thread. Stepped: lets so many more ticks run; has the next one skip so many first. */
void rthyb_ticker_grant(rthyb_ticker *ticker, uint64_t ticks);
void rthyb_ticker_miss(rthyb_ticker *ticker, uint64_t ticks);
/* From any thread, for good: _wait returns 0 within a period. */
void rthyb_ticker_stop(rthyb_ticker *ticker);
void rthyb_ticker_read(const rthyb_ticker *ticker, rthyb_ticker_counts *counts);
int64_t rthyb_now_ns(void); /* CLOCK_MONOTONIC */
/* For how long the PC has been suspended since it was switched on: that clock stood still then. */
int64_t rthyb_asleep_ns(void);
/* For how long since it was asked before: once a tick, by the ticker's own thread. First time: 0. */
int64_t rthyb_ticker_slept_ns(rthyb_ticker *ticker);

/* The link clock's loop (phase.c). Error is how long after the instant that is lead_ns before the
 * tick the pair of that tick arrived. */
typedef struct {
    double lead_ns;
    double error_ns; /* smoothed */
    double drift_ns; /* the integral: what the drive's clock is slow, ns a tick */
    double trim_ns;  /* mean of the last 4 s, ns a tick */
    double carry_ns; /* of the trim, less than one */
    double mark_ns;  /* error when the speed of approach began to be measured */
    uint32_t ticks;  /* since pairs began to be followed, or the speed of approach was looked at */
    uint32_t silent; /* ticks without a pair, in a row */
    uint32_t near;   /* ticks in a row with a small error */
    int32_t following;
    int32_t locked; /* the error has been small for a quarter of a second */
} rthyb_phase;

/* 0, or RTHYB_E_PERIOD for a lead beyond 10 us to half a period. */
int rthyb_phase_init(rthyb_phase *phase, double lead_ns);
/* Once an executed tick. came != 0: the tick took a pair that arrived so long after its due time (mostly
 * before it: less than 0). Returns what rthyb_ticker_trim is to be given: never more than
 * RTHYB_TRIM_MAX_NS either way. A tick without a pair, or with an outlier, changes next to nothing. */
int64_t rthyb_phase_step(rthyb_phase *phase, int came, double after_due_ns);

/* What a thread has obtained, by the kernel's answer and not by what was asked for. */
enum rthyb_privilege {
    RTHYB_P_FIFO = 1,    /* SCHED_FIFO at the priority asked for */
    RTHYB_P_CPU = 2,     /* runs on its one processor only */
    RTHYB_P_MEMORY = 4,  /* all pages of the process locked, present and future */
    RTHYB_P_AWAKE = 8,   /* processors do not sleep: /dev/cpu_dma_latency held at 0 */
    RTHYB_P_SIGNALS = 16 /* all of them blocked */
};

/* Makes the calling thread, and no other, as punctual as the system lets it. priority 0 leaves the
 * scheduling alone, cpu -1 the processor; latency_fd: /dev/cpu_dma_latency with 0 written to it and
 * kept open by the caller, or -1. Touches stack_bytes of stack, which must be there. */
uint32_t rthyb_thread_become_real_time(int32_t priority, int32_t cpu, int32_t latency_fd,
                                       size_t stack_bytes);
/* Undoes what RTHYB_P_MEMORY did to the whole process. */
void rthyb_memory_unlock(void);

/* What the system did to a thread. */
typedef struct {
    uint64_t major_faults, minor_faults;
    uint64_t waits;       /* times it gave the processor away itself */
    uint64_t preemptions; /* times it was taken away */
} rthyb_usage;

/* Of the calling thread since it began. */
void rthyb_thread_usage(rthyb_usage *usage);

enum rthyb_payload {
    RTHYB_PAYLOAD_NONE,
    RTHYB_PAYLOAD_SAMPLE,  /* one sample of controller and virtual rig */
    RTHYB_PAYLOAD_EXCHANGE /* the rig in a thread of its own, behind an AF_UNIX socket pair */
};

typedef struct {
    rthyb_ticker ticker;
    rthyb_latency sent;  /* from wake-up to the command being sent; without payload empty */
    uint32_t privileges; /* enum rthyb_privilege */
    uint64_t lost;       /* exchange: ticks without a fresh pair */
    uint64_t not_sent;   /* exchange: commands for which there was no room */
    rthyb_usage usage;   /* from the first tick to the last */
} rthyb_timing;

/* Set up by the caller, everything not named here zeroed. Without payload neither controller nor
 * rig nor excitation is needed. */
typedef struct {
    int32_t payload;         /* enum rthyb_payload */
    int32_t priority;        /* of the three threads, as in rthyb_thread_become_real_time */
    int32_t cpu, latency_fd; /* cpu of the two that are timed */
    uint64_t ticks;          /* 1024 a second */
    rthyb_controller *controller;
    rthyb_rig *rig;
    const double *excitation; /* repeated as long as the run lasts */
    size_t excitation_count;
    rthyb_ring *ring;       /* takes the record of every sample; NULL: none does */
    rthyb_timing measured;  /* carries the payload */
    rthyb_timing reference; /* bare, half a period later, in the same seconds */
    uint32_t stop;
} rthyb_jitter;

/* Starts the threads, waits for their end. 0, or errno of what the system refused. */
int rthyb_jitter_run(rthyb_jitter *jitter);
/* From any thread: ends the run early. */
void rthyb_jitter_stop(rthyb_jitter *jitter);
/* cffi: end */

#endif
