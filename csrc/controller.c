/* One sample of the controller: gate -> laws observe -> RFC -> numerical part -> laws lead ->
 * limiter. A pure function of state and input.
 *
 * Each axis has a compensated command, readings and a control law; each interface has a command, a
 * force and the compensation of that force. The kinematics converts between the two; without one,
 * axis i is interface i. There may be more axes than interfaces, if the actuators are redundant. */
#include <string.h>

#include "internal.h"
#include "numeric.h"

#define FREEZE_AFTER_S (3.0 / 1024.0) /* without pairs for this long: alpha and k_t are held */
#define EXTRAPOLATE_UNTIL_S (20.0 / 1024.0) /* longest time that readings are extrapolated */

enum { MOST = RTHYB_COUPLED_MAX };

/* ---- set-up ------------------------------------------------------------------------------------ */

static int counts_ok(const rthyb_controller_config *cfg)
{
    const int32_t axes = cfg->axis_count, interfaces = cfg->interface_count;
    const int32_t given = cfg->kinematics.size, lead = cfg->matrix_lead.size;
    const int32_t directions = given == 0 ? axes : rthyb_kinematics_directions(&cfg->kinematics);
    /* The axes of redundant actuators do not move independently, so the matrices of a lead, one
     * column per axis, would not be determined. */
    return axes >= 1 && axes <= MOST && interfaces >= 1 && interfaces <= axes &&
           interfaces == directions && (given == 0 || given == axes) &&
           (given > 0 || rthyb_kinematics_sensors(&cfg->kinematics) == 0) &&
           (lead == 0 || (lead == axes && axes == interfaces)) &&
           (cfg->matrix_rfc.size == 0 || cfg->matrix_rfc.size == interfaces);
}

static int limits_ok(const rthyb_axis_control *cfg)
{
    return cfg->velocity_limit_m_per_s >= 0.0 && cfg->acceleration_limit_m_per_s2 >= 0.0 &&
           cfg->x_range_m >= 0.0 && cfg->f_range_n >= 0.0 && cfg->clamp_m >= 0.0;
}

static int axes_init(rthyb_controller *c)
{
    int error = 0;
    for (int i = 0; i < c->cfg.axis_count && !error; i++) {
        rthyb_controller_axis *a = &c->axis[i];
        memset(a, 0, offsetof(rthyb_controller_axis, law));
        a->limiter.upper_m = COMMAND_MAX_M;
        a->limiter.lower_m = -COMMAND_MAX_M;
        error = rthyb_law_init(&a->law, &c->cfg.axis[i].law, c->cfg.period_s, 0.0);
    }
    for (int j = 0; j < c->cfg.interface_count && !error; j++) {
        memset(&c->interface[j], 0, offsetof(rthyb_controller_interface, rfc));
        error = rthyb_rfc_init(&c->interface[j].rfc, &c->cfg.rfc[j], 0.0, 0.0);
    }
    return error;
}

/* Parts that serve all axes together. */
static int group_init(rthyb_controller *c)
{
    const double none[MOST] = {0.0};
    int error = 0;
    if (c->cfg.kinematics.size > 0)
        error = rthyb_kinematics_init(&c->kinematics, &c->cfg.kinematics);
    if (!error && c->cfg.matrix_lead.size > 0)
        error = rthyb_matrix_lead_init(&c->matrix_lead, &c->cfg.matrix_lead, none);
    if (!error && c->cfg.matrix_rfc.size > 0)
        error = rthyb_matrix_rfc_init(&c->matrix_rfc, &c->cfg.matrix_rfc, none, none);
    return error;
}

