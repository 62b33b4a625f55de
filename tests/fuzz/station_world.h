/* Random stations, rigs, operators and troubles; one seed determines a whole episode. */
#ifndef STATION_WORLD_H
#define STATION_WORLD_H

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "../law_example.h"
#include "../servo_example.h"
#include "rthyb.h"
#include "station_rules.h"

enum { AG_MAX = 4096, TROUBLES = 4 };

/* ---- dice --------------------------------------------------------------------------------------- */

typedef struct {
    uint64_t state;
} dice;

/* splitmix64 */
static uint64_t throw_bits(dice *d)
{
    uint64_t z = d->state += UINT64_C(0x9e3779b97f4a7c15);
    z = (z ^ z >> 30) * UINT64_C(0xbf58476d1ce4e5b9);
    z = (z ^ z >> 27) * UINT64_C(0x94d049bb133111eb);
    return z ^ z >> 31;
}

static uint32_t below(dice *d, uint32_t n)
{
    return (uint32_t)(throw_bits(d) >> 32) % n;
}

static int one_in(dice *d, uint32_t n)
{
    return below(d, n) == 0;
}

static double between(dice *d, double low, double high)
{
    return low + (high - low) * (double)(throw_bits(d) >> 11) * 0x1p-53;
}

/* Equally likely in every decade. */
static double some(dice *d, double low, double high)
{
    return low * exp(between(d, 0.0, log(high / low)));
}

static int32_t ticks(dice *d, double low, double high)
{
    return (int32_t)some(d, low, high);
}

/* ---- the test ----------------------------------------------------------------------------------- */

/* Typical sizes of a test, so that limits and faults are of a meaningful size. */
typedef struct {
    double mass_kg, omega_per_s, k_n_per_m; /* of the structure, including the specimen */
    double k_e_n_per_m;
    double peak_m, delay;
} scale;

typedef struct {
    scale size;
    rthyb_station_config station;
    rthyb_rig_config rig;
    double ag_mps2[AG_MAX];
    size_t ag_count;
    double origin_m; /* position of the specimen before the test */
} world;

static scale some_scale(dice *d)
{
    scale s = {.mass_kg = some(d, 100.0, 20000.0),
               .omega_per_s = 6.2832 / between(d, 0.15, 1.5),
               .peak_m = some(d, 1e-3, 3e-2),
               .delay = one_in(d, 4) ? below(d, 3) : 3.0 + below(d, 20)};
    s.k_n_per_m = s.mass_kg * s.omega_per_s * s.omega_per_s;
    s.k_e_n_per_m = s.k_n_per_m * (one_in(d, 3) ? between(d, 0.1, 0.9) : 1.0);
    return s;
}

/* Phase lead with one of its estimators, usually near the specimen's delay. */
static rthyb_law_config some_lead(dice *d, const scale *s)
{
    static const char *const NAMES[] = {"paper", "paper", "robust", "alpha-beta"};
    static const double GAINS[] = {0.0, 0.03, 2e-3, 0.0};
    const uint32_t which = below(d, 4);
    rthyb_law_config law =
        law_example(NAMES[which], one_in(d, 5) ? between(d, 0.0, 30.0) : s->delay);
    law_set(&law, "delay_estimator.memory_s", some(d, 100.0, 8192.0) * PERIOD_S);
    law_set(&law, "delay_estimator.cutoff_hz", between(d, 5.0, 60.0));
    law.adapts = which != 0;
    law.rest_noise_m = one_in(d, 2) ? 2e-6 : 0.0;
    (void)(which == 3 && one_in(d, 2));
    const double gain = GAINS[which] * some(d, 0.1, 3.0);
    law_set(&law, "delay_estimator.gain_per_mm2_per_sample", gain);
    law_set(&law, "delay_estimator.rate_per_sample", gain);
    if (one_in(d, 5)) {
        const double w1 = some(d, 1.2, 10.0);
        law_set(&law, "w1", w1);
        law_set(&law, "w2", between(d, -0.9, 0.9) * w1);
    }
    return law;
}

