/* Kinematics of several actuators at one specimen.
 *
 * Pins: the coupler moves in its plane by (x, y) and rotates by theta, so that a pin p moves by
 *   d = (x, y) + (R(theta) - 1) p,
 * and its axis, from base to pin r at rest, becomes longer by
 *   |r + d| - |r| = d (2 r + d) / (|r + d| + |r|),
 * which remains accurate however small d is. A far axis keeps its direction e: e d. The inverse is
 * found by Newton's method, with two steps from the last pose: within a sample, a specimen moves by
 * less than a millimetre, and each step squares the remaining error.
 *
 * A matrix T may have more rows (axes) than columns (coordinates). The pose then is D x, with
 * D T = 1: the given D, or the least-squares inverse (T'T)^-1 T'. Interface forces are F f, with the
 * given F, or T', for which the axes do the same virtual work as the interface: f'(T dq) =
 * (T'f)'dq. The forces that correspond to a resultant are F'(F F')^-1 times it.
 *
 * Displacement sensors without an actuator read S q, load cells without one G r, where r are the
 * interface forces. The pose then is D (x, S q) with D (T, S) = 1, and r = F (f, G r). The load
 * cells of the axes measure f = T (T'T)^-1 r and what opposes it, so F (T (T'T)^-1, G) = 1.
 *
 * With pins, a displacement sensor without an actuator is such a rod as well. The pose is the
 * least-squares one of all readings, by Gauss-Newton: dq = (J'J)^-1 J'e, with the rows of J of axes
 * and sensors and their differences e. If the readings agree, this is Newton's method; what they
 * disagree by, d, adds the share d / length to what a step leaves. Load cells without an actuator
 * correct what those of the axes give, r0 = J'f, by F (g - G r0). Whatever F is, this is r if both
 * measure r: r0 = r and g = G r. */
#include "numeric.h"
#include "small_solve.h"

#define ANGLE_MAX 1.5 /* rad: beyond, something is broken */
/* Of the Jacobian, with rotations in lengths of the coupler: a twentieth of a degree between two
 * axes. */
#define PIVOT_MIN 1e-3
#define NEWTON_STEPS 2
/* Share of the distance that two steps may leave. With e1 = C e0^2, they leave (C e0)^3 of it: less
 * than this if C e0 < 0.2, and from there Newton's method converges. */
#define CONVERGES 1e-2
#define FOUND_M 1e-9    /* above rounding for bases 1e6 m away, below any sensor's noise */
#define SEARCH_STEPS 16 /* from any pose to any other that a rig can have */
/* Of T'T, with columns scaled to length 1: the square of PIVOT_MIN. */
#define GRAM_PIVOT_MIN 1e-6
#define IDENTITY_WITHIN 1e-6 /* of D T, relative: entries may be rounded to seven digits */

enum { MOST = RTHYB_COUPLED_MAX, ROWS_MAX = RTHYB_COUPLED_MAX + RTHYB_SENSORS_MAX };

typedef struct {
    double x, y, theta;
} plane;

static double limit_of(const rthyb_kinematics *s, int coordinate)
{
    const int turns = s->cfg.kind == RTHYB_KINEMATICS_PINS &&
                      s->cfg.coordinate[coordinate] == RTHYB_COORDINATE_THETA;
    return turns ? ANGLE_MAX : RTHYB_DISPLACEMENT_MAX_M;
}

static plane plane_of(const rthyb_kinematics_config *cfg, const double *pose)
{
    plane at = {0.0, 0.0, 0.0};
    for (int j = 0; j < cfg->size; j++) {
        double *const where[] = {&at.x, &at.y, &at.theta};
        *where[cfg->coordinate[j]] = pose[j];
    }
    return at;
}

/* From a base to a pin on the coupler: an axis, or a displacement sensor without an actuator. */
typedef struct {
    const double *pin;
    double rx, ry; /* from base to pin at rest; far: the unit direction */
    double rest;   /* length at rest */
    int far;
    double sign; /* -1: shortening is positive */
} rod;

static rod rod_of_axis(const rthyb_kinematics *s, int i)
{
    const double sign = s->cfg.pulls[i] ? -1.0 : 1.0;
    return (rod){s->cfg.pin_m[i], s->reach[i][0], s->reach[i][1],
                 s->rest_m[i],    s->cfg.far[i],  sign};
}

static rod rod_between(const double *pin, const double *base, int far, int pulls)
{
    const double rx = far ? base[0] : pin[0] - base[0], ry = far ? base[1] : pin[1] - base[1];
    const double length = hypot(rx, ry), unit = far ? length : 1.0;
    return (rod){pin, rx / unit, ry / unit, length, far, pulls ? -1.0 : 1.0};
}

