/* A virtual rig with several axes at one specimen.
 *
 * With q = q_n + J^-1 (x - x_n) within a sample, where J = d axis / d pose at t_n, the specimen
 * loads the axes with
 *   J^-T (K q + elements + C q' + M q''),
 * so that the tables of servo-hydraulic axes, whose own motion is diag(m) v' + diag(c) v = push -
 * that, form one system:
 *   (diag(m) + J^-T M J^-1) v' + (diag(c) + J^-T C J^-1) v
 *     = push - J^-T (K q + elements) - friction.
 * Its mass and damping are implicit, as for a single axis. An actuator of another kind goes where
 * its command leads it, whatever the force; the others are affected by it.
 *
 * Redundant actuators, more than the specimen has directions, are attached to it by springs of one
 * stiffness k_a, far stiffer than the specimen: q is the least-squares pose of x, J^-1 the
 * least-squares inverse, and what the axes deviate from a common pose loads them with
 *   k_a (x - J q),
 * forces in equilibrium with each other. */
#include <string.h>

#include "hydraulic.h"
#include "internal.h"
#include "sensor.h"
#include "small_solve.h"

#define STATE_MAX 1e15
#define COEFFICIENT_MAX 1e15
#define PIVOT_MIN 1e-12 /* for matrices scaled to a largest element of about 1 */

enum { MOST = RTHYB_COUPLED_MAX };

typedef rthyb_coupled_rig rig_t;

/* ---- small matrices, stored row by row --------------------------------------------------------- */

/* rows x columns */
static void times(const double *matrix, const double *x, int rows, int columns, double *out)
{
    for (int i = 0; i < rows; i++) {
        out[i] = 0.0;
        for (int j = 0; j < columns; j++)
            out[i] += matrix[i * columns + j] * x[j];
    }
}

static void transposed_times(const double *matrix, const double *x, int rows, int columns,
                             double *out)
{
    for (int i = 0; i < columns; i++) {
        out[i] = 0.0;
        for (int j = 0; j < rows; j++)
            out[i] += matrix[j * columns + i] * x[j];
    }
}

static void add_product(const double matrix[][MOST], const double *x, int n, double *out)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            out[i] += matrix[i][j] * x[j];
}

/* back' matrix back: the matrix of m directions in coordinates of n axes. */
static void along_axes(const double matrix[][MOST], const double *back, int n, int m, double *out)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            out[i * n + j] = 0.0;
            for (int k = 0; k < m; k++)
                for (int l = 0; l < m; l++)
                    out[i * n + j] += back[k * n + i] * matrix[k][l] * back[l * n + j];
        }
}

/* Scaled to a largest element of 1; 0 if there is no inverse. */
static int inverse(const double *matrix, int n, double *out)
{
    double a[RTHYB_COUPLED_SQUARE] = {0.0}, largest = 0.0;
    for (int i = 0; i < n * n; i++)
        largest = fmax(largest, fabs(matrix[i]));
    if (!(largest > 0.0 && largest <= COEFFICIENT_MAX))
        return 0;
    for (int i = 0; i < n * n; i++) {
        a[i] = matrix[i] / largest;
        out[i] = i % (n + 1) == 0 ? 1.0 / largest : 0.0;
    }
    return small_solve(a, out, n, n, PIVOT_MIN);
}

/* ---- setting up -------------------------------------------------------------------------------- */

static int within(const double *values, int count, double most)
{
    for (int i = 0; i < count; i++)
        if (!(fabs(values[i]) <= most))
            return 0;
    return 1;
}

static int symmetric(const double matrix[][MOST], int n)
{
    double largest = 0.0, apart = 0.0;
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            if (!(fabs(matrix[i][j]) <= COEFFICIENT_MAX))
                return 0;
            largest = fmax(largest, fabs(matrix[i][j]));
            apart = fmax(apart, fabs(matrix[i][j] - matrix[j][i]));
        }
    return apart <= 1e-9 * largest;
}

static int plant_ok(const rthyb_state_space *p, int n)
{
    int ok = p->states >= 0 && p->states <= RTHYB_PLANT_STATES;
    for (int k = 0; ok && k < p->states; k++)
        ok = within(p->a[k], p->states, COEFFICIENT_MAX) && within(p->b[k], n, COEFFICIENT_MAX);
    for (int i = 0; ok && p->states > 0 && i < n; i++)
        ok = within(p->x_of[i], p->states, COEFFICIENT_MAX) &&
             within(p->v_of[i], p->states, COEFFICIENT_MAX) &&
             within(p->a_of[i], p->states, COEFFICIENT_MAX) &&
             within(p->v_by[i], n, COEFFICIENT_MAX) && within(p->a_by[i], n, COEFFICIENT_MAX) &&
             p->stroke_m[i] > 0.0 && p->stroke_m[i] <= RTHYB_DISPLACEMENT_MAX_M;
    return ok;
}

