/* States, limits and faults: which transitions are allowed, and how the station reacts to a fault.
 *
 *   IDLE -> ZEROED -> ARMED -> RAMP_IN -> RUNNING (<-> HOLD) -> RAMP_OUT -> IDLE
 *   any state -> TRIPPED: three more commands with the last position, then none until RESET.
 *
 * The station determines the next displacement: from the equation of motion while RUNNING, from a
 * path of limited velocity and acceleration otherwise. The first cause that interrupts a test is
 * latched. Everything is a function of state and input; clock and wire are handled elsewhere. */
#include <string.h>

#include "station.h"

#define TRIP_FRAMES 3
#define RESET_FRAMES 3 /* losing one does not matter */

enum { MOST = RTHYB_COUPLED_MAX };

int rthyb_command_allowed(int32_t state, int32_t command)
{
    switch (command) {
    case RTHYB_CMD_ZERO:
        return state == RTHYB_IDLE || state == RTHYB_ZEROED;
    case RTHYB_CMD_ARM:
        return state == RTHYB_ZEROED;
    case RTHYB_CMD_START:
        return state == RTHYB_ARMED;
    case RTHYB_CMD_HOLD:
        return state == RTHYB_RUNNING || state == RTHYB_HOLD;
    case RTHYB_CMD_RESUME:
        return state == RTHYB_HOLD;
    case RTHYB_CMD_STOP:
        return state != RTHYB_TRIPPED;
    case RTHYB_CMD_RESET:
        return state == RTHYB_TRIPPED || state == RTHYB_IDLE;
    case RTHYB_CMD_TRIP:
        return 1;
    default:
        return 0;
    }
}

static int channels_ok(uint32_t first, uint32_t count)
{
    return first <= RTHYB_CHANNELS_MAX && count <= RTHYB_CHANNELS_MAX - first;
}

static int config_error(const rthyb_station_config *c)
{
    if (rthyb_watches_check(c->watch, RTHYB_CAUSE_COUNT) ||
        rthyb_path_limits_check(c->path_velocity_m_per_s, c->path_acceleration_m_per_s2,
                                c->brake_acceleration_m_per_s2))
        return RTHYB_E_LIMIT;
    for (int i = 0; i < MOST && i < c->controller.axis_count; i++)
        if (axis_check(&c->axis[i]) || !differ_allowance_ok(&c->axis[i].x_allowance) ||
            !differ_allowance_ok(&c->axis[i].f_allowance) ||
            rthyb_watches_check(c->axis[i].watch, RTHYB_CAUSE_COUNT))
            return RTHYB_E_LIMIT;
    for (int j = 0; j < MOST && j < c->controller.interface_count; j++)
        if (rthyb_watches_check(&c->interface[j].position, 1) ||
            rthyb_watches_check(&c->interface[j].force, 1))
            return RTHYB_E_LIMIT;
    if (!channels_ok(c->law_channel, c->law_channel_count) ||
        !channels_ok(c->part_channel, c->part_channel_count) ||
        !channels_ok(c->axis_channel, c->axis_channel_count) ||
        !channels_ok(c->lone_channel, c->lone_channel_count) || lone_check(c))
        return RTHYB_E_LIMIT;
    const int ticks_ok = c->tare_ticks >= 1 && c->tare_ticks <= 1 << 20 && c->ramp_in_ticks >= 1 &&
                         c->ramp_in_ticks <= 1 << 24 && c->armed_ticks >= 1;
    return ticks_ok ? 0 : RTHYB_E_LIMIT;
}

/* The station checks the sensors' ranges, before the tare is subtracted; the controller does not
 * check them again. */
static int fresh_controller(rthyb_station *s)
{
    const int error = rthyb_controller_init(&s->controller, &s->cfg.controller);
    for (int i = 0; i < MOST; i++)
        s->controller.cfg.axis[i].x_range_m = s->controller.cfg.axis[i].f_range_n = 0.0;
    return error;
}

/* Durations, converted to ticks of this station. */
static rthyb_station_ticks station_ticks(double h)
{
    const uint32_t lost = ticks_of(RTHYB_LOST_TICKS * STANDARD_S, h), recent = ticks_of(1.0, h);
    return (rthyb_station_ticks){
        .lost = lost < RTHYB_BLIND_MAX ? lost : RTHYB_BLIND_MAX,
        .rest = ticks_of(20.0 * STANDARD_S, h),
        .skips = ticks_of(10.0 * STANDARD_S, h),
        .recent = recent < RTHYB_RECENT_MAX ? recent : RTHYB_RECENT_MAX,
        .arrival = ticks_of(10.0, h),
        .overload = ticks_of(0.25, h),
        .least_way = ticks_of(8.0 * STANDARD_S, h),
        .turn = ticks_of(16.0 * STANDARD_S, h),
        .least_turn = ticks_of(2.0 * STANDARD_S, h),
        .pace = STANDARD_S / h,
    };
}

int rthyb_station_init(rthyb_station *s, const rthyb_station_config *cfg)
{
    int error = config_error(cfg);
    if (error)
        return error;
    memset(s, 0, sizeof *s);
    s->cfg = *cfg;
    s->state = RTHYB_IDLE;
    s->cause_axis = s->cause_interface = s->cause_sensor = s->apart_axis = -1;
    s->refused_axis = s->refused_interface = s->refused_sensor = -1;
    error = fresh_controller(s);
    if (error)
        return error;
    s->ticks = station_ticks(cfg->controller.period_s);
    s->controller.state = RTHYB_IDLE;
    rthyb_disagreement_init(&s->disagreement, &cfg->controller.kinematics,
                            cfg->controller.period_s);
    return error;
}

