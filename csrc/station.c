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

#define LOST_TRIP 20        /* samples without a pair, in a row */
#define JUMP_TAKEN 3        /* readings in a row that make a new level */
#define REST_TICKS 20       /* readings that stand still, then RESET is allowed */
#define ARRIVED_M 1e-6      /* what the command may lag behind at the end of a path */
#define ARRIVAL_TICKS 10240 /* 10 s in which it has come no nearer: it never will */
#define WORSE 1.1           /* times the force at the ramp-out that it caused */
#define WORSE_TICKS 128     /* in which that force may still grow: brake and actuator's delay */
#define SKIPS_RAMP_OUT 10   /* more skipped ticks than this in a row */
#define SKIPS_RECENT_MAX 50 /* skipped ticks in RECENT_TICKS */
#define RECENT_TICKS 1024
#define TRIP_FRAMES 3
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
        return state == RTHYB_RUNNING;
    case RTHYB_CMD_RESUME:
        return state == RTHYB_HOLD;
    case RTHYB_CMD_STOP:
        return state != RTHYB_TRIPPED;
    case RTHYB_CMD_RESET:
        return state == RTHYB_TRIPPED;
    case RTHYB_CMD_TRIP:
        return 1;
    default:
        return 0;
    }
}

static int config_error(const rthyb_station_config *c)
{
    if (rthyb_watches_check(c->watch) ||
        rthyb_path_limits_check(c->path_velocity_m_per_s, c->path_acceleration_m_per_s2))
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

int rthyb_station_init(rthyb_station *s, const rthyb_station_config *cfg)
{
    int error = config_error(cfg);
    if (error)
        return error;
    *s = (rthyb_station){.cfg = *cfg, .state = RTHYB_IDLE};
    error = fresh_controller(s);
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

int rthyb_station_adopt(rthyb_station *s, const rthyb_parameters *p)
{
    if (s->state != RTHYB_IDLE && switches_off(s, p))
        return 0;
    rthyb_controller_config *both[] = {&s->cfg.controller, &s->controller.cfg};
    for (int i = 0; i < 2; i++) {
        both[i]->velocity_limit_m_per_s = p->velocity_limit_m_per_s;
        both[i]->acceleration_limit_m_per_s2 = p->acceleration_limit_m_per_s2;
        both[i]->estimate_held = !p->adapt;
    }
    memcpy(s->cfg.watch, p->watch, sizeof s->cfg.watch);
    s->cfg.path_velocity_m_per_s = p->path_velocity_m_per_s;
    s->cfg.path_acceleration_m_per_s2 = p->path_acceleration_m_per_s2;
    s->controller.generation = p->generation;
    return 1;
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

static int path_within(const rthyb_path *p, double h, double v_max, double a_max)
{
    const double T = (double)p->ticks * h;
    for (int i = 0; i <= 32; i++) {
        const double u = i / 32.0;
        if (fabs(polynomial(p, u, 1)) > v_max * T || fabs(polynomial(p, u, 2)) > a_max * T * T)
            return 0;
    }
    return 1;
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

/* The shortest quintic, within a factor of 1.25, that keeps to the path limits; where the end states
 * themselves are beyond them, it keeps to their values. */
static rthyb_path plan(const rthyb_station *s, const double from[3], const double to[3])
{
    const double h = s->cfg.controller.period_s;
    const double v = fmax(path_velocity(s), 1.01 * fmax(fabs(from[1]), fabs(to[1])));
    const double a = fmax(path_acceleration(s), 1.01 * fmax(fabs(from[2]), fabs(to[2])));
    double T = 8.0 * h;
    rthyb_path path = quintic(from, to, whole_ticks(T, h), h);
    for (int i = 0; i < SEARCH_STEPS && !path_within(&path, h, v, a); i++) {
        T *= 1.25;
        path = quintic(from, to, whole_ticks(T, h), h);
    }
    return path;
}

/* Brakes from v to rest, no harder than the acceleration limit: x0 + v t - v t^2 / 2T. */
static rthyb_path brake(const rthyb_station *s, double x, double v)
{
    const double h = s->cfg.controller.period_s;
    const int64_t ticks = whole_ticks(fabs(v) / path_acceleration(s), h);
    const double way = v * (double)ticks * h;
    return (rthyb_path){.c = {x, way, -0.5 * way}, .end = x + 0.5 * way, .ticks = ticks};
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

/* The displacement of the next tick. */
static double follow(rthyb_path *p)
{
    if (!path_done(p))
        p->elapsed++;
    if (path_done(p))
        return p->end;
    const double u = (double)p->elapsed / (double)p->ticks;
    return p->cosine ? p->c[0] + p->c[1] * cos(RTHYB_PI * u) : polynomial(p, u, 0);
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

/* The first cause stays. That a test was over, or that the operator wanted it to be, is none that a
 * fault on the way out would hide behind. */
static void blame(rthyb_station *s, int cause)
{
    if (s->cause > RTHYB_CAUSE_OPERATOR)
        return;
    s->cause = cause;
    s->cause_tick = s->tick;
}

/* A reading at the very end of the sensor's range is a sensor that cannot say more; that end knows
 * nothing of a tare. */
static int within_range(const rthyb_station *s, const rthyb_station_input *in)
{
    const double x_range = s->cfg.controller.x_range_m, f_range = s->cfg.controller.f_range_n;
    return !(x_range > 0.0 && fabs(in->x_m) >= x_range) &&
           !(f_range > 0.0 && fabs(in->f_n) >= f_range);
}

static int is_sensible(const rthyb_station_input *in)
{
    return !in->lost && judge(in->x_m, RTHYB_DISPLACEMENT_MAX_M) == RTHYB_OK &&
           judge(in->f_n, RTHYB_FORCE_MAX_N) == RTHYB_OK;
}

static int is_sound(const rthyb_station *s, const rthyb_station_input *in)
{
    return is_sensible(in) && within_range(s, in);
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
    (void)rthyb_plc_init(&c->plc, c->cfg.estimator.w1, c->cfg.estimator.w2, x);
    c->x_num = c->x_num1 = c->x_plc = c->x_cmd = c->x_cmd1 = c->x_lim = c->x_lim1 = x;
}

static double speed(const rthyb_station *s)
{
    return (s->controller.x_num - s->controller.x_num1) / s->cfg.controller.period_s;
}

static void trip(rthyb_station *s, int cause)
{
    if (s->state == RTHYB_TRIPPED)
        return;
    blame(s, cause);
    s->zeroing = 0;
    enter(s, RTHYB_TRIPPED);
    s->trip_frames = TRIP_FRAMES;
}

static void ramp_out(rthyb_station *s, int cause)
{
    if (!is_moving(s->state))
        return;
    blame(s, cause);
    const double v = s->state == RTHYB_HOLD && s->leg == 1 ? 0.0 : speed(s);
    enter(s, RTHYB_RAMP_OUT);
    s->worst_force = 0.0;
    s->path = brake(s, s->controller.x_num, v);
}

static void hold(rthyb_station *s)
{
    const rthyb_motion *motion = &s->controller.motion;
    const double h = s->cfg.controller.period_s, x = s->controller.x_num;
    s->resume_x = x;
    s->resume_a = (x - 2.0 * motion->x1 + motion->x2) / (h * h);
    s->resume_v = (x - motion->x1) / h + 0.5 * h * s->resume_a;
    s->interrupted = 1;
    enter(s, RTHYB_HOLD);
    s->path = brake(s, x, speed(s));
}

static void resume(rthyb_station *s)
{
    const double from[3] = {s->controller.x_num, 0.0, 0.0};
    const double to[3] = {s->resume_x, s->resume_v, s->resume_a};
    s->path = plan(s, from, to);
    s->leg = 2;
}

static void react(rthyb_station *s, int cause, int reaction)
{
    /* While ramping in there is no course yet that could be resumed. */
    const int ends_it = (reaction == RTHYB_REACT_RAMP_OUT && is_moving(s->state)) ||
                        (reaction == RTHYB_REACT_HOLD && s->state == RTHYB_RAMP_IN);
    if (reaction == RTHYB_REACT_TRIP) {
        trip(s, cause);
    } else if (ends_it) {
        ramp_out(s, cause);
    } else if (reaction == RTHYB_REACT_HOLD && s->state == RTHYB_RUNNING) {
        blame(s, cause);
        hold(s);
    } else if (reaction != RTHYB_REACT_NONE) {
        s->indicated |= 1u << cause;
    }
}

/* On the way out nothing is left but a trip, and that is for the force alone: what pulls at a specimen
 * does not wait. The force that took the test off its course falls on the way, once it stands. */
static int escalated(rthyb_station *s, int cause, double value, int reaction)
{
    if (s->state != RTHYB_RAMP_OUT || cause != RTHYB_CAUSE_FORCE || reaction < RTHYB_REACT_HOLD)
        return reaction;
    if (s->cause != RTHYB_CAUSE_FORCE)
        return RTHYB_REACT_TRIP;
    if (s->leg > 0 && s->in_state >= WORSE_TICKS)
        return fabs(value) > WORSE * s->worst_force ? RTHYB_REACT_TRIP : reaction;
    s->worst_force = fmax(s->worst_force, fabs(value));
    return reaction;
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
    s->cause = RTHYB_CAUSE_NONE;
    s->indicated = 0;
    s->indicator_slope = 0.0;
    settle(s, x);
    s->controller.x_m1 = s->seen_x - s->tare_x;
    enter(s, RTHYB_RAMP_IN);
    s->path = ramp(x, 0.0, ramp_in_ticks(s, x));
}

static void begin_zero(rthyb_station *s)
{
    enter(s, RTHYB_IDLE);
    s->zeroing = 1;
    s->sum_x = s->sum_f = 0.0;
    s->low_x = RTHYB_DISPLACEMENT_MAX_M;
    s->high_x = -RTHYB_DISPLACEMENT_MAX_M;
}

/* How far from zero a command may go; 0 where nothing ends its way. */
static double farthest(const rthyb_station *s)
{
    const rthyb_watch *watch = &s->cfg.watch[RTHYB_CAUSE_POSITION];
    return watch->reaction >= RTHYB_REACT_HOLD ? watch->value : 0.0;
}

/* The specimen stands where no command may go. */
static int out_of_reach(const rthyb_station *s)
{
    const double most = farthest(s);
    return most > 0.0 && fabs(s->seen_x - s->tare_x) > most;
}

/* A drive takes up where it stands: it must stand, and where must be known. */
static int can_reset(const rthyb_station *s, const rthyb_station_input *in)
{
    return !in->link_down && is_sound(s, in) && s->rest_ticks >= REST_TICKS &&
           s->in_state >= REST_TICKS && fabs(in->x_m - s->rest_x) <= s->cfg.rest_spread_m;
}

/* What leads to motion needs a drive at the other end that follows. */
static int needs_drive(int command)
{
    return command == RTHYB_CMD_ZERO || command == RTHYB_CMD_ARM || command == RTHYB_CMD_START;
}

/* Obeys an operator; 0 if the command is not for this state, or cannot be carried out. */
static int obey(rthyb_station *s, const rthyb_station_input *in)
{
    if (in->command == RTHYB_CMD_NONE)
        return 1;
    if (!rthyb_command_allowed(s->state, in->command) ||
        (needs_drive(in->command) && (in->link_down || in->drive_stopped)))
        return 0;
    switch (in->command) {
    case RTHYB_CMD_ZERO:
        begin_zero(s);
        break;
    case RTHYB_CMD_ARM:
        enter(s, RTHYB_ARMED);
        break;
    case RTHYB_CMD_START:
        if (!s->seen || s->controller.missing || out_of_reach(s))
            return 0;
        begin_test(s);
        break;
    case RTHYB_CMD_HOLD:
        hold(s);
        break;
    case RTHYB_CMD_RESUME:
        if (s->leg != 1)
            return 0;
        resume(s);
        break;
    case RTHYB_CMD_STOP:
        if (is_moving(s->state)) {
            ramp_out(s, RTHYB_CAUSE_OPERATOR);
        } else if (s->state != RTHYB_RAMP_OUT) {
            s->zeroing = 0;
            enter(s, RTHYB_IDLE);
        }
        break;
    case RTHYB_CMD_RESET:
        if (!can_reset(s, in))
            return 0;
        enter(s, RTHYB_IDLE);
        s->cause = RTHYB_CAUSE_NONE;
        settle(s, in->x_m - s->tare_x);
        break;
    default:
        trip(s, RTHYB_CAUSE_SIGNAL);
        break;
    }
    return 1;
}

/* ---- one tick --------------------------------------------------------------------------------- */

/* Keeps the bit of each of the last 1024 ticks. */
static void note_tick(rthyb_station *s, int was_skipped)
{
    uint64_t *word = &s->skip_map[(s->tick / 64) % 16];
    const uint64_t bit = (uint64_t)1 << (s->tick % 64);
    s->recent_skips += (uint32_t)(was_skipped != 0) - (uint32_t)((*word & bit) != 0);
    *word = was_skipped ? *word | bit : *word & ~bit;
    s->skipped += (uint64_t)(was_skipped != 0);
    s->tick++;
    s->in_state++;
}

/* Mean of the readings over tare_ticks, unless they move. */
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
    if (s->in_state + 1 < (uint64_t)s->cfg.tare_ticks)
        return;
    const double command = s->controller.x_cmd + s->tare_cmd;
    s->tare_x = s->sum_x / s->cfg.tare_ticks;
    s->tare_f = s->sum_f / s->cfg.tare_ticks;
    /* The drive stays where it is. Where an earlier tare has told already how far command and reading lie
     * apart, that is no way to go: every test would go it again. */
    s->tare_cmd = s->commands ? command : s->tare_x;
    settle(s, command - s->tare_cmd);
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
        *x = follow(&s->path);
    return x;
}

/* Whether the command is where its path has ended. One that comes no nearer is given up: what keeps it
 * away, a limit of the command or a compensator that swings, would keep the state for ever. */
static int has_arrived(rthyb_station *s)
{
    const rthyb_controller *c = &s->controller;
    const double away = fmax(fabs(c->x_lim - c->x_plc), fabs(c->x_plc - c->x_num));
    if (away <= ARRIVED_M)
        return 1;
    if (away < s->nearest_m - ARRIVED_M) {
        s->nearest_m = away;
        s->no_nearer = 0;
    } else if (++s->no_nearer >= ARRIVAL_TICKS) {
        trip(s, RTHYB_CAUSE_NOT_ARRIVED);
    }
    return 0;
}

/* What comes after the end of a path. At rest the compensator and the limiter have to be through as
 * well; until then everything is watched as on the way. */
static void arrive(rthyb_station *s)
{
    const int waits = s->state == RTHYB_RAMP_IN || (s->state == RTHYB_RAMP_OUT && s->leg == 1) ||
                      (s->state == RTHYB_RAMP_OUT && s->cfg.stay);
    if (!path_done(&s->path) || (waits && !has_arrived(s)))
        return;
    if (s->state == RTHYB_RAMP_IN || (s->state == RTHYB_HOLD && s->leg == 2)) {
        enter(s, RTHYB_RUNNING);
    } else if (s->state == RTHYB_HOLD) {
        s->leg = 1;
    } else if (s->state == RTHYB_RAMP_OUT && s->leg == 0 && !s->cfg.stay) {
        const double from[3] = {s->controller.x_num, 0.0, 0.0}, rest[3] = {0.0, 0.0, 0.0};
        s->path = plan(s, from, rest);
        s->leg = 1;
    } else if (s->state == RTHYB_RAMP_OUT) {
        enter(s, RTHYB_IDLE);
    }
}

/* Reacts to a limit that is exceeded; returns what the record says of that: `bit`, and the trip. */
static int check(rthyb_station *s, int cause, double value, int bit)
{
    const rthyb_watch *watch = &s->cfg.watch[cause];
    if (watch->reaction == RTHYB_REACT_NONE || !(watch->value > 0.0) ||
        !(fabs(value) > watch->value))
        return RTHYB_OK;
    const int reaction = escalated(s, cause, value, watch->reaction);
    react(s, cause, reaction);
    return reaction == RTHYB_REACT_TRIP ? bit | RTHYB_S_TRIP : bit;
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
    code |= check(s, RTHYB_CAUSE_VELOCITY, (c->x_plc - r->x_plc_m) / h, RTHYB_OK);
    code |= check(s, RTHYB_CAUSE_INCREMENT, c->x_cmd - r->x_cmd_m, RTHYB_OK);
    code |= check(s, RTHYB_CAUSE_FORCE, r->f_meas_n, RTHYB_S_FORCE_LIMIT);
    code |= check(s, RTHYB_CAUSE_TRACKING, r->x_meas_m - r->x_num_m, RTHYB_S_TRACKING_LIMIT);
    code |= check(s, RTHYB_CAUSE_INDICATOR, s->indicator_slope, RTHYB_OK);
    code |= check(s, RTHYB_CAUSE_ENERGY, r->energy_error_j, RTHYB_OK);
    r->code = (uint8_t)code;
}

/* A sensor that repeats itself while the command has moved on. */
static void watch_stuck(rthyb_station *s, double x)
{
    if (x != s->still_x || !is_moving(s->state)) {
        s->still_x = x;
        s->still_cmd = s->controller.x_cmd;
        s->still_ticks = 0;
        return;
    }
    s->still_ticks++;
    const double moved = fabs(s->controller.x_cmd - s->still_cmd);
    const rthyb_watch *watch = &s->cfg.watch[RTHYB_CAUSE_SENSOR_STUCK];
    if (watch->value > 0.0 && (double)s->still_ticks >= watch->value &&
        moved > s->cfg.rest_spread_m)
        react(s, RTHYB_CAUSE_SENSOR_STUCK, watch->reaction);
}

/* Another level is believed when it stays, unless a leap is to end the test. */
static int stays_there(rthyb_station *s, double x, const rthyb_watch *watch)
{
    const int again = s->jumps > 0 && fabs(x - s->jump_x) <= watch->value;
    s->jumps = again ? s->jumps + 1 : 1;
    s->jump_x = x;
    const int ends_test = watch->reaction >= RTHYB_REACT_RAMP_OUT && s->state != RTHYB_IDLE &&
                          s->state != RTHYB_TRIPPED;
    if (ends_test || s->jumps < JUMP_TAKEN)
        return 0;
    return 1;
}

/* A pair whose displacement leaps is not taken; 1 if it is. In ticks without a pair the specimen may
 * have moved on, in each by as much as in one. */
static int plausible(rthyb_station *s, const rthyb_station_input *in)
{
    const rthyb_watch *watch = &s->cfg.watch[RTHYB_CAUSE_SENSOR_JUMP];
    const double most = watch->value * ((double)s->controller.missing + 1.0);
    int good = 1;
    if (s->seen && watch->value > 0.0 && fabs(in->x_m - s->seen_x) > most) {
        react(s, RTHYB_CAUSE_SENSOR_JUMP, watch->reaction);
        good = stays_there(s, in->x_m, watch);
    }
    if (good)
        s->jumps = 0;
    return good;
}

static void watch_rest(rthyb_station *s, double x)
{
    if (fabs(x - s->rest_x) > s->cfg.rest_spread_m) {
        s->rest_x = x;
        s->rest_ticks = 0;
    }
    s->rest_ticks += s->rest_ticks < REST_TICKS;
}

static void note_reading(rthyb_station *s, const rthyb_station_input *in)
{
    watch_stuck(s, in->x_m);
    watch_rest(s, in->x_m);
    if (!s->seen && !s->commands)
        settle(s, in->x_m - s->tare_x);
    s->seen = 1;
    s->seen_x = in->x_m;
    if (s->zeroing == 1)
        take_tare(s, in->x_m, in->f_n);
}

/* Where the command ends in spite of everything: what a limit takes off its course must not have left
 * first. It holds from START on; before the tare there is no zero that it could be counted from. */
static double clamp_of(const rthyb_station *s)
{
    return is_on_its_way(s->state) ? farthest(s) : 0.0;
}

/* How far out the wire may round a command: not across the limit, nor further out than one that is beyond
 * it already. What a trip repeats has left before. */
static double reach(const rthyb_station *s)
{
    const double most = farthest(s);
    const int counts = s->commands && s->state != RTHYB_TRIPPED && most > 0.0;
    return counts ? fmax(most, fabs(s->controller.x_cmd)) : HUGE_VAL;
}

static void sample(rthyb_station *s, const rthyb_input *in, int blind, rthyb_record *record)
{
    const int tripped = s->state == RTHYB_TRIPPED, running = s->state == RTHYB_RUNNING;
    double x;
    const double *path = next_on_path(s, &x);
    const double sent = s->controller.x_cmd, indicator = s->controller.tracking_indicator;
    s->controller.cfg.clamp_m = clamp_of(s);
    const int code = rthyb_controller_sample(&s->controller, in, path, blind || tripped, record);
    if (tripped && !blind)
        record->flags &= ~(uint32_t)RTHYB_F_BLIND;
    if (running)
        s->test_tick++;
    if (is_on_its_way(s->state) && !blind)
        watch_limits(s, record, indicator);
    record->tick = s->tick;
    if (!blind && s->controller.missing >= LOST_TRIP && s->state != RTHYB_IDLE)
        trip(s, RTHYB_CAUSE_LINK_LOST);
    if (code & RTHYB_S_NOT_FINITE)
        trip(s, RTHYB_CAUSE_NOT_FINITE);
    if (s->state != RTHYB_TRIPPED)
        arrive(s);
    if (s->state == RTHYB_TRIPPED)
        s->controller.x_cmd = s->controller.x_lim = sent;
    s->controller.state = s->state;
}

static rthyb_input at_tick(const rthyb_station *s, const double *ag, size_t n)
{
    const int running = s->state == RTHYB_RUNNING && s->test_tick < n;
    return (rthyb_input){.excitation = running ? ag[s->test_tick] : 0.0, .lost = RTHYB_LOST};
}

/* Makes up for skipped ticks: extrapolated, nothing learnt, nothing sent. */
static uint32_t blind_steps(rthyb_station *s, uint32_t skipped, const double *ag, size_t n,
                            rthyb_record *records)
{
    const uint32_t made_up = skipped < RTHYB_BLIND_MAX ? skipped : RTHYB_BLIND_MAX;
    /* More than the map of recent ticks holds are only counted: a long sleep is no long loop. */
    const uint32_t noted = skipped < RECENT_TICKS ? skipped : RECENT_TICKS;
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
    if (skipped >= LOST_TRIP)
        trip(s, RTHYB_CAUSE_STALLED);
    else if (skipped > SKIPS_RAMP_OUT || s->recent_skips > SKIPS_RECENT_MAX)
        ramp_out(s, RTHYB_CAUSE_SKIPS);
    return made_up;
}

static void watch_surroundings(rthyb_station *s, const rthyb_station_input *in, size_t n)
{
    if (in->link_down && s->state != RTHYB_IDLE)
        trip(s, RTHYB_CAUSE_LINK_DOWN);
    if (in->drive_stopped && s->state != RTHYB_IDLE)
        trip(s, RTHYB_CAUSE_DRIVE_STOPPED);
    if (in->beyond && s->state != RTHYB_IDLE)
        trip(s, RTHYB_CAUSE_POSITION);
    if (in->heartbeat_late)
        ramp_out(s, RTHYB_CAUSE_HEARTBEAT);
    if (s->state == RTHYB_RUNNING && s->test_tick >= n)
        ramp_out(s, RTHYB_CAUSE_COMPLETED);
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
    if (is_sensible(in) && !within_range(s, in))
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
        settle(s, s->seen_x - s->tare_x);
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

int rthyb_station_tick(rthyb_station *s, const rthyb_station_input *in, const double *ag_mps2,
                       size_t n, rthyb_record *records, rthyb_station_output *out)
{
    const int took_over = take_over(s, in);
    const uint32_t made_up = blind_steps(s, in->skipped, ag_mps2, n, records);
    const int refused = !obey(s, in);
    watch_surroundings(s, in, n);
    const rthyb_input pair = take_pair(s, in, ag_mps2, n);
    sample(s, &pair, 0, &records[made_up]);
    stand_by(s, in);
    note_tick(s, 0);
    const int frame = s->state != RTHYB_TRIPPED || s->trip_frames > 0;
    *out = (rthyb_station_output){
        .x_cmd_m = s->controller.x_cmd + s->tare_cmd,
        .send = s->seen && frame,
        .state = s->state,
        .refused = refused,
        .records = made_up + 1,
        .low_m = s->tare_cmd - reach(s),
        .high_m = s->tare_cmd + reach(s),
    };
    if (s->state == RTHYB_TRIPPED && s->trip_frames > 0)
        s->trip_frames--;
    rthyb_record *last = &records[made_up];
    if (in->beyond && s->state == RTHYB_TRIPPED)
        last->code |= RTHYB_S_POSITION_LIMIT | RTHYB_S_TRIP;
    last->flags &= ~(uint32_t)RTHYB_F_NOT_SENT;
    last->flags |= (out->send ? 0u : (uint32_t)RTHYB_F_NOT_SENT) | told(in, refused, took_over);
    return 0;
}