/* Any law, with any settings that a test file may contain, usually near its defaults. */
static rthyb_law_config any_law(dice *d, const scale *s)
{
    const int32_t kind = (int32_t)below(d, (uint32_t)rthyb_law_count());
    const rthyb_law_description *is = rthyb_law_describe(kind);
    rthyb_law_config law = law_of_kind(kind, s->delay);
    for (uint32_t i = 0; i < is->parameter_count; i++) {
        const rthyb_law_parameter *p = &is->parameters[i];
        const double now = law.parameters[i];
        const double low = fmax(p->low, 0.3 * now), high = fmin(p->high, 3.0 * now);
        if (one_in(d, 3) && low < high)
            law.parameters[i] = between(d, low, high);
    }
    rthyb_law_complaint complaint;
    if (rthyb_law_check(kind, law.parameters, PERIOD_S, &complaint) >= 0)
        law = law_of_kind(kind, s->delay);
    law.rest_noise_m = one_in(d, 2) ? 2e-6 : 0.0;
    return law;
}

/* Separate dice decide on the rest, so that an additional law does not change anything else. */
static rthyb_law_config some_law(dice *d, const scale *s)
{
    dice own = *d;
    const rthyb_law_config lead = some_lead(d, s);
    (void)throw_bits(&own);
    return one_in(&own, 4) ? any_law(&own, s) : lead;
}

static rthyb_controller_config some_controller(dice *d, const scale *s)
{
    const double v = s->peak_m * s->omega_per_s, a = v * s->omega_per_s;
    /* Thrown one after another, as everywhere. */
    rthyb_controller_config c = {.period_s = PERIOD_S, .axis_count = 1, .interface_count = 1};
    rthyb_axis_control *axis = &c.axis[0];
    c.lead_enabled = !one_in(d, 8);
    axis->law = some_law(d, s);
    c.rfc[0] = (rthyb_rfc_config){.enabled = !one_in(d, 4),
                                  .tangent = (int32_t)below(d, 2),
                                  .divisor = (int32_t)below(d, 2),
                                  .window = ticks(d, 1.0, 200.0),
                                  .k_e_n_per_m = s->k_e_n_per_m,
                                  .end_tick = one_in(d, 4) ? below(d, 4096) : UINT64_MAX,
                                  .rest_noise_m = one_in(d, 2) ? 2e-6 : 0.0};
    c.motion = (rthyb_motion_config){.integrator = (int32_t)below(d, RTHYB_PRESCRIBED + 1),
                                     .period_s = PERIOD_S,
                                     .mass_kg = s->mass_kg,
                                     .added_mass_kg = one_in(d, 6) ? 0.1 * s->mass_kg : 0.0,
                                     .damping_n_s_per_m =
                                         between(d, 0.0, 0.2) * s->mass_kg * s->omega_per_s,
                                     .stiffness_n_per_m = s->k_n_per_m - s->k_e_n_per_m,
                                     .k_e_n_per_m = s->k_e_n_per_m,
                                     .rho_inf = between(d, 0.0, 1.0)};
    axis->x_range_m = one_in(d, 3) ? 0.0 : some(d, 0.05, 0.3);
    axis->f_range_n = one_in(d, 3) ? 0.0 : s->k_e_n_per_m * s->peak_m * some(d, 1.5, 10.0);
    axis->velocity_limit_m_per_s = one_in(d, 4) ? 0.0 : v * some(d, 0.3, 8.0);
    axis->acceleration_limit_m_per_s2 = one_in(d, 3) ? 0.0 : a * some(d, 0.3, 8.0);
    c.estimate_held = one_in(d, 10);
    return c;
}

/* A limit of the size of the motion, sometimes above it, sometimes below. */
static rthyb_watch some_watch(dice *d, double size)
{
    if (one_in(d, 5))
        return (rthyb_watch){0};
    const int32_t reaction = (int32_t)below(d, RTHYB_REACT_TRIP + 1);
    return (rthyb_watch){.value = size * some(d, 0.15, 6.0),
                         .reaction = one_in(d, 3) ? RTHYB_REACT_TRIP : reaction};
}

