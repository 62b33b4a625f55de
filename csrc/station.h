/* What the files of the station share: states (station.c), where the commands go (course.c), and what is not as
 * it should be (watches.c). */
#ifndef RTHYB_STATION_H
#define RTHYB_STATION_H

#include "axis.h"
#include "internal.h"
#include "numeric.h"
#include "path.h"

#define ARRIVED_M 1e-6 /* what the command may lag behind at the end of a path */

static inline finding plain(int cause)
{
    return (finding){.cause = cause};
}

/* A cause of an axis, as a finding says where it belongs. */
static inline int of_axis(int axis)
{
    return axis + 1;
}

static inline int of_interface(int interface)
{
    return -1 - interface;
}

static inline int axes_of(const rthyb_station *s)
{
    return s->cfg.controller.axis_count;
}

static inline int interfaces_of(const rthyb_station *s)
{
    return s->cfg.controller.interface_count;
}

static inline const rthyb_watch *watch_of(const rthyb_station *s, int axis, int cause)
{
    const rthyb_axis_config *own = &s->cfg.axis[axis];
    return own->own_watches ? &own->watch[cause] : &s->cfg.watch[cause];
}

static inline int is_moving(int state)
{
    return state == RTHYB_RAMP_IN || state == RTHYB_RUNNING || state == RTHYB_HOLD;
}

/* From START until it is at rest again. */
static inline int is_on_its_way(int state)
{
    return is_moving(state) || state == RTHYB_RAMP_OUT;
}

typedef struct {
    double velocity[RTHYB_COUPLED_MAX], acceleration[RTHYB_COUPLED_MAX], brake[RTHYB_COUPLED_MAX];
} path_caps;

/* ---- station.c ---- */

void station_enter(rthyb_station *s, int state);
void station_trip(rthyb_station *s, finding found);
void station_ramp_out(rthyb_station *s, finding found);
/* The first cause stays. */
void station_blame(rthyb_station *s, finding found);

/* ---- course.c ---- */

/* Leaves whatever course it is on for the state, and stands as soon as it can. */
void course_brake_in(rthyb_station *s, int state, int leg);
/* On a way that a HOLD may leave: the test's own, or the one back to it. */
int course_can_hold(const rthyb_station *s);
void course_hold(rthyb_station *s);
void course_resume(rthyb_station *s);
void course_ramp_to_zero(rthyb_station *s);
/* What axes may move by along paths, and whether that is less than before. */
void course_caps(const rthyb_station *s, path_caps *caps);
int course_narrows(const rthyb_station *s, const path_caps *before);
/* The limits of the path that runs were drawn in: brakes to rest within them; `arrive` begins the rest of
 * the way anew. */
void course_begin_anew(rthyb_station *s);
/* The next displacements where they come from a path; NULL while the equation of motion gives them. */
const double *course_next(rthyb_station *s, double *x);
/* What comes after the end of a path. */
void course_arrive(rthyb_station *s);
/* Where the command of an axis ends in spite of everything. */
void course_confine(rthyb_station *s);
/* How far out the wire may round the command of an axis, with tare. */
void course_bounds(const rthyb_station *s, int axis, rthyb_axis_output *out);

/* ---- watches.c ---- */

/* Does what is to be done; returns what the record says of that: `bit`, and the trip. */
int watch_react(rthyb_station *s, finding found, int reaction, int bit);
/* Reacts to a limit that is exceeded of what belongs to no axis. */
int watch_check(rthyb_station *s, int cause, double value, int bit);
/* What a test would be taken off its course for before it has begun. */
int watch_finds(const rthyb_station *s, finding *found);
/* A drive does not hold the specimen where it was told to. */
int watch_wandered(const rthyb_station *s, finding *found);
/* Whether a force would end the test. f_n: before tare. */
int watch_overload(const rthyb_station *s, int axis, double f_n, finding *found);
/* The same of the forces along the interfaces. */
int watch_interface_overload(const rthyb_station *s, const double *force, finding *found);
/* A force that would trip it again at once. */
int watch_rig_trips(const rthyb_station *s, int axis, double f_n, finding *found);
int watch_off_scale(const rthyb_station *s);
void watch_at_rest(rthyb_station *s, rthyb_record *r);
/* The limits that are watched while something moves. */
void watch_moving(rthyb_station *s, rthyb_record *r, double indicator_before);
/* Bit i: axis i has leapt, and its pair is not taken. */
uint32_t watch_leaps(rthyb_station *s, const rthyb_station_input *in);
/* Sensors that repeat themselves. */
void watch_stuck(rthyb_station *s, int axis, double x_m, double f_n);
/* A row of skipped ticks, and their share of the last second. */
void watch_skips(rthyb_station *s, uint32_t skipped);

static inline double share_of(const rthyb_station *s, const rthyb_recent *recent)
{
    return (double)recent->count / s->ticks.recent;
}

#endif