int rthyb_controller_init(rthyb_controller *c, const rthyb_controller_config *cfg)
{
    if (!(cfg->period_s > 0.0 && cfg->period_s <= 1.0) || cfg->motion.period_s != cfg->period_s ||
        (cfg->matrix_lead.size > 0 && cfg->matrix_lead.period_s != cfg->period_s) ||
        (cfg->matrix_rfc.size > 0 && cfg->matrix_rfc.period_s != cfg->period_s))
        return RTHYB_E_PERIOD;
    if (!counts_ok(cfg))
        return RTHYB_E_KINEMATICS;
    for (int i = 0; i < cfg->axis_count; i++)
        if (!limits_ok(&cfg->axis[i]))
            return RTHYB_E_LIMIT;
    memset(c, 0, offsetof(rthyb_controller, axis));
    memset(c->sensor, 0, sizeof c->sensor);
    memset(c->sensor_missing, 0, sizeof c->sensor_missing);
    c->cfg = *cfg;
    c->state = RTHYB_RUNNING;
    c->posed = 1;
    c->alone = cfg->axis_count == 1 && cfg->kinematics.size == 0 && cfg->matrix_lead.size == 0 &&
               cfg->matrix_rfc.size == 0;
    int error = axes_init(c);
    if (!error)
        error = group_init(c);
    const rthyb_numerical part = part_of(c);
    if (!error)
        error = rthyb_numerical_init(&part, 0.0);
    if (!error && rthyb_numerical_interfaces(&part) != cfg->interface_count)
        error = RTHYB_E_MOTION;
    c->freeze_after = ticks_of(FREEZE_AFTER_S, cfg->period_s);
    c->extrapolate_until = ticks_of(EXTRAPOLATE_UNTIL_S, cfg->period_s);
    return error;
}

/* ---- what joins the axes ----------------------------------------------------------------------- */

/* What a sample is compiled for: n axes, m interfaces, and whether a kinematics or a matrix may act
 * on all axes together. A single axis without any of them is by far the most frequent controller; if
 * the compiler knows that it has one, no loops remain. */
typedef struct {
    int n, m, joined;
} shape;

static shape shape_of(const rthyb_controller *c)
{
    return (shape){c->cfg.axis_count, c->cfg.interface_count, 1};
}

PER_COUNT int has_kinematics(shape s, const rthyb_controller *c)
{
    return s.joined && c->cfg.kinematics.size > 0;
}

PER_COUNT int has_matrix_lead(shape s, const rthyb_controller *c)
{
    return s.joined && c->cfg.matrix_lead.size > 0;
}

PER_COUNT int has_matrix_rfc(shape s, const rthyb_controller *c)
{
    return s.joined && c->cfg.matrix_rfc.size > 0;
}

/* ---- between axes and interfaces --------------------------------------------------------------- */

/* Without a pose, each axis keeps its target: no pose corresponds to the present positions. */
PER_COUNT int targets_of(shape s, rthyb_controller *c, const double *x_num, double *target)
{
    if (has_kinematics(s, c) && c->posed) {
        const int code = rthyb_kinematics_axes(&c->kinematics, x_num, target);
        for (int i = 0; s.m < s.n && i < s.n; i++)
            target[i] += c->axis[i].apart;
        return code;
    }
    for (int i = 0; i < s.n; i++)
        target[i] = has_kinematics(s, c) ? c->axis[i].target : x_num[i];
    return RTHYB_OK;
}

/* Whether no pose of the specimen corresponds to the axes' displacements. Checked from ZERO on, and
 * only while there is a pose from which the search can start. */
PER_COUNT int is_no_pose(shape s, rthyb_controller *c, const double *x)
{
    double pose[MOST];
    return has_kinematics(s, c) && c->posed && c->state != RTHYB_IDLE &&
           rthyb_kinematics_pose(&c->kinematics, x, pose) != RTHYB_OK;
}

/* Pose and forces in interface coordinates, from the readings of the axes and further sensors. */
PER_COUNT int meet(shape s, rthyb_controller *c, const double *x, const double *f, double *pose,
                   double *force)
{
    if (has_kinematics(s, c)) {
        int code = RTHYB_OK;
        if (c->posed)
            code = rthyb_kinematics_measured_pose(&c->kinematics, x, c->sensor, pose);
        return code | rthyb_kinematics_measured_forces(&c->kinematics, f, c->sensor, force);
    }
    for (int j = 0; j < s.m; j++) {
        pose[j] = x[j];
        force[j] = f[j];
    }
    return RTHYB_OK;
}

