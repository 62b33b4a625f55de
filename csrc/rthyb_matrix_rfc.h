/* Restoring-force compensation of several axes with a tangent stiffness matrix (matrix_rfc.c). */
#ifndef RTHYB_PART_MATRIX_RFC_H
#define RTHYB_PART_MATRIX_RFC_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_kernels.h"
#include "rthyb_kinematics.h"

/* cffi: begin */

/* Displacements and forces are those of as many interface coordinates: m and N, or rad and N m. */
typedef struct {
    int32_t size; /* coordinates, 1 to RTHYB_COUPLED_MAX */
    int32_t enabled;
    double period_s;
    double memory_s;   /* a sample's weight falls to 1/e in this time */
    double cutoff_hz;  /* of the low-pass on x_c - x_m; 0: none */
    double lateness_s; /* of the forces as they are used, behind x_m */
    double k_e[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX]; /* elastic: symmetric, positive definite */
    double rest_noise[RTHYB_COUPLED_MAX]; /* standard deviation of each coordinate at rest */
} rthyb_matrix_rfc_config;

typedef struct {
    rthyb_matrix_rfc_config cfg;
    double k[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX];    /* tangent stiffness, between 0 and k_e */
    double root[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX]; /* L of k_e = L L', lower */
    double forget, weight;
    /* Of each pair of coordinates, forgetting: sums of products of displacements, and of force (row) and
     * displacement (column); sums of both. */
    double xx[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX], fx[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX];
    double x_sum[RTHYB_COUPLED_MAX], f_sum[RTHYB_COUPLED_MAX];
    double x_first[RTHYB_COUPLED_MAX], f_first[RTHYB_COUPLED_MAX]; /* they are taken from here */
    double c1[RTHYB_COUPLED_MAX], v1[RTHYB_COUPLED_MAX];           /* last good inputs */
    double x1[RTHYB_COUPLED_MAX], f1[RTHYB_COUPLED_MAX];
    rthyb_lowpass filter;
    double filter_s[RTHYB_COUPLED_MAX][2];
} rthyb_matrix_rfc;

/* At rest at x0 with the forces f0. RTHYB_E_PERIOD, RTHYB_E_STIFFNESS, RTHYB_E_LIMIT. */
int rthyb_matrix_rfc_init(rthyb_matrix_rfc *s, const rthyb_matrix_rfc_config *cfg, const double *x0,
                          const double *f0);
/* force = f + K (LP(x_c - x_m) + lateness v_c): what the equation of motion sees. frozen != 0 holds K. Status
 * bits. */
int rthyb_matrix_rfc_step(rthyb_matrix_rfc *s, const double *x_c, const double *v_c,
                          const double *x_m, const double *f, int frozen, double *force);
/* Takes in what moves along a path, and learns nothing from it. */
void rthyb_matrix_rfc_follow(rthyb_matrix_rfc *s, const double *x_c, const double *x_m,
                             const double *f);
/* n rows; k has n times size x size, row by row. */
int rthyb_matrix_rfc_run(rthyb_matrix_rfc *s, const double *x_c, const double *v_c,
                         const double *x_m, const double *f, double *force, double *k, size_t n);
/* cffi: end */

#endif