/* ---- parameters -------------------------------------------------------------------------------- */

static const rthyb_axis_parameters *own_of(const rthyb_parameters *p, int axis)
{
    return p->axis[axis].own ? &p->axis[axis] : NULL;
}

static double velocity_of(const rthyb_parameters *p, int axis)
{
    const rthyb_axis_parameters *own = own_of(p, axis);
    return own ? own->velocity_limit_m_per_s : p->velocity_limit_m_per_s;
}

static double acceleration_of(const rthyb_parameters *p, int axis)
{
    const rthyb_axis_parameters *own = own_of(p, axis);
    return own ? own->acceleration_limit_m_per_s2 : p->acceleration_limit_m_per_s2;
}

/* Whether a set of parameters would switch off a limit: a command that lags because of that limit
 * would then jump. */
static int switches_off(const rthyb_station *s, const rthyb_parameters *p)
{
    int off = 0;
    for (int i = 0; i < axes_of(s); i++) {
        const rthyb_axis_control *c = &s->cfg.controller.axis[i];
        off |= (c->velocity_limit_m_per_s > 0.0 && !(velocity_of(p, i) > 0.0)) ||
               (c->acceleration_limit_m_per_s2 > 0.0 && !(acceleration_of(p, i) > 0.0));
    }
    return off;
}

static void adopt_axis(rthyb_station *s, const rthyb_parameters *p, int i)
{
    rthyb_controller_config *both[] = {&s->cfg.controller, &s->controller.cfg};
    for (int k = 0; k < 2; k++) {
        both[k]->axis[i].velocity_limit_m_per_s = velocity_of(p, i);
        both[k]->axis[i].acceleration_limit_m_per_s2 = acceleration_of(p, i);
    }
    s->cfg.axis[i].own_watches = p->axis[i].own;
    memcpy(s->cfg.axis[i].watch, p->axis[i].watch, sizeof s->cfg.axis[i].watch);
    s->cfg.interface[i] = p->axis[i].interface;
}

int rthyb_station_adopt(rthyb_station *s, const rthyb_parameters *p)
{
    if (s->state != RTHYB_IDLE && switches_off(s, p))
        return 0;
    path_caps before;
    course_caps(s, &before);
    for (int i = 0; i < axes_of(s); i++)
        adopt_axis(s, p, i);
    s->cfg.controller.estimate_held = s->controller.cfg.estimate_held = !p->adapt;
    memcpy(s->cfg.watch, p->watch, sizeof s->cfg.watch);
    s->cfg.path_velocity_m_per_s = p->path_velocity_m_per_s;
    s->cfg.path_acceleration_m_per_s2 = p->path_acceleration_m_per_s2;
    s->cfg.brake_acceleration_m_per_s2 = p->brake_acceleration_m_per_s2;
    s->controller.generation = p->generation;
    if (course_narrows(s, &before))
        course_replan(s);
    return 1;
}

/* ---- transitions ------------------------------------------------------------------------------ */

void station_enter(rthyb_station *s, int state)
{
    s->state = state;
    s->controller.state = state;
    s->in_state = 0;
    s->leg = 0;
    s->no_nearer = 0;
    s->nearest_m = INFINITY;
}

/* Splits finding.where; -1: not such a place. */
static void split_place(int where, int32_t *axis, int32_t *interface, int32_t *sensor)
{
    const int of_lone = where >= SENSOR_PLACE;
    *axis = where > 0 && !of_lone ? where - 1 : -1;
    *interface = where < 0 ? -1 - where : -1;
    *sensor = of_lone ? where - SENSOR_PLACE : -1;
}

/* The first cause is kept. Exception: COMPLETED and OPERATOR are replaced by a fault that occurs
 * during the ramp-out, because they would hide it. */
void station_blame(rthyb_station *s, finding found)
{
    if (s->cause > RTHYB_CAUSE_OPERATOR)
        return;
    s->cause = found.cause;
    s->cause_tick = s->tick;
    s->cause_value = found.value;
    s->cause_limit = found.limit;
    split_place(found.where, &s->cause_axis, &s->cause_interface, &s->cause_sensor);
}

static void clear_cause(rthyb_station *s)
{
    s->cause = RTHYB_CAUSE_NONE;
    s->cause_value = s->cause_limit = 0.0;
    s->cause_axis = s->cause_interface = s->cause_sensor = -1;
}

/* Whether every axis has a pair of plausible values, and every further sensor a value, none of them
 * at the end of its sensor's range. If only a further sensor has none, *found says which one. */
static int is_sound(const rthyb_station *s, const rthyb_station_input *in, finding *found)
{
    int sound = 1;
    *found = plain(RTHYB_CAUSE_NONE);
    for (int i = 0; i < axes_of(s); i++)
        sound = sound && axis_is_sensible(&in->axis[i]) &&
                !axis_off_scale(&s->cfg.axis[i], &in->axis[i]);
    return sound && lone_is_sound(s, in, found);
}

/* 1 + index of the first axis whose link is down, 0 if there is none; the next two functions
 * correspondingly. */
static int first_down(const rthyb_station *s, const rthyb_station_input *in)
{
    for (int i = 0; i < axes_of(s); i++)
        if (in->axis[i].link_down)
            return of_axis(i);
    return 0;
}

static int first_stopped(const rthyb_station *s, const rthyb_station_input *in)
{
    for (int i = 0; i < axes_of(s); i++)
        if (in->axis[i].drive_stopped)
            return of_axis(i);
    return 0;
}

