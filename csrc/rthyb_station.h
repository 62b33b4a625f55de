/* States, limits and faults of a test (station.c). */
#ifndef RTHYB_PART_STATION_H
#define RTHYB_PART_STATION_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_controller.h"
#include "rthyb_watch.h"

/* cffi: begin */

enum rthyb_command {
    RTHYB_CMD_NONE,
    RTHYB_CMD_ZERO,   /* IDLE -> ZEROED: tare over tare_ticks at rest */
    RTHYB_CMD_ARM,    /* ZEROED -> ARMED */
    RTHYB_CMD_START,  /* ARMED -> RAMP_IN -> RUNNING */
    RTHYB_CMD_HOLD,   /* RUNNING -> HOLD; brakes a RESUME that is moving */
    RTHYB_CMD_RESUME, /* HOLD -> RUNNING */
    RTHYB_CMD_STOP,   /* any moving state -> RAMP_OUT; ZEROED, ARMED -> IDLE */
    RTHYB_CMD_RESET,  /* TRIPPED -> IDLE, requires a fresh reading of a specimen at rest */
    RTHYB_CMD_TRIP,   /* any state -> TRIPPED: a second signal, a broken link */
    RTHYB_CMD_COUNT
};

/* An actuator with its displacement sensor and its load cell; all before tare. */
typedef struct {
    double x_range_m, f_range_n; /* a reading beyond the range of its sensor is not used; 0 = off */
    double rest_spread_m;        /* ZERO is refused if the displacement varies by more, */
    double tare_most_m, tare_most_n; /* or if a tare exceeds these; 0 = no limit */
    int32_t
        own_watches; /* 0: the station's; else these, of what belongs to an axis: stuck, jump, position
                      * to tracking, rig position and rig force */
    rthyb_watch watch[RTHYB_CAUSE_COUNT];
} rthyb_axis_config;

/* Of what is asked of the specimen in this direction, and of its force: m and N, or rad and N m. */
typedef struct {
    rthyb_watch position, force;
} rthyb_interface_config;

typedef struct {
    rthyb_controller_config controller;
    rthyb_axis_config axis[RTHYB_COUPLED_MAX];
    rthyb_interface_config interface[RTHYB_COUPLED_MAX];
    /* SKIPS and what follows it; stuck: ticks, jump: m or N, shares: of 1. SKIPS with value 0 is
     * a ramp-out at 50 in 1024. */
    rthyb_watch watch[RTHYB_CAUSE_COUNT];
    double path_velocity_m_per_s; /* of ramps and RESUME */
    double path_acceleration_m_per_s2;
    double
        brake_acceleration_m_per_s2; /* of HOLD and at the start of a ramp-out; 0: as for paths */
    int32_t tare_ticks, ramp_in_ticks, armed_ticks;
    int32_t stay; /* RAMP_OUT ends where the motion stops, not at 0 */
    /* Which of the row's channels are what the first axis' control law reports beside alpha and beta, which
     * what the numerical part does, and which what further axes have beside the record: x_num and k_t of each
     * interface but the first, then x_plc, alpha and beta of each axis but the first. From which one on, and
     * how many; 0: none. */
    uint32_t law_channel, law_channel_count, part_channel, part_channel_count;
    uint32_t axis_channel, axis_channel_count;
} rthyb_station_config;

/* Displacement over a whole number of ticks: sum c[i] u^i, or c[0] + c[1] cos(pi u); u = 0 ... 1. Or a
 * brake: displacement, velocity and acceleration at its beginning, and the one it brakes with. */
typedef struct {
    double c[6];
    double end; /* exact end value */
    int64_t ticks, elapsed;
    int64_t turn; /* brake: ticks in which the acceleration changes, at both ends; 0: none */
    int32_t cosine;
} rthyb_path;

/* Repeated reading of a stuck sensor, the command when it began, and the number of ticks. */
typedef struct {
    double reading, command;
    uint64_t ticks;
} rthyb_stillness;

/* Consecutive readings near the level to which a sensor jumped, and the last of them, before tare. */
typedef struct {
    int32_t count;
    double level;
} rthyb_leaps;