static rod rod_of_sensor(const rthyb_kinematics_config *cfg, int k)
{
    return rod_between(cfg->sensor_pin_m[k], cfg->sensor_base_m[k], cfg->sensor_far[k],
                       cfg->sensor_pulls[k]);
}

/* Displacement of a rod at a pose, and its derivatives with respect to the coordinates. */
static double reach(const rthyb_kinematics_config *cfg, const rod *r, const plane *at,
                    double *slope)
{
    const double px = r->pin[0], py = r->pin[1];
    const double sine = sin(at->theta), half = sin(0.5 * at->theta), less = -2.0 * half * half;
    const double dx = at->x + less * px - sine * py, dy = at->y + sine * px + less * py;
    const double rx = r->rx, ry = r->ry;
    const double length = r->far ? 1.0 : hypot(rx + dx, ry + dy);
    /* A pin at its own base has no direction: the rod keeps the one that it had at rest. */
    const int stands = r->far || !(length > 0.0);
    const double unit = stands && !r->far ? r->rest : length;
    const double ex = (stands ? rx : rx + dx) / unit, ey = (stands ? ry : ry + dy) / unit;
    const double by[] = {
        ex, ey, ex * (-sine * px - (1.0 + less) * py) + ey * ((1.0 + less) * px - sine * py)};
    for (int j = 0; slope && j < cfg->size; j++)
        slope[j] = r->sign * by[cfg->coordinate[j]];
    const double longer = r->far
                              ? rx * dx + ry * dy
                              : (dx * (2.0 * rx + dx) + dy * (2.0 * ry + dy)) / (length + r->rest);
    return r->sign * longer;
}

/* rows x columns */
static void multiply(const double *matrix, const double *x, int rows, int columns, double *out)
{
    for (int i = 0; i < rows; i++) {
        out[i] = 0.0;
        for (int j = 0; j < columns; j++)
            out[i] += matrix[i * columns + j] * x[j];
    }
}

/* ---- rates ----------------------------------------------------------------------------------------- */

/* With q the rotated pin and w = theta', the pin has the velocity v = (x', y') + w x q and the
 * acceleration a = (x", y") + w' x q - w^2 q; its axis, with direction e and length L, becomes
 * longer at the rate e v, with the acceleration e a + (v^2 - (e v)^2) / L, whose last term is due
 * to the rotation of the axis itself. */
static void pin_rates(const rthyb_kinematics *s, int axis, const plane *at, const plane *by,
                      const plane *change, double *velocity, double *acceleration)
{
    const double px = s->cfg.pin_m[axis][0], py = s->cfg.pin_m[axis][1];
    const double sine = sin(at->theta), cosine = cos(at->theta), w = by->theta, dw = change->theta;
    const double qx = cosine * px - sine * py, qy = sine * px + cosine * py;
    const double vx = by->x - w * qy, vy = by->y + w * qx;
    const double ax = change->x - dw * qy - w * w * qx, ay = change->y + dw * qx - w * w * qy;
    const int far = s->cfg.far[axis];
    const double rx = s->reach[axis][0] + (far ? 0.0 : at->x + qx - px);
    const double ry = s->reach[axis][1] + (far ? 0.0 : at->y + qy - py);
    const double length = hypot(rx, ry), sign = s->cfg.pulls[axis] ? -1.0 : 1.0;
    if (!(length > 0.0)) {
        *velocity = *acceleration = HUGE_VAL;
        return;
    }
    const double ex = rx / length, ey = ry / length, along = ex * vx + ey * vy;
    const double across = ex * vy - ey * vx;
    *velocity = sign * along;
    *acceleration = sign * (ex * ax + ey * ay + (far ? 0.0 : across * across / length));
}

void rthyb_kinematics_rates(const rthyb_kinematics *s, const double *pose, const double *velocity,
                            const double *acceleration, double *axis_velocity,
                            double *axis_acceleration)
{
    if (s->cfg.kind == RTHYB_KINEMATICS_MATRIX) {
        multiply(s->cfg.matrix, velocity, s->cfg.size, s->cfg.directions, axis_velocity);
        multiply(s->cfg.matrix, acceleration, s->cfg.size, s->cfg.directions, axis_acceleration);
        return;
    }
    const plane at = plane_of(&s->cfg, pose), by = plane_of(&s->cfg, velocity),
                change = plane_of(&s->cfg, acceleration);
    for (int i = 0; i < s->cfg.size; i++)
        pin_rates(s, i, &at, &by, &change, &axis_velocity[i], &axis_acceleration[i]);
}

/* ---- setting up ---------------------------------------------------------------------------------- */

