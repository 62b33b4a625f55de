/* Several actuators at one specimen: displacements of the axes from those of the interface, and back
 * (kinematics.c). */
#ifndef RTHYB_PART_KINEMATICS_H
#define RTHYB_PART_KINEMATICS_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_record.h"

/* cffi: begin */

enum rthyb_kinematics_kind {
    RTHYB_KINEMATICS_MATRIX, /* axes = matrix times pose: small displacements, or axes side by side */
    RTHYB_KINEMATICS_PINS /* plane motion, exact: each axis from a base to a pin on the coupler */
};

enum rthyb_coordinate {
    RTHYB_COORDINATE_X,    /* m */
    RTHYB_COORDINATE_Y,    /* m */
    RTHYB_COORDINATE_THETA /* rad, from x towards y */
};

/* Arrays of axes have `size` numbers that count, square ones rows of `size`, the first at 0. There are as
 * many interface coordinates as axes. */
typedef struct {
    int32_t kind; /* enum rthyb_kinematics_kind */
    int32_t size; /* axes; pins: 1 to 3 */
    double matrix[RTHYB_COUPLED_SQUARE];
    /* The rest is of pins. Coordinates that are not named stay 0. */
    int32_t coordinate[RTHYB_COUPLED_MAX]; /* enum rthyb_coordinate, each once */
    /* At rest, from the point whose motion the pose is: x and y of each axis. */
    double pin_m[RTHYB_COUPLED_MAX][2];
    double base_m[RTHYB_COUPLED_MAX][2];
    /* Not 0: the base is so far away that the axis keeps its direction; base_m is a direction from base to
     * pin of any length. */
    int32_t far[RTHYB_COUPLED_MAX];
    int32_t pulls[RTHYB_COUPLED_MAX]; /* not 0: the axis counts its shortening as positive */
} rthyb_kinematics_config;

typedef struct {
    rthyb_kinematics_config cfg;
    double reach[RTHYB_COUPLED_MAX][2];   /* from base to pin at rest; far: the unit direction */
    double rest_m[RTHYB_COUPLED_MAX];     /* length at rest */
    double inverse[RTHYB_COUPLED_SQUARE]; /* of the matrix */
    double scale[RTHYB_COUPLED_MAX]; /* of each coordinate, m: 1, or the pins' distance for theta */
    double pose[RTHYB_COUPLED_MAX];  /* last one of rthyb_kinematics_pose */
    double wanted[RTHYB_COUPLED_MAX]; /* last good inputs: poses, */
    double axis_m[RTHYB_COUPLED_MAX]; /* axes, */
    double axis_n[RTHYB_COUPLED_MAX]; /* forces */
} rthyb_kinematics;

/* RTHYB_E_KINEMATICS: sizes, a coordinate named twice, pins that coincide with their bases, axes that
 * leave a coordinate free. */
int rthyb_kinematics_init(rthyb_kinematics *s, const rthyb_kinematics_config *cfg);
/* Pose -> displacement of each axis. Status bits. */
int rthyb_kinematics_axes(rthyb_kinematics *s, const double *pose, double *axis_m);
/* Displacement of each axis -> pose, by two steps of Newton from the last one found, which stays, with
 * RTHYB_S_OUT_OF_RANGE, where they do not converge. */
int rthyb_kinematics_pose(rthyb_kinematics *s, const double *axis_m, double *pose);
/* The same from anywhere, for what begins: from the last pose, else from that at rest, until the axes are where
 * they are said to be. RTHYB_S_OUT_OF_RANGE where no pose is found: then it is that at rest. */
int rthyb_kinematics_find(rthyb_kinematics *s, const double *axis_m, double *pose);
/* Forces of the axes, positive where they push the way they count -> forces and moments along the
 * coordinates at the last pose found: the transposed Jacobian. */
int rthyb_kinematics_forces(rthyb_kinematics *s, const double *axis_n, double *force);
/* The other way round: what each axis pushes with where those are the forces along the coordinates. */
int rthyb_kinematics_pushes(const rthyb_kinematics *s, const double *force, double *axis_n);
/* d axis / d pose at the last pose found, rows of `size`. */
void rthyb_kinematics_jacobian(const rthyb_kinematics *s, double *jacobian);
/* Velocity and acceleration of each axis where the specimen passes a pose with those of each coordinate: exact,
 * with what the turning of coupler and axes adds to an acceleration. HUGE_VAL for a pin in its own base. */
void rthyb_kinematics_rates(const rthyb_kinematics *s, const double *pose, const double *velocity,
                            const double *acceleration, double *axis_velocity,
                            double *axis_acceleration);
/* n poses, or n rows of axes, one after the other. */
int rthyb_kinematics_axes_run(rthyb_kinematics *s, const double *pose, double *axis_m, size_t n);
int rthyb_kinematics_pose_run(rthyb_kinematics *s, const double *axis_m, double *pose, size_t n);
/* cffi: end */

#endif
