/* A numerical part of any size by sparse matrices (numerical_sparse.c). */
#ifndef RTHYB_PART_SPARSE_H
#define RTHYB_PART_SPARSE_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_rig.h"

/* cffi: begin */

enum rthyb_sparse_size {
    RTHYB_SPARSE_MAX = 20000,        /* degrees of freedom */
    RTHYB_SPARSE_ENTRIES = 20000000, /* of one matrix, off the diagonal */
    RTHYB_INTERFACES_MAX = 8,
    RTHYB_INTERFACES_SQUARE = 64, /* its square */
    RTHYB_SPARSE_ELEMENTS_MAX = 20000,
    RTHYB_SPARSE_MODES_MAX = 64,
    RTHYB_RESPONSES_MAX = 32
};

/* A symmetric matrix: its diagonal, and what stands above it, row after row. Of the factor L: what stands
 * below the diagonal, column after column; the same numbers. */
typedef struct {
    const double *diagonal; /* n */
    const int32_t *start;   /* n + 1, from 0 */
    const int32_t *at;      /* start[n], each above the number of its row */
    const double *value;    /* start[n] */
} rthyb_symmetric;

/* Sums of terms, one a row. */
typedef struct {
    const int32_t *start; /* rows + 1, from 0 */
    const int32_t *at;
    const double *weight;
} rthyb_rows;

/* An element of the catalogue between two degrees of freedom, -1 for the ground: it sees x[above] - x[below] and
 * resists. stiffness_n_per_m: what of it is in the stiffness matrix and in S. */
typedef struct {
    int32_t below, above;
    double stiffness_n_per_m;
    rthyb_element element;
} rthyb_joint;

/*   M x'' + C x' + K x + (elements) + B force = -load ag
 * with everything in the order of the elimination, and  S = L D L'  and what follows from it of
 *   S = (1 - a_m) M + (1 - a_f) (gamma h C + beta h^2 K),
 * where K, here and there, has the initial stiffness of the elements and k_e at the interfaces in it. All
 * arrays are the caller's. */
typedef struct {
    int32_t size, interfaces, joints, modes, responses;
    int32_t damped; /* 0: there is no damping_n_s_per_m */
    double period_s;
    double alpha_m, alpha_f, gamma, beta;
    rthyb_symmetric mass_kg, stiffness_n_per_m;
    rthyb_symmetric damping_n_s_per_m;    /* beside the two below */
    double by_mass_per_s, by_stiffness_s; /* Rayleigh: so much of M and K is damping */
    const double *modal;                  /* size x modes: modal damping is U U' */
    rthyb_symmetric factor; /* L, and on its diagonal 1 / D, of S without modal damping */
    /* Panels of L: columns panel[i] to panel[i + 1] - 1 have the same rows below the last of them. panels + 1
     * numbers from 0 to size; 0 panels: not known. */
    const int32_t *panel;
    int32_t panels;
    const double *modal_solved; /* size x modes: Z = S^-1 U, likewise */
    const double *modal_inner;  /* modes x modes: (1 / g + U' Z)^-1, g = (1 - a_f) gamma h */
    const double *load_kg;      /* size */
    rthyb_rows interface;       /* B', a row for each interface */
    const double *k_e_n_per_m;  /* interfaces */
    const double *k_e_between;  /* interfaces x interfaces, 0 on its diagonal; NULL: none */
    const rthyb_joint *joint;
    /* q of a unit force and of a unit excitation: size for each interface, one after the other; size. The
     * first step, which has none before it, has its own. */
    const double *by_force, *by_excitation, *first_by_force, *first_by_excitation;
    /* Where it begins, size each: x, v, and q of the first step without force and excitation. All NULL: at
     * rest at 0. */
    const double *first_x, *first_v, *first_q;
    /* Named values: terms 0 to size - 1 are degrees of freedom, then follow the forces of the elements, then
     * those at the interfaces. */
    rthyb_rows response;
} rthyb_sparse_config;

/* The state begins with this; vectors and elements follow. */
typedef struct {
    int32_t size, interfaces, joints;
    int32_t stepped; /* 0 before the first step */
    int32_t ran_off;
    int32_t padding;
    double gain[2][RTHYB_INTERFACES_SQUARE]; /* of the first step, and of all others */
    double pull[2][RTHYB_INTERFACES_MAX];    /* x[n+1] by the excitation */
    double base[RTHYB_INTERFACES_MAX];       /* x[n+1] without force and excitation */
    double x[RTHYB_INTERFACES_MAX], x1[RTHYB_INTERFACES_MAX], x2[RTHYB_INTERFACES_MAX];
    double a[RTHYB_INTERFACES_MAX];
    double force[RTHYB_INTERFACES_MAX]; /* of this step */
    double excitation;
} rthyb_sparse;

/* Bytes of a state; 0 for senseless sizes. */
size_t rthyb_sparse_bytes(const rthyb_sparse_config *cfg);
/* Displacement of every degree of freedom at t_n, in the order of the elimination; how many. */
size_t rthyb_sparse_displacements(const rthyb_sparse_config *cfg, const rthyb_sparse *state,
                                  double *values, size_t most);
/* S^-1 values, in place: what advance does once a step. */
void rthyb_sparse_solve(const rthyb_sparse_config *cfg, double *values);
/* cffi: end */

#endif
