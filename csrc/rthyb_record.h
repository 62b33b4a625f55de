/* Sizes, status bits, error codes, states and flags; and the record of a sample, which is a slot of the ring, a row of
 * the HDF5 file, and the input of a replay. */
#ifndef RTHYB_PART_RECORD_H
#define RTHYB_PART_RECORD_H

#include <stddef.h>
#include <stdint.h>

/* cffi: begin */

enum rthyb_size {
    RTHYB_WINDOW_MAX = 4096,   /* largest T0 of the tangent stiffness, samples: 1 s at 4096 Hz */
    RTHYB_DELAY_MAX = 4096,    /* longest transport delay of a virtual actuator, samples: 1 s */
    RTHYB_ELEMENTS_MAX = 16,   /* elements of one specimen */
    RTHYB_ELEMENT_PARAMS = 16, /* parameters of one element */
    RTHYB_IWAN_SLIDERS = 12,   /* sliders of one Iwan element */
    RTHYB_ELEMENT_STATES = 16  /* history variables of one element */
};

/* Status of a sample; bits, because several can be set at once. A record stores sixteen of them. */
enum rthyb_status {
    RTHYB_OK = 0,
    RTHYB_S_NOT_FINITE = 1,            /* NaN or inf was received, or would have been sent */
    RTHYB_S_OUT_OF_RANGE = 2,          /* finite, but outside the sensor's range or implausible */
    RTHYB_S_LIMITED = 4,               /* the limiter changed the command */
    RTHYB_S_POSITION_LIMIT = 8,        /* the command exceeded its position limit */
    RTHYB_S_FORCE_LIMIT = 16,          /* the measured force exceeded its limit */
    RTHYB_S_TRACKING_LIMIT = 32,       /* |x_m - x_c| exceeded its limit */
    RTHYB_S_LINK_LOST = 64,            /* no accepted pair for 19.5 ms */
    RTHYB_S_TRIP = 128,                /* the limit or fault trips the test */
    RTHYB_S_VELOCITY_LIMIT = 1 << 8,   /* the velocity of the command exceeded its limit */
    RTHYB_S_INCREMENT_LIMIT = 1 << 9,  /* its change from sample to sample exceeded its limit */
    RTHYB_S_INDICATOR_LIMIT = 1 << 10, /* the slope of the tracking indicator exceeded its limit */
    RTHYB_S_ENERGY_LIMIT = 1 << 11,    /* the energy error exceeded its limit */
    RTHYB_S_SENSOR_STUCK = 1 << 12,    /* a sensor repeats the same reading */
    RTHYB_S_SENSOR_JUMP = 1 << 13,     /* a reading jumped */
    RTHYB_S_LOST_RATE = 1 << 14,       /* too large a share of pairs is lost */
    RTHYB_S_SKIP_RATE = 1 << 15,       /* too large a share of ticks was skipped */
    RTHYB_LOST = 1 << 16               /* in an input only: nothing arrived */
};

/* Reasons for which an _init function rejects its settings. */
enum rthyb_error {
    RTHYB_E_PERIOD = 1,
    RTHYB_E_WEIGHTS,
    RTHYB_E_ESTIMATOR,
    RTHYB_E_WINDOW,
    RTHYB_E_STIFFNESS,
    RTHYB_E_MOTION,
    RTHYB_E_SERVO,
    RTHYB_E_ELEMENT,
    RTHYB_E_SENSOR,
    RTHYB_E_LIMIT, /* a limit, or an implausible initial value */
    RTHYB_E_LAW,   /* unknown control law, or parameters that it cannot use */
    RTHYB_E_KINEMATICS,
    RTHYB_E_PLANT /* a virtual plant of several axes: its sizes, or a number that is not finite */
};

/* ---- one record: ring slot, HDF5 row and replay input -------------------------------------- */

enum rthyb_coupled_size {
    RTHYB_COUPLED_MAX = 4,    /* axes at one specimen */
    RTHYB_COUPLED_SQUARE = 16 /* its square */
};

/* This is the only declaration of the record: Python reads the names, types and offsets of the fields from here, and
 * they define the rows of a recording and the slots of the ring. Sizes in words of 8 bytes, without padding. */
enum rthyb_record_size {
    /* named values that a row may contain in addition to its record: those of four axes are 15, those of eight sensors
     * without an actuator 16, and each axis may have RTHYB_EXTRAS_MAX extra channels */
    RTHYB_CHANNELS_MAX = 64,
    RTHYB_TEST_WORDS = 13, /* words of a record without its axes */
    RTHYB_AXIS_WORDS = 6,  /* words of each axis */
    RTHYB_RECORD_WORDS = RTHYB_TEST_WORDS + RTHYB_COUPLED_MAX * RTHYB_AXIS_WORDS
};

enum rthyb_state {
    RTHYB_IDLE,
    RTHYB_ZEROED,
    RTHYB_ARMED,
    RTHYB_RAMP_IN,
    RTHYB_RUNNING,
    RTHYB_HOLD,
    RTHYB_RAMP_OUT,
    RTHYB_TRIPPED
};

