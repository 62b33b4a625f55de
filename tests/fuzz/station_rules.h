/* Rules that a station must obey, whatever happens to it: judged by its inputs and outputs, which
 * are tracked independently. Only state, tare and the settings in effect are taken from the
 * station. */
#ifndef STATION_RULES_H
#define STATION_RULES_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "rthyb.h"

#define PERIOD_S (1.0 / 1024.0)
#define AT_REST_M 4e-6   /* largest movement of a command at rest: what remains of its arrival */
#define FORCE_TICKS 256  /* 0.25 s: longest time of a force beyond its limit in HOLD and RAMP_OUT */
#define FORCE_WORST 1.5  /* times that limit: must trip at once */
#define LOST_TICKS 20    /* without a pair */
#define STALLED_TICKS 20 /* consecutive skipped ticks */
#define SKIPS_IN_A_ROW 10 /* more consecutive ones end the motion */
#define SKIPS_RECENT 50   /* and so do more of them in the window */
#define RECENT_TICKS 1024
#define TRIP_COMMANDS 3
#define REST_READINGS 20 /* at rest, before a RESET */

enum rule {
    RULE_FINITE,
    RULE_ROWS,
    RULE_TRANSITION,
    RULE_RESET,
    RULE_TRIP_COMMANDS,
    RULE_SILENCE,
    RULE_PERMITTED,
    RULE_REFUSED,
    RULE_OBEYED,
    RULE_POSITION,
    RULE_VELOCITY,
    RULE_ACCELERATION,
    RULE_GAP,
    RULE_AT_REST,
    RULE_TARE,
    RULE_ADMITTED,
    RULE_FORCE_TRIP,
    RULE_FORCE_REACTION,
    RULE_FORCE_BOUND,
    RULE_FORCE_WORST,
    RULE_OFF_SCALE,
    RULE_TRACKING_TRIP,
    RULE_POSITION_TRIP,
    RULE_NOT_FINITE,
    RULE_READINGS,
    RULE_LINK_LOST,
    RULE_SURROUNDINGS,
    RULE_STALLED,
    RULE_SKIPS,
    RULE_SHARES,
    RULE_HEARTBEAT,
    RULE_LENGTH,
    RULE_PARAMETERS,
    RULE_DRIVE,
    RULE_REPLAY,
    RULES
};

static const char *const RULE_TEXT[RULES] = {
    [RULE_FINITE] = "rows and commands are finite",
    [RULE_ROWS] = "a row for each tick, without a gap",
    [RULE_TRANSITION] = "states change as the table says",
    [RULE_RESET] = "TRIPPED is left by RESET alone, at rest",
    [RULE_TRIP_COMMANDS] = "a trip sends three times the last command, then nothing",
    [RULE_SILENCE] = "outside a trip every tick has a command once there is a reading",
    [RULE_PERMITTED] = "no command is obeyed in a state that it is not for",
    [RULE_REFUSED] = "a command that is refused changes nothing",
    [RULE_OBEYED] = "a command that is obeyed does what it says",
    [RULE_POSITION] = "no command beyond the position limit, nor further out",
    [RULE_VELOCITY] = "no step beyond the velocity limit, gaps or not",
    [RULE_ACCELERATION] = "no change of step beyond the acceleration limit a tick",
    [RULE_GAP] = "after a gap the step has no other sign",
    [RULE_AT_REST] = "a command at rest stands",
    [RULE_TARE] = "a tare is the mean of as many readings as it has ticks",
    [RULE_ADMITTED] = "ARM, START and RESUME are refused with the force beyond its limit",
    [RULE_FORCE_TRIP] = "force beyond a limit that trips: TRIPPED in that tick, at rest too",
    [RULE_FORCE_REACTION] = "force beyond a limit that holds or ramps out: RUNNING no more",
    [RULE_FORCE_BOUND] = "force beyond its limit for .25 s in HOLD or RAMP_OUT: TRIPPED",
    [RULE_FORCE_WORST] = "force beyond 1.5 times its limit in HOLD or RAMP_OUT: TRIPPED",
    [RULE_OFF_SCALE] = "a sensor at the end of its range: its limit's reaction in that tick",
    [RULE_TRACKING_TRIP] = "tracking error beyond a limit that trips: TRIPPED in that tick",
    [RULE_POSITION_TRIP] = "compensated command beyond a limit that trips: TRIPPED in that tick",
    [RULE_NOT_FINITE] = "a reading that is no number: TRIPPED at once",
    [RULE_READINGS] = "only a sensible reading is taken",
    [RULE_LINK_LOST] = "twenty ticks without a pair: TRIPPED",
    [RULE_SURROUNDINGS] = "link down, drive stopped, wire too narrow: TRIPPED at once",
    [RULE_STALLED] = "twenty ticks skipped in a row: TRIPPED",
    [RULE_SKIPS] = "more than 10 ticks skipped in a row: motion ends",
    [RULE_SHARES] = "lost or skipped ticks beyond their share of a second: motion ends",
    [RULE_HEARTBEAT] = "a silent operator's side: motion ends",
    [RULE_LENGTH] = "no longer in RUNNING than there is ground motion",
    [RULE_PARAMETERS] = "a set of parameters is taken whole or not at all",
    [RULE_DRIVE] = "the drive follows nothing that it must not follow",
    [RULE_REPLAY] = "the rows replay bit for bit",
};

