/* Random tests of two to four axes, or of one that moves alone, some with sensors without an actuator: operators, kinematics,
 * limits, and troubles of each axis and each sensor separately, checked against the rules that must hold for all of them together.
 *
 *   fuzz_axes ticks COUNT [SEED]     this many ticks, or
 *   fuzz_axes seconds COUNT [SEED]   this many seconds: prints how often each rule was checked and,
 *                                    for a broken one, the seed of the episode; 1 if one was broken
 *   fuzz_axes episode SEED           repeats one episode, up to the tick that breaks a rule
 *
 * Stations, moods and troubles are those of station_world.h; every axis has troubles of its own.
 * What is expected is tracked here: only state, tare, cause and settings are taken from the
 * station. */
#define _GNU_SOURCE

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "internal.h"
#include "numeric.h"
#include "rthyb.h"
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-function"
#pragma GCC diagnostic ignored "-Wunused-variable"
#include "station_world.h"
#pragma GCC diagnostic pop

#define WIRE_M 1e-9 /* step of the wire */
/* Largest movement of a command at rest: the command comes to within 1 um of the end of its path,
 * through which it may be swinging, depending on its law, and is held once it is farther away. The
 * largest movement in 15 million ticks was 2.0 um. */
#define SETTLES_M 5e-6

enum {
    MOST = RTHYB_COUPLED_MAX,
    SENSORS = RTHYB_SENSORS_ALL,
    ROWS = 1 << 14,
    WAY_BACK = 32,
    PARTS = 2,
    SECOND = 1024, /* ticks */
    READINGS = RTHYB_READINGS_ALL
};

enum axes_rule {
    AXES_FINITE,
    AXES_POSITION,
    AXES_DIRECTION,
    AXES_VELOCITY,
    AXES_ACCELERATION,
    AXES_AT_REST,
    AXES_TOGETHER,
    AXES_LATCHED,
    AXES_FRAMES,
    AXES_HELD,
    AXES_NO_NUMBER,
    AXES_MISSING,
    AXES_SURROUNDINGS,
    AXES_CLOCKS,
    AXES_ARMED,
    AXES_FORCE,
    AXES_SENSOR_NO_NUMBER,
    AXES_SENSOR_MISSING,
    AXES_SENSOR_READY,
    AXES_SENSOR_TARE,
    AXES_FROZEN,
    AXES_END_OF_RANGE,
    AXES_DISAGREES,
    AXES_REPLAY,
    AXES_RULES
};

static const char *const AXES_TEXT[AXES_RULES] = {
    [AXES_FINITE] = "commands and rows of every axis are finite",
    [AXES_POSITION] = "no command beyond the position limit of its axis, nor further out",
    [AXES_DIRECTION] = "commands bring no direction beyond its position limit, nor further out",
    [AXES_VELOCITY] = "no step beyond the velocity limit of its axis",
    [AXES_ACCELERATION] = "no change of step beyond the acceleration limit of its axis",
    [AXES_AT_REST] = "commands at rest stand",
    [AXES_TOGETHER] =
        "one state: commands of all axes leave, or of none, and a trip stops all of them",
    [AXES_LATCHED] = "a trip stays, with its cause and its axis, until RESET",
    [AXES_FRAMES] = "a trip sends three times the last commands, then nothing",
    [AXES_HELD] = "HOLD, once it stands, asks every direction to stay where it is",
    [AXES_NO_NUMBER] = "a reading of any axis that is no number: TRIPPED at once, by that axis",
    [AXES_MISSING] = "twenty ticks without a pair of any axis: TRIPPED, by the first to be lost",
    [AXES_SURROUNDINGS] = "a link down or a drive stopped: TRIPPED at once, by that axis",
    [AXES_CLOCKS] = "counts apart for twenty ticks from ARMED on: TRIPPED, by that axis",
    [AXES_ARMED] = "ARM is refused to drives on clocks apart, and before they are compared",
    [AXES_FORCE] = "force of any axis beyond a limit that trips: TRIPPED in that tick",
    [AXES_SENSOR_NO_NUMBER] = "a reading of any sensor that is no number: TRIPPED, by that sensor",
    [AXES_SENSOR_MISSING] =
        "twenty ticks without a usable reading of any sensor: TRIPPED, by the first to be lost",
    [AXES_SENSOR_READY] = "ARM and START are refused while a sensor is at the end of its range",
    [AXES_SENSOR_TARE] = "ZERO ends with tares of all sensors that are within their limits",
    [AXES_FROZEN] = "ZERO is refused after so many equal readings in a row, and not before",
    [AXES_END_OF_RANGE] =
        "lost pairs end a test by the reading that was at the end of its range in most of them",
    [AXES_DISAGREES] = "a reading that differs most from what the others imply, beyond its limit "
                       "that trips: TRIPPED",
    [AXES_REPLAY] = "the rows replay bit for bit",
};

static rule_tally axes_tally[AXES_RULES];

/* ---- a test ------------------------------------------------------------------------------------- */

/* Oscillators in parallel, one per direction: represents any numerical part. */
typedef struct {
    double x[MOST], v[MOST], damping[MOST], per_mass[MOST], share[MOST];
    int32_t n;
} side_by_side;

typedef struct {
    uint64_t seed, tick;
    int over, n, m; /* n axes, m directions */
    dice d;
    scale size;
    rthyb_station_config cfg;
    rthyb_library_config part;
    side_by_side model; /* in its initial state */
    uint64_t state[128], other_state[128];
    rthyb_station station, twin;
    rthyb_codec codec;
    double ag[AG_MAX];
    size_t ag_count;
    operator_mood mood;
    troubles troubles[MOST];
    /* the drives: received commands, as far back as the longest delay */
    double received_m[MOST][WAY_BACK], origin[MOST], k[MOST], bias[MOST], noise_m;
    uint32_t delay[MOST];
    int latched[MOST], tells;
    uint32_t silent[MOST];
    int apart; /* as reported to the station */
    uint32_t apart_left, apart_ticks;
    uint32_t missing[MOST];
    /* sensors without an actuator: their troubles, and the reading at which one began to repeat */
    dice sensor_dice;
    int sensors;
    double sensor_bias[SENSORS], sensor_held[SENSORS];
    trouble sensor_trouble[SENSORS];
    uint32_t sensor_rarity, sensor_missing[SENSORS];
    int sensor_at_end; /* any, in the tick before */
    /* which readings were at the end of their range in each tick of the last second */
    uint32_t ends[SECOND], ends_now;
    double repeated[READINGS]; /* readings of the tare, and how many times in a row */
    int32_t repeats[READINGS];
    /* tracked independently of the station */
    int known;
    double before[MOST], step[MOST], pose[MOST];
    rthyb_kinematics kinematics;
    int posed;
    int anew[MOST]; /* its next command is set to the position of the specimen */
    uint32_t frames, seen;
    int cause, cause_axis;
    size_t rows;
} axes_episode;

static axes_episode one;
static uint64_t packed[ROWS][RTHYB_RECORD_WORDS], again[ROWS][RTHYB_RECORD_WORDS];
static double packed_sensors[ROWS][SENSORS];
static uint64_t all_ticks, tests, trips, held, redundant, with_sensors;
static int shown; /* prints what happens in an episode */

static void axes_must(axes_episode *e, int rule, int holds, double value, double bound)
{
    rule_tally *t = &axes_tally[rule];
    t->met++;
    if (holds)
        return;
    if (t->broken++ == 0) {
        t->seed = e->seed;
        t->tick = e->tick;
        t->value = value;
        t->bound = bound;
    }
    e->over = 1;
}

static int32_t part_init(void *state, const rthyb_part_setup *setup)
{
    (void)setup;
    memcpy(state, &one.model, sizeof one.model);
    return 0;
}

static int32_t part_answer(void *state, double ag_mps2, const double *force_n, double *x_next_m)
{
    side_by_side *s = state;
    for (int j = 0; j < s->n; j++) {
        const double a =
            -s->share[j] * ag_mps2 - force_n[j] * s->per_mass[j] - s->damping[j] * s->v[j];
        s->v[j] += PERIOD_S * a;
        s->x[j] += PERIOD_S * s->v[j];
        x_next_m[j] = s->x[j];
    }
    return 0;
}

