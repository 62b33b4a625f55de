/* Counts what the per-sample path of the core requests from the allocator and from the kernel:
 * every controller, integrator, actuator and specimen element, with lost and implausible samples
 * among valid ones. Every allocation function of the C library is replaced by one that counts; and
 * after the set-up, the process gives up all system calls except write and exit, so that any other
 * kills it.
 *
 * Prints "CASES SAMPLES ALLOCATIONS WATCHED"; WATCHED is 1 if this system can forbid calls. The
 * arguments "allocate" and "call" break the rule once, after the cases of one law, to show that it
 * is enforced. */
#define _GNU_SOURCE
#include <linux/seccomp.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "counted_allocator.h"
#include "law_example.h"
#include "rthyb.h"
#include "servo_example.h"

#define PERIOD_S (1.0 / 1024.0)
#define SAMPLES 600 /* more than twice the window: all three stages of the tangent stiffness */
#define K_E 666400.0

static volatile unsigned long allocations;

static void note_allocation(void)
{
    allocations++;
}

static const struct {
    int32_t kind;
    size_t n;
    double params[RTHYB_ELEMENT_PARAMS];
} ELEMENTS[] = {
    {RTHYB_STIFFNESS, 1, {K_E}},
    {RTHYB_VISCOUS, 1, {2000.0}},
    {RTHYB_COULOMB, 2, {80.0, 5e-4}},
    {RTHYB_STRIBECK, 5, {80.0, 120.0, 0.01, 5e-4, 1.0}},
    {RTHYB_LUGRE, 6, {80.0, 120.0, 0.01, 1e6, 300.0, 10.0}},
    {RTHYB_QUAD_DAMPING, 1, {500.0}},
    {RTHYB_INERTIA, 1, {45.0}},
    {RTHYB_GAP, 2, {K_E, 1e-3}},
    {RTHYB_CUBIC, 1, {1e9}},
    {RTHYB_QUADRATIC, 1, {1e7}},
    {RTHYB_STOPPER, 3, {1e5, 2e-3, 0.5}},
    {RTHYB_HYSTERESIS, 6, {K_E, 0.02, 1.0, 300.0, 200.0, 1.3}},
    {RTHYB_PINCHING, 8, {K_E, 0.02, 1.0, 300.0, 200.0, 1.5, 0.6, 0.2}},
    {RTHYB_DEGRADATION, 10, {K_E, 0.02, 1.0, 300.0, 200.0, 1.5, 0.3, 1.0, 1e3, 0.1}},
    {RTHYB_MAXWELL, 2, {1e5, 0.1}},
    {RTHYB_SECOND_MODE, 3, {500.0, 12.0, 0.02}},
    {RTHYB_P_DELTA, 2, {4e4, 3.0}},
    {RTHYB_GAP_FRICTION, 5, {K_E, 1e-3, 400.0, 600.0, 2e-4}},
    {RTHYB_COULOMB_UNEVEN, 3, {80.0, 120.0, 5e-4}},
    {RTHYB_GAP_UNEVEN, 5, {K_E, 1e-3, 1e6, 2e-3, 0.5}},
    {RTHYB_POWER_DAMPING, 4, {500.0, 0.1, 0.3, 5e-4}},
    {RTHYB_POWER_SPRING, 4, {3000.0, 5e-3, 1.3, 1e-5}},
    {RTHYB_PENDULUM, 2, {4e4, 0.5}},
    {RTHYB_FRICTION_PENDULUM, 6, {4e4, 1.0, 0.03, 0.06, 30.0, 5e-4}},
    {RTHYB_IWAN, 4, {K_E, 0.02, 3e-3, 0.8}},
    {RTHYB_MENEGOTTO_PINTO, 6, {K_E, 0.02, 3e-3, 20.0, 0.925, 0.15}},
    {RTHYB_CHABOCHE, 6, {K_E, 1500.0, 5e4, 50.0, 500.0, 5.0}},
    {RTHYB_RC_COLUMN, 13, {K_E, 0.02, 3e-3, 2.0, 4.0, 0.02, 0.3, 500.0, 0.2, 0.3, 0.2, 0.3, 0.2}},
    {RTHYB_PEAK_ORIENTED, 6, {K_E, 0.8 * K_E, 0.02, 2.2, 0.6, 1e-4}},
    {RTHYB_TAKEDA, 10, {K_E, 0.05, 3e-3, 8.0, 0.4, 0.6, 0.3, 500.0, 0.8, 0.7}},
    {RTHYB_ROCKING, 3, {K_E, 2e-3, 0.1}},
    {RTHYB_NONLINEAR_MAXWELL, 4, {4e5, 900.0, 0.2, 0.35}},
};
enum { ELEMENT_COUNT = sizeof ELEMENTS / sizeof *ELEMENTS, HALF = (ELEMENT_COUNT + 1) / 2 };