enum rthyb_flag {
    RTHYB_F_FRESH = 1,     /* a new accepted pair of displacement and force */
    RTHYB_F_PREDICTED = 2, /* x_meas_m and f_meas_n are extrapolated */
    RTHYB_F_BLIND = 4,     /* a skipped tick, processed later */
    RTHYB_F_FROZEN = 8,    /* alpha and k_t held */
    RTHYB_F_LIMITED = 16,  /* the limiter changed the command */
    RTHYB_F_NOT_SENT = 32,
    /* From here on: inputs of the station in this tick, only in the last record of the tick, never in a
     * blind one. Together with the readings, they are all that a replay needs. */
    RTHYB_F_SLIP = 1 << 6, /* the drive's count slipped relative to the tick, 192 ticks ago */
    /* no new pair arrived; PREDICTED without this flag: the station rejected the pair that arrived, or a sensor without
     * an actuator had no reading */
    RTHYB_F_LOST = 1 << 7,
    RTHYB_F_DOWN = 1 << 8,    /* the link reported a failure */
    RTHYB_F_STOPPED = 1 << 9, /* the drive last reported that it has stopped on its own */
    RTHYB_F_SILENT = 1 << 10, /* the operator's program has sent no heartbeat for too long */
    RTHYB_F_BEYOND = 1 << 11, /* the wire could not represent the command of the previous tick */
    /* no reading before this tick: x_cmd_m comes from an earlier program */
    RTHYB_F_TAKEN_OVER = 1 << 12,
    /* From here to bit 22: only with several axes. */
    RTHYB_F_APART = 1 << 13, /* the drives' counts are more than one sample apart */
    /* bits 14 to 17: the command of this axis was not sent; not itself a flag */
    RTHYB_F_UNSENT_BIT = 14,
    /* bits 18 to 21: the drive of this axis has stopped on its own; not itself a flag */
    RTHYB_F_STOPPED_BIT = 18,
    RTHYB_F_REFUSED = 1 << 23, /* the operator's command of this tick was refused */
    /* bits 24 to 31: that command, enum rthyb_command; not itself a flag */
    RTHYB_F_COMMAND_BIT = 24
};

/* With several axes, rthyb_record.cause contains the cause in its lowest byte; the bits above it contain the axis,
 * interface or sensor of the cause, which links are down, which drive's count has diverged, and which sensors without
 * an actuator gave no reading. */
enum rthyb_cause_place {
    RTHYB_PLACE_BIT = 8,             /* three bits: 1 + index of axis or interface; 0: neither */
    RTHYB_PLACE_INTERFACE = 1 << 11, /* the index is that of an interface */
    RTHYB_PLACE_SENSOR_BIT = 12, /* four bits: 1 + index of a sensor without an actuator; 0: none */
    RTHYB_DOWN_BIT = 16,  /* bits 16 to 19: the link of this axis reported a failure in this tick */
    RTHYB_APART_BIT = 20, /* bits 20 to 22: rthyb_station_input.apart */
    RTHYB_APART_UNKNOWN = 7, /* value before the drives' counts have been compared */
    RTHYB_SILENT_BIT = 23    /* bits 23 to 30: no reading of this sensor arrived in this tick */
};

/* One axis. */
typedef struct {
    /* reading as received by the station, accepted or not, calibrated, before tare; NaN: not a number or,
     * with several axes, nothing received */
    double x_read_m;
    double f_read_n; /* the same for the force; with one axis, both are 0 if nothing was received */
    double x_cmd_m;  /* x_p[n], as in effect at the drive */
    double x_meas_m; /* x_m[n], accepted or predicted, after tare */
    double f_meas_n; /* f[n], accepted or predicted, after tare */
    /* consecutive samples, including this one, in which this axis had no accepted pair */
    uint32_t missing;
    uint16_t echo;  /* low bits of the sequence number of the command in effect at the drive */
    uint16_t count; /* low bits of the drive's own sample count */
} rthyb_axis_record;

/* A row with n axes is the record up to its n-th axis: the first rthyb_record_bytes(n) bytes. Single values, such as
 * x_num_m, are those of the first axis or interface; those of the others are in channels (rthyb_station_config). */
typedef struct {
    uint64_t tick;        /* n, counted from the first sample of the test */
    int64_t due_ns;       /* when the tick was due, from the start of the test */
    int32_t wake_late_ns; /* wake-up after due_ns */
    int32_t sent_late_ns; /* command sent after due_ns */
    uint32_t flags;       /* enum rthyb_flag */
    uint32_t generation;  /* parameter generation in force */
    uint16_t code;        /* enum rthyb_status */
    uint16_t state;       /* enum rthyb_state */
    uint32_t cause;       /* enum rthyb_cause, as latched after the tick */
    double ag_mps2;       /* ground acceleration at t_n */
    double x_num_m;       /* x_c[n], command of the integration */
    double x_plc_m;       /* output of the control law */
    /* delay estimate reported by the control law, after the update in tick n: samples */
    double alpha;
    double beta;        /* curvature, likewise: samples squared; NaN: not available */
    double k_t_n_per_m; /* tangent stiffness that the RFC used */
    double energy_error_j;
    double tracking_indicator_m2;
    rthyb_axis_record axis[RTHYB_COUPLED_MAX];
} rthyb_record;

/* Size of a row with this number of axes, which is also the distance between rows in an array. */
size_t rthyb_record_bytes(int32_t axis_count);

const char *rthyb_version(void);
const char *rthyb_compiler(void);
/* SHA-256 of the sources of the core (source_hash.cmake); "" if built without CMake. */
const char *rthyb_source_hash(void);
/* cffi: end */

#endif