/* ---- setting up ----------------------------------------------------------------------------------- */

static void some_pins(dice *d, rthyb_kinematics_config *k)
{
    static const double PIN[3][2] = {{0.267, 0.127}, {0.267, -0.127}, {0.1, -0.2}};
    static const double BASE[3][2] = {{1.6, 0.127}, {1.6, -0.127}, {0.15, -1.4}};
    static const int32_t OF[] = {RTHYB_COORDINATE_X, RTHYB_COORDINATE_THETA, RTHYB_COORDINATE_Y};
    for (int i = 0; i < k->size; i++) {
        k->coordinate[i] = OF[i];
        k->far[i] = one_in(d, 4);
        k->pulls[i] = one_in(d, 2);
        for (int c = 0; c < 2; c++) {
            k->pin_m[i][c] = PIN[i][c];
            k->base_m[i][c] = k->far[i] ? BASE[i][c] - PIN[i][c] : BASE[i][c];
        }
    }
    k->kind = RTHYB_KINEMATICS_PINS;
}

/* Matrices for redundant actuators, and sometimes given ones for the way back: each direction has
 * an axis of its own, which others join. */
static void some_redundant(dice *d, rthyb_kinematics_config *k)
{
    const int n = k->size, m = k->directions = 1 + (int)below(d, (uint32_t)n - 1);
    for (int i = 0; i < n; i++)
        for (int j = 0; j < m; j++)
            k->matrix[i * m + j] = (i % m == j ? 1.0 : 0.0) + between(d, -0.25, 0.25) / m;
    if (one_in(d, 3)) {
        k->given |= RTHYB_GIVEN_FORCES;
        for (int i = 0; i < n; i++)
            for (int j = 0; j < m; j++)
                k->forces[j * n + i] = k->matrix[i * m + j] + between(d, -0.05, 0.05);
    }
    rthyb_kinematics found;
    if (one_in(d, 3) && !rthyb_kinematics_init(&found, k)) {
        k->given |= RTHYB_GIVEN_DISPLACEMENTS;
        memcpy(k->displacements, found.inverse, sizeof found.inverse);
    }
}

static void some_kinematics(dice *d, int n, rthyb_kinematics_config *k)
{
    *k = (rthyb_kinematics_config){.size = one_in(d, 3) ? 0 : n};
    if (k->size == 0)
        return;
    if (n <= 3 && one_in(d, 2)) {
        some_pins(d, k);
        return;
    }
    for (int i = 0; i < n * n; i++)
        k->matrix[i] = (i % (n + 1) == 0 ? 1.0 : 0.0) + between(d, -0.25, 0.25);
}

/* Load cells carry shares C of the specimen's forces; with any weights W for them, (I - W C) B' and W
 * give the forces along the interface, because B' gives them from those of the axes. */
static void some_cells(dice *d, rthyb_kinematics_config *k)
{
    const int n = k->size, m = rthyb_kinematics_directions(k);
    const int q = k->force_sensors, pins = k->kind == RTHYB_KINEMATICS_PINS;
    double weight[MOST][RTHYB_SENSORS_MAX] = {{0.0}}, kept[MOST][MOST] = {{0.0}};
    k->given |= RTHYB_GIVEN_FORCES;
    for (int i = 0; i < q * m; i++)
        k->carries[i] = one_in(d, 4) ? 0.0 : between(d, 0.1, 0.6);
    for (int j = 0; j < m; j++) {
        kept[j][j] = 1.0;
        for (int c = 0; c < q; c++) {
            weight[j][c] = between(d, -0.5, 1.0);
            for (int h = 0; h < m; h++)
                kept[j][h] -= weight[j][c] * k->carries[c * m + h];
        }
    }
    /* With pins, the part of the axes follows from the pose. */
    for (int j = 0; j < m && pins; j++)
        for (int c = 0; c < q; c++)
            k->forces[j * q + c] = weight[j][c];
    for (int j = 0; j < m && !pins; j++)
        for (int i = 0; i < n + q; i++) {
            double sum = i < n ? 0.0 : weight[j][i - n];
            for (int h = 0; h < m && i < n; h++)
                sum += kept[j][h] * k->matrix[i * m + h];
            k->forces[j * (n + q) + i] = sum;
        }
}

/* Wires and lasers at the coupler; some are short, so that their directions change a lot. */
static void some_wires(dice *d, rthyb_kinematics_config *k)
{
    for (int i = 0; i < k->displacement_sensors; i++) {
        const double angle = between(d, -3.0, 3.0), length = some(d, 0.1, 3.0);
        k->sensor_far[i] = one_in(d, 4);
        k->sensor_pulls[i] = one_in(d, 2);
        for (int c = 0; c < 2; c++) {
            const double way = length * (c ? sin(angle) : cos(angle));
            k->sensor_pin_m[i][c] = between(d, -0.3, 0.3);
            k->sensor_base_m[i][c] = k->sensor_far[i] ? way : k->sensor_pin_m[i][c] - way;
        }
    }
}

static void some_sensors(axes_episode *e)
{
    dice *d = &e->sensor_dice;
    rthyb_kinematics_config *k = &e->cfg.controller.kinematics;
    if (k->size == 0 || one_in(d, 2))
        return;
    k->displacement_sensors = (int32_t)below(d, RTHYB_SENSORS_MAX + 1);
    k->force_sensors = (int32_t)below(d, RTHYB_SENSORS_MAX + 1);
    k->given &= k->displacement_sensors > 0 ? ~RTHYB_GIVEN_DISPLACEMENTS : ~0;
    for (int i = 0; i < k->displacement_sensors * rthyb_kinematics_directions(k); i++)
        k->reads[i] = between(d, -1.0, 1.0);
    if (k->kind == RTHYB_KINEMATICS_PINS)
        some_wires(d, k);
    if (k->force_sensors > 0)
        some_cells(d, k);
    e->sensors = k->displacement_sensors + k->force_sensors;
    with_sensors += e->sensors > 0;
    static const uint32_t RARITY[] = {0, 4000, 1500, 500, 150};
    e->sensor_rarity = RARITY[below(d, 5)];
    for (int i = 0; i < e->sensors; i++) {
        const int of_x = i < k->displacement_sensors;
        const double size = of_x ? e->size.peak_m : e->size.k_e_n_per_m * e->size.peak_m;
        rthyb_lone_config *c = &e->cfg.lone[i];
        e->sensor_bias[i] = one_in(d, 3) ? 0.0 : between(d, -0.5, 0.5) * size;
        c->range = one_in(d, 3) ? 0.0 : size * some(d, 1.0, 10.0);
        if (one_in(d, 2))
            c->stuck = some_watch(d, 30.0);
        if (one_in(d, 3))
            c->jump = some_watch(d, 0.2 * size);
        if (of_x && one_in(d, 3))
            c->rest_spread = some(d, 2e-5, 1e-3);
        if (one_in(d, 4))
            c->tare_most = some(d, 0.1, 1.0) * size;
        if (one_in(d, 4))
            c->frozen_ticks = (int32_t)ticks(d, 2.0, 128.0);
    }
    e->cfg.lone_channel = RTHYB_CHANNELS_MAX - 2 * (uint32_t)e->sensors;
    e->cfg.lone_channel_count = 2 * (uint32_t)e->sensors;
}

static void some_axis(dice *d, axes_episode *e, int i)
{
    rthyb_station_config *c = &e->cfg;
    const rthyb_law_config law = some_law(d, &e->size);
    c->controller.axis[i] = c->controller.axis[0];
    c->axis[i] = c->axis[0];
    c->controller.rfc[i] = c->controller.rfc[0];
    c->controller.axis[i].law = law;
    if (c->controller.axis[i].velocity_limit_m_per_s > 0.0)
        c->controller.axis[i].velocity_limit_m_per_s *= some(d, 0.5, 2.0);
    if (c->controller.axis[i].acceleration_limit_m_per_s2 > 0.0)
        c->controller.axis[i].acceleration_limit_m_per_s2 *= some(d, 0.5, 2.0);
    c->axis[i].own_watches = one_in(d, 2);
    if (c->axis[i].own_watches)
        some_watches(d, &e->size, c->axis[i].watch);
    if (one_in(d, 3))
        c->interface[i].force = some_watch(d, 2.0 * e->size.k_e_n_per_m * e->size.peak_m);
    if (one_in(d, 3))
        c->interface[i].position = some_watch(d, 2.0 * e->size.peak_m);
}

