/* States, limits and faults around the controller (station.c). */
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
    RTHYB_CMD_HOLD,   /* RUNNING -> HOLD; a RESUME that moves is braked again */
    RTHYB_CMD_RESUME, /* HOLD -> RUNNING */
    RTHYB_CMD_STOP,   /* anything that moves -> RAMP_OUT; ZEROED, ARMED -> IDLE */
    RTHYB_CMD_RESET,  /* TRIPPED -> IDLE, with a fresh reading of a specimen at rest */
    RTHYB_CMD_TRIP,   /* anything -> TRIPPED: a second signal, a broken link */
    RTHYB_CMD_COUNT
};

/* An actuator with its displacement sensor and its load cell; all before tare. */
typedef struct {
    double x_range_m, f_range_n;     /* a reading beyond its sensor's range is not taken; 0 = off */
    double rest_spread_m;            /* ZERO refuses a displacement that moves by more */
    double tare_most_m, tare_most_n; /* and a tare beyond these; 0 = any */
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
    double brake_acceleration_m_per_s2; /* of HOLD, and where ramp-out begins; 0: as of paths */
    int32_t tare_ticks, ramp_in_ticks, armed_ticks;
    int32_t stay; /* RAMP_OUT ends where its deceleration does, and not at 0 */
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
    double end; /* where it ends, to the last digit */
    int64_t ticks, elapsed;
    int64_t turn; /* of a brake: ticks in which its acceleration changes, at both ends; 0: none */
    int32_t cosine;
} rthyb_path;

/* A reading that a stuck sensor repeats, the command when it began, and for how many ticks. */
typedef struct {
    double reading, command;
    uint64_t ticks;
} rthyb_stillness;

/* Readings in a row about the level that a sensor leapt to, and the last of them, before tare. */
typedef struct {
    int32_t count;
    double level;
} rthyb_leaps;

/* A force beyond its limit where nothing but a trip is left: ticks of it, ticks since, last tick. */
typedef struct {
    uint64_t ticks, calm, seen;
} rthyb_overload;

enum rthyb_station_size {
    RTHYB_LOST_TICKS = 20,  /* of 1/1024 s: so long without a pair, and the link is lost */
    RTHYB_BLIND_MAX = 80,   /* ticks that are made up for: as long at 4096 Hz */
    RTHYB_RECENT_MAX = 4096 /* ticks of the last second: as above */
};

/* What a station knows of an axis; readings are those before tare. */
typedef struct {
    double tare_cmd; /* 0 of the command, before tare: sensor and drive need not agree */
    double tare_x, tare_f, sum_x, sum_f, low_x, high_x;
    double gap; /* reading less command at rest, as the tare found it: to be measured from */
    rthyb_stillness still_x, still_f;
    double seen_x, seen_f; /* last readings */
    rthyb_leaps leaps_x, leaps_f;
    double rest_x;       /* where the readings have been at rest, */
    uint32_t rest_ticks; /* and for how many of them */
    int32_t off_scale;   /* of this tick's reading: bit 0 displacement, bit 1 force */
    int32_t told;        /* this tick had one */
    rthyb_overload over_f, over_rig_f;
    double told_x, told_f; /* this tick's reading, if there was one */
} rthyb_axis;

/* One bit for each tick of the last second, and how many of them are set. */
typedef struct {
    uint64_t map[RTHYB_RECENT_MAX / 64];
    uint32_t count;
} rthyb_recent;

/* Times that a station goes by, in ticks of its own. */
typedef struct {
    uint32_t lost;      /* without a pair, then the link is lost; as many are made up for */
    uint32_t rest;      /* of readings that stand still, then RESET is allowed */
    uint32_t skips;     /* more skipped ones than this in a row: RAMP_OUT */
    uint32_t recent;    /* of the last second; RTHYB_RECENT_MAX at most */
    int64_t arrival;    /* in which the command has come no nearer: it never will */
    uint64_t overload;  /* a force beyond its limit where nothing but a trip is left, at most */
    int64_t least_way;  /* of a way between two points */
    int64_t turn;       /* in which a brake's deceleration comes and goes: a lead's time, */
    int64_t least_turn; /* and that of a motion that is nearly at rest */
    double pace;        /* of them in 1/1024 s */
} rthyb_station_ticks;