static void some_watches(dice *d, const scale *s, rthyb_watch w[RTHYB_CAUSE_COUNT])
{
    const double v = s->peak_m * s->omega_per_s, force = s->k_e_n_per_m * s->peak_m;
    w[RTHYB_CAUSE_POSITION] = some_watch(d, 2.0 * s->peak_m);
    w[RTHYB_CAUSE_VELOCITY] = some_watch(d, 4.0 * v);
    w[RTHYB_CAUSE_INCREMENT] = some_watch(d, 4.0 * v * PERIOD_S);
    w[RTHYB_CAUSE_FORCE] = some_watch(d, 1.5 * force);
    w[RTHYB_CAUSE_TRACKING] = some_watch(d, 2.0 * s->peak_m);
    w[RTHYB_CAUSE_INDICATOR] = one_in(d, 3) ? some_watch(d, s->peak_m * v) : (rthyb_watch){0};
    w[RTHYB_CAUSE_ENERGY] = one_in(d, 3) ? some_watch(d, force * s->peak_m) : (rthyb_watch){0};
    if (one_in(d, 2))
        w[RTHYB_CAUSE_SENSOR_STUCK] = w[RTHYB_CAUSE_FORCE_STUCK] = some_watch(d, 30.0);
    if (one_in(d, 2))
        w[RTHYB_CAUSE_SENSOR_JUMP] = some_watch(d, 8.0 * v * PERIOD_S);
    if (one_in(d, 4))
        w[RTHYB_CAUSE_FORCE_JUMP] = some_watch(d, 0.2 * force);
    if (one_in(d, 4))
        w[RTHYB_CAUSE_RIG_POSITION] = some_watch(d, 0.04 + 2.0 * s->peak_m);
    if (one_in(d, 3))
        w[RTHYB_CAUSE_RIG_FORCE] = some_watch(d, 2.0 * force);
    if (one_in(d, 3))
        w[RTHYB_CAUSE_LOST_PAIRS] = some_watch(d, 0.1);
    if (one_in(d, 3))
        w[RTHYB_CAUSE_SKIPS] = some_watch(d, 0.05);
    w[RTHYB_CAUSE_LOST_WARNING] = w[RTHYB_CAUSE_SKIP_WARNING] =
        (rthyb_watch){.value = 0.01, .reaction = RTHYB_REACT_INDICATE};
}

static rthyb_station_config some_station(dice *d, const scale *s)
{
    const double v = s->peak_m * s->omega_per_s, a = v * s->omega_per_s;
    dice own = *d; /* separate, as for laws: what was added later changes nothing else */
    (void)throw_bits(&own);
    (void)throw_bits(&own);
    /* One after another: within an initializer, the order of the throws would be unspecified. */
    rthyb_station_config c = {.controller = some_controller(d, s)};
    c.path_velocity_m_per_s = v * some(d, 0.1, 2.0);
    c.path_acceleration_m_per_s2 = a * some(d, 0.1, 2.0);
    c.axis[0].rest_spread_m = some(d, 2e-5, 1e-3);
    c.tare_ticks = ticks(d, 4.0, 200.0);
    c.ramp_in_ticks = ticks(d, 1.0, 500.0);
    c.armed_ticks = ticks(d, 2.0, 2000.0);
    c.stay = one_in(d, 8);
    if (one_in(d, 4))
        c.axis[0].tare_most_n = some(d, 0.1, 1.0) * s->k_e_n_per_m * s->peak_m;
    if (one_in(d, 4))
        c.axis[0].tare_most_m = some(d, 0.01, 0.1);
    c.axis[0].x_range_m = c.controller.axis[0].x_range_m;
    c.axis[0].f_range_n = c.controller.axis[0].f_range_n;
    some_watches(d, s, c.watch);
    c.controller.rfc[0].period_s = PERIOD_S;
    if (one_in(&own, 2))
        c.controller.rfc[0].cutoff_hz = some(&own, 5.0, 400.0);
    if (one_in(&own, 2))
        c.controller.rfc[0].lateness_s = between(&own, -0.002, 0.002);
    c.law_channel = below(&own, RTHYB_CHANNELS_MAX);
    c.law_channel_count = below(&own, RTHYB_CHANNELS_MAX - c.law_channel + 1);
    return c;
}

