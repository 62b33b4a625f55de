/* What a kind of numerical part is made of: a table of operations, found by its number. Nothing here
 * crosses the library's boundary. */
#ifndef RTHYB_NUMERICAL_H
#define RTHYB_NUMERICAL_H

#include "rthyb.h"

/* A state is plain bytes: whoever copies them has a second part that goes on by itself. Between force and
 * command stands `answer` alone; what may wait until the command has left is in `advance`, which the
 * next answer, freeze or look finds done. */
typedef struct {
    size_t size; /* of a state */
    int (*init)(void *state, const void *cfg, double x0_m);
    /* Excitation and force of t_n -> x_c[n+1]; status bits. */
    int (*answer)(void *state, double excitation, double force_n, double *x_next_m);
    int (*advance)(void *state); /* the rest of that step; status bits. NULL: there is none */
    /* A tick in which the displacement comes from a path: time stands still. NULL: nothing to do */
    void (*freeze)(void *state, double force_n);
    void (*look)(const void *state, rthyb_interface *at);
    size_t (*report)(const void *state, double *values, size_t most);
} rthyb_numerical_ops;

extern const rthyb_numerical_ops rthyb_motion_ops, rthyb_dense_ops;

/* NULL for a kind that does not exist. */
const rthyb_numerical_ops *rthyb_numerical_find(int32_t kind);

#endif