typedef struct {
    int law, tangent, integrator, servo, hold, half;
} choice;

/* After the integrators for one degree of freedom: CR and RK4 for a part with three, then a sparse
 * part. */
enum { SPARSE = RTHYB_PRESCRIBED + 3 };

static int dense_integrator(const choice *c)
{
    const int dense[] = {RTHYB_CR, RTHYB_RK4};
    const int own = c->integrator > RTHYB_PRESCRIBED && c->integrator < SPARSE;
    return own ? dense[c->integrator - RTHYB_PRESCRIBED - 1] : -1;
}

static const rthyb_dense_config *dense_part(int integrator)
{
    static rthyb_dense_config cfg;
    cfg = (rthyb_dense_config){
        .integrator = integrator,
        .size = 3,
        .force_delay = integrator == RTHYB_RK4,
        .period_s = PERIOD_S,
        .mass_kg = {4000.0, 0.0, 0.0, 0.0, 3000.0, 0.0, 0.0, 0.0, 2000.0},
        .damping_n_s_per_m = {3e3, -1e3, 0.0, -1e3, 2e3, -1e3, 0.0, -1e3, 1e3},
        .stiffness_n_per_m = {K_E, -K_E, 0.0, -K_E, 2.0 * K_E, -K_E, 0.0, -K_E, K_E},
        .load_kg = {4000.0, 3000.0, 2000.0},
        .k_e_n_per_m = K_E,
    };
    return &cfg;
}

enum { STOREYS = 4, SPARSE_STATE = 4096 };

/* A chain, with 1 and k K_E throughout and rho_inf = 1: S = M / 2 + (h C + h^2 K / 2) / 4 is
 * tridiagonal and is factored from its first row on. In addition, one storey is Bouc-Wen, and one
 * mode has modal damping. */
static rthyb_numerical sparse_part(void)
{
    static const int32_t start[] = {0, 1, 2, 3, 3}, next[] = {1, 2, 3}, none[] = {0, 0, 0, 0, 0};
    static const int32_t one_row[] = {0, 1}, first[] = {0}, roof[] = {STOREYS - 1};
    static const double mass[] = {4e3, 4e3, 4e3, 4e3}, unit[] = {1.0}, k_e[] = {K_E};
    static const double k[] = {3.0 * K_E, 2.0 * K_E, 2.0 * K_E, K_E}, k_off[] = {-K_E, -K_E, -K_E};
    static const double modal[] = {10.0, 20.0, 30.0, 40.0};
    static double d[STOREYS], l[STOREYS - 1], by_force[STOREYS], by_ag[STOREYS], z[STOREYS],
        inner[1];
    static double state[SPARSE_STATE];
    static rthyb_joint joint[2];
    static const int32_t slider[] = {1};
    static double slider_w[STOREYS] = {0.0, 0.0, -1.0, 1.0}, slider_g[1], slider_x[1];
    static rthyb_sparse_config cfg;
    cfg = (rthyb_sparse_config){
        .size = STOREYS,
        .interfaces = 1,
        .joints = 2,
        .modes = 0,
        .responses = 1,
        .damped = 1,
        .period_s = PERIOD_S,
        .alpha_m = 0.5,
        .alpha_f = 0.5,
        .gamma = 0.5,
        .beta = 0.25,
        .mass_kg = {.diagonal = mass, .start = none},
        .stiffness_n_per_m = {.diagonal = k, .start = start, .at = next, .value = k_off},
        .damping_n_s_per_m = {.diagonal = mass, .start = none},
        .by_mass_per_s = 0.3,
        .load_kg = mass,
        .interface = {.start = one_row, .at = first, .weight = unit},
        .k_e_n_per_m = k_e,
        .joint = joint,
        .response = {.start = one_row, .at = roof, .weight = unit},
        .factor = {.diagonal = d, .start = start, .at = next, .value = l},
        .modal = modal,
        .modal_solved = z,
        .modal_inner = inner,
        .by_force = by_force,
        .first_by_force = by_force,
        .by_excitation = by_ag,
        .first_by_excitation = by_ag,
        .sliders = 1,
        .slider = slider,
        .slider_w = slider_w,
        .slider_g = slider_g,
        .slider_x = slider_x,
    };
    joint[0] = (rthyb_joint){.below = 1, .above = 2, .stiffness_n_per_m = 0.0};
    (void)rthyb_element_init(&joint[0].element, ELEMENTS[0].kind, ELEMENTS[0].params,
                             ELEMENTS[0].n);
    joint[1] = (rthyb_joint){.below = 2, .above = 3};
    static const double dry[] = {2e3, 1e-6};
    (void)rthyb_element_init(&joint[1].element, RTHYB_COULOMB, dry, 2);
    const double h = PERIOD_S, of_k = 0.125 * h * h, of_m = 0.5 + 0.25 * h * 1.3;
    double pivot = of_m * mass[0] + of_k * k[0];
    for (int i = 0; i < STOREYS; i++) {
        d[i] = 1.0 / pivot;
        if (i + 1 == STOREYS)
            break;
        l[i] = of_k * k_off[i] / pivot;
        pivot = of_m * mass[i + 1] + of_k * k[i + 1] - l[i] * of_k * k_off[i];
    }
    for (int i = 0; i < STOREYS; i++) {
        z[i] = modal[i];
        by_force[i] = i == 0 ? -0.5 : 0.0;
        by_ag[i] = -0.5 * mass[i];
    }
    rthyb_sparse_solve(&cfg, z);
    double along = 4.0 / h;
    for (int i = 0; i < STOREYS; i++)
        along += modal[i] * z[i];
    inner[0] = 1.0 / along;
    cfg.modes = 1;
    rthyb_sparse_solve(&cfg, by_force);
    rthyb_sparse_solve(&cfg, by_ag);
    rthyb_sparse_solve(&cfg, slider_w);
    slider_g[0] = 0.5 * h * (slider_w[3] - slider_w[2]);
    slider_x[0] = h * h * slider_w[0];
    return (rthyb_numerical){.kind = RTHYB_NUMERICAL_SPARSE, .cfg = &cfg, .state = state};
}

