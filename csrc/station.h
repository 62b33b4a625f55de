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

static inline int of_sensor(int sensor)
{
    return SENSOR_PLACE + sensor;
}

/* Number of sensors without an actuator. */
static inline int lones_of(const rthyb_station *s)
{
    return rthyb_kinematics_sensors(&s->cfg.controller.kinematics);
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

/* ---- lone.c: sensors without an actuator ---- */

/* 0 or RTHYB_E_LIMIT. */
int lone_check(const rthyb_station_config *cfg);
/* Whether each has a plausible value that is not at the end of its range; if not, *found says which one. */
int lone_is_sound(const rthyb_station *s, const rthyb_station_input *in, finding *found);
/* Stores the readings of this tick; 1 if all are plausible. */
int lone_look(rthyb_station *s, const rthyb_station_input *in);
int lone_is_displacement(const rthyb_station *s, int k);
/* Bits of enum axis_off, for any of them. */
int lone_off_scale(const rthyb_station *s);
/* Bit k: the reading of sensor k has jumped and is rejected. */
uint32_t lone_leaps(rthyb_station *s);
/* Readings of this tick, as passed to the controller. */
void lone_take(const rthyb_station *s, uint32_t leapt, rthyb_input *pairs);
/* After a tick in which all axes and sensors had a reading: keeps it, and checks whether it only repeats. */
void lone_note(rthyb_station *s);
void lone_begin_tare(rthyb_station *s);
/* Adds the readings of this tick; 0 if one is not at rest: *found has the sensor, and by how much its readings vary. */
int lone_add_to_tare(rthyb_station *s, finding *found);
/* Counts the readings of this tick; whether one is frozen. */
int lone_is_frozen(rthyb_station *s, finding *found);
/* Whether a tare would exceed its limit, because the specimen is deformed or loaded, or a sensor is misadjusted. */
int lone_is_far_off(const rthyb_station *s, finding *found);
void lone_take_tare(rthyb_station *s);
/* Last readings, after tare. */
void lone_seen(const rthyb_station *s, double *values);
/* Whether one is at the end of its range; which: bits of enum axis_off. */
int lone_finds(const rthyb_station *s, int which, finding *found);
/* Whether a sensor has been without a reading for longer than every axis. */
int lone_not_taken(const rthyb_station *s, uint32_t axis_missing, finding *found);
/* Whether one has had no usable reading for so long that a test would trip. */
int lone_withholds(const rthyb_station *s, finding *found);
/* finding.where of the first value that is not finite; 0: none. */
int lone_not_finite(const rthyb_station *s, const rthyb_input *in);
void lone_note_channels(rthyb_station *s);
/* Bits of a row's cause. */
uint32_t lone_silent_bits(const rthyb_station *s);

/* ---- disagreement.c ---- */

/* After a tare: all readings agree. */
void differ_begin(rthyb_station *s);
/* After a sample in which every axis and every sensor has a reading: how far each is from what the others imply, and
 * whether it is beyond its limit. Status bits for the record. */
int differ_check(rthyb_station *s);
int differ_allowance_ok(const rthyb_allowance *allowance);
/* Whether one is, with a reaction that would interrupt a test. */
int differ_finds(const rthyb_station *s, finding *found);

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
/* 1 unless a sensor has jumped; `at` has cause and place. seen: its reading before. */
int watch_is_steady(rthyb_station *s, const rthyb_watch *watch, finding at, rthyb_leaps *leaps,
                    double seen, double reading);
/* Checks for sensors that repeat their reading. */
void watch_stuck(rthyb_station *s, int axis, double x_m, double f_n);
/* Checks the number of consecutive skipped ticks, and their share of the last second. */
void watch_skips(rthyb_station *s, uint32_t skipped);

static inline double share_of(const rthyb_station *s, const rthyb_recent *recent)
{
    return (double)recent->count / s->ticks.recent;
}

#endif
