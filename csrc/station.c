/* States, limits and faults: what may happen when, and what happens when something goes wrong.
 *
 *   IDLE -> ZEROED -> ARMED -> RAMP_IN -> RUNNING (<-> HOLD) -> RAMP_OUT -> IDLE
 *   TRIPPED from anywhere: three more commands with the last position, then silence until RESET.
 *
 * The station decides which displacement comes next: the equation of motion while RUNNING, a path
 * of limited velocity and acceleration otherwise. The first cause that took a test off its course
 * is latched. Everything is a function of (state, input); the clock and the wire are elsewhere. */
#include <string.h>

#include "axis.h"
#include "internal.h"
#include "numeric.h"
#include "path.h"

#define STANDARD_S (1.0 / 1024.0) /* a tick of real time */
#define JUMP_TAKEN 3              /* readings in a row that make a new level, at any rate */
#define ARRIVED_M 1e-6            /* what the command may lag behind at the end of a path */
#define OVERLOAD 1.5              /* times a force's limit: not even one tick */
#define START_SPREADS 5.0 /* times rest_spread_m: how far from the command START may find x_m */
#define SKIPS_SHARE (50.0 / 1024.0) /* of the last second, where nothing else is said */
#define TRIP_FRAMES 3
#define RESET_FRAMES 3 /* one that is lost does not matter */

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

static int config_error(const rthyb_station_config *c)
{
    if (rthyb_watches_check(c->watch) ||
        rthyb_path_limits_check(c->path_velocity_m_per_s, c->path_acceleration_m_per_s2,
                                c->brake_acceleration_m_per_s2))
        return RTHYB_E_LIMIT;
    for (int i = 0; i < RTHYB_AXES; i++)
        if (axis_check(&c->axis[i]))
            return RTHYB_E_LIMIT;
    if (c->law_channel > RTHYB_CHANNELS_MAX ||
        c->law_channel_count > RTHYB_CHANNELS_MAX - c->law_channel ||
        c->part_channel > RTHYB_CHANNELS_MAX ||
        c->part_channel_count > RTHYB_CHANNELS_MAX - c->part_channel)
        return RTHYB_E_LIMIT;
    const int ticks_ok = c->tare_ticks >= 1 && c->tare_ticks <= 1 << 20 && c->ramp_in_ticks >= 1 &&
                         c->ramp_in_ticks <= 1 << 24 && c->armed_ticks >= 1;
    return ticks_ok ? 0 : RTHYB_E_LIMIT;
}

/* The sensors' ranges are the station's to judge, before the tare is taken off. */
static int fresh_controller(rthyb_station *s)
{
    const int error = rthyb_controller_init(&s->controller, &s->cfg.controller);
    s->controller.cfg.x_range_m = s->controller.cfg.f_range_n = 0.0;
    return error;
}

/* What is told by time, in ticks of the station's own. */
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
    *s = (rthyb_station){.cfg = *cfg, .state = RTHYB_IDLE};
    error = fresh_controller(s);
    if (error)
        return error;
    s->ticks = station_ticks(cfg->controller.period_s);
    s->controller.state = RTHYB_IDLE;
    return error;
}

/* What lags behind its course under a limit would leap there without it. */
static int switches_off(const rthyb_station *s, const rthyb_parameters *p)
{
    const rthyb_controller_config *c = &s->cfg.controller;
    return (c->velocity_limit_m_per_s > 0.0 && !(p->velocity_limit_m_per_s > 0.0)) ||
           (c->acceleration_limit_m_per_s2 > 0.0 && !(p->acceleration_limit_m_per_s2 > 0.0));
}

/* ---- limits of paths --------------------------------------------------------------------------- */

/* Of a path and of the command: the narrower one; 0 is no limit of the command. */
static double narrower(double path, double command)
{
    return command > 0.0 ? fmin(path, command) : path;
}

static double path_velocity(const rthyb_station *s)
{
    return narrower(s->cfg.path_velocity_m_per_s, s->cfg.controller.velocity_limit_m_per_s);
}

static double path_acceleration(const rthyb_station *s)
{
    return narrower(s->cfg.path_acceleration_m_per_s2,
                    s->cfg.controller.acceleration_limit_m_per_s2);
}

static double brake_acceleration(const rthyb_station *s)
{
    const double own = s->cfg.brake_acceleration_m_per_s2;
    return own > 0.0 ? narrower(own, s->cfg.controller.acceleration_limit_m_per_s2)
                     : path_acceleration(s);
}

static path_limits limits_of(const rthyb_station *s)
{
    return (path_limits){
        .period_s = s->cfg.controller.period_s,
        .velocity_m_per_s = path_velocity(s),
        .acceleration_m_per_s2 = path_acceleration(s),
        .brake_m_per_s2 = brake_acceleration(s),
        .least_way = s->ticks.least_way,
        .turn = s->ticks.turn,
        .least_turn = s->ticks.least_turn,
    };
}

static rthyb_path plan(const rthyb_station *s, const double from[3], const double to[3])
{
    const path_limits limits = limits_of(s);
    return path_between(&limits, from, to);
}

/* ---- transitions ------------------------------------------------------------------------------ */

static void enter(rthyb_station *s, int state)
{
    s->state = state;
    s->controller.state = state;
    s->in_state = 0;
    s->leg = 0;
    s->no_nearer = 0;
    s->nearest_m = INFINITY;
}

static finding plain(int cause)
{
    return (finding){.cause = cause};
}

/* The first cause stays. That a test was over, or that the operator wanted it to be, is none that a
 * fault on the way out would hide behind. */
static void blame(rthyb_station *s, finding found)
{
    if (s->cause > RTHYB_CAUSE_OPERATOR)
        return;
    s->cause = found.cause;
    s->cause_tick = s->tick;
    s->cause_value = found.value;
    s->cause_limit = found.limit;
}

static void forget_cause(rthyb_station *s)
{
    s->cause = RTHYB_CAUSE_NONE;
    s->cause_value = s->cause_limit = 0.0;
}