/* Moves the sensors without an actuator with the specimen. */
static void move_sensors(rthyb_controller *c, const double *force)
{
    double moved[RTHYB_SENSORS_ALL] = {0.0}, from[MOST] = {0.0}, to[MOST] = {0.0};
    const int p = c->cfg.kinematics.displacement_sensors;
    for (int j = 0; j < c->cfg.interface_count; j++) {
        from[j] = c->interface[j].x_num1;
        to[j] = c->interface[j].x_num;
    }
    rthyb_kinematics_change(&c->cfg.kinematics, from, to, force, moved);
    for (int k = 0; k < rthyb_kinematics_sensors(&c->cfg.kinematics); k++) {
        const double most = k < p ? RTHYB_DISPLACEMENT_MAX_M : RTHYB_FORCE_MAX_N;
        c->sensor[k] = clamp(c->sensor[k] + moved[k], -most, most);
    }
}

/* Expected change of the axes' readings if the specimen follows its command: displacements by the
 * change of the targets, forces by the tangent stiffness times the change of the commands. The
 * readings of further sensors are changed at once. */
PER_COUNT void ahead_of(shape s, rthyb_controller *c, double *x, double *f)
{
    double way[MOST], force[MOST] = {0.0};
    for (int i = 0; i < s.n; i++)
        x[i] = c->axis[i].target - c->axis[i].target1;
    for (int j = 0; j < s.m; j++) {
        way[j] = c->interface[j].x_num - c->interface[j].x_num1;
        force[j] = c->interface[j].rfc.k_n_per_m * way[j];
    }
    for (int j = 0; j < s.m && has_matrix_rfc(s, c); j++) {
        force[j] = 0.0;
        for (int k = 0; k < s.m; k++)
            force[j] += c->matrix_rfc.k[j][k] * way[k];
    }
    if (has_kinematics(s, c))
        move_sensors(c, force);
    if (has_kinematics(s, c))
        (void)rthyb_kinematics_pushes(&c->kinematics, force, f);
    else
        memcpy(f, force, (size_t)s.n * sizeof *f);
}

/* ---- readings ---------------------------------------------------------------------------------- */

static int beyond_sensor(double value, double range)
{
    /* A sensor that reads exactly the end of its range is saturated. */
    return range > 0.0 && fabs(value) >= range;
}

/* Whether this is a valid pair; if not, the reasons are added to *code. */
static int is_pair(const rthyb_axis_control *cfg, const rthyb_pair *in, int *code)
{
    int own =
        judge(in->x_meas_m, RTHYB_DISPLACEMENT_MAX_M) | judge(in->f_meas_n, RTHYB_FORCE_MAX_N);
    if (own == RTHYB_OK && (beyond_sensor(in->x_meas_m, cfg->x_range_m) ||
                            beyond_sensor(in->f_meas_n, cfg->f_range_n)))
        own = RTHYB_S_OUT_OF_RANGE;
    if (in->lost)
        own = in->lost & (RTHYB_S_NOT_FINITE | RTHYB_S_OUT_OF_RANGE);
    *code |= own;
    return own == RTHYB_OK && !in->lost;
}

/* Counts the ticks in which a sensor without an actuator has no reading; returns 1 if any has none
 * now. */
static int gate_sensors(rthyb_controller *c, const rthyb_input *in, int *code)
{
    int made_up = 0;
    for (int k = 0; k < rthyb_kinematics_sensors(&c->cfg.kinematics); k++) {
        const int of_x = k < c->cfg.kinematics.displacement_sensors;
        const int32_t lost = in->sensor_lost[k];
        const int own =
            lost ? lost & (RTHYB_S_NOT_FINITE | RTHYB_S_OUT_OF_RANGE)
                 : judge(in->sensor[k], of_x ? RTHYB_DISPLACEMENT_MAX_M : RTHYB_FORCE_MAX_N);
        const int good = !lost && own == RTHYB_OK;
        *code |= own;
        c->sensor_missing[k] =
            good ? 0 : c->sensor_missing[k] + (c->sensor_missing[k] < UINT32_MAX);
        made_up |= !good;
    }
    return made_up;
}

