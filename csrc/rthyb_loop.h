/* The tick: link, wire, station and ring in one thread (loop.c, calibration.c). */
#ifndef RTHYB_PART_LOOP_H
#define RTHYB_PART_LOOP_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_link.h"
#include "rthyb_parameters.h"
#include "rthyb_ring.h"
#include "rthyb_time.h"

/* cffi: begin */

enum rthyb_loop_size {
    RTHYB_HEARTBEAT_TICKS = 1024, /* of silence, then RAMP_OUT */
    RTHYB_SLIP_WINDOW = 256,      /* ticks with a pair that came in time, in which */
    RTHYB_SLIP_VOTES = 192,       /* so many see another count: a slip */
    /* Link clock, by what comes in one tick: a serial line may wake for each byte. */
    RTHYB_WAKE_UPS_MAX = 2 * RTHYB_SERIAL_FEEDBACK,
    RTHYB_LINK_DELAYS = 256,    /* what the link may delay, samples; the last one: that and more */
    RTHYB_OLD_PIECES_MAX = 4096 /* dropped before the first tick */
};

/* Between the numbers on the wire and the structure's own: what sensors are mounted the other way
 * round, scaled or offset, and the similitude. All gains 1 and offsets 0: exactly nothing changes. */
typedef struct {
    double x_gain, x_offset_m;     /* x = x_gain wire + x_offset_m */
    double f_gain, f_offset_n;     /* f = f_gain wire + f_offset_n */
    double cmd_gain, cmd_offset_m; /* wire = cmd_gain x + cmd_offset_m */
} rthyb_calibration;

/* 0; RTHYB_E_LIMIT for a gain that is not within 1e-9 to 1e9 either way, or an offset beyond any
 * sense. */
int rthyb_calibration_check(const rthyb_calibration *calibration);

/* May be read while the loop runs. */
typedef struct {
    uint64_t records;
    uint64_t sent;               /* commands */
    uint64_t not_sent;           /* commands that the link did not take */
    uint64_t down;               /* ticks with the link down */
    uint64_t stopped;            /* ticks in which the drive's last word was that it has stopped */
    uint64_t late_heartbeats;    /* ticks */
    uint64_t refused;            /* operator's commands */
    uint64_t slips;              /* lasting changes of (drive's count - tick) */
    uint64_t wake_ups;           /* link clock: by what came, beside the ticks */
    uint64_t parameters;         /* sets taken */
    uint64_t parameters_refused; /* sets that switch a limit off while something moves */
    uint64_t beyond;             /* commands that the wire could not hold */
    uint64_t old;                /* pieces that had come before the first tick: dropped */
    uint64_t belated;   /* pairs not taken: the drive acted on commands that had become old */
    uint64_t suspended; /* times that the PC was asleep between two ticks */
} rthyb_loop_counters;

/* A set of parameters on its way from the operator's side to the tick. */
typedef struct {
    uint64_t stamp; /* odd while it is being written; 0: none yet */
    uint64_t taken; /* the tick's own: stamp of the set that it took last */
    uint64_t words[RTHYB_PARAMETER_WORDS];
} rthyb_handover;

/* What a loop goes on with: another test at the same link. */
typedef struct {
    rthyb_station *station;
    rthyb_ring *ring; /* NULL: no ring */
    const double *ag_mps2;
    size_t ag_count;
} rthyb_load;

/* The tick: link -> wire -> station -> wire -> link -> record -> ring. The caller sets up what the
 * pointers point to, and leaves all of it but the counters alone while the thread runs. */
typedef struct {
    rthyb_station *station;
    rthyb_wire *wire;
    rthyb_link *link;
    rthyb_ring *ring;      /* NULL: no ring */
    const double *ag_mps2; /* ground motion of the test */
    size_t ag_count;
    rthyb_calibration calibration;
    double lead_ns; /* link clock: the pair arrives so long before the tick */
    rthyb_ticker ticker;
    rthyb_latency sent; /* host clock: from wake-up to the command being sent */
    rthyb_loop_counters counters;
    rthyb_record records[RTHYB_BLIND_MAX + 1]; /* of the last tick, record_count of them */
    uint32_t record_count;
    int32_t delay;                      /* as in rthyb_feedback, of the last fresh pair */
    int32_t usual_delay;                /* the same at rest, before the test */
    uint32_t unsent;                    /* commands in a row that the link did not take */
    int64_t asleep_ns;                  /* rthyb_asleep_ns at the last tick, */
    int32_t asleep_known;               /* if there was one */
    uint64_t delays[RTHYB_LINK_DELAYS]; /* fresh pairs of RUNNING by that delay; for any thread */
    /* The same as words that any thread may read. */
    uint64_t state, cause, cause_tick;
    /* Of the link clock, to be read by any thread: error of the arrival, trim in parts per 1e9. */
    int64_t arrival_error_ns, trim_ppb;
    uint64_t locked;
    int64_t arrived_ns; /* when the newest pair did, on CLOCK_MONOTONIC */
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
    uint64_t downs_seen;                /* of the link's times_down */
    int64_t offset;                     /* drive's count - tick */
    int64_t offset_seen;                /* another one, and in which of the last ticks */
    uint64_t vote_map[RTHYB_SLIP_WINDOW / 64];
    uint64_t voted; /* ticks that had a say */
    int32_t offset_known, votes;
    int32_t taken_over; /* the station has not ticked yet, and another one's last command was: */
    double taken_cmd_m;
    int32_t offered; /* taken_cmd_m, to the first sound reading, as long as the drive reads: */
    double offered_x_m;
    int32_t unpaced;   /* the caller's: stepped clock, and the drive does not wait for its ticks */
    int32_t beyond;    /* the wire could not hold the last command */
    int32_t overheard; /* link clock: more came before this tick than it listens to */
    int32_t priority, cpu, latency_fd; /* of the thread, as in rthyb_thread_become_real_time */
    uint32_t privileges;               /* obtained: enum rthyb_privilege */
    rthyb_usage usage;                 /* of the thread, from the first tick to the last */
    uint64_t thread;
} rthyb_loop;