/* A pair of every axis, of numbers that it can be. */
static int is_sensible(const rthyb_station_input *in)
{
    int sensible = !in->lost;
    for (int i = 0; i < RTHYB_AXES; i++)
        sensible = sensible && axis_is_sensible(&in->axis[i]);
    return sensible;
}

static int is_sound(const rthyb_station *s, const rthyb_station_input *in)
{
    int sound = is_sensible(in);
    for (int i = 0; i < RTHYB_AXES; i++)
        sound = sound && !axis_off_scale(&s->cfg.axis[i], &in->axis[i]);
    return sound;
}

static int is_moving(int state)
{
    return state == RTHYB_RAMP_IN || state == RTHYB_RUNNING || state == RTHYB_HOLD;
}

/* From START until it is at rest again. */
static int is_on_its_way(int state)
{
    return is_moving(state) || state == RTHYB_RAMP_OUT;
}

/* At rest at x, wherever the drive was told to be before. */
static void settle(rthyb_station *s, double x)
{
    rthyb_controller *c = &s->controller;
    rthyb_law_rest(&c->law, x);
    c->x_num = c->x_num1 = c->x_plc = c->x_cmd = c->x_cmd1 = c->x_lim = c->x_lim1 = x;
    c->step = c->step1 = 0.0;
    c->gap = 0;
}

/* Where the specimen is read to be. */
static void settle_at(rthyb_station *s, double reading)
{
    settle(s, reading - s->axis[0].tare_x);
    s->axis[0].gap = 0.0;
}

/* Displacement, velocity and acceleration of what the phase lead is given. */
static void present(rthyb_station *s, double now[3])
{
    const double h = s->cfg.controller.period_s, x = s->controller.x_num;
    now[1] = now[2] = 0.0;
    if (s->state == RTHYB_RUNNING) {
        const rthyb_numerical part = part_of(&s->controller);
        rthyb_interface at;
        rthyb_numerical_look(&part, &at);
        now[2] = (x - 2.0 * at.x1 + at.x2) / (h * h);
        now[1] = (x - at.x1) / h + 0.5 * h * now[2];
    } else if (!path_done(&s->path)) {
        path_along(&s->path, h, now);
    }
    now[0] = x;
}

/* Leaves whatever course it is on for the state, and stands as soon as it can. */
static void brake_in(rthyb_station *s, int state, int leg)
{
    double now[3];
    present(s, now);
    enter(s, state);
    s->leg = leg;
    const path_limits limits = limits_of(s);
    s->path = path_to_rest(&limits, now);
}

static void trip(rthyb_station *s, finding found)
{
    if (s->state == RTHYB_TRIPPED)
        return;
    blame(s, found);
    s->zeroing = 0;
    enter(s, RTHYB_TRIPPED);
    s->trip_frames = TRIP_FRAMES;
    s->reset_frames = 0;
}

static void ramp_out(rthyb_station *s, finding found)
{
    if (!is_moving(s->state))
        return;
    blame(s, found);
    brake_in(s, RTHYB_RAMP_OUT, 0);
}

/* On a way that a HOLD may leave: the test's own, or the one back to it. */
static int can_hold(const rthyb_station *s)
{
    return s->state == RTHYB_RUNNING || (s->state == RTHYB_HOLD && s->leg >= 2);
}

/* Where RESUME leads is where the test was left, however often its way there is held. */
static void hold(rthyb_station *s)
{
    if (s->state == RTHYB_RUNNING) {
        double left[3];
        present(s, left);
        s->resume_x = left[0];
        s->resume_v = left[1];
        s->resume_a = left[2];
    }
    s->interrupted = 1;
    brake_in(s, RTHYB_HOLD, 0);
}

static void resume(rthyb_station *s)
{
    const double from[3] = {s->controller.x_num, 0.0, 0.0};
    const double to[3] = {s->resume_x, s->resume_v, s->resume_a};
    s->path = plan(s, from, to);
    s->leg = 2;
}

static void ramp_to_zero(rthyb_station *s)
{
    const double x = s->controller.x_num;
    const path_limits limits = limits_of(s);
    const int64_t least = path_ramp_ticks(&limits, x), usual = s->cfg.ramp_in_ticks;
    s->path = path_ramp(x, 0.0, least > usual ? least : usual);
    s->leg = 0;
}

/* The limits of the path that runs were drawn in: brakes to rest within them; `arrive` begins the rest of
 * the way anew. */
static void begin_anew(rthyb_station *s)
{
    if (s->state == RTHYB_RAMP_IN)
        brake_in(s, RTHYB_RAMP_IN, 1);
    else if (s->state == RTHYB_HOLD)
        brake_in(s, RTHYB_HOLD, s->leg >= 2 ? 3 : 0);
    else if (s->state == RTHYB_RAMP_OUT)
        brake_in(s, RTHYB_RAMP_OUT, 0);
}

int rthyb_station_adopt(rthyb_station *s, const rthyb_parameters *p)
{
    if (s->state != RTHYB_IDLE && switches_off(s, p))
        return 0;
    const double before[] = {path_velocity(s), path_acceleration(s), brake_acceleration(s)};
    rthyb_controller_config *both[] = {&s->cfg.controller, &s->controller.cfg};
    for (int i = 0; i < 2; i++) {
        both[i]->velocity_limit_m_per_s = p->velocity_limit_m_per_s;
        both[i]->acceleration_limit_m_per_s2 = p->acceleration_limit_m_per_s2;
        both[i]->estimate_held = !p->adapt;
    }
    memcpy(s->cfg.watch, p->watch, sizeof s->cfg.watch);
    s->cfg.path_velocity_m_per_s = p->path_velocity_m_per_s;
    s->cfg.path_acceleration_m_per_s2 = p->path_acceleration_m_per_s2;
    s->cfg.brake_acceleration_m_per_s2 = p->brake_acceleration_m_per_s2;
    s->controller.generation = p->generation;
    if (!path_done(&s->path) && (path_velocity(s) < before[0] || path_acceleration(s) < before[1] ||
                                 brake_acceleration(s) < before[2]))
        begin_anew(s);
    return 1;
}