typedef struct {
    uint64_t met, broken;
    uint64_t seed, tick; /* of the first violation */
    double value, bound;
} rule_tally;

static rule_tally tally[RULES];

/* Ticks of one kind among the last 1024. */
typedef struct {
    uint8_t is[RECENT_TICKS];
    uint32_t count;
} window;

/* What is known of a station and the drive behind it. */
typedef struct {
    uint64_t seed;
    uint64_t tick;    /* of the episode: executed and skipped */
    uint64_t station; /* tick of the station's next row */
    int over;         /* a rule was broken: the episode ends */
    int commanded;    /* the drive has a command */
    int anew;         /* the next one is set to the position of the specimen */
    double at_drive_m, step_m;
    uint64_t since;       /* ticks since the last command */
    double resolution_m;  /* of the wire */
    int adopted;          /* parameters have changed since this motion began */
    int commands_left;    /* commands of a trip still to come */
    uint32_t missing;     /* ticks without a pair */
    uint64_t beyond[2];   /* readings with the force beyond its limit, in HOLD or RAMP_OUT */
    uint64_t running;     /* rows in RUNNING since START */
    double low_m, high_m; /* widest position limits since the parameters changed */
    window skips, losses;
    double rest_x[REST_READINGS]; /* last readings */
    uint64_t readings;
    int seen, tared;
    double force_n; /* last reading of the force */
    int zeroing;
    uint64_t tare_readings; /* since ZERO, and the range of these readings */
    double tare_x[2], tare_f[2];
} observer;

/* One tick of the station as seen from outside. */
typedef struct {
    rthyb_station_input in;
    const rthyb_record *rows;
    uint32_t count;
    int was, is;       /* state before and after */
    int wanted;        /* the station had a command to send */
    int sent;          /* it was sent */
    int refused;       /* the operator's command was refused */
    double at_drive_m; /* the drive's command afterwards, if sent */
} event;

static void must(observer *o, int rule, int holds, double value, double bound)
{
    rule_tally *t = &tally[rule];
    t->met++;
    if (holds)
        return;
    if (t->broken++ == 0) {
        t->seed = o->seed;
        t->tick = o->tick;
        t->value = value;
        t->bound = bound;
    }
    o->over = 1;
}

/* ---- states ------------------------------------------------------------------------------------- */

static int moves(int state)
{
    return state == RTHYB_RAMP_IN || state == RTHYB_RUNNING || state == RTHYB_HOLD;
}

static int on_its_way(int state)
{
    return moves(state) || state == RTHYB_RAMP_OUT;
}

static int permitted(int state, int command)
{
    static const unsigned FOR[RTHYB_CMD_COUNT] = {
        [RTHYB_CMD_ZERO] = 1u << RTHYB_IDLE | 1u << RTHYB_ZEROED,
        [RTHYB_CMD_ARM] = 1u << RTHYB_ZEROED,
        [RTHYB_CMD_START] = 1u << RTHYB_ARMED,
        [RTHYB_CMD_HOLD] = 1u << RTHYB_RUNNING | 1u << RTHYB_HOLD,
        [RTHYB_CMD_RESUME] = 1u << RTHYB_HOLD,
        [RTHYB_CMD_STOP] = 0xffu & ~(1u << RTHYB_TRIPPED),
        [RTHYB_CMD_RESET] = 1u << RTHYB_TRIPPED | 1u << RTHYB_IDLE,
        [RTHYB_CMD_TRIP] = 0xffu,
    };
    return command > RTHYB_CMD_NONE && command < RTHYB_CMD_COUNT && (FOR[command] >> state & 1u);
}

