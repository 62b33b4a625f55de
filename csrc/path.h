/* Paths of limited velocity and acceleration between two states of motion. */
#ifndef RTHYB_PATH_H
#define RTHYB_PATH_H

#include "rthyb.h"

/* There is one path per interface coordinate; all start together and have the same duration. The limits are those of
 * the axes. The Jacobian (rows of `directions` values) relates the axes to the coordinates, and the slowest axis
 * determines the duration. With pins, the Jacobian depends on the pose: the path is first computed with the given
 * Jacobian, then lengthened until every axis is within its limits everywhere along it. */
typedef struct {
    double period_s;
    int axes, directions;
    double velocity_m_per_s[RTHYB_COUPLED_MAX];      /* for a path between two points, */
    double acceleration_m_per_s2[RTHYB_COUPLED_MAX]; /* one value per axis */
    double brake_m_per_s2[RTHYB_COUPLED_MAX];        /* for braking */
    double jacobian[RTHYB_COUPLED_SQUARE];
    const rthyb_kinematics *pins;        /* NULL: the Jacobian is constant */
    int64_t least_way, turn, least_turn; /* ticks, as in rthyb_station_ticks */
} path_limits;

/* From one state to another; a state is displacement, velocity and acceleration in each coordinate. */
void path_between(const path_limits *limits, const double from[][3], const double to[][3],
                  rthyb_path *paths);
void path_to_rest(const path_limits *limits, const double from[][3], rthyb_path *paths);
/* Half-cosine ramp from a to b. */
rthyb_path path_ramp(double a, double b, int64_t ticks);
/* Minimum duration of such a ramp over the distance `way` in each coordinate. */
int64_t path_ramp_ticks(const path_limits *limits, const double *way);
int path_done(const rthyb_path *path);
/* Current displacement, velocity and acceleration of a path. */
void path_along(const rthyb_path *path, double h, double now[3]);
/* Advances by one tick and returns the displacement. */
double path_follow(rthyb_path *path, double h);

#endif
