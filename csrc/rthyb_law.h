/* Control laws: what a law says of itself, and one at work (control_law.c; one file each, law_NAME.c). */
#ifndef RTHYB_PART_LAW_H
#define RTHYB_PART_LAW_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_record.h"

/* cffi: begin */

enum rthyb_law_size {
    RTHYB_LAW_PARAMETERS_MAX = 32,
    RTHYB_LAW_VALUES_MAX = 32,     /* that one law reports */
    RTHYB_LAW_STATE_BYTES = 16384, /* largest state of a law */
    RTHYB_LAW_NUMBERS = 4          /* that a complaint may name */
};

enum rthyb_open { RTHYB_OPEN_LOW = 1, RTHYB_OPEN_HIGH = 2 };

typedef struct {
    const char *key;  /* of a test file, below [controller] */
    const char *unit; /* "" of a plain number */
    double low, high;
    double standard; /* without a word in the file; NaN: it must be said there, or by the rig */
    const char *meaning;
    int32_t open;        /* enum rthyb_open: bounds that it may come near but not take */
    const char *rig_key; /* of a rig file, which has it when the test does not; or NULL */
    const char *words;   /* how a summary says it, {} for the number; NULL: not at all */
} rthyb_law_parameter;

typedef struct {
    const char *name, *unit;
    const char *label; /* of a figure */
    uint64_t offset;   /* of the double in the law's state */
} rthyb_law_value;

typedef struct {
    const char *name;    /* controller.type */
    const char *meaning; /* in one line */
    const char *calmer;  /* what to do when it learns wrongly; NULL: it does not learn */
    const rthyb_law_parameter *parameters;
    const rthyb_law_value *values; /* that it reports: alpha and beta go into the record */
    uint32_t parameter_count, value_count;
    int32_t uses_rest_noise;
    int32_t with_rfc; /* made to run with the restoring-force compensator; a law of others is not */
} rthyb_law_description;

/* What is wrong with settings that are each within their range. Text with {} for each of the numbers;
 * other settings are named in it by the last part of their keys. */
typedef struct {
    const char *text;
    double numbers[RTHYB_LAW_NUMBERS];
} rthyb_law_complaint;

/* Where a law begins. Parameters are in the order of its table, and finite. The ranges of the table are
 * those of test files; who asks the core itself may go beyond them, so a law must not trust them with its
 * memory. */
typedef struct {
    const double *parameters;
    double period_s;
    double x0_m;         /* command and specimen stand here */
    double rest_noise_m; /* standard deviation of x_m measured at rest */
} rthyb_law_start;

/* State is the law's own, state_size plain bytes without a pointer in them: who copies them has all of
 * it. None of these allocates, locks or calls the system; each is done within a bounded time. */
typedef struct {
    rthyb_law_description is;
    size_t state_size;
    /* What parameters that are each within their range do wrong together at this sampling period: -1, or
     * the index of the one to blame. What only the rig knows may be NaN still. May be NULL. */
    int (*check)(const double *parameters, double period_s, rthyb_law_complaint *complaint);
    /* 0 or enum rthyb_error. The state is all zeros before. */
    int (*init)(void *state, const rthyb_law_start *start);
    /* Command and specimen stand at x_m now: leading x_m next gives x_m. What has been learnt stays. */
    void (*rest)(void *state, double x_m);
    /* The newest pair: the command that the drive had, and what was measured. frozen: take it in, but
     * learn nothing from it. Status bits. */
    int (*observe)(void *state, double x_p_m, double x_m_m, int frozen);
    /* x_c -> x_p for the same instant. What has been learnt since the last call may move x_p by no more
     * than allowed_m: 0 for not at all, INFINITY for as far as it likes. Status bits; *x_p_m is finite
     * whatever x_c_m is. */
    int (*lead)(void *state, double x_c_m, double allowed_m, double *x_p_m);
} rthyb_control_law;

typedef struct {
    int32_t kind;                 /* rthyb_law_find; of this program, and of no recording */
    const rthyb_control_law *own; /* the user's, in its place; NULL: it is of this program */
    int32_t adapts;               /* 0: what it would learn stays as it begins */
    double rest_noise_m;          /* standard deviation of x_m measured at rest */
    double parameters[RTHYB_LAW_PARAMETERS_MAX]; /* in the order of its table */
} rthyb_law_config;

typedef union {
    double align_double;
    uint64_t align_word;
    unsigned char bytes[RTHYB_LAW_STATE_BYTES];
} rthyb_law_state;

typedef struct {
    rthyb_law_config cfg;
    int32_t alpha_at, beta_at; /* bytes from the beginning of its state; -1: it has none */
    rthyb_law_state state;
} rthyb_law;

/* Of all laws in this program, whose order says nothing. */
size_t rthyb_law_count(void);
/* -1: no such law. */
int32_t rthyb_law_find(const char *name);
/* NULL: no such law. */
const rthyb_law_description *rthyb_law_describe(int32_t kind);
size_t rthyb_law_state_size(int32_t kind);
/* What parameters that are each within their range do wrong together: -1, or the index of the one to
 * blame. */
int rthyb_law_check(int32_t kind, const double *parameters, double period_s,
                    rthyb_law_complaint *complaint);
int rthyb_law_init(rthyb_law *law, const rthyb_law_config *cfg, double period_s, double x0_m);
void rthyb_law_rest(rthyb_law *law, double x_m);
int rthyb_law_observe(rthyb_law *law, double x_p_m, double x_m_m, int frozen);
/* What has been learnt since the last call moves x_p by no more than allowed_m: 0 not at all, INFINITY
 * as far as it likes. */
int rthyb_law_lead(rthyb_law *law, double x_c_m, double allowed_m, double *x_p_m);
/* NaN for an offset of -1. */
double rthyb_law_value_at(const rthyb_law *law, int32_t offset);
/* Room for RTHYB_LAW_VALUES_MAX. */
void rthyb_law_report(const rthyb_law *law, double *values);
/* The same without alpha and beta, which the record has; most of them at most. Returns how many. */
uint32_t rthyb_law_report_beside(const rthyb_law *law, double *values, uint32_t most);
/* Without learning. */
int rthyb_law_run(rthyb_law *law, const double *x_c_m, double *x_p_m, size_t n);
/* cffi: end */

#endif
