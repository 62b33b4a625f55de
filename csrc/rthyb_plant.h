/* A virtual rig of any kind, with one axis or several (plant.c). */
#ifndef RTHYB_PART_PLANT_H
#define RTHYB_PART_PLANT_H

#include <stdint.h>

#include "rthyb_coupled_rig.h"
#include "rthyb_rig.h"

/* cffi: begin */

enum rthyb_plant_kind {
    RTHYB_PLANT_RIG,         /* rthyb_rig: one axis */
    RTHYB_PLANT_COUPLED_RIG, /* rthyb_coupled_rig */
    RTHYB_PLANT_KINDS
};

/* A virtual rig. The state belongs to the caller and is initialised by its own _init function. */
typedef struct {
    int32_t kind; /* enum rthyb_plant_kind */
    void *state;
} rthyb_plant;

/* Number of axes, 1 to RTHYB_COUPLED_MAX; 0: unknown kind. */
int32_t rthyb_plant_axes(const rthyb_plant *plant);
double rthyb_plant_period_s(const rthyb_plant *plant);
/* Latches x_m[n] and f[n] of each axis, then applies x_p[n] and advances to t_{n+1}. Status bits. */
int rthyb_plant_step(const rthyb_plant *plant, const double *x_p_m, double *x_m_m, double *f_n);
/* Restarts the sensor noise from the seed. */
void rthyb_plant_reseed(const rthyb_plant *plant);
/* Readings of the last step without sensor errors. */
void rthyb_plant_truth(const rthyb_plant *plant, double *x_true_m, double *f_true_n);
/* Readings of an axis' extra sensors in the last step: RTHYB_EXTRAS_MAX values, 0 where there is no sensor. */
void rthyb_plant_extra(const rthyb_plant *plant, int32_t axis, double *values);
/* Readings of the sensors without an actuator in the last step; returns their number. */
int32_t rthyb_plant_sensors(const rthyb_plant *plant, double *values);
/* cffi: end */

#endif
