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
    /* ticks of 1/1024 s without a heartbeat after which RAMP_OUT starts */
    RTHYB_HEARTBEAT_TICKS = 1024,
    RTHYB_SLIP_WINDOW = 256, /* window for detecting a slip, in ticks with a punctual pair */
    RTHYB_SLIP_VOTES = 192,  /* pairs in that window with a shifted count that mean a slip */
    /* Link clock: wake-ups in one tick; a serial line may wake the thread for each byte. */
    RTHYB_WAKE_UPS_MAX = 2 * (RTHYB_SERIAL_FEEDBACK + 4 * RTHYB_EXTRAS_MAX),
    /* histogram of link delays in samples; the last bucket includes larger ones */
    RTHYB_LINK_DELAYS = 256,
    RTHYB_OLD_PIECES_MAX = 4096 /* chunks of received data discarded before the first tick */
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
    uint64_t late_heartbeats; /* ticks with a late heartbeat */
    uint64_t refused;         /* operator's commands refused */
    uint64_t slips;           /* lasting changes of (drive's count - tick) */
    uint64_t wake_ups;        /* link clock: wake-ups by received data, in addition to the ticks */
    uint64_t parameters;      /* sets adopted */
    /* sets refused because they would switch off a limit during motion */
    uint64_t parameters_refused;
    uint64_t beyond;    /* commands that the wire could not represent */
    uint64_t old;       /* chunks of data received before the first tick, and discarded */
    uint64_t belated;   /* pairs not used because the drive followed outdated commands */
    uint64_t suspended; /* number of times the PC was suspended between two ticks */
} rthyb_loop_counters;

/* Connection to the drive of one axis. */
typedef struct {
    rthyb_wire *wire;
    rthyb_link *link;
    rthyb_calibration calibration;
} rthyb_loop_axis;

/* Parts of a loop. The caller sets them up and keeps them valid; while the thread runs, the caller must not access
 * any of them except the counters. */
typedef struct {
    rthyb_station *station;
    /* One per axis of the station; then heard_count drives to which nothing is sent: their feedback is only received,
     * for the sensors without an actuator in it. Displacement and force of each are written to two channels of the row,
     * from heard_channel on. */
    rthyb_loop_axis axis[RTHYB_COUPLED_MAX];
    int32_t heard_count;
    uint32_t heard_channel;
    /* For each of the station's sensors without an actuator: the one of `axis` whose feedback has its reading, and the
     * number of the extra channel there, in m or N. */
    int32_t sensor_axis[RTHYB_SENSORS_ALL];
    uint32_t sensor_extra[RTHYB_SENSORS_ALL];
    rthyb_ring *ring;      /* NULL: no ring */
    const double *ag_mps2; /* ground motion */
    size_t ag_count;
    int32_t clock; /* enum rthyb_clock */
    /* stepped clock: the drive runs on its own clock and does not wait for ticks */
    int32_t unpaced;
    double lead_ns; /* link clock: time by which the first axis' pair arrives before the tick */
} rthyb_loop_config;

/* Last command sent to a drive, the displacement read at that time (both without tare), and the sequence number of
 * the command. */
typedef struct {
    double x_cmd_m, x_m;
    uint32_t seq;
} rthyb_last_command;

/* Another test that a loop continues with on the same links. */
typedef struct {
    rthyb_station *station;
    rthyb_ring *ring; /* NULL: no ring */
    const double *ag_mps2;
    size_t ag_count;
} rthyb_load;

/* State of a loop. Any thread may read it at any time; each number is consistent in itself, but two numbers may
 * belong to successive ticks. */
typedef struct {
    uint64_t state, cause, cause_tick; /* of the station, after the last tick */
    uint64_t load_tick;                /* tick of the loop that was tick 0 of the current station */
    /* value of CLOCK_MONOTONIC that corresponds to due_ns = 0; 0 with the stepped clock */
    int64_t began_ns;
    int64_t arrival_error_ns;         /* link clock: smoothed lateness of the arrivals; */
    int64_t trim_ppb;                 /* change of the period, positive: longer; */
    uint64_t locked;                  /* whether the ticks follow the drive's samples */
    int64_t delay[RTHYB_COUPLED_MAX]; /* as in rthyb_feedback, for the last new pair of each axis */
} rthyb_loop_view;

/* The tick: link -> wire -> station -> wire -> link -> record -> ring. */
typedef struct rthyb_loop rthyb_loop;

size_t rthyb_loop_size(void); /* bytes that the caller provides, aligned for a double */

/* The loop runs at the period of the station. Returns 0; RTHYB_E_KINEMATICS if no axis and no drive that is heard
 * has the extra channel of a sensor without an actuator, the sensor has no range, or the channel cannot carry it
 * (rthyb_extra_reach), or if too many drives are heard; RTHYB_E_PERIOD if no ticker supports the period
 * (rthyb_ticker_rate_hz), the clock is unknown, or the link clock rejects the lead; RTHYB_E_LIMIT for an invalid
 * calibration, or for a ring with a different number of axes. */