/* The members up to lead_ns are the caller's; the rest becomes new. 0; RTHYB_E_PERIOD for an unknown
 * clock, or a lead that the link clock refuses; RTHYB_E_LIMIT for the calibration. */
int rthyb_loop_init(rthyb_loop *loop, int32_t clock);
/* What an earlier loop at this link told the drive last, where that stood then, without tare, and the seq
 * that it was told it with: a drive that still follows takes none that is older. Holds if the first
 * sound reading, and each before it, is the same within rest_spread_m and the drive has not stopped
 * meanwhile: then the command goes on from there. Else, as without this call, it begins at the reading;
 * x_m = NaN asks for that. Before the start. */
void rthyb_loop_go_on(rthyb_loop *loop, double x_cmd_m, double x_m, uint32_t seq);
/* Drops what waits in the link, RTHYB_OLD_PIECES_MAX pieces at most: it was sent to somebody else, or long
 * ago. Stepped clock: before the first tick, on the caller's word; the others do it by themselves. */
void rthyb_loop_drop_old(rthyb_loop *loop);
/* One tick on the calling thread, on its word: the stepped clock. */
void rthyb_loop_step(rthyb_loop *loop);
/* A thread that ticks until rthyb_ticker_stop; 0 or errno. But for the stepped clock the first tick is
 * due a little later than now. */
int rthyb_loop_start(rthyb_loop *loop);
/* Waits for the thread's end. */
int rthyb_loop_join(rthyb_loop *loop);
/* Once more the last command, with RTHYB_TOLD_LEAVING; 0 if none was sent: not at rest, nothing sent ever,
 * or the link did not take it. After the thread's end. */
int rthyb_loop_leave(rthyb_loop *loop);
/* Leaves an operator's command for the next tick; one thread at a time. Returns its generation, 0
 * while the last one is not answered: only RTHYB_CMD_TRIP takes its place. */
uint64_t rthyb_loop_command(rthyb_loop *loop, int32_t command);
/* 0: not answered yet; 1: obeyed; 2: refused. *tick is that of the answer. */
int rthyb_loop_answered(const rthyb_loop *loop, uint64_t generation, uint64_t *tick);
/* Has the next tick go on with another station, ring and ground motion; ticks, wire, link and what is
 * known of the drive's clock stay. Refused unless the station that goes is in IDLE; the same station may
 * get another ring in any state. One thread at a time, and one load. Returns its generation. */
uint64_t rthyb_loop_load(rthyb_loop *loop, const rthyb_load *load);
/* 0: not answered yet; 1: taken, what was there before is no longer touched; 2: refused, what was to be
 * loaded is not touched. */
int rthyb_loop_loaded(const rthyb_loop *loop, uint64_t generation);
/* Publishes a set and gives it its generation; the next tick takes it whole, before anything else. One
 * thread at a time. 0, or RTHYB_E_LIMIT: then nothing is published. */
int rthyb_loop_set_parameters(rthyb_loop *loop, rthyb_parameters *parameters);
/* 0: no tick has seen that set yet; 1: it is in force, or a later one is; 2: it, or a later one, was
 * refused (rthyb_station_adopt), and the set before stays in force. */
int rthyb_loop_set_taken(const rthyb_loop *loop, uint32_t generation);
/* A sign of life of the side that has the operator. */
void rthyb_loop_beat(rthyb_loop *loop);

/* What a recording is replayed from: all its rows, from the station's first tick on. */
typedef struct {
    const rthyb_record *rows;
    size_t count;
    const double *ag_mps2; /* as in rthyb_loop */
    size_t ag_count;
    const rthyb_codec *codec; /* that sent the commands; NULL: no wire, they left as computed */
    rthyb_calibration calibration;      /* of the commands */
    const rthyb_parameters *parameters; /* every set but that of generation 0 */
    size_t parameter_count;
} rthyb_replay;

/* Through a fresh station; what the clock and the link added to the rows is copied. Returns how many
 * rows came out: fewer than count where the rows do not make ticks. */
size_t rthyb_station_replay(rthyb_station *station, const rthyb_replay *source, rthyb_record *out);
/* cffi: end */

#endif
