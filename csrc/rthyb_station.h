/* States, limits and faults of a test (station.c). */
#ifndef RTHYB_PART_STATION_H
#define RTHYB_PART_STATION_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_controller.h"
#include "rthyb_disagreement.h"
#include "rthyb_lone.h"
#include "rthyb_watch.h"

/* cffi: begin */

enum rthyb_command {
    RTHYB_CMD_NONE,
    RTHYB_CMD_ZERO,   /* IDLE -> ZEROED: tare over tare_ticks at rest */
    RTHYB_CMD_ARM,    /* ZEROED -> ARMED */
    RTHYB_CMD_START,  /* ARMED -> RAMP_IN -> RUNNING */
    RTHYB_CMD_HOLD,   /* RUNNING -> HOLD; interrupts a RESUME in progress */
    RTHYB_CMD_RESUME, /* HOLD -> RUNNING */
    RTHYB_CMD_STOP,   /* any moving state -> RAMP_OUT; ZEROED, ARMED -> IDLE */
    RTHYB_CMD_RESET,  /* TRIPPED -> IDLE, requires a new reading of a specimen at rest */
    RTHYB_CMD_TRIP,   /* any state -> TRIPPED: on a second signal, or a broken link */
    RTHYB_CMD_COUNT
};

/* Settings of an actuator with its displacement sensor and load cell; all values before tare. */
typedef struct {
    double x_range_m, f_range_n; /* a reading beyond the range of its sensor is not used; 0 = off */
    double rest_spread_m;        /* ZERO is refused if the displacement varies by more than this */
    double tare_most_m, tare_most_n; /* ZERO is refused if a tare exceeds these; 0 = no limit */
    /* ZERO is refused after so many equal readings in a row of the displacement sensor, or of the load cell; 0 = no limit */
    int32_t x_frozen_ticks, f_frozen_ticks;
    rthyb_allowance x_allowance, f_allowance; /* for SENSOR_DISAGREES and FORCE_DISAGREES */
    /* 0: use the station's watches; else `watch`, for the causes of an axis: SENSOR_STUCK to FORCE_JUMP, POSITION
     * to TRACKING, RIG_POSITION, RIG_FORCE, SENSOR_DISAGREES, FORCE_DISAGREES */
    int32_t own_watches;
    rthyb_watch watch[RTHYB_CAUSE_COUNT];
} rthyb_axis_config;

/* Limits of the command and of the force in one interface coordinate: m and N, or rad and N m. */
typedef struct {
    rthyb_watch position, force;
} rthyb_interface_config;

typedef struct {
    rthyb_controller_config controller;
    rthyb_axis_config axis[RTHYB_COUPLED_MAX];
    rthyb_interface_config interface[RTHYB_COUPLED_MAX];
    rthyb_lone_config
        lone[RTHYB_SENSORS_ALL]; /* sensors without an actuator, as in the kinematics */
    /* Only the entries from RTHYB_CAUSE_SKIPS upwards are used. Units: stuck: ticks; jump: m or N; shares: 0 to 1.
     * If SKIPS has the value 0, a share of 50/1024 with the action ramp-out applies. */
    rthyb_watch watch[RTHYB_CAUSE_COUNT];
    double path_velocity_m_per_s; /* for ramps and RESUME */
    double path_acceleration_m_per_s2;
    /* deceleration in HOLD and at the start of a ramp-out; 0: path_acceleration_m_per_s2 */
    double brake_acceleration_m_per_s2;
    int32_t tare_ticks, ramp_in_ticks, armed_ticks;
    int32_t stay; /* not 0: RAMP_OUT ends where the motion stops instead of at 0 */
    /* For each group of channels in a row: index of the first, and how many (0: none). law: values that the first
     * axis' control law reports in addition to alpha and beta; part: responses of the numerical part; axis: values of
     * further axes that are not in the record, namely x_num and k_t of each interface except the first, then x_plc,
     * alpha and beta of each axis except the first; lone: of each sensor without an actuator, the value used, after
     * tare, then those as read, before tare, NaN if nothing was. */
    uint32_t law_channel, law_channel_count, part_channel, part_channel_count;
    uint32_t axis_channel, axis_channel_count, lone_channel, lone_channel_count;
} rthyb_station_config;

/* Displacement over an integer number of ticks: sum c[i] u^i, or c[0] + c[1] cos(pi u), u = 0 ... 1. For a braking
 * motion, c holds displacement, velocity and acceleration at its start, then the braking acceleration. */