static void react(rthyb_station *s, finding found, int reaction)
{
    /* While ramping in there is no course yet that could be resumed. */
    const int ends_it = (reaction == RTHYB_REACT_RAMP_OUT && is_moving(s->state)) ||
                        (reaction == RTHYB_REACT_HOLD && s->state == RTHYB_RAMP_IN);
    if (reaction == RTHYB_REACT_TRIP) {
        trip(s, found);
    } else if (ends_it) {
        ramp_out(s, found);
    } else if (reaction == RTHYB_REACT_HOLD && can_hold(s)) {
        blame(s, found);
        hold(s);
    } else if (reaction != RTHYB_REACT_NONE) {
        s->indicated |= 1u << found.cause;
    }
}

/* Whether something lies beyond a limit that takes a test off its course; *found says what. */
static int ends_beyond(const rthyb_station *s, int cause, double value, finding *found)
{
    const rthyb_watch *watch = &s->cfg.watch[cause];
    if (watch->reaction < RTHYB_REACT_HOLD || !(watch->value > 0.0) ||
        !(fabs(value) > watch->value))
        return 0;
    *found = (finding){cause, value, watch->value};
    return 1;
}

static int overloaded(const rthyb_station *s, const rthyb_axis *a, double f_n, finding *found)
{
    return (s->tared && ends_beyond(s, RTHYB_CAUSE_FORCE, f_n - a->tare_f, found)) ||
           ends_beyond(s, RTHYB_CAUSE_RIG_FORCE, f_n, found);
}

/* What a test would be taken off its course for before it has begun. A reading at the end of its range
 * says nothing of what lies beyond. */
static int axis_not_at_rest(const rthyb_station *s, int i, finding *found)
{
    const rthyb_axis *a = &s->axis[i];
    const double x = a->seen_x - a->tare_x;
    if (a->off_scale & AXIS_OFF_F) {
        *found = (finding){RTHYB_CAUSE_FORCE, a->told_f, s->cfg.axis[i].f_range_n};
        return 1;
    }
    if (a->off_scale & AXIS_OFF_X) {
        *found = (finding){RTHYB_CAUSE_POSITION, a->told_x, s->cfg.axis[i].x_range_m};
        return 1;
    }
    return overloaded(s, a, a->seen_f, found) ||
           ends_beyond(s, RTHYB_CAUSE_TRACKING, x - s->controller.x_num - a->gap, found) ||
           ends_beyond(s, RTHYB_CAUSE_POSITION, x, found) ||
           ends_beyond(s, RTHYB_CAUSE_RIG_POSITION, x + a->tare_cmd, found);
}

static int not_at_rest(const rthyb_station *s, finding *found)
{
    for (int i = 0; i < RTHYB_AXES; i++)
        if (axis_not_at_rest(s, i, found))
            return 1;
    return 0;
}

/* The drive does not hold the specimen where it was told to. */
static int has_wandered(const rthyb_station *s, finding *found)
{
    for (int i = 0; i < RTHYB_AXES; i++) {
        const rthyb_axis *a = &s->axis[i];
        const double away = a->seen_x - a->tare_x - s->controller.x_cmd - a->gap;
        const double most = START_SPREADS * s->cfg.axis[i].rest_spread_m;
        if (!(fabs(away) > most))
            continue;
        *found = (finding){RTHYB_CAUSE_TRACKING, away, most};
        return 1;
    }
    return 0;
}

static int refuse(rthyb_station *s, finding found)
{
    s->refused_cause = found.cause;
    s->refused_value = found.value;
    s->refused_limit = found.limit;
    return 0;
}

/* Back to the state of a fresh start; what a recording needs of the last test stays readable until
 * then. Tare survives, the reading survives, and so does the command: the ramp begins where the drive was
 * told to be, for what lies between that and the reading would leave in one step. */
static void begin_test(rthyb_station *s)
{
    const uint32_t generation = s->controller.generation;
    const double x = s->controller.x_cmd;
    (void)fresh_controller(s);
    s->controller.generation = generation;
    s->test_tick = 0;
    s->interrupted = 0;
    forget_cause(s);
    s->indicated = 0;
    s->indicator_slope = 0.0;
    for (int i = 0; i < RTHYB_AXES; i++)
        s->axis[i].over_f = s->axis[i].over_rig_f = (rthyb_overload){.seen = s->tick};
    s->losses = (rthyb_recent){.count = 0};
    settle(s, x);
    s->controller.x_m1 = s->axis[0].seen_x - s->axis[0].tare_x;
    enter(s, RTHYB_RAMP_IN);
    ramp_to_zero(s);
}

static void begin_zero(rthyb_station *s)
{
    enter(s, RTHYB_IDLE);
    s->zeroing = 1;
    s->tare_readings = 0;
    for (int i = 0; i < RTHYB_AXES; i++)
        axis_begin_tare(&s->axis[i]);
}

/* Where a command may go: the test's limit about the tare, the rig's about the drive's own zero. */
typedef struct {
    double low, high;
} range;

static double farthest(const rthyb_station *s, int cause)
{
    const rthyb_watch *watch = &s->cfg.watch[cause];
    const int ends = watch->reaction >= RTHYB_REACT_HOLD && watch->value > 0.0;
    return ends ? watch->value : HUGE_VAL;
}

static range reach(const rthyb_station *s)
{
    const double own = farthest(s, RTHYB_CAUSE_POSITION);
    const double rig = farthest(s, RTHYB_CAUSE_RIG_POSITION);
    const double zero = s->axis[0].tare_cmd;
    return (range){fmax(-own, -rig - zero), fmin(own, rig - zero)};
}

/* A drive takes up where it stands: it must stand, and where must be known. What pulls at the specimen
 * beyond the rig's own limit would trip it again at once. At rest there is nothing to reset but a drive
 * that has stopped by itself. */