/* With dice of its own, so that the rest of an episode stays what it was. */
static void some_frozen(axes_episode *e)
{
    dice d = {e->seed ^ 0x94d049bb133111ebULL};
    for (int i = 0; i < e->n; i++) {
        if (one_in(&d, 6))
            e->cfg.axis[i].x_frozen_ticks = (int32_t)ticks(&d, 2.0, 128.0);
        if (one_in(&d, 6))
            e->cfg.axis[i].f_frozen_ticks = (int32_t)ticks(&d, 2.0, 128.0);
    }
}

static rthyb_allowance some_allowance(dice *d, double size)
{
    rthyb_allowance a = {0};
    if (one_in(d, 2))
        return a;
    a.share = between(d, 0.0, 0.5);
    a.least = between(d, 0.0, 0.05) * size;
    a.grows = one_in(d, 2);
    return a;
}

/* Limits on the disagreement of readings, likewise with dice of its own. */
static void some_disagreements(axes_episode *e)
{
    dice d = {e->seed ^ 0xbf58476d1ce4e5b9ULL};
    const double m = e->size.peak_m, n = e->size.k_e_n_per_m * e->size.peak_m;
    const int p = e->cfg.controller.kinematics.displacement_sensors;
    for (int k = 0; k < e->sensors; k++)
        if (one_in(&d, 2)) {
            e->cfg.lone[k].disagreement = some_watch(&d, 0.3 * (k < p ? m : n));
            e->cfg.lone[k].allowance = some_allowance(&d, k < p ? m : n);
        }
    for (int i = 0; i < e->n; i++) {
        rthyb_axis_config *c = &e->cfg.axis[i];
        c->x_allowance = some_allowance(&d, m);
        c->f_allowance = some_allowance(&d, n);
        if (one_in(&d, 2))
            c->watch[RTHYB_CAUSE_SENSOR_DISAGREES] = some_watch(&d, 0.3 * m);
        if (one_in(&d, 2))
            c->watch[RTHYB_CAUSE_FORCE_DISAGREES] = some_watch(&d, 0.3 * n);
    }
}

static void some_drive(dice *d, axes_episode *e, int i)
{
    e->delay[i] = below(d, WAY_BACK);
    e->origin[i] = one_in(d, 3) ? 0.0 : between(d, -0.04, 0.04);
    e->k[i] = e->size.k_e_n_per_m * some(d, 0.5, 2.0);
    e->bias[i] = between(d, -0.1, 0.1) * e->size.k_e_n_per_m * e->size.peak_m;
    e->troubles[i] = some_troubles(d);
}

static void some_model(dice *d, axes_episode *e)
{
    rthyb_kinematics kinematics;
    double jacobian[RTHYB_COUPLED_SQUARE] = {0.0};
    for (int i = 0; i < e->n; i++)
        jacobian[i * e->n + i] = 1.0; /* without kinematics */
    if (e->cfg.controller.kinematics.size > 0 &&
        !rthyb_kinematics_init(&kinematics, &e->cfg.controller.kinematics))
        rthyb_kinematics_jacobian(&kinematics, jacobian);
    e->model.n = e->m;
    for (int j = 0; j < e->m; j++) {
        double k = 0.0;
        for (int i = 0; i < e->n; i++)
            k += jacobian[i * e->m + j] * jacobian[i * e->m + j] * e->k[i];
        e->model.per_mass[j] = e->size.omega_per_s * e->size.omega_per_s / k;
        e->model.damping[j] = between(d, 0.0, 0.4) * e->size.omega_per_s;
        e->model.share[j] = between(d, -1.0, 1.0);
    }
}

static int set_up_axes(axes_episode *e)
{
    dice *d = &e->d;
    e->size = some_scale(d);
    e->n = 2 + (int)below(d, MOST - 1);
    /* Sometimes one axis moves alone, with the sensors beside it; with dice of its own, so that all
     * other episodes stay what they were. */
    dice alone = {e->seed ^ 0x9e3779b97f4a7c15ULL};
    if (one_in(&alone, 8))
        e->n = 1;
    e->cfg = some_station(d, &e->size);
    e->cfg.controller.motion.integrator = RTHYB_CENTRAL_DIFFERENCE;
    e->cfg.law_channel_count = 0;
    for (int i = 0; i < e->n; i++) {
        some_axis(d, e, i);
        some_drive(d, e, i);
    }
    some_frozen(e);
    rthyb_kinematics_config *k = &e->cfg.controller.kinematics;
    some_kinematics(d, e->n, k);
    if (e->n == 1) {
        *k = (rthyb_kinematics_config){.size = 1, .matrix = {1.0}};
        e->cfg.interface[0] = (rthyb_interface_config){0}; /* the limits of the axis apply */
    }
    /* With dice of its own, so that episodes without redundant actuators stay what they were. */
    dice own = {e->seed ^ 0x5deece66dULL};
    if (k->size > 1 && k->kind == RTHYB_KINEMATICS_MATRIX && one_in(&own, 2))
        some_redundant(&own, k);
    e->sensor_dice.state = e->seed ^ 0x2545f4914f6cdd1dULL;
    some_sensors(e);
    some_disagreements(e);
    e->m = k->size > 0 ? rthyb_kinematics_directions(k) : e->n;
    e->cfg.controller.axis_count = e->n;
    e->cfg.controller.interface_count = e->m;
    redundant += e->m < e->n;
    some_model(d, e);
    if (e->cfg.controller.kinematics.size > 0 &&
        rthyb_kinematics_init(&e->kinematics, &e->cfg.controller.kinematics))
        return 1;
    e->noise_m = one_in(d, 3) ? 0.0 : some(d, 1e-7, 1e-5);
    e->tells = !one_in(d, 4);
    e->mood = some_mood(d);
    e->codec = (rthyb_codec){.format = one_in(d, 2) ? RTHYB_WIRE_CAN : RTHYB_WIRE_SERIAL};
    e->part = (rthyb_library_config){.calls = {.init = part_init, .answer = part_answer},
                                     .setup = {.period_s = PERIOD_S},
                                     .state_bytes = sizeof(side_by_side),
                                     .interfaces = e->m};
    for (int j = 0; j < e->m; j++)
        e->part.place[j] = j;
    e->cfg.controller.numerical = (rthyb_numerical){RTHYB_NUMERICAL_LIBRARY, &e->part, e->state};
    e->ag_count = (size_t)ticks(d, 32.0, AG_MAX);
    const double size = 0.4 * e->size.peak_m * e->size.omega_per_s * e->size.omega_per_s;
    for (size_t k = 0; k < e->ag_count; k++)
        e->ag[k] = size * sin(3.14159265 * (double)k / (double)e->ag_count) *
                   sin(e->size.omega_per_s * PERIOD_S * (double)k);
    return rthyb_numerical_size(&e->cfg.controller.numerical) > sizeof e->state ||
           rthyb_station_init(&e->station, &e->cfg);
}

/* ---- the drives ------------------------------------------------------------------------------------ */

static void read_axes(axes_episode *e, rthyb_station_input *in)
{
    for (int i = 0; i < e->n; i++) {
        const double x = e->received_m[i][(e->tick - e->delay[i]) % WAY_BACK];
        in->axis[i].x_m = x + e->origin[i] + between(&e->d, -1.0, 1.0) * e->noise_m;
        in->axis[i].f_n = e->k[i] * x + e->bias[i];
        in->axis[i].drive_stopped = e->tells && e->latched[i];
    }
}