/* Parameters as they may change during a test: those in effect, some of them different. */
static rthyb_parameters some_parameters(dice *d, const rthyb_station_config *now, const scale *s)
{
    rthyb_parameters p = {
        .adapt = !now->controller.estimate_held,
        .velocity_limit_m_per_s = now->controller.axis[0].velocity_limit_m_per_s,
        .acceleration_limit_m_per_s2 = now->controller.axis[0].acceleration_limit_m_per_s2,
        .path_velocity_m_per_s = now->path_velocity_m_per_s,
        .path_acceleration_m_per_s2 = now->path_acceleration_m_per_s2,
    };
    memcpy(p.watch, now->watch, sizeof p.watch);
    if (one_in(d, 2))
        p.velocity_limit_m_per_s *= some(d, 0.3, 3.0);
    if (one_in(d, 2))
        p.acceleration_limit_m_per_s2 *= some(d, 0.3, 3.0);
    if (one_in(d, 3))
        p.path_acceleration_m_per_s2 *= some(d, 0.3, 3.0);
    if (one_in(d, 3))
        p.path_velocity_m_per_s *= some(d, 0.3, 3.0);
    if (one_in(d, 3))
        some_watches(d, s, p.watch);
    if (one_in(d, 8))
        p.velocity_limit_m_per_s = 0.0;
    if (one_in(d, 8))
        p.acceleration_limit_m_per_s2 = s->peak_m * s->omega_per_s * s->omega_per_s;
    if (one_in(d, 10))
        p.adapt = !p.adapt;
    if (one_in(d, 50))
        p.path_velocity_m_per_s = -1.0;
    if (one_in(d, 50))
        p.watch[RTHYB_CAUSE_FORCE].value = NAN;
    return p;
}

/* ---- the rig ------------------------------------------------------------------------------------ */

/* A law with its parameters, as many as stand here: the core refuses another number of them. */
typedef struct {
    int32_t kind;
    const double *params;
    size_t n;
} drawn_element;

#define DRAWN(kind, params) {kind, params, sizeof(params) / sizeof(params)[0]}

static void add_element(rthyb_rig_config *rig, drawn_element drawn)
{
    if ((size_t)rthyb_element_param_count(drawn.kind) != drawn.n) {
        fprintf(stderr, "element %d: found %zu parameters, it has %d\n", (int)drawn.kind, drawn.n,
                rthyb_element_param_count(drawn.kind));
        abort();
    }
    if (!rthyb_element_init(&rig->elements[rig->element_count], drawn.kind, drawn.params, drawn.n))
        rig->element_count++;
}

/* A spring or a hysteresis, and possibly another element. */
static void add_specimen(dice *d, const scale *s, rthyb_rig_config *rig)
{
    const double k = s->k_e_n_per_m, x = s->peak_m, f = k * x, v = x * s->omega_per_s;
    const double spring[] = {k}, damper[] = {between(d, 0.0, 0.05) * f / v};
    const double friction[] = {between(d, 0.0, 0.2) * f, 1e-2 * v};
    const double lugre[] = {0.05 * f, 0.08 * f, 0.1 * v, 10.0 * k, 0.1 * f / v, 0.0};
    const double gap[] = {between(d, 0.1, 3.0) * k, x * between(d, 0.1, 1.5)};
    const double stopper[] = {gap[0], gap[1], gap[0] < 1.5 * k ? 0.0 : 0.5 * gap[0] / (k * v)};
    const double cubic[] = {between(d, -0.2, 0.5) * k / (x * x)};
    const double bouc[] = {k, between(d, 0.0, 0.5), 1.0, 0.5 / x, 0.5 / x, 1.0};
    const double maxwell[] = {0.3 * k, some(d, 0.01, 1.0)};
    const double mass[] = {0.01 * s->mass_kg};
    const drawn_element others[] = {
        DRAWN(RTHYB_VISCOUS, damper),  DRAWN(RTHYB_COULOMB, friction),
        DRAWN(RTHYB_LUGRE, lugre),     DRAWN(RTHYB_GAP, gap),
        DRAWN(RTHYB_STOPPER, stopper), DRAWN(RTHYB_CUBIC, cubic),
        DRAWN(RTHYB_MAXWELL, maxwell), DRAWN(RTHYB_INERTIA, mass)};
    if (one_in(d, 3))
        add_element(rig, (drawn_element)DRAWN(RTHYB_HYSTERESIS, bouc));
    else
        add_element(rig, (drawn_element)DRAWN(RTHYB_STIFFNESS, spring));
    for (uint32_t n = below(d, 3); n > 0; n--)
        add_element(rig, others[below(d, sizeof(others) / sizeof(others)[0])]);
}