static int can_reset(rthyb_station *s, const rthyb_station_input *in)
{
    finding found;
    const int trips = s->cfg.watch[RTHYB_CAUSE_RIG_FORCE].reaction == RTHYB_REACT_TRIP;
    if (s->state == RTHYB_IDLE && (!in->drive_stopped || s->zeroing == 1))
        return 0;
    if (!is_sound(s, in))
        return 0;
    int rests = !in->link_down && s->in_state >= s->ticks.rest;
    for (int i = 0; i < RTHYB_AXES; i++) {
        const rthyb_axis *a = &s->axis[i];
        if (trips && ends_beyond(s, RTHYB_CAUSE_RIG_FORCE, in->axis[i].f_n, &found))
            return refuse(s, found);
        rests = rests && a->rest_ticks >= s->ticks.rest &&
                fabs(in->axis[i].x_m - a->rest_x) <= s->cfg.axis[i].rest_spread_m;
    }
    return rests;
}

/* What leads to motion needs a drive at the other end that follows. */
static int needs_drive(int command)
{
    return command == RTHYB_CMD_ZERO || command == RTHYB_CMD_ARM || command == RTHYB_CMD_START;
}

/* Obeys an operator; 0 if the command is not for this state, or cannot be carried out. */
static int obey(rthyb_station *s, const rthyb_station_input *in)
{
    finding found = plain(RTHYB_CAUSE_NONE);
    if (in->command == RTHYB_CMD_NONE)
        return 1;
    (void)refuse(s, found);
    if (!rthyb_command_allowed(s->state, in->command) ||
        (needs_drive(in->command) && (in->link_down || in->drive_stopped)))
        return 0;
    switch (in->command) {
    case RTHYB_CMD_ZERO:
        begin_zero(s);
        break;
    case RTHYB_CMD_ARM:
        if (not_at_rest(s, &found))
            return refuse(s, found);
        enter(s, RTHYB_ARMED);
        break;
    case RTHYB_CMD_START:
        if (not_at_rest(s, &found) || has_wandered(s, &found))
            return refuse(s, found);
        if (!s->seen || s->controller.missing)
            return 0;
        begin_test(s);
        break;
    case RTHYB_CMD_HOLD:
        if (can_hold(s))
            hold(s);
        break;
    case RTHYB_CMD_RESUME:
        if (overloaded(s, &s->axis[0], s->controller.f1 + s->axis[0].tare_f, &found))
            return refuse(s, found);
        if (s->leg != 1)
            return 0;
        resume(s);
        break;
    case RTHYB_CMD_STOP:
        if (is_moving(s->state)) {
            ramp_out(s, plain(RTHYB_CAUSE_OPERATOR));
        } else if (s->state != RTHYB_RAMP_OUT) {
            s->zeroing = 0;
            enter(s, RTHYB_IDLE);
        }
        break;
    case RTHYB_CMD_RESET:
        if (!can_reset(s, in))
            return 0;
        enter(s, RTHYB_IDLE);
        forget_cause(s);
        s->tared = 0;
        settle_at(s, in->axis[0].x_m);
        s->reset_frames = RESET_FRAMES;
        break;
    default:
        trip(s, plain(RTHYB_CAUSE_SIGNAL));
        break;
    }
    return 1;
}

/* ---- one tick --------------------------------------------------------------------------------- */

/* Keeps the bit of each tick of the last second. */
static void remember(rthyb_recent *recent, uint64_t tick, uint32_t length, int is_set)
{
    const uint64_t at = tick % length;
    uint64_t *word = &recent->map[at / 64];
    const uint64_t bit = (uint64_t)1 << (at % 64);
    recent->count += (uint32_t)(is_set != 0) - (uint32_t)((*word & bit) != 0);
    *word = is_set ? *word | bit : *word & ~bit;
}

static double share_of(const rthyb_station *s, const rthyb_recent *recent)
{
    return (double)recent->count / s->ticks.recent;
}

static void note_tick(rthyb_station *s, int was_skipped)
{
    remember(&s->skips, s->tick, s->ticks.recent, was_skipped);
    remember(&s->losses, s->tick, s->ticks.recent, !was_skipped && s->controller.missing > 0);
    s->skipped += (uint64_t)(was_skipped != 0);
    s->tick++;
    s->in_state++;
}

/* Mean of tare_ticks readings, of all axes over the same ticks, unless they move; a tick without one is none
 * of them. */
static void take_tare(rthyb_station *s, const rthyb_station_input *in)
{
    const rthyb_axis_config *cfg = s->cfg.axis;
    finding found = plain(RTHYB_CAUSE_NONE);
    for (int i = 0; i < RTHYB_AXES; i++)
        if (!axis_add_to_tare(&s->axis[i], &cfg[i], &in->axis[i])) {
            s->zeroing = 2;
            return;
        }
    if (++s->tare_readings < s->cfg.tare_ticks)
        return;
    (void)refuse(s, found);
    for (int i = 0; i < RTHYB_AXES; i++) {
        const rthyb_axis *a = &s->axis[i];
        if (axis_is_far_off(&cfg[i], a->sum_x / s->cfg.tare_ticks, a->sum_f / s->cfg.tare_ticks,
                            &found)) {
            (void)refuse(s, found);
            s->zeroing = 3;
            return;
        }
    }
    for (int i = 0; i < RTHYB_AXES; i++) {
        rthyb_axis *a = &s->axis[i];
        settle(s, axis_take_tare(a, a->sum_x / s->cfg.tare_ticks, a->sum_f / s->cfg.tare_ticks,
                                 s->controller.x_cmd + a->tare_cmd, s->commands));
    }
    s->tared = 1;
    s->commands = 1;
    s->zeroing = 0;
    enter(s, RTHYB_ZEROED);
}

/* The next displacement where it comes from a path; NULL while the equation of motion gives it. */
static const double *next_on_path(rthyb_station *s, double *x)
{
    *x = s->controller.x_num;
    if (s->state == RTHYB_RUNNING)
        return NULL;
    const int on_the_way = s->state == RTHYB_RAMP_IN || s->state == RTHYB_RAMP_OUT ||
                           (s->state == RTHYB_HOLD && s->leg != 1);
    if (on_the_way)
        *x = path_follow(&s->path, s->cfg.controller.period_s);
    return x;
}