static void take_sensors(rthyb_controller *c, const rthyb_input *in)
{
    for (int k = 0; k < rthyb_kinematics_sensors(&c->cfg.kinematics); k++)
        c->sensor[k] = in->sensor[k];
}

/* Accepts the pairs of this tick, or predicts those of all axes from the commands; returns 1 if
 * they are predicted. Pairs that are valid individually but correspond to no pose together are
 * rejected. Two measured samples are not extrapolated: over twenty ticks their noise would grow
 * larger than the motion. */
PER_COUNT int gate(shape s, rthyb_controller *c, const rthyb_input *in, double *x, double *f,
                   int *code)
{
    int made_up = 0;
    for (int i = 0; i < s.n; i++) {
        rthyb_controller_axis *a = &c->axis[i];
        const int own = is_pair(&c->cfg.axis[i], &in->axis[i], code);
        a->missing = own ? 0 : a->missing + (a->missing < UINT32_MAX);
        made_up |= !own;
        x[i] = in->axis[i].x_meas_m;
        f[i] = in->axis[i].f_meas_n;
    }
    if (has_kinematics(s, c))
        made_up |= gate_sensors(c, in, code);
    if (!made_up && !is_no_pose(s, c, x)) {
        if (has_kinematics(s, c))
            take_sensors(c, in);
        return 0;
    }
    *code |= made_up ? RTHYB_OK : RTHYB_S_OUT_OF_RANGE;
    double dx[MOST] = {0.0}, df[MOST] = {0.0};
    if (c->missing < c->extrapolate_until)
        ahead_of(s, c, dx, df);
    for (int i = 0; i < s.n; i++) {
        const rthyb_controller_axis *a = &c->axis[i];
        x[i] = clamp(a->x_m1 + dx[i], -RTHYB_DISPLACEMENT_MAX_M, RTHYB_DISPLACEMENT_MAX_M);
        f[i] = clamp(a->f1 + df[i], -RTHYB_FORCE_MAX_N, RTHYB_FORCE_MAX_N);
    }
    return 1;
}

/* Energy that the tracking error feeds into the structure (Mosqueda et al. 2007) and tracking
 * indicator (Mercan & Ricles 2007; decreases while x_m lags), summed over all axes. */
PER_COUNT void monitor(int n, rthyb_controller *c, const double *x, const double *f)
{
    for (int i = 0; i < n; i++) {
        const rthyb_controller_axis *a = &c->axis[i];
        const double error = x[i] - a->target, error1 = a->x_m1 - a->target1;
        c->energy_error += 0.5 * (f[i] + a->f1) * (error - error1);
        c->tracking_indicator += 0.5 * (0.5 * (x[i] + a->x_m1) * (a->target - a->target1) -
                                        0.5 * (a->target + a->target1) * (x[i] - a->x_m1));
    }
    int code = RTHYB_OK;
    c->energy_error = confine(c->energy_error, 1e300, &code);
    c->tracking_indicator = confine(c->tracking_indicator, 1e300, &code);
}

/* ---- record ------------------------------------------------------------------------------------ */

PER_COUNT double lead_at(shape s, const rthyb_controller *c, int axis, int term)
{
    if (has_matrix_lead(s, c))
        return c->matrix_lead.used[term][axis][axis];
    const rthyb_law *law = &c->axis[axis].law;
    return rthyb_law_value_at(law, term == 1 ? law->alpha_at : law->beta_at);
}

PER_COUNT double stiffness_at(shape s, const rthyb_controller *c, int interface)
{
    return has_matrix_rfc(s, c) ? c->matrix_rfc.k[interface][interface]
                                : c->interface[interface].rfc.k_n_per_m;
}

