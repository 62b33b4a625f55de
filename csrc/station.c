/* States, limits and faults: what may happen when, and what happens when something goes wrong.
 *
 *   IDLE -> ZEROED -> ARMED -> RAMP_IN -> RUNNING (<-> HOLD) -> RAMP_OUT -> IDLE
 *   TRIPPED from anywhere: three more commands with the last position, then silence until RESET.
 *
 * The station decides which displacement comes next: the equation of motion while RUNNING, a path
 * of limited velocity and acceleration otherwise. The first cause that took a test off its course
 * is latched. Everything is a function of (state, input); the clock and the wire are elsewhere. */
#include <string.h>

#include "internal.h"
#include "numeric.h"

#define STANDARD_S (1.0 / 1024.0) /* a tick of real time */
#define JUMP_TAKEN 3              /* readings in a row that make a new level, at any rate */
#define ARRIVED_M 1e-6            /* what the command may lag behind at the end of a path */
#define OVERLOAD 1.5              /* times a force's limit: not even one tick */
#define START_SPREADS 5.0 /* times rest_spread_m: how far from the command START may find x_m */
#define SKIPS_SHARE (50.0 / 1024.0) /* of the last second, where nothing else is said */
#define OFF_X 1                     /* bits of off_scale */
#define OFF_F 2
#define TRIP_FRAMES 3
#define RESET_FRAMES 3  /* one that is lost does not matter */
#define SEARCH_STEPS 80 /* of 1.25 each: from 8 ms to longer than any test */

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
    if (!(c->tare_most_m >= 0.0 && c->tare_most_n >= 0.0))
        return RTHYB_E_LIMIT;
    if (c->law_channel > RTHYB_CHANNELS_MAX ||
        c->law_channel_count > RTHYB_CHANNELS_MAX - c->law_channel ||
        c->part_channel > RTHYB_CHANNELS_MAX ||
        c->part_channel_count > RTHYB_CHANNELS_MAX - c->part_channel)
        return RTHYB_E_LIMIT;
    const int ticks_ok = c->tare_ticks >= 1 && c->tare_ticks <= 1 << 20 && c->ramp_in_ticks >= 1 &&
                         c->ramp_in_ticks <= 1 << 24 && c->armed_ticks >= 1;
    return ticks_ok && c->rest_spread_m > 0.0 ? 0 : RTHYB_E_LIMIT;
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

/* ---- paths ------------------------------------------------------------------------------------ */

static int64_t whole_ticks(double duration_s, double h)
{
    return (int64_t)clamp(ceil(duration_s / h - 1e-9), 1.0, 1e15);
}

/* Quintic from (x0, v0, a0) to (x1, v1, a1) in so many ticks of h. */
static rthyb_path quintic(const double from[3], const double to[3], int64_t ticks, double h)
{
    const double T = (double)ticks * h;
    const double v0 = from[1] * T, a0 = from[2] * T * T, v1 = to[1] * T, a1 = to[2] * T * T;
    const double d = to[0] - from[0] - v0 - 0.5 * a0, e = v1 - v0 - a0, g = a1 - a0;
    return (rthyb_path){
        .c = {from[0], v0, 0.5 * a0, 10.0 * d - 4.0 * e + 0.5 * g, -15.0 * d + 7.0 * e - g,
              6.0 * d - 3.0 * e + 0.5 * g},
        .end = to[0],
        .ticks = ticks,
    };
}

/* x or its first or second derivative by u (order 0, 1, 2) of a polynomial path. */
static double polynomial(const rthyb_path *p, double u, int order)
{
    double sum = 0.0;
    for (int i = 5; i >= order; i--) {
        const double factor = order == 0 ? 1.0 : (order == 1 ? i : (double)i * (i - 1));
        sum = sum * u + factor * p->c[i];
    }
    return sum;
}

