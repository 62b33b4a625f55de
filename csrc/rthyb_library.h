/* Your own numerical part as a shared library: the functions that it exports, and what they must not do.
 *
 *   cc -O2 -shared -fPIC -I DIRECTORY_OF_THIS_FILE mine.c -o mine.so
 *
 * In each tick, the program passes the ground acceleration and the measured force at t_n to the library, which
 * returns the displacement at t_{n+1}; this is the command to the actuator. In real time this happens up to 4096
 * times per second in a separate thread: between init and the end of the test, answer, advance, freeze and report
 * must not allocate or free memory, make system calls (files, clocks, printing, locks), start threads, wait, or
 * loop without a bound. Before a test in real time, the program runs the library in a separate process and
 * rejects it if a step allocates memory or makes a system call, or takes longer than half a sampling period.
 *
 * All quantities are in SI units. All inputs are finite. An output that is not finite, or exceeds 1 km, is replaced,
 * and this is noted in the recording.
 *
 * With several interfaces, one for each direction in which the actuators move the specimen, every array has one entry
 * per interface: m and N for a displacement, rad and N m for a rotation. The test file assigns them to the directions
 * of the rig by their number, from 1: [[interface]] name = "theta", number = 2.
 *
 * A library that was built with version 1 of this header runs unchanged. */
#ifndef RTHYB_PART_LIBRARY_H
#define RTHYB_PART_LIBRARY_H

#include <stdint.h>

/* cffi: begin */

enum rthyb_library_version {
    RTHYB_LIBRARY_VERSION = 2,
    RTHYB_LIBRARY_VERSION_FIRST = 1 /* the oldest that is accepted */
};

typedef struct {
    double period_s;         /* length of a step */
    const double *parameter; /* values from the test file, in the order of rthyb_part_names */
    const double
        *k_e_n_per_m; /* elastic stiffness of the specimen at each interface, the others at rest */
    /* from version 2 on */
    int32_t interfaces; /* as returned by rthyb_part_interfaces */
    const double
        *stiffness_n_per_m; /* of the elastic specimen, interfaces x interfaces, row by row */
} rthyb_part_setup;

/* Which names rthyb_part_names is asked for. */
enum rthyb_part_names_of {
    RTHYB_PART_PARAMETERS, /* "mass_kg damping_n_s_per_m": keys of the test file */
    RTHYB_PART_RESPONSES   /* "roof[m] shear_1[N]": values of report, channels of the recording */
};

enum rthyb_part_names_size { RTHYB_PART_NAMES_ROOM = 2048 };

/* cffi: end */

/* ---- required ---- */

/* Return RTHYB_LIBRARY_VERSION of the header with which the library was built. */
int32_t rthyb_part_version(void);
/* Number of interfaces: forces in, displacements out; one for each direction of the rig, up to 8. */
int32_t rthyb_part_interfaces(void);
/* Size of the state in bytes. The program allocates it, zeroed and aligned for a double. It must not contain
 * pointers, so that a copy of the bytes is a copy of the part. */
int64_t rthyb_part_state_bytes(const rthyb_part_setup *setup);
/* Initialises the part at rest at 0. Returns 0, or an error number of your own to reject the settings. */
int32_t rthyb_part_init(void *state, const rthyb_part_setup *setup);
/* Ground acceleration and forces at t_n -> displacements at t_{n+1}. Returns 0, or an error number of your own, in
 * which case the previous displacement is kept. This is all that is computed between a reading and its command. */
int32_t rthyb_part_answer(void *state, double ag_mps2, const double *force_n, double *x_next_m);

/* ---- optional ---- */

/* Writes names, separated by spaces and terminated by a zero, to a buffer of RTHYB_PART_NAMES_ROOM bytes. */
void rthyb_part_names(int32_t of, char *text);
/* Completes the step after the command was sent. Returns 0, or an error number of your own. */
int32_t rthyb_part_advance(void *state);
/* Called instead of answer and advance while a ramp or a hold moves the actuator: the part's time must not
 * advance. */
void rthyb_part_freeze(void *state, const double *force_n);
/* Values of the responses listed by rthyb_part_names; called after answer and before advance. A value that is not
 * written, is not a number, or is beyond 1e150 is recorded as NaN. */
void rthyb_part_report(const void *state, double *values);
/* Called before the bytes of the state are copied, and after they were restored: for data kept outside the state. */
void rthyb_part_save(void *state);
void rthyb_part_restore(void *state);

#endif