/* The same with pins: exact lengths; forces by the slopes at rest. */
static void read_at_coupler(axes_episode *e, double *sensor)
{
    double x[MOST] = {0.0}, pose[MOST] = {0.0}, force[MOST] = {0.0}, jacobian[MOST * MOST];
    rthyb_kinematics rest = e->kinematics;
    memset(rest.pose, 0, sizeof rest.pose);
    rthyb_kinematics_jacobian(&rest, jacobian);
    for (int i = 0; i < e->n; i++) {
        x[i] = e->received_m[i][(e->tick - e->delay[i]) % WAY_BACK];
        for (int j = 0; j < e->m; j++)
            force[j] += jacobian[i * e->m + j] * e->k[i] * x[i];
    }
    (void)rthyb_kinematics_find(&e->kinematics, x, pose);
    rthyb_kinematics_readings(&e->cfg.controller.kinematics, pose, force, sensor);
}

/* What the sensors without an actuator read: pose and forces of a specimen that the axes hold. */
static void read_sensors(axes_episode *e, rthyb_station_input *in)
{
    const rthyb_kinematics_config *k = &e->cfg.controller.kinematics;
    double at_coupler[RTHYB_SENSORS_ALL] = {0.0};
    const int pins = k->kind == RTHYB_KINEMATICS_PINS;
    if (pins && e->sensors > 0)
        read_at_coupler(e, at_coupler);
    for (int s = 0; s < e->sensors; s++) {
        const int p = k->displacement_sensors, of_x = s < p;
        double sum = pins ? at_coupler[s] : 0.0;
        for (int j = 0; j < e->m && !pins; j++) {
            double along = 0.0;
            for (int i = 0; i < e->n; i++) {
                const double x = e->received_m[i][(e->tick - e->delay[i]) % WAY_BACK];
                along += of_x ? e->kinematics.inverse[j * e->n + i] * x
                              : k->matrix[i * e->m + j] * e->k[i] * x;
            }
            sum += along * (of_x ? k->reads[s * e->m + j] : k->carries[(s - p) * e->m + j]);
        }
        const double noise = of_x ? e->noise_m : e->noise_m * e->size.k_e_n_per_m;
        in->sensor[s] = sum + e->sensor_bias[s] + between(&e->sensor_dice, -1.0, 1.0) * noise;
    }
}

static void suffer_sensor(axes_episode *e, int s, rthyb_station_input *in)
{
    dice *d = &e->sensor_dice;
    trouble *t = &e->sensor_trouble[s];
    const int of_x = s < e->cfg.controller.kinematics.displacement_sensors;
    const double size = of_x ? e->size.peak_m : e->size.k_e_n_per_m * e->size.peak_m;
    const double range = e->cfg.lone[s].range;
    if (t->age++ == 0)
        e->sensor_held[s] = in->sensor[s];
    t->left--;
    switch (t->kind) {
    case TROUBLE_LOST:
        in->sensors_lost |= 1u << s;
        break;
    case TROUBLE_SPARSE:
        in->sensors_lost |= one_in(d, 19) ? 0u : 1u << s;
        break;
    case TROUBLE_STUCK_X:
        in->sensor[s] = e->sensor_held[s];
        break;
    case TROUBLE_JUMP:
        in->sensor[s] += t->size * size;
        break;
    case TROUBLE_NOT_FINITE:
        in->sensor[s] = no_number(d);
        break;
    case TROUBLE_SENSELESS:
        in->sensor[s] = copysign(one_in(d, 2) ? 1e300 : 1e13, t->size);
        break;
    case TROUBLE_OUT_OF_RANGE: /* some of them again and again, but never for long */
        if (range > 0.0 && (t->size < 0.0 || t->age % 20 < 15))
            in->sensor[s] = copysign(range, t->size);
        break;
    default:
        in->sensor[s] += t->size * size * (double)t->age / 300.0;
        break;
    }
}

/* Each sensor has troubles of its own. */
static void suffer_sensors(axes_episode *e, rthyb_station_input *in)
{
    static const struct {
        int32_t kind;
        double longest;
    } SOME[] = {{TROUBLE_LOST, 40.0},         {TROUBLE_SPARSE, 3000.0},  {TROUBLE_STUCK_X, 400.0},
                {TROUBLE_JUMP, 30.0},         {TROUBLE_NOT_FINITE, 2.0}, {TROUBLE_SENSELESS, 25.0},
                {TROUBLE_OUT_OF_RANGE, 30.0}, {TROUBLE_DRIFT, 1000.0}};
    dice *d = &e->sensor_dice;
    for (int s = 0; s < e->sensors; s++) {
        trouble *t = &e->sensor_trouble[s];
        if (t->left == 0 && e->sensor_rarity && one_in(d, e->sensor_rarity)) {
            const uint32_t which = below(d, sizeof SOME / sizeof *SOME);
            *t = (trouble){.kind = SOME[which].kind, .size = between(d, -1.0, 1.0)};
            t->left = (uint32_t)ticks(d, 1.0, SOME[which].longest) + 1;
            t->left *= t->kind == TROUBLE_OUT_OF_RANGE && t->size >= 0.0 ? 20 : 1;
        }
        if (t->left > 0)
            suffer_sensor(e, s, in);
    }
}

/* Each axis has troubles of its own; those of the PC may come from any of them. */
static void suffer_axes(axes_episode *e, rthyb_station_input *in, int *unsent)
{
    for (int i = 0; i < e->n; i++) {
        surroundings around = {.in = {.skipped = in->skipped}};
        rthyb_station_config as_one = {.axis = {e->cfg.axis[i]}};
        around.in.axis[0] = in->axis[i];
        suffer_all(&e->d, &e->troubles[i], &e->size, &as_one, &around);
        in->axis[i] = around.in.axis[0];
        in->skipped = around.in.skipped;
        in->heartbeat_late |= around.in.heartbeat_late;
        *unsent |= around.unsent << i;
    }
    if (e->apart_left > 0)
        e->apart_left--;
    else if (one_in(&e->d, 600)) {
        e->apart_left = 1 + below(&e->d, 45);
        e->apart = one_in(&e->d, 4) ? RTHYB_APART_UNKNOWN : 1 + (int)below(&e->d, (uint32_t)e->n);
    } else
        e->apart = 0;
    in->apart = e->n > 1 ? e->apart : 0;
}

/* Sends over the wire; bits of the axes whose command was sent. */
static uint32_t send_axes(axes_episode *e, const rthyb_station_output *out, int unsent)
{
    static const rthyb_calibration AS_IT_IS = {1.0, 0.0, 1.0, 0.0, 1.0, 0.0};
    uint32_t sent = 0;
    for (int i = 0; i < e->n && out->send; i++) {
        rthyb_frame frame;
        double wire_m = 0.0;
        const rthyb_setpoint setpoint = {
            .x_m = command_for_wire(&e->codec, &AS_IT_IS, &out->axis[i]),
            .state = (uint32_t)out->sent_state,
        };
        const int code = rthyb_encode_setpoint(&e->codec, &setpoint, &frame, &wire_m);
        const int left = !(unsent >> i & 1) && !(code & RTHYB_S_NOT_FINITE);
        note_command(&e->station, i, &AS_IT_IS, left, wire_m);
        sent |= (uint32_t)left << i;
    }
    return sent;
}

static void drive_axes(axes_episode *e, const rthyb_station_output *out, const double *x,
                       uint32_t sent)
{
    for (int i = 0; i < e->n; i++) {
        const int received = (int)(sent >> i & 1u);
        const double last = e->received_m[i][e->tick % WAY_BACK];
        e->silent[i] = received ? 0 : e->silent[i] + 1;
        if (received && (out->sent_state == RTHYB_NOTICE_RESET))
            e->latched[i] = 0;
        if (out->state == RTHYB_TRIPPED || e->silent[i] >= RTHYB_DRIVE_WATCHDOG)
            e->latched[i] = e->seen > 0;
        e->received_m[i][(e->tick + 1) % WAY_BACK] =
            received && !e->latched[i] ? x[i] - e->origin[i] : last;
    }
}

/* ---- what is expected --------------------------------------------------------------------------- */

static const rthyb_watch *axis_watch(const axes_episode *e, int i, int cause)
{
    return e->cfg.axis[i].own_watches ? &e->cfg.axis[i].watch[cause] : &e->cfg.watch[cause];
}

static double axis_ending(const axes_episode *e, int i, int cause)
{
    const rthyb_watch *w = axis_watch(e, i, cause);
    return w->reaction >= RTHYB_REACT_HOLD && w->value > 0.0 ? w->value : INFINITY;
}