static int sensors_ok(const rthyb_coupled_rig_config *c)
{
    int ok = c->load_cell == RTHYB_ACTUATOR_END || c->load_cell == RTHYB_SPECIMEN_END;
    for (int i = 0; i < c->size; i++)
        ok = ok && sensor_ok(&c->displacement[i], RTHYB_DISPLACEMENT_MAX_M) &&
             sensor_ok(&c->force[i], RTHYB_FORCE_MAX_N) &&
             extra_sensors_ok(c->extras[i], c->extra_count[i]);
    const int p = c->kinematics.displacement_sensors, q = c->kinematics.force_sensors;
    ok = ok && p >= 0 && p <= RTHYB_SENSORS_MAX && q >= 0 && q <= RTHYB_SENSORS_MAX;
    for (int k = 0; ok && k < p + q; k++)
        ok = c->sensor_extra[k] >= 0 && c->sensor_extra[k] <= c->size * RTHYB_EXTRAS_MAX &&
             sensor_ok(&c->sensor[k], k < p ? RTHYB_DISPLACEMENT_MAX_M : RTHYB_FORCE_MAX_N);
    return ok;
}

static int elements_ok(const rthyb_coupled_rig_config *c)
{
    if (c->element_count > RTHYB_ELEMENTS_MAX)
        return 0;
    for (uint32_t i = 0; i < c->element_count; i++)
        if (c->along[i] < 0 || c->along[i] >= rthyb_kinematics_directions(&c->kinematics) ||
            c->elements[i].kind == RTHYB_INERTIA)
            return 0;
    return 1;
}

static int hydraulic(const rig_t *r, int axis)
{
    return r->cfg.servo[axis].kind == RTHYB_SERVO_HYDRAULIC;
}

static int directions_of(const rig_t *r)
{
    return r->kinematics.cfg.directions;
}

/* Share of a motion of axis j that axis i does not make with it as one pose: 1 - J J^-1. */
static double deviation(const rig_t *r, int i, int j)
{
    const int n = r->cfg.size, m = directions_of(r);
    double share = i == j ? 1.0 : 0.0;
    for (int k = 0; k < m; k++)
        share -= r->jacobian[i * m + k] * r->back[k * n + j];
    return share;
}

/* Forces by which redundant actuators oppose each other at their positions x, added to those of the
 * axes. */
static void add_opposing(const rig_t *r, const double *x, double *force)
{
    const int n = r->cfg.size;
    for (int i = 0; i < n && directions_of(r) < n; i++)
        for (int j = 0; j < n; j++)
            force[i] += r->cfg.attachment_n_per_m * deviation(r, i, j) * x[j];
}

/* The fastest vibration of oil and specimen must have a period longer than pi substeps: h^2 times
 * the largest eigenvalue of M^-1 K below 4; the largest row sum is an upper bound of that
 * eigenvalue. Axes with a prescribed motion count as very heavy. */
static int resolved(const rig_t *r)
{
    const int n = r->cfg.size;
    double m[RTHYB_COUPLED_SQUARE], k[RTHYB_COUPLED_SQUARE], per_m[RTHYB_COUPLED_SQUARE];
    along_axes(r->cfg.mass, r->back, n, directions_of(r), m);
    along_axes(r->cfg.stiffness, r->back, n, directions_of(r), k);
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < n && directions_of(r) < n; j++)
            k[i * n + j] += r->cfg.attachment_n_per_m * deviation(r, i, j);
        k[i * n + i] += hydraulic(r, i) ? r->cfg.servo[i].oil_stiffness_n_per_m : 0.0;
        m[i * n + i] += hydraulic(r, i) ? r->cfg.servo[i].moving_mass_kg : 1e12;
    }
    if (!inverse(m, n, per_m))
        return 0;
    double largest = 0.0;
    for (int i = 0; i < n; i++) {
        double row = 0.0;
        for (int j = 0; j < n; j++) {
            double one = 0.0;
            for (int l = 0; l < n; l++)
                one += per_m[i * n + l] * k[l * n + j];
            row += fabs(one);
        }
        largest = fmax(largest, row);
    }
    const double h = r->cfg.period_s / r->substeps;
    return h * h * largest < 4.0;
}

