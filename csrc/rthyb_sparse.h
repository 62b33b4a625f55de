/* A numerical part with sparse matrices, for many degrees of freedom (numerical_sparse.c). */
#ifndef RTHYB_PART_SPARSE_H
#define RTHYB_PART_SPARSE_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_rig.h"

/* cffi: begin */

enum rthyb_sparse_size {
    RTHYB_SPARSE_MAX = 20000,        /* degrees of freedom */
    RTHYB_SPARSE_ENTRIES = 20000000, /* entries of one matrix off the diagonal */
    RTHYB_INTERFACES_MAX = 8,
    RTHYB_INTERFACES_SQUARE = 64, /* its square */
    RTHYB_SPARSE_ELEMENTS_MAX = 20000,
    RTHYB_SPARSE_MODES_MAX = 64,
    RTHYB_RESPONSES_MAX = 32,
    RTHYB_SLIDERS_MAX = 32
};

/* A symmetric matrix: its diagonal, and the entries above it, row by row. For the factor L: the entries below the
 * diagonal, column by column, which is the same order. */
typedef struct {
    const double *diagonal; /* n */
    const int32_t *start;   /* n + 1 indices, the first is 0 */
    const int32_t *at;      /* start[n] column indices, each greater than its row index */
    const double *value;    /* start[n] values */
} rthyb_symmetric;

/* Weighted sums of terms, one per row. */
typedef struct {
    const int32_t *start; /* rows + 1 indices, the first is 0 */
    const int32_t *at;
    const double *weight;
} rthyb_rows;

/* An element of the catalogue between two degrees of freedom (-1: ground). Its displacement is x[above] - x[below].
 * stiffness_n_per_m: the part of its stiffness that the stiffness matrix and S contain. */
typedef struct {
    int32_t below, above;
    double stiffness_n_per_m;
    rthyb_element element;
} rthyb_joint;

/*   M x'' + C x' + K x + (elements) + B force = -load ag
 * with all arrays in elimination order, and the factors L and D of
 *   S = (1 - a_m) M + (1 - a_f) (gamma h C + beta h^2 K) = L D L',
 * where K, in both equations, includes the initial stiffness of the elements and k_e at the interfaces. All arrays are
 * provided by the caller. */
typedef struct {
    int32_t size, interfaces, joints, modes, responses;
    int32_t damped; /* 0: damping_n_s_per_m is not used */
    double period_s;
    double alpha_m, alpha_f, gamma, beta;
    rthyb_symmetric mass_kg, stiffness_n_per_m;
    rthyb_symmetric damping_n_s_per_m;    /* in addition to Rayleigh and modal damping below */
    double by_mass_per_s, by_stiffness_s; /* Rayleigh damping: factors of M and K */
    const double *modal;                  /* size x modes: modal damping is U U' */
    rthyb_symmetric factor; /* of S without modal damping: L, and 1 / D on the diagonal */
    /* Panels of L: below their common triangle, columns panel[i] to panel[i + 1] - 1 have entries in the same rows.
     * panels + 1 indices from 0 to size; 0 panels: unknown. */
    const int32_t *panel;
    int32_t panels;
    const double *modal_solved; /* size x modes: Z = S^-1 U, S likewise without modal damping */
    const double *modal_inner;  /* modes x modes: (1 / g + U' Z)^-1, g = (1 - a_f) gamma h */
    const double *load_kg;      /* size */
    rthyb_rows interface;       /* B', one row per interface */
    const double *k_e_n_per_m;  /* interfaces */
    /* coupling stiffness: interfaces x interfaces, 0 on the diagonal; NULL: none */
    const double *k_e_between;
    const rthyb_joint *joint;
    /* Response q to a unit force at each interface (interfaces x size), and to a unit excitation (size). The first
     * step, which has no predecessor, has its own responses. */
    const double *by_force, *by_excitation, *first_by_force, *first_by_excitation;
    /* Initial x and v, and q of the first step without force and excitation, `size` values each. All NULL: at rest
     * at 0. */
    const double *first_x, *first_v, *first_q;
    /* Named responses: terms 0 to size - 1 are degrees of freedom, followed by the forces of the elements, then
     * those at the interfaces. */
    rthyb_rows response;
    /* Joints with dry friction whose force is solved for with the step: their indices, ascending; 0: none. With
     * B_k across joint k, W_k = (1 - a_f) S^-1 B_k, the response q to minus a unit force, and the velocity u of joint j
     * per unit of such a force, G_jk = gamma h B_j' W_k (sliders x sliders). */
    int32_t sliders;
    const int32_t *slider;
    const double *slider_w; /* sliders x size */
    const double *slider_g;
    const double
        *slider_x; /* x[n+1] at the interfaces per unit of such a force, interfaces x sliders */
} rthyb_sparse_config;

/* What the forces of dry friction took between force and command. */
typedef struct {
    int32_t passes;   /* linear solutions */
    int32_t changes;  /* elements that began to hold or to slide in one of them */
    int32_t law_cost; /* of evaluating laws: 2 for one exponential, 3 for two, 4 with a power */
    int32_t settled;  /* 0: the rest was left until after the command */
} rthyb_friction_effort;

/* Beginning of the state; vectors and elements follow. */
typedef struct {
    int32_t size, interfaces, joints;
    int32_t stepped; /* 0 before the first step */
    int32_t ran_off;
    int32_t padding;
    rthyb_friction_effort friction_effort;
    double gain[2][RTHYB_INTERFACES_SQUARE]; /* for the first step, and for all others */
    double pull[2][RTHYB_INTERFACES_MAX];    /* x[n+1] per unit excitation */
    double base[RTHYB_INTERFACES_MAX];       /* x[n+1] without force and excitation */
    double x[RTHYB_INTERFACES_MAX], x1[RTHYB_INTERFACES_MAX], x2[RTHYB_INTERFACES_MAX];
    double a[RTHYB_INTERFACES_MAX];
    double force[RTHYB_INTERFACES_MAX]; /* in this step */
    double excitation;
} rthyb_sparse;

/* Size of a state in bytes; 0 for invalid sizes. */
size_t rthyb_sparse_bytes(const rthyb_sparse_config *cfg);
/* Displacement of every degree of freedom at t_n, in elimination order, at most `most` of them; returns their
 * number. */
size_t rthyb_sparse_displacements(const rthyb_sparse_config *cfg, const rthyb_sparse *state,
                                  double *values, size_t most);
/* values = S^-1 values, in place: the main cost of advance, once per step. */
void rthyb_sparse_solve(const rthyb_sparse_config *cfg, double *values);
/* cffi: end */

#endif
