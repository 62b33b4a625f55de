/* Tests in virtual time (virtual.c), and the simulators of the diagnosis (simulate.c). */
#ifndef RTHYB_PART_SIMULATION_H
#define RTHYB_PART_SIMULATION_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_plant.h"
#include "rthyb_station.h"

/* cffi: begin */

/* ---- tests in virtual time (virtual.c) --------------------------------------------------------- */

/* Station and virtual rig, tick by tick, without clock and wire: the drives follow at once, have the
 * station's zero for their own, and stop by themselves when they are told of a trip. */
typedef struct {
    rthyb_station *station;
    rthyb_plant plant;
    const double *ag_mps2; /* ground motion of the test */
    size_t ag_count;
    double stop_decel_m_per_s2;
    int32_t truth;    /* the first two channels of each axis are what its sensors saw, without
                       * their errors: rthyb_plant_truth */
    int32_t freedoms; /* so many channels, behind those, say where the numerical part's
                       * degrees of freedom are */
    /* From here on the core's own: enum rthyb_drive_phase, what each actuator is told, and was told before. */
    int32_t phase[RTHYB_COUPLED_MAX];
    double target_m[RTHYB_COUPLED_MAX], target1_m[RTHYB_COUPLED_MAX];
} rthyb_virtual;

/* The members up to freedoms are the caller's; the rest becomes new. 0; RTHYB_E_LIMIT for a
 * deceleration that is not positive or too many channels, RTHYB_E_PERIOD where station and rig have not the same
 * period, RTHYB_E_PLANT where they have not the same axes. */
int rthyb_virtual_init(rthyb_virtual *test);
/* Runs up to count ticks, the first one with an operator's command (RTHYB_CMD_NONE: none); each gives one
 * row of the station's axes, and the first channel_count of its channels. Returns how many were run: fewer where
 * the state has become another, or a tare has failed. */
size_t rthyb_virtual_run(rthyb_virtual *test, int32_t command, size_t count, void *rows,
                         double *channels, uint32_t channel_count);

/* ---- simulators of the diagnosis (simulate.c) ------------------------------------------------- */

/* gain exp(-s delay) w^2 / (s^2 + 2 zeta w s + w^2) along a recorded command. */
typedef struct {
    double period_s;
    double delay_s, natural_frequency_hz, damping_ratio, gain;
    double shift_s;                /* of the command against the rows, beside the delay */
    double delay_rate_s2_per_m;    /* delay that comes with each m/s */
    double velocity_limit_m_per_s; /* 0 = none */
    int32_t limit_at;              /* 0: of the command, 1: of the actuator itself */
    int32_t rate_of; /* delay_rate with 0: the actuator's velocity, 1: the command's */
    int32_t hold;    /* RTHYB_ZOH, RTHYB_FOH */
} rthyb_actuator_model;

/* Displacement, velocity and acceleration at the rows, begun at rest where the first command is.
 * Up to a row, which need not be whole, the actuator is another one; place and velocity go on. With
 * row 0 it is the model throughout. 0 or RTHYB_E_SERVO;
 * RTHYB_E_LIMIT when it ran off. */
int rthyb_simulate_actuator(const rthyb_actuator_model *before, const rthyb_actuator_model *model,
                            double row, const double *x_cmd_m, size_t n, double *x_m,
                            double *v_m_per_s, double *a_m_per_s2);

typedef struct {
    double period_s, mass_kg;
    double x0_m, v0_m_per_s;
    int32_t hold; /* of the force between the rows */
    int32_t substeps;
} rthyb_body_model;

/* mass a + sum of elements = force; second order in the substep. An inertia belongs into mass_kg:
 * elements have the acceleration of the substep before. Dry friction (coulomb, coulomb_uneven,
 * stribeck) whose step over velocity is too narrow for that is solved for with the motion: what
 * sticks stands still, but for the part of the width that holds it. Elements are advanced in place.
 * 0, RTHYB_E_MOTION, or RTHYB_E_LIMIT when it ran off. */
int rthyb_simulate_body(const rthyb_body_model *model, rthyb_element *elements,
                        size_t element_count, const double *force_n, size_t n, double *x_m,
                        double *v_m_per_s, double *a_m_per_s2);

enum rthyb_iwan_size { RTHYB_IWAN_MAX = 32 };

/* What follows x behind a play of +-half. */
int rthyb_simulate_play(double half_m, const double *x_m, size_t n, double *y_m);
/* Sum of share[j] times an elastic, perfectly plastic displacement that yields at yield_m[j]; count
 * up to RTHYB_IWAN_MAX, else RTHYB_E_ELEMENT. */
int rthyb_simulate_iwan(const double *yield_m, const double *share, size_t count, const double *x_m,
                        size_t n, double *force);
/* cffi: end */

#endif