static void judge_step(axes_episode *e, int i, double x, int at_direction)
{
    const rthyb_axis_control *c = &e->cfg.controller.axis[i];
    const rthyb_station *s = &e->station;
    const double step = x - e->before[i], fine = 2.0 * WIRE_M + 1e-9 * fabs(x);
    const double own = axis_ending(e, i, RTHYB_CAUSE_POSITION);
    const double rig = axis_ending(e, i, RTHYB_CAUSE_RIG_POSITION), zero = s->axis[i].tare_cmd;
    const double low = fmax(zero - own, -rig), high = fmin(zero + own, rig);
    if (low < high)
        axes_must(e, AXES_POSITION,
                  x <= fmax(high, e->before[i]) + fine && x >= fmin(low, e->before[i]) - fine, x,
                  x > high ? high : low);
    if (c->velocity_limit_m_per_s > 0.0)
        axes_must(e, AXES_VELOCITY,
                  fabs(step) <= c->velocity_limit_m_per_s * PERIOD_S * (1.0 + 1e-9) + fine, step,
                  c->velocity_limit_m_per_s * PERIOD_S);
    const double most = c->acceleration_limit_m_per_s2 * PERIOD_S * PERIOD_S;
    const int at_the_end = x >= high - 2.0 * fine || x <= low + 2.0 * fine;
    if (most > 0.0 && !at_the_end && !at_direction)
        axes_must(e, AXES_ACCELERATION, fabs(step - e->step[i]) <= most * (1.0 + 1e-9) + 2.0 * fine,
                  step - e->step[i], most);
}

/* Whether the commands are set to the position of the specimen, which does not count as a step. */
static int puts_anew(const axes_episode *e, const rthyb_station_input *in, int refused, int was)
{
    int stopped = 0;
    for (int i = 0; i < e->n; i++)
        stopped |= in->axis[i].drive_stopped;
    return !e->known || (in->command == RTHYB_CMD_RESET && !refused) ||
           (was == RTHYB_IDLE && e->station.state == RTHYB_IDLE && stopped);
}

/* Pose that corresponds to the commands, from a separate kinematics. Bits of the directions at
 * their limits. */
static uint32_t judge_directions(axes_episode *e, const double *x)
{
    double axis[MOST], pose[MOST];
    uint32_t at = 0;
    for (int i = 0; i < e->n; i++)
        pose[i] = axis[i] = x[i] - e->station.axis[i].tare_cmd;
    if (e->cfg.controller.kinematics.size > 0 &&
        rthyb_kinematics_find(&e->kinematics, axis, pose) != RTHYB_OK)
        return 0;
    for (int j = 0; j < e->m; j++) {
        const rthyb_watch *w = &e->cfg.interface[j].position;
        const double limit =
            w->reaction >= RTHYB_REACT_HOLD && w->value > 0.0 ? w->value : INFINITY;
        const double fine = 2e-8 + 1e-6 * fabs(pose[j]);
        if (limit < INFINITY && e->posed && on_its_way(e->station.state))
            axes_must(e, AXES_DIRECTION, fabs(pose[j]) <= fmax(limit, fabs(e->pose[j])) + fine,
                      pose[j], limit);
        at |= (uint32_t)(fabs(pose[j]) >= limit - 1e-5) << j;
        e->pose[j] = pose[j];
    }
    e->posed = 1;
    return at;
}

/* x: commands of the drives; sent: bits of those received in this tick. */
static void judge_commands(axes_episode *e, const rthyb_station_input *in,
                           const rthyb_station_output *out, const double *x, uint32_t sent, int was)
{
    const int anew = puts_anew(e, in, out->refused, was);
    e->posed = e->posed && !anew;
    const int at_direction = judge_directions(e, x) != 0;
    const int rests = !on_its_way(was) && !on_its_way(out->state);
    for (int i = 0; i < e->n; i++) {
        const double step = x[i] - e->before[i];
        e->anew[i] = anew || e->anew[i];
        if (!(sent >> i & 1u))
            continue;
        if (e->anew[i])
            e->step[i] = 0.0;
        else if (out->state == RTHYB_TRIPPED)
            axes_must(e, AXES_TOGETHER, fabs(step) <= WIRE_M + 1e-9 * fabs(x[i]), step, 0.0);
        else if (rests)
            axes_must(e, AXES_AT_REST, fabs(step) <= SETTLES_M, step, SETTLES_M);
        else
            judge_step(e, i, x[i], at_direction);
        e->step[i] = e->anew[i] || out->state == RTHYB_TRIPPED ? 0.0 : step;
        e->before[i] = x[i];
        e->anew[i] = 0;
    }
    e->known = 1;
}

static void judge_trip(axes_episode *e, const rthyb_station_input *in,
                       const rthyb_station_output *out, int was)
{
    const rthyb_station *s = &e->station;
    const int reset = in->command == RTHYB_CMD_RESET && !out->refused;
    if (was == RTHYB_TRIPPED && !reset)
        axes_must(e, AXES_LATCHED,
                  s->state == RTHYB_TRIPPED && s->cause == e->cause &&
                      s->cause_axis == e->cause_axis,
                  s->cause, e->cause);
    if (s->state == RTHYB_TRIPPED && (was != RTHYB_TRIPPED || reset))
        e->frames = 3;
    if (s->state == RTHYB_TRIPPED && e->seen)
        axes_must(e, AXES_FRAMES, out->send == (e->frames > 0), out->send, e->frames);
    e->frames -= e->frames > 0;
    e->cause = s->cause;
    e->cause_axis = s->cause_axis;
}

/* Must be TRIPPED; if nothing had interrupted the test before, by that axis. */
static void trips_by(axes_episode *e, int rule, int was, int clean, int axis)
{
    const rthyb_station *s = &e->station;
    if (shown && was != RTHYB_TRIPPED && (s->state != RTHYB_TRIPPED || s->cause_axis != axis))
        printf("tick %" PRIu64 ": state %d after %d, cause %d of axis %d, not of %d\n", e->tick,
               s->state, was, s->cause, s->cause_axis, axis);
    axes_must(e, rule, s->state == RTHYB_TRIPPED, s->state, axis);
    if (was != RTHYB_TRIPPED && clean)
        axes_must(e, rule, s->cause_axis == axis, s->cause_axis, axis);
}

typedef struct {
    int no_number, missing, down, stopped, force; /* 1 + axis */
    int sensor_no_number, sensor_missing;         /* 1 + sensor */
    int sensor_at_end;                            /* any */
} found_faults;

static int trips_at(const rthyb_watch *watch)
{
    return watch->reaction == RTHYB_REACT_TRIP && watch->value > 0.0;
}

/* Bit of a reading as in RTHYB_READINGS_ALL. */
static void look_at_ends(axes_episode *e, const rthyb_station_input *in)
{
    e->ends_now = 0;
    for (int i = 0; i < e->n; i++) {
        const rthyb_axis_input *a = &in->axis[i];
        const rthyb_axis_config *c = &e->cfg.axis[i];
        const int whole = !a->lost && in_range(a->x_m, 0.0, RTHYB_DISPLACEMENT_MAX_M) &&
                          in_range(a->f_n, 0.0, RTHYB_FORCE_MAX_N);
        e->ends_now |= (uint32_t)(whole && c->x_range_m > 0.0 && fabs(a->x_m) >= c->x_range_m)
                       << (2 * i);
        e->ends_now |= (uint32_t)(whole && c->f_range_n > 0.0 && fabs(a->f_n) >= c->f_range_n)
                       << (2 * i + 1);
    }
    for (int k = 0; k < e->sensors; k++)
        e->ends_now |=
            (uint32_t)(!(in->sensors_lost >> k & 1u) && isfinite(in->sensor[k]) &&
                       e->cfg.lone[k].range > 0.0 && fabs(in->sensor[k]) >= e->cfg.lone[k].range)
            << (2 * e->n + k);
}

/* Number of a reading as in RTHYB_READINGS_ALL: the reading, and how many equal ones in a row end a
 * tare. */
