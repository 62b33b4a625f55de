/* Ways of limited velocity and acceleration between two states of motion. */
#ifndef RTHYB_PATH_H
#define RTHYB_PATH_H

#include "rthyb.h"

typedef struct {
    double period_s;
    double velocity_m_per_s, acceleration_m_per_s2; /* of a way between two points */
    double brake_m_per_s2;                          /* that it is stopped with */
    int64_t least_way, turn, least_turn;            /* ticks, as in rthyb_station_ticks */
} path_limits;

/* Displacement, velocity and acceleration, from one such state to another. */
rthyb_path path_between(const path_limits *limits, const double from[3], const double to[3]);
rthyb_path path_to_rest(const path_limits *limits, const double from[3]);
/* Half a wave of a raised cosine from a to b. */
rthyb_path path_ramp(double a, double b, int64_t ticks);
/* The fewest ticks that such a ramp may take. */
int64_t path_ramp_ticks(const path_limits *limits, double way);
int path_done(const rthyb_path *path);
/* Displacement, velocity and acceleration where a path is now. */
void path_along(const rthyb_path *path, double h, double now[3]);
/* The displacement of the next tick. */
double path_follow(rthyb_path *path, double h);

#endif
