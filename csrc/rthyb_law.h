/* Control laws: their descriptions and their execution (control_law.c; one file per law, law_NAME.c). */
#ifndef RTHYB_PART_LAW_H
#define RTHYB_PART_LAW_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_record.h"

/* cffi: begin */

enum rthyb_law_size {
    RTHYB_LAW_PARAMETERS_MAX = 32,
    RTHYB_LAW_VALUES_MAX = 32,     /* reported by one law */
    RTHYB_LAW_STATE_BYTES = 16384, /* largest state of a law */
    RTHYB_LAW_NUMBERS = 4          /* in one rthyb_law_complaint */
};

enum rthyb_open { RTHYB_OPEN_LOW = 1, RTHYB_OPEN_HIGH = 2 };

/* Initial values of a law in the benchmark: its own derivation from the rig file, the defaults in its table, or
 * the inverse a0 + a1 s + a2 s^2 ... of this order, fitted to the rig's sweep, for its parameters a0, a1_s, and
 * a2_share = a2 / a1^2, a3_share = a3 / a1^3. */
enum rthyb_benchmark_start {
    RTHYB_START_RIG = 0,
    RTHYB_START_SECOND_ORDER = 2,
    RTHYB_START_THIRD_ORDER = 3,
    RTHYB_START_TABLE = 4
};

typedef struct {
    const char *key;  /* in a test file, below [controller] */
    const char *unit; /* "" for a dimensionless number */
    double low, high;
    double
        standard; /* default; NaN: none, so that the test file must give it, or the rig file at rig_key */
    const char *meaning;
    int32_t open;        /* enum rthyb_open: bounds that are excluded from the range */
    const char *rig_key; /* key in a rig file, used if the test file has no value; or NULL */
    const char *words;   /* text in a summary, {} for the number; NULL: not shown */
} rthyb_law_parameter;

typedef struct {
    const char *name, *unit;
    const char *label; /* in figures */
    uint64_t offset;   /* of the double in the state of the law */
} rthyb_law_value;

typedef struct {
    const char *name;    /* controller.type */
    const char *meaning; /* one line */
    const char *calmer;  /* advice if it adapts wrongly; NULL: it does not adapt */
    const rthyb_law_parameter *parameters;
    const rthyb_law_value *values; /* reported values; alpha and beta are stored in the record */
    uint32_t parameter_count, value_count;
    int32_t uses_rest_noise; /* not 0: needs rest_noise_m */
    /* not 0: designed for use with the restoring-force compensator (laws taken from other publications are not) */
    int32_t with_rfc;
    int32_t passes; /* not 0: the command is x_c itself, and force compensation is off */
    /* not 0: settings that are left open keep the constants printed in the paper, whatever the rig; so do those
     * of force compensation, and its tangent is the mean of ratios */
    int32_t as_printed;
    int32_t learns_curvature; /* not 0: a phase lead that adapts beta as well as alpha */
    int32_t benchmark_start;  /* enum rthyb_benchmark_start */
} rthyb_law_description;

/* Why settings that are each within their range are invalid in combination. The text has {} for each
 * number, and refers to other settings by the last part of their keys. */
typedef struct {
    const char *text;
    double numbers[RTHYB_LAW_NUMBERS];
} rthyb_law_complaint;

/* Initial conditions of a law. Parameters are in the order of its table, and finite. The ranges in the table are
 * enforced for test files only; a caller of the core may exceed them, so a law must remain memory-safe for any
 * finite value. */
typedef struct {
    const double *parameters;
    double period_s;
    double x0_m;         /* command and specimen are at rest here */
    double rest_noise_m; /* standard deviation of x_m measured at rest */
} rthyb_law_start;

/* The state belongs to the law: state_size bytes without pointers, so that a copy of the bytes is a complete copy
 * of the law. None of these functions may allocate memory, take a lock or make a system call; each must return
 * within a bounded time. */
typedef struct {
    rthyb_law_description is;
    size_t state_size;
    /* Checks parameters that are each within their range for combinations that are invalid at this sampling
     * period. Returns -1, or the index of the parameter to change. Values that come from the rig file may still be
     * NaN. May be NULL. */
    int (*check)(const double *parameters, double period_s, rthyb_law_complaint *complaint);
    /* Returns 0 or an rthyb_error. The state is zeroed before the call. */
    int (*init)(void *state, const rthyb_law_start *start);
    /* Command and specimen are now at rest at x_m, so that the next lead(x_m) must give x_m. Adapted quantities are
     * kept. */
    void (*rest)(void *state, double x_m);
    /* The newest pair: the command in effect at the drive, and the measured displacement. frozen: update the
     * filters but do not adapt. Returns status bits. */
    int (*observe)(void *state, double x_p_m, double x_m_m, int frozen);
    /* x_c -> x_p for the same instant. The adaptation since the last call may change x_p by at most allowed_m; 0
     * prevents any change, INFINITY allows any. Returns status bits; *x_p_m must be finite for any x_c_m. */
    int (*lead)(void *state, double x_c_m, double allowed_m, double *x_p_m);
} rthyb_control_law;

typedef struct {
    int32_t kind; /* from rthyb_law_find; not stable between versions, and not used in recordings */
    const rthyb_control_law *own; /* a law of the user's own, used instead of `kind`; NULL: none */
    int32_t adapts;               /* 0: adapted quantities keep their initial values */
    double rest_noise_m;          /* standard deviation of x_m measured at rest */
    double parameters[RTHYB_LAW_PARAMETERS_MAX]; /* in the order of the law's table */
} rthyb_law_config;

typedef union {
    double align_double;
    uint64_t align_word;
    unsigned char bytes[RTHYB_LAW_STATE_BYTES];
} rthyb_law_state;

typedef struct {
    rthyb_law_config cfg;
    /* byte offsets of alpha and beta in the state; -1: the law has none */
    int32_t alpha_at, beta_at;
    rthyb_law_state state;
} rthyb_law;

/* Number of laws in this program; their order has no meaning. */
size_t rthyb_law_count(void);
/* -1: no such law. */
int32_t rthyb_law_find(const char *name);
/* NULL: no such law. */
const rthyb_law_description *rthyb_law_describe(int32_t kind);
size_t rthyb_law_state_size(int32_t kind);
/* Checks parameters that are each within their range for invalid combinations. Returns -1 if there is
 * none, or the index of the parameter to change. */
int rthyb_law_check(int32_t kind, const double *parameters, double period_s,
                    rthyb_law_complaint *complaint);
int rthyb_law_init(rthyb_law *law, const rthyb_law_config *cfg, double period_s, double x0_m);
void rthyb_law_rest(rthyb_law *law, double x_m);
int rthyb_law_observe(rthyb_law *law, double x_p_m, double x_m_m, int frozen);
/* The adaptation since the last call changes x_p by at most allowed_m; 0 prevents any change, INFINITY
 * allows any. */
int rthyb_law_lead(rthyb_law *law, double x_c_m, double allowed_m, double *x_p_m);
/* NaN if offset is -1. */
double rthyb_law_value_at(const rthyb_law *law, int32_t offset);
/* values must have room for RTHYB_LAW_VALUES_MAX numbers. */
void rthyb_law_report(const rthyb_law *law, double *values);
/* The same without alpha and beta, which are in the record; at most `most` values. Returns the number of values. */
uint32_t rthyb_law_report_beside(const rthyb_law *law, double *values, uint32_t most);
/* Applies the law without adaptation to n samples. */
int rthyb_law_run(rthyb_law *law, const double *x_c_m, double *x_p_m, size_t n);
/* cffi: end */

#endif