static int first_beyond(const rthyb_station *s, const rthyb_station_input *in)
{
    for (int i = 0; i < axes_of(s); i++)
        if (in->axis[i].beyond)
            return of_axis(i);
    return 0;
}

static int is_apart(const rthyb_station_input *in)
{
    return in->apart > 0 && in->apart != RTHYB_APART_UNKNOWN;
}

static void note_clocks(rthyb_station *s, const rthyb_station_input *in)
{
    s->apart = is_apart(in) ? s->apart + 1 : 0;
    s->apart_axis = is_apart(in) ? in->apart - 1 : -1;
}

/* If the counts have not been compared yet: 0 ticks, and no axis. */
static finding came_apart(const rthyb_station *s)
{
    const int where = s->apart_axis < 0 ? 0 : of_axis(s->apart_axis);
    return (finding){RTHYB_CAUSE_APART, (double)s->apart, s->ticks.lost, where};
}

/* Sets the commands to the measured positions. */
static void settle_at_readings(rthyb_station *s, const rthyb_station_input *in)
{
    double x[MOST];
    for (int i = 0; i < axes_of(s); i++) {
        x[i] = in->axis[i].x_m - s->axis[i].tare_x;
        s->axis[i].gap = 0.0;
    }
    rthyb_controller_rest(&s->controller, x);
}

void station_trip(rthyb_station *s, finding found)
{
    if (s->state == RTHYB_TRIPPED)
        return;
    station_blame(s, found);
    s->zeroing = 0;
    station_enter(s, RTHYB_TRIPPED);
    s->trip_frames = TRIP_FRAMES;
    s->reset_frames = 0;
}

void station_ramp_out(rthyb_station *s, finding found)
{
    if (!is_moving(s->state))
        return;
    station_blame(s, found);
    course_brake_in(s, RTHYB_RAMP_OUT, 0);
}

static int refuse(rthyb_station *s, finding found)
{
    s->refused_cause = found.cause;
    s->refused_value = found.value;
    s->refused_limit = found.limit;
    split_place(found.where, &s->refused_axis, &s->refused_interface, &s->refused_sensor);
    return 0;
}

/* Returns to the initial state; what a recording needs from the last test stays readable until
 * then. The tare, the readings and the commands are kept: the ramp begins at the last commands of
 * the drives, because the difference between those and the readings would otherwise be sent as a
 * single step. Shares of the last second begin anew: what happened at rest is no reason to end a
 * test. What is true now is kept: for how many ticks the drives' counts have been apart, and by how
 * much readings disagree, of which the tare was the beginning. */
static void begin_test(rthyb_station *s)
{
    const uint32_t generation = s->controller.generation;
    double x[MOST];
    for (int i = 0; i < axes_of(s); i++)
        x[i] = s->controller.axis[i].x_cmd;
    (void)fresh_controller(s);
    s->controller.generation = generation;
    s->test_tick = 0;
    s->interrupted = 0;
    clear_cause(s);
    s->indicated = 0;
    s->indicator_slope = 0.0;
    for (int i = 0; i < axes_of(s); i++)
        s->axis[i].over_f = s->axis[i].over_rig_f = (rthyb_overload){.seen = s->tick};
    for (int j = 0; j < interfaces_of(s); j++)
        s->over_interface[j] = (rthyb_overload){.seen = s->tick};
    s->skips = s->losses = (rthyb_recent){.count = 0};
    memset(s->ends, 0, sizeof s->ends);
    rthyb_controller_rest(&s->controller, x);
    for (int i = 0; i < axes_of(s); i++)
        s->controller.axis[i].x_m1 = s->axis[i].seen_x - s->axis[i].tare_x;
    lone_seen(s, s->controller.sensor);
    station_enter(s, RTHYB_RAMP_IN);
    course_ramp_to_zero(s);
}

static void begin_zero(rthyb_station *s)
{
    station_enter(s, RTHYB_IDLE);
    s->zeroing = 1;
    s->tare_readings = 0;
    for (int i = 0; i < axes_of(s); i++)
        axis_begin_tare(&s->axis[i]);
    lone_begin_tare(s);
}

/* A drive resumes from where it stands, so it must be at rest at a known position. A force beyond
 * the rig's own limit would cause another trip at once. In IDLE, only a drive that has stopped on
 * its own can be reset. */
static int can_reset(rthyb_station *s, const rthyb_station_input *in)
{
    finding found;
    if (s->state == RTHYB_IDLE && (!first_stopped(s, in) || s->zeroing == 1))
        return 0;
    if (!is_sound(s, in, &found))
        return refuse(s, found);
    int rests = !first_down(s, in) && s->in_state >= s->ticks.rest;
    for (int i = 0; i < axes_of(s); i++) {
        const rthyb_axis *a = &s->axis[i];
        if (watch_rig_trips(s, i, in->axis[i].f_n, &found))
            return refuse(s, found);
        rests = rests && a->rest_ticks >= s->ticks.rest &&
                fabs(in->axis[i].x_m - a->rest_x) <= s->cfg.axis[i].rest_spread_m;
    }
    return rests;
}

/* Commands that lead to motion require drives that follow. */
static int needs_drive(int command)
{
    return command == RTHYB_CMD_ZERO || command == RTHYB_CMD_ARM || command == RTHYB_CMD_START;
}

/* Whether all drives count on one clock; always true for a single axis. */
static int is_one_clock(const rthyb_station *s, const rthyb_station_input *in)
{
    return s->apart < s->ticks.lost && in->apart != RTHYB_APART_UNKNOWN;
}

