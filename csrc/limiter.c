/* Limits of velocity, acceleration and position for the commands of all axes together.
 *
 * The following holds for the commands that are sent to an axis, and only for those: with x[k] the
 * k-th command sent, before rounding on the wire, and s[k] = x[k] - x[k-1],
 *   |x[k] - centre| <= limit,   |s[k]| <= v_max h,   |s[k] - s[k-1]| <= a_max h^2,
 *   s[k] s[k-1] >= 0 if, with an acceleration limit, a tick without a command lies between them,
 * regardless of the number of ticks between them: skipped ticks, or ticks whose command the link
 * did not accept. So a gap is never caught up at once, and never stops the command. If a limit
 * takes effect while the command is beyond it, or too fast for it, the command brakes with a_max:
 * until it is within the limit, |s| decreases by a_max h^2 per command, and x keeps to the old
 * limit. (If v_max or a_max is 0, that bound does not exist, and without a_max there is no
 * braking.) Position has priority over the others.
 *
 * Several axes hold one specimen: if one of them has to stay behind, all do, by one factor, so that
 * their combined motion keeps its direction. The steps of all axes are reduced by the smallest
 * factor that any of them needs for its velocity or its position, and the changes of all steps
 * likewise for the acceleration. Closing a lag, and braking before a limit, takes place at the pace
 * of the axis that brakes worst. Where direction and limit cannot both be kept (a reversal in front
 * of a limit, a gap), the limit is kept.
 *
 * The same applies to the pose that corresponds to the commands of all axes: |q_j| <= limit_j along
 * each interface that has a limit, with priority over the limits of velocity and acceleration. */
#include "limiter.h"

#include <string.h>

#include "numeric.h"

enum { MOST = RTHYB_COUPLED_MAX };

#define DIRECTION_LOOKS 3
#define AT_DIRECTION 1e-6 /* m or rad: distance that counts as being at the limit */

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

/* Moves all of `to` back towards `from` by one factor, until each is within its bounds. The one
 * that determines the factor ends exactly on its bound. */
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

/* Step that closes a lag and can still be braked with half the acceleration limit. */
static double catch_up(double lag, double a_max, double h)
{
    const double brake = 0.5 * a_max, half = 0.5 * brake * h;
    return copysign(h * (sqrt(2.0 * brake * fabs(lag) + half * half) - half), lag);
}

/* Largest step towards a limit from which the command can still brake before it, with some
 * deceleration to spare. */
static double before_the_end(double room, double a_max, double h)
{
    return room > 0.0 ? catch_up(room, 1.6 * a_max, h) : 0.0;
}

/* Largest distance of a command from the centre of the clamp. */
static double position_limit(const rthyb_axis_control *cfg)
{
    return cfg->clamp_m > 0.0 ? cfg->clamp_m : COMMAND_MAX_M;
}

/* Steps that catch up with the wanted commands, no faster than they can be braked: otherwise the
 * commands would oscillate about them for ever. */
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

/* Acceleration with which an axis can brake while it keeps pace with all others. */
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

/* Steps that can still be braked before the position limits; `alone`: each axis individually. */
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

/* After a gap, no step reverses at once. */
PER_COUNT void keep_way(int n, const rthyb_controller *c, double *step)
{
    for (int i = 0; i < n; i++) {
        const rthyb_limiter *l = &c->axis[i].limiter;
        if (l->gap && l->step != 0.0 && c->cfg.axis[i].acceleration_limit_m_per_s2 > 0.0)
            step[i] = l->step > 0.0 ? fmax(step[i], 0.0) : fmin(step[i], 0.0);
    }
}

/* Relative to the previous steps; an axis that brakes for its own position limit still does so. */
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

/* If a limit is moved behind the command, or close in front of it, the command returns along its
 * own path, not at once: with an acceleration limit, it may continue for its braking distance, but
 * never beyond the previous limit. */