static rthyb_numerical part_of_case(const choice *c)
{
    static rthyb_dense state;
    if (c->integrator == SPARSE)
        return sparse_part();
    const int dense = dense_integrator(c);
    return dense < 0 ? (rthyb_numerical){.kind = RTHYB_NUMERICAL_MOTION}
                     : (rthyb_numerical){.kind = RTHYB_NUMERICAL_DENSE,
                                         .cfg = dense_part(dense),
                                         .state = &state};
}

static int set_up_controller(rthyb_controller *controller, const choice *c)
{
    const int own = c->integrator <= RTHYB_PRESCRIBED;
    const rthyb_controller_config cfg = {
        .period_s = PERIOD_S,
        .lead_enabled = 1,
        .axis_count = 1,
        .interface_count = 1,
        .axis = {{.law = law_of_kind(c->law, 17.0),
                  .x_range_m = 0.1,
                  .velocity_limit_m_per_s = 1.0,
                  .acceleration_limit_m_per_s2 = 50.0}},
        .rfc = {{.enabled = 1,
                 .tangent = c->tangent,
                 .window = 51,
                 .k_e_n_per_m = K_E,
                 .end_tick = 500,
                 .rest_noise_m = 2e-6}},
        .numerical = part_of_case(c),
        .motion = {.integrator = own ? c->integrator : RTHYB_CR,
                   .period_s = PERIOD_S,
                   .mass_kg = 4220.0,
                   .damping_n_s_per_m = 2121.0,
                   .k_e_n_per_m = K_E,
                   .rho_inf = 0.8},
    };
    return rthyb_controller_init(controller, &cfg);
}

static int set_up_rig(rthyb_rig *rig, const choice *c)
{
    rthyb_rig_config cfg = {
        .servo = servo_example(c->servo, c->hold, 1.0),
        .displacement = {.noise_std = 2e-6, .lsb = 5e-7, .range = 0.075},
        .force = {.noise_std = 5.0, .lsb = 1.0, .range = 25e3},
        .seed = 1,
    };
    int error = 0;
    for (int i = c->half ? HALF : 0; i < (c->half ? ELEMENT_COUNT : HALF); i++)
        error |= rthyb_element_init(&cfg.elements[cfg.element_count++], ELEMENTS[i].kind,
                                    ELEMENTS[i].params, ELEMENTS[i].n);
    return error | rthyb_rig_init(rig, &cfg);
}