/* Whether a state may follow another, without a command or with the one that was executed. */
static int leads_to(int from, int to, int obeyed)
{
    static const unsigned ALONE[] = {
        [RTHYB_IDLE] = 1u << RTHYB_ZEROED,
        [RTHYB_ZEROED] = 0,
        [RTHYB_ARMED] = 1u << RTHYB_ZEROED,
        [RTHYB_RAMP_IN] = 1u << RTHYB_RUNNING | 1u << RTHYB_RAMP_OUT,
        [RTHYB_RUNNING] = 1u << RTHYB_HOLD | 1u << RTHYB_RAMP_OUT,
        [RTHYB_HOLD] = 1u << RTHYB_RUNNING | 1u << RTHYB_RAMP_OUT,
        [RTHYB_RAMP_OUT] = 1u << RTHYB_IDLE,
        [RTHYB_TRIPPED] = 0,
    };
    const int rest = from == RTHYB_IDLE || from == RTHYB_ZEROED || from == RTHYB_ARMED;
    if (to == RTHYB_TRIPPED || (ALONE[from] >> to & 1u))
        return 1;
    switch (obeyed) {
    case RTHYB_CMD_ZERO:
    case RTHYB_CMD_STOP:
        return to == RTHYB_IDLE && rest;
    case RTHYB_CMD_ARM:
        return from == RTHYB_ZEROED && to == RTHYB_ARMED;
    case RTHYB_CMD_START:
        return from == RTHYB_ARMED && to == RTHYB_RAMP_IN;
    case RTHYB_CMD_RESET:
        return from == RTHYB_TRIPPED && to == RTHYB_IDLE;
    default:
        return 0;
    }
}

/* Several transitions may take place in one tick. */
static int reaches(int from, int to, int obeyed, int depth)
{
    if (from == to || leads_to(from, to, obeyed))
        return 1;
    for (int middle = RTHYB_IDLE; depth > 0 && middle < RTHYB_TRIPPED; middle++)
        if (middle != from && leads_to(from, middle, obeyed) &&
            reaches(middle, to, obeyed, depth - 1))
            return 1;
    return 0;
}

static double spread_of(const observer *o)
{
    double low = INFINITY, high = -INFINITY;
    for (int i = 0; i < REST_READINGS; i++) {
        low = fmin(low, o->rest_x[i]);
        high = fmax(high, o->rest_x[i]);
    }
    return high - low;
}

static void judge_states(observer *o, const event *e, const rthyb_station *s)
{
    const int obeyed = e->refused ? RTHYB_CMD_NONE : e->in.command;
    must(o, RULE_TRANSITION, reaches(e->was, e->is, obeyed, 3), e->was, e->is);
    if (e->was == RTHYB_TRIPPED && e->is != RTHYB_TRIPPED) {
        const int by_reset =
            obeyed == RTHYB_CMD_RESET && e->is == RTHYB_IDLE && !e->in.axis[0].lost;
        must(o, RULE_RESET,
             by_reset && o->readings >= REST_READINGS &&
                 spread_of(o) <= 2.0 * s->cfg.axis[0].rest_spread_m,
             spread_of(o), s->cfg.axis[0].rest_spread_m);
    }
    if (e->in.command == RTHYB_CMD_NONE || e->in.skipped)
        return;
    must(o, RULE_PERMITTED, e->refused || permitted(e->was, e->in.command), e->was, e->in.command);
    if (e->refused)
        return;
    if (e->in.command == RTHYB_CMD_TRIP)
        must(o, RULE_OBEYED, e->is == RTHYB_TRIPPED, e->is, e->in.command);
    if (e->in.command == RTHYB_CMD_STOP || e->in.command == RTHYB_CMD_HOLD)
        must(o, RULE_OBEYED,
             !moves(e->is) || (e->in.command == RTHYB_CMD_HOLD && e->is == RTHYB_HOLD), e->is,
             e->in.command);
}

