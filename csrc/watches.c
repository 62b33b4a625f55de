/* Monitoring of limits, sensors, forces and shares of the last second, and the reactions to what it
 * finds. */
#include "station.h"

#define JUMP_TAKEN 3 /* consecutive readings at a new level that establish it, at any rate */
#define OVERLOAD 1.5 /* times the force limit: escalates to a trip at once */
#define START_SPREADS                                                                              \
    5.0 /* times rest_spread_m: largest distance of x_m from the command at START */
#define ALL_AXES (~0u)
#define SKIPS_SHARE (50.0 / 1024.0) /* of the last second, if no other limit is given */

/* ---- reactions --------------------------------------------------------------------------------- */

static void react(rthyb_station *s, finding found, int reaction)
{
    /* During ramp-in there is no test yet that could be resumed after a hold. */
    const int ends_it = (reaction == RTHYB_REACT_RAMP_OUT && is_moving(s->state)) ||
                        (reaction == RTHYB_REACT_HOLD && s->state == RTHYB_RAMP_IN);
    if (reaction == RTHYB_REACT_TRIP) {
        station_trip(s, found);
    } else if (ends_it) {
        station_ramp_out(s, found);
    } else if (reaction == RTHYB_REACT_HOLD && course_can_hold(s)) {
        station_blame(s, found);
        course_hold(s);
    } else if (reaction != RTHYB_REACT_NONE) {
        s->indicated |= (uint64_t)1 << found.cause;
    }
}

int watch_react(rthyb_station *s, finding found, int reaction, int bit)
{
    react(s, found, reaction);
    return reaction == RTHYB_REACT_TRIP ? bit | RTHYB_S_TRIP : bit;
}

static int check_by(rthyb_station *s, const rthyb_watch *watch, int cause, int where, double value,
                    int bit)
{
    if (watch->reaction == RTHYB_REACT_NONE || !(watch->value > 0.0) ||
        !(fabs(value) > watch->value))
        return RTHYB_OK;
    return watch_react(s, (finding){cause, value, watch->value, where}, watch->reaction, bit);
}

int watch_check(rthyb_station *s, int cause, double value, int bit)
{
    return check_by(s, &s->cfg.watch[cause], cause, 0, value, bit);
}

static int check_axis(rthyb_station *s, int axis, int cause, double value, int bit)
{
    return check_by(s, watch_of(s, axis, cause), cause, of_axis(axis), value, bit);
}

/* ---- before it moves --------------------------------------------------------------------------- */

/* Whether a value exceeds a limit that would interrupt a test; if so, *found describes it. */
static int ends_beyond(const rthyb_station *s, int axis, int cause, double value, finding *found)
{
    const rthyb_watch *watch = watch_of(s, axis, cause);
    if (watch->reaction < RTHYB_REACT_HOLD || !(watch->value > 0.0) ||
        !(fabs(value) > watch->value))
        return 0;
    *found = (finding){cause, value, watch->value, of_axis(axis)};
    return 1;
}

int watch_overload(const rthyb_station *s, int axis, double f_n, finding *found)
{
    return (s->tared &&
            ends_beyond(s, axis, RTHYB_CAUSE_FORCE, f_n - s->axis[axis].tare_f, found)) ||
           ends_beyond(s, axis, RTHYB_CAUSE_RIG_FORCE, f_n, found);
}

int watch_rig_trips(const rthyb_station *s, int axis, double f_n, finding *found)
{
    return watch_of(s, axis, RTHYB_CAUSE_RIG_FORCE)->reaction == RTHYB_REACT_TRIP &&
           ends_beyond(s, axis, RTHYB_CAUSE_RIG_FORCE, f_n, found);
}

