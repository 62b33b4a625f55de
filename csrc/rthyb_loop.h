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
    RTHYB_HEARTBEAT_TICKS = 1024, /* of 1/1024 s without a heartbeat until RAMP_OUT */
    RTHYB_SLIP_WINDOW = 256,      /* ticks with a punctual pair, of which */
    RTHYB_SLIP_VOTES = 192,       /* this many with a different count are a slip */
    /* Link clock: wake-ups in one tick; a serial line may wake the thread for each byte. */
    RTHYB_WAKE_UPS_MAX = 2 * (RTHYB_SERIAL_FEEDBACK + 4 * RTHYB_EXTRAS_MAX),
    RTHYB_LINK_DELAYS =
        256, /* histogram of link delays in samples; the last bucket includes larger ones */
    RTHYB_OLD_PIECES_MAX = 4096 /* discarded before the first tick */
};

/* Conversion between numbers on the wire and those of the structure: sign, scale and offset of the sensors,
 * and similitude. With all gains 1 and offsets 0, values are unchanged. */
typedef struct {
    double x_gain, x_offset_m;     /* x = x_gain wire + x_offset_m */
    double f_gain, f_offset_n;     /* f = f_gain wire + f_offset_n */
    double cmd_gain, cmd_offset_m; /* wire = cmd_gain x + cmd_offset_m */
} rthyb_calibration;

/* 0; RTHYB_E_LIMIT if the magnitude of a gain is outside 1e-9 to 1e9, or if an offset is implausible. */
int rthyb_calibration_check(const rthyb_calibration *calibration);

/* May be read while the loop runs. */
typedef struct {
    uint64_t records;
    uint64_t sent;            /* commands */
    uint64_t not_sent;        /* commands that the link did not accept */
    uint64_t down;            /* ticks with the link down */
    uint64_t stopped;         /* ticks in which the drive last reported that it has stopped */
    uint64_t late_heartbeats; /* ticks */
    uint64_t refused;         /* operator's commands */
    uint64_t slips;           /* lasting changes of (drive's count - tick) */
    uint64_t wake_ups;        /* link clock: wake-ups by received data, in addition to the ticks */
    uint64_t parameters;      /* sets taken */
    uint64_t parameters_refused; /* sets that would switch off a limit during a motion */
    uint64_t beyond;             /* commands that the wire could not represent */
    uint64_t old;                /* pieces that arrived before the first tick and were discarded */
    uint64_t belated;            /* pairs not used because the drive followed outdated commands */
    uint64_t suspended;          /* number of times the PC was suspended between two ticks */
} rthyb_loop_counters;

/* The way to the drive of one axis and back. */
typedef struct {
    rthyb_wire *wire;
    rthyb_link *link;
    rthyb_calibration calibration;
} rthyb_loop_axis;

/* What a loop is made of: set up by the caller, who keeps it alive and leaves all but the counters alone
 * while the thread runs. */
typedef struct {
    rthyb_station *station;
    rthyb_loop_axis axis[RTHYB_COUPLED_MAX]; /* as many as the station has */
    rthyb_ring *ring;                        /* NULL: no ring */
    const double *ag_mps2;                   /* ground motion of the test */
    size_t ag_count;
    int32_t clock;   /* enum rthyb_clock */
    int32_t unpaced; /* stepped clock: the drive does not wait for its ticks */
    double lead_ns;  /* link clock: the first axis' pair arrives so long before the tick */
} rthyb_loop_config;

/* What a drive was told last, where it stood then, both without tare, and the seq that it was told it with. */
typedef struct {
    double x_cmd_m, x_m;
    uint32_t seq;
} rthyb_last_command;

/* What a loop continues with: another test on the same link. */
typedef struct {
    rthyb_station *station;
    rthyb_ring *ring; /* NULL: no ring */
    const double *ag_mps2;
    size_t ag_count;
} rthyb_load;

/* State of a loop that any thread may read at any time; each number is consistent in itself, but two may belong to
 * successive ticks. */
typedef struct {
    uint64_t state, cause, cause_tick; /* of the station, after the last tick */
    uint64_t load_tick;                /* where tick 0 of the station is that was taken last */
    int64_t began_ns;                  /* CLOCK_MONOTONIC at due_ns 0; stepped clock: 0 */
    int64_t arrival_error_ns;          /* link clock: after the wanted instant, smoothed; */
    int64_t trim_ppb;                  /* by how much the period is lengthened; */
    uint64_t locked;                   /* whether the ticks follow the drive's samples */
    int64_t delay[RTHYB_COUPLED_MAX];  /* as in rthyb_feedback, of each axis' last fresh pair */
} rthyb_loop_view;

/* The tick: link -> wire -> station -> wire -> link -> record -> ring. */
typedef struct rthyb_loop rthyb_loop;

size_t rthyb_loop_size(void); /* bytes, aligned as a double is; the caller's */