static int servos_init(rig_t *r)
{
    rthyb_coupled_rig_config *c = &r->cfg;
    for (int i = 0; i < c->size; i++)
        if (hydraulic(r, i) && c->servo[i].substeps > r->substeps)
            r->substeps = c->servo[i].substeps;
    for (int i = 0; i < c->size; i++) {
        if (c->servo[i].kind == RTHYB_SERVO_VALVE)
            return RTHYB_E_SERVO;
        if (c->servo[i].period_s != c->period_s)
            return RTHYB_E_PERIOD;
        /* Tables that form one system use the same substeps. */
        if (hydraulic(r, i) && c->servo[i].substeps >= 1)
            c->servo[i].substeps = r->substeps;
        const int error = rthyb_servo_init(&r->servo[i], &c->servo[i]);
        if (error)
            return error;
    }
    return r->substeps == 0 || resolved(r) ? 0 : RTHYB_E_SERVO;
}

/* The inverse of the Jacobian, directions x axes. A matrix with redundant axes is constant. */
static int invert_jacobian(const rig_t *r, double *back)
{
    if (directions_of(r) == r->cfg.size)
        return inverse(r->jacobian, r->cfg.size, back);
    memcpy(back, r->kinematics.inverse, sizeof r->kinematics.inverse);
    return 1;
}

/* Which sensors the controller uses for the pose does not change where the specimen is; and with
 * load cells without an actuator, those of the axes are in line with them. */
static int kinematics_init(rig_t *r)
{
    rthyb_kinematics_config kinematics = r->cfg.kinematics;
    if (rthyb_kinematics_sensors(&kinematics) > 0) {
        const int error = rthyb_kinematics_init(&r->kinematics, &kinematics);
        if (error)
            return error;
    }
    kinematics.given &= ~RTHYB_GIVEN_DISPLACEMENTS;
    if (kinematics.force_sensors > 0)
        kinematics.given &= ~RTHYB_GIVEN_FORCES;
    kinematics.displacement_sensors = kinematics.force_sensors = 0;
    return rthyb_kinematics_init(&r->kinematics, &kinematics);
}

int rthyb_coupled_rig_init(rthyb_coupled_rig *rig, const rthyb_coupled_rig_config *cfg)
{
    if (!(cfg->period_s > 0.0 && cfg->period_s <= 1.0))
        return RTHYB_E_PERIOD;
    const int32_t m = rthyb_kinematics_directions(&cfg->kinematics);
    if (cfg->size < 1 || cfg->size > MOST || cfg->kinematics.size != cfg->size || m < 1 ||
        m > cfg->size || !plant_ok(&cfg->plant, cfg->size) || !symmetric(cfg->stiffness, m) ||
        !symmetric(cfg->damping, m) || !symmetric(cfg->mass, m) ||
        !(cfg->attachment_n_per_m >= 0.0 && cfg->attachment_n_per_m <= COEFFICIENT_MAX))
        return RTHYB_E_PLANT;
    if (!sensors_ok(cfg))
        return RTHYB_E_SENSOR;
    if (!elements_ok(cfg))
        return RTHYB_E_ELEMENT;
    *rig = (rthyb_coupled_rig){.cfg = *cfg};
    const int error = kinematics_init(rig);
    if (error)
        return error;
    rthyb_kinematics_jacobian(&rig->kinematics, rig->jacobian);
    if (!invert_jacobian(rig, rig->back))
        return RTHYB_E_KINEMATICS;
    rthyb_coupled_rig_reseed(rig);
    return cfg->plant.states > 0 ? 0 : servos_init(rig);
}

void rthyb_coupled_rig_reseed(rthyb_coupled_rig *rig)
{
    noise_seed(&rig->noise, rig->cfg.seed);
    /* A generator of their own, so that the other sensors have the same noise without them. */
    noise_seed(&rig->extra_noise, ~rig->cfg.seed);
    noise_seed(&rig->sensor_noise, rig->cfg.seed ^ (uint64_t)0x5555555555555555);
}

/* ---- what is latched ----------------------------------------------------------------------------- */

