/* One sample of the controller: gate -> law observes -> RFC -> numerical part -> law leads -> limiter. A pure
 * function of (state, input). */
#include "internal.h"
#include "numeric.h"

#define FREEZE_AFTER_S (3.0 / 1024.0) /* of lost samples, after which alpha and k_t are held */
#define EXTRAPOLATE_UNTIL_S                                                                        \
    (20.0 / 1024.0) /* of them, until which the measurement is extrapolated */
#define COMMAND_MAX_M (1e2 * RTHYB_DISPLACEMENT_MAX_M)

int rthyb_controller_init(rthyb_controller *c, const rthyb_controller_config *cfg)
{
    if (!(cfg->period_s > 0.0 && cfg->period_s <= 1.0) || cfg->motion.period_s != cfg->period_s)
        return RTHYB_E_PERIOD;
    if (!(cfg->velocity_limit_m_per_s >= 0.0 && cfg->acceleration_limit_m_per_s2 >= 0.0 &&
          cfg->x_range_m >= 0.0 && cfg->f_range_n >= 0.0 && cfg->clamp_m >= 0.0))
        return RTHYB_E_LIMIT;
    *c = (rthyb_controller){.cfg = *cfg, .state = RTHYB_RUNNING};
    int error = rthyb_law_init(&c->law, &cfg->law, cfg->period_s, 0.0);
    if (!error)
        error = rthyb_rfc_init(&c->rfc, &cfg->rfc, 0.0, 0.0);
    const rthyb_numerical part = part_of(c);
    if (!error)
        error = rthyb_numerical_init(&part, 0.0);
    if (!error && rthyb_numerical_interfaces(&part) != 1)
        error = RTHYB_E_MOTION;
    c->freeze_after = ticks_of(FREEZE_AFTER_S, cfg->period_s);
    c->extrapolate_until = ticks_of(EXTRAPOLATE_UNTIL_S, cfg->period_s);
    c->upper_m = COMMAND_MAX_M;
    c->lower_m = -COMMAND_MAX_M;
    return error;
}

static int beyond_sensor(double value, double range)
{
    /* A reading at the very end of the range is a sensor that cannot say more. */
    return range > 0.0 && fabs(value) >= range;
}

/* Takes the pair of this tick, or makes one up from the command. */
static int gate(const rthyb_controller *c, const rthyb_input *in, double *x, double *f)
{
    int code =
        judge(in->x_meas_m, RTHYB_DISPLACEMENT_MAX_M) | judge(in->f_meas_n, RTHYB_FORCE_MAX_N);
    if (code == RTHYB_OK && (beyond_sensor(in->x_meas_m, c->cfg.x_range_m) ||
                             beyond_sensor(in->f_meas_n, c->cfg.f_range_n)))
        code = RTHYB_S_OUT_OF_RANGE;
    if (in->lost)
        code = in->lost & (RTHYB_S_NOT_FINITE | RTHYB_S_OUT_OF_RANGE);
    if (code == RTHYB_OK && !in->lost) {
        *x = in->x_meas_m;
        *f = in->f_meas_n;
        return code;
    }
    /* The specimen goes on as its command does, the force along the tangent stiffness. The noise of
     * two samples, run out over twenty, would be more than the motion. */
    const double ahead = c->missing < c->extrapolate_until ? c->x_num - c->x_num1 : 0.0;
    *x = clamp(c->x_m1 + ahead, -RTHYB_DISPLACEMENT_MAX_M, RTHYB_DISPLACEMENT_MAX_M);
    *f = clamp(c->f1 + c->rfc.k_n_per_m * ahead, -RTHYB_FORCE_MAX_N, RTHYB_FORCE_MAX_N);
    return code;
}

/* Energy that the tracking error feeds into the structure (Mosqueda et al. 2007) and tracking
 * indicator (Mercan & Ricles 2007; falling while x_m lags). */