/* The station's period is the loop's. 0; RTHYB_E_PERIOD for one of no ticker (rthyb_ticker_rate_hz), an unknown
 * clock, or a lead that the link clock refuses; RTHYB_E_LIMIT for a calibration, or a ring for rows of another
 * number of axes. */
int rthyb_loop_init(rthyb_loop *loop, const rthyb_loop_config *cfg);
/* Parts that may be read while the loop runs; the ticker can also be used to grant, miss and stop ticks. */
void rthyb_loop_look(const rthyb_loop *loop, rthyb_loop_view *view);
const rthyb_loop_counters *rthyb_loop_counted(const rthyb_loop *loop);
const uint64_t *rthyb_loop_delays(const rthyb_loop *loop); /* RTHYB_LINK_DELAYS pairs of RUNNING */
const rthyb_latency *rthyb_loop_sent(const rthyb_loop *loop); /* from wake-up to the command sent */
rthyb_ticker *rthyb_loop_ticker(rthyb_loop *loop);
/* Records of the last tick, *count of them; not to be called while a thread runs. */
const rthyb_record *rthyb_loop_records(const rthyb_loop *loop, uint32_t *count);
/* For the thread, after its end: its privileges (enum rthyb_privilege) and its system usage. */
uint32_t rthyb_loop_ended(const rthyb_loop *loop, rthyb_usage *usage);
/* What an earlier loop at these links told the drives last, one of each axis: a drive that still follows takes
 * no seq that is older. Holds if the first sound readings, and each before them, are the same within
 * rest_spread_m and no drive has stopped meanwhile: then the commands go on from there. Else, as without this
 * call, they begin at the readings; x_m = NaN asks for that. Before the start. */
void rthyb_loop_go_on(rthyb_loop *loop, const rthyb_last_command *last);
/* What rthyb_loop_go_on of the next one is to be given, once this one has ended; 0: nothing was ever sent, or
 * it did not end at rest. */
int rthyb_loop_last(const rthyb_loop *loop, rthyb_last_command *last);
/* Drops what waits in the links, RTHYB_OLD_PIECES_MAX pieces each at most: it was sent to somebody else, or long
 * ago. Stepped clock: before the first tick, on the caller's word; the others do it by themselves. */
void rthyb_loop_drop_old(rthyb_loop *loop);
/* Executes one tick on the calling thread, for the stepped clock. */
void rthyb_loop_step(rthyb_loop *loop);
/* A thread that ticks until rthyb_ticker_stop, as punctual as rthyb_thread_become_real_time makes it; 0 or
 * errno. But for the stepped clock the first tick is due a little later than now. */
int rthyb_loop_start(rthyb_loop *loop, int32_t priority, int32_t cpu, int32_t latency_fd);
/* Waits for the thread to end. */
int rthyb_loop_join(rthyb_loop *loop);
/* Once more the last commands, with RTHYB_TOLD_LEAVING; 0 if not all were sent: not at rest, nothing sent ever,
 * or a link did not take it. After the thread's end. */
int rthyb_loop_leave(rthyb_loop *loop);
/* Queues an operator's command for the next tick; one thread at a time. Returns its generation, or 0 while the
 * previous one has not been answered; only RTHYB_CMD_TRIP replaces that one. */
uint64_t rthyb_loop_command(rthyb_loop *loop, int32_t command);
/* 0: not answered yet; 1: obeyed; 2: refused. *tick is the tick of the answer. */
int rthyb_loop_answered(const rthyb_loop *loop, uint64_t generation, uint64_t *tick);
/* Has the next tick go on with another station, ring and ground motion; ticks, wires, links and what is
 * known of the drives' clocks stay. Refused unless the station that goes is in IDLE, and the other has as many
 * axes and the same period; the same station may get another ring in any state. A ring for rows of another number of
 * axes is refused always. One thread at a time, and one load. Returns its generation. */
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
/* Heartbeat of the operator's side. */
void rthyb_loop_beat(rthyb_loop *loop);

typedef struct {
    const rthyb_codec *codec; /* that sent the commands; NULL: no wire, they left as computed */
    rthyb_calibration calibration; /* of the commands */
} rthyb_replay_axis;

/* What a recording is replayed from: all its rows, from the station's first tick on, of as many axes as the
 * station has. */
typedef struct {
    const void *rows;
    size_t count;
    const double *ag_mps2; /* as in rthyb_loop */
    size_t ag_count;
    rthyb_replay_axis axis[RTHYB_COUPLED_MAX];
    const rthyb_parameters *parameters; /* every set but that of generation 0 */
    size_t parameter_count;
} rthyb_replay;

/* Through a fresh station; what the clock and the link added to the rows is copied. Returns how many
 * rows came out: fewer than count where the rows do not make ticks. */
size_t rthyb_station_replay(rthyb_station *station, const rthyb_replay *source, void *out);
/* cffi: end */

#endif