typedef struct {
    double c[6];
    double end; /* exact end value */
    int64_t ticks, elapsed;
    /* braking: ticks over which the acceleration changes, at each end; 0: not a braking motion */
    int64_t turn;
    int32_t cosine;
} rthyb_path;

/* Counts while a force is beyond its limit and only a trip can still follow. ticks: ticks beyond the limit; calm:
 * consecutive ticks below it since; seen: last tick counted. */
typedef struct {
    uint64_t ticks, calm, seen;
} rthyb_overload;

enum rthyb_station_size {
    RTHYB_LOST_TICKS = 20, /* ticks of 1/1024 s without a pair after which the link is lost */
    /* most skipped ticks that are made up for later: RTHYB_LOST_TICKS at 4096 Hz */
    RTHYB_BLIND_MAX = 80,
    /* displacement sensor and load cell of each axis, then the sensors without an actuator */
    RTHYB_READINGS_ALL = 2 * RTHYB_COUPLED_MAX + RTHYB_SENSORS_ALL
};

/* State of an axis; readings are before tare. */
typedef struct {
    /* command that counts as zero, before tare; differs from tare_x if sensor and drive disagree */
    double tare_cmd;
    double tare_x, tare_f, sum_x, sum_f, low_x, high_x;
    rthyb_repeats repeats_x, repeats_f; /* of the tare */
    double gap; /* reading minus command at rest, found by the tare: reference for drift */
    rthyb_stillness still_x, still_f;
    double seen_x, seen_f; /* last readings */
    rthyb_leaps leaps_x, leaps_f;
    double rest_x;       /* position at which the readings are at rest, */
    uint32_t rest_ticks; /* and number of these readings */
    int32_t off_scale;   /* in this tick: bit 0 displacement, bit 1 force */
    int32_t has_reading; /* there is a reading in this tick */
    int32_t stands;      /* the drive has stopped on its own, or cannot be reached */
    rthyb_overload over_f, over_rig_f;
    double reading_x_m, reading_f_n; /* reading in this tick, if there was one */
} rthyb_axis;

/* Time constants of a station, in its ticks. */
typedef struct {
    /* ticks without a pair until the link is lost; also the most skipped ticks that are made up for later */
    uint32_t lost;
    uint32_t rest;   /* readings at rest until RESET is allowed */
    uint32_t skips;  /* more skipped ticks than this in a row: RAMP_OUT */
    uint32_t recent; /* ticks in the last second; at most RTHYB_RECENT_MAX */
    /* ticks without progress towards the end of a path, after which the cause is NOT_ARRIVED */
    int64_t arrival;
    /* ticks beyond a force limit that cause a trip, if hold and ramp-out can do no more */
    uint64_t overload;
    int64_t least_way;  /* minimum duration of a path between two points */
    int64_t turn;       /* ticks in which the deceleration of a brake builds up and ends, */
    int64_t least_turn; /* and the same for a motion that is nearly at rest */
    double pace;        /* ticks per 1/1024 s */
} rthyb_station_ticks;

