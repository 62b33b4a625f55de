/* Checks of one axis of a rig: an actuator with its displacement sensor and load cell. All readings are before
 * tare. */
#ifndef RTHYB_AXIS_H
#define RTHYB_AXIS_H

#include "rthyb.h"

/* Bits of rthyb_axis.off_scale. */
enum axis_off { AXIS_OFF_X = 1, AXIS_OFF_F = 2 };

/* From here on, finding.where is a sensor without an actuator. */
#define SENSOR_PLACE 64

/* A cause with the value found and its limit, both 0 if the cause has no value. where: 0: no axis; 1 + i: axis i;
 * -1 - j: interface j; from SENSOR_PLACE on: a sensor without an actuator. */
typedef struct {
    int cause;
    double value, limit;
    int where;
} finding;

/* 0 or RTHYB_E_LIMIT. */
int axis_check(const rthyb_axis_config *cfg);
/* Whether the readings are plausible. */
int axis_is_sensible(const rthyb_axis_input *in);
/* Bits of enum axis_off for readings at or beyond the end of a sensor's range. */
int axis_off_scale(const rthyb_axis_config *cfg, const rthyb_axis_input *in);

void axis_begin_tare(rthyb_axis *axis);
/* Adds a reading; 0 if the readings are not at rest. */
int axis_add_to_tare(rthyb_axis *axis, const rthyb_axis_config *cfg, const rthyb_axis_input *in);
/* Counts a reading of a tare; 1 once there were `most` equal ones in a row. most = 0: no limit. */
int axis_repeats(rthyb_repeats *seen, double reading, int32_t most);
/* The same for both readings of an axis; *found has the one that is frozen, without its place. */
int axis_is_frozen(rthyb_axis *axis, const rthyb_axis_config *cfg, const rthyb_axis_input *in,
                   finding *found);
/* Whether a tare would exceed its limit, because the specimen is deformed or a sensor is misadjusted. */
int axis_is_far_off(const rthyb_axis_config *cfg, double x_m, double f_n, finding *found);
/* x_cmd_m: the drive's command, before the new tare; used only if `known`. Returns the command after tare. */
double axis_take_tare(rthyb_axis *axis, double x_m, double f_n, double x_cmd_m, int known);

/* Whether a sensor has repeated its reading for `most` ticks while the command changed by more than the spread at
 * rest. most = 0: not monitored. */
int axis_is_stuck(rthyb_stillness *still, double reading, double x_cmd_m, int moves, double most,
                  double spread_m);
/* Number of consecutive readings near another level, including this one. */
int axis_count_leaps(rthyb_leaps *leaps, double level, double most);
/* Counts readings at rest; starts again if readings were missing, because the specimen may have moved. */
void axis_watch_rest(rthyb_axis *axis, double x_m, double spread_m, int ceased, uint32_t most);
/* Counts ticks with a force beyond its limit; `gone`: ticks since the last call. The count continues if the force
 * falls below its limit only briefly, because of noise. */
void axis_count_overload(rthyb_overload *over, uint64_t gone, int is_beyond, int counts,
                         uint64_t most);

#endif
