/* What the tick keeps between two ticks (loop.c): nobody's business but its own, and that of the tests that
 * run it under sanitizers. */
#ifndef RTHYB_LOOP_STATE_H
#define RTHYB_LOOP_STATE_H

#include "abreast.h"
#include "rthyb.h"

/* A set of parameters on its way from the operator's side to the tick. */
typedef struct {
    uint64_t stamp; /* odd while it is being written; 0: none yet */
    uint64_t taken; /* the tick's own: stamp of the set that it took last */
    uint64_t words[RTHYB_PARAMETER_WORDS];
} rthyb_handover;

/* Neither waits. _read: 1 for a set that is new; one half written is left for the next time. */
void rthyb_handover_write(rthyb_handover *handover, const rthyb_parameters *parameters);
int rthyb_handover_read(rthyb_handover *handover, rthyb_parameters *parameters);

/* What the tick keeps of one axis. */
typedef struct {
    int64_t delay;       /* as in rthyb_feedback, of the last fresh pair; for any thread */
    int32_t usual_delay; /* the same at rest, before the test */
    uint32_t unsent;     /* commands in a row that the link did not take */
    int64_t arrived_ns;  /* when the newest pair did, on CLOCK_MONOTONIC */
    uint64_t downs_seen; /* of the link's times_down */
    int64_t offset;      /* drive's count - tick */
    int64_t offset_seen; /* another one, and in which of the last ticks */
    uint64_t vote_map[RTHYB_SLIP_WINDOW / 64];
    uint64_t voted; /* ticks that had a say */
    int32_t offset_known, votes;
    double taken_cmd_m, offered_x_m; /* what another one told it last, and where it stood then */
    int32_t beyond;                  /* the wire could not hold the last command */
    int32_t stale; /* samples by which commands may arrive later than they did at rest */
} rthyb_loop_way;

struct rthyb_loop {
    rthyb_loop_config cfg; /* as it was given, but for what a load has put in its place */
    int32_t axis_count;
    uint32_t rate_hz; /* of the station that it began with, and of all that come after it */
    uint32_t heartbeat_ticks, watchdog_ticks;
    int64_t half_period_ns;
    rthyb_ticker ticker;
    rthyb_latency sent; /* host clock: from wake-up to the commands being sent */
    rthyb_loop_counters counters;
    rthyb_record records[RTHYB_BLIND_MAX + 1]; /* of the last tick, record_count of them */
    uint32_t record_count;
    uint64_t delays[RTHYB_LINK_DELAYS]; /* fresh pairs of RUNNING by their delay; for any thread */
    /* The same as words that any thread may read. */
    uint64_t state, cause, cause_tick;
    /* Of the link clock, to be read by any thread: error of the arrival, trim in parts per 1e9. */
    int64_t arrival_error_ns, trim_ppb;
    uint64_t locked;
    rthyb_phase phase;
    rthyb_handover handover;
    uint32_t generation; /* of the last set that was published */
    uint64_t set_answer; /* of the last set that a tick saw: generation << 1 | refused */
    /* Mailbox: generation << 8 | command, and what became of it: generation << 8 | refused. */
    uint64_t mail, answer, answer_tick;
    rthyb_load load;
    uint64_t loads, load_answer; /* generation of the load; what became of it: << 1 | refused */
    uint64_t load_tick; /* of the loop: where tick 0 of the station is that was taken last */
    uint64_t heartbeat, heard, silence; /* word of the other side, last seen, ticks since */
    int32_t taken_over; /* the station has not ticked yet, and another one's last command was */
    int32_t
        offered; /* taken_cmd_m, to the first sound reading, as long as the drives read offered_x_m */
    abreast abreast;   /* the drives' counts, of several axes, */
    int32_t apart;     /* and what the last tick that had them all says of them */
    int32_t overheard; /* link clock: more came before this tick than it listens to */
    int32_t priority, cpu, latency_fd; /* of the thread, as in rthyb_thread_become_real_time */
    uint32_t privileges;               /* obtained: enum rthyb_privilege */
    rthyb_usage usage;                 /* of the thread, from the first tick to the last */
    uint64_t thread;
    rthyb_loop_way way[RTHYB_COUPLED_MAX];
};

#endif