static int arm(rthyb_station *s, const rthyb_station_input *in)
{
    finding found;
    if (!is_one_clock(s, in))
        return refuse(s, came_apart(s));
    if (watch_finds(s, &found))
        return refuse(s, found);
    station_enter(s, RTHYB_ARMED);
    return 1;
}

static int start(rthyb_station *s)
{
    finding found;
    if (watch_finds(s, &found) || watch_wandered(s, &found))
        return refuse(s, found);
    if (lone_not_taken(s, 0, &found))
        return refuse(s, found);
    if (!s->seen || s->controller.missing)
        return 0;
    begin_test(s);
    return 1;
}

static int resume(rthyb_station *s)
{
    finding found;
    for (int i = 0; i < axes_of(s); i++)
        if (watch_overload(s, i, s->controller.axis[i].f1 + s->axis[i].tare_f, &found))
            return refuse(s, found);
    double force[MOST];
    for (int j = 0; j < interfaces_of(s); j++)
        force[j] = s->controller.interface[j].f;
    if (watch_interface_overload(s, force, &found))
        return refuse(s, found);
    if (s->leg != 1)
        return 0;
    course_resume(s);
    return 1;
}

static int reset(rthyb_station *s, const rthyb_station_input *in)
{
    if (!can_reset(s, in))
        return 0;
    station_enter(s, RTHYB_IDLE);
    clear_cause(s);
    s->tared = 0;
    settle_at_readings(s, in);
    s->reset_frames = RESET_FRAMES;
    return 1;
}

static void stop(rthyb_station *s)
{
    if (is_moving(s->state)) {
        station_ramp_out(s, plain(RTHYB_CAUSE_OPERATOR));
    } else if (s->state != RTHYB_RAMP_OUT) {
        s->zeroing = 0;
        station_enter(s, RTHYB_IDLE);
    }
}

/* Executes an operator's command; 0 if it is not allowed in this state or cannot be carried out. */
static int obey(rthyb_station *s, const rthyb_station_input *in)
{
    if (in->command == RTHYB_CMD_NONE)
        return 1;
    (void)refuse(s, plain(RTHYB_CAUSE_NONE));
    if (!rthyb_command_allowed(s->state, in->command) ||
        (needs_drive(in->command) && (first_down(s, in) || first_stopped(s, in))))
        return 0;
    switch (in->command) {
    case RTHYB_CMD_ZERO:
        begin_zero(s);
        break;
    case RTHYB_CMD_ARM:
        return arm(s, in);
    case RTHYB_CMD_START:
        return start(s);
    case RTHYB_CMD_HOLD:
        if (course_can_hold(s))
            course_hold(s);
        break;
    case RTHYB_CMD_RESUME:
        return resume(s);
    case RTHYB_CMD_STOP:
        stop(s);
        break;
    case RTHYB_CMD_RESET:
        return reset(s, in);
    default:
        station_trip(s, plain(RTHYB_CAUSE_SIGNAL));
        break;
    }
    return 1;
}

/* ---- one tick --------------------------------------------------------------------------------- */

/* Stores one bit for this tick in the map of the last second. */
static void remember(rthyb_recent *recent, uint64_t tick, uint32_t length, int is_set)
{
    const uint64_t at = tick % length;
    uint64_t *word = &recent->map[at / 64];
    const uint64_t bit = (uint64_t)1 << (at % 64);
    recent->count += (uint32_t)(is_set != 0) - (uint32_t)((*word & bit) != 0);
    *word = is_set ? *word | bit : *word & ~bit;
}

static void note_end(rthyb_station *s, int place, int is_end, double reading)
{
    rthyb_range_end *end = &s->ends[place];
    remember(&end->ticks, s->tick, s->ticks.recent, is_end);
    end->reading = is_end ? reading : end->reading;
}

/* Which readings of this tick were at the end of their range; a skipped tick has none. */
static void note_ends(rthyb_station *s, int was_skipped)
{
    const int n = axes_of(s);
    for (int i = 0; i < n; i++) {
        const rthyb_axis *a = &s->axis[i];
        const int off_scale = was_skipped ? 0 : a->off_scale;
        note_end(s, 2 * i, off_scale & AXIS_OFF_X, a->reading_x_m);
        note_end(s, 2 * i + 1, off_scale & AXIS_OFF_F, a->reading_f_n);
    }
    for (int k = 0; k < lones_of(s); k++)
        note_end(s, 2 * n + k, !was_skipped && s->lone[k].off_scale, s->lone[k].reading);
}

static void note_tick(rthyb_station *s, int was_skipped)
{
    note_ends(s, was_skipped);
    remember(&s->skips, s->tick, s->ticks.recent, was_skipped);
    remember(&s->losses, s->tick, s->ticks.recent, !was_skipped && s->controller.missing > 0);
    s->skipped += (uint64_t)(was_skipped != 0);
    s->tick++;
    s->in_state++;
}

/* Command, after tare, that a tare with these sums would leave: 0 if the command is known from an
 * earlier tare or station, because the tare then makes it the zero. */
static double left_of_command(const rthyb_station *s, int axis)
{
    const rthyb_axis *a = &s->axis[axis];
    const double x_cmd_m = s->controller.axis[axis].x_cmd + a->tare_cmd;
    return s->commands ? 0.0 : x_cmd_m - a->sum_x / s->cfg.tare_ticks;
}

