/* Paths of the commands while the equation of motion does not determine them, and bounds of the
 * commands.
 *
 * Paths are defined in interface coordinates. All have the same duration, which follows from the
 * limits of the axes. */
#include <string.h>

#include "station.h"

enum { MOST = RTHYB_COUPLED_MAX };

/* ---- limits of paths --------------------------------------------------------------------------- */

/* The tighter of two limits, of paths and of commands; 0 means no limit of the command. */
static double narrower(double path, double command)
{
    return command > 0.0 ? fmin(path, command) : path;
}

static double path_velocity(const rthyb_station_config *c, int i)
{
    return narrower(c->path_velocity_m_per_s, c->controller.axis[i].velocity_limit_m_per_s);
}

static double path_acceleration(const rthyb_station_config *c, int i)
{
    return narrower(c->path_acceleration_m_per_s2,
                    c->controller.axis[i].acceleration_limit_m_per_s2);
}

static double brake_acceleration(const rthyb_station_config *c, int i)
{
    const double own = c->brake_acceleration_m_per_s2;
    return own > 0.0 ? narrower(own, c->controller.axis[i].acceleration_limit_m_per_s2)
                     : path_acceleration(c, i);
}

void course_caps(const rthyb_station *s, path_caps *caps)
{
    for (int i = 0; i < axes_of(s); i++) {
        caps->velocity[i] = path_velocity(&s->cfg, i);
        caps->acceleration[i] = path_acceleration(&s->cfg, i);
        caps->brake[i] = brake_acceleration(&s->cfg, i);
    }
}

int course_narrows(const rthyb_station *s, const path_caps *before)
{
    path_caps now;
    int narrows = 0;
    course_caps(s, &now);
    for (int i = 0; i < axes_of(s); i++)
        narrows |= now.velocity[i] < before->velocity[i] ||
                   now.acceleration[i] < before->acceleration[i] || now.brake[i] < before->brake[i];
    return narrows;
}

static path_limits limits_of(const rthyb_station *s)
{
    path_limits limits = {
        .period_s = s->cfg.controller.period_s,
        .axes = axes_of(s),
        .directions = interfaces_of(s),
        .least_way = s->ticks.least_way,
        .turn = s->ticks.turn,
        .least_turn = s->ticks.least_turn,
    };
    for (int i = 0; i < limits.axes; i++) {
        limits.velocity_m_per_s[i] = path_velocity(&s->cfg, i);
        limits.acceleration_m_per_s2[i] = path_acceleration(&s->cfg, i);
        limits.brake_m_per_s2[i] = brake_acceleration(&s->cfg, i);
        limits.jacobian[i * limits.directions + i] = 1.0;
    }
    if (s->cfg.controller.kinematics.size > 0) {
        rthyb_kinematics_jacobian(&s->controller.kinematics, limits.jacobian);
        if (s->cfg.controller.kinematics.kind == RTHYB_KINEMATICS_PINS)
            limits.pins = &s->controller.kinematics;
    }
    return limits;
}

static void plan(rthyb_station *s, const double from[][3], const double to[][3])
{
    const path_limits limits = limits_of(s);
    path_between(&limits, from, to, s->path);
}

/* State of rest at the commanded position of the specimen. */
static void stand(const rthyb_station *s, double now[][3])
{
    for (int j = 0; j < interfaces_of(s); j++) {
        now[j][0] = s->controller.interface[j].x_num;
        now[j][1] = now[j][2] = 0.0;
    }
}

/* Displacement, velocity and acceleration of the command, before phase lead. */
static void present(rthyb_station *s, double now[][3])
{
    const double h = s->cfg.controller.period_s;
    rthyb_interface at[MOST];
    const int running = s->state == RTHYB_RUNNING;
    stand(s, now);
    if (running) {
        const rthyb_numerical part = part_of(&s->controller);
        rthyb_numerical_look(&part, at);
    }
    for (int j = 0; j < interfaces_of(s); j++) {
        const double x = now[j][0];
        if (running) {
            now[j][2] = (x - 2.0 * at[j].x1 + at[j].x2) / (h * h);
            now[j][1] = (x - at[j].x1) / h + 0.5 * h * now[j][2];
        } else if (!path_done(&s->path[j])) {
            path_along(&s->path[j], h, now[j]);
        }
        now[j][0] = x;
    }
}

/* ---- ways -------------------------------------------------------------------------------------- */

void course_brake_in(rthyb_station *s, int state, int leg)
{
    double now[MOST][3];
    present(s, now);
    station_enter(s, state);
    s->leg = leg;
    const path_limits limits = limits_of(s);
    path_to_rest(&limits, now, s->path);
}

