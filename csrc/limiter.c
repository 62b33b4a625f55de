/* Velocity, acceleration and position of the commands, of all axes together.
 *
 * What holds of the commands that leave of an axis, and of nothing else: with x[k] the one that leaves as the
 * k-th, before the wire rounds it, and s[k] = x[k] - x[k-1],
 *   |x[k] - centre| <= limit,   |s[k]| <= v_max h,   |s[k] - s[k-1]| <= a_max h^2,
 *   s[k] s[k-1] >= 0 where, with an acceleration limit, a tick without a command lies between them,
 * whatever number of ticks that is: skipped ones, and those whose command found no room. So a gap is never
 * caught up at once, and never stops the command. A limit that comes into force while the command is beyond
 * it, or too fast for it, is reached by braking with a_max: until then |s| falls by a_max h^2 a command, and
 * x keeps to the old limit. (v_max or a_max of 0: no such bound, and then nothing to brake with.) Position
 * wins over the others.
 *
 * Several axes hold one specimen: where one of them has to stay behind, all do, by one factor, so that what
 * they do together keeps its direction. The steps of all axes are shortened by the smallest factor that one of
 * them needs for its velocity or its position, and so are the changes of all steps for the acceleration. What
 * is closed after a lag, and braked before a limit, is so at the pace of the axis that brakes worst. Where a
 * direction and a limit cannot both be kept (a turn in front of a limit, a gap), it is the limit.
 *
 * The same holds of the pose that the commands of all axes have the specimen in: |q_j| <= limit_j along each
 * interface that has one, and above the limits of velocity and acceleration. */
#include "limiter.h"

#include <string.h>

#include "numeric.h"

enum { MOST = RTHYB_COUPLED_MAX };

#define DIRECTION_LOOKS 3
#define AT_DIRECTION 1e-6 /* m or rad: as near to the limit of a direction as counts as at it */

void limiter_rest(rthyb_limiter *l, double x_m)
{
    l->x_lim = l->x_lim1 = x_m;
    l->step = l->step1 = 0.0;
    l->gap = 0;
}

void limiter_note(rthyb_limiter *l, double x_cmd, int blind)
{
    l->x_lim1 = l->x_lim;
    l->step1 = l->step;
    l->step = blind ? l->step : x_cmd - l->x_lim;
    l->x_lim = blind ? l->x_lim : x_cmd;
    l->gap = blind;
}

void limiter_stayed(rthyb_limiter *l)
{
    l->x_lim = l->x_lim1;
    l->step = l->step1;
    l->gap = 1;
}

/* All of `to` come back towards `from` by one factor, until each lies within its bounds. The one that needs
 * it most ends on its bound, to the last digit. */
PER_COUNT void draw_back(int n, const double *from, const double *low, const double *high,
                         double *to)
{
    double kept[MOST], share[MOST], least = 1.0;
    int inside = 1;
    for (int i = 0; i < n; i++)
        inside = inside && to[i] >= low[i] && to[i] <= high[i];
    if (inside)
        return;
    for (int i = 0; i < n; i++) {
        kept[i] = clamp(to[i], low[i], high[i]);
        share[i] = kept[i] == to[i] || to[i] == from[i]
                       ? 1.0
                       : clamp((kept[i] - from[i]) / (to[i] - from[i]), 0.0, 1.0);
        least = fmin(least, share[i]);
    }
    for (int i = 0; i < n; i++)
        to[i] = share[i] == least ? kept[i]
                                  : clamp(from[i] + least * (to[i] - from[i]), low[i], high[i]);
}

/* The step that closes a lag and can still be braked away with half the acceleration limit. */
static double catch_up(double lag, double a_max, double h)
{
    const double brake = 0.5 * a_max, half = 0.5 * brake * h;
    return copysign(h * (sqrt(2.0 * brake * fabs(lag) + half * half) - half), lag);
}

/* No faster towards a limit than can be braked before it, with some of the deceleration to spare. */
static double before_the_end(double room, double a_max, double h)
{
    return room > 0.0 ? catch_up(room, 1.6 * a_max, h) : 0.0;
}

/* How far from the clamp's centre a command may be. */
static double position_limit(const rthyb_axis_control *cfg)
{
    return cfg->clamp_m > 0.0 ? cfg->clamp_m : COMMAND_MAX_M;
}

/* The steps that catch up with what is wanted, no faster than they can be braked: else the commands would
 * swing about that for ever. */