/* The largest share of the limits that a polynomial path takes; up to 1 it is within them. */
static double path_share(const rthyb_path *p, double h, double v_max, double a_max)
{
    const double T = (double)p->ticks * h;
    double share = 0.0;
    for (int i = 0; i <= 32; i++) {
        const double u = i / 32.0;
        share = fmax(share, fabs(polynomial(p, u, 1)) / (v_max * T));
        share = fmax(share, fabs(polynomial(p, u, 2)) / (a_max * T * T));
    }
    return share;
}

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

/* The shortest quintic, within a factor of 1.25, that keeps to the path limits; where the end states
 * themselves are beyond them, it keeps to their values. A way to a point that is near but left at speed may
 * be short of time and of room at once, and a longer one only swings the farther: then the one that exceeds
 * the limits least. */
static rthyb_path plan(const rthyb_station *s, const double from[3], const double to[3])
{
    const double h = s->cfg.controller.period_s;
    const double v = fmax(path_velocity(s), 1.01 * fmax(fabs(from[1]), fabs(to[1])));
    const double a = fmax(path_acceleration(s), 1.01 * fmax(fabs(from[2]), fabs(to[2])));
    double T = (double)s->ticks.least_way * h;
    rthyb_path best = quintic(from, to, whole_ticks(T, h), h);
    double least = path_share(&best, h, v, a);
    for (int i = 0; i < SEARCH_STEPS && least > 1.0; i++) {
        T *= 1.25;
        const rthyb_path path = quintic(from, to, whole_ticks(T, h), h);
        const double share = path_share(&path, h, v, a);
        best = share < least ? path : best;
        least = fmin(share, least);
    }
    return best;
}

/* Displacement, velocity and acceleration on a brake: its acceleration goes over into the deceleration,
 * stays, and goes over into 0. */
static void braked(const rthyb_path *p, double h, double now[3])
{
    const double turn = (double)p->turn * h, steady = (double)(p->ticks - 2 * p->turn) * h;
    const double lasts[3] = {turn, steady, turn}, ends[3] = {p->c[3], p->c[3], 0.0};
    double left = (double)p->elapsed * h;
    memcpy(now, p->c, 3 * sizeof now[0]);
    for (int i = 0; i < 3 && left > 0.0; i++) {
        const double t = fmin(left, lasts[i]);
        const double jerk = lasts[i] > 0.0 ? (ends[i] - now[2]) / lasts[i] : 0.0;
        now[0] += t * (now[1] + t * (0.5 * now[2] + t * jerk / 6.0));
        now[1] += t * (now[2] + 0.5 * t * jerk);
        now[2] += t * jerk;
        left -= t;
    }
}

/* Brakes from (x, v, a) to rest. A step of the acceleration would be a leap behind the phase lead: each
 * change takes `turn`, less for a motion that is over sooner: v = (b - a / 2) turn. What a has beyond the
 * limit b is cut off. */
static rthyb_path brake(const rthyb_station *s, const double from[3])
{
    const double h = s->cfg.controller.period_s, b = brake_acceleration(s), v = fabs(from[1]);
    const double a = clamp(from[1] < 0.0 ? -from[2] : from[2], -b, b);
    const int64_t turn =
        (int64_t)clamp(v / (b - 0.5 * a) / h, (double)s->ticks.least_turn, (double)s->ticks.turn);
    const double changes = (double)turn * h, rest = (v + 0.5 * a * changes) / b - changes;
    const int64_t steady = rest > 0.0 ? whole_ticks(rest, h) : 0;
    const double needed = (v + 0.5 * a * changes) / (changes + (double)steady * h);
    const double way = from[1] < 0.0 ? -1.0 : 1.0;
    rthyb_path path = {
        .c = {from[0], from[1], way * a, -way * needed},
        .ticks = 2 * turn + steady,
        .turn = turn,
    };
    double at_rest[3];
    path.elapsed = path.ticks;
    braked(&path, h, at_rest);
    path.elapsed = 0;
    path.end = at_rest[0];
    return path;
}