static double reading_of(const axes_episode *e, const rthyb_station_input *in, int k, int32_t *most)
{
    const int lone = k - 2 * e->n, of_f = k % 2;
    if (lone >= 0) {
        *most = e->cfg.lone[lone].frozen_ticks;
        return in->sensor[lone];
    }
    const rthyb_axis_config *c = &e->cfg.axis[k / 2];
    *most = of_f ? c->f_frozen_ticks : c->x_frozen_ticks;
    return of_f ? in->axis[k / 2].f_n : in->axis[k / 2].x_m;
}

/* zeroing, readings: of the station before the tick. */
static void judge_frozen(axes_episode *e, const rthyb_station_input *in, int refused, int zeroing,
                         int readings)
{
    const rthyb_station *s = &e->station;
    const int begun = in->command == RTHYB_CMD_ZERO && !refused;
    const int now = begun || zeroing == 1, before = begun ? 0 : readings;
    int frozen = 0;
    if (begun)
        memset(e->repeats, 0, sizeof e->repeats);
    if (!now || (s->tare_readings == before && s->zeroing != 6))
        return; /* this tick did not count */
    for (int k = 0; k < 2 * e->n + e->sensors; k++) {
        int32_t most = 0;
        const double reading = reading_of(e, in, k, &most);
        e->repeats[k] = reading == e->repeated[k] && e->repeats[k] > 0 ? e->repeats[k] + 1 : 1;
        e->repeated[k] = reading;
        frozen = frozen || (most > 0 && e->repeats[k] >= most);
    }
    axes_must(e, AXES_FROZEN, frozen == (s->zeroing == 6), s->zeroing, frozen);
    axes_must(e, AXES_FROZEN, !(frozen && s->state == RTHYB_ZEROED), s->state, frozen);
}

static uint32_t count_of_ends(const axes_episode *e, int reading)
{
    uint32_t count = 0;
    for (int t = 0; t < SECOND; t++)
        count += e->ends[t] >> reading & 1u;
    return count;
}

static const rthyb_watch *watch_on_difference(const axes_episode *e, int place, int of_x)
{
    const int p = e->cfg.controller.kinematics.displacement_sensors;
    if (place < e->n)
        return axis_watch(e, place,
                          of_x ? RTHYB_CAUSE_SENSOR_DISAGREES : RTHYB_CAUSE_FORCE_DISAGREES);
    return &e->cfg.lone[place - e->n + (of_x ? 0 : p)].disagreement;
}

/* What one kind of reading is compared with, from the smoothed differences of the station, which are
 * those of an independent calculation in tests/test_disagreement.py. */
static void judge_differences(axes_episode *e, int of_x, int was)
{
    const rthyb_station *s = &e->station;
    const rthyb_disagreement *d = &s->disagreement;
    const int count = of_x ? d->displacements : d->forces;
    const double *apart = of_x ? d->x : d->f, *norm = of_x ? d->norm_x : d->norm_f;
    int most = 0;
    for (int k = 0; k < count; k++) {
        axes_must(e, AXES_FINITE, isfinite(apart[k]), apart[k], k);
        most = norm[k] * fabs(apart[k]) > norm[most] * fabs(apart[most]) ? k : most;
    }
    if (count == 0)
        return;
    const rthyb_watch *w = watch_on_difference(e, most, of_x);
    double limit = w->value;
    const int p = e->cfg.controller.kinematics.displacement_sensors;
    for (int i = 0; i < count; i++) {
        const rthyb_axis_config *c = &e->cfg.axis[i < e->n ? i : 0];
        const rthyb_allowance *of_axis = of_x ? &c->x_allowance : &c->f_allowance;
        const rthyb_allowance *a =
            i < e->n ? of_axis : &e->cfg.lone[i - e->n + (of_x ? 0 : p)].allowance;
        const rthyb_axis_config *mine = &e->cfg.axis[most < e->n ? most : 0];
        const int grows = most >= e->n ? e->cfg.lone[most - e->n + (of_x ? 0 : p)].allowance.grows
                                       : (of_x ? mine->x_allowance.grows : mine->f_allowance.grows);
        const double weight = of_x ? d->by_x[most][i] : d->by_f[most][i];
        if (grows)
            limit += fabs(weight) * fmax(a->share * (of_x ? d->peak_x[i] : d->peak_f[i]), a->least);
    }
    const int beyond = trips_at(w) && fabs(apart[most]) > limit * (1.0 + 1e-12);
    if (beyond && s->tared && on_its_way(was) && s->controller.missing == 0)
        axes_must(e, AXES_DISAGREES,
                  s->state == RTHYB_TRIPPED || s->state == RTHYB_IDLE ||
                      (s->state == RTHYB_RAMP_OUT && s->cause > RTHYB_CAUSE_OPERATOR),
                  s->state, most);
}

/* A cause that names a disagreement has a value beyond its limit, of a reading that has one. */
static void judge_disagreement(axes_episode *e, int was, int cause)
{
    const rthyb_station *s = &e->station;
    const int of_x = s->cause == RTHYB_CAUSE_SENSOR_DISAGREES;
    const int p = e->cfg.controller.kinematics.displacement_sensors;
    judge_differences(e, 1, was);
    judge_differences(e, 0, was);
    if (s->cause == cause || !(of_x || s->cause == RTHYB_CAUSE_FORCE_DISAGREES))
        return;
    const int place =
        s->cause_sensor >= 0 ? e->n + s->cause_sensor - (of_x ? 0 : p) : s->cause_axis;
    axes_must(e, AXES_DISAGREES,
              fabs(s->cause_value) > s->cause_limit && s->cause_limit > 0.0 &&
                  watch_on_difference(e, place, of_x)->reaction >= RTHYB_REACT_HOLD,
              s->cause_value, s->cause_limit);
}

/* Called after a tick; its own readings count from the next one on. losses: ticks of the second
 * before it that lack a pair. */
static void judge_ends(axes_episode *e, const rthyb_station_input *in, int started, int cause)
{
    const rthyb_station *s = &e->station;
    const int of_range =
        s->cause == RTHYB_CAUSE_SENSOR_RANGE || s->cause == RTHYB_CAUSE_FORCE_RANGE;
    const uint32_t losses = s->losses.count;
    uint32_t most = 0;
    if (started)
        memset(e->ends, 0, sizeof e->ends);
    for (uint32_t t = 0; t <= in->skipped && t < SECOND; t++)
        e->ends[(s->tick - 1 - t) % SECOND] = 0;
    if (s->cause != cause && (of_range || s->cause == RTHYB_CAUSE_LOST_PAIRS)) {
        for (int k = 0; k < 2 * e->n + e->sensors; k++)
            most = count_of_ends(e, k) > most ? count_of_ends(e, k) : most;
        const int named = s->cause_sensor >= 0
                              ? 2 * e->n + s->cause_sensor
                              : 2 * s->cause_axis + (s->cause == RTHYB_CAUSE_FORCE_RANGE);
        /* This tick itself may add one loss, or drop one of a second ago. */
        if (of_range)
            axes_must(e, AXES_END_OF_RANGE,
                      count_of_ends(e, named) == most && 2 * most + 2 > losses, most, losses);
        else
            axes_must(e, AXES_END_OF_RANGE, 2 * most <= losses + 2, most, losses);
    }
    e->ends[(s->tick - 1) % SECOND] = e->ends_now;
}

/* 1 if all sensors have a usable reading. */
static int look_at_sensors(axes_episode *e, const rthyb_station_input *in, uint32_t made_up,
                           found_faults *f)
{
    int all = 1;
    for (int s = e->sensors - 1; s >= 0; s--) {
        const int of_x = s < e->cfg.controller.kinematics.displacement_sensors;
        const int lost = (int)(in->sensors_lost >> s & 1u);
        const double reading = in->sensor[s], range = e->cfg.lone[s].range;
        const double most = of_x ? RTHYB_DISPLACEMENT_MAX_M : RTHYB_FORCE_MAX_N;
        const int sound = !lost && in_range(reading, range, most);
        f->sensor_no_number = !lost && !isfinite(reading) ? s + 1 : f->sensor_no_number;
        f->sensor_at_end |= !lost && !sound && in_range(reading, 0.0, most);
        e->sensor_missing[s] = sound ? 0 : e->sensor_missing[s] + made_up + 1;
        f->sensor_missing = e->sensor_missing[s] >= LOST_TICKS ? s + 1 : f->sensor_missing;
        all = all && sound;
    }
    return all;
}

