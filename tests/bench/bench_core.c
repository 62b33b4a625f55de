/* Computing time of the core: each kernel alone, one sample of each controller, complete tests.
 * JSON on stdout; times in ns per sample, or in ns for a complete test.
 *
 * Every repetition starts from the same memory and uses the same samples, which were recorded
 * beforehand in a test on the virtual shaking table with its sensor noise. Virtual machines stall
 * for tens of milliseconds: use the median, together with the tenth percentile. */
#define _POSIX_C_SOURCE 200809L

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "../law_example.h"
#include "../servo_example.h"
#include "rthyb.h"

#define FS_HZ 1024
#define PERIOD_S (1.0 / FS_HZ)
#define SETTLE (4 * FS_HZ)  /* ticks before the timed samples: windows full, gate open */
#define SAMPLES (8 * FS_HZ) /* ticks of one repetition */
#define REPETITIONS 200
#define TEST_REPETITIONS 25
#define LONGEST_S 240
#define K_E 666400.0

typedef struct {
    rthyb_controller controller;
    rthyb_rig rig;
} loop;

/* One signal of length SAMPLES for each argument of a kernel, and places for the results. */
typedef struct {
    double x_num[SAMPLES], x_cmd[SAMPLES], x_meas[SAMPLES], f[SAMPLES], ag[SAMPLES];
    double v[SAMPLES], a[SAMPLES], alpha[SAMPLES], beta[SAMPLES];
    double out1[SAMPLES], out2[SAMPLES];
    rthyb_input input[SAMPLES];
} signals;

static signals sig;
static double excitation[LONGEST_S * FS_HZ];
static rthyb_record made[SAMPLES];
static double rows[LONGEST_S * FS_HZ][RTHYB_TEST_WORDS + RTHYB_AXIS_WORDS];
static int first_row = 1;

/* With one axis: a record up to its first axis. */
static const rthyb_record *row(size_t i)
{
    return (const rthyb_record *)(const void *)rows[i];
}

static double now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return 1e9 * (double)t.tv_sec + (double)t.tv_nsec;
}

static void must(int error, const char *what)
{
    if (error) {
        fprintf(stderr, "bench_core: %s refused its settings (%d)\n", what, error);
        exit(1);
    }
}