/* ---- rows --------------------------------------------------------------------------------------- */

/* A law without alpha, or without beta, has NaN there. */
static int is_finite(const rthyb_law *law, const rthyb_record *r)
{
    return isfinite(r->ag_mps2) && isfinite(r->x_num_m) && isfinite(r->x_plc_m) &&
           isfinite(r->axis[0].x_cmd_m) && isfinite(r->axis[0].x_meas_m) &&
           isfinite(r->axis[0].f_meas_n) && (isfinite(r->alpha) || law->alpha_at < 0) &&
           (isfinite(r->beta) || law->beta_at < 0) && isfinite(r->k_t_n_per_m) &&
           isfinite(r->energy_error_j) && isfinite(r->tracking_indicator_m2);
}

static void judge_rows(observer *o, const event *e, const rthyb_station *s)
{
    const uint32_t made_up = e->in.skipped < RTHYB_LOST_TICKS ? e->in.skipped : RTHYB_LOST_TICKS;
    must(o, RULE_ROWS, e->count == made_up + 1, e->count, made_up + 1.0);
    for (uint32_t i = 0; i < e->count && !o->over; i++) {
        const rthyb_record *r = &e->rows[i];
        const int last = i == e->count - 1;
        const uint64_t due = o->station + (last ? e->in.skipped : i);
        must(o, RULE_FINITE, is_finite(&s->controller.axis[0].law, r), i, 0.0);
        must(o, RULE_ROWS, r->tick == due, (double)r->tick, (double)due);
        must(o, RULE_ROWS, ((r->flags & RTHYB_F_BLIND) == 0) == last, r->flags, 0.0);
        o->running = r->state == RTHYB_RUNNING ? o->running + 1 : o->running;
    }
    must(o, RULE_FINITE, isfinite(e->at_drive_m), e->at_drive_m, 0.0);
}

/* ---- what leaves -------------------------------------------------------------------------------- */

/* Whether the command is set to the position of the specimen, which does not count as a step: no
 * drive follows then, or its command is unknown. If that command is not sent, the next one is
 * set. */
static int sets_anew(observer *o, const event *e)
{
    const int stands_by = e->is == RTHYB_IDLE && e->in.axis[0].drive_stopped;
    const int taken_over = e->rows[e->count - 1].flags & RTHYB_F_TAKEN_OVER;
    const int first = o->readings == 1 && !taken_over;
    const int reset = e->in.command == RTHYB_CMD_RESET && !e->refused;
    const int anew = o->anew || first || stands_by || reset;
    o->anew = anew && !e->sent;
    return anew || !o->commanded;
}

/* Limit that interrupts a test; infinite if there is none. */
static double ending(const rthyb_station *s, int cause)
{
    const rthyb_watch *w = &s->cfg.watch[cause];
    return w->reaction >= RTHYB_REACT_HOLD && w->value > 0.0 ? w->value : INFINITY;
}

/* Bounds of a command: the test's limit is relative to the tare, the rig's is not. When a limit is
 * tightened, the command brakes into it, which requires an acceleration limit, but never goes
 * beyond the previous limit. */
static void note_bounds(observer *o, const rthyb_station *s, double *low_m, double *high_m)
{
    const double test = ending(s, RTHYB_CAUSE_POSITION), rig = ending(s, RTHYB_CAUSE_RIG_POSITION);
    *low_m = fmax(s->axis[0].tare_cmd - test, -rig);
    *high_m = fmin(s->axis[0].tare_cmd + test, rig);
    const int brakes = o->adopted && s->cfg.controller.axis[0].acceleration_limit_m_per_s2 > 0.0;
    o->low_m = brakes ? fmin(o->low_m, *low_m) : *low_m;
    o->high_m = brakes ? fmax(o->high_m, *high_m) : *high_m;
}

static void judge_velocity(observer *o, const rthyb_station *s, double step_m, double wire)
{
    const double most = s->cfg.controller.axis[0].velocity_limit_m_per_s * PERIOD_S;
    const double a = s->cfg.controller.axis[0].acceleration_limit_m_per_s2;
    const double before = fabs(o->step_m) - (a > 0.0 ? a * PERIOD_S * PERIOD_S : 0.0);
    if (most > 0.0)
        must(o, RULE_VELOCITY,
             fabs(step_m) <= (o->adopted && a > 0.0 ? fmax(most, before) : most) + wire, step_m,
             most);
}

