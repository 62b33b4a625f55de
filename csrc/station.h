/* Declarations shared by the files of the station: states (station.c), paths (course.c), and monitoring
 * (watches.c). */
#ifndef RTHYB_STATION_H
#define RTHYB_STATION_H

#include "axis.h"
#include "internal.h"
#include "numeric.h"
#include "path.h"

#define ARRIVED_M 1e-6 /* largest distance of the command from the end of a completed path */

static inline finding plain(int cause)
{
    return (finding){.cause = cause};
}

/* finding.where for an axis. */
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

/* From START until the specimen is at rest again. */
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
/* Sets the cause, unless one is already latched. */
void station_blame(rthyb_station *s, finding found);

/* ---- course.c ---- */

/* Enters the state, abandons the current motion, and brakes to rest as quickly as the limits allow. */
void course_brake_in(rthyb_station *s, int state, int leg);
/* Whether HOLD is possible: the test is running, or resuming. */
int course_can_hold(const rthyb_station *s);
void course_hold(rthyb_station *s);
void course_resume(rthyb_station *s);
void course_ramp_to_zero(rthyb_station *s);
/* Limits of the axes along paths, and whether they are tighter than before. */
void course_caps(const rthyb_station *s, path_caps *caps);
int course_narrows(const rthyb_station *s, const path_caps *before);
/* Call after the limits of the current path were tightened: brakes to rest within them; course_arrive then starts a new
 * path for the rest of the distance. */
void course_replan(rthyb_station *s);
/* Next displacements if a path determines them; NULL if the equation of motion does. */
const double *course_next(rthyb_station *s, double *x);
/* Continues after the end of a path. */
void course_arrive(rthyb_station *s);
/* Bounds the commands of the axes, as a last resort. */
void course_confine(rthyb_station *s);
/* Bounds for the rounding of an axis' command on the wire, with tare. */
void course_bounds(const rthyb_station *s, int axis, rthyb_axis_output *out);

/* ---- watches.c ---- */

/* Carries out a reaction; returns the status bits for the record: `bit`, and the trip if there is one. */
int watch_react(rthyb_station *s, finding found, int reaction, int bit);
/* Checks a value that concerns no single axis against its limit, and reacts if it exceeds it. */
int watch_check(rthyb_station *s, int cause, double value, int bit);
/* Whether a limit that would end the test is already exceeded before its start. */
int watch_finds(const rthyb_station *s, finding *found);
/* Whether a drive does not hold the specimen at its command. */
int watch_wandered(const rthyb_station *s, finding *found);
/* Whether a force would end the test. f_n: before tare. */
int watch_overload(const rthyb_station *s, int axis, double f_n, finding *found);
/* The same for the forces in interface coordinates. */
int watch_interface_overload(const rthyb_station *s, const double *force, finding *found);
/* Whether a force would immediately cause another trip. */
int watch_rig_trips(const rthyb_station *s, int axis, double f_n, finding *found);
int watch_off_scale(const rthyb_station *s);
void watch_at_rest(rthyb_station *s, rthyb_record *r);
/* Checks the limits that apply during motion. */
void watch_moving(rthyb_station *s, rthyb_record *r, double indicator_before);
/* Bit i: a reading of axis i has jumped, and its pair is rejected. */
uint32_t watch_leaps(rthyb_station *s, const rthyb_station_input *in);
/* Checks for sensors that repeat their reading. */
void watch_stuck(rthyb_station *s, int axis, double x_m, double f_n);
/* Checks the number of consecutive skipped ticks, and their share of the last second. */
void watch_skips(rthyb_station *s, uint32_t skipped);

static inline double share_of(const rthyb_station *s, const rthyb_recent *recent)
{
    return (double)recent->count / s->ticks.recent;
}

#endif
