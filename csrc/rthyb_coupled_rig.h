/* A virtual rig with several axes at one specimen (coupled_rig.c): one actuator per axis, coupled through the
 * specimen, or a state-space model of the whole; each axis has its own displacement sensor and load cell. */
#ifndef RTHYB_PART_COUPLED_RIG_H
#define RTHYB_PART_COUPLED_RIG_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_coupled_plant.h"
#include "rthyb_kinematics.h"
#include "rthyb_rig.h"

/* cffi: begin */

/* Replaces the actuators: s[n+1] = A s[n] + B u[n], u: commands, held from t_n on. Displacements of the axes at
 * t_n depend on s[n]; velocities and accelerations on s[n] and u[n-1]. */
typedef struct {
    int32_t states; /* 0: no state-space model */
    double a[RTHYB_PLANT_STATES][RTHYB_PLANT_STATES];
    double b[RTHYB_PLANT_STATES][RTHYB_COUPLED_MAX];
    double x_of[RTHYB_COUPLED_MAX][RTHYB_PLANT_STATES];
    double v_of[RTHYB_COUPLED_MAX][RTHYB_PLANT_STATES];
    double a_of[RTHYB_COUPLED_MAX][RTHYB_PLANT_STATES];
    double v_by[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX];
    double a_by[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX];
    double stroke_m[RTHYB_COUPLED_MAX]; /* commands are limited to +- this */
} rthyb_state_space;

typedef struct {
    int32_t size; /* axes */
    double period_s;
    /* relation between axes and interface, and what the sensors without an actuator measure */
    rthyb_kinematics_config kinematics;
    rthyb_servo_config servo[RTHYB_COUPLED_MAX]; /* any kind but the servo-valve */
    rthyb_state_space plant;
    /* The specimen in interface coordinates: force = K q + C q' + M q'' + elements. All symmetric; M positive
     * definite or 0. */
    double stiffness[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX];
    double damping[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX];
    double mass[RTHYB_COUPLED_MAX][RTHYB_COUPLED_MAX];
    /* With more axes than interface coordinates: stiffness between each actuator and the specimen, with which redundant
     * actuators that do not agree on a pose push against each other. */
    double attachment_n_per_m;
    uint32_t element_count;
    rthyb_element elements[RTHYB_ELEMENTS_MAX]; /* no inertia elements: mass is given above */
    int32_t along[RTHYB_ELEMENTS_MAX]; /* interface coordinate in which each element acts */
    rthyb_sensor displacement[RTHYB_COUPLED_MAX], force[RTHYB_COUPLED_MAX];
    int32_t load_cell; /* enum rthyb_load_cell */
    uint64_t seed;
    uint32_t extra_count[RTHYB_COUPLED_MAX]; /* of each axis, along which its sensors measure */
    rthyb_extra_sensor extras[RTHYB_COUPLED_MAX][RTHYB_EXTRAS_MAX];
    /* sensors without an actuator, as many as the kinematics has: displacements, then forces */
    rthyb_sensor sensor[RTHYB_SENSORS_ALL];
    /* 1 + axis * RTHYB_EXTRAS_MAX + number of the extra sensor that gives the same reading; 0: none does */
    int32_t sensor_extra[RTHYB_SENSORS_ALL];
} rthyb_coupled_rig_config;

typedef struct {
    rthyb_coupled_rig_config cfg;
    rthyb_kinematics kinematics;
    rthyb_servo servo[RTHYB_COUPLED_MAX];
    rthyb_noise noise, extra_noise, sensor_noise;
    double s[RTHYB_PLANT_STATES];
    double command[RTHYB_COUPLED_MAX]; /* state-space model: last valid commands */
    /* Readings of each axis without sensor errors. */
    double x_true_m[RTHYB_COUPLED_MAX], f_true_n[RTHYB_COUPLED_MAX];
    double v_true[RTHYB_COUPLED_MAX], a_true[RTHYB_COUPLED_MAX];
    /* Interface coordinates at the last latch. */
    double pose[RTHYB_COUPLED_MAX], pose_v[RTHYB_COUPLED_MAX], pose_a[RTHYB_COUPLED_MAX];
    double jacobian[RTHYB_COUPLED_SQUARE]; /* d axis / d pose, */
    double back[RTHYB_COUPLED_SQUARE];     /* and its inverse, or least-squares inverse */
    int32_t substeps;                      /* per sample; 0: no axis has substeps */
    /* Readings of the extra sensors at the same instant; extra_to: where each axis' are also written; NULL:
     * nowhere. */
    double extra[RTHYB_COUPLED_MAX][RTHYB_EXTRAS_MAX];
    double *extra_to[RTHYB_COUPLED_MAX];
    double force[RTHYB_COUPLED_MAX];  /* of the specimen, at the last latch */
    double sensor[RTHYB_SENSORS_ALL]; /* readings of the sensors without an actuator */
} rthyb_coupled_rig;

/* RTHYB_E_PLANT: sizes or matrix entries; RTHYB_E_PERIOD: period of an actuator; RTHYB_E_KINEMATICS,
 * RTHYB_E_SENSOR, RTHYB_E_ELEMENT; RTHYB_E_SERVO, also if actuators and specimen together are too stiff for the
 * substeps. */
int rthyb_coupled_rig_init(rthyb_coupled_rig *rig, const rthyb_coupled_rig_config *cfg);
/* Restarts the sensor noise from the seed. */
void rthyb_coupled_rig_reseed(rthyb_coupled_rig *rig);
/* Latches x_m[n] and f[n] of every axis, then applies x_p[n] and advances to t_{n+1}. */
int rthyb_coupled_rig_step(rthyb_coupled_rig *rig, const double *x_p_m, double *x_m_m, double *f_n);
/* For n rows of commands. */
int rthyb_coupled_rig_run(rthyb_coupled_rig *rig, const double *x_p_m, double *x_m_m, double *f_n,
                          size_t n);
/* cffi: end */

#endif