static int within(const double *values, int count, double most)
{
    for (int i = 0; i < count; i++)
        if (!(fabs(values[i]) <= most))
            return 0;
    return 1;
}

static int square_init(rthyb_kinematics *s)
{
    const int n = s->cfg.size;
    double a[RTHYB_COUPLED_SQUARE] = {0.0}, norm = 0.0;
    for (int i = 0; i < n * n; i++) {
        a[i] = s->cfg.matrix[i];
        norm = fmax(norm, fabs(a[i]));
        s->inverse[i] = i % (n + 1) == 0 ? 1.0 : 0.0;
    }
    return norm >= 1e-6 && small_solve(a, s->inverse, n, n, 1e-9 * norm) ? 0 : RTHYB_E_KINEMATICS;
}

/* Least-squares inverse (m x n) of a matrix t (n x m); 0 if its columns are not independent. */
static int left_inverse(const double *t, int n, int m, double *out)
{
    double scale[MOST], gram[RTHYB_COUPLED_SQUARE] = {0.0};
    for (int j = 0; j < m; j++) {
        double sum = 0.0;
        for (int i = 0; i < n; i++)
            sum += t[i * m + j] * t[i * m + j];
        scale[j] = sqrt(sum);
        if (!(scale[j] >= 1e-6))
            return 0;
    }
    for (int j = 0; j < m; j++)
        for (int i = 0; i < n; i++) {
            out[j * n + i] = t[i * m + j] / scale[j];
            for (int k = 0; k < m; k++)
                gram[j * m + k] += t[i * m + j] / scale[j] * t[i * m + k] / scale[k];
        }
    if (!small_solve(gram, out, m, n, GRAM_PIVOT_MIN))
        return 0;
    for (int j = 0; j < m; j++)
        for (int i = 0; i < n; i++)
            out[j * n + i] /= scale[j];
    return 1;
}

/* Whether d (m x n) times t (n x m) is the identity. */
static int inverts(const double *d, const double *t, int n, int m)
{
    for (int j = 0; j < m; j++)
        for (int k = 0; k < m; k++) {
            double sum = 0.0, size = 0.0;
            for (int i = 0; i < n; i++) {
                sum += d[j * n + i] * t[i * m + k];
                size += fabs(d[j * n + i] * t[i * m + k]);
            }
            if (!(fabs(sum - (j == k ? 1.0 : 0.0)) <= IDENTITY_WITHIN * fmax(1.0, size)))
                return 0;
        }
    return 1;
}

static int is_given(const rthyb_kinematics_config *cfg, int what)
{
    return (cfg->given & what) != 0;
}

/* Whether the load cells of the axes alone give the interface forces, by the given matrix. */
static int by_own_cells(const rthyb_kinematics_config *cfg)
{
    return is_given(cfg, RTHYB_GIVEN_FORCES) && cfg->force_sensors == 0;
}

/* The forces of the axes that have a given resultant. */
static int pushes_init(rthyb_kinematics *s)
{
    const int n = s->cfg.size, m = s->cfg.directions;
    double turned[RTHYB_COUPLED_SQUARE], back[RTHYB_COUPLED_SQUARE];
    for (int j = 0; j < m; j++)
        for (int i = 0; i < n; i++)
            turned[i * m + j] =
                by_own_cells(&s->cfg) ? s->cfg.forces[j * n + i] : s->cfg.matrix[i * m + j];
    if (!left_inverse(turned, n, m, back))
        return 0;
    for (int j = 0; j < m; j++)
        for (int i = 0; i < n; i++)
            s->pushes[i * m + j] = back[j * n + i];
    return 1;
}

/* `first` (n x m) above `then` (k x m). */
static void stack(const double *first, int n, const double *then, int k, int m, double *out)
{
    for (int i = 0; i < n * m; i++)
        out[i] = first[i];
    for (int i = 0; i < k * m; i++)
        out[n * m + i] = then[i];
}

/* Sensors without an actuator, after `inverse` and `pushes`. */
static int sensors_init(rthyb_kinematics *s)
{
    const rthyb_kinematics_config *cfg = &s->cfg;
    const int n = cfg->size, m = cfg->directions;
    const int p = cfg->displacement_sensors, q = cfg->force_sensors;
    double all[RTHYB_MEASURED_MAX] = {0.0};
    stack(cfg->matrix, n, cfg->reads, p, m, all);
    if (p > 0 && !is_given(cfg, RTHYB_GIVEN_DISPLACEMENTS) &&
        !left_inverse(all, n + p, m, s->measure))
        return RTHYB_E_KINEMATICS;
    if (p > 0 && is_given(cfg, RTHYB_GIVEN_DISPLACEMENTS)) {
        if (!inverts(cfg->displacements, all, n + p, m))
            return RTHYB_E_KINEMATICS;
        stack(cfg->displacements, m, NULL, 0, n + p, s->measure);
    }
    stack(s->pushes, n, cfg->carries, q, m, all);
    return q == 0 || inverts(cfg->forces, all, n + q, m) ? 0 : RTHYB_E_KINEMATICS;
}