/* A force beyond its limit when only a trip remains: ticks beyond, ticks below since, last tick. */
typedef struct {
    uint64_t ticks, calm, seen;
} rthyb_overload;

enum rthyb_station_size {
    RTHYB_LOST_TICKS = 20,  /* ticks of 1/1024 s without a pair after which the link is lost */
    RTHYB_BLIND_MAX = 80,   /* skipped ticks that are processed later: the same time at 4096 Hz */
    RTHYB_RECENT_MAX = 4096 /* ticks in the last second, at 4096 Hz */
};

/* State of an axis; readings are before tare. */
typedef struct {
    double tare_cmd; /* zero of the command, before tare: sensor and drive need not agree */
    double tare_x, tare_f, sum_x, sum_f, low_x, high_x;
    double gap; /* reading minus command at rest, found by the tare: reference for drift */
    rthyb_stillness still_x, still_f;
    double seen_x, seen_f; /* last readings */
    rthyb_leaps leaps_x, leaps_f;
    double rest_x;       /* position at which the readings are at rest, */
    uint32_t rest_ticks; /* and number of these readings */
    int32_t off_scale;   /* of this tick's reading: bit 0 displacement, bit 1 force */
    int32_t told;        /* this tick had one */
    int32_t stands;      /* the drive has stopped by itself, or cannot be reached */
    rthyb_overload over_f, over_rig_f;
    double told_x, told_f; /* reading in this tick, if there was one */
} rthyb_axis;

/* One bit per tick in the last second, and the number of bits set. */
typedef struct {
    uint64_t map[RTHYB_RECENT_MAX / 64];
    uint32_t count;
} rthyb_recent;

/* Time constants of a station, in its ticks. */
typedef struct {
    uint32_t
        lost; /* ticks without a pair until the link is lost; also skipped ticks processed later */
    uint32_t rest;   /* readings at rest until RESET is allowed */
    uint32_t skips;  /* more skipped ticks than this in a row: RAMP_OUT */
    uint32_t recent; /* ticks in the last second; at most RTHYB_RECENT_MAX */
    int64_t arrival; /* ticks without approach after which a command is considered not to arrive */
    uint64_t
        overload; /* ticks with a force beyond its limit until a trip, when only a trip remains */
    int64_t least_way;  /* least duration of a path between two points */
    int64_t turn;       /* ticks in which the deceleration of a brake builds up and ends, */
    int64_t least_turn; /* and the same for a motion that is nearly at rest */
    double pace;        /* of them in 1/1024 s */
} rthyb_station_ticks;

typedef struct {
    rthyb_station_config cfg;
    rthyb_station_ticks ticks;
    rthyb_controller controller;
    int32_t state;                       /* enum rthyb_state */
    int32_t cause;                       /* enum rthyb_cause, latched */
    int32_t cause_axis, cause_interface; /* of which, or -1 */
    uint64_t cause_tick;                 /* when the cause occurred */
    double
        cause_value; /* measured value, in the unit of the monitored quantity (m, N, ticks ...), */
    double cause_limit; /* and its limit; both 0 if the cause has no number */
    uint32_t indicated; /* bit 1 << cause: occurred, without an action */
    int32_t interrupted;
    uint64_t tick;                      /* ticks of the station */
    uint64_t in_state;                  /* ticks since the state was entered */
    double nearest_m;                   /* end of a path: smallest distance of the command so far */
    int64_t no_nearer;                  /* ticks since that distance was reached */
    uint64_t test_tick;                 /* index in the ground motion: RUNNING ticks so far */
    rthyb_path path[RTHYB_COUPLED_MAX]; /* of each interface; they begin and end together */
    int32_t leg; /* HOLD: 0 decelerating, 1 stands, 2 resuming, 3 decelerating before it resumes;
                  * RAMP_OUT: 0 decelerating, 1 on the way; RAMP_IN: 0 on the way, 1 decelerating */
    double resume[RTHYB_COUPLED_MAX]
                 [3]; /* displacement, velocity, acceleration of each interface */
    int32_t
        zeroing; /* 0 no, 1 in progress; failed: 2 reading not at rest, 3 tare too large, 4 no pose */
    int32_t tare_readings; /* readings in the tare so far */
    int32_t tared;         /* there is a valid tare: not before the first, nor after a RESET */
    int32_t seen;          /* every axis has had a reading */
    int32_t commands;      /* x_cmd is from an earlier tare or station, not from a reading */
    int32_t noted;         /* status bits found in this tick before its record exists */
    uint64_t apart;        /* ticks in a row in which the drives' counts were apart, */
    int32_t apart_axis;    /* that of which axis, as the station was told it last; -1: of none */
    rthyb_axis axis[RTHYB_COUPLED_MAX];
    rthyb_overload over_interface[RTHYB_COUPLED_MAX];
    int32_t refused_cause; /* reason why the last ARM, START, RESUME, RESET or tare was refused, */
    double refused_value,
        refused_limit; /* with the values as for a cause; NONE: not because of a limit */
    int32_t refused_axis, refused_interface; /* of which, or -1 */
    double indicator_slope;                  /* of the tracking indicator, mean of 0.25 s, m^2/s */
    rthyb_recent skips, losses;
    uint64_t skipped;     /* total */
    int32_t trip_frames;  /* trip frames still to be sent */
    int32_t reset_frames; /* number of further commands with RTHYB_TOLD_RESET */
    /* What the row of this tick has beside its record, in the order of the recording's table of channels:
     * written by whoever knows it, before the row is taken. Nothing here is read by the station. */
    double channel[RTHYB_CHANNELS_MAX];
} rthyb_station;