/* A reading at the end of its range does not show how far beyond it the true value lies. */
static int axis_finds(const rthyb_station *s, int i, finding *found)
{
    const rthyb_axis *a = &s->axis[i];
    const double x = a->seen_x - a->tare_x;
    if (a->off_scale & AXIS_OFF_F) {
        *found = (finding){RTHYB_CAUSE_FORCE, a->reading_f_n, s->cfg.axis[i].f_range_n, of_axis(i)};
        return 1;
    }
    if (a->off_scale & AXIS_OFF_X) {
        *found =
            (finding){RTHYB_CAUSE_POSITION, a->reading_x_m, s->cfg.axis[i].x_range_m, of_axis(i)};
        return 1;
    }
    return watch_overload(s, i, a->seen_f, found) ||
           ends_beyond(s, i, RTHYB_CAUSE_TRACKING, x - s->controller.axis[i].target - a->gap,
                       found) ||
           ends_beyond(s, i, RTHYB_CAUSE_POSITION, x, found) ||
           ends_beyond(s, i, RTHYB_CAUSE_RIG_POSITION, x + a->tare_cmd, found);
}

/* Whether a pose or a force that is already present exceeds the limit of its interface. */
static int interface_beyond(const rthyb_watch *watch, int cause, int interface, double value,
                            finding *found)
{
    if (watch->reaction < RTHYB_REACT_HOLD || !(watch->value > 0.0) ||
        !(fabs(value) > watch->value))
        return 0;
    *found = (finding){cause, value, watch->value, of_interface(interface)};
    return 1;
}

int watch_interface_overload(const rthyb_station *s, const double *force, finding *found)
{
    for (int j = 0; j < interfaces_of(s); j++)
        if (interface_beyond(&s->cfg.interface[j].force, RTHYB_CAUSE_FORCE, j, force[j], found))
            return 1;
    return 0;
}

/* Pose and forces of the last readings; with one axis, the limits of the axis apply instead. */
static int interfaces_find(const rthyb_station *s, finding *found)
{
    double x[RTHYB_COUPLED_MAX], f[RTHYB_COUPLED_MAX];
    double pose[RTHYB_COUPLED_MAX], force[RTHYB_COUPLED_MAX], sensor[RTHYB_SENSORS_ALL] = {0.0};
    lone_seen(s, sensor);
    for (int i = 0; i < axes_of(s); i++) {
        x[i] = s->axis[i].seen_x - s->axis[i].tare_x;
        f[i] = s->axis[i].seen_f - s->axis[i].tare_f;
    }
    if (!rthyb_controller_meets(&s->controller, x, f, sensor, pose, force)) {
        *found = plain(RTHYB_CAUSE_NO_POSE);
        return 1;
    }
    for (int j = 0; j < interfaces_of(s); j++)
        if (interface_beyond(&s->cfg.interface[j].position, RTHYB_CAUSE_POSITION, j, pose[j],
                             found))
            return 1;
    return watch_interface_overload(s, force, found);
}

int watch_finds(const rthyb_station *s, finding *found)
{
    for (int i = 0; i < axes_of(s); i++)
        if (axis_finds(s, i, found))
            return 1;
    return lone_finds(s, AXIS_OFF_X | AXIS_OFF_F, found) || interfaces_find(s, found) ||
           differ_finds(s, found);
}

int watch_wandered(const rthyb_station *s, finding *found)
{
    for (int i = 0; i < axes_of(s); i++) {
        const rthyb_axis *a = &s->axis[i];
        const double away = a->seen_x - a->tare_x - s->controller.axis[i].x_cmd - a->gap;
        const double most = START_SPREADS * s->cfg.axis[i].rest_spread_m;
        if (!(fabs(away) > most))
            continue;
        *found = (finding){RTHYB_CAUSE_TRACKING, away, most, of_axis(i)};
        return 1;
    }
    return 0;
}

/* ---- while it moves ---------------------------------------------------------------------------- */

/* Whether a hold or a ramp-out would change nothing: at rest, held, or already ramping out. */
static int is_off_course(int state)
{
    return state != RTHYB_RAMP_IN && state != RTHYB_RUNNING;
}