static int by_value(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

static void print_row(const char *group, const char *name, double *ns, size_t n)
{
    qsort(ns, n, sizeof *ns, by_value);
    printf("%s\n  {\"group\": \"%s\", \"name\": \"%s\", \"median_ns\": %.6g, \"p10_ns\": %.6g, "
           "\"least_ns\": %.6g}",
           first_row ? "" : ",", group, name, ns[n / 2], ns[n / 10], ns[0]);
    first_row = 0;
}

/* Times `run` over SAMPLES samples, each time with a fresh copy of the kernel. */
static void time_kernel(const char *group, const char *name, const void *kernel, size_t size,
                        void (*run)(void *kernel))
{
    static double ns[REPETITIONS];
    void *work = malloc(size);
    if (!work)
        exit(1);
    for (int i = -REPETITIONS / 10; i < REPETITIONS; i++) { /* the first ones warm the caches */
        memcpy(work, kernel, size);
        const double start = now_ns();
        run(work);
        if (i >= 0)
            ns[i] = (now_ns() - start) / SAMPLES;
    }
    free(work);
    print_row(group, name, ns, REPETITIONS);
}

/* ---- settings: Section 5 of the paper, T = 0.5 s ----------------------------------------------- */

static rthyb_estimator_config estimator_config(enum rthyb_estimator_law law)
{
    return (rthyb_estimator_config){
        .law = law,
        .estimate_beta = law == RTHYB_LAW_RLS,
        .alpha0 = 17.0,
        .beta0 = law == RTHYB_LAW_RLS ? 144.5 : 0.0,
        .period_s = PERIOD_S,
        .reference_m = 1e-3,
        .gain = law == RTHYB_LAW_ROBUST ? 0.002 : 0.03,
        .memory_samples = 6.0 * FS_HZ,
        .cutoff_hz = 25.0,
        .alpha_max = 60.0,
        .rest_noise_m = 2e-6,
        .gate_factor = 10.0,
    };
}

static rthyb_rfc_config rfc_config(enum rthyb_tangent tangent, int32_t window)
{
    return (rthyb_rfc_config){
        .enabled = 1,
        .tangent = tangent,
        .window = window,
        .k_e_n_per_m = K_E,
        .end_tick = UINT64_MAX,
        .rest_noise_m = 2e-6,
    };
}

static rthyb_motion_config motion_config(enum rthyb_integrator integrator)
{
    return (rthyb_motion_config){
        .integrator = integrator,
        .period_s = PERIOD_S,
        .mass_kg = 4220.0,
        .damping_n_s_per_m = 2121.0,
        .k_e_n_per_m = K_E,
        .rho_inf = 0.8,
    };
}

static rthyb_servo_config servo_config(enum rthyb_servo_kind kind)
{
    return servo_example((int32_t)kind, RTHYB_ZOH, kind == RTHYB_PURE_DELAY ? 10.0 : 1.0);
}

static void set_up_rig(rthyb_rig *rig, enum rthyb_servo_kind kind, int noisy, int inelastic)
{
    static const double k = K_E, bouc_wen[] = {K_E, 0.02, 1.0, 300.0, 200.0, 1.5};
    rthyb_rig_config cfg = {.servo = servo_config(kind), .element_count = 1, .seed = 1};
    if (noisy) {
        cfg.displacement = (rthyb_sensor){.noise_std = 2e-6, .lsb = 5e-7, .range = 0.075};
        cfg.force = (rthyb_sensor){.noise_std = 5.0, .lsb = 1.0, .range = 25e3};
    }
    must(inelastic ? rthyb_element_init(cfg.elements, RTHYB_HYSTERESIS, bouc_wen, 6)
                   : rthyb_element_init(cfg.elements, RTHYB_STIFFNESS, &k, 1),
         "specimen");
    must(rthyb_rig_init(rig, &cfg), "rig");
}

static const struct {
    const char *name;
    enum rthyb_tangent tangent;
} CONTROLLERS[] = {
    {"paper", RTHYB_TANGENT_MEAN_OF_RATIOS},
    {"robust", RTHYB_TANGENT_LEAST_SQUARES},
    {"alpha-beta", RTHYB_TANGENT_LEAST_SQUARES},
    {"none", RTHYB_TANGENT_MEAN_OF_RATIOS},
};
enum { PAPER, ROBUST, ALPHA_BETA, NONE, CONTROLLER_COUNT };

static void set_up_controller(rthyb_controller *controller, int which)
{
    const int compensated = which != NONE;
    rthyb_controller_config cfg = {
        .period_s = PERIOD_S,
        .lead_enabled = compensated,
        .axis_count = 1,
        .interface_count = 1,
        .axis = {{.law = law_example(CONTROLLERS[which].name, 17.0),
                  .x_range_m = 0.075,
                  .f_range_n = 25e3}},
        .rfc = {rfc_config(CONTROLLERS[which].tangent, 51)},
        .motion = motion_config(RTHYB_CENTRAL_DIFFERENCE),
    };
    cfg.rfc[0].enabled = compensated;
    law_set(&cfg.axis[0].law, "delay_estimator.memory_s", 6.0);
    if (which == ALPHA_BETA)
        law_set(&cfg.axis[0].law, "beta0", 144.5);
    must(rthyb_controller_init(controller, &cfg), "controller");
}

/* A steady mixture of eight sines up to 8 Hz, with a peak of 0.3 m/s^2, so that all parts of a test
 * take the same computing time. */
static void make_excitation(void)
{
    for (size_t n = 0; n < LONGEST_S * FS_HZ; n++) {
        const double t = (double)n * PERIOD_S;
        for (int i = 1; i <= 8; i++)
            excitation[n] += 0.04 * sin(6.2831853 * i * 0.97 * t + i * i);
    }
}

/* ---- recording the samples --------------------------------------------------------------------- */

/* Runs a test, and leaves `l` as it was before the SAMPLES records that follow. */
static void record(loop *l, int which)
{
    int32_t status;
    set_up_controller(&l->controller, which);
    set_up_rig(&l->rig, RTHYB_SERVO_HYDRAULIC, 1, 0);
    rthyb_run_virtual(&l->controller, &l->rig, excitation, LONGEST_S * FS_HZ, SETTLE, rows,
                      &status);
    loop copy = *l;
    const size_t done = rthyb_run_virtual(&copy.controller, &copy.rig, excitation,
                                          LONGEST_S * FS_HZ, SAMPLES, rows, &status);
    must(done != SAMPLES, "the recorded test");
    for (size_t i = 0; i < SAMPLES; i++) {
        const rthyb_record *r = row(i);
        sig.input[i] = (rthyb_input){.axis = {{r->axis[0].x_meas_m, r->axis[0].f_meas_n, 0}},
                                     .excitation = r->ag_mps2};
    }
}

static void spread_signals(void)
{
    for (size_t i = 0; i < SAMPLES; i++) {
        const rthyb_record *r = row(i);
        sig.x_num[i] = r->x_num_m;
        sig.x_cmd[i] = r->axis[0].x_cmd_m;
        sig.x_meas[i] = r->axis[0].x_meas_m;
        sig.f[i] = r->axis[0].f_meas_n;
        sig.ag[i] = r->ag_mps2;
        sig.alpha[i] = r->alpha;
        sig.beta[i] = r->beta;
        sig.v[i] = i ? (sig.x_num[i] - sig.x_num[i - 1]) * FS_HZ : 0.0;
        sig.a[i] = i ? (sig.v[i] - sig.v[i - 1]) * FS_HZ : 0.0;
    }
}

/* ---- what is timed ----------------------------------------------------------------------------- */

static void run_plc(void *kernel)
{
    rthyb_plc_run(kernel, sig.alpha, sig.beta, sig.x_num, sig.out1, SAMPLES);
}

static void run_estimator(void *kernel)
{
    rthyb_estimator_run(kernel, sig.x_cmd, sig.x_meas, sig.out1, sig.out2, SAMPLES);
}

static void run_rfc(void *kernel)
{
    rthyb_rfc_run(kernel, sig.x_num, NULL, sig.x_meas, sig.f, sig.out1, sig.out2, SAMPLES);
}

static void run_motion(void *kernel)
{
    for (size_t i = 0; i < SAMPLES; i++)
        rthyb_motion_step(kernel, sig.ag[i], sig.f[i], &sig.out1[i]);
}

static void run_element(void *kernel)
{
    rthyb_element_run(kernel, sig.x_num, sig.v, sig.a, PERIOD_S, sig.out1, SAMPLES);
}

static void run_rig(void *kernel)
{
    rthyb_rig_run(kernel, sig.x_cmd, sig.out1, sig.out2, SAMPLES);
}

static void run_controller(void *kernel)
{
    for (size_t i = 0; i < SAMPLES; i++)
        rthyb_controller_step(kernel, &sig.input[i], &made[i]);
}

static void time_controllers(loop *l)
{
    for (int which = 0; which < CONTROLLER_COUNT; which++) {
        record(l, which);
        time_kernel("sample", CONTROLLERS[which].name, &l->controller, sizeof l->controller,
                    run_controller);
    }
}

static void time_estimators(void)
{
    static const char *const NAMES[] = {"fixed", "gradient", "robust", "rls alpha, beta"};
    rthyb_estimator est;
    for (int law = RTHYB_LAW_FIXED; law <= RTHYB_LAW_RLS; law++) {
        const rthyb_estimator_config cfg = estimator_config((enum rthyb_estimator_law)law);
        must(rthyb_estimator_init(&est, &cfg, 3.0, 2.0, 0.0), "estimator");
        time_kernel("estimator", NAMES[law], &est, sizeof est, run_estimator);
    }
}

static void time_rfc(const char *tangent_name, enum rthyb_tangent tangent)
{
    static const int32_t WINDOWS[] = {26, 51, 102, 205};
    static rthyb_rfc rfc;
    char name[64];
    for (size_t i = 0; i < sizeof WINDOWS / sizeof *WINDOWS; i++) {
        const rthyb_rfc_config cfg = rfc_config(tangent, WINDOWS[i]);
        must(rthyb_rfc_init(&rfc, &cfg, 0.0, 0.0), "rfc");
        snprintf(name, sizeof name, "%s, T0 = %d", tangent_name, WINDOWS[i]);
        time_kernel("rfc", name, &rfc, sizeof rfc, run_rfc);
    }
}

static void time_motion(void)
{
    static const char *const NAMES[] = {"central difference", "forward Euler", "CR", "KR-alpha"};
    rthyb_motion motion;
    for (int i = RTHYB_CENTRAL_DIFFERENCE; i <= RTHYB_KR_ALPHA; i++) {
        const rthyb_motion_config cfg = motion_config((enum rthyb_integrator)i);
        must(rthyb_motion_init(&motion, &cfg, 0.0), "motion");
        time_kernel("motion", NAMES[i], &motion, sizeof motion, run_motion);
    }
}

static void time_elements(void)
{
    static const struct {
        const char *name;
        size_t n;
        double params[RTHYB_ELEMENT_PARAMS];
    } ELEMENTS[RTHYB_ELEMENT_KINDS] = {
        [RTHYB_STIFFNESS] = {"stiffness", 1, {K_E}},
        [RTHYB_VISCOUS] = {"viscous", 1, {2000.0}},
        [RTHYB_COULOMB] = {"coulomb", 2, {80.0, 5e-4}},
        [RTHYB_STRIBECK] = {"stribeck", 5, {80.0, 120.0, 0.01, 5e-4, 1.0}},
        [RTHYB_LUGRE] = {"lugre", 6, {80.0, 120.0, 0.01, 1e6, 300.0, 10.0}},
        [RTHYB_QUAD_DAMPING] = {"quad_damping", 1, {5000.0}},
        [RTHYB_INERTIA] = {"inertia", 1, {45.0}},
        [RTHYB_GAP] = {"gap", 2, {K_E, 1e-3}},
        [RTHYB_CUBIC] = {"cubic", 1, {1e9}},
        [RTHYB_QUADRATIC] = {"quadratic", 1, {1e7}},
        [RTHYB_STOPPER] = {"stopper", 3, {1e7, 2e-3, 0.5}},
        [RTHYB_HYSTERESIS] = {"hysteresis", 6, {K_E, 0.02, 1.0, 300.0, 200.0, 1.5}},
        [RTHYB_PINCHING] = {"pinching", 8, {K_E, 0.02, 1.0, 300.0, 200.0, 1.5, 0.6, 0.2}},
        [RTHYB_DEGRADATION] = {"degradation",
                               10,
                               {K_E, 0.02, 1.0, 300.0, 200.0, 1.5, 0.3, 1.0, 1e3, 0.1}},
        [RTHYB_MAXWELL] = {"maxwell", 2, {1e5, 0.1}},
        [RTHYB_SECOND_MODE] = {"second_mode", 3, {500.0, 12.0, 0.02}},
        [RTHYB_P_DELTA] = {"p_delta", 2, {4e4, 3.0}},
        [RTHYB_GAP_FRICTION] = {"gap_friction", 5, {K_E, 1e-3, 400.0, 600.0, 2e-4}},
        [RTHYB_COULOMB_UNEVEN] = {"coulomb_uneven", 3, {80.0, 120.0, 5e-4}},
        [RTHYB_GAP_UNEVEN] = {"gap_uneven", 5, {K_E, 1e-3, 1e6, 2e-3, 0.5}},
        [RTHYB_POWER_DAMPING] = {"power_damping", 4, {500.0, 0.1, 0.3, 5e-4}},
        [RTHYB_POWER_SPRING] = {"power_spring", 4, {3000.0, 5e-3, 1.3, 1e-5}},
        [RTHYB_PENDULUM] = {"pendulum", 2, {4e4, 0.5}},
        [RTHYB_FRICTION_PENDULUM] = {"friction_pendulum", 6, {4e4, 1.0, 0.03, 0.06, 30.0, 5e-4}},
        [RTHYB_IWAN] = {"iwan", 4, {K_E, 0.02, 3e-3, 0.8}},
        [RTHYB_MENEGOTTO_PINTO] = {"menegotto_pinto", 6, {K_E, 0.02, 3e-3, 20.0, 0.925, 0.15}},
        [RTHYB_CHABOCHE] = {"chaboche", 6, {K_E, 1500.0, 5e4, 50.0, 500.0, 5.0}},
        [RTHYB_RC_COLUMN] = {"rc_column",
                             13,
                             {K_E, 0.02, 3e-3, 2.0, 4.0, 0.02, 0.3, 500.0, 0.2, 0.3, 0.2, 0.3,
                              0.2}},
        [RTHYB_PEAK_ORIENTED] = {"peak_oriented", 6, {K_E, 0.8 * K_E, 0.02, 2.2, 0.6, 1e-4}},
        [RTHYB_TAKEDA] = {"takeda", 10, {K_E, 0.05, 3e-3, 8.0, 0.4, 0.6, 0.3, 500.0, 0.8, 1.0}},
        [RTHYB_ROCKING] = {"rocking", 3, {K_E, 2e-3, 0.1}},
        [RTHYB_NONLINEAR_MAXWELL] = {"nonlinear_maxwell", 4, {4e5, 900.0, 0.2, 0.35}},
    };
    rthyb_element element;
    for (int kind = 0; kind < RTHYB_ELEMENT_KINDS; kind++) {
        if (!ELEMENTS[kind].name) /* computed by a class in Python */
            continue;
        must(rthyb_element_init(&element, kind, ELEMENTS[kind].params, ELEMENTS[kind].n),
             ELEMENTS[kind].name);
        time_kernel("element", ELEMENTS[kind].name, &element, sizeof element, run_element);
    }
}

static const char *const SERVOS[] = {"pure delay", "first order", "second order",
                                     "servo-hydraulic, 16 substeps"};

static void time_rigs(void)
{
    static rthyb_rig rig;
    for (int kind = RTHYB_PURE_DELAY; kind <= RTHYB_SERVO_HYDRAULIC; kind++) {
        set_up_rig(&rig, (enum rthyb_servo_kind)kind, 0, 0);
        time_kernel("rig", SERVOS[kind], &rig, sizeof rig, run_rig);
    }
    set_up_rig(&rig, RTHYB_PURE_DELAY, 1, 0);
    time_kernel("rig", "pure delay, noisy sensors", &rig, sizeof rig, run_rig);
}

/* A complete test from its first sample, on a rig without noise or with that of the shaking
 * table. */
static void time_test(const char *group, const char *name, int which, enum rthyb_servo_kind kind,
                      int inelastic, size_t seconds)
{
    static loop l;
    double ns[TEST_REPETITIONS];
    const size_t n = seconds * FS_HZ;
    for (int i = -1; i < TEST_REPETITIONS; i++) {
        int32_t status;
        set_up_controller(&l.controller, which);
        set_up_rig(&l.rig, kind, kind == RTHYB_SERVO_HYDRAULIC, inelastic);
        const double start = now_ns();
        const size_t done =
            rthyb_run_virtual(&l.controller, &l.rig, excitation, n, n, rows, &status);
        if (i >= 0)
            ns[i] = now_ns() - start;
        must(done != n, name);
    }
    print_row(group, name, ns, TEST_REPETITIONS);
}

static void time_tests(void)
{
    char name[64];
    for (int kind = RTHYB_PURE_DELAY; kind <= RTHYB_SERVO_HYDRAULIC; kind++) {
        for (int which = PAPER; which <= ALPHA_BETA; which += ALPHA_BETA - PAPER) {
            snprintf(name, sizeof name, "%s, %s", SERVOS[kind], CONTROLLERS[which].name);
            time_test("test of 60 s", name, which, (enum rthyb_servo_kind)kind, 0, 60);
        }
    }
    for (int kind = RTHYB_PURE_DELAY; kind <= RTHYB_SERVO_HYDRAULIC;
         kind += RTHYB_SERVO_HYDRAULIC) {
        snprintf(name, sizeof name, "%s, Bouc-Wen, paper", SERVOS[kind]);
        time_test("test of 60 s", name, PAPER, (enum rthyb_servo_kind)kind, 1, 60);
    }
    for (size_t seconds = 15; seconds <= LONGEST_S; seconds *= 2) {
        snprintf(name, sizeof name, "%zu s", seconds);
        time_test("length", name, PAPER, RTHYB_PURE_DELAY, 0, seconds);
    }
}

static int finish(void)
{
    puts("\n]}");
    return 0;
}

/* With the argument "sample", only the samples of the controllers are timed. */
int main(int argc, char **argv)
{
    static loop l;
    static rthyb_plc plc;
    make_excitation();
    printf("{\"compiler\": \"%s\", \"repetitions\": %d, \"samples\": %d, \"rows\": [",
           rthyb_compiler(), REPETITIONS, SAMPLES);
    time_controllers(&l);
    if (argc > 1 && !strcmp(argv[1], "sample"))
        return finish();
    record(&l, ALPHA_BETA);
    spread_signals();
    must(rthyb_plc_init(&plc, 3.0, 2.0, 0.0), "plc");
    time_kernel("plc", "with curvature", &plc, sizeof plc, run_plc);
    time_estimators();
    time_rfc("mean of ratios", RTHYB_TANGENT_MEAN_OF_RATIOS);
    time_rfc("least squares", RTHYB_TANGENT_LEAST_SQUARES);
    time_motion();
    time_elements();
    time_rigs();
    time_tests();
    return finish();
}