static rthyb_servo_config some_servo(dice *d, const scale *s)
{
    static const int32_t KINDS[] = {RTHYB_PURE_DELAY,   RTHYB_PURE_DELAY,   RTHYB_PURE_DELAY,
                                    RTHYB_SECOND_ORDER, RTHYB_SECOND_ORDER, RTHYB_SERVO_HYDRAULIC};
    const int32_t kind = KINDS[below(d, 6)], hold = (int32_t)below(d, 2);
    rthyb_servo_config servo = servo_example(kind, hold, s->delay);
    servo.natural_frequency_hz = some(d, 5.0, 60.0);
    servo.damping_ratio = between(d, 0.4, 1.2);
    servo.stall_force_n = 4.0 * s->k_e_n_per_m * s->peak_m;
    return servo;
}

static void set_up_rig(dice *d, world *w)
{
    const scale *s = &w->size;
    w->rig = (rthyb_rig_config){
        .servo = some_servo(d, s), .load_cell = (int32_t)below(d, 2), .seed = throw_bits(d)};
    if (w->rig.servo.kind == RTHYB_SERVO_HYDRAULIC)
        w->rig.servo.delay_samples = 0.0;
    w->rig.displacement = (rthyb_sensor){.noise_std = one_in(d, 3) ? 0.0 : some(d, 1e-7, 1e-5)};
    w->rig.displacement.bias = one_in(d, 3) ? between(d, -0.01, 0.01) : 0.0;
    w->rig.force = (rthyb_sensor){.noise_std = one_in(d, 3) ? 0.0 : some(d, 0.1, 30.0)};
    w->rig.force.bias = between(d, -0.3, 0.3) * s->k_e_n_per_m * s->peak_m;
    w->origin_m = one_in(d, 3) ? 0.0 : between(d, -0.04, 0.04);
    add_specimen(d, s, &w->rig);
}

/* ---- the excitation ----------------------------------------------------------------------------- */

static void set_up_motion(dice *d, world *w)
{
    const scale *s = &w->size;
    const int prescribed = w->station.controller.motion.integrator == RTHYB_PRESCRIBED;
    const double size = prescribed ? s->peak_m : 0.4 * s->peak_m * s->omega_per_s * s->omega_per_s;
    const double omega = s->omega_per_s * between(d, 0.5, 1.3) * PERIOD_S;
    w->ag_count = (size_t)ticks(d, 32.0, AG_MAX);
    for (size_t n = 0; n < w->ag_count; n++) {
        const double envelope = sin(3.14159265 * (double)n / (double)w->ag_count);
        w->ag_mps2[n] = size * envelope * sin(omega * (double)n);
    }
}

/* A different test on the same rig. */
static void another_test(dice *d, world *w)
{
    w->station = some_station(d, &w->size);
    set_up_motion(d, w);
}

static void set_up_world(dice *d, world *w)
{
    memset(w, 0, sizeof *w);
    w->size = some_scale(d);
    set_up_rig(d, w);
    another_test(d, w);
}

/* ---- the operator ------------------------------------------------------------------------------- */

typedef struct {
    uint32_t patience; /* ticks between two decisions */
    uint32_t nonsense; /* one command in this many ticks is arbitrary */
} operator_mood;

static operator_mood some_mood(dice *d)
{
    return (operator_mood){.patience = 1 + below(d, 60),
                           .nonsense = one_in(d, 4) ? 20 + below(d, 300) : 4000};
}

/* Runs a test as an operator does; sometimes holds, stops, or does something that makes no
 * sense. */