/* Half a wave of a raised cosine from a to b. */
static rthyb_path ramp(double a, double b, int64_t ticks)
{
    return (rthyb_path){.c = {0.5 * (a + b), 0.5 * (a - b)}, .end = b, .ticks = ticks, .cosine = 1};
}

/* Peak velocity pi/2 way/T and acceleration pi^2/2 way/T^2 of that wave within the path limits. */
static int64_t ramp_in_ticks(const rthyb_station *s, double way)
{
    const double h = s->cfg.controller.period_s, size = fabs(way);
    const double by_velocity = 0.5 * RTHYB_PI * size / path_velocity(s);
    const double by_acceleration = RTHYB_PI * sqrt(0.5 * size / path_acceleration(s));
    const int64_t least = whole_ticks(fmax(by_velocity, by_acceleration), h);
    return least > s->cfg.ramp_in_ticks ? least : s->cfg.ramp_in_ticks;
}

static int path_done(const rthyb_path *p)
{
    return p->elapsed >= p->ticks;
}

/* Displacement, velocity and acceleration where a path is now. */
static void along(const rthyb_path *p, double h, double now[3])
{
    const double T = (double)p->ticks * h, u = (double)p->elapsed / (double)p->ticks;
    const double turned = RTHYB_PI * u, size = p->c[1], rate = RTHYB_PI / T;
    if (p->turn > 0) {
        braked(p, h, now);
    } else if (p->cosine) {
        now[0] = p->c[0] + size * cos(turned);
        now[1] = -size * rate * sin(turned);
        now[2] = -size * rate * rate * cos(turned);
    } else {
        now[0] = polynomial(p, u, 0);
        now[1] = polynomial(p, u, 1) / T;
        now[2] = polynomial(p, u, 2) / (T * T);
    }
}

