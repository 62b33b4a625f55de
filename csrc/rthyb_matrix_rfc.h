/* Restoring-force compensation for several axes, with a tangent stiffness matrix (matrix_rfc.c). */
#ifndef RTHYB_PART_MATRIX_RFC_H
#define RTHYB_PART_MATRIX_RFC_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_kernels.h"
#include "rthyb_kinematics.h"

/* cffi: begin */

/* Displacements and forces in interface coordinates: m and N, or rad and N m. */
typedef struct {
    int32_t size; /* coordinates, 1 to RTHYB_COUPLED_MAX */
    int32_t enabled;
    double period_s;
    double memory_s;   /* time in which the weight of a sample falls to 1/e */
    double cutoff_hz;  /* of the low-pass filter on x_c - x_m; 0: no filter */
    double lateness_s; /* delay of the forces used, relative to x_m */
    double k_e[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX]; /* elastic: symmetric, positive definite */
    double rest_noise[RTHYB_COUPLED_MAX]; /* standard deviation of each coordinate at rest */
} rthyb_matrix_rfc_config;

typedef struct {
    rthyb_matrix_rfc_config cfg;
    double k[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX];    /* tangent stiffness, between 0 and k_e */
    double root[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX]; /* L of k_e = L L', lower */
    double forget, weight;
    /* Sums with exponential forgetting, for each pair of coordinates: products of displacements, and products of
     * force (row) and displacement (column); then sums of displacements and of forces. */
    double xx[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX], fx[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX];
    double x_sum[RTHYB_COUPLED_MAX], f_sum[RTHYB_COUPLED_MAX];
    double x_first[RTHYB_COUPLED_MAX], f_first[RTHYB_COUPLED_MAX]; /* subtracted before summing */
    double c1[RTHYB_COUPLED_MAX], v1[RTHYB_COUPLED_MAX];           /* last valid inputs */
    double x1[RTHYB_COUPLED_MAX], f1[RTHYB_COUPLED_MAX];
    rthyb_lowpass filter;
    double filter_s[RTHYB_COUPLED_MAX][2];
} rthyb_matrix_rfc;

/* Initialises at rest at x0 with forces f0. RTHYB_E_PERIOD, RTHYB_E_STIFFNESS, RTHYB_E_LIMIT. */
int rthyb_matrix_rfc_init(rthyb_matrix_rfc *s, const rthyb_matrix_rfc_config *cfg, const double *x0,
                          const double *f0);
/* force = f + K (LP(x_c - x_m) + lateness v_c), the force in the equation of motion. frozen != 0 holds K. Status
 * bits. */
int rthyb_matrix_rfc_step(rthyb_matrix_rfc *s, const double *x_c, const double *v_c,
                          const double *x_m, const double *f, int frozen, double *force);
/* Stores a sample of a motion along a path without adapting K. */
void rthyb_matrix_rfc_follow(rthyb_matrix_rfc *s, const double *x_c, const double *x_m,
                             const double *f);
/* For n rows; k receives n matrices of size x size, row by row. */
int rthyb_matrix_rfc_run(rthyb_matrix_rfc *s, const double *x_c, const double *v_c,
                         const double *x_m, const double *f, double *force, double *k, size_t n);
/* cffi: end */

#endif
