/* Readings that differ from what all other sensors of their kind imply.
 *
 * Displacements are y = H q for a pose q, with H = (T, S): the axes, and the sensors without an
 * actuator. For forces the unknowns are the forces p of the axes, in which redundant actuators may
 * also push against each other: H = (1, G T'), because the load cells without an actuator read G r
 * for interface forces r = T' p. The least squares fit to all readings leaves (1 - P) y, where P
 * projects onto the columns of H; what reading k differs by from the fit to all others is
 *   e_k = ((1 - P) y)_k / (1 - P_kk),
 * the leave-one-out residual. If 1 - P_kk is 0, the others imply nothing about it.
 * If reading k alone is off by d, e_k = d, whatever it is; others differ too, but r_k = e_k sqrt(1 -
 * P_kk) is then the largest of all such, by the inequality of Cauchy and Schwarz. So only the
 * reading with the largest r is compared with its limit, and the others that are equal to it: if
 * only one reading is redundant, all are equal, and which one is wrong is not known.
 *
 * With pins, H has the slopes of all lengths at the pose of this tick, and y is what the readings
 * leave at that pose, which is the least squares one: it is (1 - P) y already, and the lengths are
 * exact, so that readings that agree leave nothing at any pose. The load cells of the axes turn
 * with them: T is the Jacobian at the pose. What is filtered is then the normalised residual,
 * because the weights change with the pose, and all residuals are equal if one reading is redundant.
 *
 * Noise of single readings does not count: e_k passes a low-pass filter of the first order. */
#include <string.h>

#include "station.h"

#define SMOOTHED_S (8.0 / 1024.0) /* time constant: 20 Hz, above the motion of a specimen */
/* Smallest 1 - P_kk: of a reading whose weight among the others is below a millionth, rounding
 * would make the result. */
#define IMPLIED_MIN 1e-6
#define EQUAL_SHARE (1.0 - 1e-6) /* normalised residuals above this share of the largest */
#define INDEPENDENT_MIN 1e-9     /* of a column, after those before it are subtracted */

enum { ALL = RTHYB_COMPARED_MAX, MOST = RTHYB_COUPLED_MAX };

/* Replaces the columns of h (rows x columns) by orthonormal ones; a dependent column becomes 0.
 * Twice is enough for orthogonality to rounding. */
static void orthonormal(double h[ALL][MOST], int rows, int columns)
{
    for (int c = 0; c < columns; c++) {
        double size = 0.0, left = 0.0;
        for (int i = 0; i < rows; i++)
            size += h[i][c] * h[i][c];
        for (int k = 0; k < 2 * c; k++) {
            double along = 0.0;
            for (int i = 0; i < rows; i++)
                along += h[i][k % c] * h[i][c];
            for (int i = 0; i < rows; i++)
                h[i][c] -= along * h[i][k % c];
        }
        for (int i = 0; i < rows; i++)
            left += h[i][c] * h[i][c];
        const int kept = left > INDEPENDENT_MIN * INDEPENDENT_MIN * size;
        for (int i = 0; i < rows; i++)
            h[i][c] = kept ? h[i][c] / sqrt(left) : 0.0;
    }
}

/* Weights of the readings in e_k, for orthonormal columns. */
static void weigh(const double q[ALL][MOST], int rows, int columns, double weight[ALL][ALL],
                  double *norm)
{
    for (int k = 0; k < rows; k++) {
        double fit[ALL] = {0.0};
        for (int i = 0; i < rows; i++)
            for (int c = 0; c < columns; c++)
                fit[i] += q[k][c] * q[i][c];
        const double left = 1.0 - fit[k];
        /* Nor can a reading be compared that nothing moves. */
        const int implied = fit[k] > 0.0 && left > IMPLIED_MIN;
        norm[k] = implied ? sqrt(left) : 0.0;
        for (int i = 0; i < rows; i++)
            weight[k][i] = !implied ? 0.0 : (i == k ? 1.0 : -fit[i] / left);
    }
}

/* Slopes of the displacements, rows of m values: of the n axes, and of the sensors without an
 * actuator. */
typedef struct {
    int n, m;
    const double *axes, *sensors;
} slopes;

static void rows_of_pose(const rthyb_kinematics_config *tie, slopes by, double h[ALL][MOST])
{
    const int n = by.n, m = by.m;
    for (int j = 0; j < m; j++) {
        for (int i = 0; i < n; i++)
            h[i][j] = by.axes[i * m + j];
        for (int k = 0; k < tie->displacement_sensors; k++)
            h[n + k][j] = by.sensors[k * m + j];
    }
}

static void rows_of_forces(const rthyb_kinematics_config *tie, slopes by, double h[ALL][MOST])
{
    const int n = by.n, m = by.m;
    for (int c = 0; c < n; c++) {
        for (int i = 0; i < n; i++)
            h[i][c] = i == c ? 1.0 : 0.0;
        for (int k = 0; k < tie->force_sensors; k++) {
            h[n + k][c] = 0.0;
            for (int j = 0; j < m; j++)
                h[n + k][c] += tie->carries[k * m + j] * by.axes[c * m + j];
        }
    }
}