static int tare_is_refused(const rthyb_station *s, finding *found)
{
    const double ticks = s->cfg.tare_ticks;
    double x[MOST];
    for (int i = 0; i < axes_of(s); i++) {
        const rthyb_axis *a = &s->axis[i];
        x[i] = left_of_command(s, i);
        if (axis_is_far_off(&s->cfg.axis[i], a->sum_x / ticks, a->sum_f / ticks, found)) {
            found->where = of_axis(i);
            return 1;
        }
    }
    if (lone_is_far_off(s, found))
        return 1;
    *found = plain(RTHYB_CAUSE_NO_POSE);
    return !rthyb_controller_has_pose(&s->controller, x);
}

/* Whether a reading of the tare repeats itself for longer than its noise allows. All are counted,
 * whether or not one is found. */
static int is_frozen(rthyb_station *s, const rthyb_station_input *in, finding *found)
{
    finding other;
    int frozen = 0;
    for (int i = 0; i < axes_of(s); i++)
        if (axis_is_frozen(&s->axis[i], &s->cfg.axis[i], &in->axis[i], &other) && !frozen) {
            *found = other;
            found->where = of_axis(i);
            frozen = 1;
        }
    const int lone = lone_is_frozen(s, &other);
    if (lone && !frozen)
        *found = other;
    return lone || frozen;
}

/* Tare: mean of tare_ticks readings, of all axes over the same ticks; fails if they move. Ticks
 * without a reading do not count. */
static void take_tare(rthyb_station *s, const rthyb_station_input *in)
{
    const rthyb_axis_config *cfg = s->cfg.axis;
    const double ticks = s->cfg.tare_ticks;
    double x[MOST];
    finding found;
    for (int i = 0; i < axes_of(s); i++)
        if (!axis_add_to_tare(&s->axis[i], &cfg[i], &in->axis[i])) {
            s->zeroing = 2;
            return;
        }
    if (!lone_add_to_tare(s, &found)) {
        (void)refuse(s, found);
        s->zeroing = 2;
        return;
    }
    if (is_frozen(s, in, &found)) {
        (void)refuse(s, found);
        s->zeroing = 6;
        return;
    }
    if (++s->tare_readings < s->cfg.tare_ticks)
        return;
    (void)refuse(s, plain(RTHYB_CAUSE_NONE));
    if (tare_is_refused(s, &found)) {
        (void)refuse(s, found);
        s->zeroing = found.cause == RTHYB_CAUSE_NO_POSE ? 4 : 3;
        return;
    }
    for (int i = 0; i < axes_of(s); i++) {
        rthyb_axis *a = &s->axis[i];
        x[i] = axis_take_tare(a, a->sum_x / ticks, a->sum_f / ticks,
                              s->controller.axis[i].x_cmd + a->tare_cmd, s->commands);
    }
    lone_take_tare(s);
    differ_begin(s);
    rthyb_controller_rest(&s->controller, x);
    s->tared = 1;
    s->commands = 1;
    s->zeroing = 0;
    station_enter(s, RTHYB_ZEROED);
}

static void note_reading(rthyb_station *s, const rthyb_station_input *in)
{
    const int ceased = s->controller.missing >= s->ticks.lost;
    for (int i = 0; i < axes_of(s); i++) {
        const double x = in->axis[i].x_m;
        watch_stuck(s, i, x, in->axis[i].f_n);
        axis_watch_rest(&s->axis[i], x, s->cfg.axis[i].rest_spread_m, ceased, s->ticks.rest);
    }
    lone_note(s);
    if (!s->seen && !s->commands)
        settle_at_readings(s, in);
    s->seen = 1;
    for (int i = 0; i < axes_of(s); i++) {
        s->axis[i].seen_x = in->axis[i].x_m;
        s->axis[i].seen_f = in->axis[i].f_n;
    }
    if (s->zeroing == 1)
        take_tare(s, in);
}

/* Trips, and marks the record of this tick with the reason. */
static void trip_at(rthyb_station *s, finding found, int bit, rthyb_record *record)
{
    if (s->state == RTHYB_TRIPPED)
        return;
    record->code |= (uint16_t)(bit | RTHYB_S_TRIP);
    station_trip(s, found);
}

/* 1 + index of the axis that has been without a pair for longest. */
static int longest_missing(const rthyb_station *s)
{
    int longest = 0;
    for (int i = 1; i < axes_of(s); i++)
        if (s->controller.axis[i].missing > s->controller.axis[longest].missing)
            longest = i;
    return of_axis(longest);
}

/* Whether a reading arrives but is rejected because it has jumped; *found says which one. */
static int has_leapt(const rthyb_axis *a, finding *found)
{
    if (!a->has_reading || a->off_scale || (a->leaps_x.count == 0 && a->leaps_f.count == 0))
        return 0;
    const int of_x = a->leaps_x.count > 0;
    found->cause = of_x ? RTHYB_CAUSE_SENSOR_JUMP : RTHYB_CAUSE_FORCE_JUMP;
    found->value = of_x ? a->leaps_x.level - a->seen_x : a->leaps_f.level - a->seen_f;
    return 1;
}

/* Why no pair was accepted for so long: an axis has none, its readings have jumped, or those of all
 * axes correspond to no pose. */
static finding not_taken(const rthyb_station *s)
{
    const int axis = longest_missing(s);
    finding of_lone;
    if (lone_not_taken(s, s->controller.axis[axis - 1].missing, &of_lone))
        return of_lone;
    finding found = {RTHYB_CAUSE_LINK_LOST, s->controller.missing, s->ticks.lost, axis};
    if (has_leapt(&s->axis[axis - 1], &found))
        found.limit = watch_of(s, axis - 1, found.cause)->value;
    else if (!s->controller.axis[axis - 1].missing)
        found = (finding){RTHYB_CAUSE_NO_POSE, s->controller.missing, s->ticks.lost, 0};
    return found;
}