static int latch_plant(rig_t *r)
{
    const rthyb_state_space *p = &r->cfg.plant;
    const int n = r->cfg.size;
    int code = RTHYB_OK;
    for (int i = 0; i < n; i++) {
        double x = 0.0, v = 0.0, a = 0.0;
        for (int k = 0; k < p->states; k++) {
            x += p->x_of[i][k] * r->s[k];
            v += p->v_of[i][k] * r->s[k];
            a += p->a_of[i][k] * r->s[k];
        }
        for (int j = 0; j < n; j++) {
            v += p->v_by[i][j] * r->command[j];
            a += p->a_by[i][j] * r->command[j];
        }
        r->x_true_m[i] = confine(x, 1e2 * RTHYB_DISPLACEMENT_MAX_M, &code);
        r->v_true[i] = confine(v, 1e9, &code);
        r->a_true[i] = confine(a, 1e12, &code);
    }
    return code;
}

static int latch_servos(rig_t *r, const double *x_p_m)
{
    int code = RTHYB_OK;
    for (int i = 0; i < r->cfg.size; i++) {
        code |= rthyb_servo_latch(&r->servo[i], x_p_m[i]);
        r->x_true_m[i] = r->servo[i].x;
        r->v_true[i] = r->servo[i].v;
        r->a_true[i] = r->servo[i].a;
    }
    return code;
}

/* Pose, its velocity and its acceleration: x'' = J q'' + J' q', with J' from the previous
 * sample. */
static int latch_pose(rig_t *r)
{
    const int n = r->cfg.size, m = directions_of(r);
    double before[RTHYB_COUPLED_SQUARE], turned[MOST] = {0.0}, found[RTHYB_COUPLED_SQUARE];
    int code = rthyb_kinematics_pose(&r->kinematics, r->x_true_m, r->pose);
    memcpy(before, r->jacobian, sizeof before);
    rthyb_kinematics_jacobian(&r->kinematics, r->jacobian);
    if (invert_jacobian(r, found))
        memcpy(r->back, found, sizeof found);
    else
        code |= RTHYB_S_OUT_OF_RANGE;
    times(r->back, r->v_true, m, n, r->pose_v);
    for (int i = 0; i < n; i++) {
        turned[i] = r->a_true[i];
        for (int j = 0; j < m; j++)
            turned[i] -=
                (r->jacobian[i * m + j] - before[i * m + j]) / r->cfg.period_s * r->pose_v[j];
    }
    times(r->back, turned, m, n, r->pose_a);
    return code;
}

/* Resistance of the specimen in interface coordinates, without its damping and mass matrices. */
static void resist(rig_t *r, const double *q, const double *v, const double *a, double dt,
                   double *force)
{
    memset(force, 0, MOST * sizeof *force);
    add_product(r->cfg.stiffness, q, directions_of(r), force);
    for (uint32_t e = 0; e < r->cfg.element_count; e++) {
        const int j = r->cfg.along[e];
        force[j] += rthyb_element_force(&r->cfg.elements[e], q[j], v[j], a[j], dt);
    }
}

/* Load cells: at the actuator's end they measure the force of the oil column, otherwise the load of
 * the specimen on the axis; where they are not in line with the axes, forces with the resultant of
 * the specimen's, to which opposing actuators add nothing. dt = 0, because the substeps have
 * already advanced the elements to t_n. */
static void latch_forces(rig_t *r)
{
    const int n = r->cfg.size, m = directions_of(r);
    double force[MOST];
    resist(r, r->pose, r->pose_v, r->pose_a, r->substeps > 0 ? 0.0 : r->cfg.period_s, force);
    add_product(r->cfg.damping, r->pose_v, m, force);
    add_product(r->cfg.mass, r->pose_a, m, force);
    memcpy(r->force, force, (size_t)m * sizeof *force);
    if (r->kinematics.cfg.given & RTHYB_GIVEN_FORCES) {
        (void)rthyb_kinematics_pushes(&r->kinematics, force, r->f_true_n);
        return;
    }
    transposed_times(r->back, force, m, n, r->f_true_n);
    add_opposing(r, r->x_true_m, r->f_true_n);
    for (int i = 0; i < n; i++)
        if (r->cfg.plant.states == 0 && hydraulic(r, i) && r->cfg.load_cell == RTHYB_ACTUATOR_END)
            r->f_true_n[i] = r->servo[i].oil_force;
}