static int32_t operate(dice *d, const operator_mood *mood, int state)
{
    static const int32_t NEXT[] = {
        [RTHYB_IDLE] = RTHYB_CMD_ZERO,     [RTHYB_ZEROED] = RTHYB_CMD_ARM,
        [RTHYB_ARMED] = RTHYB_CMD_START,   [RTHYB_RAMP_IN] = RTHYB_CMD_NONE,
        [RTHYB_RUNNING] = RTHYB_CMD_NONE,  [RTHYB_HOLD] = RTHYB_CMD_RESUME,
        [RTHYB_RAMP_OUT] = RTHYB_CMD_NONE, [RTHYB_TRIPPED] = RTHYB_CMD_RESET,
    };
    if (one_in(d, mood->nonsense))
        return (int32_t)below(d, RTHYB_CMD_COUNT + 1);
    if (!one_in(d, mood->patience))
        return RTHYB_CMD_NONE;
    if (state == RTHYB_IDLE && one_in(d, 3))
        return RTHYB_CMD_RESET; /* of a drive that has stopped on its own */
    if (state == RTHYB_RUNNING && one_in(d, 20))
        return RTHYB_CMD_HOLD;
    if (moves(state) && one_in(d, 120))
        return RTHYB_CMD_STOP;
    return NEXT[state];
}

/* ---- troubles ----------------------------------------------------------------------------------- */

enum trouble_kind {
    TROUBLE_LOST,
    TROUBLE_SPARSE, /* most pairs are lost */
    TROUBLE_STUCK_X,
    TROUBLE_STUCK_F,
    TROUBLE_JUMP,
    TROUBLE_NOT_FINITE,
    TROUBLE_SENSELESS,
    TROUBLE_OUT_OF_RANGE,
    TROUBLE_REFUSED, /* the wire rejected a reading */
    TROUBLE_FORCE_STEP,
    TROUBLE_FORCE_CREEP,
    TROUBLE_DRIFT,
    TROUBLE_LINK_DOWN,
    TROUBLE_STOPPED,
    TROUBLE_SILENT,
    TROUBLE_UNSENT,
    TROUBLE_SKIPS,
    TROUBLE_LONG_SKIP,
    TROUBLE_KINDS
};

typedef struct {
    int32_t kind;
    uint32_t left, age; /* ticks */
    double size, seen_x, seen_f;
} trouble;

typedef struct {
    uint32_t rarity; /* one begins in this many ticks */
    trouble now[TROUBLES];
} troubles;

/* What a tick of the loop receives besides the pair. */
typedef struct {
    rthyb_station_input in;
    int unsent;
} surroundings;

static void begin_trouble(dice *d, trouble *t)
{
    static const double LONGEST[TROUBLE_KINDS] = {
        [TROUBLE_LOST] = 40.0,        [TROUBLE_SPARSE] = 3000.0,      [TROUBLE_STUCK_X] = 400.0,
        [TROUBLE_STUCK_F] = 400.0,    [TROUBLE_JUMP] = 30.0,          [TROUBLE_NOT_FINITE] = 2.0,
        [TROUBLE_SENSELESS] = 25.0,   [TROUBLE_OUT_OF_RANGE] = 30.0,  [TROUBLE_REFUSED] = 4.0,
        [TROUBLE_FORCE_STEP] = 600.0, [TROUBLE_FORCE_CREEP] = 2000.0, [TROUBLE_DRIFT] = 1000.0,
        [TROUBLE_LINK_DOWN] = 20.0,   [TROUBLE_STOPPED] = 50.0,       [TROUBLE_SILENT] = 50.0,
        [TROUBLE_UNSENT] = 40.0,      [TROUBLE_SKIPS] = 60.0,         [TROUBLE_LONG_SKIP] = 2.0,
    };
    *t = (trouble){.kind = (int32_t)below(d, TROUBLE_KINDS), .size = between(d, -1.0, 1.0)};
    t->left = (uint32_t)ticks(d, 1.0, LONGEST[t->kind]) + 1;
}

static double no_number(dice *d)
{
    static const double SOME[] = {NAN, INFINITY, -INFINITY};
    return SOME[below(d, 3)];
}

