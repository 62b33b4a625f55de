/* A virtual rig with several coupled axes: a linear plant from commands to displacements, and the specimen's
 * forces from matrices (coupled_plant.c). */
#ifndef RTHYB_PART_COUPLED_PLANT_H
#define RTHYB_PART_COUPLED_PLANT_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_kinematics.h"
#include "rthyb_rig.h"

/* cffi: begin */

enum rthyb_coupled_plant_size { RTHYB_PLANT_STATES = 32 };

typedef struct {
    int32_t size;   /* axes */
    int32_t states; /* states of the plant */
    int32_t forces; /* forces of the specimen; independent of the number of axes */
    double period_s;
    /* s[n+1] = A s[n] + B u[n], x[n] = C s[n]: u: commands, held from t_n on. */
    double a[RTHYB_PLANT_STATES][RTHYB_PLANT_STATES];
    double b[RTHYB_PLANT_STATES][RTHYB_COUPLED_MAX];
    double c[RTHYB_COUPLED_MAX][RTHYB_PLANT_STATES];
    double stroke_m[RTHYB_COUPLED_MAX]; /* commands are limited to +- this */
    double noise_m[RTHYB_COUPLED_MAX];  /* standard deviation of a reading, white */
    rthyb_kinematics_config kinematics; /* relation between axes and pose */
    /* Force j = sum over the coordinates of the pose of k q + c q' + m q''. q is the pose as read, including noise;
     * q' and q'' are its backward differences. */
    double stiffness[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX];
    double damping[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX];
    double mass[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX];
    uint64_t seed;
} rthyb_coupled_plant_config;

typedef struct {
    rthyb_coupled_plant_config cfg;
    rthyb_kinematics kinematics;
    rthyb_noise noise;
    double s[RTHYB_PLANT_STATES];
    double command[RTHYB_COUPLED_MAX]; /* last valid commands */
    double true_m[RTHYB_COUPLED_MAX];  /* readings without noise */
    double pose[RTHYB_COUPLED_MAX];    /* as read */
    double velocity[RTHYB_COUPLED_MAX];
} rthyb_coupled_plant;

/* RTHYB_E_PLANT, RTHYB_E_PERIOD, RTHYB_E_KINEMATICS. */
int rthyb_coupled_plant_init(rthyb_coupled_plant *plant, const rthyb_coupled_plant_config *cfg);
/* Latches x_m[n], one value per axis, and f[n], one value per force. */
int rthyb_coupled_plant_latch(rthyb_coupled_plant *plant, double *x_m_m, double *force);
/* Call after _latch: applies the commands and advances to t_{n+1}. */
int rthyb_coupled_plant_apply(rthyb_coupled_plant *plant, const double *x_p_m);
/* Both, for n rows of commands. */
int rthyb_coupled_plant_run(rthyb_coupled_plant *plant, const double *x_p_m, double *x_m_m,
                            double *force, size_t n);
/* cffi: end */

#endif