static int matrices_ok(const rthyb_kinematics_config *cfg)
{
    const int n = cfg->size, m = cfg->directions;
    const int p = cfg->displacement_sensors, q = cfg->force_sensors;
    return within(cfg->matrix, n * m, 1e6) && within(cfg->reads, p * m, 1e6) &&
           within(cfg->carries, q * m, 1e6) && (q == 0 || is_given(cfg, RTHYB_GIVEN_FORCES)) &&
           (!is_given(cfg, RTHYB_GIVEN_FORCES) || within(cfg->forces, m * (n + q), 1e6)) &&
           (!is_given(cfg, RTHYB_GIVEN_DISPLACEMENTS) ||
            within(cfg->displacements, m * (n + p), 1e6));
}

static int matrix_init(rthyb_kinematics *s)
{
    const int n = s->cfg.size, m = s->cfg.directions;
    const int forces = is_given(&s->cfg, RTHYB_GIVEN_FORCES);
    const int own_displacements =
        is_given(&s->cfg, RTHYB_GIVEN_DISPLACEMENTS) && s->cfg.displacement_sensors == 0;
    if (!matrices_ok(&s->cfg))
        return RTHYB_E_KINEMATICS;
    if (n == m) {
        const int error = square_init(s);
        if (error)
            return error;
    } else if (!left_inverse(s->cfg.matrix, n, m, s->inverse)) {
        return RTHYB_E_KINEMATICS;
    }
    if (own_displacements) {
        if (!inverts(s->cfg.displacements, s->cfg.matrix, n, m))
            return RTHYB_E_KINEMATICS;
        for (int i = 0; i < n * m; i++)
            s->inverse[i] = s->cfg.displacements[i];
    }
    if (!(n == m && !forces) && !pushes_init(s))
        return RTHYB_E_KINEMATICS;
    return rthyb_kinematics_sensors(&s->cfg) == 0 ? 0 : sensors_init(s);
}

static int coordinates_ok(const rthyb_kinematics_config *cfg)
{
    int named[3] = {0, 0, 0};
    for (int j = 0; j < cfg->size; j++) {
        const int32_t c = cfg->coordinate[j];
        if (c < RTHYB_COORDINATE_X || c > RTHYB_COORDINATE_THETA || named[c])
            return 0;
        named[c] = 1;
    }
    return 1;
}

static int solves(const rthyb_kinematics *s, const double *jacobian, double *b)
{
    const int n = s->cfg.size;
    double a[RTHYB_COUPLED_SQUARE] = {0.0};
    for (int i = 0; i < n * n; i++)
        a[i] = jacobian[i] / s->scale[i % n];
    if (!small_solve(a, b, n, 1, PIVOT_MIN))
        return 0;
    for (int j = 0; j < n; j++)
        b[j] /= s->scale[j];
    return 1;
}

/* Sensors without an actuator, with pins. */
static int rods_ok(const rthyb_kinematics_config *cfg)
{
    const int m = cfg->size, p = cfg->displacement_sensors, q = cfg->force_sensors;
    if (cfg->given != (q > 0 ? RTHYB_GIVEN_FORCES : 0) || !within(cfg->carries, q * m, 1e6) ||
        !within(cfg->forces, q * m, 1e6) ||
        !within(cfg->sensor_pin_m[0], 2 * p, RTHYB_DISPLACEMENT_MAX_M) ||
        !within(cfg->sensor_base_m[0], 2 * p, 1e6))
        return 0;
    for (int k = 0; k < p; k++)
        if (!(rod_of_sensor(cfg, k).rest > 1e-6))
            return 0;
    return 1;
}