static found_faults look_at_axes(axes_episode *e, const rthyb_station_input *in, uint32_t made_up)
{
    found_faults f = {0};
    int all = 1;
    for (int i = e->n - 1; i >= 0; i--) {
        const rthyb_axis_input *a = &in->axis[i];
        const int finite = isfinite(a->x_m) && isfinite(a->f_n);
        const rthyb_axis_config *c = &e->cfg.axis[i];
        const int sound = !a->lost && in_range(a->x_m, c->x_range_m, RTHYB_DISPLACEMENT_MAX_M) &&
                          in_range(a->f_n, c->f_range_n, RTHYB_FORCE_MAX_N);
        const rthyb_watch *w = axis_watch(e, i, RTHYB_CAUSE_RIG_FORCE);
        all = all && sound;
        f.no_number = (!a->lost && !finite) || a->lost & RTHYB_S_NOT_FINITE ? i + 1 : f.no_number;
        f.down = a->link_down ? i + 1 : f.down;
        f.stopped = a->drive_stopped ? i + 1 : f.stopped;
        e->missing[i] = sound ? 0 : e->missing[i] + made_up + 1;
        f.missing = e->missing[i] >= LOST_TICKS ? i + 1 : f.missing;
        const rthyb_watch *own = axis_watch(e, i, RTHYB_CAUSE_FORCE);
        const double f_n = a->f_n - e->station.axis[i].tare_f;
        if (sound && ((trips_at(w) && fabs(a->f_n) > w->value) ||
                      (e->station.tared && trips_at(own) && fabs(f_n) > own->value)))
            f.force = i + 1;
    }
    e->seen += all & look_at_sensors(e, in, made_up, &f);
    return f;
}

/* The axis that has been without a valid reading for longest, the first of several. */
static int longest_missing(const axes_episode *e)
{
    int longest = 0;
    for (int i = 1; i < e->n; i++)
        longest = e->missing[i] > e->missing[longest] ? i : longest;
    return longest;
}

/* A valid reading that jumps is rejected too; jumps are not tracked here. */
static int may_leap(const axes_episode *e, int axis)
{
    return axis >= 0 && (axis_watch(e, axis, RTHYB_CAUSE_SENSOR_JUMP)->value > 0.0 ||
                         axis_watch(e, axis, RTHYB_CAUSE_FORCE_JUMP)->value > 0.0);
}

static void judge_faults_of_axes(axes_episode *e, const rthyb_station_input *in, found_faults f,
                                 int was, int cause_before)
{
    const rthyb_station *s = &e->station;
    const int clean = cause_before <= RTHYB_CAUSE_OPERATOR && !in->skipped && !in->heartbeat_late &&
                      in->command == RTHYB_CMD_NONE;
    const int surroundings_fault = f.down || f.stopped;
    if (f.no_number)
        axes_must(e, AXES_NO_NUMBER, s->state == RTHYB_TRIPPED, s->state, f.no_number - 1);
    if (f.no_number && clean && was != RTHYB_TRIPPED && !surroundings_fault &&
        s->cause == RTHYB_CAUSE_NOT_FINITE)
        trips_by(e, AXES_NO_NUMBER, was, 1, f.no_number - 1);
    if (f.missing && s->state != RTHYB_IDLE)
        axes_must(e, AXES_MISSING, s->state == RTHYB_TRIPPED, s->state, f.missing - 1);
    const int trips_now = was != RTHYB_TRIPPED && s->state == RTHYB_TRIPPED && clean;
    if (trips_now && f.missing)
        axes_must(e, AXES_MISSING, s->cause != RTHYB_CAUSE_NO_POSE, s->cause, f.missing - 1);
    if (trips_now && s->cause == RTHYB_CAUSE_LINK_LOST && !may_leap(e, s->cause_axis))
        axes_must(e, AXES_MISSING, s->cause_axis == longest_missing(e), s->cause_axis,
                  longest_missing(e));
    if (surroundings_fault && was != RTHYB_IDLE && s->state != RTHYB_IDLE)
        trips_by(e, AXES_SURROUNDINGS, was,
                 clean && s->cause == (f.down ? RTHYB_CAUSE_LINK_DOWN : RTHYB_CAUSE_DRIVE_STOPPED),
                 (f.down ? f.down : f.stopped) - 1);
    const int counted = in->apart > 0 && in->apart != RTHYB_APART_UNKNOWN;
    e->apart_ticks = counted ? e->apart_ticks + 1 : 0;
    if (e->apart_ticks >= LOST_TICKS && s->state != RTHYB_IDLE && s->state != RTHYB_ZEROED)
        trips_by(e, AXES_CLOCKS, was, clean && s->cause == RTHYB_CAUSE_APART, in->apart - 1);
    if (f.force && on_its_way(was))
        axes_must(e, AXES_FORCE, s->state == RTHYB_TRIPPED || s->state == RTHYB_IDLE, s->state,
                  0.0);
}

/* The sensor that has been without a usable reading for longest, the first of several. */
static int longest_missing_sensor(const axes_episode *e)
{
    int longest = 0;
    for (int s = 1; s < e->sensors; s++)
        longest = e->sensor_missing[s] > e->sensor_missing[longest] ? s : longest;
    return longest;
}

static void judge_sensors(axes_episode *e, const rthyb_station_input *in, found_faults f, int was,
                          int refused)
{
    const rthyb_station *s = &e->station;
    const int trips_now = was != RTHYB_TRIPPED && s->state == RTHYB_TRIPPED;
    if (f.sensor_no_number)
        axes_must(e, AXES_SENSOR_NO_NUMBER, s->state == RTHYB_TRIPPED, s->state,
                  f.sensor_no_number - 1);
    if (trips_now && f.sensor_no_number && s->cause == RTHYB_CAUSE_NOT_FINITE && s->cause_axis < 0)
        axes_must(e, AXES_SENSOR_NO_NUMBER, s->cause_sensor == f.sensor_no_number - 1,
                  s->cause_sensor, f.sensor_no_number - 1);
    if (f.sensor_missing && s->state != RTHYB_IDLE)
        axes_must(e, AXES_SENSOR_MISSING, s->state == RTHYB_TRIPPED, s->state,
                  f.sensor_missing - 1);
    const int longest = longest_missing_sensor(e);
    if (trips_now && s->cause == RTHYB_CAUSE_SENSOR_LOST)
        axes_must(e, AXES_SENSOR_MISSING,
                  e->cfg.lone[longest].jump.value > 0.0 || s->cause_sensor == longest,
                  s->cause_sensor, longest);
    if (e->sensors > 0 && in->command == RTHYB_CMD_ARM && !refused)
        axes_must(e, AXES_SENSOR_READY, !e->sensor_at_end || in->skipped, e->sensor_at_end, 0.0);
    if (e->sensors > 0 && in->command == RTHYB_CMD_START && !refused)
        axes_must(e, AXES_SENSOR_READY, !e->sensor_at_end || in->skipped, e->sensor_at_end, 1.0);
    e->sensor_at_end = f.sensor_at_end;
    for (int k = 0; k < e->sensors; k++) {
        const double tare = s->lone[k].tare, most = e->cfg.lone[k].tare_most;
        if (was == RTHYB_IDLE && s->state == RTHYB_ZEROED)
            axes_must(e, AXES_SENSOR_TARE, isfinite(tare) && (most == 0.0 || fabs(tare) <= most),
                      tare, most);
        axes_must(e, AXES_FINITE, isfinite(s->channel[e->cfg.lone_channel + (uint32_t)k]),
                  s->channel[e->cfg.lone_channel + (uint32_t)k], k);
    }
}