PER_COUNT void close_lags(int n, const rthyb_controller *c, const double *wanted, double *step)
{
    double closing[MOST], share[MOST], least = HUGE_VAL;
    for (int i = 0; i < n; i++) {
        const double a_max = c->cfg.axis[i].acceleration_limit_m_per_s2;
        const double lag = c->axis[i].x_plc - c->axis[i].limiter.x_lim;
        closing[i] = catch_up(lag, a_max, c->cfg.period_s);
        const int lags = a_max > 0.0 && fabs(closing[i]) < fabs(lag);
        share[i] = lags ? closing[i] / lag : HUGE_VAL;
        least = fmin(least, share[i]);
    }
    for (int i = 0; i < n; i++) {
        const double x_plc = c->axis[i].x_plc, x_lim = c->axis[i].limiter.x_lim;
        if (least < HUGE_VAL)
            step[i] =
                wanted[i] - x_plc + (share[i] == least ? closing[i] : least * (x_plc - x_lim));
    }
}

/* What an axis can brake with while it keeps pace with all others. */
PER_COUNT double joint_acceleration(int n, const rthyb_controller *c, const double *step, int axis)
{
    double most = c->cfg.axis[axis].acceleration_limit_m_per_s2;
    for (int k = 0; k < n; k++) {
        const double a_max = c->cfg.axis[k].acceleration_limit_m_per_s2;
        if (k != axis && a_max > 0.0 && step[k] != 0.0)
            most = fmin(most, a_max * fabs(step[axis]) / fabs(step[k]));
    }
    return most;
}

/* Steps that can still be braked before the position limits; `alone`: each axis by itself. */
PER_COUNT void brake_in_time(int n, const rthyb_controller *c, double *step, int alone)
{
    const double h = c->cfg.period_s, none[MOST] = {0.0};
    double low[MOST] = {0.0}, high[MOST] = {0.0};
    for (int i = 0; i < n; i++) {
        const rthyb_axis_control *cfg = &c->cfg.axis[i];
        const double out = c->axis[i].limiter.x_lim - cfg->clamp_centre_m;
        const double room = position_limit(cfg) - copysign(out, out * step[i]);
        const double a_max =
            alone ? cfg->acceleration_limit_m_per_s2 : joint_acceleration(n, c, step, i);
        const int brakes = cfg->acceleration_limit_m_per_s2 > 0.0;
        high[i] = brakes ? before_the_end(room, a_max, h) : HUGE_VAL;
        low[i] = -high[i];
        if (alone)
            step[i] = clamp(step[i], low[i], high[i]);
    }
    if (!alone)
        draw_back(n, none, low, high, step);
}

PER_COUNT void limit_velocity(int n, const rthyb_controller *c, double *step)
{
    const double none[MOST] = {0.0};
    double low[MOST] = {0.0}, high[MOST] = {0.0};
    for (int i = 0; i < n; i++) {
        const double v_max = c->cfg.axis[i].velocity_limit_m_per_s;
        high[i] = v_max > 0.0 ? v_max * c->cfg.period_s : HUGE_VAL;
        low[i] = -high[i];
    }
    draw_back(n, none, low, high, step);
}

/* After a gap no step goes the other way at once. */
PER_COUNT void keep_way(int n, const rthyb_controller *c, double *step)
{
    for (int i = 0; i < n; i++) {
        const rthyb_limiter *l = &c->axis[i].limiter;
        if (l->gap && l->step != 0.0 && c->cfg.axis[i].acceleration_limit_m_per_s2 > 0.0)
            step[i] = l->step > 0.0 ? fmax(step[i], 0.0) : fmin(step[i], 0.0);
    }
}

/* From the steps of before; one that braked for its own position limit keeps to that. */
PER_COUNT void limit_acceleration(int n, const rthyb_controller *c, double *step)
{
    const double h = c->cfg.period_s;
    double from[MOST] = {0.0}, low[MOST] = {0.0}, high[MOST] = {0.0};
    for (int i = 0; i < n; i++) {
        const double a_max = c->cfg.axis[i].acceleration_limit_m_per_s2;
        from[i] = c->axis[i].limiter.step;
        low[i] = a_max > 0.0 ? from[i] - a_max * h * h : -HUGE_VAL;
        high[i] = a_max > 0.0 ? from[i] + a_max * h * h : HUGE_VAL;
    }
    draw_back(n, from, low, high, step);
    if (n == 1)
        return;
    brake_in_time(n, c, step, 1);
    for (int i = 0; i < n; i++)
        step[i] = clamp(step[i], low[i], high[i]);
}