typedef struct {
    rthyb_station_config cfg;
    rthyb_station_ticks ticks;
    rthyb_controller controller;
    int32_t state;                       /* enum rthyb_state */
    int32_t cause;                       /* enum rthyb_cause, latched */
    int32_t cause_axis, cause_interface; /* of which, or -1 */
    uint64_t cause_tick;                 /* when the cause came up */
    double cause_value; /* what was met, in the unit of what is watched (m, N, ticks ...), */
    double cause_limit; /* and what was allowed; both 0 where the cause has no number */
    uint32_t indicated; /* bit 1 << cause: seen, not acted on */
    int32_t interrupted;
    uint64_t tick;      /* ticks of the station */
    uint64_t in_state;  /* ticks since the state was entered */
    double nearest_m;   /* at the end of a path: how near the command has come to it, since when */
    int64_t no_nearer;  /* ticks since then */
    uint64_t test_tick; /* n of the ground motion: RUNNING ticks so far */
    rthyb_path path[RTHYB_COUPLED_MAX]; /* of each interface; they begin and end together */
    int32_t leg; /* HOLD: 0 decelerating, 1 stands, 2 resuming, 3 decelerating before it resumes;
                  * RAMP_OUT: 0 decelerating, 1 on the way; RAMP_IN: 0 on the way, 1 decelerating */
    double resume[RTHYB_COUPLED_MAX]
                 [3];      /* displacement, velocity, acceleration of each interface */
    int32_t zeroing;       /* 0 no, 1 under way, 2 failed: the reading moved, 3: too large */
    int32_t tare_readings; /* that the tare has so far */
    int32_t tared;         /* there is one that counts: none before the first, none after a RESET */
    int32_t seen;          /* there is a reading of every axis */
    int32_t commands; /* x_cmd is the drive's by an earlier tare or station, not by a reading */
    int32_t noted;    /* bits of this tick's record, found before there is one */
    uint64_t apart;   /* ticks in a row in which the drives' counts were apart */
    rthyb_axis axis[RTHYB_COUPLED_MAX];
    int32_t drive_stands;  /* it has stopped by itself, or nobody can reach it */
    int32_t refused_cause; /* why the last ARM, START, RESUME, RESET or tare was refused: */
    double refused_value, refused_limit; /* as with a cause; NONE: not by a watch */
    double indicator_slope;              /* of the tracking indicator, mean of 0.25 s, m^2/s */
    rthyb_recent skips, losses;
    uint64_t skipped;     /* all of them */
    int32_t trip_frames;  /* trip frames still to be sent */
    int32_t reset_frames; /* commands that still say RTHYB_TOLD_RESET */
    /* What the row of this tick has beside its record, in the order of the recording's table of channels:
     * written by whoever knows it, before the row is taken. Nothing here is read by the station. */
    double channel[RTHYB_CHANNELS_MAX];
} rthyb_station;

/* Of an axis. */
typedef struct {
    double x_m, f_n;       /* newest pair, before tare */
    double x_cmd_m;        /* with taken_over: what the drive has */
    int32_t lost;          /* as in rthyb_pair */
    int32_t link_down;     /* the link itself reports a failure */
    int32_t drive_stopped; /* the drive says that it has stopped by itself */
    int32_t beyond;        /* the wire could not hold the last command and sent the nearest */
} rthyb_axis_input;

typedef struct {
    double x_cmd_m;       /* for the wire: with tare */
    double low_m, high_m; /* with tare: the wire's rounding must not take it beyond these */
} rthyb_axis_output;

typedef struct {
    rthyb_axis_input axis[RTHYB_COUPLED_MAX];
    uint32_t skipped;       /* ticks that were skipped before this one */
    int32_t command;        /* enum rthyb_command */
    int32_t heartbeat_late; /* Python has been silent for a second */
    int32_t taken_over;     /* with the first sound readings: the drives have commands already */
    int32_t apart;          /* the drives' counts are more than one sample apart */
} rthyb_station_input;

typedef struct {
    rthyb_axis_output axis[RTHYB_COUPLED_MAX];
    int32_t send; /* 0: silence */
    int32_t state;
    int32_t told;    /* to the drives: the state, or RTHYB_TOLD_RESET */
    int32_t refused; /* the command was refused: not for this state, or nobody there to obey */
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
/* What that tick left to do, once the command has been sent. The next tick does it where nobody has. */
void rthyb_station_advance(rthyb_station *station);
/* cffi: end */

#endif