double rthyb_controller_lead(const rthyb_controller *c, int axis, int term)
{
    return lead_at(shape_of(c), c, axis, term);
}

double rthyb_controller_stiffness(const rthyb_controller *c, int interface)
{
    return stiffness_at(shape_of(c), c, interface);
}

PER_COUNT void write_axes(int n, const rthyb_controller *c, const rthyb_input *in, const double *x,
                          const double *f, rthyb_record *record)
{
    for (int i = 0; i < n; i++) {
        rthyb_axis_record *r = &record->axis[i];
        note_pair(r, in->axis[i].x_meas_m, in->axis[i].f_meas_n, in->axis[i].lost, n);
        r->x_cmd_m = c->axis[i].x_cmd;
        r->x_meas_m = x[i];
        r->f_meas_n = f[i];
        r->missing = c->axis[i].missing;
        r->echo = r->count = 0;
    }
}

PER_COUNT void write_record(shape s, const rthyb_controller *c, const rthyb_input *in,
                            const double *x, const double *f, uint32_t flags, int code,
                            rthyb_record *record)
{
    record->tick = c->tick;
    record->due_ns = llrint((double)c->tick * c->cfg.period_s * 1e9);
    record->flags = flags;
    record->generation = c->generation;
    record->state = (uint16_t)c->state;
    record->code = (uint16_t)code;
    record->cause = RTHYB_CAUSE_NONE;
    record->ag_mps2 = c->cfg.motion.integrator == RTHYB_PRESCRIBED ? 0.0 : in->excitation;
    record->x_num_m = c->interface[0].x_num;
    record->x_plc_m = c->axis[0].x_plc;
    record->alpha = lead_at(s, c, 0, 1);
    record->beta = lead_at(s, c, 0, 2);
    record->k_t_n_per_m = stiffness_at(s, c, 0);
    record->energy_error_j = c->energy_error;
    record->tracking_indicator_m2 = c->tracking_indicator;
    record->wake_late_ns = record->sent_late_ns = 0;
    write_axes(s.n, c, in, x, f, record);
}

/* ---- motion ------------------------------------------------------------------------------------ */

/* The controller's own equation of motion, with one degree of freedom, completes its step at once
 * and is called without dispatch by kind. Other parts are given copies: what they can reach would
 * lie in memory for all. */
PER_COUNT int answer(shape s, rthyb_controller *c, double excitation, const double *force,
                     double *x_num)
{
    if (has_own_part(c))
        return rthyb_motion_step(&c->motion, excitation, *force, x_num);
    double given[MOST] = {0.0}, found[MOST] = {0.0};
    for (int j = 0; j < s.m; j++)
        given[j] = force[j];
    c->behind = 1;
    const int code = rthyb_numerical_answer(&c->cfg.numerical, excitation, given, found);
    for (int j = 0; j < s.m; j++)
        x_num[j] = found[j];
    return code;
}

PER_COUNT int asks_velocity(shape s, const rthyb_controller *c)
{
    int asks = has_matrix_rfc(s, c) && c->cfg.matrix_rfc.lateness_s != 0.0;
    for (int j = 0; j < s.m; j++)
        asks = asks || c->cfg.rfc[j].lateness_s != 0.0;
    return asks;
}

/* Velocities of the interfaces at t_n; computed only if needed, to compensate for a late force. */
PER_COUNT void velocities(shape s, rthyb_controller *c, double *v)
{
    rthyb_interface at[MOST];
    memset(v, 0, MOST * sizeof *v);
    if (!asks_velocity(s, c))
        return;
    const rthyb_numerical part = part_of(c);
    rthyb_numerical_look(&part, at);
    for (int j = 0; j < s.m; j++)
        v[j] = at[j].v;
}

PER_COUNT int observe(shape s, rthyb_controller *c, const double *x, int held)
{
    double sent[MOST];
    int code = RTHYB_OK;
    if (has_matrix_lead(s, c)) {
        for (int i = 0; i < s.n; i++)
            sent[i] = c->axis[i].x_cmd;
        return rthyb_matrix_lead_observe(&c->matrix_lead, sent, x, held);
    }
    for (int i = 0; i < s.n; i++)
        code |= rthyb_law_observe(&c->axis[i].law, c->axis[i].x_cmd, x[i], held);
    return code;
}

