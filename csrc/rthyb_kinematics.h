/* Kinematics of several actuators at one specimen: conversion between displacements of the axes and of the
 * interface (kinematics.c). */
#ifndef RTHYB_PART_KINEMATICS_H
#define RTHYB_PART_KINEMATICS_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_record.h"

/* cffi: begin */

enum rthyb_kinematics_kind {
    RTHYB_KINEMATICS_MATRIX, /* axes = matrix times pose: small displacements, or parallel axes */
    /* exact plane motion: each axis connects a base to a pin on the coupler */
    RTHYB_KINEMATICS_PINS
};

enum rthyb_coordinate {
    RTHYB_COORDINATE_X,    /* m */
    RTHYB_COORDINATE_Y,    /* m */
    RTHYB_COORDINATE_THETA /* rad, from x towards y */
};

/* Sensors without an actuator: further displacement sensors and load cells at the specimen. */
enum rthyb_sensor_size {
    RTHYB_SENSORS_MAX = 4, /* of each of the two kinds */
    RTHYB_SENSORS_ALL = 8,
    RTHYB_MEASURED_MAX = 32 /* interface coordinates times axes and sensors of one kind */
};

enum rthyb_kinematics_given {
    RTHYB_GIVEN_FORCES = 1,       /* `forces` is used; otherwise the transposed Jacobian */
    RTHYB_GIVEN_DISPLACEMENTS = 2 /* `displacements` is used; otherwise the least-squares inverse */
};

/* Only the first `size` entries of an array of axes are used; matrices are stored row by row. With a matrix there may
 * be fewer interface coordinates than axes, because the actuators are redundant; with pins there are as many. Load cells
 * without an actuator need `forces`. */
typedef struct {
    int32_t kind;       /* enum rthyb_kinematics_kind */
    int32_t size;       /* axes; pins: 1 to 3 */
    int32_t directions; /* interface coordinates; 0: as many as axes */
    int32_t given;      /* enum rthyb_kinematics_given, bits; with pins at most FORCES */
    double matrix[RTHYB_COUPLED_SQUARE]; /* size rows of `directions` values */
    /* `directions` rows, with one value for each axis and then one for each sensor without an actuator. forces:
     * interface forces = forces times load cells; displacements: pose = displacements times displacement sensors, so that
     * displacements times (matrix, then reads) must be the identity. With pins, `forces` has the columns of the sensors
     * only: F = J'f + forces (g - carries J'f), where J'f are the forces along the interface by the axes' load cells f, and
     * g the readings of those without an actuator. */
    double forces[RTHYB_MEASURED_MAX], displacements[RTHYB_MEASURED_MAX];
    int32_t displacement_sensors,
        force_sensors; /* without an actuator: 0 to RTHYB_SENSORS_MAX each */
    /* A row of `directions` values for each: reading of such a displacement sensor for a pose, and of such a load cell
     * for the interface forces. The load cells of the axes are then in line with them: forces times (the forces of the axes
     * with a given resultant, then carries) must be the identity. With pins, `reads` is not used: see sensor_pin_m. */
    double reads[RTHYB_COUPLED_SQUARE], carries[RTHYB_COUPLED_SQUARE];
    /* The rest applies to pins only. Coordinates that are not listed remain 0. */
    int32_t coordinate[RTHYB_COUPLED_MAX]; /* enum rthyb_coordinate, each at most once */
    /* x and y of each axis at rest, relative to the point whose motion is the pose. */
    double pin_m[RTHYB_COUPLED_MAX][2];
    double base_m[RTHYB_COUPLED_MAX][2];
    /* Not 0: the base is so far away that the axis does not turn; base_m is then the direction from base to pin, as
     * a vector of any length. */
    int32_t far[RTHYB_COUPLED_MAX];
    int32_t pulls[RTHYB_COUPLED_MAX]; /* not 0: shortening of the axis is positive */
    /* The same for the displacement sensors without an actuator. */
    double sensor_pin_m[RTHYB_SENSORS_MAX][2];
    double sensor_base_m[RTHYB_SENSORS_MAX][2];
    int32_t sensor_far[RTHYB_SENSORS_MAX];
    int32_t sensor_pulls[RTHYB_SENSORS_MAX];
} rthyb_kinematics_config;

typedef struct {
    rthyb_kinematics_config cfg;
    double reach[RTHYB_COUPLED_MAX][2];   /* from base to pin at rest; far: the unit direction */
    double rest_m[RTHYB_COUPLED_MAX];     /* length at rest */
    double inverse[RTHYB_COUPLED_SQUARE]; /* of the matrix: rows of `size` */
    double measure[RTHYB_MEASURED_MAX];   /* with displacement sensors: pose from all of them */
    double pushes[RTHYB_COUPLED_SQUARE]; /* of forces: rows of `directions`; unless cfg is square */
    double scale[RTHYB_COUPLED_MAX]; /* of each coordinate, m: 1, or the pins' distance for theta */
    double pose[RTHYB_COUPLED_MAX];  /* last result of rthyb_kinematics_pose */
    double wanted[RTHYB_COUPLED_MAX]; /* last valid inputs: pose, */
    double axis_m[RTHYB_COUPLED_MAX]; /* axes, */
    double axis_n[RTHYB_COUPLED_MAX]; /* forces, */
    double sensor[RTHYB_SENSORS_ALL]; /* sensors without an actuator: displacements, then forces */
} rthyb_kinematics;

