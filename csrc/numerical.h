/* Operations of a kind of numerical part, found by the number of the kind. Not part of the interface of the core. */
#ifndef RTHYB_NUMERICAL_H
#define RTHYB_NUMERICAL_H

#include "rthyb.h"

/* A state consists of plain bytes, so that a copy of them is an independent part. Only `answer` is computed between a
 * reading and its command; whatever can wait until the command was sent is in `advance`, which must be called before
 * the next answer, freeze or look. */
typedef struct {
    size_t (*size)(const void *cfg);        /* of a state; 0 for invalid settings */
    int32_t (*interfaces)(const void *cfg); /* forces in, displacements out. NULL: one */
    int (*init)(const rthyb_numerical *part, double x0_m);
    /* Excitation and forces at t_n -> x_c[n+1], one value per interface; status bits. */
    int (*answer)(const rthyb_numerical *part, double excitation, const double *force_n,
                  double *x_next_m);
    int (*advance)(
        const rthyb_numerical *part); /* completes the step; status bits. NULL: nothing to do */
    /* Called in a tick in which a path determines the displacement: the part's time does not advance. NULL: nothing
     * to do */
    void (*freeze)(const rthyb_numerical *part, const double *force_n);
    void (*look)(const rthyb_numerical *part, rthyb_interface *at); /* one value per interface */
    size_t (*report)(const rthyb_numerical *part, double *values, size_t most);
    /* Called before the bytes of the state are copied, and after they were restored. NULL: nothing to do */
    void (*before_save)(const rthyb_numerical *part);
    void (*after_restore)(const rthyb_numerical *part);
} rthyb_numerical_ops;

extern const rthyb_numerical_ops rthyb_motion_ops, rthyb_dense_ops, rthyb_sparse_ops,
    rthyb_library_ops;

/* NULL for an unknown kind. */
const rthyb_numerical_ops *rthyb_numerical_find(int32_t kind);

#endif