/* Of a limit that was drawn in behind it, or close before it, the command comes back on its own course
 * and not at once: with an acceleration limit it may go on as far as it needs to brake, but never beyond
 * a limit that was there before. */
static void draw_bounds(const rthyb_axis_control *cfg, double h, rthyb_limiter *l)
{
    const double per_tick2 = cfg->acceleration_limit_m_per_s2 * h * h;
    const double braked = per_tick2 > 0.0 ? 0.5 * l->step * fabs(l->step) / per_tick2 : 0.0;
    const double centre = cfg->clamp_centre_m, limit = position_limit(cfg);
    l->upper_m =
        greater_of(centre + limit, less_of(l->upper_m, l->x_lim + greater_of(0.0, braked)));
    l->lower_m = less_of(centre - limit, greater_of(l->lower_m, l->x_lim + less_of(0.0, braked)));
}

/* Whether an axis has a limit of its acceleration, and one of its velocity. */
PER_COUNT int accelerates(int n, const rthyb_controller *c)
{
    int any = 0;
    for (int i = 0; i < n; i++)
        any = any || c->cfg.axis[i].acceleration_limit_m_per_s2 > 0.0;
    return any;
}

PER_COUNT int has_velocity(int n, const rthyb_controller *c)
{
    int any = 0;
    for (int i = 0; i < n; i++)
        any = any || c->cfg.axis[i].velocity_limit_m_per_s > 0.0;
    return any;
}

/* ---- along the interfaces -------------------------------------------------------------------------- */

static int has_directions(int n, const rthyb_controller *c)
{
    int any = 0;
    for (int j = 0; j < n; j++)
        any = any || c->cfg.direction_clamp[j] > 0.0;
    return any;
}

/* Where commands have the specimen, found from where it is asked to be; 0 where they have it nowhere. */
static int pose_of(int n, const rthyb_controller *c, const double *x, double *pose)
{
    memcpy(pose, x, (size_t)n * sizeof *pose);
    if (c->cfg.kinematics.size == 0)
        return 1;
    rthyb_kinematics trial = c->kinematics;
    for (int j = 0; j < n; j++)
        trial.pose[j] = c->interface[j].x_num;
    return rthyb_kinematics_pose(&trial, x, pose) == RTHYB_OK;
}

/* What the commands of a tick are along the interfaces: where they come from, and where they go. */
typedef struct {
    double from[MOST], to[MOST];
} ways;

static int find_ways(int n, const rthyb_controller *c, const double *step, ways *way)
{
    double from[MOST] = {0.0}, to[MOST] = {0.0};
    for (int i = 0; i < n; i++) {
        from[i] = c->axis[i].limiter.x_lim;
        to[i] = from[i] + step[i];
    }
    return pose_of(n, c, from, way->from) && pose_of(n, c, to, way->to);
}

/* What a direction can be braked with while the axes keep pace: the one that brakes worst decides. */
static double direction_acceleration(int n, const rthyb_controller *c, const double *step,
                                     double way)
{
    double most = HUGE_VAL;
    for (int i = 0; i < n; i++) {
        const double a_max = c->cfg.axis[i].acceleration_limit_m_per_s2;
        if (a_max > 0.0 && step[i] != 0.0)
            most = fmin(most, a_max * fabs(way) / fabs(step[i]));
    }
    return most;
}

/* Steps that can still be braked before the limits of the directions, all by one factor. */
static void brake_directions(int n, const rthyb_controller *c, double *step)
{
    ways way;
    double least = 1.0;
    if (!has_directions(n, c) || !find_ways(n, c, step, &way))
        return;
    for (int j = 0; j < n; j++) {
        const double limit = c->cfg.direction_clamp[j], along = way.to[j] - way.from[j];
        const double room = limit - copysign(way.from[j], way.from[j] * along);
        const double a_max = direction_acceleration(n, c, step, along);
        if (!(limit > 0.0) || along == 0.0 || !(a_max < HUGE_VAL))
            continue;
        least = fmin(least, before_the_end(room, a_max, c->cfg.period_s) / fabs(along));
    }
    for (int i = 0; i < n && least < 1.0; i++)
        step[i] *= least;
}

