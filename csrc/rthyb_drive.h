/* The drive's side of the wire: the virtual drive (drive.c) and simulated faults. */
#ifndef RTHYB_PART_DRIVE_H
#define RTHYB_PART_DRIVE_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_loop.h"
#include "rthyb_plant.h"

/* cffi: begin */

/* Faults that can be simulated on the drive's side of the wire. */
enum rthyb_drive_fault {
    RTHYB_FAULT_DROP,         /* a feedback is lost with probability `value` */
    RTHYB_FAULT_DROP_COMMAND, /* the same for commands */
    RTHYB_FAULT_DROP_FORCE,   /* CAN: the second frame of a feedback is lost */
    RTHYB_FAULT_DELAY,        /* feedback is delayed by `value` ticks */
    RTHYB_FAULT_REORDER,      /* every other feedback arrives after the next one */
    RTHYB_FAULT_DUPLICATE,    /* each frame is sent twice */
    RTHYB_FAULT_CORRUPT,      /* one bit of each frame is wrong */
    RTHYB_FAULT_STUCK,        /* the displacement keeps its first value */
    RTHYB_FAULT_JUMP,         /* `value` is added to the displacement */
    RTHYB_FAULT_FORCE,        /* `value` is added to the force */
    RTHYB_FAULT_NOT_FINITE,   /* the displacement is not a number */
    RTHYB_FAULT_SILENCE,      /* the drive neither sends nor receives */
    RTHYB_FAULTS
};

typedef struct {
    int32_t kind;          /* enum rthyb_drive_fault */
    uint64_t first, ticks; /* begins at the drive's tick `first`, lasts `ticks` ticks */
    double value;
} rthyb_fault;

enum rthyb_drive_phase {
    /* ignores commands until a new one with state IDLE arrives; if latched, until one with RTHYB_NOTICE_RESET
     * arrives */
    RTHYB_DRIVE_STOPPED,
    RTHYB_DRIVE_FOLLOWING,
    RTHYB_DRIVE_STOPPING
};

/* What the drive received and did in one of its ticks. */
typedef struct {
    double x_m;      /* last command received, as decoded */
    double target_m; /* target of the actuator, after the calibration */
    double read_x_m; /* displacement reading sent, before rounding on the wire */
    /* force reading, likewise; the count sent with both is the low bits of the tick */
    double read_f_n;
    uint32_t seq;    /* sequence number of that command */
    uint32_t state;  /* state in that command */
    uint32_t frames; /* commands received in this tick, valid or not; 0: the values above are old */
    uint32_t refused; /* how many of them were rejected: damaged, not finite, or not a command */
    uint32_t phase;   /* enum rthyb_drive_phase, after the tick */
    uint32_t silent;  /* ticks since the last new sequence number */
} rthyb_drive_entry;

enum rthyb_drive_size {
    /* the drive stops after this many ticks of 1/1024 s without a new sequence number */
    RTHYB_DRIVE_WATCHDOG = 20,
    RTHYB_DRIVE_HELD_MAX = 64 /* feedbacks that are delayed; RTHYB_FAULT_DELAY must be less */
};

/* Frames of one sample, to be sent at a later tick. */
typedef struct {
    rthyb_frame frames[2];
    int32_t count; /* 0: free */
    int32_t after; /* sent after the others of that tick */
    uint64_t due;
} rthyb_held;

/* A drive with load cell: rig, wire and a watchdog that counts the drive's own ticks. The initial phase is
 * STOPPED, not latched, because no fault has occurred yet. */
typedef struct {
    rthyb_plant plant; /* a plant with one axis, or one that several drives share (rthyb_drives) */
    rthyb_link *link;
    rthyb_codec codec;
    rthyb_calibration calibration; /* that of the controller; the drive applies its inverse */
    double origin_m;               /* position of the rig's zero, after calibration */
    double stop_decel_m_per_s2;
    /* provided by the caller; tick n is logged in log[n] as long as there is room */
    rthyb_drive_entry *log;
    size_t log_size;
    uint64_t seed;
    double drift_ppm; /* by how much its clock is fast; only for rthyb_drive_run */
    double gained_ns;
    uint32_t watchdog; /* in ticks of the drive, whose rate is that of the plant */
    uint64_t tick;
    const rthyb_fault *faults; /* provided by the caller */
    size_t fault_count;
    int32_t phase;   /* enum rthyb_drive_phase */
    int32_t latched; /* it stopped on its own and has not been reset */
    uint32_t seq, seq_mask, silent;
    uint32_t state;             /* in the last new command */
    double wanted_m;            /* displacement in the last new command */
    double target_m, target1_m; /* current and previous target of the actuator */
    double stuck_m;
    int32_t stuck; /* stuck_m is in effect */
    uint64_t random;
    rthyb_deframer deframer;
    rthyb_drive_entry now;
    rthyb_held held[RTHYB_DRIVE_HELD_MAX];
} rthyb_drive;

/* The caller sets the members up to drift_ppm; this function sets the rest. Returns 0, RTHYB_E_CODEC, or
 * RTHYB_E_LIMIT for the calibration, a deceleration that is not positive, or a drift beyond 199 ppm. */
int rthyb_drive_init(rthyb_drive *drive);
/* Sets the faults to simulate from now on; the array remains the caller's and must stay valid. Returns 0, or
 * RTHYB_E_LIMIT for an unknown kind or an invalid delay, in which case nothing changes. Call between two ticks. */
int rthyb_drive_schedule(rthyb_drive *drive, const rthyb_fault *faults, size_t n);
/* One sample: receives commands, latches, applies, answers. */
void rthyb_drive_tick(rthyb_drive *drive);
/* Runs until the ticker is stopped; a missed tick is not made up for. */
void rthyb_drive_run(rthyb_drive *drive, rthyb_ticker *ticker);

/* Drives of one virtual rig, in the order of its axes, on one clock: that of the first drive. */
typedef struct {
    rthyb_drive *drive[RTHYB_COUPLED_MAX];
    int32_t count;
} rthyb_drives;

/* Call after initialising each drive. 0, or RTHYB_E_PLANT if the number of drives differs from the number of axes
 * of the rig that they share. */
int rthyb_drives_check(const rthyb_drives *drives);
void rthyb_drives_tick(rthyb_drives *drives);
void rthyb_drives_run(rthyb_drives *drives, rthyb_ticker *ticker);
/* cffi: end */

#endif