typedef struct {
    rthyb_station_config cfg;
    rthyb_station_ticks ticks;
    rthyb_controller controller;
    int32_t state;                                     /* enum rthyb_state */
    int32_t cause;                                     /* enum rthyb_cause, latched */
    int32_t cause_axis, cause_interface, cause_sensor; /* index, or -1 */
    uint64_t cause_tick;                               /* when the cause occurred */
    /* measured value, in the unit of the monitored quantity (m, N, ticks ...), */
    double cause_value;
    double cause_limit; /* and its limit; both 0 if the cause has no number */
    uint64_t indicated; /* bit 1 << cause: the cause occurred but did not change the state */
    int32_t interrupted;
    uint64_t tick;                      /* ticks of the station */
    uint64_t in_state;                  /* ticks since the state was entered */
    double nearest_m;                   /* end of a path: smallest distance of the command so far */
    int64_t no_nearer;                  /* ticks since that distance was reached */
    uint64_t test_tick;                 /* index in the ground motion: RUNNING ticks so far */
    rthyb_path path[RTHYB_COUPLED_MAX]; /* of each interface; they begin and end together */
    /* HOLD: 0 decelerating, 1 at rest, 2 resuming, 3 decelerating before it resumes; RAMP_OUT: 0
     * decelerating, 1 on the way; RAMP_IN: 0 on the way, 1 decelerating */
    int32_t leg;
    /* displacement, velocity, acceleration of each interface */
    double resume[RTHYB_COUPLED_MAX][3];
    /* 0 no, 1 in progress; failed: 2 reading not at rest, 3 tare too large, 4 no pose, 5 a sensor without an actuator
     * gives no usable reading, 6 a reading is frozen */
    int32_t zeroing;
    int32_t tare_readings; /* readings in the tare so far */
    int32_t tared;         /* there is a valid tare: not before the first, nor after a RESET */
    int32_t seen;          /* every axis has had a reading */
    /* not 0: x_cmd comes from an earlier tare or station rather than from a reading */
    int32_t commands;
    int32_t noted;      /* status bits found in this tick before its record exists */
    uint64_t apart;     /* consecutive ticks in which the drives' counts differed */
    int32_t apart_axis; /* axis whose count differed, as last reported to the station; -1: none */
    rthyb_axis axis[RTHYB_COUPLED_MAX];
    rthyb_lone lone[RTHYB_SENSORS_ALL];
    rthyb_disagreement disagreement;
    rthyb_overload over_interface[RTHYB_COUPLED_MAX];
    int32_t refused_cause; /* reason why the last ARM, START, RESUME, RESET or tare was refused, */
    /* with the values as for a cause; NONE: not because of a limit */
    double refused_value, refused_limit;
    int32_t refused_axis, refused_interface, refused_sensor; /* index, or -1 */
    double indicator_slope; /* of the tracking indicator, mean of 0.25 s, m^2/s */
    rthyb_recent skips, losses;
    rthyb_range_end ends[RTHYB_READINGS_ALL];
    uint64_t skipped;     /* total */
    int32_t trip_frames;  /* trip frames still to be sent */
    int32_t reset_frames; /* number of further commands with RTHYB_NOTICE_RESET */
    /* Channels of this tick's row, in the order of the recording's table of channels. Written by whichever part of
     * the program produces them, before the row is stored; the station does not read them. */
    double channel[RTHYB_CHANNELS_MAX];
} rthyb_station;

/* Input for one axis. */
typedef struct {
    double x_m, f_n;       /* newest pair, before tare */
    double x_cmd_m;        /* with taken_over: the command in effect at the drive */
    int32_t lost;          /* as in rthyb_pair */
    int32_t link_down;     /* the link itself reports a failure */
    int32_t drive_stopped; /* the drive reports that it has stopped on its own */
    int32_t beyond; /* the wire could not represent the last command and sent the nearest value */
} rthyb_axis_input;

typedef struct {
    double x_cmd_m; /* for the wire: with tare */
    /* with tare: the command must stay within these after rounding on the wire */
    double low_m, high_m;
} rthyb_axis_output;

typedef struct {
    rthyb_axis_input axis[RTHYB_COUPLED_MAX];
    double sensor[RTHYB_SENSORS_ALL]; /* readings of the sensors without an actuator, before tare */
    uint32_t sensors_lost;            /* bit k: there is no reading of sensor k in this tick */
    uint32_t skipped;                 /* ticks that were skipped before this one */
    int32_t command;                  /* enum rthyb_command */
    int32_t heartbeat_late;           /* no heartbeat from Python for a second */
    int32_t taken_over; /* with the first valid readings: the drives already have commands */
    /* 0: the drives count on one clock; 1 + the axis whose drive's count differs by more than one sample from
     * another; RTHYB_APART_UNKNOWN: not compared yet */
    int32_t apart;
} rthyb_station_input;

typedef struct {
    rthyb_axis_output axis[RTHYB_COUPLED_MAX];
    int32_t send; /* 0: send nothing */
    int32_t state;
    int32_t sent_state; /* value to send to the drives: the state, or RTHYB_NOTICE_RESET */
    /* the command was refused: not allowed in this state, or no drive to execute it */
    int32_t refused;
    uint32_t records;
} rthyb_station_output;

int rthyb_station_init(rthyb_station *station, const rthyb_station_config *cfg);
/* Executes one tick: blind steps for skipped ticks, then the sample. `records` must have room for RTHYB_BLIND_MAX +
 * 1 complete records; the flags of the last one record the station's inputs. ag_mps2: ground motion of the whole
 * test, n samples. ZERO, ARM and START are refused while a link is down or a drive has stopped. RESET is refused
 * without a new reading, or before the readings have been at rest for 19.5 ms. ARM, START, RESUME and RESET are
 * refused if a limit is exceeded; refused_cause says which. RESET applies in TRIPPED, and in IDLE if the drive has
 * stopped; the next three commands carry it to the drive. */
int rthyb_station_tick(rthyb_station *station, const rthyb_station_input *in, const double *ag_mps2,
                       size_t n, rthyb_record *records, rthyb_station_output *out);
/* Completes the tick after the command was sent; otherwise the next tick does it. */
void rthyb_station_advance(rthyb_station *station);
/* cffi: end */

#endif
