/* The virtual rig: specimen elements (element.c, friction.c), actuators (servo.c, servo_valve.c),
 * sensors (rig.c). */
#ifndef RTHYB_PART_RIG_H
#define RTHYB_PART_RIG_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_extra.h"
#include "rthyb_record.h"

/* cffi: begin */

/* ---- specimen elements (element.c) ---------------------------------------------------------- */

enum rthyb_element_kind {
    RTHYB_STIFFNESS,         /* k */
    RTHYB_VISCOUS,           /* c */
    RTHYB_COULOMB,           /* Fc, width m/s */
    RTHYB_STRIBECK,          /* Fc, Fs, vs, width, exponent */
    RTHYB_LUGRE,             /* Fc, Fs, vs, sigma0, sigma1, sigma2 */
    RTHYB_QUAD_DAMPING,      /* c2 */
    RTHYB_INERTIA,           /* m */
    RTHYB_GAP,               /* k, gap (half width) */
    RTHYB_CUBIC,             /* k3 */
    RTHYB_QUADRATIC,         /* k2 */
    RTHYB_STOPPER,           /* ks, xs, loss s/m */
    RTHYB_HYSTERESIS,        /* k, a, A, B, C, eta: Eqn 4.1-4.2 */
    RTHYB_PINCHING,          /* k, a, A, B, C, eta, depth, width */
    RTHYB_DEGRADATION,       /* k, a, A, B, C, eta, loss, travel m, work J, amplitude m */
    RTHYB_MAXWELL,           /* km, tau */
    RTHYB_SECOND_MODE,       /* m2, f2 Hz, zeta2 */
    RTHYB_P_DELTA,           /* gravity load, height */
    RTHYB_GAP_FRICTION,      /* k, gap (half width), Fc up, Fc down, seat */
    RTHYB_COULOMB_UNEVEN,    /* Fc up, Fc down, width m/s */
    RTHYB_GAP_UNEVEN,        /* k up, gap up, k down, gap down, loss s/m */
    RTHYB_POWER_DAMPING,     /* force, at velocity, exponent, width m/s */
    RTHYB_POWER_SPRING,      /* force, at displacement, exponent, width m */
    RTHYB_PENDULUM,          /* weight, length */
    RTHYB_FRICTION_PENDULUM, /* weight, radius, mu slow, mu fast, rate s/m, xy */
    RTHYB_IWAN,              /* k, a, xy, spread */
    RTHYB_MENEGOTTO_PINTO,   /* k, a, xy, R0, cR1, cR2 */
    RTHYB_CHABOCHE,          /* k, fy, H, gamma 1/m, Q, rate 1/m */
    /* k, a, xy, eta, pivot, ultimate m, strength lost there, energy J, strength and stiffness lost with it,
     * slip, its level and width */
    RTHYB_RC_COLUMN,
    RTHYB_PEAK_ORIENTED, /* k up, k down, reach, exponent, backbone, start */
    /* k, a, xy, sharpness, unloading exponent, pinching, its level, energy J, strength downwards over upwards,
     * part of the straight line in the corner of pinching */
    RTHYB_TAKEDA,
    RTHYB_NONLINEAR_MAXWELL, /* km, force, at velocity, exponent */
    RTHYB_ROCKING,           /* k, uplift, post-uplift over k */
    RTHYB_OWN,               /* no parameters: user-defined function */
    RTHYB_ELEMENT_KINDS
};

/* A user-defined force law, for virtual time only. It must keep its history in `state`, RTHYB_ELEMENT_STATES - 1
 * values that are initially 0, so that a copy of the element is an independent element. */
typedef double (*rthyb_own_force)(double *state, double x_m, double v_m_per_s, double a_m_per_s2,
                                  double dt_s);

typedef struct {
    int32_t kind;        /* enum rthyb_element_kind */
    rthyb_own_force own; /* RTHYB_OWN: to be set after initialisation */
    double params[RTHYB_ELEMENT_PARAMS];
    double state[RTHYB_ELEMENT_STATES];
    double x, v, a; /* last valid motion, used in place of an invalid one */
} rthyb_element;

