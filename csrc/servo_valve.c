/* The transfer system of the benchmark by Silva et al., MSSP 135 (2020) 106381, together with the
 * specimen: second-order servo-valve, natural velocity feedback, first-order actuator,
 *   q'' + b1 q' + b2 q = G (gain u - x),  F' + a3 F = q - a2 v,  m v' + c v + k x + other = F.
 * u is the command, or the output of the drive's own loop for the command and the displacement
 * sensor. u, and the force of all other elements of the specimen, are held over a substep;
 * everything else is exact. */
#include <string.h>

#include "internal.h"
#include "numeric.h"

enum { STATES = RTHYB_VALVE_STATES, INPUTS = 2, SIZE = STATES + INPUTS };

#define SUBSTEPS_MAX 4096
#define HALVINGS 12
#define TERMS 12

static int config_ok(const rthyb_servo_config *c)
{
    const int valve_ok = c->valve_n_per_m_s3 > 0.0 && c->valve_n_per_m_s3 <= 1e24 &&
                         c->valve_b1_per_s > 0.0 && c->valve_b1_per_s <= 1e6 &&
                         c->valve_b2_per_s2 > 0.0 && c->valve_b2_per_s2 <= 1e12 &&
                         fabs(c->gain) <= 1e3;
    const int actuator_ok = c->velocity_feedback_n_s_per_m2 >= 0.0 &&
                            c->velocity_feedback_n_s_per_m2 <= 1e15 && c->leakage_per_s >= 0.0 &&
                            c->leakage_per_s <= 1e6;
    const int specimen_ok =
        c->moving_mass_kg > 0.0 && c->moving_mass_kg <= 1e9 &&
        c->specimen_stiffness_n_per_m >= 0.0 && c->specimen_stiffness_n_per_m <= 1e15 &&
        c->specimen_damping_n_s_per_m >= 0.0 && c->specimen_damping_n_s_per_m <= 1e12;
    const int input_ok = c->command_range_m >= 0.0 && c->command_lsb_m >= 0.0 &&
                         c->command_range_m <= 1e3 && c->command_lsb_m <= 1.0 &&
                         fabs(c->loop_kp) <= 1e3 && fabs(c->loop_ki_per_s) <= 1e6;
    return valve_ok && actuator_ok && specimen_ok && input_ok && c->hold == RTHYB_ZOH &&
           c->substeps >= 1 && c->substeps <= SUBSTEPS_MAX;
}

static void multiply(const double a[SIZE * SIZE], const double b[SIZE * SIZE],
                     double out[SIZE * SIZE])
{
    for (int i = 0; i < SIZE; i++)
        for (int j = 0; j < SIZE; j++) {
            double sum = 0.0;
            for (int k = 0; k < SIZE; k++)
                sum += a[i * SIZE + k] * b[k * SIZE + j];
            out[i * SIZE + j] = sum;
        }
}

/* exp(z) in place: Taylor series of a small fraction of z, then repeated squaring. */
static void exponential(double z[SIZE * SIZE])
{
    double sum[SIZE * SIZE] = {0}, next[SIZE * SIZE];
    for (int i = 0; i < SIZE * SIZE; i++)
        z[i] = ldexp(z[i], -HALVINGS);
    for (int term = TERMS; term >= 0; term--) { /* 1 + z (1 + z/2 (1 + z/3 ...)) */
        multiply(z, sum, next);
        for (int i = 0; i < SIZE * SIZE; i++)
            sum[i] = next[i] / (term + 1.0) + (i % (SIZE + 1) == 0 ? 1.0 : 0.0);
    }
    for (int k = 0; k < HALVINGS; k++) {
        multiply(sum, sum, next);
        memcpy(sum, next, sizeof sum);
    }
    memcpy(z, sum, sizeof sum);
}

/* Unit of the force state, newtons per metre: the frequency of the valve makes all five states
 * lengths. */
static double force_unit(const rthyb_servo_config *c)
{
    const double w = sqrt(c->valve_b2_per_s2);
    return c->valve_n_per_m_s3 / (w * w * w);
}