static void judge_acceleration(observer *o, const rthyb_station *s, double step_m, double wire)
{
    const double a = s->cfg.controller.axis[0].acceleration_limit_m_per_s2;
    const double most = a * PERIOD_S * PERIOD_S * (1.0 + 1e-9), change = fabs(step_m - o->step_m);
    if (!(a > 0.0))
        return;
    must(o, RULE_ACCELERATION, change <= most + wire, change, most);
    if (o->since > 1)
        must(o, RULE_GAP,
             step_m * o->step_m >= 0.0 || fabs(step_m) <= wire || fabs(o->step_m) <= wire, step_m,
             o->step_m);
}

static void judge_limits(observer *o, const event *e, const rthyb_station *s, double step_m)
{
    const double x = e->at_drive_m, before = o->at_drive_m;
    const double fine = 1e-12 + 1e-9 * fabs(x), wire = 2.0 * o->resolution_m + fine;
    double low_m, high_m;
    note_bounds(o, s, &low_m, &high_m);
    if (low_m < high_m) {
        const double most = fmax(o->high_m, before), least = fmin(o->low_m, before);
        must(o, RULE_POSITION, x <= most + fine && x >= least - fine, x, x > most ? most : least);
    }
    judge_velocity(o, s, step_m, wire);
    /* A reduced acceleration limit may be too small to brake before the position limit, which has
     * priority; if that was tightened too, it is as far out as the command could brake until
     * then. */
    const int at_the_end =
        x >= s->controller.axis[0].limiter.upper_m + s->axis[0].tare_cmd - wire ||
        x <= s->controller.axis[0].limiter.lower_m + s->axis[0].tare_cmd + wire;
    if (!(o->adopted && at_the_end))
        judge_acceleration(o, s, step_m, 2.0 * wire);
}

static void judge_command(observer *o, const event *e, const rthyb_station *s)
{
    const int was_rest = !on_its_way(e->was), is_rest = !on_its_way(e->is);
    const double step_m = e->at_drive_m - o->at_drive_m;
    const int anew = sets_anew(o, e);
    o->since += e->in.skipped + 1u;
    if (!e->sent)
        return;
    if (anew) {
        o->step_m = 0.0;
    } else if (e->is == RTHYB_TRIPPED) {
        must(o, RULE_TRIP_COMMANDS, fabs(step_m) <= 1e-12 + 1e-9 * fabs(e->at_drive_m), step_m,
             0.0);
        o->step_m = 0.0;
    } else if (was_rest && is_rest) {
        must(o, RULE_AT_REST, fabs(step_m) <= AT_REST_M + o->resolution_m, step_m, AT_REST_M);
        o->step_m = step_m;
    } else {
        judge_limits(o, e, s, step_m);
        o->step_m = step_m;
    }
    o->at_drive_m = e->at_drive_m;
    o->since = 0;
    o->commanded = 1;
}

static void judge_sending(observer *o, const event *e)
{
    const int reset = e->in.command == RTHYB_CMD_RESET && !e->refused;
    if (e->is == RTHYB_TRIPPED && (e->was != RTHYB_TRIPPED || reset))
        o->commands_left = TRIP_COMMANDS;
    if (e->is == RTHYB_TRIPPED && o->seen)
        must(o, RULE_TRIP_COMMANDS, e->wanted == (o->commands_left > 0), e->wanted,
             o->commands_left);
    else
        must(o, RULE_SILENCE, e->wanted == o->seen, e->wanted, o->seen);
    o->commands_left -= o->commands_left > 0;
    must(o, RULE_SILENCE, ((e->rows[e->count - 1].flags & RTHYB_F_NOT_SENT) == 0) == e->sent,
         e->sent, 0.0);
}

/* ---- readings ----------------------------------------------------------------------------------- */

static int in_range(double value, double range, double most)
{
    return fabs(value) <= most && !(range > 0.0 && fabs(value) >= range);
}

static int is_sensible(const event *e, const rthyb_station *s)
{
    const rthyb_axis_config *c = &s->cfg.axis[0];
    return !e->in.axis[0].lost && in_range(e->in.axis[0].x_m, c->x_range_m, 1e3) &&
           in_range(e->in.axis[0].f_n, c->f_range_n, 1e12);
}

