/* Compensation of several actuators at one specimen, which feel one another: gain, delay and curvature as
 * matrices, before an inverse of the axes as they were identified (matrix_lead.c). */
#ifndef RTHYB_PART_MATRIX_LEAD_H
#define RTHYB_PART_MATRIX_LEAD_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_kernels.h"
#include "rthyb_kinematics.h"

/* cffi: begin */

enum rthyb_matrix_lead_size {
    RTHYB_MATRIX_TERMS = 3,     /* gain, delay, curvature */
    RTHYB_MATRIX_UNKNOWNS = 12, /* of one row: terms of each axis */
    RTHYB_MATRIX_POLES = 8      /* of the inverse */
};

typedef struct {
    int32_t size;    /* axes, 1 to RTHYB_COUPLED_MAX */
    int32_t coupled; /* 0: each axis learns from itself alone, the matrices stay diagonal */
    int32_t poles;   /* of the inverse; 0: a constant matrix alone */
    double period_s;
    double roll_off_hz; /* of the lead: two real poles */
    double cutoff_hz;   /* of the filter pair */
    double
        gate_factor; /* learn only while an axis moves with so many times the power of its noise */
    double memory_s;
    double sigma[RTHYB_MATRIX_TERMS]; /* how far each term may be from where it begins: 1, s, s^2 */
    double gain_most, delay_most_s;   /* of each number of the matrices, either way */
    double rest_noise_m[RTHYB_COUPLED_MAX]; /* standard deviation of x_m at rest, of each axis */
    /* Where gain less 1, delay and curvature begin: 1, s, s^2; [row of the command][column]. */
    double first[RTHYB_MATRIX_TERMS][RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX];
    /* C(z) = C_0 + sum of C_k (1 - 1/z) / (1 - rho_k / z), rho_k = exp(-2 pi f_k h). */
    double pole_hz[RTHYB_MATRIX_POLES];
    double inverse[RTHYB_MATRIX_POLES + 1][RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX];
} rthyb_matrix_lead_config;

/* C(z), or the other way round: its input at the sample before, and what each pole keeps. */
typedef struct {
    double x1[RTHYB_COUPLED_MAX];
    double pole[RTHYB_MATRIX_POLES][RTHYB_COUPLED_MAX];
} rthyb_matrix_inverse;

typedef struct {
    rthyb_matrix_lead_config cfg;
    double w1, w2, s; /* of the lead; s = w1 + w2 + 1 */
    /* Gain less 1, samples, samples squared. */
    double first[RTHYB_MATRIX_TERMS][RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX];
    double learnt[RTHYB_MATRIX_TERMS][RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX];
    double used[RTHYB_MATRIX_TERMS][RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX]; /* in the command */
    double most[RTHYB_MATRIX_TERMS];
    double x1[RTHYB_COUPLED_MAX], x2[RTHYB_COUPLED_MAX]; /* x_c[n-1], x_c[n-2] */
    double e1[RTHYB_COUPLED_MAX], e2[RTHYB_COUPLED_MAX]; /* lead less x_c */
    double offset[RTHYB_COUPLED_MAX];                    /* fades as the command moves */
    double rho[RTHYB_MATRIX_POLES];
    double feed[RTHYB_COUPLED_MAX]
               [RTHYB_COUPLED_MAX]; /* what a step becomes in its first sample, */
    double taken[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX]; /* and its inverse */
    double still[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX]; /* inverse of C_0 */
    rthyb_matrix_inverse inverse, rig; /* of the command; the other way round, the axes as fitted */
    double last_p[RTHYB_COUPLED_MAX], last_m[RTHYB_COUPLED_MAX]; /* last good inputs */
    rthyb_lowpass filter; /* the filter pair, and what it takes away as offset */
    double filter_p[RTHYB_COUPLED_MAX][2], filter_m[RTHYB_COUPLED_MAX][2];
    double level_p[RTHYB_COUPLED_MAX], level_m[RTHYB_COUPLED_MAX], level_weight, least_weight;
    double p1[RTHYB_COUPLED_MAX], p2[RTHYB_COUPLED_MAX];
    double m1[RTHYB_COUPLED_MAX], m2[RTHYB_COUPLED_MAX];
    /* Least squares: one matrix for all rows of the command, a right-hand side for each. */
    double r[RTHYB_MATRIX_UNKNOWNS][RTHYB_MATRIX_UNKNOWNS];
    double q[RTHYB_COUPLED_MAX][RTHYB_MATRIX_UNKNOWNS];
    /* What noise of 1 m on one axis puts into them a sample. */
    double noise_r[RTHYB_MATRIX_TERMS][RTHYB_MATRIX_TERMS], noise_q[RTHYB_MATRIX_TERMS];
    double ridge[RTHYB_MATRIX_TERMS]; /* weight of where a term begins */
    double weight, forget;
    double power[RTHYB_COUPLED_MAX], gate_power[RTHYB_COUPLED_MAX];
    int32_t open; /* learning, for the record */
} rthyb_matrix_lead;

/* At rest at x0, one number an axis. RTHYB_E_LAW: sizes, a setting, or an inverse whose own inverse, the
 * axes as they were fitted, is not stable. */
int rthyb_matrix_lead_init(rthyb_matrix_lead *s, const rthyb_matrix_lead_config *cfg,
                           const double *x0_m);
/* Commands and specimen stand at x_m now; what has been learnt stays. */
void rthyb_matrix_lead_rest(rthyb_matrix_lead *s, const double *x_m);
/* The newest commands that the drives had, and what was measured. frozen: learn nothing from them. */
int rthyb_matrix_lead_observe(rthyb_matrix_lead *s, const double *x_p_m, const double *x_m_m,
                              int frozen);
/* x_c -> x_p for the same instant. What was learnt since the last call may move no axis by more than
 * allowed_m. */
int rthyb_matrix_lead_lead(rthyb_matrix_lead *s, const double *x_c_m, double allowed_m,
                           double *x_p_m);
/* Without learning: n rows of the axes. */
int rthyb_matrix_lead_run(rthyb_matrix_lead *s, const double *x_c_m, double *x_p_m, size_t n);
/* cffi: end */

#endif