static void monitor(rthyb_controller *c, double x, double f)
{
    const double error = x - c->x_num, error1 = c->x_m1 - c->x_num1;
    c->energy_error += 0.5 * (f + c->f1) * (error - error1);
    c->tracking_indicator += 0.5 * (0.5 * (x + c->x_m1) * (c->x_num - c->x_num1) -
                                    0.5 * (c->x_num + c->x_num1) * (x - c->x_m1));
    int code = RTHYB_OK;
    c->energy_error = confine(c->energy_error, 1e300, &code);
    c->tracking_indicator = confine(c->tracking_indicator, 1e300, &code);
}

/* The step that closes a lag and can still be braked away with half the acceleration limit. */
static double catch_up(double lag, double a_max, double h)
{
    const double brake = 0.5 * a_max, half = 0.5 * brake * h;
    return copysign(h * (sqrt(2.0 * brake * fabs(lag) + half * half) - half), lag);
}

/* No faster towards a limit than can be braked before it, with some of the deceleration to spare. */
static double before_the_end(double step, double room, double a_max, double h)
{
    const double most = room > 0.0 ? catch_up(room, 1.6 * a_max, h) : 0.0;
    return clamp(step, -most, most);
}

/* How far from the clamp's centre a command may be. */
static double position_limit(const rthyb_controller_config *cfg)
{
    return cfg->clamp_m > 0.0 ? cfg->clamp_m : COMMAND_MAX_M;
}

/* The step that catches up with what is wanted, no faster than it can be braked: else the command would
 * swing about that for ever. */
static double accelerated(const rthyb_controller *c, double wanted, double limit)
{
    const double h = c->cfg.period_s, a_max = c->cfg.acceleration_limit_m_per_s2;
    const double lag = c->x_plc - c->x_lim, closing = catch_up(lag, a_max, h);
    double step = wanted - c->x_lim;
    if (fabs(closing) < fabs(lag))
        step = wanted - c->x_plc + closing;
    const double out = c->x_lim - c->cfg.clamp_centre_m;
    step = before_the_end(step, limit - copysign(out, out * step), a_max, h);
    if (c->gap && c->step != 0.0)
        step = c->step > 0.0 ? fmax(step, 0.0) : fmin(step, 0.0);
    return clamp(step, c->step - a_max * h * h, c->step + a_max * h * h);
}

/* Of a limit that was drawn in behind it, or close before it, the command comes back on its own course
 * and not at once: with an acceleration limit it may go on as far as it needs to brake, but never beyond
 * a limit that was there before. */
static void draw_bounds(rthyb_controller *c, double limit)
{
    const double per_tick2 = c->cfg.acceleration_limit_m_per_s2 * c->cfg.period_s * c->cfg.period_s;
    const double braked = per_tick2 > 0.0 ? 0.5 * c->step * fabs(c->step) / per_tick2 : 0.0;
    const double centre = c->cfg.clamp_centre_m;
    c->upper_m = fmax(centre + limit, fmin(c->upper_m, c->x_lim + fmax(braked, 0.0)));
    c->lower_m = fmin(centre - limit, fmax(c->lower_m, c->x_lim + fmin(braked, 0.0)));
}

/* Acceleration, velocity, position: the last one wins.
 *
 * What holds of the commands that leave, and of nothing else: with x[k] the one that leaves as the k-th,
 * before the wire rounds it, and s[k] = x[k] - x[k-1],
 *   |x[k] - centre| <= limit,   |s[k]| <= v_max h,   |s[k] - s[k-1]| <= a_max h^2,
 *   s[k] s[k-1] >= 0 where, with an acceleration limit, a tick without a command lies between them,
 * whatever number of ticks that is: skipped ones, and those whose command found no room. So a gap is never
 * caught up at once, and never stops the command. A limit that comes into force while the command is beyond
 * it, or too fast for it, is reached by braking with a_max: until then |s| falls by a_max h^2 a command, and
 * x keeps to the old limit. (v_max or a_max of 0: no such bound, and then nothing to brake with.)
 *
 * It goes on from what it wanted itself: from a coarse wire's rounding a slow command would never get
 * away. */
