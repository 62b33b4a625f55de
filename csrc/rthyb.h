/* rthyb: the real-time core of rthyb_rt.
 *
 * Contract
 *   - The caller allocates every struct; nothing here allocates, locks, blocks or keeps a global.
 *   - A struct is set up by its _init function, which returns 0 or the RTHYB_E_* of the first value
 *     that it refuses, and leaves a refused struct unusable.
 *   - A _step function takes one sample. It returns RTHYB_OK or a set of RTHYB_S_* bits. A sample
 *     that is not finite, or larger than any laboratory could mean, is never stored: the kernel
 *     works on with its last good value and says so by the code. State stays finite for ever.
 *   - A _run function is the same over n samples, for Python and for tests.
 *   - SI units everywhere: m, N, s, kg. alpha is in samples, beta in samples squared.
 *
 * Names follow Chen & Tsai (15WCEE 2012): x_c the command of the integration, x_p the compensated
 * command that the drive has, x_m the measured displacement. Time index: at instant t_n the rig
 * latches x_m[n] and f[n], then applies x_p[n], computed at tick n-1.
 */
#ifndef RTHYB_H
#define RTHYB_H

#include <stddef.h>
#include <stdint.h>

#define RTHYB_VERSION "0.3.0"

/* What stands between the two markers is read by the C compiler and by cffi alike. */
/* cffi: begin */

enum rthyb_size {
    RTHYB_WINDOW_MAX = 4096,   /* largest T0 of the tangent stiffness, samples: 1 s at 4096 Hz */
    RTHYB_DELAY_MAX = 4096,    /* longest transport delay of a virtual actuator, samples: 1 s */
    RTHYB_ELEMENTS_MAX = 16,   /* elements of one specimen */
    RTHYB_ELEMENT_PARAMS = 16, /* parameters of one element */
    RTHYB_IWAN_SLIDERS = 12,   /* springs of a chain that yield one by one */
    RTHYB_ELEMENT_STATES = 16  /* history variables of one element */
};

/* What a sample was like; bits, because several may be true at once. A record has sixteen of them. */
enum rthyb_status {
    RTHYB_OK = 0,
    RTHYB_S_NOT_FINITE = 1,            /* NaN or inf came in, or would have gone out */
    RTHYB_S_OUT_OF_RANGE = 2,          /* finite, but outside the sensor's range or any sense */
    RTHYB_S_LIMITED = 4,               /* the limiter changed the command */
    RTHYB_S_POSITION_LIMIT = 8,        /* the command went past its position limit */
    RTHYB_S_FORCE_LIMIT = 16,          /* the measured force went past its limit */
    RTHYB_S_TRACKING_LIMIT = 32,       /* |x_m - x_c| went past its limit */
    RTHYB_S_LINK_LOST = 64,            /* for 19.5 ms no accepted pair */
    RTHYB_S_TRIP = 128,                /* one of these is set to end the test */
    RTHYB_S_VELOCITY_LIMIT = 1 << 8,   /* the command's velocity went past its limit */
    RTHYB_S_INCREMENT_LIMIT = 1 << 9,  /* its change from sample to sample did */
    RTHYB_S_INDICATOR_LIMIT = 1 << 10, /* the slope of the tracking indicator did */
    RTHYB_S_ENERGY_LIMIT = 1 << 11,    /* the energy error did */
    RTHYB_S_SENSOR_STUCK = 1 << 12,    /* a sensor repeats itself */
    RTHYB_S_SENSOR_JUMP = 1 << 13,     /* a reading leapt */
    RTHYB_S_LOST_RATE = 1 << 14,       /* too large a share of pairs is lost */
    RTHYB_S_SKIP_RATE = 1 << 15,       /* too large a share of ticks was skipped */
    RTHYB_LOST = 1 << 16               /* of an input only: nothing arrived */
};

/* What an _init function refuses. */
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
    RTHYB_E_LIMIT, /* a limit, or a starting value beyond any sense */
    RTHYB_E_LAW    /* no such control law, or parameters that it cannot work with */
};

/* ---- one record: ring slot, HDF5 row and replay input -------------------------------------- */

/* What stands here is declared nowhere else: Python reads names, types and places of the fields from it, and
 * from them come the rows of a recording and the slots of the ring. */
enum rthyb_record_size {
    RTHYB_AXES = 1,          /* displacements that are commanded, each with its force */
    RTHYB_CHANNELS_MAX = 32, /* named values that a row may have beside its record */
    RTHYB_RECORD_WORDS = 19  /* of 8 bytes; the record has no padding */
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
    RTHYB_F_BLIND = 4,     /* a skipped tick, made up for later */
    RTHYB_F_FROZEN = 8,    /* alpha and k_t held */
    RTHYB_F_LIMITED = 16,  /* the limiter changed the command */
    RTHYB_F_NOT_SENT = 32,
    /* From here on: what the station was told in this tick, in its last record alone, never in a
     * blind one. With the reading it is all that a replay needs. */
    RTHYB_F_SLIP = 1 << 6,    /* the drive's count has slipped against the tick, 192 ticks ago */
    RTHYB_F_LOST = 1 << 7,    /* the wire had no new pair; PREDICTED without it: the station
                               * refused the pair that came */
    RTHYB_F_DOWN = 1 << 8,    /* the link reported a failure */
    RTHYB_F_STOPPED = 1 << 9, /* the drive's last word is that it has stopped by itself */
    RTHYB_F_SILENT = 1 << 10, /* the operator's side has been silent for too long */
    RTHYB_F_BEYOND = 1 << 11, /* the wire cannot hold the command of the tick before */
    RTHYB_F_TAKEN_OVER = 1
        << 12,                 /* no reading before this tick: the drive has x_cmd_m from others */
    RTHYB_F_REFUSED = 1 << 23, /* the operator's command of this tick was refused */
    RTHYB_F_COMMAND_BIT = 24   /* bits 24 to 31: that command, enum rthyb_command; no flag itself */
};

/* One axis. */
typedef struct {
    double x_read_m;  /* reading as the station was told it, taken or not, calibrated, before
                       * the tare; NaN: what came was no number */
    double f_read_n;  /* the same of the force; both 0 where nothing came */
    double x_cmd_m;   /* x_p[n], as the drive has it */
    double x_meas_m;  /* x_m[n], accepted or predicted, after tare */
    double f_meas_n;  /* f[n], accepted or predicted, after tare */
    uint32_t missing; /* samples in a row without an accepted pair, this one among them */
    uint16_t echo;    /* low bits of the command sequence number the drive had applied */
    uint16_t count;   /* low bits of the drive's own sample count */
} rthyb_axis_record;

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
    double alpha;       /* what the control law reports by that name, after the update of tick n, */
    double beta;        /* samples and samples squared; NaN: it has none */
    double k_t_n_per_m; /* tangent stiffness that the RFC used */
    double energy_error_j;
    double tracking_indicator_m2;
    rthyb_axis_record axis[RTHYB_AXES];
} rthyb_record;

/* ---- phase-lead compensator (plc.c) --------------------------------------------------------- */

typedef struct {
    double w1, w2;
    double x1, x2;      /* x_c[n-1], x_c[n-2] */
    double y1, y2;      /* x_p[n-1], x_p[n-2] */
    double alpha, beta; /* last good ones */
} rthyb_plc;

/* 1 if the poles of Eqn 2.5 lie inside the unit circle (Fig. 2.1), else 0. */
int rthyb_plc_is_stable(double w1, double w2);
int rthyb_plc_init(rthyb_plc *plc, double w1, double w2, double x0_m);
int rthyb_plc_step(rthyb_plc *plc, double alpha, double beta, double x_c_m, double *x_p_m);
int rthyb_plc_run(rthyb_plc *plc, const double *alpha, const double *beta, const double *x_c_m,
                  double *x_p_m, size_t n);

/* ---- delay estimator (delay_estimator.c) ---------------------------------------------------- */

enum rthyb_estimator_law {
    RTHYB_LAW_FIXED,    /* alpha and beta stay where they start */
    RTHYB_LAW_GRADIENT, /* Eqn 2.6-2.11 as printed */
    RTHYB_LAW_ROBUST,   /* the same behind filter pair, gate, projection, power normalisation */
    RTHYB_LAW_RLS       /* recursive least squares of alpha, or of alpha and beta */
};

typedef struct {
    int32_t law;           /* enum rthyb_estimator_law */
    int32_t estimate_beta; /* RLS only */
    double alpha0, beta0;
    double period_s;
    double reference_m;    /* unit of mu and phi in the normalisation 1 + phi^2: the paper's 1 mm */
    double gain;           /* gradient: per reference^2 per sample; robust: per sample */
    double memory_samples; /* RLS: the weight of a sample falls by 1/e in so many samples */
    double cutoff_hz;      /* filter pair of robust and RLS */
    double alpha_min, alpha_max;
    double rest_noise_m; /* standard deviation of x_m measured at rest */
    double gate_factor;  /* adapt only while phi's power exceeds so many times its power at rest */
} rthyb_estimator_config;

typedef struct {
    double b0, b1, b2, a1, a2;
} rthyb_lowpass;

typedef struct {
    rthyb_estimator_config cfg;
    double w1, w2; /* of the compensator that is led */
    rthyb_lowpass filter;
    double unit;                     /* 1 / reference_m */
    double filter_p[2], filter_m[2]; /* states of the pair: low-pass */
    double level_p, level_m;         /* and what it takes away as offset */
    double level_weight;             /* of a sample in that; 1 before the first */
    double p1, p2, m1, m2;           /* x_p[n-1], x_p[n-2], x_m[n-1], x_m[n-2], filtered */
    double last_p, last_m;           /* last good inputs */
    double alpha, beta;
    double power;                     /* mean phi^2 over about 2 s */
    double short_power;               /* mean phi^2 over 0.2 s, for the gate */
    double gate_power;                /* what short_power must exceed */
    double forget;                    /* RLS: lambda */
    double r11, r12, r22, q1, q2;     /* RLS: weighted normal equations */
    double noise11, noise12, noise22; /* RLS: what rest noise alone adds to them per sample */
    double noise1, noise2;
    double weight;         /* RLS: sum of weights */
    double ridge1, ridge2; /* RLS: weight of the starting values */
    int32_t open;          /* the gate, for the record */
} rthyb_estimator;

int rthyb_estimator_init(rthyb_estimator *est, const rthyb_estimator_config *cfg, double w1,
                         double w2, double x0_m);
/* frozen != 0 takes the pair in but leaves alpha and beta alone. */
int rthyb_estimator_step(rthyb_estimator *est, double x_p_m, double x_m_m, int frozen);
int rthyb_estimator_run(rthyb_estimator *est, const double *x_p_m, const double *x_m_m,
                        double *alpha, double *beta, size_t n);

/* ---- control laws (control_law.c; one file each, law_NAME.c) ---------------------------------- */

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
} rthyb_law_description;

/* What is wrong with settings that are each within their range. Text with {} for each of the numbers;
 * other settings are named in it by the last part of their keys. */
typedef struct {
    const char *text;
    double numbers[RTHYB_LAW_NUMBERS];
} rthyb_law_complaint;

