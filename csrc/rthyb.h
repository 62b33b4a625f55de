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

#define RTHYB_VERSION "0.1.0"

/* What stands between the two markers is read by the C compiler and by cffi alike. */
/* cffi: begin */

enum rthyb_size {
    RTHYB_WINDOW_MAX = 1024,   /* largest T0 of the tangent stiffness, samples */
    RTHYB_DELAY_MAX = 1024,    /* longest transport delay of a virtual actuator, samples */
    RTHYB_ELEMENTS_MAX = 16,   /* elements of one specimen */
    RTHYB_ELEMENT_PARAMS = 12, /* parameters of one element */
    RTHYB_ELEMENT_STATES = 6   /* history variables of one element */
};

/* What a sample was like; bits, because several may be true at once. */
enum rthyb_status {
    RTHYB_OK = 0,
    RTHYB_S_NOT_FINITE = 1,      /* NaN or inf came in, or would have gone out */
    RTHYB_S_OUT_OF_RANGE = 2,    /* finite, but outside the sensor's range or any sense */
    RTHYB_S_LIMITED = 4,         /* the limiter changed the command */
    RTHYB_S_POSITION_LIMIT = 8,  /* the command went past its position limit */
    RTHYB_S_FORCE_LIMIT = 16,    /* the measured force went past its limit */
    RTHYB_S_TRACKING_LIMIT = 32, /* |x_m - x_c| went past its limit */
    RTHYB_S_TRIP = 128,          /* one of the above is set to end the test */
    RTHYB_LOST = 256             /* of an input only: nothing arrived */
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
    RTHYB_E_LIMIT /* a limit, or a starting value beyond any sense */
};

/* ---- one record: ring slot, HDF5 row and replay input -------------------------------------- */

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
    RTHYB_F_NOT_SENT = 32
};