/* What one direction lets through of a way: all of it, or as far as its limit. One that is beyond it already comes
 * back, and goes no further. */
static double let_through(double limit, double from, double to)
{
    const double bound = copysign(fmax(limit, fabs(from)), to);
    const double out = fabs(to) - fabs(bound);
    return out > 0.0 ? clamp((bound - from) / (to - from), 0.0, 1.0) : 1.0;
}

/* And in spite of everything: commands that would lead beyond go so far as the limit, all by one factor. Where the
 * geometry is curved the second look finds what the first has left. */
static void keep_directions(int n, rthyb_controller *c, const double *wanted, double *command)
{
    double step[MOST] = {0.0}, beyond[MOST] = {0.0};
    c->at_direction = 0;
    if (!has_directions(n, c))
        return;
    const int known = pose_of(n, c, wanted, beyond);
    for (int look = 0; look < DIRECTION_LOOKS; look++) {
        ways way;
        double least = 1.0;
        for (int i = 0; i < n; i++)
            step[i] = command[i] - c->axis[i].limiter.x_lim;
        const int found = find_ways(n, c, step, &way);
        for (int j = 0; j < n && found; j++) {
            const double limit = c->cfg.direction_clamp[j];
            if (limit > 0.0)
                least = fmin(least, let_through(limit, way.from[j], way.to[j]));
            c->at_direction |= known && limit > 0.0 && fabs(beyond[j]) > limit + AT_DIRECTION &&
                               fabs(way.to[j]) >= limit - AT_DIRECTION;
        }
        for (int i = 0; i < n && least < 1.0; i++)
            command[i] = c->axis[i].limiter.x_lim + least * step[i];
        if (!(least < 1.0))
            return;
    }
}

PER_COUNT void limit_steps(int n, const rthyb_controller *c, const double *wanted, double *step)
{
    const int brakes = accelerates(n, c);
    for (int i = 0; i < n; i++)
        step[i] = wanted[i] - c->axis[i].limiter.x_lim;
    if (brakes) {
        close_lags(n, c, wanted, step);
        brake_in_time(n, c, step, 0);
        if (n > 1)
            brake_directions(n, c, step);
    }
    if (has_velocity(n, c))
        limit_velocity(n, c, step);
    if (brakes) {
        keep_way(n, c, step);
        limit_acceleration(n, c, step);
    }
}

/* An axis that its own position limit stops at once holds the others on the straight way, but no faster than each
 * of them brakes: one that is nowhere near a limit does not leap. */
PER_COUNT void spare_the_others(int n, const rthyb_controller *c, const double *low,
                                const double *high, double *command)
{
    const double h = c->cfg.period_s;
    for (int i = 0; i < n; i++) {
        const rthyb_limiter *l = &c->axis[i].limiter;
        const double most = c->cfg.axis[i].acceleration_limit_m_per_s2 * h * h;
        const double step = command[i] - l->x_lim;
        const double kept = most > 0.0 ? clamp(step, l->step - most, l->step + most) : step;
        if (kept != step)
            command[i] = clamp(l->x_lim + kept, low[i], high[i]);
    }
}

/* It goes on from what it wanted itself: from a coarse wire's rounding a slow command would never get away. */
PER_COUNT void limit_all(int n, rthyb_controller *c, const double *wanted, double *command)
{
    double step[MOST] = {0.0}, from[MOST] = {0.0}, low[MOST] = {0.0}, high[MOST] = {0.0};
    limit_steps(n, c, wanted, step);
    for (int i = 0; i < n; i++) {
        rthyb_limiter *l = &c->axis[i].limiter;
        draw_bounds(&c->cfg.axis[i], c->cfg.period_s, l);
        from[i] = l->x_lim;
        low[i] = l->lower_m;
        high[i] = l->upper_m;
        command[i] = step[i] == wanted[i] - l->x_lim ? wanted[i] : l->x_lim + step[i];
    }
    draw_back(n, from, low, high, command);
    if (n > 1) {
        spare_the_others(n, c, low, high, command);
        keep_directions(n, c, wanted, command);
    }
}

/* Where there is one axis, and the compiler knows it, no loop is left. */
void limiter_commands(int n, rthyb_controller *c, const double *wanted, double *command)
{
    if (n == 1)
        limit_all(1, c, wanted, command);
    else
        limit_all(n, c, wanted, command);
}