int rthyb_loop_init(rthyb_loop *loop, const rthyb_loop_config *cfg);
/* These may be read while the loop runs; the ticker may also be used to grant ticks, to skip them, and to stop. */
void rthyb_loop_look(const rthyb_loop *loop, rthyb_loop_view *view);
const rthyb_loop_counters *rthyb_loop_counted(const rthyb_loop *loop);
const uint64_t *
rthyb_loop_delays(const rthyb_loop *loop); /* RTHYB_LINK_DELAYS counts of pairs in RUNNING */
const rthyb_latency *
rthyb_loop_sent(const rthyb_loop *loop); /* from wake-up until the command was sent */
rthyb_ticker *rthyb_loop_ticker(rthyb_loop *loop);
/* The *count records of the last tick; must not be called while a thread runs. */
const rthyb_record *rthyb_loop_records(const rthyb_loop *loop, uint32_t *count);
/* After the end of the thread: its privileges (enum rthyb_privilege) and its system usage. */
uint32_t rthyb_loop_ended(const rthyb_loop *loop, rthyb_usage *usage);
/* Passes on the last commands of an earlier loop on these links, one per axis, because a drive that is still
 * following ignores commands with older sequence numbers. If no drive has stopped, and all readings up to and
 * including the first valid ones agree with those of the earlier loop within rest_spread_m, the commands continue
 * from there. Otherwise, and if x_m is NaN, they start at the readings, as without this call. Call before the
 * start. */
void rthyb_loop_continue_from(rthyb_loop *loop, const rthyb_last_command *last);
/* After the end of a loop: what to pass to rthyb_loop_continue_from of the next one. Returns 0 if nothing was ever
 * sent, or if the loop did not end at rest. */
int rthyb_loop_last(const rthyb_loop *loop, rthyb_last_command *last);
/* Discards up to RTHYB_OLD_PIECES_MAX chunks of received data that are waiting in each link, because they are old or
 * were meant for another program. With the stepped clock, call it before the first tick; with the other clocks this
 * is done automatically. */
void rthyb_loop_drop_old(rthyb_loop *loop);
/* Executes one tick on the calling thread, for the stepped clock. */
void rthyb_loop_step(rthyb_loop *loop);
/* Starts a thread that runs until rthyb_ticker_stop is called; priority, cpu and latency_fd as for
 * rthyb_thread_become_real_time. Returns 0 or errno. Except with the stepped clock, the first tick is due shortly
 * after the call. */
int rthyb_loop_start(rthyb_loop *loop, int32_t priority, int32_t cpu, int32_t latency_fd);
/* Waits for the thread to end. */
int rthyb_loop_join(rthyb_loop *loop);
/* After the end of the thread: sends the last commands again, with RTHYB_NOTICE_LEAVING. Returns 0 if they were
 * not all sent: the loop is not at rest, nothing was ever sent, or a link refused one. */
int rthyb_loop_leave(rthyb_loop *loop);
/* Queues an operator's command for the next tick; one thread at a time. Returns its generation, or 0 if the previous
 * one has not been answered yet; only RTHYB_CMD_TRIP replaces an unanswered one. */
uint64_t rthyb_loop_command(rthyb_loop *loop, int32_t command);
/* 0: not answered yet; 1: accepted; 2: refused. *tick is the tick of the answer. */
int rthyb_loop_answered(const rthyb_loop *loop, uint64_t generation, uint64_t *tick);
/* Makes the next tick continue with another station, ring and ground motion; the tick count, wires, links and what
 * is known about the drives' clocks are kept. Refused unless the current station is in IDLE, and the new one has the
 * same number of axes and the same period; the same station may be given another ring in any state. A ring for a
 * different number of axes is always refused. One thread at a time, and one load at a time. Returns its
 * generation. */
uint64_t rthyb_loop_load(rthyb_loop *loop, const rthyb_load *load);
/* 0: not answered yet; 1: accepted, the previous objects are no longer used; 2: refused, the new objects are not
 * used. */
int rthyb_loop_loaded(const rthyb_loop *loop, uint64_t generation);
/* Publishes a set of parameters and assigns its generation; the next tick adopts it as a whole before it does
 * anything else. One thread at a time. Returns 0, or RTHYB_E_LIMIT, in which case nothing is published. */
int rthyb_loop_set_parameters(rthyb_loop *loop, rthyb_parameters *parameters);
/* 0: no tick has processed the set of this generation yet; 1: it or a later one is in effect; 2: it or a later one
 * was refused (rthyb_station_adopt), and the previous set remains in effect. */
int rthyb_loop_set_taken(const rthyb_loop *loop, uint32_t generation);
/* Heartbeat of the operator's program. */
void rthyb_loop_beat(rthyb_loop *loop);

typedef struct {
    const rthyb_codec *codec;      /* of the wire; NULL: no wire, commands were not rounded */
    rthyb_calibration calibration; /* applied to the commands */
} rthyb_replay_axis;

/* Recording to be replayed: all rows from the station's first tick on, with as many axes as the station. */
typedef struct {
    const void *rows;
    size_t count;
    const double *ag_mps2; /* as in rthyb_loop_config */
    size_t ag_count;
    rthyb_replay_axis axis[RTHYB_COUPLED_MAX];
    const double *sensors; /* as read, of each row those of all sensors without an actuator */
    const rthyb_parameters *parameters; /* all sets except generation 0 */
    size_t parameter_count;
} rthyb_replay;

/* Replays a recording through a newly initialised station; what the clock and the link added to the rows is copied.
 * Returns the number of rows written, which is less than `count` if the rows do not form complete ticks. */
size_t rthyb_station_replay(rthyb_station *station, const rthyb_replay *source, void *out);
/* cffi: end */

#endif