/* Set-up and run of one test; returns 0, or the error. */
static int run_case(const choice *c)
{
    static rthyb_controller controller;
    static rthyb_rig rig;
    static rthyb_record record;
    const int error = set_up_controller(&controller, c) | set_up_rig(&rig, c);
    for (int n = 0; n < SAMPLES && !error; n++) {
        const double t = n * PERIOD_S;
        rthyb_input in = {.excitation = 0.4 * sin(20.0 * t) + 0.3 * sin(55.0 * t)};
        if (c->integrator == RTHYB_PRESCRIBED)
            in.excitation *= 0.01;
        rthyb_rig_step(&rig, controller.axis[0].x_cmd, &in.axis[0].x_meas_m, &in.axis[0].f_meas_n);
        in.axis[0].lost = n % 97 < 4;
        if (n % 131 == 0)
            in.axis[0].x_meas_m = n % 2 ? NAN : 1e300;
        if (n % 173 == 0)
            in.axis[0].f_meas_n = INFINITY;
        rthyb_controller_step(&controller, &in, &record);
    }
    return error;
}

enum { AXES = 2, CHOICES = 4 };

static int set_up_axes(int choice, rthyb_coupled_plant *plant, rthyb_matrix_lead *lead,
                       rthyb_matrix_rfc *rfc)
{
    const double rest[AXES] = {0.0, 0.0};
    const rthyb_coupled_plant_config cfg = {
        .size = AXES,
        .states = AXES,
        .forces = 3,
        .period_s = PERIOD_S,
        .a = {{0.9, 0.01}, {0.02, 0.95}},
        .b = {{0.09, 0.0}, {0.0, 0.05}},
        .c = {{1.0, 0.1}, {0.1, 1.0}},
        .stroke_m = {0.03, 0.03},
        .noise_m = {1e-5, 1e-5},
        .kinematics = {.kind = choice % 2 ? RTHYB_KINEMATICS_PINS : RTHYB_KINEMATICS_MATRIX,
                       .size = AXES,
                       .matrix = {1.0, 0.13, 1.0, -0.13},
                       .coordinate = {RTHYB_COORDINATE_X, RTHYB_COORDINATE_THETA},
                       .pin_m = {{0.27, 0.13}, {0.27, -0.13}},
                       .base_m = {{1.6, 0.13}, {1.6, -0.13}}},
        .stiffness = {{K_E, 0.0}, {0.0, 0.1 * K_E}, {0.0, 1.0}},
        .mass = {{8.0, 0.0}, {0.0, 1.0}, {0.0, 0.0}},
        .seed = 1,
    };
    const rthyb_matrix_lead_config led = {
        .size = AXES,
        .coupled = choice / 2,
        .poles = 1,
        .period_s = PERIOD_S,
        .roll_off_hz = 20.0,
        .cutoff_hz = 10.0,
        .gate_factor = 10.0,
        .memory_s = 1.0,
        .sigma = {0.05, 0.004, 1e-5},
        .gain_most = 0.3,
        .delay_most_s = 0.05,
        .rest_noise_m = {1e-5, 1e-5},
        .pole_hz = {40.0},
        .inverse = {{{1.0, -0.1}, {-0.1, 1.0}}, {{0.5, 0.0}, {0.0, 0.5}}},
    };
    const rthyb_matrix_rfc_config compensated = {
        .size = AXES,
        .enabled = 1,
        .period_s = PERIOD_S,
        .memory_s = 0.05,
        .cutoff_hz = choice / 2 ? 60.0 : 0.0,
        .lateness_s = 5e-4,
        .k_e = {{K_E, 0.0}, {0.0, 0.1 * K_E}},
        .rest_noise = {1e-5, 1e-4},
    };
    return rthyb_coupled_plant_init(plant, &cfg) | rthyb_matrix_lead_init(lead, &led, rest) |
           rthyb_matrix_rfc_init(rfc, &compensated, rest, rest);
}