static double limit_command(rthyb_controller *c, double wanted)
{
    const double h = c->cfg.period_s, v_max = c->cfg.velocity_limit_m_per_s;
    const double a_max = c->cfg.acceleration_limit_m_per_s2, limit = position_limit(&c->cfg);
    const double whole = wanted - c->x_lim;
    double step = a_max > 0.0 ? accelerated(c, wanted, limit) : whole;
    if (v_max > 0.0) {
        const double braked = a_max > 0.0 ? fabs(c->step) - a_max * h * h : 0.0;
        const double most = fmax(v_max * h, braked);
        step = clamp(step, -most, most);
    }
    const double command = step == whole ? wanted : c->x_lim + step;
    draw_bounds(c, limit);
    return clamp(command, c->lower_m, c->upper_m);
}

/* What leaves in this tick, unless it finds no room: then command_stayed takes it back. */
static void note_step(rthyb_controller *c, double x_cmd, int blind)
{
    c->x_lim1 = c->x_lim;
    c->step1 = c->step;
    c->step = blind ? c->step : x_cmd - c->x_lim;
    c->x_lim = blind ? c->x_lim : x_cmd;
    c->gap = blind;
}

static void write_record(const rthyb_controller *c, const rthyb_input *in, double x, double f,
                         uint32_t flags, int code, rthyb_record *record)
{
    const uint64_t n = c->tick;
    record->tick = n;
    record->due_ns = llrint((double)n * c->cfg.period_s * 1e9);
    record->flags = flags;
    record->generation = c->generation;
    note_pair(record, in->x_meas_m, in->f_meas_n, in->lost);
    record->state = (uint16_t)c->state;
    record->code = (uint16_t)code;
    record->cause = RTHYB_CAUSE_NONE;
    record->ag_mps2 = c->cfg.motion.integrator == RTHYB_PRESCRIBED ? 0.0 : in->excitation;
    record->x_num_m = c->x_num;
    record->x_plc_m = c->x_plc;
    record->axis[0].x_cmd_m = c->x_cmd;
    record->axis[0].x_meas_m = x;
    record->axis[0].f_meas_n = f;
    record->alpha = rthyb_law_value_at(&c->law, c->law.alpha_at);
    record->beta = rthyb_law_value_at(&c->law, c->law.beta_at);
    record->k_t_n_per_m = c->rfc.k_n_per_m;
    record->energy_error_j = c->energy_error;
    record->tracking_indicator_m2 = c->tracking_indicator;
    record->wake_late_ns = record->sent_late_ns = 0;
    record->axis[0].missing = c->missing;
    record->axis[0].echo = record->axis[0].count = 0;
}

/* One degree of freedom leaves nothing to be done later, and takes no detour by the table of kinds. */
static int answer(rthyb_controller *c, double excitation, double force, double *x_num)
{
    if (has_own_part(c))
        return rthyb_motion_step(&c->motion, excitation, force, x_num);
    c->behind = 1;
    return rthyb_numerical_answer(&c->cfg.numerical, excitation, &force, x_num);
}

/* Velocity of the interface at t_n; only a force that is late is asked for it. */
static double velocity(rthyb_controller *c)
{
    if (c->cfg.rfc.lateness_s == 0.0)
        return 0.0;
    const rthyb_numerical part = part_of(c);
    rthyb_interface at;
    rthyb_numerical_look(&part, &at);
    return at.v;
}