/* The displacement of the next tick. */
static double follow(rthyb_path *p, double h)
{
    if (!path_done(p))
        p->elapsed++;
    if (path_done(p))
        return p->end;
    double now[3];
    along(p, h, now);
    return now[0];
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

/* A cause with what was met and what is allowed; both 0 where it has no number. */
typedef struct {
    int cause;
    double value, limit;
} finding;

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

/* A reading at the very end of the sensor's range is a sensor that cannot say more; that end knows
 * nothing of a tare. */
static int off_scale(const rthyb_station *s, const rthyb_station_input *in)
{
    const double x_range = s->cfg.controller.x_range_m, f_range = s->cfg.controller.f_range_n;
    return (x_range > 0.0 && fabs(in->x_m) >= x_range ? OFF_X : 0) |
           (f_range > 0.0 && fabs(in->f_n) >= f_range ? OFF_F : 0);
}

static int is_sensible(const rthyb_station_input *in)
{
    return !in->lost && judge(in->x_m, RTHYB_DISPLACEMENT_MAX_M) == RTHYB_OK &&
           judge(in->f_n, RTHYB_FORCE_MAX_N) == RTHYB_OK;
}

static int is_sound(const rthyb_station *s, const rthyb_station_input *in)
{
    return is_sensible(in) && !off_scale(s, in);
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
    settle(s, reading - s->tare_x);
    s->gap = 0.0;
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
        along(&s->path, h, now);
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
    s->path = brake(s, now);
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
    s->path = ramp(x, 0.0, ramp_in_ticks(s, x));
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

static int overloaded(const rthyb_station *s, double f_n, finding *found)
{
    return (s->tared && ends_beyond(s, RTHYB_CAUSE_FORCE, f_n - s->tare_f, found)) ||
           ends_beyond(s, RTHYB_CAUSE_RIG_FORCE, f_n, found);
}

/* What a test would be taken off its course for before it has begun. A reading at the end of its range
 * says nothing of what lies beyond. */
static int not_at_rest(const rthyb_station *s, finding *found)
{
    const rthyb_controller *c = &s->controller;
    const double x = s->seen_x - s->tare_x;
    if (s->off_scale & OFF_F) {
        *found = (finding){RTHYB_CAUSE_FORCE, s->told_f, c->cfg.f_range_n};
        return 1;
    }
    if (s->off_scale & OFF_X) {
        *found = (finding){RTHYB_CAUSE_POSITION, s->told_x, c->cfg.x_range_m};
        return 1;
    }
    return overloaded(s, s->seen_f, found) ||
           ends_beyond(s, RTHYB_CAUSE_TRACKING, x - c->x_num - s->gap, found) ||
           ends_beyond(s, RTHYB_CAUSE_POSITION, x, found) ||
           ends_beyond(s, RTHYB_CAUSE_RIG_POSITION, x + s->tare_cmd, found);
}

/* The drive does not hold the specimen where it was told to. */
static int has_wandered(const rthyb_station *s, finding *found)
{
    const double away = s->seen_x - s->tare_x - s->controller.x_cmd - s->gap;
    const double most = START_SPREADS * s->cfg.rest_spread_m;
    if (!(fabs(away) > most))
        return 0;
    *found = (finding){RTHYB_CAUSE_TRACKING, away, most};
    return 1;
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
    s->over_f = s->over_rig_f = (rthyb_overload){.seen = s->tick};
    s->losses = (rthyb_recent){.count = 0};
    settle(s, x);
    s->controller.x_m1 = s->seen_x - s->tare_x;
    enter(s, RTHYB_RAMP_IN);
    ramp_to_zero(s);
}

static void begin_zero(rthyb_station *s)
{
    enter(s, RTHYB_IDLE);
    s->zeroing = 1;
    s->tare_readings = 0;
    s->sum_x = s->sum_f = 0.0;
    s->low_x = RTHYB_DISPLACEMENT_MAX_M;
    s->high_x = -RTHYB_DISPLACEMENT_MAX_M;
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
    return (range){fmax(-own, -rig - s->tare_cmd), fmin(own, rig - s->tare_cmd)};
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
    if (is_sound(s, in) && trips && ends_beyond(s, RTHYB_CAUSE_RIG_FORCE, in->f_n, &found))
        return refuse(s, found);
    return !in->link_down && is_sound(s, in) && s->rest_ticks >= s->ticks.rest &&
           s->in_state >= s->ticks.rest && fabs(in->x_m - s->rest_x) <= s->cfg.rest_spread_m;
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
        if (overloaded(s, s->controller.f1 + s->tare_f, &found))
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
        settle_at(s, in->x_m);
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

/* A specimen that is bent, or a sensor that is off, by this much is not what zero should be. */
static int tare_too_large(rthyb_station *s, double x, double f)
{
    const double most_m = s->cfg.tare_most_m, most_n = s->cfg.tare_most_n;
    finding found = plain(RTHYB_CAUSE_NONE);
    if (most_n > 0.0 && fabs(f) > most_n)
        found = (finding){RTHYB_CAUSE_RIG_FORCE, f, most_n};
    else if (most_m > 0.0 && fabs(x) > most_m)
        found = (finding){RTHYB_CAUSE_RIG_POSITION, x, most_m};
    (void)refuse(s, found);
    return found.cause != RTHYB_CAUSE_NONE;
}

/* Mean of tare_ticks readings, unless they move; a tick without one is none of them. */
static void take_tare(rthyb_station *s, double x, double f)
{
    s->sum_x += x;
    s->sum_f += f;
    s->low_x = fmin(s->low_x, x);
    s->high_x = fmax(s->high_x, x);
    if (s->high_x - s->low_x > s->cfg.rest_spread_m) {
        s->zeroing = 2;
        return;
    }
    if (++s->tare_readings < s->cfg.tare_ticks)
        return;
    const double command = s->controller.x_cmd + s->tare_cmd;
    const double tare_x = s->sum_x / s->cfg.tare_ticks, tare_f = s->sum_f / s->cfg.tare_ticks;
    if (tare_too_large(s, tare_x, tare_f)) {
        s->zeroing = 3;
        return;
    }
    s->tare_x = tare_x;
    s->tare_f = tare_f;
    s->tared = 1;
    /* The drive stays where it is. Where an earlier tare has told already how far command and reading lie
     * apart, that is no way to go: every test would go it again. */
    s->tare_cmd = s->commands ? command : s->tare_x;
    settle(s, command - s->tare_cmd);
    s->gap = s->tare_cmd - command;
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
        *x = follow(&s->path, s->cfg.controller.period_s);
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

/* Counts the ticks of a force beyond its limit where a hold or a ramp-out does no more; what falls below it
 * for a while only, by its noise, begins no new count. */
static void count_overload(const rthyb_station *s, rthyb_overload *over, int is_beyond)
{
    const uint64_t gone = s->tick - over->seen, ticks = gone < s->ticks.lost ? gone : s->ticks.lost;
    over->seen = s->tick;
    over->calm = is_beyond ? 0 : over->calm + ticks;
    if (!is_off_course(s->state) || over->calm >= s->ticks.overload)
        over->ticks = 0;
    else if (is_beyond)
        over->ticks += ticks;
}

/* A force beyond its limit. What is to hold or to ramp out has nothing left but a trip where the force stays,
 * or grows, in spite of it. One at the end of the sensor's range may be any force. */
static int check_force(rthyb_station *s, int cause, double value, rthyb_overload *over)
{
    const rthyb_watch *watch = &s->cfg.watch[cause];
    const int off_scale = s->off_scale & OFF_F;
    if (watch->reaction == RTHYB_REACT_NONE || !(watch->value > 0.0))
        return RTHYB_OK;
    const int is_beyond = off_scale || fabs(value) > watch->value;
    count_overload(s, over, is_beyond);
    if (!is_beyond)
        return RTHYB_OK;
    const int too_much =
        off_scale || fabs(value) > OVERLOAD * watch->value || over->ticks >= s->ticks.overload;
    const int escalates =
        watch->reaction >= RTHYB_REACT_HOLD && is_off_course(s->state) && too_much;
    const finding found = off_scale ? (finding){cause, s->told_f, s->cfg.controller.f_range_n}
                                    : (finding){cause, value, watch->value};
    return react_to(s, found, escalates ? RTHYB_REACT_TRIP : watch->reaction, RTHYB_S_FORCE_LIMIT);
}

static int check_forces(rthyb_station *s, const rthyb_record *r)
{
    /* The reading counts though its pair was not taken: what pulls at the specimen need not be smooth. */
    const double f = s->told ? s->told_f - s->tare_f : r->axis[0].f_meas_n;
    int code = RTHYB_OK;
    if (s->tared)
        code = check_force(s, RTHYB_CAUSE_FORCE, f, &s->over_f);
    return code | check_force(s, RTHYB_CAUSE_RIG_FORCE, f + s->tare_f, &s->over_rig_f);
}

/* A displacement at the end of its sensor's range is as one beyond the position limit. */
static int check_off_scale(rthyb_station *s)
{
    int code = RTHYB_OK;
    const int causes[] = {RTHYB_CAUSE_RIG_POSITION, RTHYB_CAUSE_POSITION};
    for (int i = 0; i < 2 && s->off_scale & OFF_X; i++) {
        const rthyb_watch *watch = &s->cfg.watch[causes[i]];
        const finding found = {causes[i], s->told_x, s->cfg.controller.x_range_m};
        if (watch->reaction != RTHYB_REACT_NONE && watch->value > 0.0)
            code |= react_to(s, found, watch->reaction, RTHYB_S_POSITION_LIMIT);
    }
    return code;
}

/* Commands leave, and nothing moves: a force, or a drive that lets go of where it was told to be. What was
 * never zeroed has no zero to be far from. */
static void watch_at_rest(rthyb_station *s, rthyb_record *r)
{
    if (!s->seen || s->drive_stands || (s->controller.missing && !s->off_scale))
        return;
    int code = r->code | check_forces(s, r) | check_off_scale(s);
    if (s->tared)
        code |= check(s, RTHYB_CAUSE_TRACKING, r->axis[0].x_meas_m - r->x_num_m - s->gap,
                      RTHYB_S_TRACKING_LIMIT);
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
    code |= check(s, RTHYB_CAUSE_RIG_POSITION, c->x_plc + s->tare_cmd, RTHYB_S_POSITION_LIMIT);
    code |= check_off_scale(s);
    code |= check(s, RTHYB_CAUSE_VELOCITY, (c->x_plc - r->x_plc_m) / h, RTHYB_S_VELOCITY_LIMIT);
    code |= check(s, RTHYB_CAUSE_INCREMENT, c->x_cmd - r->axis[0].x_cmd_m, RTHYB_S_INCREMENT_LIMIT);
    code |= check_forces(s, r);
    code |=
        check(s, RTHYB_CAUSE_TRACKING, r->axis[0].x_meas_m - r->x_num_m, RTHYB_S_TRACKING_LIMIT);
    code |= check(s, RTHYB_CAUSE_INDICATOR, s->indicator_slope, RTHYB_S_INDICATOR_LIMIT);
    code |= check(s, RTHYB_CAUSE_ENERGY, r->energy_error_j, RTHYB_S_ENERGY_LIMIT);
    code |= check(s, RTHYB_CAUSE_LOST_WARNING, share_of(s, &s->losses), RTHYB_S_LOST_RATE);
    code |= check(s, RTHYB_CAUSE_LOST_PAIRS, share_of(s, &s->losses), RTHYB_S_LOST_RATE);
    r->code = (uint16_t)code;
}

/* A sensor that repeats itself while the command has moved on. */
static void watch_stuck(rthyb_station *s, int cause, rthyb_stillness *still, double reading)
{
    const double command = s->controller.x_cmd;
    if (reading != still->reading || !is_moving(s->state)) {
        *still = (rthyb_stillness){reading, command, 0};
        return;
    }
    still->ticks++;
    const rthyb_watch *watch = &s->cfg.watch[cause];
    if (watch->value > 0.0 && (double)still->ticks >= watch->value &&
        fabs(command - still->command) > s->cfg.rest_spread_m)
        s->noted |= react_to(s, (finding){cause, (double)still->ticks, watch->value},
                             watch->reaction, RTHYB_S_SENSOR_STUCK);
}

/* Another level is believed when it stays, unless a leap is to end the test. */
static int stays_there(const rthyb_station *s, rthyb_leaps *leaps, double level,
                       const rthyb_watch *watch)
{
    const int again = leaps->count > 0 && fabs(level - leaps->level) <= watch->value;
    leaps->count = again ? leaps->count + 1 : 1;
    leaps->level = level;
    const int ends_test = watch->reaction >= RTHYB_REACT_RAMP_OUT && s->state != RTHYB_IDLE &&
                          s->state != RTHYB_TRIPPED;
    return !ends_test && leaps->count >= JUMP_TAKEN;
}

/* 1 unless a sensor leapt. In ticks without a pair the specimen may have moved on, in each by as much as
 * in one. */
static int is_steady(rthyb_station *s, int cause, rthyb_leaps *leaps, double seen, double reading)
{
    const rthyb_watch *watch = &s->cfg.watch[cause];
    const double most = watch->value * ((double)s->controller.missing + 1.0);
    const double leap = reading - seen;
    int good = 1;
    if (s->seen && watch->value > 0.0 && fabs(leap) > most) {
        s->noted |= react_to(s, (finding){cause, leap, most}, watch->reaction, RTHYB_S_SENSOR_JUMP);
        good = stays_there(s, leaps, reading, watch);
    }
    if (good)
        leaps->count = 0;
    return good;
}

/* A pair of which one half leaps is not taken; 1 if it is. */
static int plausible(rthyb_station *s, const rthyb_station_input *in)
{
    finding found;
    const int x = is_steady(s, RTHYB_CAUSE_SENSOR_JUMP, &s->leaps_x, s->seen_x, in->x_m);
    /* A force beyond its limit is that first, however it came there. */
    if (overloaded(s, in->f_n, &found))
        return x;
    const int f = is_steady(s, RTHYB_CAUSE_FORCE_JUMP, &s->leaps_f, s->seen_f, in->f_n);
    return x && f;
}

/* What stood still before the readings ceased need not stand still now. */
static void watch_rest(rthyb_station *s, double x)
{
    if (fabs(x - s->rest_x) > s->cfg.rest_spread_m || s->controller.missing >= s->ticks.lost) {
        s->rest_x = x;
        s->rest_ticks = 0;
    }
    s->rest_ticks += s->rest_ticks < s->ticks.rest;
}

static void note_reading(rthyb_station *s, const rthyb_station_input *in)
{
    watch_stuck(s, RTHYB_CAUSE_SENSOR_STUCK, &s->still_x, in->x_m);
    watch_stuck(s, RTHYB_CAUSE_FORCE_STUCK, &s->still_f, in->f_n);
    watch_rest(s, in->x_m);
    if (!s->seen && !s->commands)
        settle_at(s, in->x_m);
    s->seen = 1;
    s->seen_x = in->x_m;
    s->seen_f = in->f_n;
    if (s->zeroing == 1)
        take_tare(s, in->x_m, in->f_n);
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
    return (range){s->tare_cmd + fmin(within.low, x), s->tare_cmd + fmax(within.high, x)};
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
    s->off_scale = is_sensible(in) ? off_scale(s, in) : 0;
    s->told = is_sensible(in);
    s->told_x = in->x_m;
    s->told_f = in->f_n;
    if (s->off_scale)
        pair.lost = RTHYB_LOST | RTHYB_S_OUT_OF_RANGE;
    else if (is_sensible(in) && !plausible(s, in))
        pair.lost = RTHYB_LOST;
    else if (is_sensible(in))
        note_reading(s, in);
    pair.x_meas_m = in->x_m - s->tare_x;
    pair.f_meas_n = in->f_n - s->tare_f;
    return pair;
}

/* While the drive stands by itself the command goes where the specimen is, so that nothing leaps when it
 * is released. */
static void stand_by(rthyb_station *s, const rthyb_station_input *in)
{
    if (s->state == RTHYB_IDLE && in->drive_stopped && !s->controller.missing)
        settle_at(s, s->seen_x);
}

/* With the first reading that is sound: what is taken over before would wait, unsent, for who knows how
 * long. 1 if it was taken over. */
static int take_over(rthyb_station *s, const rthyb_station_input *in)
{
    if (!in->taken_over || s->seen || !is_sound(s, in) ||
        judge(in->x_cmd_m, RTHYB_DISPLACEMENT_MAX_M) != RTHYB_OK)
        return 0;
    settle(s, in->x_cmd_m);
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
        .x_cmd_m = s->controller.x_cmd + s->tare_cmd,
        .send = s->seen && frame,
        .state = s->state,
        .told = s->reset_frames > 0 ? RTHYB_TOLD_RESET : s->state,
        .refused = refused,
        .records = made_up + 1,
        .low_m = wire.low,
        .high_m = wire.high,
    };
    if (s->state == RTHYB_TRIPPED && s->trip_frames > 0)
        s->trip_frames--;
    s->reset_frames -= out->send && s->reset_frames > 0;
    if (s->cfg.law_channel_count > 0)
        (void)rthyb_law_report_beside(&s->controller.law, s->channel + s->cfg.law_channel,
                                      s->cfg.law_channel_count);
    rthyb_record *last = &records[made_up];
    last->code |= (uint16_t)s->noted;
    note_pair(last, in->x_m, in->f_n, in->lost);
    if (in->beyond && s->state == RTHYB_TRIPPED)
        last->code |= RTHYB_S_POSITION_LIMIT | RTHYB_S_TRIP;
    last->flags &= ~(uint32_t)RTHYB_F_NOT_SENT;
    last->flags |= (out->send ? 0u : (uint32_t)RTHYB_F_NOT_SENT) | told(in, refused, took_over);
    return 0;
}