/* RTHYB_E_KINEMATICS: sizes, a coordinate listed twice, a pin that coincides with its base, or axes, displacements or
 * forces that do not determine every coordinate. Afterwards s->cfg.directions is not 0. Without `given`, displacements
 * of further sensors count like those of the axes: least squares. */
int rthyb_kinematics_init(rthyb_kinematics *s, const rthyb_kinematics_config *cfg);
/* Number of interface coordinates, before or after _init. */
int32_t rthyb_kinematics_directions(const rthyb_kinematics_config *cfg);
/* Pose -> displacement of each axis. Status bits. */
int rthyb_kinematics_axes(rthyb_kinematics *s, const double *pose, double *axis_m);
/* Displacement of each axis -> pose, by two Newton steps from the previous pose. If they do not converge, returns
 * the previous pose and RTHYB_S_OUT_OF_RANGE. */
int rthyb_kinematics_pose(rthyb_kinematics *s, const double *axis_m, double *pose);
/* The same without a nearby previous pose, for use at the start of a test: iterates from the last pose, and if
 * that fails from the pose at rest, until the axes agree. If no pose is found, returns the pose at rest and
 * RTHYB_S_OUT_OF_RANGE. */
int rthyb_kinematics_find(rthyb_kinematics *s, const double *axis_m, double *pose);
/* Forces of the axes, positive in the positive direction of each axis -> forces and moments in interface
 * coordinates, by the transposed Jacobian at the last pose found, or by the given matrix; with load cells without an
 * actuator always by the former. */
int rthyb_kinematics_forces(rthyb_kinematics *s, const double *axis_n, double *force);
/* Pose and interface forces as measured, from the readings of the axes and of the sensors without an actuator: first
 * all displacements, then all forces. Without such sensors the same as _pose and _forces. With pins, displacements of
 * further sensors count like those of the axes, by two Gauss-Newton steps from the previous pose. */
int rthyb_kinematics_measured_pose(rthyb_kinematics *s, const double *axis_m, const double *sensor,
                                   double *pose);
int rthyb_kinematics_measured_forces(rthyb_kinematics *s, const double *axis_n,
                                     const double *sensor, double *force);
/* Readings of the sensors without an actuator for a pose and interface forces. */
void rthyb_kinematics_readings(const rthyb_kinematics_config *cfg, const double *pose,
                               const double *force, double *sensor);
/* Their change from one pose to another, for a change of the interface forces. */
void rthyb_kinematics_change(const rthyb_kinematics_config *cfg, const double *from,
                             const double *to, const double *force, double *sensor);
/* d reading / d pose of the displacement sensors without an actuator at the last pose found, rows of `directions`. */
void rthyb_kinematics_reads(const rthyb_kinematics *s, double *reads);
/* With pins: by how much the displacements of the axes and of the sensors without an actuator differ from their
 * lengths at the last pose found, and d length / d pose there, a row for each. */
void rthyb_kinematics_left(const rthyb_kinematics *s, const double *axis_m, const double *sensor,
                           double *slopes, double *left);
/* Number of sensors without an actuator. */
int32_t rthyb_kinematics_sensors(const rthyb_kinematics_config *cfg);
/* The inverse: forces and moments in interface coordinates -> force of each axis; with redundant axes, the smallest
 * forces (root sum square) that have this resultant. */
int rthyb_kinematics_pushes(const rthyb_kinematics *s, const double *force, double *axis_n);
/* d axis / d pose at the last pose found, rows of `directions`. */
void rthyb_kinematics_jacobian(const rthyb_kinematics *s, double *jacobian);
/* Velocity and acceleration of each axis for a pose with given velocity and acceleration; exact, including the
 * acceleration due to rotation of the coupler and the axes. HUGE_VAL for a pin that coincides with its base. */
void rthyb_kinematics_rates(const rthyb_kinematics *s, const double *pose, const double *velocity,
                            const double *acceleration, double *axis_velocity,
                            double *axis_acceleration);
/* The same for n successive poses, or n successive rows of axes. */
int rthyb_kinematics_axes_run(rthyb_kinematics *s, const double *pose, double *axis_m, size_t n);
int rthyb_kinematics_pose_run(rthyb_kinematics *s, const double *axis_m, double *pose, size_t n);
/* cffi: end */

#endif