/* Whether the command is where its path has ended, and stands: one that swings is there in passing. One
 * that comes no nearer is given up: what keeps it away, a limit of the command or a compensator that swings,
 * would keep the state for ever. */
static int has_arrived(rthyb_station *s)
{
    const rthyb_controller *c = &s->controller;
    const range within = reach(s);
    /* What brakes in front of a limit ends at it. */
    const double aim = fmin(fmax(c->x_plc, within.low), within.high);
    const double off = fmax(fabs(c->x_lim - aim), fabs(c->x_plc - c->x_num));
    /* What it still goes, in 1/1024 s at any rate. */
    const double away = fmax(off, fabs(c->x_lim - c->x_lim1) * s->ticks.pace);
    if (away <= ARRIVED_M)
        return 1;
    if (away < s->nearest_m - ARRIVED_M) {
        s->nearest_m = away;
        s->no_nearer = 0;
    } else if (++s->no_nearer >= s->ticks.arrival) {
        trip(s, (finding){RTHYB_CAUSE_NOT_ARRIVED, away, ARRIVED_M});
    }
    return 0;
}

/* What comes after the end of a path. At rest the compensator and the limiter have to be through as
 * well; until then everything is watched as on the way. */
static void arrive(rthyb_station *s)
{
    const int waits = (s->state == RTHYB_RAMP_IN && s->leg == 0) ||
                      (s->state == RTHYB_RAMP_OUT && s->leg == 1) ||
                      (s->state == RTHYB_RAMP_OUT && s->cfg.stay);
    if (!path_done(&s->path) || (waits && !has_arrived(s)))
        return;
    if (s->state == RTHYB_RAMP_IN && s->leg == 1) {
        ramp_to_zero(s);
    } else if (s->state == RTHYB_HOLD && s->leg == 3) {
        resume(s);
    } else if (s->state == RTHYB_RAMP_IN || (s->state == RTHYB_HOLD && s->leg == 2)) {
        enter(s, RTHYB_RUNNING);
    } else if (s->state == RTHYB_HOLD) {
        s->leg = 1;
    } else if (s->state == RTHYB_RAMP_OUT && s->leg == 0 && !s->cfg.stay) {
        const double from[3] = {s->controller.x_num, 0.0, 0.0}, rest[3] = {0.0, 0.0, 0.0};
        s->path = plan(s, from, rest);
        s->leg = 1;
    } else if (s->state == RTHYB_RAMP_OUT) {
        /* At rest nothing confines it: what a limit has kept it from is not gone to after all. */
        if (fabs(s->controller.x_lim - s->controller.x_plc) > ARRIVED_M)
            settle(s, s->controller.x_lim);
        enter(s, RTHYB_IDLE);
    }
}

/* Does what is to be done; returns what the record says of that: `bit`, and the trip. */
static int react_to(rthyb_station *s, finding found, int reaction, int bit)
{
    react(s, found, reaction);
    return reaction == RTHYB_REACT_TRIP ? bit | RTHYB_S_TRIP : bit;
}

/* Reacts to a limit that is exceeded. */
static int check(rthyb_station *s, int cause, double value, int bit)
{
    const rthyb_watch *watch = &s->cfg.watch[cause];
    if (watch->reaction == RTHYB_REACT_NONE || !(watch->value > 0.0) ||
        !(fabs(value) > watch->value))
        return RTHYB_OK;
    return react_to(s, (finding){cause, value, watch->value}, watch->reaction, bit);
}

/* Where nothing is left that a hold or a ramp-out would do: at rest, held, on the way out. */
static int is_off_course(int state)
{
    return state != RTHYB_RAMP_IN && state != RTHYB_RUNNING;
}

/* A force beyond its limit. What is to hold or to ramp out has nothing left but a trip where the force stays,
 * or grows, in spite of it. One at the end of the sensor's range may be any force. */
static int check_force(rthyb_station *s, int i, int cause, double value, rthyb_overload *over)
{
    const rthyb_watch *watch = &s->cfg.watch[cause];
    const rthyb_axis *a = &s->axis[i];
    const int off_scale = a->off_scale & AXIS_OFF_F;
    if (watch->reaction == RTHYB_REACT_NONE || !(watch->value > 0.0))
        return RTHYB_OK;
    const int is_beyond = off_scale || fabs(value) > watch->value;
    const uint64_t gone = s->tick - over->seen;
    over->seen = s->tick;
    axis_count_overload(over, gone < s->ticks.lost ? gone : s->ticks.lost, is_beyond,
                        is_off_course(s->state), s->ticks.overload);
    if (!is_beyond)
        return RTHYB_OK;
    const int too_much =
        off_scale || fabs(value) > OVERLOAD * watch->value || over->ticks >= s->ticks.overload;
    const int escalates =
        watch->reaction >= RTHYB_REACT_HOLD && is_off_course(s->state) && too_much;
    const finding found = off_scale ? (finding){cause, a->told_f, s->cfg.axis[i].f_range_n}
                                    : (finding){cause, value, watch->value};
    return react_to(s, found, escalates ? RTHYB_REACT_TRIP : watch->reaction, RTHYB_S_FORCE_LIMIT);
}

static int check_forces(rthyb_station *s, const rthyb_record *r)
{
    int code = RTHYB_OK;
    for (int i = 0; i < RTHYB_AXES; i++) {
        rthyb_axis *a = &s->axis[i];
        /* The reading counts though its pair was not taken: what pulls at the specimen need not be
         * smooth. */
        const double f = s->told ? a->told_f - a->tare_f : r->axis[i].f_meas_n;
        if (s->tared)
            code |= check_force(s, i, RTHYB_CAUSE_FORCE, f, &a->over_f);
        code |= check_force(s, i, RTHYB_CAUSE_RIG_FORCE, f + a->tare_f, &a->over_rig_f);
    }
    return code;
}

