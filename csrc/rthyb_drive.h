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
    RTHYB_FAULT_DROP,         /* a feedback is lost, with a probability of value */
    RTHYB_FAULT_DROP_COMMAND, /* the same of commands */
    RTHYB_FAULT_DROP_FORCE,   /* CAN: the second frame of a feedback is lost */
    RTHYB_FAULT_DELAY,        /* feedback delayed by value ticks */
    RTHYB_FAULT_REORDER,      /* every other feedback arrives after the next one */
    RTHYB_FAULT_DUPLICATE,    /* each frame twice */
    RTHYB_FAULT_CORRUPT,      /* one bit of each frame is wrong */
    RTHYB_FAULT_STUCK,        /* displacement repeats its first value */
    RTHYB_FAULT_JUMP,         /* value added to the displacement */
    RTHYB_FAULT_FORCE,        /* value added to the force */
    RTHYB_FAULT_NOT_FINITE,   /* displacement is no number */
    RTHYB_FAULT_SILENCE,      /* neither sends nor receives */
    RTHYB_FAULTS
};

typedef struct {
    int32_t kind;          /* enum rthyb_drive_fault */
    uint64_t first, ticks; /* of the drive: from first on, so many */
    double value;
} rthyb_fault;

enum rthyb_drive_phase {
    RTHYB_DRIVE_STOPPED, /* stands, whatever it is told, until a fresh command in state IDLE; latched:
                          * until one with RTHYB_TOLD_RESET */
    RTHYB_DRIVE_FOLLOWING,
    RTHYB_DRIVE_STOPPING
};

/* What the drive received and did in one of its ticks. */
typedef struct {
    double x_m;       /* newest command received, as decoded */
    double target_m;  /* target of the actuator, after the calibration */
    double read_x_m;  /* reading that was sent, before rounding on the wire */
    double read_f_n;  /* the same of the force; its count is the tick's low bits */
    uint32_t seq;     /* of that command */
    uint32_t state;   /* in that command */
    uint32_t frames;  /* commands in this tick, valid or not; 0: the values above are old */
    uint32_t refused; /* of those: damaged, not finite, or not a command */
    uint32_t phase;   /* enum rthyb_drive_phase, after the tick */
    uint32_t silent;  /* ticks since the last fresh sequence number */
} rthyb_drive_entry;

enum rthyb_drive_size {
    RTHYB_DRIVE_WATCHDOG =
        20,                   /* ticks of 1/1024 s without a fresh sequence number, then it stops */
    RTHYB_DRIVE_HELD_MAX = 64 /* feedbacks on their way; RTHYB_FAULT_DELAY is less */
};

/* Frames of one sample that wait until a tick. */
typedef struct {
    rthyb_frame frames[2];
    int32_t count; /* 0: free */
    int32_t after; /* leaves after the others of that tick */
    uint64_t due;
} rthyb_held;

/* An actuator controller with load cell: rig, wire and a watchdog that counts its own ticks. It
 * begins STOPPED, and not latched: nothing has gone wrong yet. */
typedef struct {
    rthyb_plant plant; /* of one axis, or one that several drives share (rthyb_drives) */
    rthyb_link *link;
    rthyb_codec codec;
    rthyb_calibration calibration; /* the controller's; the drive applies its inverse */
    double origin_m;               /* where the rig's zero lies, behind the calibration */
    double stop_decel_m_per_s2;
    rthyb_drive_entry *log; /* the caller's; entry of tick n in log[n] while there is room */
    size_t log_size;
    uint64_t seed;
    double drift_ppm; /* its clock is fast by so much; rthyb_drive_run alone */
    double gained_ns;
    uint32_t watchdog; /* in its ticks, whose rate is the plant's */
    uint64_t tick;
    const rthyb_fault *faults; /* the caller's */
    size_t fault_count;
    int32_t phase;   /* enum rthyb_drive_phase */
    int32_t latched; /* it has stopped by itself and has not been reset */
    uint32_t seq, seq_mask, silent;
    uint32_t state;             /* of the last fresh command */
    double wanted_m;            /* of the last fresh command */
    double target_m, target1_m; /* current and previous target of the actuator */
    double stuck_m;
    int32_t stuck; /* stuck_m is in force */
    uint64_t random;
    rthyb_deframer deframer;
    rthyb_drive_entry now;
    rthyb_held held[RTHYB_DRIVE_HELD_MAX];
} rthyb_drive;

/* The members up to drift_ppm are the caller's; the rest becomes new. 0; RTHYB_E_CODEC; RTHYB_E_LIMIT
 * for the calibration, a deceleration that is not positive, or a drift beyond 199 ppm. */
int rthyb_drive_init(rthyb_drive *drive);
/* What goes wrong from now on; faults stay the caller's. 0, or RTHYB_E_LIMIT for a kind or a delay
 * that does not exist: then nothing changes. Between two ticks. */
int rthyb_drive_schedule(rthyb_drive *drive, const rthyb_fault *faults, size_t n);
/* One sample: takes commands in, latches, applies, answers. */
void rthyb_drive_tick(rthyb_drive *drive);
/* Ticks until the ticker is stopped; a tick slept through does not happen. */
void rthyb_drive_run(rthyb_drive *drive, rthyb_ticker *ticker);

/* Drives of the axes of one virtual rig, in its order, by one clock: that of the first. */
typedef struct {
    rthyb_drive *drive[RTHYB_COUPLED_MAX];
    int32_t count;
} rthyb_drives;

/* Each drive has been set up. 0, or RTHYB_E_PLANT: the rig that they share has other axes. */
int rthyb_drives_check(const rthyb_drives *drives);
void rthyb_drives_tick(rthyb_drives *drives);
void rthyb_drives_run(rthyb_drives *drives, rthyb_ticker *ticker);
/* cffi: end */

#endif