/* Extra sensors of an axis through which sensors without an actuator are read. */
static void pass_sensors(rig_t *r, int axis)
{
    const int count = rthyb_kinematics_sensors(&r->cfg.kinematics);
    for (int k = 0; k < count; k++) {
        const int place = r->cfg.sensor_extra[k] - 1;
        if (place >= 0 && place / RTHYB_EXTRAS_MAX == axis)
            r->extra[axis][place % RTHYB_EXTRAS_MAX] = r->sensor[k];
    }
}

static void latch_extras(rig_t *r)
{
    for (int i = 0; i < r->cfg.size; i++) {
        const double measured[RTHYB_EXTRA_KINDS] = {
            [RTHYB_EXTRA_DISPLACEMENT] = r->x_true_m[i],
            [RTHYB_EXTRA_VELOCITY] = r->v_true[i],
            [RTHYB_EXTRA_ACCELERATION] = r->a_true[i],
            [RTHYB_EXTRA_FORCE] = r->f_true_n[i],
        };
        const uint32_t count = r->cfg.extra_count[i];
        sense_extras(&r->extra_noise, r->cfg.extras[i], count, measured, r->extra[i]);
        pass_sensors(r, i);
        if (r->extra_to[i])
            memcpy(r->extra_to[i], r->extra[i], count * sizeof *r->extra[i]);
    }
}

/* Sensors without an actuator. */
static void latch_sensors(rig_t *r)
{
    const rthyb_kinematics_config *cfg = &r->cfg.kinematics;
    const int count = rthyb_kinematics_sensors(cfg);
    if (count == 0)
        return;
    double truth[RTHYB_SENSORS_ALL] = {0.0};
    rthyb_kinematics_readings(cfg, r->pose, r->force, truth);
    for (int k = 0; k < count; k++)
        r->sensor[k] = sense(&r->sensor_noise, &r->cfg.sensor[k], truth[k]);
}

/* ---- moving on ------------------------------------------------------------------------------------ */

static int advance_plant(rig_t *r, const double *x_p_m)
{
    const rthyb_state_space *p = &r->cfg.plant;
    int code = RTHYB_OK;
    double next[RTHYB_PLANT_STATES] = {0.0};
    for (int i = 0; i < r->cfg.size; i++) {
        const double x = accept(x_p_m[i], 1e2 * RTHYB_DISPLACEMENT_MAX_M, r->command[i], &code);
        r->command[i] = clamp(x, -p->stroke_m[i], p->stroke_m[i]);
    }
    for (int k = 0; k < p->states; k++) {
        for (int j = 0; j < p->states; j++)
            next[k] += p->a[k][j] * r->s[j];
        for (int j = 0; j < r->cfg.size; j++)
            next[k] += p->b[k][j] * r->command[j];
    }
    for (int k = 0; k < p->states; k++)
        r->s[k] = confine(next[k], STATE_MAX, &code);
    return code;
}

/* One sample of tables that form one system: the values that are constant within it. */
typedef struct {
    double h;
    double start[MOST], rise[MOST]; /* commands */
    double speed[MOST];             /* of axes with a prescribed motion */
    double left[RTHYB_COUPLED_SQUARE], right[RTHYB_COUPLED_SQUARE];
} joint_sample;

static int joint_begin(rig_t *r, joint_sample *s)
{
    const int n = r->cfg.size;
    double m[RTHYB_COUPLED_SQUARE], c[RTHYB_COUPLED_SQUARE], own[RTHYB_COUPLED_SQUARE] = {0.0};
    int code = RTHYB_OK;
    *s = (joint_sample){.h = r->cfg.period_s / r->substeps};
    along_axes(r->cfg.mass, r->back, n, directions_of(r), m);
    along_axes(r->cfg.damping, r->back, n, directions_of(r), c);
    for (int i = 0; i < n; i++) {
        const rthyb_servo_config *cfg = &r->cfg.servo[i];
        if (hydraulic(r, i)) {
            rthyb_servo_run_up(&r->servo[i], &s->start[i], &s->rise[i]);
            m[i * n + i] += cfg->moving_mass_kg;
            c[i * n + i] += cfg->oil_damping_n_s_per_m + cfg->viscous_n_s_per_m;
        } else {
            const double x = r->servo[i].x;
            code |= rthyb_servo_advance(&r->servo[i], NULL, 0);
            s->speed[i] = (r->servo[i].x - x) / r->cfg.period_s;
        }
        for (int j = 0; j < n; j++) {
            const double damping = 0.5 * s->h * c[i * n + j];
            own[i * n + j] = hydraulic(r, i) ? m[i * n + j] + damping : (double)(i == j);
            s->right[i * n + j] = m[i * n + j] - damping;
        }
    }
    return inverse(own, n, s->left) ? code : code | RTHYB_S_OUT_OF_RANGE;
}