/* finding.where of the first axis or sensor with a value that is not finite; 0: none. */
static int not_finite(const rthyb_station *s, const rthyb_input *in)
{
    for (int i = 0; i < axes_of(s); i++) {
        const rthyb_pair *pair = &in->axis[i];
        if (pair->lost & RTHYB_S_NOT_FINITE ||
            (!pair->lost && !(isfinite(pair->x_meas_m) && isfinite(pair->f_meas_n))))
            return of_axis(i);
    }
    return lone_not_finite(s, in);
}

/* Writes the values of further axes, which the record does not contain, to the channels. */
static void note_channels(rthyb_station *s)
{
    const rthyb_controller *c = &s->controller;
    double value[RTHYB_CHANNELS_MAX];
    uint32_t count = 0;
    for (int j = 1; j < interfaces_of(s); j++) {
        value[count++] = c->interface[j].x_num1;
        value[count++] = rthyb_controller_stiffness(c, j);
    }
    for (int i = 1; i < axes_of(s); i++) {
        value[count++] = c->axis[i].x_plc1;
        value[count++] = rthyb_controller_lead(c, i, 1);
        value[count++] = rthyb_controller_lead(c, i, 2);
    }
    for (uint32_t k = 0; k < count && k < s->cfg.axis_channel_count; k++)
        s->channel[s->cfg.axis_channel + k] = value[k];
}

/* The commands in effect at the drives remain those that were sent last. */
static void keep_commands(rthyb_station *s, const double *sent)
{
    for (int i = 0; i < axes_of(s); i++)
        s->controller.axis[i].x_cmd = s->controller.axis[i].limiter.x_lim = sent[i];
}

/* Cause for the row, including the sensor without an actuator that it belongs to; with several axes,
 * also the axis or interface. */
static uint32_t placed_cause(const rthyb_station *s)
{
    const int interface = s->cause_interface >= 0;
    const int number = interface ? s->cause_interface : s->cause_axis;
    const uint32_t place = (uint32_t)(number + 1) << RTHYB_PLACE_BIT |
                           (interface ? (uint32_t)RTHYB_PLACE_INTERFACE : 0u);
    return (uint32_t)s->cause | (axes_of(s) == 1 ? 0u : place) |
           (uint32_t)(s->cause_sensor + 1) << RTHYB_PLACE_SENSOR_BIT;
}

static void sample(rthyb_station *s, const rthyb_input *in, int blind, rthyb_record *record)
{
    const int tripped = s->state == RTHYB_TRIPPED, running = s->state == RTHYB_RUNNING;
    double x[MOST], sent[MOST] = {0.0};
    const double *path = course_next(s, x);
    const double indicator = s->controller.tracking_indicator;
    for (int i = 0; i < axes_of(s); i++)
        sent[i] = s->controller.axis[i].x_cmd;
    course_confine(s);
    const int code = rthyb_controller_sample(&s->controller, in, path, blind || tripped, record);
    if (s->cfg.axis_channel_count > 0)
        note_channels(s);
    if (s->cfg.lone_channel_count > 0)
        lone_note_channels(s);
    if (tripped && !blind)
        record->flags &= ~(uint32_t)RTHYB_F_BLIND;
    if (running)
        s->test_tick++;
    if (is_on_its_way(s->state) && !blind)
        watch_moving(s, record, indicator);
    else if (!tripped && !blind)
        watch_at_rest(s, record);
    record->tick = s->tick;
    if (!blind && s->controller.missing >= s->ticks.lost && s->state != RTHYB_IDLE) {
        const finding found = not_taken(s);
        const int lost = found.cause == RTHYB_CAUSE_LINK_LOST ||
                         found.cause == RTHYB_CAUSE_NO_POSE ||
                         found.cause == RTHYB_CAUSE_SENSOR_LOST;
        trip_at(s, found, lost ? RTHYB_S_LINK_LOST : RTHYB_S_SENSOR_JUMP, record);
    }
    if (code & RTHYB_S_NOT_FINITE)
        trip_at(s, (finding){.cause = RTHYB_CAUSE_NOT_FINITE, .where = not_finite(s, in)},
                RTHYB_S_NOT_FINITE, record);
    /* Arrival moves the command to the end of its path, so not in a tick that sends nothing. */
    if (s->state != RTHYB_TRIPPED && !blind)
        course_arrive(s);
    if (s->state == RTHYB_TRIPPED)
        keep_commands(s, sent);
    s->controller.state = s->state;
    record->cause = placed_cause(s);
}

static rthyb_input at_tick(const rthyb_station *s, const double *ag, size_t n)
{
    const int running = s->state == RTHYB_RUNNING && s->test_tick < n;
    rthyb_input in = {.excitation = running ? ag[s->test_tick] : 0.0};
    for (int i = 0; i < MOST; i++)
        in.axis[i].lost = RTHYB_LOST;
    for (int k = 0; k < lones_of(s); k++)
        in.sensor_lost[k] = RTHYB_LOST;
    return in;
}