static void weigh_all(rthyb_disagreement *d, const rthyb_kinematics_config *tie, slopes by)
{
    double h[ALL][MOST] = {{0.0}};
    rows_of_pose(tie, by, h);
    orthonormal(h, d->displacements, by.m);
    weigh(h, d->displacements, by.m, d->by_x, d->norm_x);
    rows_of_forces(tie, by, h);
    orthonormal(h, d->forces, by.n);
    weigh(h, d->forces, by.n, d->by_f, d->norm_f);
}

/* At rest, where the displacements are 0. */
static int slopes_at_rest(const rthyb_kinematics_config *tie, double *found)
{
    const double none[RTHYB_SENSORS_ALL] = {0.0};
    double left[ALL] = {0.0};
    rthyb_kinematics rest;
    if (rthyb_kinematics_init(&rest, tie))
        return 0;
    rthyb_kinematics_left(&rest, none, none, found, left);
    return 1;
}

void rthyb_disagreement_init(rthyb_disagreement *d, const rthyb_kinematics_config *tie,
                             double period_s)
{
    double at_rest[RTHYB_MEASURED_MAX] = {0.0};
    const int n = tie->size, m = rthyb_kinematics_directions(tie);
    const int pins = tie->kind == RTHYB_KINEMATICS_PINS;
    *d = (rthyb_disagreement){.share = period_s / (SMOOTHED_S + period_s)};
    if (n < 1 || n > MOST || m > MOST || (pins && !slopes_at_rest(tie, at_rest)))
        return;
    d->displacements = n + tie->displacement_sensors > m ? n + tie->displacement_sensors : 0;
    d->forces = tie->force_sensors > 0 ? n + tie->force_sensors : 0;
    weigh_all(d, tie,
              pins ? (slopes){n, m, at_rest, at_rest + (ptrdiff_t)n * m}
                   : (slopes){n, m, tie->matrix, tie->reads});
}

void differ_begin(rthyb_station *s)
{
    for (int k = 0; k < ALL; k++)
        s->disagreement.x[k] = s->disagreement.f[k] = s->disagreement.peak_x[k] =
            s->disagreement.peak_f[k] = 0.0;
}

int differ_allowance_ok(const rthyb_allowance *a)
{
    return a->share >= 0.0 && a->share <= 1e6 && a->least >= 0.0 && isfinite(a->least);
}

/* left: the readings, or what the fit leaves of them. */
static void smooth(double share, int count, double weight[ALL][ALL], const double *left,
                   const double *reading, double *smoothed, double *peak)
{
    for (int k = 0; k < count; k++) {
        double apart = 0.0;
        for (int i = 0; i < count; i++)
            apart += weight[k][i] * left[i];
        smoothed[k] += share * (apart - smoothed[k]);
        peak[k] = fmax(peak[k], fabs(reading[k] - apart));
    }
}

/* Keeps the normalised residuals, although the weights have changed. */
static void renormalise(int count, const double *before, const double *norm, double *smoothed)
{
    for (int k = 0; k < count; k++)
        smoothed[k] = norm[k] > 0.0 ? smoothed[k] * (before[k] / norm[k]) : 0.0;
}

/* With pins: the weights at the pose of this tick, and what the displacements leave there. */
static void turn(rthyb_station *s, const double *x, double *left)
{
    rthyb_disagreement *d = &s->disagreement;
    const rthyb_kinematics *tie = &s->controller.kinematics;
    const int n = tie->cfg.size, m = tie->cfg.directions;
    double norm_x[ALL], norm_f[ALL], found[RTHYB_MEASURED_MAX] = {0.0};
    memcpy(norm_x, d->norm_x, sizeof norm_x);
    memcpy(norm_f, d->norm_f, sizeof norm_f);
    rthyb_kinematics_left(tie, x, x + n, found, left);
    weigh_all(d, &tie->cfg, (slopes){n, m, found, found + (ptrdiff_t)n * m});
    renormalise(d->displacements, norm_x, d->norm_x, d->x);
    renormalise(d->forces, norm_f, d->norm_f, d->f);
}

/* Readings of this tick, after tare, as the controller has taken them. */
static void follow(rthyb_station *s)
{
    rthyb_disagreement *d = &s->disagreement;
    const rthyb_controller *c = &s->controller;
    const int n = axes_of(s), p = s->cfg.controller.kinematics.displacement_sensors;
    const int compared = d->displacements > 0 || d->forces > 0;
    double x[ALL] = {0.0}, f[ALL] = {0.0}, left[ALL];
    for (int i = 0; i < n; i++) {
        x[i] = c->axis[i].x_m1;
        f[i] = c->axis[i].f1;
    }
    for (int k = 0; k < lones_of(s); k++)
        if (k < p)
            x[n + k] = c->sensor[k];
        else
            f[n + k - p] = c->sensor[k];
    memcpy(left, x, sizeof left);
    if (compared && s->cfg.controller.kinematics.kind == RTHYB_KINEMATICS_PINS)
        turn(s, x, left);
    smooth(d->share, d->displacements, d->by_x, left, x, d->x, d->peak_x);
    smooth(d->share, d->forces, d->by_f, f, f, d->f, d->peak_f);
}

