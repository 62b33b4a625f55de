/* The virtual actuator that the C programs of the tests measure, monitor and fuzz: with the
 * parameters of the shaking table, and some for every other kind. */
#ifndef SERVO_EXAMPLE_H
#define SERVO_EXAMPLE_H

#include "rthyb.h"

static rthyb_servo_config servo_example(int32_t kind, int32_t hold, double delay_samples)
{
    return (rthyb_servo_config){
        .kind = kind,
        .hold = hold,
        .period_s = 1.0 / 1024.0,
        .delay_samples = delay_samples,
        .roll_off_hz = 10.0,
        .natural_frequency_hz = 12.0,
        .damping_ratio = 0.7,
        .gain = 1.0,
        .kp_per_s = 63.5,
        .ki_per_s2 = 6.0,
        .valve_time_constant_s = 0.0018,
        .stall_force_n = 16000.0,
        .flow_limit_m_per_s = 1.0,
        .oil_stiffness_n_per_m = 2e7,
        .oil_damping_n_s_per_m = 1.2e4,
        .moving_mass_kg = 45.0,
        .friction_n = 80.0,
        .friction_width_m_per_s = 5e-4,
        .viscous_n_s_per_m = 600.0,
        .substeps = 16,
    };
}

#endif