/* Processes skipped ticks late: readings are extrapolated, nothing is learnt, nothing is sent. */
static uint32_t blind_steps(rthyb_station *s, uint32_t skipped, const double *ag, size_t n,
                            rthyb_record *records)
{
    const uint32_t made_up = skipped < s->ticks.lost ? skipped : s->ticks.lost;
    /* Beyond the length of the map of recent ticks, they are only counted, so that a long
     * suspension does not cause a long loop. */
    const uint32_t noted = skipped < s->ticks.recent ? skipped : s->ticks.recent;
    const uint32_t counted = skipped - noted;
    for (uint32_t i = 0; i < noted; i++) {
        if (i < made_up) {
            const rthyb_input in = at_tick(s, ag, n);
            sample(s, &in, 1, &records[i]);
        }
        note_tick(s, 1);
    }
    s->tick += counted;
    s->skipped += counted;
    watch_skips(s, skipped);
    return made_up;
}

static void watch_surroundings(rthyb_station *s, const rthyb_station_input *in, size_t n)
{
    const int down = first_down(s, in), stopped = first_stopped(s, in);
    const int beyond = first_beyond(s, in);
    note_clocks(s, in);
    if (down && s->state != RTHYB_IDLE)
        station_trip(s, (finding){.cause = RTHYB_CAUSE_LINK_DOWN, .where = down});
    if (stopped && s->state != RTHYB_IDLE)
        station_trip(s, (finding){.cause = RTHYB_CAUSE_DRIVE_STOPPED, .where = stopped});
    if (beyond && s->state != RTHYB_IDLE)
        station_trip(s, (finding){RTHYB_CAUSE_POSITION, s->controller.axis[beyond - 1].x_cmd,
                                  watch_of(s, beyond - 1, RTHYB_CAUSE_POSITION)->value, beyond});
    if (s->apart >= s->ticks.lost && s->state != RTHYB_IDLE && s->state != RTHYB_ZEROED)
        station_trip(s, came_apart(s));
    if (in->heartbeat_late)
        station_ramp_out(s, plain(RTHYB_CAUSE_HEARTBEAT));
    if (s->state == RTHYB_RUNNING && s->test_tick >= n)
        station_ramp_out(s, plain(RTHYB_CAUSE_COMPLETED));
    if (s->state == RTHYB_ARMED && s->in_state >= (uint64_t)s->cfg.armed_ticks)
        station_enter(s, RTHYB_ZEROED);
}

/* With several axes: flags of the drives that have stopped. */
static uint32_t stopped_flags(const rthyb_station *s, const rthyb_station_input *in)
{
    uint32_t flags = 0;
    for (int i = 0; i < axes_of(s) && axes_of(s) > 1; i++)
        flags |= (uint32_t)(in->axis[i].drive_stopped != 0) << (RTHYB_F_STOPPED_BIT + i);
    return flags;
}

/* With several axes: bits of the links that are down, the axis whose count differs, and the sensors
 * without a reading. */
static uint32_t place_bits(const rthyb_station *s, const rthyb_station_input *in)
{
    uint32_t places = axes_of(s) > 1 ? ((uint32_t)in->apart & 7u) << RTHYB_APART_BIT : 0u;
    for (int i = 0; i < axes_of(s) && axes_of(s) > 1; i++)
        places |= (uint32_t)(in->axis[i].link_down != 0) << (RTHYB_DOWN_BIT + i);
    return places | lone_silent_bits(s);
}

/* The station's inputs in this tick, as flags of the record. */
static uint32_t input_flags(const rthyb_station *s, const rthyb_station_input *in, int refused,
                            int took_over)
{
    int32_t lost = 0;
    for (int i = 0; i < axes_of(s); i++)
        lost |= in->axis[i].lost;
    return (lost ? (uint32_t)RTHYB_F_LOST : 0u) |
           (first_down(s, in) ? (uint32_t)RTHYB_F_DOWN : 0u) |
           (first_stopped(s, in) ? (uint32_t)RTHYB_F_STOPPED : 0u) |
           (in->heartbeat_late ? (uint32_t)RTHYB_F_SILENT : 0u) |
           (first_beyond(s, in) ? (uint32_t)RTHYB_F_BEYOND : 0u) |
           (is_apart(in) ? (uint32_t)RTHYB_F_APART : 0u) |
           (took_over ? (uint32_t)RTHYB_F_TAKEN_OVER : 0u) |
           (refused ? (uint32_t)RTHYB_F_REFUSED : 0u) | stopped_flags(s, in) |
           ((uint32_t)in->command & UINT8_MAX) << RTHYB_F_COMMAND_BIT;
}

/* Stores which axes and sensors have a reading in this tick, and which readings are at the end of a
 * range; 1 if all have one. */
static int look_at(rthyb_station *s, const rthyb_station_input *in)
{
    int all = 1;
    for (int i = 0; i < axes_of(s); i++) {
        rthyb_axis *a = &s->axis[i];
        a->has_reading = axis_is_sensible(&in->axis[i]);
        a->off_scale = a->has_reading ? axis_off_scale(&s->cfg.axis[i], &in->axis[i]) : 0;
        a->reading_x_m = in->axis[i].x_m;
        a->reading_f_n = in->axis[i].f_n;
        all = all && a->has_reading;
    }
    const int sensors = lone_look(s, in);
    return all && sensors;
}