int rthyb_valve_init(rthyb_servo *s)
{
    const rthyb_servo_config *c = &s->cfg;
    if (!config_ok(c))
        return RTHYB_E_SERVO;
    const double h = c->period_s / c->substeps, w = sqrt(c->valve_b2_per_s2);
    const double unit = force_unit(c), m = c->moving_mass_kg;
    /* q w^2 / G, q' w / G, F / unit, x, v / w; then command and other force. */
    const double rate[STATES][SIZE] = {
        {0.0, w, 0.0, 0.0, 0.0, 0.0, 0.0},
        {-w, -c->valve_b1_per_s, 0.0, -w, 0.0, w * c->gain, 0.0},
        {w, 0.0, -c->leakage_per_s, 0.0, -c->velocity_feedback_n_s_per_m2 * w / unit, 0.0, 0.0},
        {0.0, 0.0, 0.0, 0.0, w, 0.0, 0.0},
        {0.0, 0.0, unit / (m * w), -c->specimen_stiffness_n_per_m / (m * w),
         -c->specimen_damping_n_s_per_m / m, 0.0, -1.0 / (m * w)},
    };
    double z[SIZE * SIZE] = {0};
    for (int i = 0; i < STATES; i++)
        for (int j = 0; j < SIZE; j++)
            z[i * SIZE + j] = h * rate[i][j];
    exponential(z);
    memcpy(s->valve_step, z, sizeof s->valve_step);
    for (int i = 0; i < STATES * SIZE; i++)
        if (!isfinite(z[i]))
            return RTHYB_E_SERVO;
    return 0;
}

/* The value after a converter with limited resolution and range. */
static double converted(const rthyb_servo *s, double value)
{
    const rthyb_servo_config *c = &s->cfg;
    if (c->command_lsb_m > 0.0)
        value = c->command_lsb_m * nearbyint(value / c->command_lsb_m);
    return c->command_range_m > 0.0 ? clamp(value, -c->command_range_m, c->command_range_m) : value;
}

/* Input of the valve: the command, or the output of the drive's loop, with converters at its input
 * and output. The integral uses the trapezoidal rule, that is Tustin's method. */
static double driven(rthyb_servo *s, double command)
{
    const rthyb_servo_config *c = &s->cfg;
    if (c->loop_kp == 0.0 && c->loop_ki_per_s == 0.0)
        return converted(s, command);
    const double error = converted(s, command - s->sensed_m);
    s->integral = clamp(s->integral + 0.5 * c->period_s * (error + s->loop_error), -1e3, 1e3);
    s->loop_error = error;
    return converted(s, c->loop_kp * error + c->loop_ki_per_s * s->integral);
}

void rthyb_valve_advance(rthyb_servo *s, rthyb_element *elements, uint32_t element_count)
{
    const rthyb_servo_config *c = &s->cfg;
    const double h = c->period_s / c->substeps, w = sqrt(c->valve_b2_per_s2);
    const uint32_t length = RTHYB_DELAY_MAX + 2;
    const uint32_t late = (uint32_t)c->delay_samples;
    const double command = driven(s, s->past[(s->head + length - late) % length]);
    double other = 0.0;
    for (int n = 0; n < c->substeps; n++) {
        other = rthyb_specimen_force(elements, element_count, s->x, s->v, s->a, h);
        const double *z = s->valve_step;
        double next[STATES];
        for (int i = 0; i < STATES; i++, z += SIZE) {
            next[i] = z[STATES] * command + z[STATES + 1] * other;
            for (int j = 0; j < STATES; j++)
                next[i] += z[j] * s->valve_state[j];
        }
        memcpy(s->valve_state, next, sizeof next);
        s->x = next[3];
        s->v = next[4] * w;
    }
    s->oil_force = force_unit(c) * s->valve_state[2];
    s->a = (s->oil_force - c->specimen_stiffness_n_per_m * s->x -
            c->specimen_damping_n_s_per_m * s->v - other) /
           c->moving_mass_kg;
}