/* The next displacement by the equation of motion, with what the law learns, RFC and monitors. */
static int compute_motion(rthyb_controller *c, const rthyb_input *in, double x, double f,
                          int frozen, double *x_num)
{
    double force;
    monitor(c, x, f);
    const int held = frozen || c->cfg.estimate_held;
    int code = rthyb_law_observe(&c->law, c->x_cmd, x, held);
    code |= rthyb_rfc_step(&c->rfc, c->x_num, velocity(c), x, f, frozen, &force);
    code |= answer(c, in->excitation, force, x_num);
    return code;
}

/* The next displacement from a path: law and RFC see the motion and learn nothing from it. */
static int follow_path(rthyb_controller *c, double x, double f, double path_m, double *x_num)
{
    int code = rthyb_law_observe(&c->law, c->x_cmd, x, 1);
    rthyb_rfc_follow(&c->rfc, c->x_num, x, f);
    if (!has_own_part(c))
        rthyb_numerical_freeze(&c->cfg.numerical, &f);
    *x_num = accept(path_m, RTHYB_DISPLACEMENT_MAX_M, c->x_num, &code);
    return code;
}

/* What the law has learnt may move the command by one increment limit a tick; on a path, not at all. */
static double allowed_move(const rthyb_controller *c, const double *path_m)
{
    const double most = c->cfg.velocity_limit_m_per_s * c->cfg.period_s;
    if (path_m)
        return 0.0;
    return most > 0.0 ? most : (double)INFINITY;
}

/* x_p for the next instant. No law may bring the command out of this world. */
static int lead(rthyb_controller *c, double x_num, double allowed_m, double *x_plc)
{
    double led;
    int code = rthyb_law_lead(&c->law, x_num, allowed_m, &led);
    *x_plc = c->cfg.lead_enabled ? accept(led, 1e300, c->x_plc, &code) : x_num;
    return code;
}

int rthyb_controller_step(rthyb_controller *c, const rthyb_input *in, rthyb_record *record)
{
    const int code = rthyb_controller_sample(c, in, NULL, 0, record);
    rthyb_controller_advance(c);
    return code;
}

void rthyb_controller_advance(rthyb_controller *c)
{
    if (!c->behind)
        return;
    c->late_code |= rthyb_numerical_advance(&c->cfg.numerical);
    c->behind = 0;
}

int rthyb_controller_sample(rthyb_controller *c, const rthyb_input *in, const double *path_m,
                            int blind, rthyb_record *record)
{
    double x, f, x_num, x_plc;
    int code = gate(c, in, &x, &f);
    const int made_up = in->lost || code != RTHYB_OK;
    rthyb_controller_advance(c);
    c->missing = made_up ? c->missing + (c->missing < UINT32_MAX) : 0;
    const int frozen = blind || c->missing >= c->freeze_after;
    if (path_m)
        code |= follow_path(c, x, f, *path_m, &x_num);
    else
        code |= compute_motion(c, in, x, f, frozen, &x_num);
    code |= c->late_code;
    c->late_code = RTHYB_OK;
    code |= lead(c, x_num, allowed_move(c, path_m), &x_plc);
    const double x_cmd = blind ? c->x_cmd : limit_command(c, x_plc);
    if (x_cmd != x_plc && !blind)
        code |= RTHYB_S_LIMITED;
    const uint32_t flags = (made_up ? RTHYB_F_PREDICTED : RTHYB_F_FRESH) |
                           (frozen || path_m ? RTHYB_F_FROZEN : 0u) |
                           (blind ? RTHYB_F_BLIND | RTHYB_F_NOT_SENT : 0u) |
                           (code & RTHYB_S_LIMITED ? RTHYB_F_LIMITED : 0u);
    write_record(c, in, x, f, flags, code, record);
    c->x_m1 = x;
    c->f1 = f;
    c->x_num1 = c->x_num;
    c->x_num = x_num;
    c->x_plc = x_plc;
    c->x_cmd1 = c->x_cmd;
    note_step(c, x_cmd, blind);
    c->x_cmd = x_cmd;
    c->tick++;
    return code;
}
