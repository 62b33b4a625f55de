/* One axis of a rig, as the station judges it: an actuator with its displacement sensor and its load cell.
 * All readings are those before tare. */
#ifndef RTHYB_AXIS_H
#define RTHYB_AXIS_H

#include "rthyb.h"

/* Bits of rthyb_axis.off_scale. */
enum axis_off { AXIS_OFF_X = 1, AXIS_OFF_F = 2 };

/* A cause with what was met and what is allowed; both 0 where it has no number. where: 0 where it belongs to no
 * axis, 1 + i to axis i, -1 - j to interface j. */
typedef struct {
    int cause;
    double value, limit;
    int where;
} finding;

/* 0 or RTHYB_E_LIMIT. */
int axis_check(const rthyb_axis_config *cfg);
/* Numbers that a reading can be. */
int axis_is_sensible(const rthyb_axis_input *in);
/* At the end of a sensor's range or beyond: it cannot say more. */
int axis_off_scale(const rthyb_axis_config *cfg, const rthyb_axis_input *in);

void axis_begin_tare(rthyb_axis *axis);
/* One reading more; 0 if they move. */
int axis_add_to_tare(rthyb_axis *axis, const rthyb_axis_config *cfg, const rthyb_axis_input *in);
/* A specimen that is bent, or a sensor that is off, by more than zero may be. */
int axis_is_far_off(const rthyb_axis_config *cfg, double x_m, double f_n, finding *found);
/* x_cmd_m, before the new tare, is where the drive was told to be; it counts if `known`. Returns the command
 * after tare. */
double axis_take_tare(rthyb_axis *axis, double x_m, double f_n, double x_cmd_m, int known);

/* Whether a sensor has repeated itself for `most` ticks while the command has moved on by more than the
 * spread at rest. 0 for most: it is not watched. */
int axis_is_stuck(rthyb_stillness *still, double reading, double x_cmd_m, int moves, double most,
                  double spread_m);
/* Readings about another level, in a row, with this one. */
int axis_count_leaps(rthyb_leaps *leaps, double level, double most);
/* What stood still before the readings ceased need not stand still now. */
void axis_watch_rest(rthyb_axis *axis, double x_m, double spread_m, int ceased, uint32_t most);
/* Ticks of a force beyond its limit; `gone` ones since the last tick. What falls below it for a while only,
 * by its noise, begins no new count. */
void axis_count_overload(rthyb_overload *over, uint64_t gone, int is_beyond, int counts,
                         uint64_t most);

#endif