/* Forces after compensation, as used in the equation of motion. */
PER_COUNT int compensate(shape s, rthyb_controller *c, const double *pose, const double *f,
                         int frozen, double *force)
{
    double v[MOST], x_num[MOST] = {0.0};
    int code = RTHYB_OK;
    velocities(s, c, v);
    if (has_matrix_rfc(s, c)) {
        for (int j = 0; j < s.m; j++)
            x_num[j] = c->interface[j].x_num;
        return rthyb_matrix_rfc_step(&c->matrix_rfc, x_num, v, pose, f, frozen, force);
    }
    for (int j = 0; j < s.m; j++) {
        rthyb_controller_interface *at = &c->interface[j];
        code |= rthyb_rfc_step(&at->rfc, at->x_num, v[j], pose[j], f[j], frozen, &force[j]);
    }
    return code;
}

PER_COUNT int meet_and_note(shape s, rthyb_controller *c, const double *x, const double *f,
                            double *pose, double *force)
{
    const int code = meet(s, c, x, f, pose, force);
    for (int j = 0; j < s.m; j++) {
        c->interface[j].x_m = pose[j];
        c->interface[j].f = force[j];
    }
    return code;
}

/* Next displacements from the equation of motion; the laws adapt, and RFC and monitors run. */
PER_COUNT int compute_motion(shape s, rthyb_controller *c, const rthyb_input *in, const double *x,
                             const double *f, int frozen, double *x_num)
{
    double pose[MOST] = {0.0}, met[MOST] = {0.0}, force[MOST] = {0.0};
    monitor(s.n, c, x, f);
    int code = observe(s, c, x, frozen || c->cfg.estimate_held);
    code |= meet_and_note(s, c, x, f, pose, met);
    code |= compensate(s, c, pose, met, frozen, force);
    code |= answer(s, c, in->excitation, force, x_num);
    return code;
}

/* Next displacements from a path: laws and RFC follow the motion but do not adapt. */
PER_COUNT int follow_path(shape s, rthyb_controller *c, const double *x, const double *f,
                          const double *path_m, double *x_num)
{
    double pose[MOST] = {0.0}, met[MOST] = {0.0}, at[MOST] = {0.0};
    int code = observe(s, c, x, 1);
    code |= meet_and_note(s, c, x, f, pose, met);
    for (int j = 0; j < s.m; j++) {
        at[j] = c->interface[j].x_num;
        rthyb_rfc_follow(&c->interface[j].rfc, at[j], pose[j], met[j]);
        x_num[j] = accept(path_m[j], RTHYB_DISPLACEMENT_MAX_M, at[j], &code);
    }
    if (has_matrix_rfc(s, c))
        rthyb_matrix_rfc_follow(&c->matrix_rfc, at, pose, met);
    if (!has_own_part(c))
        rthyb_numerical_freeze(&c->cfg.numerical, met);
    return code;
}

/* How far the adaptation of a law may move the command in one tick: by the velocity limit; on a
 * path, not at all. */
static double allowed_move(const rthyb_controller *c, int axis, const double *path_m)
{
    const double most = c->cfg.axis[axis].velocity_limit_m_per_s * c->cfg.period_s;
    if (path_m)
        return 0.0;
    return most > 0.0 ? most : (double)INFINITY;
}

PER_COUNT int lead_all(shape s, rthyb_controller *c, const double *target, const double *path_m,
                       double *led)
{
    double least = HUGE_VAL;
    int code = RTHYB_OK;
    for (int i = 0; i < s.n; i++) {
        const double allowed = allowed_move(c, i, path_m);
        least = less_of(least, allowed);
        if (!has_matrix_lead(s, c))
            code |= rthyb_law_lead(&c->axis[i].law, target[i], allowed, &led[i]);
    }
    if (has_matrix_lead(s, c))
        code = rthyb_matrix_lead_lead(&c->matrix_lead, target, least, led);
    return code;
}