static void draw_bounds(const rthyb_axis_control *cfg, double h, rthyb_limiter *l)
{
    const double per_tick2 = cfg->acceleration_limit_m_per_s2 * h * h;
    const double braked = per_tick2 > 0.0 ? 0.5 * l->step * fabs(l->step) / per_tick2 : 0.0;
    const double centre = cfg->clamp_centre_m, limit = position_limit(cfg);
    l->upper_m =
        greater_of(centre + limit, less_of(l->upper_m, l->x_lim + greater_of(0.0, braked)));
    l->lower_m = less_of(centre - limit, greater_of(l->lower_m, l->x_lim + less_of(0.0, braked)));
}

/* Whether any axis has an acceleration limit; below: a velocity limit. */
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

static int has_directions(const rthyb_controller *c)
{
    int any = 0;
    for (int j = 0; j < c->cfg.interface_count; j++)
        any = any || c->cfg.direction_clamp[j] > 0.0;
    return any;
}

/* Pose that corresponds to commands, searched for from the commanded pose; 0 if there is none. */
static int pose_of(int n, const rthyb_controller *c, const double *x, double *pose)
{
    memcpy(pose, x, (size_t)n * sizeof *pose);
    if (c->cfg.kinematics.size == 0)
        return 1;
    rthyb_kinematics trial = c->kinematics;
    for (int j = 0; j < c->cfg.interface_count; j++)
        trial.pose[j] = c->interface[j].x_num;
    return rthyb_kinematics_pose(&trial, x, pose) == RTHYB_OK;
}

/* Commands of a tick in interface coordinates: the previous ones and the new ones. */
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

/* Acceleration with which a direction can be braked while the axes keep pace; the axis that brakes
 * worst determines it. */
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

/* Steps that can still be braked before the limits of the interface coordinates, all by one
 * factor. */
static void brake_directions(int n, const rthyb_controller *c, double *step)
{
    ways way;
    double least = 1.0;
    if (!has_directions(c) || !find_ways(n, c, step, &way))
        return;
    for (int j = 0; j < c->cfg.interface_count; j++) {
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

/* Share of a change that the limit of one interface coordinate permits: all of it, or as far as the
 * limit. A coordinate that is already beyond its limit may return but go no further out. */
static double permitted_share(double limit, double from, double to)
{
    const double bound = copysign(fmax(limit, fabs(from)), to);
    const double out = fabs(to) - fabs(bound);
    return out > 0.0 ? clamp((bound - from) / (to - from), 0.0, 1.0) : 1.0;
}

/* Final bound: commands that would lead beyond a limit end at the limit, all by one factor. If the
 * geometry is curved, later passes correct what the first one leaves. */
static void keep_directions(int n, rthyb_controller *c, const double *wanted, double *command)
{
    double step[MOST] = {0.0}, beyond[MOST] = {0.0};
    c->at_direction = 0;
    if (!has_directions(c))
        return;
    const int known = pose_of(n, c, wanted, beyond);
    for (int look = 0; look < DIRECTION_LOOKS; look++) {
        ways way;
        double least = 1.0;
        for (int i = 0; i < n; i++)
            step[i] = command[i] - c->axis[i].limiter.x_lim;
        const int found = find_ways(n, c, step, &way);
        for (int j = 0; j < c->cfg.interface_count && found; j++) {
            const double limit = c->cfg.direction_clamp[j];
            if (limit > 0.0)
                least = fmin(least, permitted_share(limit, way.from[j], way.to[j]));
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

/* An axis that its own position limit stops at once keeps the others on the straight line, but
 * brakes each of them no faster than its limit permits: an axis that is nowhere near a limit does
 * not jump. */
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

/* Continues from its own unrounded result: from a value rounded on a coarse wire, a slow command
 * would never move on. */
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

double limiter_single_command(rthyb_controller *c, double wanted)
{
    double command;
    limit_all(1, c, &wanted, &command);
    return command;
}

void limiter_commands(int n, rthyb_controller *c, const double *wanted, double *command)
{
    limit_all(n, c, wanted, command);
}