static int is_off_scale(const rthyb_station *s)
{
    int bits = 0;
    for (int i = 0; i < RTHYB_AXES; i++)
        bits |= s->axis[i].off_scale;
    return bits;
}

/* A displacement at the end of its sensor's range is as one beyond the position limit. */
static int check_off_scale(rthyb_station *s)
{
    int code = RTHYB_OK;
    const int causes[] = {RTHYB_CAUSE_RIG_POSITION, RTHYB_CAUSE_POSITION};
    for (int i = 0; i < RTHYB_AXES; i++) {
        const rthyb_axis *a = &s->axis[i];
        for (int j = 0; j < 2 && a->off_scale & AXIS_OFF_X; j++) {
            const rthyb_watch *watch = &s->cfg.watch[causes[j]];
            const finding found = {causes[j], a->told_x, s->cfg.axis[i].x_range_m};
            if (watch->reaction != RTHYB_REACT_NONE && watch->value > 0.0)
                code |= react_to(s, found, watch->reaction, RTHYB_S_POSITION_LIMIT);
        }
    }
    return code;
}

static int check_tracking(rthyb_station *s, const rthyb_record *r, int at_rest)
{
    int code = RTHYB_OK;
    for (int i = 0; i < RTHYB_AXES; i++) {
        const double gap = at_rest ? s->axis[i].gap : 0.0;
        code |= check(s, RTHYB_CAUSE_TRACKING, r->axis[i].x_meas_m - r->x_num_m - gap,
                      RTHYB_S_TRACKING_LIMIT);
    }
    return code;
}

/* Commands leave, and nothing moves: a force, or a drive that lets go of where it was told to be. What was
 * never zeroed has no zero to be far from. */
static void watch_at_rest(rthyb_station *s, rthyb_record *r)
{
    if (!s->seen || s->drive_stands || (s->controller.missing && !is_off_scale(s)))
        return;
    int code = r->code | check_forces(s, r) | check_off_scale(s);
    if (s->tared)
        code |= check_tracking(s, r, 1);
    r->code = (uint16_t)code;
}

/* The limits that are watched while something moves. */
static void watch_limits(rthyb_station *s, rthyb_record *r, double indicator_before)
{
    const rthyb_controller *c = &s->controller;
    const double h = s->cfg.controller.period_s;
    const double slope = (r->tracking_indicator_m2 - indicator_before) / h;
    s->indicator_slope += (slope - s->indicator_slope) * fmin(h / 0.25, 1.0);
    int code = r->code;
    code |= check(s, RTHYB_CAUSE_POSITION, c->x_plc, RTHYB_S_POSITION_LIMIT);
    code |=
        check(s, RTHYB_CAUSE_RIG_POSITION, c->x_plc + s->axis[0].tare_cmd, RTHYB_S_POSITION_LIMIT);
    code |= check_off_scale(s);
    code |= check(s, RTHYB_CAUSE_VELOCITY, (c->x_plc - r->x_plc_m) / h, RTHYB_S_VELOCITY_LIMIT);
    code |= check(s, RTHYB_CAUSE_INCREMENT, c->x_cmd - r->axis[0].x_cmd_m, RTHYB_S_INCREMENT_LIMIT);
    code |= check_forces(s, r);
    code |= check_tracking(s, r, 0);
    code |= check(s, RTHYB_CAUSE_INDICATOR, s->indicator_slope, RTHYB_S_INDICATOR_LIMIT);
    code |= check(s, RTHYB_CAUSE_ENERGY, r->energy_error_j, RTHYB_S_ENERGY_LIMIT);
    code |= check(s, RTHYB_CAUSE_LOST_WARNING, share_of(s, &s->losses), RTHYB_S_LOST_RATE);
    code |= check(s, RTHYB_CAUSE_LOST_PAIRS, share_of(s, &s->losses), RTHYB_S_LOST_RATE);
    r->code = (uint16_t)code;
}

/* A sensor that repeats itself while the command has moved on. */
static void watch_stuck(rthyb_station *s, int i, int cause, rthyb_stillness *still, double reading)
{
    const rthyb_watch *watch = &s->cfg.watch[cause];
    if (axis_is_stuck(still, reading, s->controller.x_cmd, is_moving(s->state), watch->value,
                      s->cfg.axis[i].rest_spread_m))
        s->noted |= react_to(s, (finding){cause, (double)still->ticks, watch->value},
                             watch->reaction, RTHYB_S_SENSOR_STUCK);
}

/* 1 unless a sensor leapt. In ticks without a pair the specimen may have moved on, in each by as much as
 * in one. Another level is believed when it stays, unless a leap is to end the test. */
static int is_steady(rthyb_station *s, int cause, rthyb_leaps *leaps, double seen, double reading)
{
    const rthyb_watch *watch = &s->cfg.watch[cause];
    const double most = watch->value * ((double)s->controller.missing + 1.0);
    const double leap = reading - seen;
    int good = 1;
    if (s->seen && watch->value > 0.0 && fabs(leap) > most) {
        s->noted |= react_to(s, (finding){cause, leap, most}, watch->reaction, RTHYB_S_SENSOR_JUMP);
        const int ends_test = watch->reaction >= RTHYB_REACT_RAMP_OUT && s->state != RTHYB_IDLE &&
                              s->state != RTHYB_TRIPPED;
        good = axis_count_leaps(leaps, reading, watch->value) >= JUMP_TAKEN && !ends_test;
    }
    if (good)
        leaps->count = 0;
    return good;
}

/* A pair of which one half leaps is not taken, nor are those of the other axes then; 1 if it is. */
static int plausible(rthyb_station *s, const rthyb_station_input *in)
{
    int good = 1;
    for (int i = 0; i < RTHYB_AXES; i++) {
        rthyb_axis *a = &s->axis[i];
        finding found;
        const double x = in->axis[i].x_m, f = in->axis[i].f_n;
        good &= is_steady(s, RTHYB_CAUSE_SENSOR_JUMP, &a->leaps_x, a->seen_x, x);
        /* A force beyond its limit is that first, however it came there. */
        if (!overloaded(s, a, f, &found))
            good &= is_steady(s, RTHYB_CAUSE_FORCE_JUMP, &a->leaps_f, a->seen_f, f);
    }
    return good;
}