/* Compensated commands x_p for the next instant. They stay finite, whatever a law computes. */
PER_COUNT int lead(shape s, rthyb_controller *c, const double *target, const double *path_m,
                   double *x_plc)
{
    double led[MOST] = {0.0};
    int code = lead_all(s, c, target, path_m, led);
    for (int i = 0; i < s.n; i++)
        x_plc[i] = c->cfg.lead_enabled ? accept(led[i], 1e300, c->axis[i].x_plc, &code) : target[i];
    return code;
}

/* ---- one sample -------------------------------------------------------------------------------- */

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

/* Commands after limiting, or the previous ones in a blind tick; returns 1 if the limiter changed
 * any. */
PER_COUNT int command(int n, rthyb_controller *c, const double *x_plc, int blind, double *x_cmd)
{
    int limited = 0;
    for (int i = 0; blind && i < n; i++)
        x_cmd[i] = c->axis[i].x_cmd;
    if (!blind && n == 1)
        x_cmd[0] = limiter_single_command(c, x_plc[0]);
    else if (!blind)
        limiter_commands(n, c, x_plc, x_cmd);
    for (int i = 0; !blind && i < n; i++)
        limited |= x_cmd[i] != x_plc[i];
    return limited;
}

/* Stores the results of this sample as the previous values for the next one. */
PER_COUNT void shift(int n, rthyb_controller *c, const double *x, const double *f,
                     const double *target, const double *x_plc, const double *x_cmd, int blind)
{
    for (int i = 0; i < n; i++) {
        rthyb_controller_axis *a = &c->axis[i];
        a->x_m1 = x[i];
        a->f1 = f[i];
        a->target1 = a->target;
        a->target = target[i];
        a->x_plc1 = a->x_plc;
        a->x_plc = x_plc[i];
        a->x_cmd1 = a->x_cmd;
        limiter_note(&a->limiter, x_cmd[i], blind);
        a->x_cmd = x_cmd[i];
    }
}

PER_COUNT int sample(shape s, rthyb_controller *c, const rthyb_input *in, const double *path_m,
                     int blind, rthyb_record *record)
{
    double x[MOST] = {0.0}, f[MOST] = {0.0}, x_num[MOST] = {0.0};
    double target[MOST] = {0.0}, x_plc[MOST] = {0.0}, x_cmd[MOST] = {0.0};
    int code = RTHYB_OK;
    const int made_up = gate(s, c, in, x, f, &code);
    rthyb_controller_advance(c);
    c->missing = made_up ? c->missing + (c->missing < UINT32_MAX) : 0;
    const int frozen = blind || c->missing >= c->freeze_after;
    if (path_m)
        code |= follow_path(s, c, x, f, path_m, x_num);
    else
        code |= compute_motion(s, c, in, x, f, frozen, x_num);
    code |= c->late_code;
    c->late_code = RTHYB_OK;
    code |= targets_of(s, c, x_num, target);
    code |= lead(s, c, target, path_m, x_plc);
    if (command(s.n, c, x_plc, blind, x_cmd))
        code |= RTHYB_S_LIMITED;
    const uint32_t flags = (made_up ? RTHYB_F_PREDICTED : RTHYB_F_FRESH) |
                           (frozen || path_m ? RTHYB_F_FROZEN : 0u) |
                           (blind ? RTHYB_F_BLIND | RTHYB_F_NOT_SENT : 0u) |
                           (code & RTHYB_S_LIMITED ? RTHYB_F_LIMITED : 0u);
    write_record(s, c, in, x, f, flags, code, record);
    for (int j = 0; j < s.m; j++) {
        c->interface[j].x_num1 = c->interface[j].x_num;
        c->interface[j].x_num = x_num[j];
    }
    shift(s.n, c, x, f, target, x_plc, x_cmd, blind);
    c->tick++;
    return code;
}