static int pins_init(rthyb_kinematics *s)
{
    const rthyb_kinematics_config *cfg = &s->cfg;
    const int n = cfg->size;
    if (n > 3 || cfg->directions != n || !coordinates_ok(cfg) || !rods_ok(cfg) ||
        !within(cfg->pin_m[0], 2 * n, RTHYB_DISPLACEMENT_MAX_M) ||
        !within(cfg->base_m[0], 2 * n, 1e6))
        return RTHYB_E_KINEMATICS;
    double arm = 0.0;
    for (int i = 0; i < n; i++) {
        const double *pin = cfg->pin_m[i];
        const rod own = rod_between(pin, cfg->base_m[i], cfg->far[i], cfg->pulls[i]);
        if (!(own.rest > 1e-6))
            return RTHYB_E_KINEMATICS;
        s->reach[i][0] = own.rx;
        s->reach[i][1] = own.ry;
        s->rest_m[i] = own.rest;
        arm = fmax(arm, hypot(pin[0], pin[1]));
    }
    for (int j = 0; j < n; j++) {
        s->scale[j] = cfg->coordinate[j] == RTHYB_COORDINATE_THETA ? arm : 1.0;
        if (!(s->scale[j] > 1e-6))
            return RTHYB_E_KINEMATICS;
    }
    double jacobian[RTHYB_COUPLED_SQUARE] = {0.0}, b[MOST] = {0.0};
    rthyb_kinematics_jacobian(s, jacobian);
    return solves(s, jacobian, b) ? 0 : RTHYB_E_KINEMATICS;
}

int32_t rthyb_kinematics_directions(const rthyb_kinematics_config *cfg)
{
    return cfg->directions == 0 ? cfg->size : cfg->directions;
}

int32_t rthyb_kinematics_sensors(const rthyb_kinematics_config *cfg)
{
    return cfg->displacement_sensors + cfg->force_sensors;
}

int rthyb_kinematics_init(rthyb_kinematics *s, const rthyb_kinematics_config *cfg)
{
    const int32_t directions = rthyb_kinematics_directions(cfg);
    if (cfg->size < 1 || cfg->size > MOST || directions < 1 || directions > cfg->size ||
        cfg->displacement_sensors < 0 || cfg->displacement_sensors > RTHYB_SENSORS_MAX ||
        cfg->force_sensors < 0 || cfg->force_sensors > RTHYB_SENSORS_MAX || cfg->given < 0 ||
        cfg->given > (RTHYB_GIVEN_FORCES | RTHYB_GIVEN_DISPLACEMENTS) ||
        (cfg->kind != RTHYB_KINEMATICS_MATRIX && cfg->kind != RTHYB_KINEMATICS_PINS))
        return RTHYB_E_KINEMATICS;
    *s = (rthyb_kinematics){.cfg = *cfg};
    s->cfg.directions = directions;
    return cfg->kind == RTHYB_KINEMATICS_MATRIX ? matrix_init(s) : pins_init(s);
}

/* ---- both ways ----------------------------------------------------------------------------------- */

void rthyb_kinematics_jacobian(const rthyb_kinematics *s, double *jacobian)
{
    const int n = s->cfg.size;
    if (s->cfg.kind == RTHYB_KINEMATICS_MATRIX) {
        for (int i = 0; i < n * s->cfg.directions; i++)
            jacobian[i] = s->cfg.matrix[i];
        return;
    }
    const plane at = plane_of(&s->cfg, s->pose);
    for (int i = 0; i < n; i++) {
        const rod own = rod_of_axis(s, i);
        (void)reach(&s->cfg, &own, &at, jacobian + (ptrdiff_t)i * n);
    }
}

void rthyb_kinematics_reads(const rthyb_kinematics *s, double *reads)
{
    const int m = s->cfg.directions, p = s->cfg.displacement_sensors;
    if (s->cfg.kind == RTHYB_KINEMATICS_MATRIX) {
        for (int i = 0; i < p * m; i++)
            reads[i] = s->cfg.reads[i];
        return;
    }
    const plane at = plane_of(&s->cfg, s->pose);
    for (int k = 0; k < p; k++) {
        const rod own = rod_of_sensor(&s->cfg, k);
        (void)reach(&s->cfg, &own, &at, reads + (ptrdiff_t)k * m);
    }
}

int rthyb_kinematics_axes(rthyb_kinematics *s, const double *pose, double *axis_m)
{
    int code = RTHYB_OK;
    const int n = s->cfg.size, m = s->cfg.directions;
    for (int j = 0; j < m; j++)
        s->wanted[j] = accept(pose[j], limit_of(s, j), s->wanted[j], &code);
    if (s->cfg.kind == RTHYB_KINEMATICS_MATRIX) {
        multiply(s->cfg.matrix, s->wanted, n, m, axis_m);
        return code;
    }
    const plane at = plane_of(&s->cfg, s->wanted);
    for (int i = 0; i < n; i++) {
        const rod own = rod_of_axis(s, i);
        axis_m[i] = reach(&s->cfg, &own, &at, NULL);
    }
    return code;
}

/* Differences of readings from those at a pose, and the largest of them; on request, also the
 * Jacobian there. `rows`: the axes, or with them the displacement sensors without an actuator. */
