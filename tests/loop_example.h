/* A complete test for the C programs that run the tick thread: a small structure, a specimen that
 * is a spring, a drive with a delay of six samples, CAN frames over a socket pair. */
#ifndef LOOP_EXAMPLE_H
#define LOOP_EXAMPLE_H

#include <math.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include "law_example.h"
#include "loop_state.h"

#define EXAMPLE_K_E 666400.0
#define EXAMPLE_PERIOD_S (1.0 / 1024.0)
enum { EXAMPLE_TICKS = 2048 /* of ground motion */ };

typedef struct {
    rthyb_rig rig;
    rthyb_drive drive;
    rthyb_station station;
    rthyb_wire wire;
    rthyb_link near, far;
    rthyb_loop_config config;
    rthyb_loop loop;
    double ag_mps2[EXAMPLE_TICKS];
} loop_example;

static rthyb_station_config loop_example_station(void)
{
    return (rthyb_station_config){
        .controller = {.period_s = EXAMPLE_PERIOD_S,
                       .lead_enabled = 1,
                       .axis_count = 1,
                       .interface_count = 1,
                       .axis = {{.law = law_example("paper", 6.0), .velocity_limit_m_per_s = 0.5}},
                       .rfc = {{.enabled = 1,
                                .window = 51,
                                .k_e_n_per_m = EXAMPLE_K_E,
                                .end_tick = UINT64_MAX}},
                       .motion = {.period_s = EXAMPLE_PERIOD_S,
                                  .mass_kg = 4220.0,
                                  .damping_n_s_per_m = 2121.0,
                                  .k_e_n_per_m = EXAMPLE_K_E,
                                  .rho_inf = 1.0}},
        .path_velocity_m_per_s = 0.05,
        .path_acceleration_m_per_s2 = 1.0,
        .axis = {{.rest_spread_m = 1e-4}},
        .tare_ticks = 16,
        .ramp_in_ticks = 64,
        .armed_ticks = 500,
    };
}

static int loop_example_links(loop_example *e)
{
    int ends[2];
    if (socketpair(AF_UNIX, SOCK_SEQPACKET, 0, ends))
        return 1;
    const int error = rthyb_link_open(&e->near, RTHYB_LINK_CAN, ends[0]) |
                      rthyb_link_open(&e->far, RTHYB_LINK_CAN, ends[1]);
    close(ends[0]);
    close(ends[1]);
    return error;
}

/* Everything except the loop itself, whose settings the caller may still change; returns 0, or the
 * error. */
static int loop_example_set_up(loop_example *e)
{
    const double stiffness = EXAMPLE_K_E;
    const rthyb_calibration identity = {.x_gain = 1.0, .f_gain = 1.0, .cmd_gain = 1.0};
    const rthyb_codec codec = {.format = RTHYB_WIRE_CAN};
    const rthyb_station_config station = loop_example_station();
    rthyb_rig_config rig = {
        .servo = {.kind = RTHYB_PURE_DELAY, .period_s = EXAMPLE_PERIOD_S, .delay_samples = 6.0},
        .element_count = 1};
    memset(e, 0, sizeof *e);
    for (int n = 0; n < EXAMPLE_TICKS; n++)
        e->ag_mps2[n] = 0.3 * sin(0.0104 * n) * sin(0.00153 * n);
    int error = rthyb_element_init(&rig.elements[0], RTHYB_STIFFNESS, &stiffness, 1);
    error |= rthyb_rig_init(&e->rig, &rig) | rthyb_station_init(&e->station, &station);
    error |= rthyb_wire_init(&e->wire, &codec) | loop_example_links(e);
    e->drive.plant = (rthyb_plant){RTHYB_PLANT_RIG, &e->rig};
    e->drive.link = &e->far;
    e->drive.codec = codec;
    e->drive.calibration = identity;
    e->drive.stop_decel_m_per_s2 = 1.0;
    e->config.station = &e->station;
    e->config.axis[0] =
        (rthyb_loop_axis){.wire = &e->wire, .link = &e->near, .calibration = identity};
    e->config.lead_ns = 200e3;
    e->config.ag_mps2 = e->ag_mps2;
    e->config.ag_count = EXAMPLE_TICKS;
    return error;
}

static inline int loop_example_init(loop_example *e, int32_t clock)
{
    e->config.clock = clock;
    return rthyb_loop_init(&e->loop, &e->config);
}

static inline void loop_example_close(loop_example *e)
{
    rthyb_link_close(&e->near);
    rthyb_link_close(&e->far);
}

#endif
