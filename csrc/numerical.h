/* What a kind of numerical part is made of: a table of operations, found by its number. Nothing here
 * crosses the library's boundary. */
#ifndef RTHYB_NUMERICAL_H
#define RTHYB_NUMERICAL_H

#include "rthyb.h"

/* A state is plain bytes: whoever copies them has a second part that goes on by itself. Between force and
 * command stands `answer` alone; what may wait until the command has left is in `advance`, which the
 * next answer, freeze or look finds done. */
typedef struct {
    size_t (*size)(const void *cfg); /* of a state; 0 for senseless settings */
    int (*init)(const rthyb_numerical *part, double x0_m);
    /* Excitation and forces of t_n -> x_c[n+1], one each for every interface; status bits. */
    int (*answer)(const rthyb_numerical *part, double excitation, const double *force_n,
                  double *x_next_m);
    int (*advance)(
        const rthyb_numerical *part); /* the rest of that step; status bits. NULL: none */
    /* A tick in which the displacement comes from a path: time stands still. NULL: nothing to do */
    void (*freeze)(const rthyb_numerical *part, const double *force_n);
    void (*look)(const rthyb_numerical *part, rthyb_interface *at); /* one for every interface */
    size_t (*report)(const rthyb_numerical *part, double *values, size_t most);
    /* Its bytes are about to be copied, or have been put back. NULL: they are all there is */
    void (*before_save)(const rthyb_numerical *part);
    void (*after_restore)(const rthyb_numerical *part);
} rthyb_numerical_ops;

extern const rthyb_numerical_ops rthyb_motion_ops, rthyb_dense_ops, rthyb_sparse_ops,
    rthyb_library_ops;

/* NULL for a kind that does not exist. */
const rthyb_numerical_ops *rthyb_numerical_find(int32_t kind);

#endif