static double left_of(const rthyb_kinematics *s, int rows, const double *pose, const double *axis_m,
                      const double *sensor, double *jacobian, double *left)
{
    const int n = s->cfg.size;
    const plane at = plane_of(&s->cfg, pose);
    double most = 0.0;
    for (int i = 0; i < rows; i++) {
        const rod own = i < n ? rod_of_axis(s, i) : rod_of_sensor(&s->cfg, i - n);
        const double read = i < n ? axis_m[i] : sensor[i - n];
        left[i] = read - reach(&s->cfg, &own, &at, jacobian ? jacobian + (ptrdiff_t)i * n : NULL);
        most = fmax(most, fabs(left[i]));
    }
    return most;
}

static double left_at(const rthyb_kinematics *s, int rows, const double *pose, double *jacobian,
                      double *left)
{
    return left_of(s, rows, pose, s->axis_m, s->sensor, jacobian, left);
}

void rthyb_kinematics_left(const rthyb_kinematics *s, const double *axis_m, const double *sensor,
                           double *slopes, double *left)
{
    const int rows = s->cfg.size + s->cfg.displacement_sensors;
    (void)left_of(s, rows, s->pose, axis_m, sensor, slopes, left);
}

/* Least-squares step for more readings than coordinates; *most: the largest change of a reading that
 * it makes, because a part of the differences is left whatever the pose is. */
static int least_squares(const rthyb_kinematics *s, int rows, const double *jacobian,
                         const double *left, double *step, double *most)
{
    const int n = s->cfg.size;
    double gram[RTHYB_COUPLED_SQUARE] = {0.0};
    for (int j = 0; j < n; j++) {
        step[j] = 0.0;
        for (int i = 0; i < rows; i++) {
            const double slope = jacobian[i * n + j] / s->scale[j];
            step[j] += slope * left[i];
            for (int k = 0; k < n; k++)
                gram[j * n + k] += slope * jacobian[i * n + k] / s->scale[k];
        }
    }
    if (!small_solve(gram, step, n, 1, GRAM_PIVOT_MIN))
        return 0;
    for (int j = 0; j < n; j++)
        step[j] /= s->scale[j];
    *most = 0.0;
    for (int i = 0; i < rows; i++) {
        double moved = 0.0;
        for (int j = 0; j < n; j++)
            moved += jacobian[i * n + j] * step[j];
        *most = fmax(*most, fabs(moved));
    }
    return 1;
}

/* The next step from a pose, and the largest difference that it is to remove. */
static int next_step(const rthyb_kinematics *s, int rows, const double *pose, double *step,
                     double *most)
{
    const int n = s->cfg.size;
    double jacobian[RTHYB_MEASURED_MAX] = {0.0}, left[ROWS_MAX] = {0.0};
    *most = left_at(s, rows, pose, jacobian, left);
    if (rows > n)
        return least_squares(s, rows, jacobian, left, step, most);
    for (int j = 0; j < n; j++)
        step[j] = left[j];
    return solves(s, jacobian, step);
}

/* Executes Newton steps; gives the largest difference before and after them. 0 if they do not lead
 * to a pose. */
static int go_by_newton(const rthyb_kinematics *s, int rows, int steps, double *pose,
                        double *before, double *after)
{
    const int n = s->cfg.size;
    double step[MOST] = {0.0}, left[ROWS_MAX] = {0.0};
    *before = -1.0;
    for (int i = 0; i < steps; i++) {
        double most = 0.0;
        const int found = next_step(s, rows, pose, step, &most);
        *before = i == 0 ? most : *before;
        if (!found)
            return 0;
        for (int j = 0; j < n; j++)
            pose[j] += step[j];
    }
    for (int j = 0; j < n; j++)
        if (judge(pose[j], limit_of(s, j)) != RTHYB_OK)
            return 0;
    if (rows > n)
        return next_step(s, rows, pose, step, after);
    *after = left_at(s, rows, pose, NULL, left);
    return 1;
}

/* Two Newton steps; the last pose is kept if they lead to none, or leave more than CONVERGES of the
 * difference. */
static int pose_by_newton(rthyb_kinematics *s, int rows)
{
    const int n = s->cfg.size;
    double pose[MOST] = {0.0}, before = 0.0, after = 0.0;
    for (int j = 0; j < n; j++)
        pose[j] = s->pose[j];
    if (!go_by_newton(s, rows, NEWTON_STEPS, pose, &before, &after) ||
        !(after <= fmax(CONVERGES * before, FOUND_M)))
        return RTHYB_S_OUT_OF_RANGE;
    for (int j = 0; j < n; j++)
        s->pose[j] = pose[j];
    return RTHYB_OK;
}