/* State of the specimen at the beginning of a substep, and its load on the axes. */
static void asked_of_axes(rig_t *r, const joint_sample *s, int substep, double *asked)
{
    const int n = r->cfg.size, m = directions_of(r);
    double moved[MOST], v[MOST], a[MOST], q[MOST], qv[MOST], qa[MOST], force[MOST];
    double x[MOST] = {0.0};
    for (int i = 0; i < n; i++) {
        const int free = hydraulic(r, i);
        moved[i] = free ? r->servo[i].x - r->x_true_m[i] : s->h * substep * s->speed[i];
        v[i] = free ? r->servo[i].v : s->speed[i];
        a[i] = free ? r->servo[i].a : r->a_true[i];
        x[i] = r->x_true_m[i] + moved[i];
    }
    times(r->back, moved, m, n, q);
    times(r->back, v, m, n, qv);
    times(r->back, a, m, n, qa);
    for (int j = 0; j < m; j++)
        q[j] += r->pose[j];
    resist(r, q, qv, qa, s->h, force);
    transposed_times(r->back, force, m, n, asked);
    add_opposing(r, x, asked);
}

static int advance_together(rig_t *r)
{
    const int n = r->cfg.size;
    joint_sample s;
    int code = joint_begin(r, &s);
    const double per_h = 1.0 / s.h;
    double before[MOST], asked[MOST] = {0.0}, known[MOST], half[MOST];
    for (int step = 0; step < r->substeps; step++) {
        for (int i = 0; i < n; i++)
            before[i] =
                hydraulic(r, i) ? r->servo[i].half_velocity : s.speed[i] - s.h * r->a_true[i];
        asked_of_axes(r, &s, step, asked);
        times(s.right, before, n, n, known);
        for (int i = 0; i < n; i++) {
            const rthyb_servo_config *c = &r->cfg.servo[i];
            if (!hydraulic(r, i)) {
                known[i] = s.speed[i];
                continue;
            }
            const double push = hydraulic_push(&r->servo[i], s.start[i] + s.rise[i] * (step + 0.5),
                                               s.h, 1.0 / c->stall_force_n);
            const double sign = smooth_sign(r->servo[i].v / c->friction_width_m_per_s);
            known[i] += s.h * (push - asked[i] - c->friction_n * sign);
        }
        times(s.left, known, n, n, half);
        for (int i = 0; i < n; i++)
            if (hydraulic(r, i))
                hydraulic_move(&r->servo[i], half[i], s.h, per_h);
    }
    for (int i = 0; i < n; i++)
        code |= rthyb_servo_confine(&r->servo[i]);
    return code;
}

static int advance_alone(rig_t *r)
{
    int code = RTHYB_OK;
    for (int i = 0; i < r->cfg.size; i++)
        code |= rthyb_servo_advance(&r->servo[i], NULL, 0);
    return code;
}

int rthyb_coupled_rig_step(rthyb_coupled_rig *rig, const double *x_p_m, double *x_m_m, double *f_n)
{
    const int by_plant = rig->cfg.plant.states > 0;
    int code = by_plant ? latch_plant(rig) : latch_servos(rig, x_p_m);
    code |= latch_pose(rig);
    latch_forces(rig);
    for (int i = 0; i < rig->cfg.size; i++) {
        x_m_m[i] = sense(&rig->noise, &rig->cfg.displacement[i], rig->x_true_m[i]);
        f_n[i] = sense(&rig->noise, &rig->cfg.force[i], rig->f_true_n[i]);
    }
    latch_sensors(rig);
    latch_extras(rig);
    if (by_plant)
        return code | advance_plant(rig, x_p_m);
    return code | (rig->substeps > 0 ? advance_together(rig) : advance_alone(rig));
}

int rthyb_coupled_rig_run(rthyb_coupled_rig *rig, const double *x_p_m, double *x_m_m, double *f_n,
                          size_t n)
{
    int code = RTHYB_OK;
    const size_t width = (size_t)rig->cfg.size;
    for (size_t i = 0; i < n; i++)
        code |= rthyb_coupled_rig_step(rig, x_p_m + i * width, x_m_m + i * width, f_n + i * width);
    return code;
}
