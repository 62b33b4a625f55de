/* State of the loop between two ticks (loop.c). Internal; also used by the tests that run under sanitizers. */
#ifndef RTHYB_LOOP_STATE_H
#define RTHYB_LOOP_STATE_H

#include "abreast.h"
#include "rthyb.h"

/* A set of parameters being passed from the operator's program to the tick. */
typedef struct {
    uint64_t stamp; /* odd while a set is being written; 0: none yet */
    uint64_t taken; /* used by the tick only: stamp of the set that it adopted last */
    uint64_t words[RTHYB_PARAMETER_WORDS];
} rthyb_handover;

/* Neither function waits. _read returns 1 for a new set; a set that is only partly written is left for the next
 * call. */
void rthyb_handover_write(rthyb_handover *handover, const rthyb_parameters *parameters);
int rthyb_handover_read(rthyb_handover *handover, rthyb_parameters *parameters);

/* State of the loop for one axis. */
typedef struct {
    int64_t delay;       /* as in rthyb_feedback, for the last new pair; any thread may read it */
    int32_t usual_delay; /* the same at rest, before the test */
    uint32_t unsent;     /* consecutive commands that the link did not accept */
    int64_t arrived_ns;  /* arrival of the newest pair, on CLOCK_MONOTONIC */
    uint64_t downs_seen; /* last value of the link's times_down */
    int64_t offset;      /* drive's count - tick */
    int64_t offset_seen; /* a different offset, and the recent ticks in which it was found */
    uint64_t vote_map[RTHYB_SLIP_WINDOW / 64];
    uint64_t voted; /* ticks evaluated */
    int32_t offset_known, votes;
    /* last command of an earlier program, and the reading at that time */
    double taken_cmd_m, offered_x_m;
    int32_t beyond; /* the wire could not represent the last command */
    int32_t stale;  /* samples by which commands may arrive later than at rest */
} rthyb_loop_way;

struct rthyb_loop {
    rthyb_loop_config cfg; /* as given by the caller, except for parts replaced by a load */
    int32_t axis_count;
    uint32_t rate_hz; /* of the first station and of all later ones */
    uint32_t heartbeat_ticks, watchdog_ticks;
    int64_t half_period_ns;
    rthyb_ticker ticker;
    rthyb_latency sent; /* host clock: from wake-up to the commands being sent */
    rthyb_loop_counters counters;
    rthyb_record records[RTHYB_BLIND_MAX + 1]; /* of the last tick, record_count of them */
    uint32_t record_count;
    /* new pairs in RUNNING by their delay; any thread may read it */
    uint64_t delays[RTHYB_LINK_DELAYS];
    /* As in rthyb_loop_view; any thread may read them. */
    uint64_t state, cause, cause_tick;
    /* Link clock: error of the arrival, trim in parts per 1e9; any thread may read them. */
    int64_t arrival_error_ns, trim_ppb;
    uint64_t locked;
    rthyb_phase phase;
    rthyb_handover handover;
    uint32_t generation; /* of the last set published */
    uint64_t set_answer; /* for the last set that a tick processed: generation << 1 | refused */
    /* Mailbox: generation << 8 | command, and its answer: generation << 8 | refused. */
    uint64_t mail, answer, answer_tick;
    rthyb_load load;
    uint64_t loads, load_answer; /* generation of the load; its answer: generation << 1 | refused */
    uint64_t load_tick;          /* tick of the loop that was tick 0 of the current station */
    /* counter of the operator's program, its last value seen, ticks since then */
    uint64_t heartbeat, last_beat, silence;
    /* the station has not ticked yet, and an earlier program's commands are in effect */
    int32_t taken_over;
    /* taken_cmd_m is used at the first valid reading, as long as the drives read offered_x_m */
    int32_t offered;
    abreast abreast; /* several axes: the drives' counts, */
    int32_t apart;   /* and the result in the last tick in which all were known */
    int32_t flooded; /* link clock: more wake-ups before this tick than are processed */
    int32_t priority, cpu, latency_fd; /* of the thread, as in rthyb_thread_become_real_time */
    uint32_t privileges;               /* obtained: enum rthyb_privilege */
    rthyb_usage usage;                 /* of the thread, from the first tick to the last */
    uint64_t thread;
    rthyb_loop_way way[RTHYB_COUPLED_MAX];
};

#endif