typedef struct rthyb_control_law rthyb_control_law;

typedef struct {
    int32_t kind;        /* rthyb_law_find; of this program, and of no recording */
    int32_t adapts;      /* 0: what it would learn stays as it begins */
    double rest_noise_m; /* standard deviation of x_m measured at rest */
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
/* Without learning. */
int rthyb_law_run(rthyb_law *law, const double *x_c_m, double *x_p_m, size_t n);

/* ---- restoring-force compensator (rfc.c) ---------------------------------------------------- */

enum rthyb_tangent {
    RTHYB_TANGENT_MEAN_OF_RATIOS, /* Eqn 3.3 */
    RTHYB_TANGENT_LEAST_SQUARES   /* slope of f over x_m in the same window */
};

enum rthyb_divisor {
    RTHYB_DIVISOR_PRINTED, /* T0 + 1 terms divided by T0, as Eqn 3.3 stands */
    RTHYB_DIVISOR_TERMS    /* divided by the number of terms */
};

typedef struct {
    int32_t enabled;
    int32_t tangent;     /* enum rthyb_tangent */
    int32_t divisor;     /* enum rthyb_divisor; mean of ratios only */
    int32_t window;      /* T0, samples */
    double k_e_n_per_m;  /* elastic stiffness, upper bound */
    uint64_t end_tick;   /* t_ex: from this tick on k_exp = k_e again (stage 3) */
    double rest_noise_m; /* least squares holds k while x_m has moved less than this noise allows */
    double period_s;     /* of a sample; the low-pass alone needs it */
    double cutoff_hz;    /* of the low-pass on x_c - x_m; 0: none */
    double lateness_s;   /* of the force as it is used, behind x_m */
} rthyb_rfc_config;

typedef struct {
    rthyb_rfc_config cfg;
    uint64_t tick;
    uint32_t head, filled; /* next to be overwritten; samples in the window */
    double k_n_per_m;      /* bounded k_exp[n] */
    double ratio;          /* last term of Eqn 3.3 */
    double x1, f1, c1, v1; /* last good inputs */
    rthyb_lowpass filter;
    double filter_s[2];
    double x[RTHYB_WINDOW_MAX]; /* the T0 samples before the newest: x_m, or ratios (Eqn 3.3) */
    double f[RTHYB_WINDOW_MAX];
} rthyb_rfc;

int rthyb_rfc_init(rthyb_rfc *rfc, const rthyb_rfc_config *cfg, double x0_m, double f0_n);
/* force_n = f + k_exp (LP(x_c - x_m) + lateness v_c): what the equation of motion sees. v_c is asked for
 * where there is a lateness. frozen != 0 holds k_exp. */
int rthyb_rfc_step(rthyb_rfc *rfc, double x_c_m, double v_c_m_per_s, double x_m_m, double f_n,
                   int frozen, double *force_n);
/* Takes in what moves along a path, and learns nothing from it. */
void rthyb_rfc_follow(rthyb_rfc *rfc, double x_c_m, double x_m_m, double f_n);
/* v_c may be NULL: 0. */
int rthyb_rfc_run(rthyb_rfc *rfc, const double *x_c_m, const double *v_c_m_per_s,
                  const double *x_m_m, const double *f_n, double *force_n, double *k_n_per_m,
                  size_t n);

/* ---- equation of motion (motion.c) ---------------------------------------------------------- */

enum rthyb_integrator {
    RTHYB_CENTRAL_DIFFERENCE,
    RTHYB_FORWARD_EULER,
    RTHYB_CR,
    RTHYB_KR_ALPHA,
    RTHYB_PRESCRIBED, /* no equation: the next command is the excitation itself */
    RTHYB_RK4         /* classical Runge-Kutta with a held force: dense parts alone */
};

typedef struct {
    int32_t integrator; /* enum rthyb_integrator */
    double period_s;
    double mass_kg;       /* numerical mass: ground motion acts on it */
    double added_mass_kg; /* moves with it, but the ground motion does not act on it */
    double damping_n_s_per_m;
    double stiffness_n_per_m; /* numerical stiffness */
    double k_e_n_per_m;       /* specimen's elastic stiffness; CR and KR-alpha need it */
    double rho_inf;           /* KR-alpha: spectral radius at infinite frequency, 0 to 1 */
} rthyb_motion_config;

typedef struct {
    rthyb_motion_config cfg;
    double x, v, a;                /* at t_n */
    double x1, x2;                 /* x[n-1], x[n-2] */
    double v1, net1;               /* KR-alpha: v[n-1] and (P - f)[n-1] */
    double a1c, a2c, a3c, alpha_f; /* CR and KR-alpha coefficients */
    double per_mass, per_step;     /* 1 / mass (central difference: with its damping), 1 / h */
    double last_force, last_excitation;
} rthyb_motion;

int rthyb_motion_init(rthyb_motion *motion, const rthyb_motion_config *cfg, double x0_m);
/* m a + c v + k x + force = -m ag  at t_n  ->  x[n+1]. PRESCRIBED: excitation is x[n+1]. */
int rthyb_motion_step(rthyb_motion *motion, double excitation, double force_n, double *x_next_m);
/* Velocity at t_n before the step, as good as the integrator's order allows. */
double rthyb_motion_velocity(const rthyb_motion *motion);

/* ---- dense numerical part (numerical_dense.c) ------------------------------------------------- */

enum rthyb_dense_size {
    RTHYB_DENSE_MAX = 8,
    RTHYB_DENSE_SQUARE = 64, /* its square, */
    RTHYB_DENSE_STATES = 16, /* its double, */
    RTHYB_DENSE_STEP = 256   /* and that one's square */
};

typedef struct {
    int32_t integrator;  /* RTHYB_CR or RTHYB_RK4 */
    int32_t size;        /* n, degrees of freedom */
    int32_t at;          /* the one that is the interface, from 0 */
    int32_t force_delay; /* samples by which the force is used late: 0 or 1 */
    double period_s;
    /* Numerical part alone, n x n, row after row from the first number on; symmetric. */
    double mass_kg[RTHYB_DENSE_SQUARE];
    double damping_n_s_per_m[RTHYB_DENSE_SQUARE];
    double stiffness_n_per_m[RTHYB_DENSE_SQUARE];
    double load_kg[RTHYB_DENSE_MAX]; /* force of a ground acceleration of -1 m/s^2 */
    /* What is known of the specimen: CR's coefficients take it in, the equation does not. */
    double specimen_mass_kg, specimen_damping_n_s_per_m, k_e_n_per_m;
} rthyb_dense_config;

typedef struct {
    rthyb_dense_config cfg;
    double step[RTHYB_DENSE_STEP]; /* D of s += D s + ..., 2n x 2n */
    double by_force[RTHYB_DENSE_STATES], by_excitation[RTHYB_DENSE_STATES];
    double s[RTHYB_DENSE_STATES]; /* x, then v, at t_n */
    double change;    /* of the interface over the next step, without force and excitation */
    double x, x1, x2; /* of the interface, as answered */
    double a;         /* of the interface, over the last step */
    double force, last_force, excitation; /* of this step, as measured last, of this step */
    int32_t ran_off;
} rthyb_dense;

int rthyb_dense_init(rthyb_dense *s, const rthyb_dense_config *cfg, double x0_m);
/* M a + C v + K x + e force = -load ag  at t_n  ->  x[n+1] of the interface; two products. */
int rthyb_dense_answer(rthyb_dense *s, double excitation, double force_n, double *x_next_m);
/* The other degrees of freedom follow; before the next answer. */
int rthyb_dense_advance(rthyb_dense *s);

/* ---- numerical part by kind (numerical.c) ----------------------------------------------------- */

enum rthyb_numerical_kind {
    RTHYB_NUMERICAL_MOTION, /* rthyb_motion_config, rthyb_motion */
    RTHYB_NUMERICAL_DENSE,  /* rthyb_dense_config, rthyb_dense */
    RTHYB_NUMERICAL_KINDS
};

/* Settings and state are the caller's. A state is rthyb_numerical_size(kind) plain bytes without a
 * pointer. Two parts never share one. */
typedef struct {
    int32_t kind; /* enum rthyb_numerical_kind */
    const void *cfg;
    void *state;
} rthyb_numerical;

/* The interface at t_n: v and a as good as the integrator's order allows; x[n-1], x[n-2]. */
typedef struct {
    double x, v, a, x1, x2;
} rthyb_interface;

/* Bytes of a state; 0 for a kind that does not exist. */
size_t rthyb_numerical_size(int32_t kind);
/* At rest at x0. All others need a part that was set up. */
int rthyb_numerical_init(const rthyb_numerical *part, double x0_m);
/* Excitation and force at t_n -> x_c[n+1]: all that stands between a reading and its command. */
int rthyb_numerical_answer(const rthyb_numerical *part, double excitation, double force_n,
                           double *x_next_m);
/* The rest of that step, once the command has left; before anything else is asked of the part. */
int rthyb_numerical_advance(const rthyb_numerical *part);
/* Instead of answer and advance where a path has the command: the part's time stands still. */
void rthyb_numerical_freeze(const rthyb_numerical *part, double force_n);
/* A state to its bytes and back, of the same kind and settings. */
void rthyb_numerical_save(const rthyb_numerical *part, void *bytes);
void rthyb_numerical_restore(const rthyb_numerical *part, const void *bytes);
void rthyb_numerical_look(const rthyb_numerical *part, rthyb_interface *at);
/* Displacement of every degree of freedom, m, up to `most` of them; how many. */
size_t rthyb_numerical_report(const rthyb_numerical *part, double *values, size_t most);

/* ---- specimen elements (element.c) ---------------------------------------------------------- */

enum rthyb_element_kind {
    RTHYB_STIFFNESS,         /* k */
    RTHYB_VISCOUS,           /* c */
    RTHYB_COULOMB,           /* Fc, width m/s */
    RTHYB_STRIBECK,          /* Fc, Fs, vs, width */
    RTHYB_LUGRE,             /* Fc, Fs, vs, sigma0, sigma1, sigma2 */
    RTHYB_QUAD_DAMPING,      /* c2 */
    RTHYB_INERTIA,           /* m */
    RTHYB_GAP,               /* k, gap (half width) */
    RTHYB_CUBIC,             /* k3 */
    RTHYB_QUADRATIC,         /* k2 */
    RTHYB_STOPPER,           /* ks, xs */
    RTHYB_HYSTERESIS,        /* k, a, A, B, C, eta: Eqn 4.1-4.2 */
    RTHYB_PINCHING,          /* k, a, A, B, C, eta, depth, width */
    RTHYB_DEGRADATION,       /* k, a, A, B, C, eta, loss, travel */
    RTHYB_MAXWELL,           /* km, tau */
    RTHYB_SECOND_MODE,       /* m2, f2 Hz, zeta2 */
    RTHYB_P_DELTA,           /* gravity load, height */
    RTHYB_GAP_FRICTION,      /* k, gap (half width), Fc up, Fc down, seat */
    RTHYB_COULOMB_UNEVEN,    /* Fc up, Fc down, width m/s */
    RTHYB_GAP_UNEVEN,        /* k up, gap up, k down, gap down */
    RTHYB_POWER_DAMPING,     /* force, at velocity, exponent, width m/s */
    RTHYB_POWER_SPRING,      /* force, at displacement, exponent, width m */
    RTHYB_PENDULUM,          /* weight, length */
    RTHYB_FRICTION_PENDULUM, /* weight, radius, mu slow, mu fast, rate s/m, xy */
    RTHYB_IWAN,              /* k, a, xy, spread */
    RTHYB_MENEGOTTO_PINTO,   /* k, a, xy, R0, cR1, cR2 */
    RTHYB_CHABOCHE,          /* k, fy, H, gamma 1/m, Q, rate 1/m */
    RTHYB_RC_COLUMN,         /* k, a, xy, eta, pivot, ultimate m, strength lost there, energy J,
                              * strength and stiffness lost with it, slip, its level and width */
    RTHYB_ELEMENT_KINDS
};

typedef struct {
    int32_t kind; /* enum rthyb_element_kind */
    double params[RTHYB_ELEMENT_PARAMS];
    double state[RTHYB_ELEMENT_STATES];
    double x, v, a; /* last good motion: it stands in for a senseless one */
} rthyb_element;

/* Number of parameters that a kind takes, -1 for an unknown kind. */
int rthyb_element_param_count(int32_t kind);
int rthyb_element_init(rthyb_element *element, int32_t kind, const double *params, size_t n);
double rthyb_element_force(rthyb_element *element, double x_m, double v_m_per_s, double a_m_per_s2,
                           double dt_s);
int rthyb_element_run(rthyb_element *element, const double *x_m, const double *v_m_per_s,
                      const double *a_m_per_s2, double dt_s, double *force_n, size_t n);

/* ---- actuator models and the virtual rig (servo.c, rig.c) ----------------------------------- */

enum rthyb_servo_kind {
    RTHYB_PURE_DELAY,
    RTHYB_FIRST_ORDER,
    RTHYB_SECOND_ORDER,
    RTHYB_SERVO_HYDRAULIC,
    RTHYB_SERVO_VALVE /* transfer functions of valve, natural velocity feedback and actuator */
};

enum rthyb_hold { RTHYB_ZOH, RTHYB_FOH };

typedef struct {
    int32_t kind; /* enum rthyb_servo_kind */
    int32_t hold; /* enum rthyb_hold: how the drive joins two commands */
    double period_s;
    double delay_samples; /* transport: whole for pure delay and first order */
    double roll_off_hz;   /* first order */
    double natural_frequency_hz, damping_ratio, gain; /* second order */
    double kp_per_s, ki_per_s2;                       /* servo-hydraulic from here on */
    double valve_time_constant_s, stall_force_n, flow_limit_m_per_s;
    double oil_stiffness_n_per_m, oil_damping_n_s_per_m;
    double moving_mass_kg, friction_n, friction_width_m_per_s, viscous_n_s_per_m;
    int32_t substeps;
    /* Servo-valve G / (s^2 + b1 s + b2) on gain u - x, its flow less a2 v, force 1 / (s + a3) of that; mass,
     * stiffness and damping of the specimen, which a rig takes from its elements. */
    double valve_n_per_m_s3, valve_b1_per_s, valve_b2_per_s2;
    double velocity_feedback_n_s_per_m2, leakage_per_s;
    double specimen_stiffness_n_per_m, specimen_damping_n_s_per_m;
    double command_range_m, command_lsb_m; /* of the drive's input; 0 = unlimited, none */
} rthyb_servo_config;

enum rthyb_valve_size { RTHYB_VALVE_STATES = 5, RTHYB_VALVE_STEP = 35 };

typedef struct {
    rthyb_servo_config cfg;
    double x, v, a;      /* table: m, m/s, m/s^2 */
    double last_command; /* last good command */
    uint32_t head;       /* newest of past[] */
    double past[RTHYB_DELAY_MAX + 2];
    double fraction;            /* of delay_samples */
    double first[4], second[4]; /* free motion over the two parts of a sample, row by row */
    /* Servo-valve: the next state from state, command and force of the specimen's other elements; lengths of
     * its own make the five comparable. */
    double valve_step[RTHYB_VALVE_STEP], valve_state[RTHYB_VALVE_STATES];
    double integral, valve, piston, piston_velocity, half_velocity, oil_force;
    double valve_gain;
} rthyb_servo;

typedef struct {
    double noise_std; /* normal, white */
    double lsb;       /* quantisation, 0 = none */
    double bias;
    double range; /* saturates at +-range, 0 = unlimited */
} rthyb_sensor;

enum rthyb_load_cell { RTHYB_ACTUATOR_END, RTHYB_SPECIMEN_END };

typedef struct {
    rthyb_servo_config servo;
    rthyb_sensor displacement, force;
    int32_t load_cell; /* enum rthyb_load_cell */
    uint32_t element_count;
    rthyb_element elements[RTHYB_ELEMENTS_MAX];
    uint64_t seed;
} rthyb_rig_config;

typedef struct {
    rthyb_rig_config cfg;
    rthyb_servo servo;
    uint64_t random[2];
    double spare;
    int32_t has_spare;
    double x_true_m, f_true_n; /* what the sensors saw without their errors */
    double ridden_kg;          /* of the specimen's own mass, which rides on the table */
} rthyb_rig;

int rthyb_rig_init(rthyb_rig *rig, const rthyb_rig_config *cfg);
/* Begins the noise of the sensors anew, from the seed. */
void rthyb_rig_reseed(rthyb_rig *rig);
/* Latches x_m[n], f[n], then applies x_p[n] and moves on to t_{n+1}. */
int rthyb_rig_step(rthyb_rig *rig, double x_p_m, double *x_m_m, double *f_n);
int rthyb_rig_run(rthyb_rig *rig, const double *x_p_m, double *x_m_m, double *f_n, size_t n);

/* ---- one sample of the controller (controller.c) -------------------------------------------- */

typedef struct {
    double period_s;
    int32_t lead_enabled; /* 0: what the law leads by does not reach the command */
    rthyb_law_config law;
    rthyb_rfc_config rfc;
    rthyb_motion_config motion;
    rthyb_numerical
        numerical; /* another kind than `motion`, which then only says PRESCRIBED or not */
    double x_range_m, f_range_n; /* a reading beyond its sensor's range is not taken; 0 = off */
    double velocity_limit_m_per_s, acceleration_limit_m_per_s2; /* 0 = off */
    double clamp_m; /* the command never leaves clamp_centre_m +-clamp_m; 0 = off */
    double clamp_centre_m;
    int32_t estimate_held; /* what the law has learnt stays as it is */
} rthyb_controller_config;

typedef struct {
    rthyb_controller_config cfg;
    rthyb_law law;
    rthyb_rfc rfc;
    rthyb_motion motion;
    int32_t behind;    /* the numerical part has answered and has the rest of that step to do */
    int32_t late_code; /* status bits of that rest, for the next record */
    uint64_t tick;
    double x_num, x_plc, x_cmd; /* commands for t_n */
    double x_cmd1;              /* command for t_{n-1} */
    double x_lim, step;         /* command that left last, and its way from the one that left before
                                 * it: as the limiter had them, before the wire rounded */
    double x_lim1, step1;       /* the same before this sample, should its command not leave */
    uint32_t freeze_after, extrapolate_until; /* lost samples in a row: 2.9 ms, 19.5 ms */
    double lower_m, upper_m;                  /* the command may be no further out than these now */
    int32_t gap;                              /* a tick since then in which none left */
    double x_m1, f1, x_num1;
    double energy_error, tracking_indicator;
    uint32_t missing; /* samples in a row without an accepted pair */
    uint32_t generation;
    int32_t state;
} rthyb_controller;

typedef struct {
    double x_meas_m;
    double f_meas_n;
    double excitation; /* ag_mps2 of t_n; PRESCRIBED: x_num_m of t_{n+1} */
    int32_t lost;      /* 0, or why there is no pair: RTHYB_LOST, or the bits that refused it */
} rthyb_input;

int rthyb_controller_init(rthyb_controller *controller, const rthyb_controller_config *cfg);
/* Fills the record of tick n; controller->x_cmd is then the command for t_{n+1}. */
int rthyb_controller_step(rthyb_controller *controller, const rthyb_input *input,
                          rthyb_record *record);
/* What a sample has left to do once its command is known; rthyb_controller_step has done it. */
void rthyb_controller_advance(rthyb_controller *controller);

/* The bare controller at a virtual rig, without states or limits: for studies of the control alone.
 * excitation[n] for n_total samples; runs ticks until count more records are written or a value is not
 * finite. Returns the number of records written; *status has all bits seen. */
size_t rthyb_run_virtual(rthyb_controller *controller, rthyb_rig *rig, const double *excitation,
                         size_t n_total, size_t count, rthyb_record *records, int32_t *status);
/* The numerical structure and the specimen joined without actuator or sensor: the reference.
 * elements are advanced in place. Returns RTHYB_OK or the status bits seen; with too many elements
 * RTHYB_S_OUT_OF_RANGE at once. Mass belongs into added_mass_kg: an inertia element here has the
 * acceleration of the step before. */
int rthyb_run_reference(rthyb_motion *motion, rthyb_element *elements, size_t element_count,
                        const double *ag_mps2, size_t n, double *x_m, double *v_m_per_s,
                        double *force_n);
/* The same with a numerical part of any kind, and of its period; what is known of the specimen's mass
 * and damping belongs into the part's own. */
int rthyb_numerical_reference(const rthyb_numerical *part, rthyb_element *elements,
                              size_t element_count, const double *ag_mps2, size_t n,
                              double period_s, double *x_m, double *v_m_per_s, double *force_n);

/* ---- states, limits, faults (station.c) ------------------------------------------------------ */

enum rthyb_command {
    RTHYB_CMD_NONE,
    RTHYB_CMD_ZERO,   /* IDLE -> ZEROED: tare over tare_ticks at rest */
    RTHYB_CMD_ARM,    /* ZEROED -> ARMED */
    RTHYB_CMD_START,  /* ARMED -> RAMP_IN -> RUNNING */
    RTHYB_CMD_HOLD,   /* RUNNING -> HOLD; a RESUME that moves is braked again */
    RTHYB_CMD_RESUME, /* HOLD -> RUNNING */
    RTHYB_CMD_STOP,   /* anything that moves -> RAMP_OUT; ZEROED, ARMED -> IDLE */
    RTHYB_CMD_RESET,  /* TRIPPED -> IDLE, with a fresh reading of a specimen at rest */
    RTHYB_CMD_TRIP,   /* anything -> TRIPPED: a second signal, a broken link */
    RTHYB_CMD_COUNT
};

/* Why a test left its course; the first one since START (or RESET) is latched, but a fault takes the
 * place of COMPLETED and OPERATOR. */
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
    RTHYB_CAUSE_RIG_POSITION, /* before tare: where the drive was told to go */
    RTHYB_CAUSE_RIG_FORCE,    /* before tare */
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

typedef struct {
    rthyb_controller_config controller;
    /* SKIPS and what follows it; stuck: ticks, jump: m or N, shares: of 1. SKIPS with value 0 is
     * a ramp-out at 50 in 1024. */
    rthyb_watch watch[RTHYB_CAUSE_COUNT];
    double path_velocity_m_per_s; /* of ramps and RESUME */
    double path_acceleration_m_per_s2;
    double brake_acceleration_m_per_s2; /* of HOLD, and where ramp-out begins; 0: as of paths */
    double rest_spread_m;               /* ZERO refuses a displacement that moves by more */
    double tare_most_m, tare_most_n;    /* and a tare beyond these; 0 = any */
    int32_t tare_ticks, ramp_in_ticks, armed_ticks;
    int32_t stay; /* RAMP_OUT ends where its deceleration does, and not at 0 */
} rthyb_station_config;

/* Displacement over a whole number of ticks: sum c[i] u^i, or c[0] + c[1] cos(pi u); u = 0 ... 1. Or a
 * brake: displacement, velocity and acceleration at its beginning, and the one it brakes with. */
typedef struct {
    double c[6];
    double end; /* where it ends, to the last digit */
    int64_t ticks, elapsed;
    int64_t turn; /* of a brake: ticks in which its acceleration changes, at both ends; 0: none */
    int32_t cosine;
} rthyb_path;

/* A reading that a stuck sensor repeats, the command when it began, and for how many ticks. */
typedef struct {
    double reading, command;
    uint64_t ticks;
} rthyb_stillness;

/* Readings in a row about the level that a sensor leapt to, and the last of them, before tare. */
typedef struct {
    int32_t count;
    double level;
} rthyb_leaps;

/* A force beyond its limit where nothing but a trip is left: ticks of it, ticks since, last tick. */
typedef struct {
    uint64_t ticks, calm, seen;
} rthyb_overload;

enum rthyb_station_size {
    RTHYB_LOST_TICKS = 20,  /* of 1/1024 s: so long without a pair, and the link is lost */
    RTHYB_BLIND_MAX = 80,   /* ticks that are made up for: as long at 4096 Hz */
    RTHYB_RECENT_MAX = 4096 /* ticks of the last second: as above */
};

/* One bit for each tick of the last second, and how many of them are set. */
typedef struct {
    uint64_t map[RTHYB_RECENT_MAX / 64];
    uint32_t count;
} rthyb_recent;

/* Times that a station goes by, in ticks of its own. */
typedef struct {
    uint32_t lost;      /* without a pair, then the link is lost; as many are made up for */
    uint32_t rest;      /* of readings that stand still, then RESET is allowed */
    uint32_t skips;     /* more skipped ones than this in a row: RAMP_OUT */
    uint32_t recent;    /* of the last second; RTHYB_RECENT_MAX at most */
    int64_t arrival;    /* in which the command has come no nearer: it never will */
    uint64_t overload;  /* a force beyond its limit where nothing but a trip is left, at most */
    int64_t least_way;  /* of a way between two points */
    int64_t turn;       /* in which a brake's deceleration comes and goes: a lead's time, */
    int64_t least_turn; /* and that of a motion that is nearly at rest */
    double pace;        /* of them in 1/1024 s */
} rthyb_station_ticks;

typedef struct {
    rthyb_station_config cfg;
    rthyb_station_ticks ticks;
    rthyb_controller controller;
    int32_t state;       /* enum rthyb_state */
    int32_t cause;       /* enum rthyb_cause, latched */
    uint64_t cause_tick; /* when the cause came up */
    double cause_value;  /* what was met, in the unit of what is watched (m, N, ticks ...), */
    double cause_limit;  /* and what was allowed; both 0 where the cause has no number */
    uint32_t indicated;  /* bit 1 << cause: seen, not acted on */
    int32_t interrupted;
    uint64_t tick;      /* ticks of the station */
    uint64_t in_state;  /* ticks since the state was entered */
    double nearest_m;   /* at the end of a path: how near the command has come to it, since when */
    int64_t no_nearer;  /* ticks since then */
    uint64_t test_tick; /* n of the ground motion: RUNNING ticks so far */
    rthyb_path path;
    int32_t leg; /* HOLD: 0 decelerating, 1 stands, 2 resuming, 3 decelerating before it resumes;
                  * RAMP_OUT: 0 decelerating, 1 on the way; RAMP_IN: 0 on the way, 1 decelerating */
    double resume_x, resume_v, resume_a;
    int32_t zeroing;       /* 0 no, 1 under way, 2 failed: the reading moved, 3: too large */
    int32_t tare_readings; /* that the tare has so far */
    double tare_cmd;       /* 0 of the command, before tare: sensor and drive need not agree */
    double tare_x, tare_f, sum_x, sum_f, low_x, high_x;
    int32_t tared; /* there is one that counts: none before the first, none after a RESET */
    double gap;    /* reading less command at rest, as the tare found it: to be measured from */
    rthyb_stillness still_x, still_f;
    double seen_x;    /* last reading, before tare */
    int32_t seen;     /* there is one */
    int32_t commands; /* x_cmd is the drive's by an earlier tare or station, not by a reading */
    rthyb_leaps leaps_x, leaps_f;
    double seen_f;       /* last reading of the force, before tare */
    double rest_x;       /* where the readings have been at rest, before tare, */
    uint32_t rest_ticks; /* and for how many of them */
    rthyb_overload over_f, over_rig_f;
    int32_t noted;         /* bits of this tick's record, found before there is one */
    int32_t off_scale;     /* of this tick's reading: bit 0 displacement, bit 1 force */
    double told_x, told_f; /* that reading, */
    int32_t told;          /* if there was one */
    int32_t drive_stands;  /* it has stopped by itself, or nobody can reach it */
    int32_t refused_cause; /* why the last ARM, START, RESUME, RESET or tare was refused: */
    double refused_value, refused_limit; /* as with a cause; NONE: not by a watch */
    double indicator_slope;              /* of the tracking indicator, mean of 0.25 s, m^2/s */
    rthyb_recent skips, losses;
    uint64_t skipped;     /* all of them */
    int32_t trip_frames;  /* trip frames still to be sent */
    int32_t reset_frames; /* commands that still say RTHYB_TOLD_RESET */
    /* What the row of this tick has beside its record, in the order of the recording's table of channels:
     * written by whoever knows it, before the row is taken. Nothing here is read by the station. */
    double channel[RTHYB_CHANNELS_MAX];
} rthyb_station;

typedef struct {
    double x_m, f_n;        /* newest pair, before tare */
    int32_t lost;           /* as in rthyb_input */
    uint32_t skipped;       /* ticks that were skipped before this one */
    int32_t command;        /* enum rthyb_command */
    int32_t link_down;      /* the link itself reports a failure */
    int32_t drive_stopped;  /* the drive says that it has stopped by itself */
    int32_t heartbeat_late; /* Python has been silent for a second */
    int32_t beyond;         /* the wire could not hold the last command and sent the nearest */
    int32_t taken_over;     /* with the first sound reading: x_cmd_m is what the drive has */
    double x_cmd_m;
} rthyb_station_input;

typedef struct {
    double x_cmd_m; /* for the wire: with tare */
    int32_t send;   /* 0: silence */
    int32_t state;
    int32_t told;    /* to the drive: the state, or RTHYB_TOLD_RESET */
    int32_t refused; /* the command was refused: not for this state, or nobody there to obey */
    uint32_t records;
    double low_m, high_m; /* with tare: the wire's rounding must not take it beyond these */
} rthyb_station_output;

int rthyb_station_init(rthyb_station *station, const rthyb_station_config *cfg);
/* One executed tick: blind steps for what was skipped, then the sample. records takes up to
 * RTHYB_BLIND_MAX + 1 of them; the last one has what the station was told as flags. ag_mps2 is the
 * ground motion of the whole test, n of it. While the link is down or the drive stopped, ZERO, ARM
 * and START are refused; RESET without a fresh reading, or before they have stood still for 19.5 ms; ARM,
 * START, RESUME and RESET beyond a limit, as refused_cause says. RESET is for TRIPPED, and for IDLE where
 * the drive has stopped: the next three commands tell it so. */
int rthyb_station_tick(rthyb_station *station, const rthyb_station_input *in, const double *ag_mps2,
                       size_t n, rthyb_record *records, rthyb_station_output *out);
/* What that tick left to do, once the command has been sent. The next tick does it where nobody has. */
void rthyb_station_advance(rthyb_station *station);

enum rthyb_parameters_size { RTHYB_PARAMETER_WORDS = 62 };

/* What may be changed while a test runs. Generation 0 is what the station was set up with. */
typedef struct {
    uint32_t generation;
    int32_t adapt;                        /* 0: what the control law has learnt stays as it is */
    rthyb_watch watch[RTHYB_CAUSE_COUNT]; /* as in rthyb_station_config */
    double velocity_limit_m_per_s, acceleration_limit_m_per_s2; /* of the command; 0 = off */
    /* As in rthyb_station_config, of paths that begin from now on; narrower than those of the path
     * that runs, that brakes to rest within them and begins anew. */
    double path_velocity_m_per_s, path_acceleration_m_per_s2, brake_acceleration_m_per_s2;
} rthyb_parameters;

/* 0 or RTHYB_E_LIMIT. */
int rthyb_parameters_check(const rthyb_parameters *parameters);
/* Before a tick: puts a set that passed in force, with its generation, in this test and the next. New
 * limits are braked into: with an acceleration limit, no harder than that; without one, a command
 * beyond a new position limit goes no further out. Outside IDLE a set that switches a limit of the
 * command off is not taken. 1 if it was taken. */
int rthyb_station_adopt(rthyb_station *station, const rthyb_parameters *parameters);

/* 1 if a command may be given in a state. */
int rthyb_command_allowed(int32_t state, int32_t command);

/* ---- time (latency.c, ticker.c, thread.c, jitter.c) ------------------------------------------ */

/* The one part of the core that waits and, for measuring, starts threads. All of it without
 * allocation, and none of it is reached from a _step function. */

enum rthyb_time_size {
    RTHYB_LATENCY_BUCKETS = 1024, /* and one more for what is longer than 2^36 ns */
    RTHYB_TRIM_MAX_NS = 195       /* 200 ppm of one period */
};

/* Histogram of times in ns: every ns of its own below 32, then 32 buckets to each doubling (3 %).
 * One thread records; any thread may read at the same time and sees each number whole. */
typedef struct {
    uint64_t count, sum_ns, max_ns;
    uint64_t bucket[RTHYB_LATENCY_BUCKETS + 1]; /* the last one: 2^36 ns (69 s) and longer */
} rthyb_latency;

/* Less than zero counts as zero. */
void rthyb_latency_record(rthyb_latency *latency, int64_t ns);
/* What the fraction of the times recorded did not exceed: never less than the true value, at most
 * 3 % more. 0 while there is none. */
uint64_t rthyb_latency_percentile(const rthyb_latency *latency, double fraction);
/* Shortest time of a bucket; of bucket i + 1: where bucket i ends. */
uint64_t rthyb_latency_edge_ns(uint32_t bucket);
/* Adds what from has seen; into a zeroed one: a copy of one that is in use. */
void rthyb_latency_merge(rthyb_latency *into, const rthyb_latency *from);

enum rthyb_clock {
    RTHYB_CLOCK_HOST,    /* CLOCK_MONOTONIC */
    RTHYB_CLOCK_STEPPED, /* no wall clock: a tick comes on the caller's word */
    RTHYB_CLOCK_LINK     /* CLOCK_MONOTONIC, trimmed by a loop to the drive's samples */
};

/* Tick k is due at t0 + k 1953125/2 ns, rounded down; a rounded period is never added up. Woken
 * later than the next due time, the ticks in between are skipped: phase is kept, and no two ticks
 * ever run between one due time and the next. */
typedef struct {
    int64_t t0_ns;    /* on CLOCK_MONOTONIC */
    int64_t shift_ns; /* sum of all trims */
    int32_t clock;    /* enum rthyb_clock */
    uint32_t stop, bell;
    uint64_t granted, missed, missed_taken; /* stepped: what was said, and how much of it is done */
    uint64_t elapsed, executed, skipped, longest_skip;
    rthyb_latency wake; /* host, link: woken after the due time of the tick that was waited for */
} rthyb_ticker;

typedef struct {
    uint64_t k;
    uint64_t skipped; /* ticks just before k that nobody executed */
    int64_t due_ns;   /* of tick k; woken_ns - due_ns is less than a period */
    int64_t woken_ns; /* stepped: due_ns */
} rthyb_tick;

/* executed + skipped == elapsed after every tick; read from another thread while the ticker runs,
 * they may be those of two successive ticks. */
typedef struct {
    uint64_t elapsed, executed, skipped, longest_skip;
} rthyb_ticker_counts;

/* Refuses an unknown clock and a t0 before the clock's own zero with RTHYB_E_PERIOD. */
int rthyb_ticker_init(rthyb_ticker *ticker, int32_t clock, int64_t t0_ns);
int64_t rthyb_ticker_due_ns(const rthyb_ticker *ticker, uint64_t k);
/* Waits for the next tick, signals or not. 1: here it is; 0: the ticker was stopped. */
int rthyb_ticker_wait(rthyb_ticker *ticker, rthyb_tick *tick);
/* What _wait does after waiting: which tick is it at now_ns? */
void rthyb_ticker_woken(rthyb_ticker *ticker, int64_t now_ns, rthyb_tick *tick);
/* Takes the next tick without waiting, on the word of the calling thread. */
void rthyb_ticker_step(rthyb_ticker *ticker, rthyb_tick *tick);
/* Moves all later due times; at most RTHYB_TRIM_MAX_NS a call, once a tick. For a ticker's own
 * thread: what follows the drive's clock. */
void rthyb_ticker_trim(rthyb_ticker *ticker, int64_t ns);
/* From any thread. Stepped: lets so many more ticks run; has the next one skip so many first. */
void rthyb_ticker_grant(rthyb_ticker *ticker, uint64_t ticks);
void rthyb_ticker_miss(rthyb_ticker *ticker, uint64_t ticks);
/* From any thread, for good: _wait returns 0 within a period. */
void rthyb_ticker_stop(rthyb_ticker *ticker);
void rthyb_ticker_read(const rthyb_ticker *ticker, rthyb_ticker_counts *counts);
int64_t rthyb_now_ns(void); /* CLOCK_MONOTONIC */
/* For how long the PC has been suspended since it was switched on: that clock stood still then. */
int64_t rthyb_asleep_ns(void);

/* The link clock's loop (phase.c). Error is how long after the instant that is lead_ns before the
 * tick the pair of that tick arrived. */
typedef struct {
    double lead_ns;
    double error_ns; /* smoothed */
    double drift_ns; /* the integral: what the drive's clock is slow, ns a tick */
    double trim_ns;  /* mean of the last 4 s, ns a tick */
    double carry_ns; /* of the trim, less than one */
    double mark_ns;  /* error when the speed of approach began to be measured */
    uint32_t ticks;  /* since pairs began to be followed, or the speed of approach was looked at */
    uint32_t silent; /* ticks without a pair, in a row */
    uint32_t near;   /* ticks in a row with a small error */
    int32_t following;
    int32_t locked; /* the error has been small for a quarter of a second */
} rthyb_phase;

/* 0, or RTHYB_E_PERIOD for a lead beyond 10 us to half a period. */
int rthyb_phase_init(rthyb_phase *phase, double lead_ns);
/* Once an executed tick. came != 0: the tick took a pair that arrived so long after its due time (mostly
 * before it: less than 0). Returns what rthyb_ticker_trim is to be given: never more than
 * RTHYB_TRIM_MAX_NS either way. A tick without a pair, or with an outlier, changes next to nothing. */
int64_t rthyb_phase_step(rthyb_phase *phase, int came, double after_due_ns);

/* What a thread has obtained, by the kernel's answer and not by what was asked for. */
enum rthyb_privilege {
    RTHYB_P_FIFO = 1,    /* SCHED_FIFO at the priority asked for */
    RTHYB_P_CPU = 2,     /* runs on its one processor only */
    RTHYB_P_MEMORY = 4,  /* all pages of the process locked, present and future */
    RTHYB_P_AWAKE = 8,   /* processors do not sleep: /dev/cpu_dma_latency held at 0 */
    RTHYB_P_SIGNALS = 16 /* all of them blocked */
};

/* Makes the calling thread, and no other, as punctual as the system lets it. priority 0 leaves the
 * scheduling alone, cpu -1 the processor; latency_fd: /dev/cpu_dma_latency with 0 written to it and
 * kept open by the caller, or -1. Touches stack_bytes of stack, which must be there. */
uint32_t rthyb_thread_become_real_time(int32_t priority, int32_t cpu, int32_t latency_fd,
                                       size_t stack_bytes);
/* Undoes what RTHYB_P_MEMORY did to the whole process. */
void rthyb_memory_unlock(void);

/* What the system did to a thread. */
typedef struct {
    uint64_t major_faults, minor_faults;
    uint64_t waits;       /* times it gave the processor away itself */
    uint64_t preemptions; /* times it was taken away */
} rthyb_usage;

/* Of the calling thread since it began. */
void rthyb_thread_usage(rthyb_usage *usage);

enum rthyb_payload {
    RTHYB_PAYLOAD_NONE,
    RTHYB_PAYLOAD_SAMPLE,  /* one sample of controller and virtual rig */
    RTHYB_PAYLOAD_EXCHANGE /* the rig in a thread of its own, behind an AF_UNIX socket pair */
};

typedef struct {
    rthyb_ticker ticker;
    rthyb_latency sent;  /* from wake-up to the command being sent; without payload empty */
    uint32_t privileges; /* enum rthyb_privilege */
    uint64_t lost;       /* exchange: ticks without a fresh pair */
    uint64_t not_sent;   /* exchange: commands for which there was no room */
    rthyb_usage usage;   /* from the first tick to the last */
} rthyb_timing;

typedef struct rthyb_ring rthyb_ring;

/* Set up by the caller, everything not named here zeroed. Without payload neither controller nor
 * rig nor excitation is needed. */
typedef struct {
    int32_t payload;         /* enum rthyb_payload */
    int32_t priority;        /* of the three threads, as in rthyb_thread_become_real_time */
    int32_t cpu, latency_fd; /* cpu of the two that are timed */
    uint64_t ticks;          /* 1024 a second */
    rthyb_controller *controller;
    rthyb_rig *rig;
    const double *excitation; /* repeated as long as the run lasts */
    size_t excitation_count;
    rthyb_ring *ring;       /* takes the record of every sample; NULL: none does */
    rthyb_timing measured;  /* carries the payload */
    rthyb_timing reference; /* bare, half a period later, in the same seconds */
    uint32_t stop;
} rthyb_jitter;

/* Starts the threads, waits for their end. 0, or errno of what the system refused. */
int rthyb_jitter_run(rthyb_jitter *jitter);
/* From any thread: ends the run early. */
void rthyb_jitter_stop(rthyb_jitter *jitter);

/* ---- the wire: frames, serial framing, bookkeeping (codec.c, framing.c, wire.c) -------------- */

enum rthyb_wire_size {
    RTHYB_FRAME_MAX = 64,       /* data of a CAN FD frame, bytes */
    RTHYB_SERIAL_COMMAND = 12,  /* a command on the serial line, with the 0 that ends it */
    RTHYB_SERIAL_FEEDBACK = 16, /* the same of a feedback */
    RTHYB_PACKET_MAX = 14       /* what COBS unpacks to, with its CRC */
};

enum rthyb_can_id { RTHYB_ACT_CMD = 0x101, RTHYB_ACT_FB = 0x181, RTHYB_LC_FB = 0x182 };
/* Added to a 29-bit identifier, as in SocketCAN. */
#define RTHYB_ID_EXTENDED 0x80000000

/* Bits of the status byte that the drive or the load cell sends. */
enum rthyb_device {
    RTHYB_DEVICE_STOPPED = 1, /* its own stop has begun or is done; latched there */
    RTHYB_DEVICE_INVALID = 2  /* this reading is not to be used */
};

/* What became of a frame. Above HALF: the frame was not taken. */
enum rthyb_verdict {
    RTHYB_W_PAIR = 1,         /* displacement and force of one instant are complete */
    RTHYB_W_HALF = 2,         /* one of them; it waits for the other */
    RTHYB_W_ID = 4,           /* not a frame for us */
    RTHYB_W_LENGTH = 8,       /* too short or too long */
    RTHYB_W_CRC = 16,         /* damaged */
    RTHYB_W_FRAMING = 32,     /* serial: not COBS */
    RTHYB_W_NOT_FINITE = 64,  /* says that it has no number, or holds NaN or inf */
    RTHYB_W_RANGE = 128,      /* beyond the range in the DBC */
    RTHYB_W_INVALID = 256,    /* RTHYB_DEVICE_INVALID */
    RTHYB_W_DUPLICATE = 512,  /* of a sample that is here already */
    RTHYB_W_REORDERED = 1024, /* older than what is here already */
    RTHYB_W_STUCK = 2048,     /* the drive repeats one sample again and again */
    RTHYB_W_PACKET = 4096     /* of a deframer: a whole packet, CRC good */
};

typedef struct {
    uint32_t id;    /* as in SocketCAN, flags included; serial: 0 */
    int32_t fd;     /* to be sent as CAN FD */
    int32_t length; /* bytes in data */
    uint8_t data[RTHYB_FRAME_MAX];
} rthyb_frame;

enum rthyb_signal_kind { RTHYB_UNSIGNED, RTHYB_SIGNED, RTHYB_FLOAT };

/* Where a number stands in a frame. Its value in SI is raw * scale + offset. */
typedef struct {
    int32_t kind;   /* enum rthyb_signal_kind */
    int32_t length; /* bits; 0: the frame does not have it */
    int32_t start;  /* 8 byte + bit of its lowest bit; big-endian: of its highest */
    int32_t big_endian;
    int32_t has_none; /* raw value `none` says that there is no number */
    int64_t none;
    double scale, offset;
    double low, high; /* range of the raw value, as the DBC has it */
} rthyb_signal;

enum rthyb_field {
    RTHYB_FIELD_X,
    RTHYB_FIELD_F,
    RTHYB_FIELD_SEQ,
    RTHYB_FIELD_STATE,
    RTHYB_FIELD_ECHO,
    RTHYB_FIELD_COUNT,
    RTHYB_FIELD_STATUS,
    RTHYB_FIELDS
};

typedef struct {
    uint32_t id;
    int32_t fd, length;
    int32_t crc_at; /* byte with CRC-8/SAE-J1850 of the id's low byte and all others; -1: none */
    rthyb_signal field[RTHYB_FIELDS];
    uint8_t fill[RTHYB_FRAME_MAX]; /* the bits that belong to no field */
} rthyb_message;

enum rthyb_wire_format {
    RTHYB_WIRE_CAN,    /* hw/rthyb.dbc, its code written by hand */
    RTHYB_WIRE_SERIAL, /* the same numbers in COBS packets */
    RTHYB_WIRE_TABLE   /* any DBC, by table */
};

typedef struct {
    int32_t format; /* enum rthyb_wire_format; only TABLE needs the messages */
    /* displacement and force with one id: one frame holds both. */
    rthyb_message command, displacement, force;
    /* Raw state by which a table's drive is told so, beyond those of enum rthyb_state. 0: it cannot be,
     * and is told IDLE. */
    uint32_t reset, leaving;
} rthyb_codec;

/* What a command says in the place of the controller's state, beside enum rthyb_state. */
enum rthyb_told {
    RTHYB_TOLD_RESET =
        8, /* an operator's: a drive that stands after a stop of its own follows again */
    RTHYB_TOLD_LEAVING =
        9 /* the silence that follows is meant: it is no reason to ask for a reset */
};

enum rthyb_wire_error { RTHYB_E_CODEC = 64 };

/* A shorter count comes round while one half of a pair may still wait for the other. */
enum rthyb_codec_size { RTHYB_COUNT_BITS_MIN = 5 };

typedef struct {
    double x_m;
    uint32_t seq;   /* one more with every command */
    uint32_t state; /* enum rthyb_state, or enum rthyb_told */
} rthyb_setpoint;

enum rthyb_reading_part { RTHYB_HAS_X = 1, RTHYB_HAS_F = 2 };

typedef struct {
    uint32_t has;    /* enum rthyb_reading_part */
    uint32_t echo;   /* low bits of the seq of the command applied at the instant of this sample */
    uint32_t count;  /* the drive's samples */
    uint32_t status; /* enum rthyb_device */
    double x_m, f_n;
} rthyb_reading;

/* 0, or RTHYB_E_CODEC for a table that does not fit its frames. The functions below trust a codec
 * that passed. */
int rthyb_codec_check(const rthyb_codec *codec);

/* A command as bytes; CAN: a frame, serial: what is to be written. *sent_m is the displacement as
 * the drive will read it. RTHYB_OK; RTHYB_S_OUT_OF_RANGE for one that the frame cannot hold, sent as
 * the nearest that it can; RTHYB_S_NOT_FINITE: there is no frame, its length is 0. */
int rthyb_encode_setpoint(const rthyb_codec *codec, const rthyb_setpoint *setpoint,
                          rthyb_frame *frame, double *sent_m);
/* For a displacement between two bounds: itself, where what a frame rounds it to lies between them as
 * well, to a millionth of a step; else the value of the frame next to it that does. NaN: none does. */
double rthyb_command_within(const rthyb_codec *codec, double x_m, double low_m, double high_m);
/* A sample of the drive as one or two frames; returns how many. 0 if a value is not finite and the
 * table has no way to say so. */
int rthyb_encode_feedback(const rthyb_codec *codec, const rthyb_reading *reading,
                          rthyb_frame frames[2]);
/* 0, or why the frame is not taken (enum rthyb_verdict). serial: the frame is a deframer's packet.
 * After NOT_FINITE, RANGE and INVALID the reading's count is good, its values are not. */
int rthyb_decode_setpoint(const rthyb_codec *codec, const rthyb_frame *frame,
                          rthyb_setpoint *setpoint);
int rthyb_decode_feedback(const rthyb_codec *codec, const rthyb_frame *frame,
                          rthyb_reading *reading);

/* CRC-8/SAE-J1850 and CRC-16/CCITT-FALSE. */
uint8_t rthyb_crc8(const uint8_t *bytes, size_t n);
uint16_t rthyb_crc16(const uint8_t *bytes, size_t n);
/* Fewer than 254 bytes -> n + 2 bytes without a 0 but the last, which ends the packet. */
size_t rthyb_cobs_encode(const uint8_t *bytes, size_t n, uint8_t *out);

/* Finds packets in a stream of bytes; after damage it is in step again at the next 0. All zero is
 * its start. */
typedef struct {
    uint8_t data[RTHYB_PACKET_MAX];
    uint8_t length;   /* bytes in data */
    uint8_t left;     /* bytes until the next code byte */
    uint8_t begun;    /* a byte came since the last 0 */
    uint8_t too_long; /* nothing fits any more: wait for the 0 */
} rthyb_deframer;

/* 0: nothing yet. RTHYB_W_PACKET: *packet has the bytes without their CRC. Else what was damaged. */
int rthyb_deframer_byte(rthyb_deframer *deframer, uint8_t byte, rthyb_frame *packet);

/* May be read while the wire is in use. */
typedef struct {
    uint64_t sent;   /* commands */
    uint64_t frames; /* frames and packets that came, good or bad */
    uint64_t pairs;  /* taken */
    uint64_t other_id, bad_length, bad_crc, bad_framing, not_finite, out_of_range, invalid;
    uint64_t duplicate, reordered;
    uint64_t stuck;      /* duplicates after many others */
    uint64_t lone;       /* halves whose other half did not come */
    uint64_t missed;     /* samples that the drive's count skips */
    uint64_t superseded; /* pairs followed by another within one tick */
    uint64_t stale;      /* ticks without a new pair */
} rthyb_wire_counters;

/* One end of the wire, the controller's. */
typedef struct {
    rthyb_codec codec;
    rthyb_deframer deframer;
    uint32_t seq; /* of the last command */
    uint32_t echo_mask, count_mask;
    rthyb_reading half[2]; /* displacement, force: what waits for its other half; has 0: none */
    uint32_t half_age[2];  /* ticks */
    rthyb_reading pair;    /* newest */
    uint64_t samples;      /* its count, unwrapped */
    uint32_t age;          /* ticks since it came */
    uint32_t stopped;      /* RTHYB_DEVICE_STOPPED: last word of any frame that was intact, or 0 */
    uint32_t repeats;      /* frames in a row that bring nothing new */
    int32_t synced;        /* pair.count says which count comes next */
    int32_t fresh;         /* pair came since the last take */
    int32_t refused;       /* enum rthyb_status: readings refused since the last take */
    rthyb_wire_counters counters;
} rthyb_wire;

typedef struct {
    double x_m, f_n; /* newest pair, 0 before the first */
    uint32_t echo, count, status;
    /* Samples between the command for this tick and the one that the drive had applied at the
     * instant of the pair; -1: not known. */
    int32_t delay;
    uint32_t age; /* ticks since the pair came, 0: fresh */
    uint64_t
        samples; /* the drive's count, unwrapped; after 20 ticks of silence only modulo 2^bits */
} rthyb_feedback;

/* 0 or RTHYB_E_CODEC. */
int rthyb_wire_init(rthyb_wire *wire, const rthyb_codec *codec);
/* The next command, with the next seq; as rthyb_encode_setpoint. */
int rthyb_wire_command(rthyb_wire *wire, double x_m, int32_t state, rthyb_frame *frame,
                       double *sent_m);
/* A CAN frame that came. Returns its enum rthyb_verdict. One with ID, LENGTH, CRC or FRAMING
 * changes nothing but its counter. */
int rthyb_wire_receive(rthyb_wire *wire, const rthyb_frame *frame);
/* Bytes that came from the serial line, in pieces of any size; all verdicts together. */
int rthyb_wire_feed(rthyb_wire *wire, const uint8_t *bytes, size_t n);
/* Once a tick, after all that came was taken in and before the command is made: the newest pair.
 * RTHYB_OK, or why there is none: for rthyb_input.lost. */
int rthyb_wire_take(rthyb_wire *wire, rthyb_feedback *feedback);

/* ---- telemetry ring (ring.c) ------------------------------------------------------------------ */

enum rthyb_ring_size {
    RTHYB_RING_LAYOUT = 3,                                         /* version of the layout below */
    RTHYB_RING_CAPACITY = 65536,                                   /* records of a ring: 64 s */
    RTHYB_ROW_WORDS_MAX = RTHYB_RECORD_WORDS + RTHYB_CHANNELS_MAX, /* a record and its channels */
    RTHYB_RING_AFTER_TRIP = 1024 /* records kept of a TRIP before the ring stands still */
};

/* Bits. */
enum rthyb_ring_phase {
    RTHYB_RING_OPEN = 0,
    RTHYB_RING_FROZEN = 1, /* stands still after a TRIP, until the state is another */
    RTHYB_RING_CLOSED = 2  /* its producer ended in good order */
};

/* What rthyb_ring_attach refuses. */
enum rthyb_ring_refusal {
    RTHYB_RING_FOREIGN = 1, /* no ring at all */
    RTHYB_RING_UNFINISHED,  /* its producer did not get as far as the start */
    RTHYB_RING_OTHER_LAYOUT,
    RTHYB_RING_OTHER_RECORD,
    RTHYB_RING_TRUNCATED, /* shorter than it says */
    RTHYB_RING_DAMAGED    /* sizes that contradict one another */
};

/* What rthyb_ring_settle reached; bits. */
enum rthyb_ring_fact {
    RTHYB_RING_LOCKED = 1,   /* cannot be paged out */
    RTHYB_RING_IN_MEMORY = 2 /* on tmpfs: no write-back ever makes the producer wait */
};

/* One row, a record and its channels, with its stamp: 2 n + 1 while row number n is being written,
 * 2 n + 2 when it is there. 0: never written. In the file a slot ends with the words that its ring has. */
typedef struct {
    uint64_t stamp;
    uint64_t words[RTHYB_ROW_WORDS_MAX];
} rthyb_ring_slot;

/* Beginning of the file. magic to about_bytes have their place in every layout. */
typedef struct {
    uint64_t magic;
    uint32_t layout, record_bytes;  /* of a row: a record and its channels */
    uint64_t about_at, about_bytes; /* JSON: fields, units, versions, process */
    uint64_t slots_at, file_bytes;
    uint32_t capacity, slot_bytes;
    uint64_t spare[1];
    uint64_t pushed;        /* records so far: the next one has this number */
    uint64_t phase;         /* enum rthyb_ring_phase bits */
    uint64_t apart[6];      /* what follows begins a cache line */
    rthyb_ring_slot newest; /* status page: the newest record while the ring is frozen */
} rthyb_ring_header;

/* The producer's own side; one thread at a time. */
struct rthyb_ring {
    rthyb_ring_header *header;
    char *slots;
    uint64_t mask;
    uint64_t pushed, shown; /* records in the ring, records on the status page */
    uint32_t slot_bytes, channel_count;
    uint32_t tripped; /* records taken since the TRIP */
};

/* One reader of a mapping that may be read-only. Readers do not know of one another, and the
 * producer knows of none. */
typedef struct {
    const rthyb_ring_header *header;
    const char *slots;
    uint64_t capacity, mask;
    uint32_t slot_bytes, row_words;
    uint64_t next; /* number of the record to be read next */
    uint64_t lost; /* records overwritten, or half written, before they were read */
} rthyb_ring_reader;

/* Size of the file for a capacity, a power of two, so many bytes of description and so many channels,
 * RTHYB_CHANNELS_MAX at most. */
size_t rthyb_ring_bytes(uint32_t capacity, size_t about_bytes, uint32_t channel_count);
/* Where the description begins, bytes from the start of the file. */
size_t rthyb_ring_about_at(void);
/* Locks the mapping and writes all of it once; returns enum rthyb_ring_fact bits. The file must
 * have its blocks already (posix_fallocate). Before the start only. */
int rthyb_ring_settle(int fd, void *map, size_t bytes);
/* Writes the header over a settled mapping of rthyb_ring_bytes() bytes whose description is in its
 * place; from then on readers find a ring. */
void rthyb_ring_init(rthyb_ring *ring, void *map, uint32_t capacity, size_t about_bytes,
                     uint32_t channel_count);
/* Never waits, fails or calls the kernel. RTHYB_RING_AFTER_TRIP records in state TRIPPED are taken,
 * further ones go to the status page alone until the state is another. */
/* channels: as many values as the ring has channels; NULL: not known, they become NaN. */
void rthyb_ring_push(rthyb_ring *ring, const rthyb_record *record, const double *channels);
/* channels: of each record in turn, or NULL. */
void rthyb_ring_push_run(rthyb_ring *ring, const rthyb_record *records, size_t n,
                         const double *channels);
void rthyb_ring_close(rthyb_ring *ring);

/* Takes a mapping of a whole file and stands before its oldest record; 0 or enum
 * rthyb_ring_refusal. Nothing outside bytes is read, whatever the file holds. */
int rthyb_ring_attach(rthyb_ring_reader *reader, const void *map, size_t bytes);
/* Up to n rows of record_bytes each without a gap between them, the first with the number
 * next - (returned count). A gap before them shows in lost. 0: nothing new. */
size_t rthyb_ring_read(rthyb_ring_reader *reader, void *rows, size_t n);
/* The newest row, also while the ring is frozen; 0 if there is none. */
int rthyb_ring_newest(const rthyb_ring_reader *reader, void *row);
uint64_t rthyb_ring_pushed(const rthyb_ring_reader *reader);
/* enum rthyb_ring_phase bits. */
int rthyb_ring_phase(const rthyb_ring_reader *reader);

/* ---- link, tick thread, virtual drive (link.c, loop.c, drive.c) ------------------------------- */

enum rthyb_link_kind {
    RTHYB_LINK_CAN,   /* SocketCAN; or a SOCK_SEQPACKET socket, each packet a struct can_frame */
    RTHYB_LINK_STREAM /* tty in raw mode, or a stream socket: serial packets */
};

/* Why a link is down. */
enum rthyb_link_fault {
    RTHYB_LINK_UP,
    RTHYB_LINK_NETWORK_DOWN, /* ENETDOWN: the interface was set down, or the cable pulled */
    RTHYB_LINK_DEVICE_GONE,  /* ENODEV, ENXIO, EIO and other errors that do not pass */
    RTHYB_LINK_BUS_OFF,      /* the CAN controller has left the bus */
    RTHYB_LINK_HUNG_UP       /* the other end is closed */
};

/* May be read while the link is in use. */
typedef struct {
    uint64_t pieces_in, bytes_in; /* frames; stream: what one read gave */
    uint64_t pieces_out, bytes_out;
    uint64_t no_room;      /* not sent: the queue was full (ENOBUFS, EAGAIN) */
    uint64_t error_frames; /* CAN: reports of the controller, bus-off among them */
    uint64_t times_down;
} rthyb_link_counters;

/* A descriptor of its own on what the caller opened and set up. */
typedef struct {
    int32_t kind, fd;
    uint64_t down; /* enum rthyb_link_fault; until something comes or goes again; for any thread */
    int32_t torn;  /* stream: half of a packet was written, the next one begins with a 0 */
    rthyb_link_counters counters;
} rthyb_link;

enum rthyb_link_size { RTHYB_LINK_PIECES_MAX = 256 }; /* taken in one tick */

/* 0 or errno. Refuses with EINVAL an unknown kind, and a stream without O_NONBLOCK: a tty has no
 * other way not to wait. The caller may close its own descriptor. */
int rthyb_link_open(rthyb_link *link, int32_t kind, int32_t fd);
void rthyb_link_close(rthyb_link *link);
/* 1: a frame, or some bytes of a stream; 0: nothing more, or down. */
int rthyb_link_receive(rthyb_link *link, rthyb_frame *frame);
/* 1: sent; 0: lost, counted, for want of room or because the link is down. */
int rthyb_link_send(rthyb_link *link, const rthyb_frame *frame);
/* Waits for something to come, so long at most. 1: it did; 0: not, or nothing ever will, because the
 * descriptor is in error or its other end closed: then it does not wait. The one function here that
 * waits. */
int rthyb_link_wait(const rthyb_link *link, int64_t most_ns);
/* Everything that came, into the wire; RTHYB_LINK_PIECES_MAX pieces at most. */
void rthyb_link_drain(rthyb_link *link, rthyb_wire *wire);

enum rthyb_loop_size {
    RTHYB_HEARTBEAT_TICKS = 1024, /* of silence, then RAMP_OUT */
    RTHYB_SLIP_WINDOW = 256,      /* ticks with a pair that came in time, in which */
    RTHYB_SLIP_VOTES = 192,       /* so many see another count: a slip */
    /* Link clock, by what comes in one tick: a serial line may wake for each byte. */
    RTHYB_WAKE_UPS_MAX = 2 * RTHYB_SERIAL_FEEDBACK,
    RTHYB_LINK_DELAYS = 256,    /* what the link may delay, samples; the last one: that and more */
    RTHYB_OLD_PIECES_MAX = 4096 /* dropped before the first tick */
};

/* Between the numbers on the wire and the structure's own: what sensors are mounted the other way
 * round, scaled or offset, and the similitude. All gains 1 and offsets 0: exactly nothing changes. */
typedef struct {
    double x_gain, x_offset_m;     /* x = x_gain wire + x_offset_m */
    double f_gain, f_offset_n;     /* f = f_gain wire + f_offset_n */
    double cmd_gain, cmd_offset_m; /* wire = cmd_gain x + cmd_offset_m */
} rthyb_calibration;

/* 0; RTHYB_E_LIMIT for a gain that is not within 1e-9 to 1e9 either way, or an offset beyond any
 * sense. */
int rthyb_calibration_check(const rthyb_calibration *calibration);

/* May be read while the loop runs. */
typedef struct {
    uint64_t records;
    uint64_t sent;               /* commands */
    uint64_t not_sent;           /* commands that the link did not take */
    uint64_t down;               /* ticks with the link down */
    uint64_t stopped;            /* ticks in which the drive's last word was that it has stopped */
    uint64_t late_heartbeats;    /* ticks */
    uint64_t refused;            /* operator's commands */
    uint64_t slips;              /* lasting changes of (drive's count - tick) */
    uint64_t wake_ups;           /* link clock: by what came, beside the ticks */
    uint64_t parameters;         /* sets taken */
    uint64_t parameters_refused; /* sets that switch a limit off while something moves */
    uint64_t beyond;             /* commands that the wire could not hold */
    uint64_t old;                /* pieces that had come before the first tick: dropped */
    uint64_t belated;   /* pairs not taken: the drive acted on commands that had become old */
    uint64_t suspended; /* times that the PC was asleep between two ticks */
} rthyb_loop_counters;

/* A set of parameters on its way from the operator's side to the tick. */
typedef struct {
    uint64_t stamp; /* odd while it is being written; 0: none yet */
    uint64_t taken; /* the tick's own: stamp of the set that it took last */
    uint64_t words[RTHYB_PARAMETER_WORDS];
} rthyb_handover;

/* What a loop goes on with: another test at the same link. */
typedef struct {
    rthyb_station *station;
    rthyb_ring *ring; /* NULL: no ring */
    const double *ag_mps2;
    size_t ag_count;
} rthyb_load;

/* The tick: link -> wire -> station -> wire -> link -> record -> ring. The caller sets up what the
 * pointers point to, and leaves all of it but the counters alone while the thread runs. */
typedef struct {
    rthyb_station *station;
    rthyb_wire *wire;
    rthyb_link *link;
    rthyb_ring *ring;      /* NULL: no ring */
    const double *ag_mps2; /* ground motion of the test */
    size_t ag_count;
    rthyb_calibration calibration;
    double lead_ns; /* link clock: the pair arrives so long before the tick */
    rthyb_ticker ticker;
    rthyb_latency sent; /* host clock: from wake-up to the command being sent */
    rthyb_loop_counters counters;
    rthyb_record records[RTHYB_BLIND_MAX + 1]; /* of the last tick, record_count of them */
    uint32_t record_count;
    int32_t delay;                      /* as in rthyb_feedback, of the last fresh pair */
    int32_t usual_delay;                /* the same at rest, before the test */
    uint32_t unsent;                    /* commands in a row that the link did not take */
    int64_t asleep_ns;                  /* rthyb_asleep_ns at the last tick, */
    int32_t asleep_known;               /* if there was one */
    uint64_t delays[RTHYB_LINK_DELAYS]; /* fresh pairs of RUNNING by that delay; for any thread */
    /* The same as words that any thread may read. */
    uint64_t state, cause, cause_tick;
    /* Of the link clock, to be read by any thread: error of the arrival, trim in parts per 1e9. */
    int64_t arrival_error_ns, trim_ppb;
    uint64_t locked;
    int64_t arrived_ns; /* when the newest pair did, on CLOCK_MONOTONIC */
    rthyb_phase phase;
    rthyb_handover handover;
    uint32_t generation; /* of the last set that was published */
    uint64_t set_answer; /* of the last set that a tick saw: generation << 1 | refused */
    /* Mailbox: generation << 8 | command, and what became of it: generation << 8 | refused. */
    uint64_t mail, answer, answer_tick;
    rthyb_load load;
    uint64_t loads, load_answer; /* generation of the load; what became of it: << 1 | refused */
    uint64_t load_tick; /* of the loop: where tick 0 of the station is that was taken last */
    uint64_t heartbeat, heard, silence; /* word of the other side, last seen, ticks since */
    uint64_t downs_seen;                /* of the link's times_down */
    int64_t offset;                     /* drive's count - tick */
    int64_t offset_seen;                /* another one, and in which of the last ticks */
    uint64_t vote_map[RTHYB_SLIP_WINDOW / 64];
    uint64_t voted; /* ticks that had a say */
    int32_t offset_known, votes;
    int32_t taken_over; /* the station has not ticked yet, and another one's last command was: */
    double taken_cmd_m;
    int32_t offered; /* taken_cmd_m, to the first sound reading, as long as the drive reads: */
    double offered_x_m;
    int32_t unpaced;   /* the caller's: stepped clock, and the drive does not wait for its ticks */
    int32_t beyond;    /* the wire could not hold the last command */
    int32_t overheard; /* link clock: more came before this tick than it listens to */
    int32_t priority, cpu, latency_fd; /* of the thread, as in rthyb_thread_become_real_time */
    uint32_t privileges;               /* obtained: enum rthyb_privilege */
    rthyb_usage usage;                 /* of the thread, from the first tick to the last */
    uint64_t thread;
} rthyb_loop;

/* The members up to lead_ns are the caller's; the rest becomes new. 0; RTHYB_E_PERIOD for an unknown
 * clock, or a lead that the link clock refuses; RTHYB_E_LIMIT for the calibration. */
int rthyb_loop_init(rthyb_loop *loop, int32_t clock);
/* What an earlier loop at this link told the drive last, where that stood then, without tare, and the seq
 * that it was told it with: a drive that still follows takes none that is older. Holds if the first
 * sound reading, and each before it, is the same within rest_spread_m and the drive has not stopped
 * meanwhile: then the command goes on from there. Else, as without this call, it begins at the reading;
 * x_m = NaN asks for that. Before the start. */
void rthyb_loop_go_on(rthyb_loop *loop, double x_cmd_m, double x_m, uint32_t seq);
/* Drops what waits in the link, RTHYB_OLD_PIECES_MAX pieces at most: it was sent to somebody else, or long
 * ago. Stepped clock: before the first tick, on the caller's word; the others do it by themselves. */
void rthyb_loop_drop_old(rthyb_loop *loop);
/* One tick on the calling thread, on its word: the stepped clock. */
void rthyb_loop_step(rthyb_loop *loop);
/* A thread that ticks until rthyb_ticker_stop; 0 or errno. But for the stepped clock the first tick is
 * due a little later than now. */
int rthyb_loop_start(rthyb_loop *loop);
/* Waits for the thread's end. */
int rthyb_loop_join(rthyb_loop *loop);
/* Once more the last command, with RTHYB_TOLD_LEAVING; 0 if none was sent: not at rest, nothing sent ever,
 * or the link did not take it. After the thread's end. */
int rthyb_loop_leave(rthyb_loop *loop);
/* Leaves an operator's command for the next tick; one thread at a time. Returns its generation, 0
 * while the last one is not answered: only RTHYB_CMD_TRIP takes its place. */
uint64_t rthyb_loop_command(rthyb_loop *loop, int32_t command);
/* 0: not answered yet; 1: obeyed; 2: refused. *tick is that of the answer. */
int rthyb_loop_answered(const rthyb_loop *loop, uint64_t generation, uint64_t *tick);
/* Has the next tick go on with another station, ring and ground motion; ticks, wire, link and what is
 * known of the drive's clock stay. Refused unless the station that goes is in IDLE; the same station may
 * get another ring in any state. One thread at a time, and one load. Returns its generation. */
uint64_t rthyb_loop_load(rthyb_loop *loop, const rthyb_load *load);
/* 0: not answered yet; 1: taken, what was there before is no longer touched; 2: refused, what was to be
 * loaded is not touched. */
int rthyb_loop_loaded(const rthyb_loop *loop, uint64_t generation);
/* Publishes a set and gives it its generation; the next tick takes it whole, before anything else. One
 * thread at a time. 0, or RTHYB_E_LIMIT: then nothing is published. */
int rthyb_loop_set_parameters(rthyb_loop *loop, rthyb_parameters *parameters);
/* 0: no tick has seen that set yet; 1: it is in force, or a later one is; 2: it, or a later one, was
 * refused (rthyb_station_adopt), and the set before stays in force. */
int rthyb_loop_set_taken(const rthyb_loop *loop, uint32_t generation);
/* A sign of life of the side that has the operator. */
void rthyb_loop_beat(rthyb_loop *loop);

/* What a recording is replayed from: all its rows, from the station's first tick on. */
typedef struct {
    const rthyb_record *rows;
    size_t count;
    const double *ag_mps2; /* as in rthyb_loop */
    size_t ag_count;
    const rthyb_codec *codec; /* that sent the commands; NULL: no wire, they left as computed */
    rthyb_calibration calibration;      /* of the commands */
    const rthyb_parameters *parameters; /* every set but that of generation 0 */
    size_t parameter_count;
} rthyb_replay;

/* Through a fresh station; what the clock and the link added to the rows is copied. Returns how many
 * rows came out: fewer than count where the rows do not make ticks. */
size_t rthyb_station_replay(rthyb_station *station, const rthyb_replay *source, rthyb_record *out);

/* What may be made to go wrong at the drive's side of the wire. */
enum rthyb_drive_fault {
    RTHYB_FAULT_DROP,         /* a feedback is lost, with a probability of value */
    RTHYB_FAULT_DROP_COMMAND, /* the same of commands */
    RTHYB_FAULT_DROP_FORCE,   /* CAN: the second frame of a feedback is lost */
    RTHYB_FAULT_DELAY,        /* feedback held back for value ticks */
    RTHYB_FAULT_REORDER,      /* every other feedback comes after its successor */
    RTHYB_FAULT_DUPLICATE,    /* each frame twice */
    RTHYB_FAULT_CORRUPT,      /* one bit of each frame is wrong */
    RTHYB_FAULT_STUCK,        /* displacement repeats its first value */
    RTHYB_FAULT_JUMP,         /* value added to the displacement */
    RTHYB_FAULT_FORCE,        /* value added to the force */
    RTHYB_FAULT_NOT_FINITE,   /* displacement is no number */
    RTHYB_FAULT_SILENCE,      /* neither sends nor hears */
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

/* What the drive saw and did in one of its ticks. */
typedef struct {
    double x_m;       /* newest command that came, as decoded */
    double target_m;  /* what the actuator was told, behind the calibration */
    double read_x_m;  /* reading that it answered with, before the wire rounds it */
    double read_f_n;  /* the same of the force; its count is the tick's low bits */
    uint32_t seq;     /* of that command */
    uint32_t state;   /* in that command */
    uint32_t frames;  /* commands in this tick, whatever became of them; 0: the above are old */
    uint32_t refused; /* of those: damaged, not finite, or no command */
    uint32_t phase;   /* enum rthyb_drive_phase, after the tick */
    uint32_t silent;  /* ticks since the last fresh sequence number */
} rthyb_drive_entry;

enum rthyb_drive_size {
    RTHYB_DRIVE_WATCHDOG = 20, /* ticks without a fresh sequence number, then it stops */
    RTHYB_DRIVE_HELD_MAX = 64  /* feedbacks on their way; RTHYB_FAULT_DELAY is less */
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
    rthyb_rig *rig;
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
    uint64_t tick;
    const rthyb_fault *faults; /* the caller's */
    size_t fault_count;
    int32_t phase;   /* enum rthyb_drive_phase */
    int32_t latched; /* it has stopped by itself, and nobody has reset it */
    uint32_t seq, seq_mask, silent;
    uint32_t state;             /* of the last fresh command */
    double wanted_m;            /* of the last fresh command */
    double target_m, target1_m; /* what the actuator is told, and was told before */
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

/* ---- tests in virtual time (virtual.c) --------------------------------------------------------- */

/* Station and virtual rig, tick by tick, without clock and wire: the drive follows at once, has the
 * station's zero for its own, and stops by itself when it is told of a trip. */
typedef struct {
    rthyb_station *station;
    rthyb_rig *rig;
    const double *ag_mps2; /* ground motion of the test */
    size_t ag_count;
    double stop_decel_m_per_s2;
    int32_t truth;              /* the first two channels are what the sensors saw, without their
                                 * errors: rthyb_rig.x_true_m and f_true_n */
    int32_t phase;              /* enum rthyb_drive_phase; from here on the core's own */
    double target_m, target1_m; /* what the actuator is told, and was told before */
} rthyb_virtual;

/* The members up to truth are the caller's; the rest becomes new. 0; RTHYB_E_LIMIT for a
 * deceleration that is not positive, RTHYB_E_PERIOD where station and rig have not the same period. */
int rthyb_virtual_init(rthyb_virtual *test);
/* Runs up to count ticks, the first one with an operator's command (RTHYB_CMD_NONE: none); each gives one
 * record, and the first channel_count of its channels. Returns how many were run: fewer where the state has
 * become another, or a tare has failed. */
size_t rthyb_virtual_run(rthyb_virtual *test, int32_t command, size_t count, rthyb_record *records,
                         double *channels, uint32_t channel_count);

/* ---- simulators of the diagnosis (simulate.c) ------------------------------------------------- */

/* gain exp(-s delay) w^2 / (s^2 + 2 zeta w s + w^2) along a recorded command. */
typedef struct {
    double period_s;
    double delay_s, natural_frequency_hz, damping_ratio, gain;
    double shift_s;                /* of the command against the rows, beside the delay */
    double delay_rate_s2_per_m;    /* delay that comes with each m/s */
    double velocity_limit_m_per_s; /* 0 = none */
    int32_t limit_at;              /* 0: of the command, 1: of the actuator itself */
    int32_t rate_of; /* delay_rate with 0: the actuator's velocity, 1: the command's */
    int32_t hold;    /* RTHYB_ZOH, RTHYB_FOH */
} rthyb_actuator_model;

/* Displacement, velocity and acceleration at the rows, begun at rest where the first command is.
 * Up to a row, which need not be whole, the actuator is another one; place and velocity go on. With
 * row 0 it is the model throughout. 0 or RTHYB_E_SERVO;
 * RTHYB_E_LIMIT when it ran off. */
int rthyb_simulate_actuator(const rthyb_actuator_model *before, const rthyb_actuator_model *model,
                            double row, const double *x_cmd_m, size_t n, double *x_m,
                            double *v_m_per_s, double *a_m_per_s2);

typedef struct {
    double period_s, mass_kg;
    double x0_m, v0_m_per_s;
    int32_t hold; /* of the force between the rows */
    int32_t substeps;
} rthyb_body_model;

/* mass a + sum of elements = force; second order in the substep. An inertia belongs into mass_kg:
 * elements have the acceleration of the substep before. Elements are advanced in place. 0,
 * RTHYB_E_MOTION, or RTHYB_E_LIMIT when it ran off. */
int rthyb_simulate_body(const rthyb_body_model *model, rthyb_element *elements,
                        size_t element_count, const double *force_n, size_t n, double *x_m,
                        double *v_m_per_s, double *a_m_per_s2);

enum rthyb_iwan_size { RTHYB_IWAN_MAX = 32 };

/* What follows x behind a play of +-half. */
int rthyb_simulate_play(double half_m, const double *x_m, size_t n, double *y_m);
/* Sum of share[j] times an elastic, perfectly plastic displacement that yields at yield_m[j]; count
 * up to RTHYB_IWAN_MAX, else RTHYB_E_ELEMENT. */
int rthyb_simulate_iwan(const double *yield_m, const double *share, size_t count, const double *x_m,
                        size_t n, double *force);

const char *rthyb_version(void);
const char *rthyb_compiler(void);
/* SHA-256 of the sources that the core was made of (source_hash.cmake); "" built without CMake. */
const char *rthyb_source_hash(void);
/* cffi: end */

#endif