/* A force beyond its limit. If the force stays or grows although the test is held or ramps out,
 * only a trip remains. A force at the end of the sensor's range may be of any magnitude. */
static int check_force(rthyb_station *s, const rthyb_watch *watch, finding found, int off_scale,
                       rthyb_overload *over)
{
    if (watch->reaction == RTHYB_REACT_NONE || !(watch->value > 0.0))
        return RTHYB_OK;
    const int is_beyond = off_scale || fabs(found.value) > watch->value;
    const uint64_t gone = s->tick - over->seen;
    over->seen = s->tick;
    axis_count_overload(over, gone < s->ticks.lost ? gone : s->ticks.lost, is_beyond,
                        is_off_course(s->state), s->ticks.overload);
    if (!is_beyond)
        return RTHYB_OK;
    const int too_much = off_scale || fabs(found.value) > OVERLOAD * watch->value ||
                         over->ticks >= s->ticks.overload;
    const int escalates =
        watch->reaction >= RTHYB_REACT_HOLD && is_off_course(s->state) && too_much;
    return watch_react(s, found, escalates ? RTHYB_REACT_TRIP : watch->reaction,
                       RTHYB_S_FORCE_LIMIT);
}

static int check_axis_force(rthyb_station *s, int i, int cause, double value, rthyb_overload *over)
{
    const rthyb_watch *watch = watch_of(s, i, cause);
    const rthyb_axis *a = &s->axis[i];
    const int off_scale = a->off_scale & AXIS_OFF_F;
    const finding found =
        off_scale ? (finding){cause, a->reading_f_n, s->cfg.axis[i].f_range_n, of_axis(i)}
                  : (finding){cause, value, watch->value, of_axis(i)};
    return check_force(s, watch, found, off_scale, over);
}

static int check_forces(rthyb_station *s, const rthyb_record *r, uint32_t axes)
{
    int code = RTHYB_OK;
    for (int i = 0; i < axes_of(s); i++) {
        rthyb_axis *a = &s->axis[i];
        if (!(axes >> i & 1u))
            continue;
        /* The reading counts even if its pair was rejected: the force on the specimen need not be
         * smooth. */
        const double f = a->has_reading ? a->reading_f_n - a->tare_f : r->axis[i].f_meas_n;
        if (s->tared)
            code |= check_axis_force(s, i, RTHYB_CAUSE_FORCE, f, &a->over_f);
        code |= check_axis_force(s, i, RTHYB_CAUSE_RIG_FORCE, f + a->tare_f, &a->over_rig_f);
    }
    return code;
}

/* The same for each interface, whose force is computed from all axes: it is known only if every
 * axis has a reading, and counts as saturated if one of them is at the end of its range. If that is
 * a load cell without an actuator, the cause names it. */
static int check_interface_forces(rthyb_station *s)
{
    int code = RTHYB_OK;
    const int off_scale = watch_off_scale(s) & AXIS_OFF_F;
    for (int j = 0; j < interfaces_of(s); j++) {
        const rthyb_watch *watch = &s->cfg.interface[j].force;
        finding found = {RTHYB_CAUSE_FORCE, s->controller.interface[j].f, watch->value,
                         of_interface(j)};
        (void)lone_finds(s, AXIS_OFF_F, &found);
        code |= check_force(s, watch, found, off_scale, &s->over_interface[j]);
    }
    return code;
}

int watch_off_scale(const rthyb_station *s)
{
    int bits = 0;
    for (int i = 0; i < axes_of(s); i++)
        bits |= s->axis[i].off_scale;
    return bits | lone_off_scale(s);
}

