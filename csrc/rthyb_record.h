/* Status of a sample, reasons for rejection, and the record of a sample: ring slot, HDF5 row, replay input.
 * Largest sizes, status bits, reasons of refusal, states and flags. */
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
    RTHYB_IWAN_SLIDERS = 12,   /* springs of a chain that yield one by one */
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
    RTHYB_S_TRIP = 128,                /* one of these is set to end the test */
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

/* What stands here is declared nowhere else: Python reads names, types and places of the fields from it, and
 * from them come the rows of a recording and the slots of the ring. In words of 8 bytes; nothing is padded. */
enum rthyb_record_size {
    RTHYB_CHANNELS_MAX = 32, /* named values that a row may have beside its record */
    RTHYB_TEST_WORDS = 13,   /* of a record, without its axes */
    RTHYB_AXIS_WORDS = 6,    /* of each axis */
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
    /* From here on: what the station was told in this tick, in its last record alone, never in a
     * blind one. With the reading it is all that a replay needs. */
    RTHYB_F_SLIP = 1 << 6,    /* the drive's count slipped relative to the tick, 192 ticks ago */
    RTHYB_F_LOST = 1 << 7,    /* the wire had no new pair; PREDICTED without it: the station
                               * refused the pair that came */
    RTHYB_F_DOWN = 1 << 8,    /* the link reported a failure */
    RTHYB_F_STOPPED = 1 << 9, /* the drive last reported that it has stopped by itself */
    RTHYB_F_SILENT = 1 << 10, /* the operator's side has been silent for too long */
    RTHYB_F_BEYOND = 1 << 11, /* the wire could not represent the command of the previous tick */
    RTHYB_F_TAKEN_OVER = 1
        << 12, /* no reading before this tick: the drive has x_cmd_m from others */
    /* Of several axes alone, from here to bit 22. */
    RTHYB_F_APART = 1 << 13, /* the drives' counts are more than one sample apart */
    RTHYB_F_UNSENT_BIT =
        14, /* bits 14 to 17: the command of this axis did not leave; no flag itself */
    RTHYB_F_STOPPED_BIT =
        18, /* bits 18 to 21: the drive of this axis has stopped by itself; no flag itself */
    RTHYB_F_REFUSED = 1 << 23, /* the operator's command of this tick was refused */
    RTHYB_F_COMMAND_BIT = 24   /* bits 24 to 31: that command, enum rthyb_command; no flag itself */
};

/* Of several axes, rthyb_record.cause has the cause in its lowest byte, above it where it belongs, which links
 * are down, and whose count has come apart. */
enum rthyb_cause_place {
    RTHYB_PLACE_BIT = 8,             /* three bits: 1 + axis or interface; 0: neither */
    RTHYB_PLACE_INTERFACE = 1 << 11, /* it is an interface */
    RTHYB_DOWN_BIT = 16,  /* bits 16 to 19: the link of this axis reported a failure in this tick */
    RTHYB_APART_BIT = 20, /* bits 20 to 22: rthyb_station_input.apart */
    RTHYB_APART_UNKNOWN = 7 /* what stands there before the drives' counts have been compared */
};

/* One axis. */
typedef struct {
    double x_read_m; /* reading as the station was told it, taken or not, calibrated, before
                      * the tare; NaN: what came was no number, or, with several axes, nothing */
    double f_read_n; /* the same of the force; both 0 where nothing came */
    double x_cmd_m;  /* x_p[n], as the drive has it */
    double x_meas_m; /* x_m[n], accepted or predicted, after tare */
    double f_meas_n; /* f[n], accepted or predicted, after tare */
    uint32_t
        missing;    /* samples in a row without an accepted pair of its own, this one among them */
    uint16_t echo;  /* low bits of the command sequence number the drive had applied */
    uint16_t count; /* low bits of the drive's own sample count */
} rthyb_axis_record;

/* A row of n axes is the record up to its n-th axis: rthyb_record_bytes(n) of it. What is said once, and what
 * has a channel of its own where there are several (rthyb_station_config), is of the first. */
typedef struct {
    uint64_t tick;        /* n, counted from the first sample of the test */
    int64_t due_ns;       /* when the tick was due, from the start of the test */
    int32_t wake_late_ns; /* woken after due */
    int32_t sent_late_ns; /* command sent after due */
    uint32_t flags;       /* enum rthyb_flag */
    uint32_t generation;  /* parameter generation in force */
    uint16_t code;        /* enum rthyb_status */
    uint16_t state;       /* enum rthyb_state */
    uint32_t cause;       /* enum rthyb_cause, as latched after the tick */
    double ag_mps2;       /* ground acceleration at t_n */
    double x_num_m;       /* x_c[n], command of the integration */
    double x_plc_m;       /* output of the control law */
    double alpha; /* reported by the control law under that name, after the update of tick n, */
    double beta;  /* in samples and samples squared; NaN: not available */
    double k_t_n_per_m; /* tangent stiffness that the RFC used */
    double energy_error_j;
    double tracking_indicator_m2;
    rthyb_axis_record axis[RTHYB_COUPLED_MAX];
} rthyb_record;

/* Of a row of so many axes: from one to the next in an array of them. */
size_t rthyb_record_bytes(int32_t axis_count);

const char *rthyb_version(void);
const char *rthyb_compiler(void);
/* SHA-256 of the sources of the core (source_hash.cmake); "" if built without CMake. */
const char *rthyb_source_hash(void);
/* cffi: end */

#endif
