/* Numerical parts: the equation of motion (motion.c), dense matrices (numerical_dense.c), sparse ones
 * (rthyb_sparse.h), and any of them by its kind (numerical.c). */
#ifndef RTHYB_PART_NUMERICAL_H
#define RTHYB_PART_NUMERICAL_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_rig.h"
#include "rthyb_sparse.h"

/* cffi: begin */

/* ---- equation of motion (motion.c) ---------------------------------------------------------- */

enum rthyb_integrator {
    RTHYB_CENTRAL_DIFFERENCE,
    RTHYB_FORWARD_EULER,
    RTHYB_CR,
    RTHYB_KR_ALPHA,
    RTHYB_PRESCRIBED, /* no equation: the next command is the excitation itself */
    RTHYB_RK4         /* classical Runge-Kutta with a held force; dense parts only */
};

typedef struct {
    int32_t integrator; /* enum rthyb_integrator */
    double period_s;
    double mass_kg;       /* numerical mass: ground motion acts on it */
    double added_mass_kg; /* moves with it, but is not subject to the ground motion */
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
/* Velocity at t_n before the step, to the accuracy of the integrator. */
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
    int32_t at;          /* index of the interface, from 0 */
    int32_t force_delay; /* samples by which the force is delayed: 0 or 1 */
    double period_s;
    /* Numerical part only, n x n, row by row; symmetric. */
    double mass_kg[RTHYB_DENSE_SQUARE];
    double damping_n_s_per_m[RTHYB_DENSE_SQUARE];
    double stiffness_n_per_m[RTHYB_DENSE_SQUARE];
    double load_kg[RTHYB_DENSE_MAX]; /* force of a ground acceleration of -1 m/s^2 */
    /* Known properties of the specimen: used in the coefficients of CR, but not in the equation. */
    double specimen_mass_kg, specimen_damping_n_s_per_m, k_e_n_per_m;
} rthyb_dense_config;

typedef struct {
    rthyb_dense_config cfg;
    double step[RTHYB_DENSE_STEP]; /* D of s += D s + ..., 2n x 2n */
    double by_force[RTHYB_DENSE_STATES], by_excitation[RTHYB_DENSE_STATES];
    double s[RTHYB_DENSE_STATES]; /* x, then v, at t_n */
    double change;    /* change of the interface in the next step, without force and excitation */
    double x, x1, x2; /* of the interface, as returned */
    double a;         /* of the interface, over the last step */
    double force, last_force, excitation; /* of this step, previously measured, of this step */
    int32_t ran_off;
} rthyb_dense;

int rthyb_dense_init(rthyb_dense *s, const rthyb_dense_config *cfg, double x0_m);
/* M a + C v + K x + e force = -load ag  at t_n  ->  x[n+1] of the interface, by two products. */
int rthyb_dense_answer(rthyb_dense *s, double excitation, double force_n, double *x_next_m);
/* Advances the other degrees of freedom; call before the next answer. */
int rthyb_dense_advance(rthyb_dense *s);

/* ---- numerical part by kind (numerical.c) ----------------------------------------------------- */

enum rthyb_numerical_kind {
    RTHYB_NUMERICAL_MOTION,  /* rthyb_motion_config, rthyb_motion */
    RTHYB_NUMERICAL_DENSE,   /* rthyb_dense_config, rthyb_dense */
    RTHYB_NUMERICAL_SPARSE,  /* rthyb_sparse_config; the state begins with rthyb_sparse */
    RTHYB_NUMERICAL_LIBRARY, /* rthyb_library_config; the user's own (rthyb_own_part.h) */
    RTHYB_NUMERICAL_KINDS
};

/* Settings and state belong to the caller. A state consists of rthyb_numerical_size(part) plain bytes without
 * pointers, aligned for a double, and must not be shared by two parts. The settings must remain valid. */
typedef struct {
    int32_t kind; /* enum rthyb_numerical_kind */
    const void *cfg;
    void *state;
} rthyb_numerical;

/* The interface at t_n: v and a to the accuracy of the integrator; x1 = x[n-1], x2 = x[n-2]. */
typedef struct {
    double x, v, a, x1, x2;
} rthyb_interface;

/* Size of a state in bytes; 0 for an unknown kind or implausible settings. */
size_t rthyb_numerical_size(const rthyb_numerical *part);
/* Number of interfaces (forces in, displacements out), for settings that init accepted; 0: unknown kind. */
int32_t rthyb_numerical_interfaces(const rthyb_numerical *part);
/* Initialises the part at rest at x0. A sparse part starts as its settings specify and a library at 0; for both, x0
 * must be 0. All functions below require an initialised part. */
int rthyb_numerical_init(const rthyb_numerical *part, double x0_m);
/* Excitation and forces at t_n -> x_c[n+1], one value per interface. This is all that is computed between
 * a reading and its command. */
int rthyb_numerical_answer(const rthyb_numerical *part, double excitation, const double *force_n,
                           double *x_next_m);
/* Completes the step after the command was sent; must be called before any other function of this part. */
int rthyb_numerical_advance(const rthyb_numerical *part);
/* Call instead of answer and advance while a path determines the command: the part's time does not advance. */
void rthyb_numerical_freeze(const rthyb_numerical *part, const double *force_n);
/* Copy a state to bytes and back; kind and settings must be the same. */
void rthyb_numerical_save(const rthyb_numerical *part, void *bytes);
void rthyb_numerical_restore(const rthyb_numerical *part, const void *bytes);
/* One value per interface. */
void rthyb_numerical_look(const rthyb_numerical *part, rthyb_interface *at);
/* Displacement of every degree of freedom in m, at most `most` of them; returns their number. For a sparse part:
 * its responses in this tick, valid between answer and advance. */
size_t rthyb_numerical_report(const rthyb_numerical *part, double *values, size_t most);
/* cffi: end */

#endif