/* The pairs of this tick, as passed to the controller. A pair is rejected if either half jumps. */
static rthyb_input take_pairs(rthyb_station *s, const rthyb_station_input *in, const double *ag,
                              size_t n)
{
    rthyb_input pairs = at_tick(s, ag, n);
    const int all = look_at(s, in), off_scale = watch_off_scale(s);
    const uint32_t leapt = all && !off_scale ? watch_leaps(s, in) : 0;
    const uint32_t sensors_leapt = all && !off_scale ? lone_leaps(s) : 0;
    if (all && !off_scale && !leapt && !sensors_leapt)
        note_reading(s, in);
    lone_take(s, sensors_leapt, &pairs);
    for (int i = 0; i < axes_of(s); i++) {
        rthyb_pair *pair = &pairs.axis[i];
        pair->lost = leapt >> i & 1u ? RTHYB_LOST : in->axis[i].lost;
        if (s->axis[i].off_scale)
            pair->lost = RTHYB_LOST | RTHYB_S_OUT_OF_RANGE;
        pair->x_meas_m = in->axis[i].x_m - s->axis[i].tare_x;
        pair->f_meas_n = in->axis[i].f_n - s->axis[i].tare_f;
    }
    return pairs;
}

/* While a drive has stopped on its own, its command follows the measured position, so that nothing
 * jumps when the drive is released. For this the axes need their own readings only, whatever other
 * sensor has none. */
static void stand_by(rthyb_station *s, const rthyb_station_input *in)
{
    double x[MOST];
    if (s->state != RTHYB_IDLE || !s->seen || !first_stopped(s, in))
        return;
    for (int i = 0; i < axes_of(s); i++)
        if (s->controller.axis[i].missing)
            return;
    for (int i = 0; i < axes_of(s); i++) {
        const int stopped = in->axis[i].drive_stopped;
        rthyb_axis *a = &s->axis[i];
        x[i] = stopped ? in->axis[i].x_m - a->tare_x : s->controller.axis[i].x_cmd;
        a->gap = stopped ? 0.0 : a->gap;
    }
    rthyb_controller_rest(&s->controller, x);
}

/* Takes over the drives' commands, with the first valid readings: earlier, they would wait unsent
 * for an unknown time. Returns 1 if they were taken over. */
static int take_over(rthyb_station *s, const rthyb_station_input *in)
{
    double x[MOST];
    finding unsound;
    int good = in->taken_over && !s->seen && is_sound(s, in, &unsound);
    for (int i = 0; i < axes_of(s); i++) {
        x[i] = in->axis[i].x_cmd_m;
        good = good && judge(x[i], RTHYB_DISPLACEMENT_MAX_M) == RTHYB_OK;
    }
    if (!good)
        return 0;
    rthyb_controller_rest(&s->controller, x);
    s->commands = 1;
    return 1;
}

/* A tare whose readings do not come would remain in progress without saying why. */
static void give_up_tare(rthyb_station *s)
{
    finding found;
    if (s->zeroing != 1 || !lone_withholds(s, &found))
        return;
    (void)refuse(s, found);
    s->zeroing = 5;
}

void rthyb_station_advance(rthyb_station *s)
{
    if (s->cfg.part_channel_count > 0) {
        const rthyb_numerical part = part_of(&s->controller);
        (void)rthyb_numerical_report(&part, s->channel + s->cfg.part_channel,
                                     s->cfg.part_channel_count);
    }
    rthyb_controller_advance(&s->controller);
}

static void write_output(rthyb_station *s, int refused, uint32_t records, rthyb_station_output *out)
{
    const int frame = s->state != RTHYB_TRIPPED || s->trip_frames > 0;
    *out = (rthyb_station_output){
        .send = s->seen && frame,
        .state = s->state,
        .sent_state = s->reset_frames > 0 ? RTHYB_NOTICE_RESET : s->state,
        .refused = refused,
        .records = records,
    };
    for (int i = 0; i < axes_of(s); i++) {
        out->axis[i].x_cmd_m = s->controller.axis[i].x_cmd + s->axis[i].tare_cmd;
        course_bounds(s, i, &out->axis[i]);
    }
    if (s->state == RTHYB_TRIPPED && s->trip_frames > 0)
        s->trip_frames--;
    s->reset_frames -= out->send && s->reset_frames > 0;
}

int rthyb_station_tick(rthyb_station *s, const rthyb_station_input *in, const double *ag_mps2,
                       size_t n, rthyb_record *records, rthyb_station_output *out)
{
    rthyb_station_advance(s);
    const int took_over = take_over(s, in);
    s->noted = RTHYB_OK;
    for (int i = 0; i < axes_of(s); i++)
        s->axis[i].stands = in->axis[i].drive_stopped || in->axis[i].link_down;
    const uint32_t made_up = blind_steps(s, in->skipped, ag_mps2, n, records);
    const int refused = !obey(s, in);
    watch_surroundings(s, in, n);
    const rthyb_input pairs = take_pairs(s, in, ag_mps2, n);
    rthyb_record *last = &records[made_up];
    sample(s, &pairs, 0, last);
    stand_by(s, in);
    give_up_tare(s);
    note_tick(s, 0);
    write_output(s, refused, made_up + 1, out);
    if (s->cfg.law_channel_count > 0)
        (void)rthyb_law_report_beside(&s->controller.axis[0].law, s->channel + s->cfg.law_channel,
                                      s->cfg.law_channel_count);
    last->code |= (uint16_t)s->noted;
    for (int i = 0; i < axes_of(s); i++)
        note_pair(&last->axis[i], in->axis[i].x_m, in->axis[i].f_n, in->axis[i].lost, axes_of(s));
    if (first_beyond(s, in) && s->state == RTHYB_TRIPPED)
        last->code |= RTHYB_S_POSITION_LIMIT | RTHYB_S_TRIP;
    last->cause |= place_bits(s, in);
    last->flags = (last->flags & ~UNSENT_FLAGS) | input_flags(s, in, refused, took_over);
    for (int i = 0; i < axes_of(s) && !out->send; i++)
        last->flags |= unsent_flag(i, axes_of(s));
    return 0;
}