/* A displacement at the end of its sensor's range is treated like one beyond the position limit. */
static int check_off_scale(rthyb_station *s, uint32_t axes)
{
    int code = RTHYB_OK;
    const int causes[] = {RTHYB_CAUSE_RIG_POSITION, RTHYB_CAUSE_POSITION};
    for (int i = 0; i < axes_of(s); i++) {
        const rthyb_axis *a = &s->axis[i];
        for (int j = 0; j < 2 && axes >> i & 1u && a->off_scale & AXIS_OFF_X; j++) {
            const rthyb_watch *watch = watch_of(s, i, causes[j]);
            const finding found = {causes[j], a->reading_x_m, s->cfg.axis[i].x_range_m, of_axis(i)};
            if (watch->reaction != RTHYB_REACT_NONE && watch->value > 0.0)
                code |= watch_react(s, found, watch->reaction, RTHYB_S_POSITION_LIMIT);
        }
    }
    return code;
}

/* Measured position of an axis. If another axis has no pair, the values of all axes are predicted,
 * but the reading of this axis is used here. */
static double measured_x(const rthyb_station *s, const rthyb_record *r, int axis)
{
    const rthyb_axis *a = &s->axis[axis];
    return s->controller.axis[axis].missing ? r->axis[axis].x_meas_m : a->reading_x_m - a->tare_x;
}

/* Deviation of each axis from its command for this tick. */
static int check_tracking(rthyb_station *s, const rthyb_record *r, int at_rest, uint32_t axes)
{
    int code = RTHYB_OK;
    for (int i = 0; i < axes_of(s); i++) {
        const double gap = at_rest ? s->axis[i].gap : 0.0;
        if (axes >> i & 1u)
            code |= check_axis(s, i, RTHYB_CAUSE_TRACKING,
                               measured_x(s, r, i) - s->controller.axis[i].target1 - gap,
                               RTHYB_S_TRACKING_LIMIT);
    }
    return code;
}

static uint32_t all_axes(const rthyb_station *s)
{
    return (1u << axes_of(s)) - 1u;
}

/* Bit i: the drive of axis i follows, and its sensors give readings. Missing readings of another
 * axis are no reason to ignore these. */
static uint32_t axes_to_watch(const rthyb_station *s)
{
    uint32_t axes = 0;
    for (int i = 0; i < axes_of(s); i++) {
        const int has_reading = !s->controller.axis[i].missing || s->axis[i].off_scale;
        axes |= has_reading && !s->axis[i].stands ? 1u << i : 0u;
    }
    return axes;
}

/* Commands are sent, and nothing should move: checks the forces, and whether each drive stays at
 * its command. Before zeroing, there is no zero from which to measure a deviation. */
void watch_at_rest(rthyb_station *s, rthyb_record *r)
{
    const uint32_t axes = axes_to_watch(s);
    if (!s->seen || !axes)
        return;
    int code = r->code | check_forces(s, r, axes) | check_off_scale(s, axes);
    if (s->tared && axes == all_axes(s))
        code |= differ_check(s) | check_interface_forces(s);
    if (s->tared)
        code |= check_tracking(s, r, 1, axes);
    r->code = (uint16_t)code;
}

static int check_commands(rthyb_station *s)
{
    const double h = s->cfg.controller.period_s;
    int code = RTHYB_OK;
    for (int i = 0; i < axes_of(s); i++) {
        const rthyb_controller_axis *a = &s->controller.axis[i];
        code |= check_axis(s, i, RTHYB_CAUSE_POSITION, a->x_plc, RTHYB_S_POSITION_LIMIT);
        code |= check_axis(s, i, RTHYB_CAUSE_RIG_POSITION, a->x_plc + s->axis[i].tare_cmd,
                           RTHYB_S_POSITION_LIMIT);
    }
    for (int j = 0; j < interfaces_of(s); j++)
        code |= check_by(s, &s->cfg.interface[j].position, RTHYB_CAUSE_POSITION, of_interface(j),
                         s->controller.interface[j].x_num, RTHYB_S_POSITION_LIMIT);
    code |= check_off_scale(s, ALL_AXES);
    for (int i = 0; i < axes_of(s); i++) {
        const rthyb_controller_axis *a = &s->controller.axis[i];
        code |= check_axis(s, i, RTHYB_CAUSE_VELOCITY, (a->x_plc - a->x_plc1) / h,
                           RTHYB_S_VELOCITY_LIMIT);
        code |=
            check_axis(s, i, RTHYB_CAUSE_INCREMENT, a->x_cmd - a->x_cmd1, RTHYB_S_INCREMENT_LIMIT);
    }
    return code;
}

