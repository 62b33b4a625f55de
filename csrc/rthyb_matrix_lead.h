/* Compensation of several coupled actuators at one specimen: gain, delay and curvature as matrices, followed by an
 * inverse of the identified axes (matrix_lead.c). */
#ifndef RTHYB_PART_MATRIX_LEAD_H
#define RTHYB_PART_MATRIX_LEAD_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_kernels.h"
#include "rthyb_kinematics.h"

/* cffi: begin */

enum rthyb_matrix_lead_size {
    RTHYB_MATRIX_TERMS = 3,     /* gain, delay, curvature */
    RTHYB_MATRIX_UNKNOWNS = 12, /* in one row: the terms of each axis */
    RTHYB_MATRIX_POLES = 8      /* largest number of poles of the inverse */
};

typedef struct {
    int32_t size;    /* axes, 1 to RTHYB_COUPLED_MAX */
    int32_t coupled; /* 0: the axes adapt independently; the matrices remain diagonal */
    int32_t poles;   /* of the inverse; 0: a constant matrix only */
    double period_s;
    double roll_off_hz; /* of the lead, which has two real poles there */
    double cutoff_hz;   /* of the filter pair */
    /* adapt only while the power of an axis' motion exceeds this multiple of the power of its noise */
    double gate_factor;
    double memory_s;
    /* standard deviation of each term from its initial value: 1, s, s^2 */
    double sigma[RTHYB_MATRIX_TERMS];
    double gain_most, delay_most_s;         /* bounds +- of each matrix entry */
    double rest_noise_m[RTHYB_COUPLED_MAX]; /* standard deviation of x_m at rest, for each axis */
    /* Initial values of gain - 1, delay and curvature: 1, s, s^2; [row of the command][column]. */
    double first[RTHYB_MATRIX_TERMS][RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX];
    /* C(z) = C_0 + sum of C_k (1 - 1/z) / (1 - rho_k / z), rho_k = exp(-2 pi f_k h). */
    double pole_hz[RTHYB_MATRIX_POLES];
    double inverse[RTHYB_MATRIX_POLES + 1][RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX];
} rthyb_matrix_lead_config;

/* State of C(z) or of its inverse: previous input, and state of each pole. */
typedef struct {
    double x1[RTHYB_COUPLED_MAX];
    double pole[RTHYB_MATRIX_POLES][RTHYB_COUPLED_MAX];
} rthyb_matrix_inverse;

typedef struct {
    rthyb_matrix_lead_config cfg;
    double w1, w2, s; /* of the lead; s = w1 + w2 + 1 */
    /* Gain - 1, delay in samples, curvature in samples squared. */
    double first[RTHYB_MATRIX_TERMS][RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX];
    double learnt[RTHYB_MATRIX_TERMS][RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX];
    /* in effect in the command */
    double used[RTHYB_MATRIX_TERMS][RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX];
    double most[RTHYB_MATRIX_TERMS];
    double x1[RTHYB_COUPLED_MAX], x2[RTHYB_COUPLED_MAX]; /* x_c[n-1], x_c[n-2] */
    double e1[RTHYB_COUPLED_MAX], e2[RTHYB_COUPLED_MAX]; /* lead - x_c */
    double offset[RTHYB_COUPLED_MAX];                    /* fades as the command moves */
    double rho[RTHYB_MATRIX_POLES];
    double feed[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX]; /* response to a step in the first sample, */
    double taken[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX]; /* and its inverse */
    double still[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX]; /* inverse of C_0 */
    /* applied to the command; its inverse: the identified axes */
    rthyb_matrix_inverse inverse, rig;
    double last_p[RTHYB_COUPLED_MAX], last_m[RTHYB_COUPLED_MAX]; /* last valid inputs */
    rthyb_lowpass filter; /* the filter pair, and the offsets that it subtracts */
    double filter_p[RTHYB_COUPLED_MAX][2], filter_m[RTHYB_COUPLED_MAX][2];
    double level_p[RTHYB_COUPLED_MAX], level_m[RTHYB_COUPLED_MAX], level_weight, least_weight;
    double p1[RTHYB_COUPLED_MAX], p2[RTHYB_COUPLED_MAX];
    double m1[RTHYB_COUPLED_MAX], m2[RTHYB_COUPLED_MAX];
    /* Least squares: one matrix for all rows of the command, one right-hand side per row. */
    double r[RTHYB_MATRIX_UNKNOWNS][RTHYB_MATRIX_UNKNOWNS];
    double q[RTHYB_COUPLED_MAX][RTHYB_MATRIX_UNKNOWNS];
    /* Contribution per sample of a noise of 1 m on one axis. */
    double noise_r[RTHYB_MATRIX_TERMS][RTHYB_MATRIX_TERMS], noise_q[RTHYB_MATRIX_TERMS];
    double ridge[RTHYB_MATRIX_TERMS]; /* weight of the initial value of each term */
    double weight, forget;
    double power[RTHYB_COUPLED_MAX], gate_power[RTHYB_COUPLED_MAX];
    int32_t open; /* adapting, for the record */
} rthyb_matrix_lead;

/* Initialises at rest at x0, one value per axis. RTHYB_E_LAW: sizes, a setting, or an inverse whose own inverse (the
 * identified axes) is unstable. */
int rthyb_matrix_lead_init(rthyb_matrix_lead *s, const rthyb_matrix_lead_config *cfg,
                           const double *x0_m);
/* Commands and specimen are now at rest at x_m. Adapted quantities are kept. */
void rthyb_matrix_lead_rest(rthyb_matrix_lead *s, const double *x_m);
/* The newest commands in effect at the drives, and the measured displacements. frozen: do not adapt. */
int rthyb_matrix_lead_observe(rthyb_matrix_lead *s, const double *x_p_m, const double *x_m_m,
                              int frozen);
/* x_c -> x_p for the same instant. The adaptation since the last call changes the command of each axis by at most
 * allowed_m. */
int rthyb_matrix_lead_lead(rthyb_matrix_lead *s, const double *x_c_m, double allowed_m,
                           double *x_p_m);
/* For n rows, without adaptation. */
int rthyb_matrix_lead_run(rthyb_matrix_lead *s, const double *x_c_m, double *x_p_m, size_t n);
/* cffi: end */

#endif