/* The axes of a plant, with a wire and a load cell that belong to none of them. */
static int set_up_sensors(const rthyb_kinematics_config *axes, rthyb_kinematics *kinematics)
{
    rthyb_kinematics_config cfg = *axes;
    const int pins = cfg.kind == RTHYB_KINEMATICS_PINS;
    const double with_pins[] = {0.5, 0.1};
    /* (1 - W C) B', and W, with W = with_pins and C = carries. */
    const double with_matrix[] = {0.8, 0.8, 0.5, 0.09, -0.17, 0.1};
    cfg.displacement_sensors = cfg.force_sensors = 1;
    cfg.given = RTHYB_GIVEN_FORCES;
    cfg.reads[0] = 1.0;
    cfg.reads[1] = 0.2;
    cfg.carries[0] = 0.4;
    cfg.sensor_pin_m[0][0] = 0.1;
    cfg.sensor_base_m[0][0] = -0.7;
    cfg.sensor_base_m[0][1] = 0.2;
    memcpy(cfg.forces, pins ? with_pins : with_matrix,
           pins ? sizeof with_pins : sizeof with_matrix);
    return rthyb_kinematics_init(kinematics, &cfg);
}

/* Two coupled axes, with the same implausible readings among valid ones. */
static int run_axes(int choice)
{
    static rthyb_coupled_plant plant;
    static rthyb_matrix_lead lead;
    static rthyb_matrix_rfc rfc;
    static rthyb_kinematics sensed;
    const int error =
        set_up_axes(choice, &plant, &lead, &rfc) | set_up_sensors(&plant.cfg.kinematics, &sensed);
    double command[AXES] = {0.0, 0.0};
    for (int n = 0; n < SAMPLES && !error; n++) {
        const double t = n * PERIOD_S, v[AXES] = {0.1, 0.1};
        double x[AXES], force[3], pose[AXES] = {4e-3 * sin(20.0 * t), 0.03 * sin(33.0 * t)};
        double target[AXES], used[AXES], push[AXES], sensor[2], measured[AXES], slopes[AXES];
        (void)rthyb_coupled_plant_latch(&plant, x, force);
        if (n % 131 == 0)
            x[n % 2] = n % 4 ? NAN : 1e300;
        if (n % 173 == 0)
            pose[0] = INFINITY;
        (void)rthyb_matrix_rfc_step(&rfc, pose, v, plant.pose, force, n % 97 < 4, used);
        (void)rthyb_matrix_lead_observe(&lead, command, x, n % 97 < 4);
        (void)rthyb_kinematics_axes(&plant.kinematics, pose, target);
        (void)rthyb_kinematics_forces(&plant.kinematics, used, push);
        rthyb_kinematics_readings(&sensed.cfg, pose, used, sensor);
        sensor[n % 2] = n % 59 ? sensor[n % 2] : n % 3 ? 1e300 : NAN;
        (void)rthyb_kinematics_measured_pose(&sensed, x, sensor, measured);
        (void)rthyb_kinematics_measured_forces(&sensed, push, sensor, measured);
        rthyb_kinematics_reads(&sensed, slopes);
        (void)rthyb_matrix_lead_lead(&lead, target, n % 3 ? 1e-6 : INFINITY, command);
        (void)rthyb_coupled_plant_apply(&plant, command);
    }
    return error;
}

static void finish(int status)
{
    syscall(SYS_exit, status);
}

int main(int argc, char **argv)
{
    const char *wrong = argc > 1 ? argv[1] : "";
    free(malloc(64)); /* so that the allocator itself is initialised */
    const int watched = prctl(PR_SET_SECCOMP, SECCOMP_MODE_STRICT) == 0;
    const unsigned long before = allocations;
    unsigned long cases = 0;
    int error = 0;
    choice c;
    const int laws = *wrong ? 1 : (int)rthyb_law_count();
    for (c.law = 0; c.law < laws; c.law++)
        for (c.tangent = 0; c.tangent <= RTHYB_TANGENT_LEAST_SQUARES; c.tangent++)
            for (c.integrator = 0; c.integrator <= SPARSE; c.integrator++)
                for (c.servo = 0; c.servo <= RTHYB_SERVO_HYDRAULIC; c.servo++)
                    for (c.hold = 0; c.hold <= RTHYB_FOH; c.hold++)
                        for (c.half = 0; c.half <= 1; c.half++, cases++)
                            error |= run_case(&c);
    for (int choice = 0; choice < CHOICES; choice++, cases++)
        error |= run_axes(choice);
    if (!strcmp(wrong, "allocate")) {
        void *volatile block = malloc(64);
        free(block);
    }
    if (!strcmp(wrong, "call"))
        syscall(SYS_getpid);
    char line[128];
    const int length = snprintf(line, sizeof line, "%lu %lu %lu %d\n", cases, cases * SAMPLES,
                                allocations - before, watched);
    if (write(1, line, (size_t)length) != length)
        error = 1;
    finish(error);
}
