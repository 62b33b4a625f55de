/* Readings that differ from what all other sensors of their kind imply (disagreement.c). */
#ifndef RTHYB_PART_DISAGREEMENT_H
#define RTHYB_PART_DISAGREEMENT_H

#include "rthyb_kinematics.h"

/* cffi: begin */
enum rthyb_compared_size {
    RTHYB_COMPARED_MAX = 8 /* displacements, or forces: of four axes and four sensors */
};

/* By how much a reading may differ from what it measures: the larger of a share of the largest value that the others
 * have implied since the tare, and a value in m or N. */
typedef struct {
    double share, least;
    /* not 0: the limit of this reading is that of its watch, plus what it and those that it is compared with may differ by */
    int32_t grows;
} rthyb_allowance;

/* Of the displacements and of the forces: those of the axes, then those of the sensors without an actuator. */
typedef struct {
    int32_t displacements, forces; /* how many are compared; 0: none implies another */
    /* Row k: weights of all readings in the difference of reading k from what the others imply; its own is 1. Only zeros:
     * they do not imply it. */
    double by_x[RTHYB_COMPARED_MAX][RTHYB_COMPARED_MAX];
    double by_f[RTHYB_COMPARED_MAX][RTHYB_COMPARED_MAX];
    /* A difference times these is the normalised residual: if a single reading is wrong, its own is the largest. */
    double norm_x[RTHYB_COMPARED_MAX], norm_f[RTHYB_COMPARED_MAX];
    double share; /* of a new difference in the smoothed one */
    double x[RTHYB_COMPARED_MAX], f[RTHYB_COMPARED_MAX]; /* smoothed differences, m and N */
    double peak_x[RTHYB_COMPARED_MAX], peak_f[RTHYB_COMPARED_MAX]; /* of what the others imply */
} rthyb_disagreement;

/* For kinematics that rthyb_kinematics_init accepts, or of size 0. With pins the weights are those at rest; the station
 * replaces them by those at the pose of each tick. */
void rthyb_disagreement_init(rthyb_disagreement *d, const rthyb_kinematics_config *tie,
                             double period_s);
/* cffi: end */

#endif