static void note_tare(observer *o, double x, double f)
{
    o->tare_readings++;
    o->tare_x[0] = fmin(o->tare_x[0], x);
    o->tare_x[1] = fmax(o->tare_x[1], x);
    o->tare_f[0] = fmin(o->tare_f[0], f);
    o->tare_f[1] = fmax(o->tare_f[1], f);
}

static int lies_between(double value, const double bounds[2])
{
    const double fine = 1e-12 * (fabs(bounds[0]) + fabs(bounds[1]));
    return value >= bounds[0] - fine && value <= bounds[1] + fine;
}

static void judge_tare(observer *o, const event *e, const rthyb_station *s)
{
    if (e->is == RTHYB_ZEROED && o->zeroing) {
        must(o, RULE_TARE,
             o->tare_readings == (uint64_t)s->cfg.tare_ticks &&
                 lies_between(s->axis[0].tare_x, o->tare_x) &&
                 lies_between(s->axis[0].tare_f, o->tare_f),
             (double)o->tare_readings, s->cfg.tare_ticks);
        o->tared = 1;
    }
    if (e->is != RTHYB_IDLE)
        o->zeroing = 0;
}

static void note_readings(observer *o, const event *e, const rthyb_station *s)
{
    const rthyb_record *last = &e->rows[e->count - 1];
    const int fresh = (last->flags & RTHYB_F_FRESH) != 0, sensible = is_sensible(e, s);
    const int leaps = s->cfg.watch[RTHYB_CAUSE_SENSOR_JUMP].value > 0.0 ||
                      s->cfg.watch[RTHYB_CAUSE_FORCE_JUMP].value > 0.0;
    must(o, RULE_READINGS, fresh == sensible || (sensible && leaps), fresh, sensible);
    o->missing = fresh ? 0 : o->missing + e->count;
    o->seen = o->seen || fresh;
    if (fresh)
        o->rest_x[o->readings++ % REST_READINGS] = e->in.axis[0].x_m;
    if (fresh)
        o->force_n = e->in.axis[0].f_n;
    if (fresh && o->zeroing)
        note_tare(o, e->in.axis[0].x_m, e->in.axis[0].f_n);
}

/* The value at a sensor that reads the end of its range may be any larger one: such a force counts
 * as infinite. 0 if no reading was accepted. */
static double force_taken(const observer *o, const event *e, const rthyb_station *s, int cause)
{
    const int fresh = (e->rows[e->count - 1].flags & RTHYB_F_FRESH) != 0;
    const double range = s->cfg.axis[0].f_range_n;
    if (cause == RTHYB_CAUSE_FORCE && !o->tared)
        return 0.0;
    if (!e->in.axis[0].lost && range > 0.0 && fabs(e->in.axis[0].f_n) >= range &&
        fabs(e->in.axis[0].f_n) <= 1e12 && fabs(e->in.axis[0].x_m) <= 1e3)
        return INFINITY;
    return fresh ? fabs(cause == RTHYB_CAUSE_FORCE ? e->in.axis[0].f_n - s->axis[0].tare_f
                                                   : e->in.axis[0].f_n)
                 : 0.0;
}

static void judge_held_force(observer *o, const event *e, uint64_t *beyond, double force,
                             double limit)
{
    if (e->was != RTHYB_HOLD && e->was != RTHYB_RAMP_OUT)
        return;
    ++*beyond;
    must(o, RULE_FORCE_BOUND, e->is == RTHYB_TRIPPED || *beyond <= FORCE_TICKS, (double)*beyond,
         FORCE_TICKS);
    if (force > FORCE_WORST * limit)
        must(o, RULE_FORCE_WORST, e->is == RTHYB_TRIPPED, force, FORCE_WORST * limit);
}