static void note_reading(rthyb_station *s, const rthyb_station_input *in)
{
    const int ceased = s->controller.missing >= s->ticks.lost;
    for (int i = 0; i < RTHYB_AXES; i++) {
        rthyb_axis *a = &s->axis[i];
        const double x = in->axis[i].x_m, f = in->axis[i].f_n;
        watch_stuck(s, i, RTHYB_CAUSE_SENSOR_STUCK, &a->still_x, x);
        watch_stuck(s, i, RTHYB_CAUSE_FORCE_STUCK, &a->still_f, f);
        axis_watch_rest(a, x, s->cfg.axis[i].rest_spread_m, ceased, s->ticks.rest);
    }
    if (!s->seen && !s->commands)
        settle_at(s, in->axis[0].x_m);
    s->seen = 1;
    for (int i = 0; i < RTHYB_AXES; i++) {
        s->axis[i].seen_x = in->axis[i].x_m;
        s->axis[i].seen_f = in->axis[i].f_n;
    }
    if (s->zeroing == 1)
        take_tare(s, in);
}

/* Where the command ends in spite of everything: what a limit takes off its course must not have left
 * first. It holds from START on; before the tare there is no zero that it could be counted from. */
static void confine_command(rthyb_station *s)
{
    rthyb_controller_config *cfg = &s->controller.cfg;
    const range within = reach(s);
    const int counts = is_on_its_way(s->state) && within.high < HUGE_VAL;
    /* Limits that leave nothing between them bring it to where they meet. */
    cfg->clamp_m = counts ? fmax(0.5 * (within.high - within.low), ARRIVED_M) : 0.0;
    cfg->clamp_centre_m = counts ? 0.5 * (within.high + within.low) : 0.0;
}

/* How far out the wire may round a command: not across the limit, nor further out than one that is beyond
 * it already. What a trip repeats has left before. */
static range wire_bounds(const rthyb_station *s)
{
    const double x = s->controller.x_cmd;
    const range within = reach(s);
    if (!s->commands || s->state == RTHYB_TRIPPED)
        return (range){-HUGE_VAL, HUGE_VAL};
    const double zero = s->axis[0].tare_cmd;
    return (range){zero + fmin(within.low, x), zero + fmax(within.high, x)};
}

/* A trip that its own record shows. */
static void trip_at(rthyb_station *s, finding found, int bit, rthyb_record *record)
{
    if (s->state == RTHYB_TRIPPED)
        return;
    record->code |= (uint16_t)(bit | RTHYB_S_TRIP);
    trip(s, found);
}

static void sample(rthyb_station *s, const rthyb_input *in, int blind, rthyb_record *record)
{
    const int tripped = s->state == RTHYB_TRIPPED, running = s->state == RTHYB_RUNNING;
    double x;
    const double *path = next_on_path(s, &x);
    const double sent = s->controller.x_cmd, indicator = s->controller.tracking_indicator;
    confine_command(s);
    const int code = rthyb_controller_sample(&s->controller, in, path, blind || tripped, record);
    if (tripped && !blind)
        record->flags &= ~(uint32_t)RTHYB_F_BLIND;
    if (running)
        s->test_tick++;
    if (is_on_its_way(s->state) && !blind)
        watch_limits(s, record, indicator);
    else if (!tripped && !blind)
        watch_at_rest(s, record);
    record->tick = s->tick;
    if (!blind && s->controller.missing >= s->ticks.lost && s->state != RTHYB_IDLE)
        trip_at(s, (finding){RTHYB_CAUSE_LINK_LOST, s->controller.missing, s->ticks.lost},
                RTHYB_S_LINK_LOST, record);
    if (code & RTHYB_S_NOT_FINITE)
        trip_at(s, plain(RTHYB_CAUSE_NOT_FINITE), RTHYB_S_NOT_FINITE, record);
    /* An arrival moves the command to its goal: not in a tick that sends nothing. */
    if (s->state != RTHYB_TRIPPED && !blind)
        arrive(s);
    if (s->state == RTHYB_TRIPPED)
        s->controller.x_cmd = s->controller.x_lim = sent;
    s->controller.state = s->state;
    record->cause = (uint32_t)s->cause;
}

static rthyb_input at_tick(const rthyb_station *s, const double *ag, size_t n)
{
    const int running = s->state == RTHYB_RUNNING && s->test_tick < n;
    return (rthyb_input){.excitation = running ? ag[s->test_tick] : 0.0, .lost = RTHYB_LOST};
}

/* A row of skipped ticks, and their share of the last second. */
static void watch_skips(rthyb_station *s, uint32_t skipped)
{
    const double share = share_of(s, &s->skips), most = SKIPS_SHARE;
    if (skipped >= s->ticks.lost) {
        trip(s, (finding){RTHYB_CAUSE_STALLED, skipped, s->ticks.lost});
    } else if (skipped > s->ticks.skips) {
        ramp_out(s, (finding){RTHYB_CAUSE_SKIPS, skipped, s->ticks.skips});
    } else if (is_on_its_way(s->state)) {
        s->noted |= check(s, RTHYB_CAUSE_SKIP_WARNING, share, RTHYB_S_SKIP_RATE);
        if (s->cfg.watch[RTHYB_CAUSE_SKIPS].value > 0.0)
            s->noted |= check(s, RTHYB_CAUSE_SKIPS, share, RTHYB_S_SKIP_RATE);
        else if (share > most)
            ramp_out(s, (finding){RTHYB_CAUSE_SKIPS, share, most});
    }
}

