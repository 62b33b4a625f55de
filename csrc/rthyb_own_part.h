/* User-defined numerical parts: a shared library (rthyb_library.h), an FMU for co-simulation, or a Python class.
 * numerical_library.c runs all three, numerical_fmu.c calls an FMU, and library_trial.c tests a part in a separate
 * process. */
#ifndef RTHYB_PART_OWN_PART_H
#define RTHYB_PART_OWN_PART_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_library.h"
#include "rthyb_numerical.h"

/* cffi: begin */

/* Functions of a library, named without the prefix rthyb_part_; NULL: not exported. */
typedef struct {
    int32_t (*init)(void *state, const rthyb_part_setup *setup);
    int32_t (*answer)(void *state, double ag_mps2, const double *force_n, double *x_next_m);
    int32_t (*advance)(void *state);
    void (*freeze)(void *state, const double *force_n);
    void (*report)(const void *state, double *values);
    void (*save)(void *state);
    void (*restore)(void *state);
} rthyb_part_calls;

/* Settings of RTHYB_NUMERICAL_LIBRARY. */
typedef struct {
    rthyb_part_calls calls;
    rthyb_part_setup setup;
    /* passed to all calls instead of the state, for a part that keeps its state elsewhere; or NULL */
    void *instance;
    int64_t state_bytes; /* only without an instance */
    int32_t interfaces, responses;
    /* for each interface as the rest of the program counts them: its number in the part, from 0; each once */
    int32_t place[RTHYB_INTERFACES_MAX];
} rthyb_library_config;

/* For a part that rthyb_numerical_init rejected: the value returned by the part's own init. */
int32_t rthyb_library_refusal(const rthyb_numerical *part);

enum rthyb_library_size { RTHYB_LIBRARY_STATE_MAX = 1 << 30 };

/* ---- an FMU (numerical_fmu.c) ------------------------------------------------------------------ */

enum rthyb_fmu_size {
    RTHYB_FMU_PARAMETERS_MAX = 256,
    RTHYB_FMU_RESPONSES_MAX = 32,
    RTHYB_FMU_INTERFACES_MAX = 8,
    RTHYB_FMU_TEXT = 256
};

/* Addresses of an FMU's functions; names as in the standard, without their prefix. */
typedef void (*rthyb_any_function)(void);
typedef struct {
    rthyb_any_function instantiate, free_instance, enter_initialization, exit_initialization;
    rthyb_any_function setup_experiment; /* FMI 2 only */
    rthyb_any_function set, get, do_step, terminate;
} rthyb_fmu_functions;

typedef struct {
    int32_t fmi; /* 2 or 3 */
    rthyb_fmu_functions call;
    const char *name, *token, *resources; /* token: in FMI 2, the guid */
    int32_t interfaces, responses, parameters;
    uint32_t ground_acceleration; /* value references */
    int32_t has_ground_acceleration;
    uint32_t force[RTHYB_FMU_INTERFACES_MAX], displacement[RTHYB_FMU_INTERFACES_MAX];
    uint32_t response[RTHYB_FMU_RESPONSES_MAX], parameter[RTHYB_FMU_PARAMETERS_MAX];
    /* internal from here on */
    void *instance, *callbacks[5];
    double period_s;
    int64_t step;
    char said[RTHYB_FMU_TEXT]; /* last message from the FMU */
} rthyb_fmu;

/* Functions of a part whose instance `of` is a rthyb_fmu. init sets the parameters before the FMU is initialised. */
int32_t rthyb_fmu_init(void *of, const rthyb_part_setup *setup);
int32_t rthyb_fmu_answer(void *of, double ag_mps2, const double *force_n, double *x_next_m);
void rthyb_fmu_report(const void *of, double *values);
/* Terminates the FMU and frees its resources; calling it again has no effect. */
void rthyb_fmu_close(rthyb_fmu *fmu);

/* ---- a trial (library_trial.c) ----------------------------------------------------------------- */

enum rthyb_trial_end {
    RTHYB_TRIAL_NOT_TRIED, /* no second process could be created */
    RTHYB_TRIAL_DONE,
    RTHYB_TRIAL_REFUSED, /* number: value returned by init */
    RTHYB_TRIAL_CRASHED, /* number: signal */
    RTHYB_TRIAL_ENDED,   /* number: exit status; the part ended the process */
    RTHYB_TRIAL_STUCK,   /* not completed in time */
    RTHYB_TRIAL_CALLED   /* number: number of the system call that a step made */
};

enum rthyb_trial_stage { RTHYB_TRIAL_IN_INIT, RTHYB_TRIAL_IN_STEPS, RTHYB_TRIAL_WATCHED };

typedef struct {
    int32_t ended; /* enum rthyb_trial_end */
    int32_t stage; /* enum rthyb_trial_stage: stage reached */
    int32_t number;
    int32_t watched;                  /* system calls could be monitored */
    int32_t status;                   /* status bits of all steps */
    uint32_t steps;                   /* steps completed */
    uint64_t allocations;             /* memory allocations in the monitored steps */
    double step_s, worst_s, answer_s; /* median and largest time of a step; median time of answer */
} rthyb_trial;

/* Runs a part with an elastic specimen of stiffness k_e (interfaces x interfaces, row by row) in a child process, for
 * `steps` steps (at most 4096) to measure time and as many again with system calls monitored; terminates it after
 * `most_s`. The state of the part itself does not change. */
void rthyb_part_try(const rthyb_numerical *part, double period_s, const double *k_e_n_per_m,
                    uint32_t steps, double most_s, rthyb_trial *result);
/* cffi: end */

#endif