int course_can_hold(const rthyb_station *s)
{
    return s->state == RTHYB_RUNNING || (s->state == RTHYB_HOLD && s->leg >= 2);
}

/* RESUME leads to where the test was interrupted, even if the way back is held again. */
void course_hold(rthyb_station *s)
{
    if (s->state == RTHYB_RUNNING)
        present(s, s->resume);
    s->interrupted = 1;
    course_brake_in(s, RTHYB_HOLD, 0);
}

void course_resume(rthyb_station *s)
{
    double from[MOST][3];
    stand(s, from);
    plan(s, from, s->resume);
    s->leg = 2;
}

void course_ramp_to_zero(rthyb_station *s)
{
    const path_limits limits = limits_of(s);
    double way[MOST];
    for (int j = 0; j < interfaces_of(s); j++)
        way[j] = s->controller.interface[j].x_num;
    const int64_t least = path_ramp_ticks(&limits, way), usual = s->cfg.ramp_in_ticks;
    for (int j = 0; j < interfaces_of(s); j++)
        s->path[j] = path_ramp(way[j], 0.0, least > usual ? least : usual);
    s->leg = 0;
}

void course_replan(rthyb_station *s)
{
    if (path_done(&s->path[0]))
        return;
    if (s->state == RTHYB_RAMP_IN)
        course_brake_in(s, RTHYB_RAMP_IN, 1);
    else if (s->state == RTHYB_HOLD)
        course_brake_in(s, RTHYB_HOLD, s->leg >= 2 ? 3 : 0);
    else if (s->state == RTHYB_RAMP_OUT)
        course_brake_in(s, RTHYB_RAMP_OUT, 0);
}

const double *course_next(rthyb_station *s, double *x)
{
    const int on_the_way = s->state == RTHYB_RAMP_IN || s->state == RTHYB_RAMP_OUT ||
                           (s->state == RTHYB_HOLD && s->leg != 1);
    if (s->state == RTHYB_RUNNING)
        return NULL;
    for (int j = 0; j < interfaces_of(s); j++)
        x[j] = on_the_way ? path_follow(&s->path[j], s->cfg.controller.period_s)
                          : s->controller.interface[j].x_num;
    return x;
}

/* ---- how far ----------------------------------------------------------------------------------- */

/* Permitted range of a command, from the test's limit about the tare and the rig's limit about the
 * drive's own zero. */
typedef struct {
    double low, high;
} range;

static double farthest(const rthyb_station *s, int axis, int cause)
{
    const rthyb_watch *watch = watch_of(s, axis, cause);
    const int ends = watch->reaction >= RTHYB_REACT_HOLD && watch->value > 0.0;
    return ends ? watch->value : HUGE_VAL;
}

static range reach(const rthyb_station *s, int axis)
{
    const double own = farthest(s, axis, RTHYB_CAUSE_POSITION);
    const double rig = farthest(s, axis, RTHYB_CAUSE_RIG_POSITION);
    const double zero = s->axis[axis].tare_cmd;
    return (range){fmax(-own, -rig - zero), fmin(own, rig - zero)};
}

/* Final bound of the commands: a command that exceeds a limit which interrupts the test must not be
 * sent in the first place. Applies from START on; before the tare there is no zero for the
 * limits. */
void course_confine(rthyb_station *s)
{
    for (int i = 0; i < axes_of(s); i++) {
        rthyb_axis_control *cfg = &s->controller.cfg.axis[i];
        const range within = reach(s, i);
        const int counts = is_on_its_way(s->state) && within.high < HUGE_VAL;
        /* If the limits leave no range between them, the command goes to the middle of the two. */
        cfg->clamp_m = counts ? fmax(0.5 * (within.high - within.low), ARRIVED_M) : 0.0;
        cfg->clamp_centre_m = counts ? 0.5 * (within.high + within.low) : 0.0;
    }
    for (int j = 0; j < interfaces_of(s) && axes_of(s) > 1; j++) {
        const rthyb_watch *watch = &s->cfg.interface[j].position;
        const int ends = watch->reaction >= RTHYB_REACT_HOLD && is_on_its_way(s->state);
        s->controller.cfg.direction_clamp[j] = ends ? watch->value : 0.0;
    }
}

/* Neither across the limit nor, if the command is already beyond it, further out. The command that
 * a trip repeats was sent before, and is not bounded. */
void course_bounds(const rthyb_station *s, int axis, rthyb_axis_output *out)
{
    const double x = s->controller.axis[axis].x_cmd;
    const range within = reach(s, axis);
    const int free = !s->commands || s->state == RTHYB_TRIPPED;
    const double zero = s->axis[axis].tare_cmd;
    out->low_m = free ? -HUGE_VAL : zero + fmin(within.low, x);
    out->high_m = free ? HUGE_VAL : zero + fmax(within.high, x);
}

