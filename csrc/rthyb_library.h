/* A numerical part of your own, as a shared library: what it exports, and what it may not do.
 *
 *   cc -O2 -shared -fPIC -I DIRECTORY_OF_THIS_FILE mine.c -o mine.so
 *
 * At each tick the program gives the library the ground acceleration and the measured force of t_n, and
 * the library answers with the displacement of t_{n+1}, which the actuator is sent. In real time this
 * happens up to 4096 times a second in a thread of its own: between init and the end of the test, answer, advance,
 * freeze and report may not allocate or free memory, call the system (files, clocks, printing, locks),
 * start threads, wait, or loop without a bound. Before a test in real time the program tries them out in a
 * process of its own: it refuses a library that allocates or calls the system, and one whose step takes
 * more than half of a sampling period.
 *
 * SI units. Whatever comes in is finite; whatever goes out that is not finite, or further than 1 km, is
 * replaced and noted in the recording. Of several interfaces each has its place in every array. */
#ifndef RTHYB_PART_LIBRARY_H
#define RTHYB_PART_LIBRARY_H

#include <stdint.h>

/* cffi: begin */

enum rthyb_library_version { RTHYB_LIBRARY_VERSION = 1 };

typedef struct {
    double period_s;           /* of a step */
    const double *parameter;   /* values of the test file, in the order of rthyb_part_names */
    const double *k_e_n_per_m; /* elastic stiffness of the specimen at each interface */
} rthyb_part_setup;

/* What rthyb_part_names is asked for. */
enum rthyb_part_names_of {
    RTHYB_PART_PARAMETERS, /* "mass_kg damping_n_s_per_m": keys of the test file */
    RTHYB_PART_RESPONSES   /* "roof[m] shear_1[N]": values of report, channels of the recording */
};

enum rthyb_part_names_size { RTHYB_PART_NAMES_ROOM = 2048 };

/* cffi: end */

/* ---- required ---- */

/* Return RTHYB_LIBRARY_VERSION. */
int32_t rthyb_part_version(void);
/* How many forces it takes and displacements it gives. */
int32_t rthyb_part_interfaces(void);
/* Bytes of a state. It is allocated, zeroed, and aligned for a double by the program; it holds no
 * pointers, so that a copy of the bytes is a copy of the part. */
int64_t rthyb_part_state_bytes(const rthyb_part_setup *setup);
/* At rest at 0. 0, or a number of your own for settings that you refuse. */
int32_t rthyb_part_init(void *state, const rthyb_part_setup *setup);
/* Ground acceleration and forces of t_n -> displacements of t_{n+1}. 0, or a number of your own: the
 * displacement of before is kept then. Nothing but this stands between force and command. */
int32_t rthyb_part_answer(void *state, double ag_mps2, const double *force_n, double *x_next_m);

/* ---- leave out what you do not need ---- */

/* Text with RTHYB_PART_NAMES_ROOM bytes for names, separated by spaces, with a zero at its end. */
void rthyb_part_names(int32_t of, char *text);
/* The rest of that step, once the command has left. 0, or a number of your own. */
int32_t rthyb_part_advance(void *state);
/* Instead of both while a ramp or a hold moves the actuator: the part's time stands still. */
void rthyb_part_freeze(void *state, const double *force_n);
/* The values that rthyb_part_names calls responses, after answer and before advance. */
void rthyb_part_report(const void *state, double *values);
/* The bytes of the state are about to be copied / have been put back: for what is kept elsewhere. */
void rthyb_part_save(void *state);
void rthyb_part_restore(void *state);

#endif