/* Number of parameters of a kind; -1 for an unknown kind. */
int rthyb_element_param_count(int32_t kind);
/* Whether its force depends on the velocity alone, opposes it, and may be steep where the velocity changes its sign. */
int rthyb_is_dry_friction(const rthyb_element *element);
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
    int32_t hold; /* enum rthyb_hold: interpolation between two commands */
    double period_s;
    double delay_samples; /* transport delay; an integer for pure delay and first order */
    double roll_off_hz;   /* first order */
    double natural_frequency_hz, damping_ratio, gain; /* second order */
    double kp_per_s, ki_per_s2;                       /* servo-hydraulic from here on */
    double valve_time_constant_s, stall_force_n, flow_limit_m_per_s;
    double oil_stiffness_n_per_m, oil_damping_n_s_per_m;
    double moving_mass_kg, friction_n, friction_width_m_per_s, viscous_n_s_per_m;
    int32_t substeps;
    /* Servo-valve: flow G / (s^2 + b1 s + b2) (gain u - x); force 1 / (s + a3) (flow - a2 v). Mass, stiffness and
     * damping of the specimen; a rig computes them from its elements. */
    double valve_n_per_m_s3, valve_b1_per_s, valve_b2_per_s2;
    double velocity_feedback_n_s_per_m2, leakage_per_s;
    double specimen_stiffness_n_per_m, specimen_damping_n_s_per_m;
    /* range and resolution of the drive's converters; 0 = unlimited, ideal */
    double command_range_m, command_lsb_m;
    /* Servo-valve: the drive's control loop on the displacement sensor, kp + ki / s, discretised by Tustin's
     * method; both 0 = no loop, the command is sent directly to the valve. */
    double loop_kp, loop_ki_per_s;
} rthyb_servo_config;

enum rthyb_valve_size { RTHYB_VALVE_STATES = 5, RTHYB_VALVE_STEP = 35 };

typedef struct {
    rthyb_servo_config cfg;
    double x, v, a;      /* table: m, m/s, m/s^2 */
    double last_command; /* last valid command */
    uint32_t head;       /* index of the newest entry of past[] */
    double past[RTHYB_DELAY_MAX + 2];
    double fraction;            /* fractional part of delay_samples */
    double first[4], second[4]; /* free motion over the two parts of a sample, row by row */
    /* Servo-valve: matrix from state, command and force of the remaining elements to the next state. The states are
     * scaled to comparable magnitudes. */
    double valve_step[RTHYB_VALVE_STEP], valve_state[RTHYB_VALVE_STATES];
    double integral, valve, piston, piston_velocity, half_velocity, oil_force;
    double valve_gain;
    double sensed_m, loop_error; /* servo-valve: newest reading, and previous error of the loop */
} rthyb_servo;

typedef struct {
    double noise_std; /* normal, white */
    double lsb;       /* quantisation, 0 = none */
    double bias;
    double range; /* saturates at +-range, 0 = unlimited */
} rthyb_sensor;

/* A seeded noise source. */
typedef struct {
    uint64_t random[2];
    double spare;
    int32_t has_spare;
} rthyb_noise;

/* A sensor in addition to those for displacement and force: gain times the measured quantity, with its own errors. */
typedef struct {
    int32_t kind; /* enum rthyb_extra_kind */
    double gain;
    rthyb_sensor sensor;
} rthyb_extra_sensor;

enum rthyb_load_cell { RTHYB_ACTUATOR_END, RTHYB_SPECIMEN_END };

typedef struct {
    rthyb_servo_config servo;
    rthyb_sensor displacement, force;
    int32_t load_cell; /* enum rthyb_load_cell */
    uint32_t element_count;
    rthyb_element elements[RTHYB_ELEMENTS_MAX];
    uint64_t seed;
    uint32_t extra_count;
    rthyb_extra_sensor extras[RTHYB_EXTRAS_MAX];
} rthyb_rig_config;

typedef struct {
    rthyb_rig_config cfg;
    rthyb_servo servo;
    rthyb_noise noise;
    double x_true_m, f_true_n; /* readings without sensor errors */
    double ridden_kg;          /* mass of the specimen that moves with the table */
    rthyb_noise extra_noise;
    double extra[RTHYB_EXTRAS_MAX]; /* readings of the extra sensors at the same instant */
    /* provided by the caller: each sample also stores the readings here; NULL: not used */
    double *extra_to;
} rthyb_rig;

int rthyb_rig_init(rthyb_rig *rig, const rthyb_rig_config *cfg);
/* Restarts the sensor noise from the seed. */
void rthyb_rig_reseed(rthyb_rig *rig);
/* Latches x_m[n] and f[n], then applies x_p[n] and advances to t_{n+1}. */
int rthyb_rig_step(rthyb_rig *rig, double x_p_m, double *x_m_m, double *f_n);
int rthyb_rig_run(rthyb_rig *rig, const double *x_p_m, double *x_m_m, double *f_n, size_t n);
/* cffi: end */

#endif