typedef struct {
    uint64_t tick;        /* n, counted from the first sample of the test */
    int64_t due_ns;       /* when the tick was due, from the start of the test */
    int32_t wake_late_ns; /* woken after due */
    int32_t sent_late_ns; /* command sent after due */
    uint32_t flags;       /* enum rthyb_flag */
    uint32_t generation;  /* parameter generation in force */
    int32_t x_raw;        /* displacement as on the wire, 1 nm; saturates */
    int32_t f_raw;        /* force as on the wire, 1 mN; saturates */
    uint8_t state;        /* enum rthyb_state */
    uint8_t echo;         /* low byte of the command sequence number the drive had applied */
    uint8_t count;        /* the drive's own sample count */
    uint8_t code;         /* enum rthyb_status */
    double ag_mps2;       /* ground acceleration at t_n */
    double x_num_m;       /* x_c[n], command of the integration */
    double x_plc_m;       /* output of the phase-lead compensator */
    double x_cmd_m;       /* x_p[n], as the drive has it */
    double x_meas_m;      /* x_m[n], accepted or predicted, after tare */
    double f_meas_n;      /* f[n], accepted or predicted, after tare */
    double alpha;         /* samples, after the update of tick n */
    double beta;          /* samples squared */
    double k_t_n_per_m;   /* tangent stiffness that the RFC used */
    double energy_error_j;
    double tracking_indicator_m2;
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

enum rthyb_law {
    RTHYB_LAW_FIXED,    /* alpha and beta stay where they start */
    RTHYB_LAW_GRADIENT, /* Eqn 2.6-2.11 as printed */
    RTHYB_LAW_ROBUST,   /* the same behind filter pair, gate, projection, power normalisation */
    RTHYB_LAW_RLS       /* recursive least squares of alpha, or of alpha and beta */
};

typedef struct {
    int32_t law;           /* enum rthyb_law */
    int32_t estimate_beta; /* RLS only */
    double w1, w2;
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

int rthyb_estimator_init(rthyb_estimator *est, const rthyb_estimator_config *cfg, double x0_m);
/* frozen != 0 takes the pair in but leaves alpha and beta alone. */
int rthyb_estimator_step(rthyb_estimator *est, double x_p_m, double x_m_m, int frozen);
int rthyb_estimator_run(rthyb_estimator *est, const double *x_p_m, const double *x_m_m,
                        double *alpha, double *beta, size_t n);

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
} rthyb_rfc_config;

typedef struct {
    rthyb_rfc_config cfg;
    uint64_t tick;
    uint32_t head, filled; /* next to be overwritten; samples in the window */
    double k_n_per_m;      /* bounded k_exp[n] */
    double ratio;          /* last term of Eqn 3.3 */
    double x1, f1, c1;
    double x[RTHYB_WINDOW_MAX]; /* the T0 samples before the newest: x_m, or ratios (Eqn 3.3) */
    double f[RTHYB_WINDOW_MAX];
} rthyb_rfc;

int rthyb_rfc_init(rthyb_rfc *rfc, const rthyb_rfc_config *cfg, double x0_m, double f0_n);
/* force_n = f + k_exp (x_c - x_m): what the equation of motion sees. frozen != 0 holds k_exp. */
int rthyb_rfc_step(rthyb_rfc *rfc, double x_c_m, double x_m_m, double f_n, int frozen,
                   double *force_n);
int rthyb_rfc_run(rthyb_rfc *rfc, const double *x_c_m, const double *x_m_m, const double *f_n,
                  double *force_n, double *k_n_per_m, size_t n);

/* ---- equation of motion (motion.c) ---------------------------------------------------------- */

enum rthyb_integrator {
    RTHYB_CENTRAL_DIFFERENCE,
    RTHYB_FORWARD_EULER,
    RTHYB_CR,
    RTHYB_KR_ALPHA,
    RTHYB_PRESCRIBED /* no equation: the next command is the excitation itself */
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

/* ---- specimen elements (element.c) ---------------------------------------------------------- */

enum rthyb_element_kind {
    RTHYB_STIFFNESS,    /* k */
    RTHYB_VISCOUS,      /* c */
    RTHYB_COULOMB,      /* Fc, width m/s */
    RTHYB_STRIBECK,     /* Fc, Fs, vs, width */
    RTHYB_LUGRE,        /* Fc, Fs, vs, sigma0, sigma1, sigma2 */
    RTHYB_QUAD_DAMPING, /* c2 */
    RTHYB_INERTIA,      /* m */
    RTHYB_GAP,          /* k, gap (half width) */
    RTHYB_CUBIC,        /* k3 */
    RTHYB_QUADRATIC,    /* k2 */
    RTHYB_STOPPER,      /* ks, xs */
    RTHYB_HYSTERESIS,   /* k, a, A, B, C, eta: Eqn 4.1-4.2 */
    RTHYB_PINCHING,     /* k, a, A, B, C, eta, depth, width */
    RTHYB_DEGRADATION,  /* k, a, A, B, C, eta, loss, travel */
    RTHYB_MAXWELL,      /* km, tau */
    RTHYB_SECOND_MODE,  /* m2, f2 Hz, zeta2 */
    RTHYB_P_DELTA,      /* gravity load, height */
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
    RTHYB_SERVO_HYDRAULIC
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
} rthyb_servo_config;

typedef struct {
    rthyb_servo_config cfg;
    double x, v, a;      /* table: m, m/s, m/s^2 */
    double last_command; /* last good command */
    uint32_t head;       /* newest of past[] */
    double past[RTHYB_DELAY_MAX + 2];
    double fraction;            /* of delay_samples */
    double first[4], second[4]; /* free motion over the two parts of a sample, row by row */
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
} rthyb_rig;

int rthyb_rig_init(rthyb_rig *rig, const rthyb_rig_config *cfg);
/* Latches x_m[n], f[n], then applies x_p[n] and moves on to t_{n+1}. */
int rthyb_rig_step(rthyb_rig *rig, double x_p_m, double *x_m_m, double *f_n);
int rthyb_rig_run(rthyb_rig *rig, const double *x_p_m, double *x_m_m, double *f_n, size_t n);

/* ---- one sample of the controller (controller.c) -------------------------------------------- */

enum rthyb_action { RTHYB_NONE, RTHYB_INDICATE, RTHYB_TRIP_TEST };

typedef struct {
    double value;   /* 0 = no limit */
    int32_t action; /* enum rthyb_action */
} rthyb_limit;

typedef struct {
    double period_s;
    int32_t plc_enabled;
    rthyb_estimator_config estimator;
    rthyb_rfc_config rfc;
    rthyb_motion_config motion;
    double x_range_m, f_range_n; /* a reading beyond its sensor's range is not taken; 0 = off */
    rthyb_limit position, force, tracking;
    double velocity_limit_m_per_s, acceleration_limit_m_per_s2; /* 0 = off */
} rthyb_controller_config;

typedef struct {
    rthyb_controller_config cfg;
    rthyb_plc plc;
    rthyb_estimator estimator;
    rthyb_rfc rfc;
    rthyb_motion motion;
    uint64_t tick;
    double x_num, x_plc, x_cmd; /* commands for t_n */
    double x_cmd1;              /* command for t_{n-1} */
    double alpha, beta;         /* as the PLC has them, rate-limited */
    double x_m1, x_m2, f1, f2, x_num1;
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
/* Takes over a recorded state, unless its settings or indices could not have come from a
 * controller: then RTHYB_E_*, and nothing is taken. A recording is a file, and files get damaged. */
int rthyb_controller_adopt(rthyb_controller *controller, const rthyb_controller *recorded);
/* Fills the record of tick n; controller->x_cmd is then the command for t_{n+1}. */
int rthyb_controller_step(rthyb_controller *controller, const rthyb_input *input,
                          rthyb_record *record);

/* A test in virtual time. excitation[n] for n_total samples; runs ticks until count more records
 * are written or a trip ends the test. Returns the number of records written. */
size_t rthyb_run_virtual(rthyb_controller *controller, rthyb_rig *rig, const double *excitation,
                         size_t n_total, size_t count, rthyb_record *records, int32_t *status);
/* The recorded inputs through the core again. */
size_t rthyb_run_replay(rthyb_controller *controller, const rthyb_record *recorded,
                        const double *excitation, size_t n_total, size_t count,
                        rthyb_record *records);
/* The numerical structure and the specimen joined without actuator or sensor: the reference.
 * elements are advanced in place. Returns RTHYB_OK or the status bits seen; with too many elements
 * RTHYB_S_OUT_OF_RANGE at once. Mass belongs into added_mass_kg: an inertia element here has the
 * acceleration of the step before. */
int rthyb_run_reference(rthyb_motion *motion, rthyb_element *elements, size_t element_count,
                        const double *ag_mps2, size_t n, double *x_m, double *v_m_per_s,
                        double *force_n);

const char *rthyb_version(void);
const char *rthyb_compiler(void);
/* cffi: end */

#endif