static int search(rthyb_kinematics *s, double *pose)
{
    double before = 0.0, after = 0.0;
    return go_by_newton(s, s->cfg.size, SEARCH_STEPS, pose, &before, &after) && after <= FOUND_M;
}

int rthyb_kinematics_find(rthyb_kinematics *s, const double *axis_m, double *pose)
{
    const int n = s->cfg.size;
    double at[MOST] = {0.0};
    if (s->cfg.kind == RTHYB_KINEMATICS_MATRIX)
        return rthyb_kinematics_pose(s, axis_m, pose);
    int code = RTHYB_OK;
    for (int i = 0; i < n; i++)
        s->axis_m[i] = accept(axis_m[i], RTHYB_DISPLACEMENT_MAX_M, s->axis_m[i], &code);
    for (int j = 0; j < n; j++)
        at[j] = s->pose[j];
    if (code == RTHYB_OK && !search(s, at)) {
        for (int j = 0; j < n; j++)
            at[j] = 0.0;
        code = search(s, at) ? RTHYB_OK : RTHYB_S_OUT_OF_RANGE;
    }
    for (int j = 0; j < n; j++)
        pose[j] = s->pose[j] = code == RTHYB_OK ? at[j] : 0.0;
    return code;
}

int rthyb_kinematics_pose(rthyb_kinematics *s, const double *axis_m, double *pose)
{
    int code = RTHYB_OK;
    const int n = s->cfg.size, m = s->cfg.directions;
    for (int i = 0; i < n; i++)
        s->axis_m[i] = accept(axis_m[i], RTHYB_DISPLACEMENT_MAX_M, s->axis_m[i], &code);
    if (s->cfg.kind == RTHYB_KINEMATICS_MATRIX)
        multiply(s->inverse, s->axis_m, m, n, s->pose);
    else
        code |= pose_by_newton(s, n);
    for (int j = 0; j < m; j++)
        pose[j] = s->pose[j];
    return code;
}

int rthyb_kinematics_forces(rthyb_kinematics *s, const double *axis_n, double *force)
{
    int code = RTHYB_OK;
    const int n = s->cfg.size, m = s->cfg.directions;
    double jacobian[RTHYB_COUPLED_SQUARE] = {0.0};
    for (int i = 0; i < n; i++)
        s->axis_n[i] = accept(axis_n[i], RTHYB_FORCE_MAX_N, s->axis_n[i], &code);
    if (by_own_cells(&s->cfg)) {
        multiply(s->cfg.forces, s->axis_n, m, n, force);
        return code;
    }
    rthyb_kinematics_jacobian(s, jacobian);
    for (int j = 0; j < m; j++) {
        force[j] = 0.0;
        for (int i = 0; i < n; i++)
            force[j] += jacobian[i * m + j] * s->axis_n[i];
    }
    return code;
}

int rthyb_kinematics_measured_pose(rthyb_kinematics *s, const double *axis_m, const double *sensor,
                                   double *pose)
{
    int code = RTHYB_OK;
    const int n = s->cfg.size, m = s->cfg.directions, p = s->cfg.displacement_sensors;
    double all[ROWS_MAX];
    if (p == 0)
        return rthyb_kinematics_pose(s, axis_m, pose);
    for (int i = 0; i < n; i++)
        all[i] = s->axis_m[i] = accept(axis_m[i], RTHYB_DISPLACEMENT_MAX_M, s->axis_m[i], &code);
    for (int k = 0; k < p; k++)
        all[n + k] = s->sensor[k] =
            accept(sensor[k], RTHYB_DISPLACEMENT_MAX_M, s->sensor[k], &code);
    if (s->cfg.kind == RTHYB_KINEMATICS_MATRIX)
        multiply(s->measure, all, m, n + p, s->pose);
    else
        code |= pose_by_newton(s, n + p);
    for (int j = 0; j < m; j++)
        pose[j] = s->pose[j];
    return code;
}

/* Corrects the forces by the axes' load cells, `force`, by those without an actuator. */
static void correct_forces(const rthyb_kinematics_config *cfg, const double *cell, double *force)
{
    const int m = cfg->size, q = cfg->force_sensors;
    double left[RTHYB_SENSORS_MAX] = {0.0}, more[MOST] = {0.0};
    multiply(cfg->carries, force, q, m, left);
    for (int k = 0; k < q; k++)
        left[k] = cell[k] - left[k];
    multiply(cfg->forces, left, m, q, more);
    for (int j = 0; j < m; j++)
        force[j] += more[j];
}