static void judge_rows_of_axes(axes_episode *e, const rthyb_record *rows, uint32_t count)
{
    for (uint32_t k = 0; k < count; k++)
        for (int i = 0; i < e->n; i++) {
            const rthyb_axis_record *a = &rows[k].axis[i];
            axes_must(e, AXES_FINITE,
                      isfinite(a->x_cmd_m) && isfinite(a->x_meas_m) && isfinite(a->f_meas_n) &&
                          isfinite(rows[k].x_num_m),
                      a->x_cmd_m, i);
        }
}

/* ---- a tick ---------------------------------------------------------------------------------------- */

static void keep_rows(axes_episode *e, const rthyb_station_input *in, const rthyb_record *rows,
                      uint32_t count, uint32_t sent)
{
    for (uint32_t k = 0; k < count && e->rows < ROWS; k++) {
        rthyb_record row = rows[k];
        if (k == count - 1) {
            row.flags &= ~UNSENT_FLAGS;
            for (int i = 0; i < e->n; i++)
                row.flags |= sent >> i & 1u ? 0u : unsent_flag(i, e->n);
        }
        memcpy(&packed_sensors[0][0] + e->rows * (size_t)e->sensors, in->sensor,
               (size_t)e->sensors * sizeof(double));
        memcpy((char *)packed + e->rows++ * record_bytes(e->n), &row, record_bytes(e->n));
    }
}

static void tick_axes(axes_episode *e)
{
    static rthyb_record rows[RTHYB_BLIND_MAX + 1];
    rthyb_station *s = &e->station;
    rthyb_station_input in = {.command = operate(&e->d, &e->mood, s->state)};
    rthyb_station_output out;
    double x[MOST], asked[MOST];
    int unsent = 0;
    read_axes(e, &in);
    suffer_axes(e, &in, &unsent);
    read_sensors(e, &in);
    suffer_sensors(e, &in);
    const int was = s->state, cause = s->cause, leg = s->leg;
    const int zeroing = s->zeroing, readings = s->tare_readings;
    const uint64_t apart = s->apart;
    for (int j = 0; j < e->m; j++)
        asked[j] = s->controller.interface[j].x_num;
    rthyb_station_tick(s, &in, e->ag, e->ag_count, rows, &out);
    const uint32_t sent = send_axes(e, &out, unsent);
    for (int i = 0; i < e->n; i++)
        x[i] = s->controller.axis[i].x_cmd + s->axis[i].tare_cmd;
    const found_faults f = look_at_axes(e, &in, out.records - 1);
    judge_rows_of_axes(e, rows, out.records);
    judge_trip(e, &in, &out, was);
    if (s->seen && out.send)
        judge_commands(e, &in, &out, x, sent, was);
    judge_faults_of_axes(e, &in, f, was, cause);
    judge_sensors(e, &in, f, was, out.refused);
    judge_frozen(e, &in, out.refused, zeroing, readings);
    judge_disagreement(e, was, cause);
    look_at_ends(e, &in);
    judge_ends(e, &in, in.command == RTHYB_CMD_START && !out.refused, cause);
    if (in.command == RTHYB_CMD_ARM && !out.refused)
        axes_must(e, AXES_ARMED, apart < LOST_TICKS && in.apart != RTHYB_APART_UNKNOWN,
                  (double)apart, in.apart);
    for (int j = 0;
         j < e->m && was == RTHYB_HOLD && leg == 1 && s->state == RTHYB_HOLD && s->leg == 1; j++)
        axes_must(e, AXES_HELD, s->controller.interface[j].x_num == asked[j],
                  s->controller.interface[j].x_num, asked[j]);
    held += was == RTHYB_HOLD && leg == 1;
    tests += in.command == RTHYB_CMD_START && !out.refused;
    trips += s->state == RTHYB_TRIPPED && was != RTHYB_TRIPPED;
    keep_rows(e, &in, rows, out.records, sent);
    drive_axes(e, &out, x, sent);
    e->tick++;
    all_ticks += out.records;
}

/* Prints which words of a row differ. */
static void show_difference(const axes_episode *e, size_t at)
{
    const uint64_t *mine = packed[0] + at * record_bytes(e->n) / sizeof(uint64_t);
    const uint64_t *other = again[0] + at * record_bytes(e->n) / sizeof(uint64_t);
    for (size_t i = 0; i < record_bytes(e->n) / sizeof(uint64_t); i++) {
        double a, b;
        memcpy(&a, &mine[i], sizeof a);
        memcpy(&b, &other[i], sizeof b);
        if (mine[i] != other[i])
            printf("row %zu, word %zu: %016" PRIx64 " %016" PRIx64 " (%.17g %.17g)\n", at, i,
                   mine[i], other[i], a, b);
    }
}

static void judge_axes_replay(axes_episode *e)
{
    rthyb_replay source = {
        .rows = packed,
        .count = e->rows,
        .ag_mps2 = e->ag,
        .ag_count = e->ag_count,
        .sensors = packed_sensors[0],
    };
    for (int i = 0; i < e->n; i++)
        source.axis[i] = (rthyb_replay_axis){&e->codec, {1.0, 0.0, 1.0, 0.0, 1.0, 0.0}};
    rthyb_station_config cfg = e->cfg;
    cfg.controller.numerical.state = e->other_state;
    if (rthyb_station_init(&e->twin, &cfg))
        return;
    const size_t made = rthyb_station_replay(&e->twin, &source, again), row = record_bytes(e->n);
    size_t same = 0;
    while (same < made && memcmp((char *)packed + same * row, (char *)again + same * row, row) == 0)
        same++;
    if (shown && same < e->rows)
        show_difference(e, same);
    axes_must(e, AXES_REPLAY, same == e->rows, (double)same, (double)e->rows);
}

static void play_axes(uint64_t seed)
{
    axes_episode *e = &one;
    memset(e, 0, sizeof *e);
    e->seed = seed;
    e->d.state = seed;
    e->cause_axis = -1;
    if (set_up_axes(e))
        return;
    e->tick = WAY_BACK;
    const uint64_t length = (uint64_t)ticks(&e->d, 300.0, 10000.0);
    while (e->tick < length && !e->over && e->rows + RTHYB_BLIND_MAX + 1 < ROWS)
        tick_axes(e);
    if (!e->over)
        judge_axes_replay(e);
}

/* ---- all of them ------------------------------------------------------------------------------------ */

static int report_axes(uint64_t episodes, double seconds)
{
    int broken = 0;
    for (int i = 0; i < AXES_RULES; i++) {
        const rule_tally *t = &axes_tally[i];
        printf("%12" PRIu64 "  %s\n", t->met, AXES_TEXT[i]);
        if (!t->broken)
            continue;
        broken = 1;
        printf("      broken %" PRIu64 " times, at first in episode 0x%" PRIx64 ", tick %" PRIu64
               ": %.9g, bound %.9g\n",
               t->broken, t->seed, t->tick, t->value, t->bound);
    }
    printf("%" PRIu64 " episodes, %" PRIu64 " ticks, %" PRIu64 " tests, %" PRIu64 " trips, %" PRIu64
           " held, %" PRIu64 " with redundant actuators, %" PRIu64
           " with sensors, %.0f ticks/s: %s\n",
           episodes, all_ticks, tests, trips, held, redundant, with_sensors,
           (double)all_ticks / seconds, broken ? "BROKEN" : "nothing broken");
    return broken;
}

static double now_s(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

int main(int argc, char **argv)
{
    const uint64_t count = argc > 2 ? strtoull(argv[2], NULL, 0) : 0;
    dice seeds = {argc > 3 ? strtoull(argv[3], NULL, 0) : 0};
    const double begun = now_s();
    uint64_t episodes = 0;
    if (argc < 3 ||
        (strcmp(argv[1], "ticks") && strcmp(argv[1], "seconds") && strcmp(argv[1], "episode"))) {
        fprintf(stderr, "fuzz_axes: ticks COUNT [SEED], seconds COUNT [SEED], episode SEED\n");
        return 2;
    }
    if (strcmp(argv[1], "episode") == 0) {
        shown = 1;
        play_axes(count);
        return report_axes(1, 1.0);
    }
    const int timed = strcmp(argv[1], "seconds") == 0;
    while (timed ? now_s() - begun < (double)count : all_ticks < count) {
        play_axes(throw_bits(&seeds));
        episodes++;
    }
    return report_axes(episodes, now_s() - begun);
}