/* Makes up for skipped ticks: extrapolated, nothing learnt, nothing sent. */
static uint32_t blind_steps(rthyb_station *s, uint32_t skipped, const double *ag, size_t n,
                            rthyb_record *records)
{
    const uint32_t made_up = skipped < s->ticks.lost ? skipped : s->ticks.lost;
    /* More than the map of recent ticks holds are only counted: a long sleep is no long loop. */
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
    if (in->link_down && s->state != RTHYB_IDLE)
        trip(s, plain(RTHYB_CAUSE_LINK_DOWN));
    if (in->drive_stopped && s->state != RTHYB_IDLE)
        trip(s, plain(RTHYB_CAUSE_DRIVE_STOPPED));
    if (in->beyond && s->state != RTHYB_IDLE)
        trip(s, (finding){RTHYB_CAUSE_POSITION, s->controller.x_cmd,
                          s->cfg.watch[RTHYB_CAUSE_POSITION].value});
    if (in->heartbeat_late)
        ramp_out(s, plain(RTHYB_CAUSE_HEARTBEAT));
    if (s->state == RTHYB_RUNNING && s->test_tick >= n)
        ramp_out(s, plain(RTHYB_CAUSE_COMPLETED));
    if (s->state == RTHYB_ARMED && s->in_state >= (uint64_t)s->cfg.armed_ticks)
        enter(s, RTHYB_ZEROED);
}

/* What the station was told in this tick, as the record shows it. */
static uint32_t told(const rthyb_station_input *in, int refused, int took_over)
{
    return (in->lost ? (uint32_t)RTHYB_F_LOST : 0u) |
           (in->link_down ? (uint32_t)RTHYB_F_DOWN : 0u) |
           (in->drive_stopped ? (uint32_t)RTHYB_F_STOPPED : 0u) |
           (in->heartbeat_late ? (uint32_t)RTHYB_F_SILENT : 0u) |
           (in->beyond ? (uint32_t)RTHYB_F_BEYOND : 0u) |
           (took_over ? (uint32_t)RTHYB_F_TAKEN_OVER : 0u) |
           (refused ? (uint32_t)RTHYB_F_REFUSED : 0u) |
           ((uint32_t)in->command & UINT8_MAX) << RTHYB_F_COMMAND_BIT;
}

/* The pair of this tick, as the controller gets it. */
static rthyb_input take_pair(rthyb_station *s, const rthyb_station_input *in, const double *ag,
                             size_t n)
{
    rthyb_input pair = at_tick(s, ag, n);
    pair.lost = in->lost;
    s->told = is_sensible(in);
    for (int i = 0; i < RTHYB_AXES; i++) {
        rthyb_axis *a = &s->axis[i];
        a->off_scale = s->told ? axis_off_scale(&s->cfg.axis[i], &in->axis[i]) : 0;
        a->told_x = in->axis[i].x_m;
        a->told_f = in->axis[i].f_n;
    }
    if (is_off_scale(s))
        pair.lost = RTHYB_LOST | RTHYB_S_OUT_OF_RANGE;
    else if (s->told && !plausible(s, in))
        pair.lost = RTHYB_LOST;
    else if (s->told)
        note_reading(s, in);
    pair.x_meas_m = in->axis[0].x_m - s->axis[0].tare_x;
    pair.f_meas_n = in->axis[0].f_n - s->axis[0].tare_f;
    return pair;
}

/* While the drive stands by itself the command goes where the specimen is, so that nothing leaps when it
 * is released. */
static void stand_by(rthyb_station *s, const rthyb_station_input *in)
{
    if (s->state == RTHYB_IDLE && in->drive_stopped && !s->controller.missing)
        settle_at(s, s->axis[0].seen_x);
}

/* With the first reading that is sound: what is taken over before would wait, unsent, for who knows how
 * long. 1 if it was taken over. */
static int take_over(rthyb_station *s, const rthyb_station_input *in)
{
    if (!in->taken_over || s->seen || !is_sound(s, in) ||
        judge(in->axis[0].x_cmd_m, RTHYB_DISPLACEMENT_MAX_M) != RTHYB_OK)
        return 0;
    settle(s, in->axis[0].x_cmd_m);
    s->commands = 1;
    return 1;
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

int rthyb_station_tick(rthyb_station *s, const rthyb_station_input *in, const double *ag_mps2,
                       size_t n, rthyb_record *records, rthyb_station_output *out)
{
    rthyb_station_advance(s);
    const int took_over = take_over(s, in);
    s->noted = RTHYB_OK;
    s->drive_stands = in->drive_stopped || in->link_down;
    const uint32_t made_up = blind_steps(s, in->skipped, ag_mps2, n, records);
    const int refused = !obey(s, in);
    watch_surroundings(s, in, n);
    const rthyb_input pair = take_pair(s, in, ag_mps2, n);
    sample(s, &pair, 0, &records[made_up]);
    stand_by(s, in);
    note_tick(s, 0);
    const range wire = wire_bounds(s);
    const int frame = s->state != RTHYB_TRIPPED || s->trip_frames > 0;
    *out = (rthyb_station_output){
        .axis = {{.x_cmd_m = s->controller.x_cmd + s->axis[0].tare_cmd,
                  .low_m = wire.low,
                  .high_m = wire.high}},
        .send = s->seen && frame,
        .state = s->state,
        .told = s->reset_frames > 0 ? RTHYB_TOLD_RESET : s->state,
        .refused = refused,
        .records = made_up + 1,
    };
    if (s->state == RTHYB_TRIPPED && s->trip_frames > 0)
        s->trip_frames--;
    s->reset_frames -= out->send && s->reset_frames > 0;
    if (s->cfg.law_channel_count > 0)
        (void)rthyb_law_report_beside(&s->controller.law, s->channel + s->cfg.law_channel,
                                      s->cfg.law_channel_count);
    rthyb_record *last = &records[made_up];
    last->code |= (uint16_t)s->noted;
    note_pair(last, in->axis[0].x_m, in->axis[0].f_n, in->lost);
    if (in->beyond && s->state == RTHYB_TRIPPED)
        last->code |= RTHYB_S_POSITION_LIMIT | RTHYB_S_TRIP;
    last->flags &= ~(uint32_t)RTHYB_F_NOT_SENT;
    last->flags |= (out->send ? 0u : (uint32_t)RTHYB_F_NOT_SENT) | told(in, refused, took_over);
    return 0;
}