int rthyb_kinematics_measured_forces(rthyb_kinematics *s, const double *axis_n,
                                     const double *sensor, double *force)
{
    int code = RTHYB_OK;
    const int n = s->cfg.size, m = s->cfg.directions, p = s->cfg.displacement_sensors;
    const int q = s->cfg.force_sensors;
    double all[ROWS_MAX];
    if (q == 0)
        return rthyb_kinematics_forces(s, axis_n, force);
    for (int k = 0; k < q; k++)
        all[n + k] = s->sensor[p + k] =
            accept(sensor[p + k], RTHYB_FORCE_MAX_N, s->sensor[p + k], &code);
    if (s->cfg.kind == RTHYB_KINEMATICS_PINS) {
        code |= rthyb_kinematics_forces(s, axis_n, force);
        correct_forces(&s->cfg, all + n, force);
        return code;
    }
    for (int i = 0; i < n; i++)
        all[i] = s->axis_n[i] = accept(axis_n[i], RTHYB_FORCE_MAX_N, s->axis_n[i], &code);
    multiply(s->cfg.forces, all, m, n + q, force);
    return code;
}

void rthyb_kinematics_readings(const rthyb_kinematics_config *cfg, const double *pose,
                               const double *force, double *sensor)
{
    const int m = rthyb_kinematics_directions(cfg), p = cfg->displacement_sensors;
    multiply(cfg->carries, force, cfg->force_sensors, m, sensor + p);
    if (cfg->kind == RTHYB_KINEMATICS_MATRIX) {
        multiply(cfg->reads, pose, p, m, sensor);
        return;
    }
    const plane at = plane_of(cfg, pose);
    for (int k = 0; k < p; k++) {
        const rod own = rod_of_sensor(cfg, k);
        sensor[k] = reach(cfg, &own, &at, NULL);
    }
}

void rthyb_kinematics_change(const rthyb_kinematics_config *cfg, const double *from,
                             const double *to, const double *force, double *sensor)
{
    double way[MOST] = {0.0}, before[RTHYB_SENSORS_ALL] = {0.0};
    for (int j = 0; j < rthyb_kinematics_directions(cfg); j++)
        way[j] = to[j] - from[j];
    if (cfg->kind == RTHYB_KINEMATICS_MATRIX) {
        rthyb_kinematics_readings(cfg, way, force, sensor);
        return;
    }
    rthyb_kinematics_readings(cfg, from, force, before);
    rthyb_kinematics_readings(cfg, to, force, sensor);
    for (int k = 0; k < cfg->displacement_sensors; k++)
        sensor[k] -= before[k];
}

int rthyb_kinematics_pushes(const rthyb_kinematics *s, const double *force, double *axis_n)
{
    const int n = s->cfg.size;
    double jacobian[RTHYB_COUPLED_SQUARE] = {0.0}, turned[RTHYB_COUPLED_SQUARE] = {0.0};
    if (s->cfg.kind == RTHYB_KINEMATICS_MATRIX &&
        (s->cfg.directions < n || is_given(&s->cfg, RTHYB_GIVEN_FORCES))) {
        multiply(s->pushes, force, n, s->cfg.directions, axis_n);
        return RTHYB_OK;
    }
    rthyb_kinematics_jacobian(s, jacobian);
    const int scaled = s->cfg.kind == RTHYB_KINEMATICS_PINS;
    for (int j = 0; j < n; j++) {
        const double scale = scaled ? s->scale[j] : 1.0;
        axis_n[j] = force[j] / scale;
        for (int i = 0; i < n; i++)
            turned[j * n + i] = jacobian[i * n + j] / scale;
    }
    if (small_solve(turned, axis_n, n, 1, scaled ? PIVOT_MIN : 0.0))
        return RTHYB_OK;
    for (int i = 0; i < n; i++)
        axis_n[i] = 0.0;
    return RTHYB_S_OUT_OF_RANGE;
}

int rthyb_kinematics_axes_run(rthyb_kinematics *s, const double *pose, double *axis_m, size_t n)
{
    int code = RTHYB_OK;
    const size_t width = (size_t)s->cfg.size, directions = (size_t)s->cfg.directions;
    for (size_t i = 0; i < n; i++)
        code |= rthyb_kinematics_axes(s, pose + i * directions, axis_m + i * width);
    return code;
}

int rthyb_kinematics_pose_run(rthyb_kinematics *s, const double *axis_m, double *pose, size_t n)
{
    int code = RTHYB_OK;
    const size_t width = (size_t)s->cfg.size, directions = (size_t)s->cfg.directions;
    for (size_t i = 0; i < n; i++)
        code |= rthyb_kinematics_pose(s, axis_m + i * width, pose + i * directions);
    return code;
}