/* Number of a reading of one kind among the sensors without an actuator. */
static int lone_of(const rthyb_station *s, int place, int of_x)
{
    return place - axes_of(s) + (of_x ? 0 : s->cfg.controller.kinematics.displacement_sensors);
}

static const rthyb_watch *watch_at(const rthyb_station *s, int place, int of_x)
{
    const int cause = of_x ? RTHYB_CAUSE_SENSOR_DISAGREES : RTHYB_CAUSE_FORCE_DISAGREES;
    return place < axes_of(s) ? watch_of(s, place, cause)
                              : &s->cfg.lone[lone_of(s, place, of_x)].disagreement;
}

static const rthyb_allowance *allowance_at(const rthyb_station *s, int place, int of_x)
{
    if (place >= axes_of(s))
        return &s->cfg.lone[lone_of(s, place, of_x)].allowance;
    const rthyb_axis_config *own = &s->cfg.axis[place];
    return of_x ? &own->x_allowance : &own->f_allowance;
}

/* The limit of a reading at this time; 0: none. */
static double limit_at(const rthyb_station *s, int place, int of_x)
{
    const rthyb_disagreement *d = &s->disagreement;
    const double *weight = of_x ? d->by_x[place] : d->by_f[place];
    const double *peak = of_x ? d->peak_x : d->peak_f;
    double limit = watch_at(s, place, of_x)->value;
    if (!(limit > 0.0) || !allowance_at(s, place, of_x)->grows)
        return limit;
    for (int i = 0; i < (of_x ? d->displacements : d->forces); i++) {
        const rthyb_allowance *a = allowance_at(s, i, of_x);
        limit += fabs(weight[i]) * fmax(a->share * peak[i], a->least);
    }
    return limit;
}

/* The reading found so far that is beyond its limit by the largest factor, of those with the
 * strongest reaction. */
typedef struct {
    int reaction;
    double factor;
    finding found;
} excess;

static void look_at(const rthyb_station *s, int place, int of_x, double apart, excess *worst)
{
    const int reaction = watch_at(s, place, of_x)->reaction;
    if (reaction == RTHYB_REACT_NONE || reaction < worst->reaction)
        return;
    const double limit = limit_at(s, place, of_x);
    const double factor = limit > 0.0 ? fabs(apart) / limit : 0.0;
    if (!(factor > 1.0) || (reaction == worst->reaction && factor <= worst->factor))
        return;
    *worst = (excess){
        .reaction = reaction,
        .factor = factor,
        .found =
            {
                .cause = of_x ? RTHYB_CAUSE_SENSOR_DISAGREES : RTHYB_CAUSE_FORCE_DISAGREES,
                .value = apart,
                .limit = limit,
                .where = place < axes_of(s) ? of_axis(place) : of_sensor(lone_of(s, place, of_x)),
            },
    };
}

static void look_at_suspects(const rthyb_station *s, int of_x, excess *worst)
{
    const rthyb_disagreement *d = &s->disagreement;
    const double *apart = of_x ? d->x : d->f, *norm = of_x ? d->norm_x : d->norm_f;
    const int count = of_x ? d->displacements : d->forces;
    double most = 0.0;
    for (int k = 0; k < count; k++)
        most = fmax(most, norm[k] * fabs(apart[k]));
    for (int k = 0; k < count; k++)
        if (most > 0.0 && norm[k] * fabs(apart[k]) >= EQUAL_SHARE * most)
            look_at(s, k, of_x, apart[k], worst);
}

/* The reaction, RTHYB_REACT_NONE if no reading is beyond its limit. */
static int worst(const rthyb_station *s, finding *found)
{
    excess most = {.reaction = RTHYB_REACT_NONE, .factor = 1.0};
    look_at_suspects(s, 1, &most);
    look_at_suspects(s, 0, &most);
    if (most.reaction != RTHYB_REACT_NONE)
        *found = most.found;
    return most.reaction;
}

/* Not in IDLE, where the specimen may be mounted or removed; nor while a fault, of which the
 * disagreement may be another sign, already ramps the test out: no command depends on a reading
 * there. */
static int is_compared(const rthyb_station *s)
{
    return s->state != RTHYB_IDLE &&
           !(s->state == RTHYB_RAMP_OUT && s->cause > RTHYB_CAUSE_OPERATOR);
}

int differ_check(rthyb_station *s)
{
    finding found;
    if (!s->tared || s->controller.missing > 0)
        return RTHYB_OK;
    follow(s);
    const int reaction = is_compared(s) ? worst(s, &found) : RTHYB_REACT_NONE;
    return reaction == RTHYB_REACT_NONE ? RTHYB_OK : watch_react(s, found, reaction, RTHYB_OK);
}

int differ_finds(const rthyb_station *s, finding *found)
{
    return s->tared && worst(s, found) >= RTHYB_REACT_HOLD;
}