/* Skips, usually of a few ticks, rarely of so many that only their number counts. */
static uint32_t some_skips(dice *d, int32_t kind)
{
    if (kind == TROUBLE_SKIPS)
        return one_in(d, 4) ? (uint32_t)ticks(d, 1.0, one_in(d, 4) ? 31.0 : 9.0) : 0;
    return one_in(d, 3) ? UINT32_MAX : (uint32_t)ticks(d, 20.0, 1e6);
}

static void suffer(dice *d, trouble *t, const scale *s, const rthyb_station_config *c,
                   surroundings *around)
{
    rthyb_station_input *in = &around->in;
    const double force = s->k_e_n_per_m * s->peak_m;
    if (t->age == 0) {
        t->seen_x = in->axis[0].x_m;
        t->seen_f = in->axis[0].f_n;
    }
    switch (t->kind) {
    case TROUBLE_LOST:
        in->axis[0].lost = RTHYB_LOST;
        break;
    case TROUBLE_SPARSE:
        in->axis[0].lost = one_in(d, 19) ? 0 : RTHYB_LOST;
        break;
    case TROUBLE_STUCK_X:
        in->axis[0].x_m = t->seen_x;
        break;
    case TROUBLE_STUCK_F:
        in->axis[0].f_n = t->seen_f;
        break;
    case TROUBLE_JUMP:
        in->axis[0].x_m += t->size * s->peak_m;
        break;
    case TROUBLE_NOT_FINITE:
        *(one_in(d, 2) ? &in->axis[0].x_m : &in->axis[0].f_n) = no_number(d);
        break;
    case TROUBLE_SENSELESS:
        *(one_in(d, 2) ? &in->axis[0].x_m : &in->axis[0].f_n) =
            copysign(one_in(d, 2) ? 1e300 : 1e13, t->size);
        break;
    case TROUBLE_OUT_OF_RANGE:
        if (t->size > 0.0 && c->axis[0].x_range_m > 0.0)
            in->axis[0].x_m = copysign(c->axis[0].x_range_m, in->axis[0].x_m);
        else if (c->axis[0].f_range_n > 0.0)
            in->axis[0].f_n = copysign(c->axis[0].f_range_n, in->axis[0].f_n);
        break;
    case TROUBLE_REFUSED:
        in->axis[0].lost = RTHYB_LOST | (one_in(d, 4) ? RTHYB_S_NOT_FINITE : RTHYB_S_OUT_OF_RANGE);
        break;
    case TROUBLE_FORCE_STEP:
        in->axis[0].f_n += 6.0 * t->size * force;
        break;
    case TROUBLE_FORCE_CREEP:
        in->axis[0].f_n += t->size * force * (double)t->age / 200.0;
        break;
    case TROUBLE_DRIFT:
        in->axis[0].x_m += t->size * s->peak_m * (double)t->age / 300.0;
        break;
    case TROUBLE_LINK_DOWN:
        in->axis[0].link_down = 1;
        in->axis[0].lost = RTHYB_LOST;
        around->unsent = 1;
        break;
    case TROUBLE_STOPPED:
        in->axis[0].drive_stopped = 1;
        break;
    case TROUBLE_SILENT:
        in->heartbeat_late = 1;
        break;
    case TROUBLE_UNSENT:
        around->unsent = 1;
        break;
    default:
        in->skipped += in->skipped ? 0 : some_skips(d, t->kind);
        break;
    }
    t->age++;
    t->left--;
}

static void suffer_all(dice *d, troubles *all, const scale *s, const rthyb_station_config *c,
                       surroundings *around)
{
    for (int i = 0; i < TROUBLES; i++) {
        trouble *t = &all->now[i];
        if (t->left > 0)
            suffer(d, t, s, c, around);
        else if (all->rarity && one_in(d, TROUBLES * all->rarity))
            begin_trouble(d, t);
    }
}

static troubles some_troubles(dice *d)
{
    static const uint32_t RARITY[] = {0, 4000, 1500, 1500, 500, 150};
    return (troubles){.rarity = RARITY[below(d, 6)]};
}

#endif
