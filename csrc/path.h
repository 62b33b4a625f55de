/* Ways of limited velocity and acceleration between two states of motion. */
#ifndef RTHYB_PATH_H
#define RTHYB_PATH_H

#include "rthyb.h"

/* A way has a path in each direction of the interfaces, and one duration for all: they set off together and
 * arrive together. Its limits are those of the axes, of which the Jacobian, rows of `directions`, says how they
 * move with it: the one that is slowest decides. Pins have another Jacobian at every pose: with them a way is found
 * by the one that is given, and made longer until every axis keeps to its limits all along it. */
typedef struct {
    double period_s;
    int axes, directions;
    double velocity_m_per_s[RTHYB_COUPLED_MAX];      /* of a way between two points, */
    double acceleration_m_per_s2[RTHYB_COUPLED_MAX]; /* one each an axis */
    double brake_m_per_s2[RTHYB_COUPLED_MAX];        /* that it is stopped with */
    double jacobian[RTHYB_COUPLED_SQUARE];
    const rthyb_kinematics *pins;        /* NULL: the Jacobian holds at every pose */
    int64_t least_way, turn, least_turn; /* ticks, as in rthyb_station_ticks */
} path_limits;

/* From one state of displacement, velocity and acceleration in each direction to another. */
void path_between(const path_limits *limits, const double from[][3], const double to[][3],
                  rthyb_path *paths);
void path_to_rest(const path_limits *limits, const double from[][3], rthyb_path *paths);
/* Half a wave of a raised cosine from a to b. */
rthyb_path path_ramp(double a, double b, int64_t ticks);
/* The fewest ticks that such a ramp may take, `way` in each direction. */
int64_t path_ramp_ticks(const path_limits *limits, const double *way);
int path_done(const rthyb_path *path);
/* Displacement, velocity and acceleration where a path is now. */
void path_along(const rthyb_path *path, double h, double now[3]);
/* The displacement of the next tick. */
double path_follow(rthyb_path *path, double h);

#endif