/* ---- where it ends ----------------------------------------------------------------------------- */

/* Where the command of an axis ends: at its target, or at the limit before which it brakes. */
static double aim_of(const rthyb_station *s, int axis)
{
    const range within = reach(s, axis);
    return fmin(fmax(s->controller.axis[axis].x_plc, within.low), within.high);
}

/* Whether an axis has stopped at its position limit, or all axes at the limit of an interface
 * coordinate: the other axes, which it keeps on the straight line, then stay where they are. */
static int holds_the_others(const rthyb_station *s)
{
    int holds = s->controller.at_direction;
    for (int i = 0; i < axes_of(s) && axes_of(s) > 1; i++) {
        const rthyb_controller_axis *a = &s->controller.axis[i];
        const double aim = aim_of(s, i);
        holds |= fabs(aim - a->x_plc) > ARRIVED_M && fabs(a->limiter.x_lim - aim) <= ARRIVED_M;
    }
    return holds;
}

/* Distance of a command from the end of its path, or its change within 1/1024 s (at any sampling
 * rate) if that is larger. */
static double away_from_end(const rthyb_station *s, int axis, int held)
{
    const rthyb_controller_axis *a = &s->controller.axis[axis];
    const double aim = aim_of(s, axis);
    const double way = held ? 0.0 : fabs(a->limiter.x_lim - aim);
    const double off = fmax(way, fabs(a->x_plc - a->target));
    return fmax(off, fabs(a->limiter.x_lim - a->limiter.x_lim1) * s->ticks.pace);
}

/* Whether the commands are at the ends of their paths and at rest; one that oscillates only passes
 * its end. If they come no nearer, the station trips: whatever keeps them away, a limit or an
 * oscillating compensator, would otherwise keep this state for ever. */
static int has_arrived(rthyb_station *s)
{
    double away = 0.0;
    int last = 0;
    const int held = holds_the_others(s);
    for (int i = 0; i < axes_of(s); i++) {
        const double own = away_from_end(s, i, held);
        last = own > away ? i : last;
        away = fmax(away, own);
    }
    if (away <= ARRIVED_M)
        return 1;
    if (away < s->nearest_m - ARRIVED_M) {
        s->nearest_m = away;
        s->no_nearer = 0;
    } else if (++s->no_nearer >= s->ticks.arrival) {
        station_trip(s, (finding){RTHYB_CAUSE_NOT_ARRIVED, away, ARRIVED_M, of_axis(last)});
    }
    return 0;
}

/* At rest, the commands have no bounds: they must not continue to where a limit has kept them from,
 * and a compensator that still remembers the motion must not move them again. */
static void stay_there(rthyb_station *s)
{
    double x[MOST];
    int kept = 0;
    for (int i = 0; i < axes_of(s); i++) {
        const rthyb_controller_axis *a = &s->controller.axis[i];
        x[i] = a->limiter.x_lim;
        kept |= fabs(x[i] - a->x_plc) > ARRIVED_M || fabs(a->x_plc - a->target) > ARRIVED_M;
    }
    if (kept)
        rthyb_controller_rest(&s->controller, x);
}

/* Before the state of rest, compensators and limiter must have settled too; until then, everything
 * is monitored as during motion. */
void course_arrive(rthyb_station *s)
{
    if (s->state == RTHYB_IDLE)
        stay_there(s);
    const int waits = (s->state == RTHYB_RAMP_IN && s->leg == 0) ||
                      (s->state == RTHYB_RAMP_OUT && s->leg == 1) ||
                      (s->state == RTHYB_RAMP_OUT && s->cfg.stay);
    if (!path_done(&s->path[0]) || (waits && !has_arrived(s)))
        return;
    if (s->state == RTHYB_RAMP_IN && s->leg == 1) {
        course_ramp_to_zero(s);
    } else if (s->state == RTHYB_HOLD && s->leg == 3) {
        course_resume(s);
    } else if (s->state == RTHYB_RAMP_IN || (s->state == RTHYB_HOLD && s->leg == 2)) {
        station_enter(s, RTHYB_RUNNING);
    } else if (s->state == RTHYB_HOLD) {
        s->leg = 1;
    } else if (s->state == RTHYB_RAMP_OUT && s->leg == 0 && !s->cfg.stay) {
        double from[MOST][3];
        const double rest[MOST][3] = {{0.0}};
        stand(s, from);
        plan(s, from, rest);
        s->leg = 1;
    } else if (s->state == RTHYB_RAMP_OUT) {
        stay_there(s);
        station_enter(s, RTHYB_IDLE);
    }
}