/* Checked whenever commands are sent; at rest only for a drive that follows. */
static void judge_force(observer *o, const event *e, const rthyb_station *s, int cause)
{
    const rthyb_watch *w = &s->cfg.watch[cause];
    uint64_t *beyond = &o->beyond[cause == RTHYB_CAUSE_RIG_FORCE];
    const double force = force_taken(o, e, s, cause);
    const int on_the_way = on_its_way(e->was) || on_its_way(e->is);
    const int follows = o->seen && !e->in.axis[0].drive_stopped && !e->in.axis[0].link_down;
    if (!(w->value > 0.0) || !(force > w->value) || e->was == RTHYB_TRIPPED) {
        *beyond = force > 0.0 ? 0 : *beyond;
        return;
    }
    if (w->reaction == RTHYB_REACT_TRIP && (on_the_way || follows))
        must(o, isinf(force) ? RULE_OFF_SCALE : RULE_FORCE_TRIP, e->is == RTHYB_TRIPPED, force,
             w->value);
    if (w->reaction != RTHYB_REACT_HOLD && w->reaction != RTHYB_REACT_RAMP_OUT)
        return;
    if (e->was == RTHYB_RUNNING)
        must(o, isinf(force) ? RULE_OFF_SCALE : RULE_FORCE_REACTION, e->is != RTHYB_RUNNING, force,
             w->value);
    judge_held_force(o, e, beyond, force, w->value);
}

/* No motion begins beyond a limit that would end it. */
static void judge_admission(observer *o, const event *e, const rthyb_station *s)
{
    const int moves_on = e->in.command == RTHYB_CMD_ARM || e->in.command == RTHYB_CMD_START ||
                         e->in.command == RTHYB_CMD_RESUME;
    if (!moves_on || e->refused || o->missing)
        return;
    const double own = fabs(o->force_n - s->axis[0].tare_f), rig = fabs(o->force_n);
    must(o, RULE_ADMITTED,
         !(o->tared && own > ending(s, RTHYB_CAUSE_FORCE)) &&
             !(rig > ending(s, RTHYB_CAUSE_RIG_FORCE)),
         own, ending(s, RTHYB_CAUSE_FORCE));
}

static void judge_motion(observer *o, const event *e, const rthyb_station *s)
{
    const rthyb_record *last = &e->rows[e->count - 1];
    const rthyb_watch *tracking = &s->cfg.watch[RTHYB_CAUSE_TRACKING];
    const rthyb_watch *position = &s->cfg.watch[RTHYB_CAUSE_POSITION];
    if (!on_its_way(e->was))
        return;
    const double error = fabs(last->axis[0].x_meas_m - last->x_num_m);
    if (tracking->reaction == RTHYB_REACT_TRIP && tracking->value > 0.0 && error > tracking->value)
        must(o, RULE_TRACKING_TRIP, e->is == RTHYB_TRIPPED, error, tracking->value);
    const double asked = fabs(s->controller.axis[0].x_plc);
    if (position->reaction == RTHYB_REACT_TRIP && position->value > 0.0 && asked > position->value)
        must(o, RULE_POSITION_TRIP, e->is == RTHYB_TRIPPED, asked, position->value);
}

/* ---- what stops a test -------------------------------------------------------------------------- */

static void remember(window *w, uint64_t tick, int is)
{
    uint8_t *place = &w->is[tick % RECENT_TICKS];
    w->count += (uint32_t)(is != 0);
    w->count -= *place;
    *place = is != 0;
}

static void note_skips(observer *o, const event *e)
{
    const uint64_t ticks = (uint64_t)e->in.skipped + 1u;
    const uint64_t noted = ticks < RECENT_TICKS ? ticks : RECENT_TICKS;
    const int fresh = (e->rows[e->count - 1].flags & RTHYB_F_FRESH) != 0;
    for (uint64_t i = ticks - noted; i < ticks; i++) {
        remember(&o->skips, o->tick + i, i < ticks - 1);
        remember(&o->losses, o->tick + i, i == ticks - 1 && !fresh);
    }
}

/* A share whose limit ends a motion. A difference of one tick is due to the end of the window. */
static int beyond_share(const rthyb_station *s, int cause, uint32_t count, uint32_t otherwise)
{
    const rthyb_watch *w = &s->cfg.watch[cause];
    const double most = w->value > 0.0 ? w->value * RECENT_TICKS : otherwise;
    const int ends = !(w->value > 0.0) || w->reaction >= RTHYB_REACT_RAMP_OUT;
    return ends && count > most + 1.0;
}