/* Of an axis. */
typedef struct {
    double x_m, f_n;       /* newest pair, before tare */
    double x_cmd_m;        /* with taken_over: the command in effect at the drive */
    int32_t lost;          /* as in rthyb_pair */
    int32_t link_down;     /* the link itself reports a failure */
    int32_t drive_stopped; /* the drive reports that it has stopped by itself */
    int32_t beyond; /* the wire could not represent the last command and sent the nearest value */
} rthyb_axis_input;

typedef struct {
    double x_cmd_m;       /* for the wire: with tare */
    double low_m, high_m; /* with tare: rounding on the wire must not exceed these */
} rthyb_axis_output;

typedef struct {
    rthyb_axis_input axis[RTHYB_COUPLED_MAX];
    uint32_t skipped;       /* ticks that were skipped before this one */
    int32_t command;        /* enum rthyb_command */
    int32_t heartbeat_late; /* Python has been silent for a second */
    int32_t taken_over;     /* with the first sound readings: the drives have commands already */
    int32_t
        apart; /* 0: the drives count by one clock; 1 + the axis whose drive has come to be more than
                * one sample apart from another; RTHYB_APART_UNKNOWN: not compared yet */
} rthyb_station_input;

typedef struct {
    rthyb_axis_output axis[RTHYB_COUPLED_MAX];
    int32_t send; /* 0: send nothing */
    int32_t state;
    int32_t told; /* to the drives: the state, or RTHYB_TOLD_RESET */
    int32_t
        refused; /* the command was refused: not allowed in this state, or no drive to obey it */
    uint32_t records;
} rthyb_station_output;

int rthyb_station_init(rthyb_station *station, const rthyb_station_config *cfg);
/* One executed tick: blind steps for what was skipped, then the sample. records takes up to
 * RTHYB_BLIND_MAX + 1 of them, whole ones; the last one has what the station was told as flags. ag_mps2 is the
 * ground motion of the whole test, n of it. While a link is down or a drive stopped, ZERO, ARM
 * and START are refused; RESET without a fresh reading, or before they have stood still for 19.5 ms; ARM,
 * START, RESUME and RESET beyond a limit, as refused_cause says. RESET is for TRIPPED, and for IDLE where
 * the drive has stopped: the next three commands tell it so. */
int rthyb_station_tick(rthyb_station *station, const rthyb_station_input *in, const double *ag_mps2,
                       size_t n, rthyb_record *records, rthyb_station_output *out);
/* Completes the tick after the command was sent; otherwise the next tick does it. */
void rthyb_station_advance(rthyb_station *station);
/* cffi: end */

#endif
