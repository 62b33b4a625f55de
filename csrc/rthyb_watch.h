/* Causes that interrupt or end a test, and the watches that detect them (watches.c). */
#ifndef RTHYB_PART_WATCH_H
#define RTHYB_PART_WATCH_H

#include <stdint.h>

/* cffi: begin */

/* Causes that interrupt or end a test. The first one since START (or RESET) is latched, but a fault replaces
 * COMPLETED and OPERATOR. */
enum rthyb_cause {
    RTHYB_CAUSE_NONE,
    RTHYB_CAUSE_COMPLETED,
    RTHYB_CAUSE_OPERATOR,
    RTHYB_CAUSE_SIGNAL,
    RTHYB_CAUSE_NOT_FINITE,
    RTHYB_CAUSE_LINK_LOST,
    RTHYB_CAUSE_LINK_DOWN,
    RTHYB_CAUSE_DRIVE_STOPPED,
    RTHYB_CAUSE_STALLED,
    RTHYB_CAUSE_HEARTBEAT,
    RTHYB_CAUSE_NOT_ARRIVED,
    RTHYB_CAUSE_SKIPS, /* share of the last second's ticks, or more than 10 in a row */
    RTHYB_CAUSE_SKIP_WARNING,
    RTHYB_CAUSE_LOST_PAIRS, /* share of the last second's ticks without an accepted pair */
    RTHYB_CAUSE_LOST_WARNING,
    RTHYB_CAUSE_SENSOR_STUCK,
    RTHYB_CAUSE_SENSOR_JUMP,
    RTHYB_CAUSE_FORCE_STUCK,
    RTHYB_CAUSE_FORCE_JUMP,
    RTHYB_CAUSE_POSITION,
    RTHYB_CAUSE_VELOCITY,
    RTHYB_CAUSE_INCREMENT,
    RTHYB_CAUSE_FORCE,
    RTHYB_CAUSE_TRACKING,
    RTHYB_CAUSE_INDICATOR,
    RTHYB_CAUSE_ENERGY,
    RTHYB_CAUSE_RIG_POSITION, /* command before tare */
    RTHYB_CAUSE_RIG_FORCE,    /* before tare */
    RTHYB_CAUSE_APART,        /* the sample counts of two drives differ; has no watch */
    /* the positions of the axes correspond to no pose of the specimen; has no watch */
    RTHYB_CAUSE_NO_POSE,
    RTHYB_CAUSE_SENSOR_LOST, /* no usable reading of a sensor without an actuator; has no watch */
    /* LOST_PAIRS, mostly because this displacement sensor, or load cell, was at the end of its range; no watch */
    RTHYB_CAUSE_SENSOR_RANGE,
    RTHYB_CAUSE_FORCE_RANGE,
    /* a displacement, or a force, differs from what all other sensors of its kind imply; only with several axes, or a
     * sensor without an actuator */
    RTHYB_CAUSE_SENSOR_DISAGREES,
    RTHYB_CAUSE_FORCE_DISAGREES,
    RTHYB_CAUSE_COUNT
};

enum rthyb_reaction {
    RTHYB_REACT_NONE,
    RTHYB_REACT_INDICATE,
    RTHYB_REACT_HOLD,
    RTHYB_REACT_RAMP_OUT,
    RTHYB_REACT_TRIP
};

typedef struct {
    double value;     /* 0 = off */
    int32_t reaction; /* enum rthyb_reaction */
} rthyb_watch;

enum rthyb_recent_size {
    RTHYB_RECENT_MAX = 4096 /* ticks in the last second, at 4096 Hz */
};

/* One bit per tick in the last second, and the number of bits set. */
typedef struct {
    uint64_t map[RTHYB_RECENT_MAX / 64];
    uint32_t count;
} rthyb_recent;

/* Ticks of the last second in which a reading was at the end of its sensor's range, and the last such reading, before
 * tare. */
typedef struct {
    rthyb_recent ticks;
    double reading;
} rthyb_range_end;

/* Repeated reading of a stuck sensor, the command when the repetition began, and for how many ticks it has been
 * repeated. */
typedef struct {
    double reading, command;
    uint64_t ticks;
} rthyb_stillness;

/* Reading that a tare has last seen, and how many times in a row. */
typedef struct {
    double reading;
    int32_t count;
} rthyb_repeats;

/* Number of consecutive readings near the level to which a sensor jumped, and the last of them, before tare. */
typedef struct {
    int32_t count;
    double level;
} rthyb_leaps;
/* cffi: end */

#endif