static void judge_shares(observer *o, const event *e, const rthyb_station *s)
{
    if (e->in.skipped && beyond_share(s, RTHYB_CAUSE_SKIPS, o->skips.count, SKIPS_RECENT))
        must(o, RULE_SHARES, !moves(e->is) || e->in.command == RTHYB_CMD_START, o->skips.count,
             s->cfg.watch[RTHYB_CAUSE_SKIPS].value);
    if (on_its_way(e->was) &&
        beyond_share(s, RTHYB_CAUSE_LOST_PAIRS, o->losses.count, RECENT_TICKS))
        must(o, RULE_SHARES, !moves(e->is), o->losses.count,
             s->cfg.watch[RTHYB_CAUSE_LOST_PAIRS].value);
}

static int has_no_number(const event *e)
{
    return (!e->in.axis[0].lost &&
            (!isfinite(e->in.axis[0].x_m) || !isfinite(e->in.axis[0].f_n))) ||
           (e->in.axis[0].lost & RTHYB_S_NOT_FINITE);
}

static void judge_faults(observer *o, const event *e)
{
    const int tripped = e->is == RTHYB_TRIPPED, moving = moves(e->is);
    const rthyb_station_input *in = &e->in;
    if (has_no_number(e))
        must(o, RULE_NOT_FINITE, tripped, 0.0, 0.0);
    if (o->missing >= LOST_TICKS && e->is != RTHYB_IDLE)
        must(o, RULE_LINK_LOST, tripped, o->missing, LOST_TICKS);
    if ((in->axis[0].link_down || in->axis[0].drive_stopped || in->axis[0].beyond) &&
        e->was != RTHYB_IDLE)
        must(o, RULE_SURROUNDINGS, tripped || e->is == RTHYB_IDLE, e->is, 0.0);
    if (in->skipped >= STALLED_TICKS && in->command != RTHYB_CMD_RESET)
        must(o, RULE_STALLED, tripped, in->skipped, STALLED_TICKS);
    if (in->skipped > SKIPS_IN_A_ROW)
        must(o, RULE_SKIPS, !moving || in->command == RTHYB_CMD_START, in->skipped, SKIPS_IN_A_ROW);
    if (in->heartbeat_late)
        must(o, RULE_HEARTBEAT, !moving, e->is, 0.0);
}

/* ---- one tick ----------------------------------------------------------------------------------- */

static void observe(observer *o, const event *e, const rthyb_station *s, size_t ag_count)
{
    if (e->in.command == RTHYB_CMD_START && !e->refused) {
        o->running = 0;
        o->adopted = 0;
        memset(&o->skips, 0, sizeof o->skips);
        memset(&o->losses, 0, sizeof o->losses);
    }
    if (e->in.command == RTHYB_CMD_RESET && !e->refused)
        o->tared = 0;
    if (e->in.command == RTHYB_CMD_ZERO && !e->refused) {
        o->tare_readings = 0;
        o->zeroing = 1;
        o->tare_x[0] = o->tare_f[0] = INFINITY;
        o->tare_x[1] = o->tare_f[1] = -INFINITY;
    }
    judge_rows(o, e, s);
    if (o->over)
        return;
    note_skips(o, e);
    judge_admission(o, e, s);
    note_readings(o, e, s);
    judge_tare(o, e, s);
    judge_states(o, e, s);
    judge_sending(o, e);
    judge_command(o, e, s);
    judge_force(o, e, s, RTHYB_CAUSE_FORCE);
    judge_force(o, e, s, RTHYB_CAUSE_RIG_FORCE);
    judge_motion(o, e, s);
    judge_faults(o, e);
    judge_shares(o, e, s);
    if (e->is == RTHYB_RUNNING)
        must(o, RULE_LENGTH, o->running <= ag_count, (double)o->running, (double)ag_count);
    if (!on_its_way(e->is))
        o->beyond[0] = o->beyond[1] = 0;
    o->tick += (uint64_t)e->in.skipped + 1u;
    o->station += (uint64_t)e->in.skipped + 1u;
}

/* Another station continues with the same drive. */
static void observe_another(observer *o)
{
    const observer before = *o;
    *o = (observer){.seed = before.seed,
                    .tick = before.tick,
                    .over = before.over,
                    .commanded = before.commanded,
                    .anew = before.anew,
                    .at_drive_m = before.at_drive_m,
                    .since = before.since,
                    .resolution_m = before.resolution_m};
}

#endif