/* Whether most of the pairs that the last second lacks are missing because one reading was at the
 * end of its range; *found describes the one that was so most often. */
static int ends_made_losses(const rthyb_station *s, finding *found)
{
    const int n = axes_of(s), count = 2 * n + lones_of(s);
    uint32_t most = s->losses.count / 2;
    int worst = -1;
    for (int k = 0; k < count; k++) {
        const uint32_t own = s->ends[k].ticks.count;
        if (own <= most)
            continue;
        most = own;
        worst = k;
    }
    if (worst < 0)
        return 0;
    const int lone = worst - 2 * n, axis = worst / 2;
    const int of_x = lone < 0 ? worst % 2 == 0 : lone_is_displacement(s, lone);
    const rthyb_axis_config *own = &s->cfg.axis[axis < n ? axis : 0];
    const double of_axis_range = of_x ? own->x_range_m : own->f_range_n;
    *found = (finding){
        .cause = of_x ? RTHYB_CAUSE_SENSOR_RANGE : RTHYB_CAUSE_FORCE_RANGE,
        .value = s->ends[worst].reading,
        .limit = lone < 0 ? of_axis_range : s->cfg.lone[lone].range,
        .where = lone < 0 ? of_axis(axis) : of_sensor(lone),
    };
    return 1;
}

/* The share of lost pairs. Its cause is a sensor rather than the link if that is what made them. */
static int check_losses(rthyb_station *s)
{
    const rthyb_watch *watch = &s->cfg.watch[RTHYB_CAUSE_LOST_PAIRS];
    const double share = share_of(s, &s->losses);
    finding found = {RTHYB_CAUSE_LOST_PAIRS, share, watch->value, 0};
    if (watch->reaction == RTHYB_REACT_NONE || !(watch->value > 0.0) || !(share > watch->value))
        return RTHYB_OK;
    (void)ends_made_losses(s, &found);
    return watch_react(s, found, watch->reaction, RTHYB_S_LOST_RATE);
}

void watch_moving(rthyb_station *s, rthyb_record *r, double indicator_before)
{
    const double h = s->cfg.controller.period_s;
    const double slope = (r->tracking_indicator_m2 - indicator_before) / h;
    s->indicator_slope += (slope - s->indicator_slope) * fmin(h / 0.25, 1.0);
    int code = r->code | differ_check(s);
    code |= check_commands(s);
    code |= check_forces(s, r, ALL_AXES);
    code |= check_interface_forces(s);
    code |= check_tracking(s, r, 0, ALL_AXES);
    code |= watch_check(s, RTHYB_CAUSE_INDICATOR, s->indicator_slope, RTHYB_S_INDICATOR_LIMIT);
    code |= watch_check(s, RTHYB_CAUSE_ENERGY, r->energy_error_j, RTHYB_S_ENERGY_LIMIT);
    code |= watch_check(s, RTHYB_CAUSE_LOST_WARNING, share_of(s, &s->losses), RTHYB_S_LOST_RATE);
    code |= check_losses(s);
    r->code = (uint16_t)code;
}

/* ---- sensors ----------------------------------------------------------------------------------- */