/* All that a sample of one axis runs through is inlined: as calls, with arguments in memory, it took
 * a fifth longer. The linker does the same for functions of other files. */
__attribute__((flatten)) static int sample_alone(rthyb_controller *c, const rthyb_input *in,
                                                 const double *path_m, int blind,
                                                 rthyb_record *record)
{
    return sample((shape){1, 1, 0}, c, in, path_m, blind, record);
}

static int sample_joined(rthyb_controller *c, const rthyb_input *in, const double *path_m,
                         int blind, rthyb_record *record)
{
    return sample(shape_of(c), c, in, path_m, blind, record);
}

int rthyb_controller_sample(rthyb_controller *c, const rthyb_input *in, const double *path_m,
                            int blind, rthyb_record *record)
{
    return c->alone ? sample_alone(c, in, path_m, blind, record)
                    : sample_joined(c, in, path_m, blind, record);
}

int rthyb_controller_meets(const rthyb_controller *c, const double *x_m, const double *f_n,
                           const double *sensor, double *pose, double *force)
{
    rthyb_kinematics trial = c->kinematics;
    memcpy(pose, x_m, (size_t)c->cfg.axis_count * sizeof *pose);
    memcpy(force, f_n, (size_t)c->cfg.axis_count * sizeof *force);
    if (c->cfg.kinematics.size == 0)
        return 1;
    const int further = c->cfg.kinematics.displacement_sensors > 0;
    int found = RTHYB_OK;
    /* With pins the last pose may be far away; the axes alone lead to a pose nearby. */
    if (!further || c->cfg.kinematics.kind == RTHYB_KINEMATICS_PINS)
        found |= rthyb_kinematics_find(&trial, x_m, pose);
    if (further)
        found |= rthyb_kinematics_measured_pose(&trial, x_m, sensor, pose);
    return (found | rthyb_kinematics_measured_forces(&trial, f_n, sensor, force)) == RTHYB_OK;
}

int rthyb_controller_has_pose(const rthyb_controller *c, const double *x_m)
{
    double pose[MOST];
    rthyb_kinematics trial = c->kinematics;
    return c->cfg.kinematics.size == 0 || rthyb_kinematics_find(&trial, x_m, pose) == RTHYB_OK;
}

/* Redundant actuators rarely stand exactly at positions of one pose. Each keeps its difference from
 * the common pose until the next rest: removing it would move it against the others. */
static void keep_apart(rthyb_controller *c, const double *x_m, const double *pose)
{
    double common[MOST] = {0.0};
    const int n = c->cfg.axis_count;
    if (c->cfg.interface_count < n && c->posed)
        (void)rthyb_kinematics_axes(&c->kinematics, pose, common);
    for (int i = 0; i < n; i++)
        c->axis[i].apart = c->cfg.interface_count < n ? x_m[i] - common[i] : 0.0;
}

void rthyb_controller_rest(rthyb_controller *c, const double *x_m)
{
    const int n = c->cfg.axis_count;
    double pose[MOST] = {0.0};
    c->posed = 1;
    if (c->cfg.kinematics.size > 0)
        c->posed = rthyb_kinematics_find(&c->kinematics, x_m, pose) == RTHYB_OK;
    else
        memcpy(pose, x_m, (size_t)n * sizeof *pose);
    keep_apart(c, x_m, pose);
    for (int j = 0; j < c->cfg.interface_count; j++)
        c->interface[j].x_num = c->interface[j].x_num1 = pose[j];
    for (int i = 0; i < n; i++) {
        rthyb_controller_axis *a = &c->axis[i];
        a->target = a->target1 = a->x_plc = a->x_plc1 = a->x_cmd = a->x_cmd1 = x_m[i];
        limiter_rest(&a->limiter, x_m[i]);
        if (c->cfg.matrix_lead.size == 0)
            rthyb_law_rest(&a->law, x_m[i]);
    }
    if (c->cfg.matrix_lead.size > 0)
        rthyb_matrix_lead_rest(&c->matrix_lead, x_m);
}