/* A sensor that repeats its reading although the command has moved on. */
static void check_stuck(rthyb_station *s, int i, int cause, rthyb_stillness *still, double reading)
{
    const rthyb_watch *watch = watch_of(s, i, cause);
    if (axis_is_stuck(still, reading, s->controller.axis[i].x_cmd, is_moving(s->state),
                      watch->value, s->cfg.axis[i].rest_spread_m))
        s->noted |= watch_react(s, (finding){cause, (double)still->ticks, watch->value, of_axis(i)},
                                watch->reaction, RTHYB_S_SENSOR_STUCK);
}

void watch_stuck(rthyb_station *s, int axis, double x_m, double f_n)
{
    check_stuck(s, axis, RTHYB_CAUSE_SENSOR_STUCK, &s->axis[axis].still_x, x_m);
    check_stuck(s, axis, RTHYB_CAUSE_FORCE_STUCK, &s->axis[axis].still_f, f_n);
}

/* During ticks without a pair, the specimen may have moved by as much in each as in one. A new level
 * is accepted if it persists, unless a jump ends the test. */
int watch_is_steady(rthyb_station *s, const rthyb_watch *watch, finding at, rthyb_leaps *leaps,
                    double seen, double reading)
{
    const double most = watch->value * ((double)s->controller.missing + 1.0);
    const double leap = reading - seen;
    int good = 1;
    if (s->seen && watch->value > 0.0 && fabs(leap) > most) {
        s->noted |= watch_react(s, (finding){at.cause, leap, most, at.where}, watch->reaction,
                                RTHYB_S_SENSOR_JUMP);
        const int ends_test = watch->reaction >= RTHYB_REACT_RAMP_OUT && s->state != RTHYB_IDLE &&
                              s->state != RTHYB_TRIPPED;
        good = axis_count_leaps(leaps, reading, watch->value) >= JUMP_TAKEN && !ends_test;
    }
    if (good)
        leaps->count = 0;
    return good;
}

static int is_steady(rthyb_station *s, int i, int cause, rthyb_leaps *leaps, double seen,
                     double reading)
{
    const finding at = {.cause = cause, .where = of_axis(i)};
    return watch_is_steady(s, watch_of(s, i, cause), at, leaps, seen, reading);
}

uint32_t watch_leaps(rthyb_station *s, const rthyb_station_input *in)
{
    uint32_t leapt = 0;
    for (int i = 0; i < axes_of(s); i++) {
        rthyb_axis *a = &s->axis[i];
        finding found;
        const double x = in->axis[i].x_m, f = in->axis[i].f_n;
        int good = is_steady(s, i, RTHYB_CAUSE_SENSOR_JUMP, &a->leaps_x, a->seen_x, x);
        /* A force beyond its limit is reported as such, even if it jumped there. */
        if (!watch_overload(s, i, f, &found))
            good &= is_steady(s, i, RTHYB_CAUSE_FORCE_JUMP, &a->leaps_f, a->seen_f, f);
        leapt |= good ? 0u : 1u << i;
    }
    return leapt;
}

/* ---- the clock --------------------------------------------------------------------------------- */

void watch_skips(rthyb_station *s, uint32_t skipped)
{
    const double share = share_of(s, &s->skips), most = SKIPS_SHARE;
    if (skipped >= s->ticks.lost) {
        station_trip(s, (finding){RTHYB_CAUSE_STALLED, skipped, s->ticks.lost, 0});
    } else if (skipped > s->ticks.skips) {
        station_ramp_out(s, (finding){RTHYB_CAUSE_SKIPS, skipped, s->ticks.skips, 0});
    } else if (is_on_its_way(s->state)) {
        s->noted |= watch_check(s, RTHYB_CAUSE_SKIP_WARNING, share, RTHYB_S_SKIP_RATE);
        if (s->cfg.watch[RTHYB_CAUSE_SKIPS].value > 0.0)
            s->noted |= watch_check(s, RTHYB_CAUSE_SKIPS, share, RTHYB_S_SKIP_RATE);
        else if (share > most)
            station_ramp_out(s, (finding){RTHYB_CAUSE_SKIPS, share, most, 0});
    }
}
