/* Tests in virtual time (virtual.c), and the simulators of the diagnosis (simulate.c). */
#ifndef RTHYB_PART_SIMULATION_H
#define RTHYB_PART_SIMULATION_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_plant.h"
#include "rthyb_station.h"

/* cffi: begin */

/* ---- tests in virtual time (virtual.c) --------------------------------------------------------- */

/* Station and virtual rig, tick by tick, without clock and wire. The drives follow at once, use the station's zero,
 * and stop on their own when they receive a trip. */
typedef struct {
    rthyb_station *station;
    rthyb_plant plant;
    const double *ag_mps2; /* ground motion */
    size_t ag_count;
    double stop_decel_m_per_s2;
    /* not 0: the first two channels of each axis are its readings without sensor errors (rthyb_plant_truth)
     * */
    int32_t truth;
    /* number of channels after those with displacements of the numerical part's degrees of freedom */
    int32_t freedoms;
    /* Internal from here on: enum rthyb_drive_phase; current and previous target of each actuator. */
    int32_t phase[RTHYB_COUPLED_MAX];
    double target_m[RTHYB_COUPLED_MAX], target1_m[RTHYB_COUPLED_MAX];
} rthyb_virtual;

/* The caller sets the members up to freedoms; this function sets the rest. Returns 0; RTHYB_E_LIMIT for a
 * deceleration that is not positive, or too many channels; RTHYB_E_PERIOD or RTHYB_E_PLANT if station and rig have
 * different periods or numbers of axes. */
int rthyb_virtual_init(rthyb_virtual *test);
/* Runs up to `count` ticks, the first one with an operator's command (RTHYB_CMD_NONE: none). Each tick writes one row
 * and the first channel_count of its channels. Returns the number of ticks run, which is less than `count` if the
 * state changed or a tare failed. */
size_t rthyb_virtual_run(rthyb_virtual *test, int32_t command, size_t count, void *rows,
                         double *channels, uint32_t channel_count);

/* ---- simulators of the diagnosis (simulate.c) ------------------------------------------------- */

/* gain exp(-s delay) w^2 / (s^2 + 2 zeta w s + w^2), applied to a recorded command. */
typedef struct {
    double period_s;
    double delay_s, natural_frequency_hz, damping_ratio, gain;
    double shift_s; /* shift of the command relative to the rows, in addition to the delay */
    double delay_rate_s2_per_m;    /* change of the delay per m/s */
    double velocity_limit_m_per_s; /* 0 = none */
    int32_t limit_at;              /* the limit applies to 0: the command, 1: the actuator */
    int32_t rate_of; /* delay_rate refers to the velocity of 0: the actuator, 1: the command */
    int32_t hold;    /* RTHYB_ZOH, RTHYB_FOH */
} rthyb_actuator_model;

/* Displacement, velocity and acceleration at the rows, starting at rest at the first command. Up to `row`, which need
 * not be an integer, the actuator is `before`, then `model`; displacement and velocity are continuous there. With row
 * 0, it is `model` throughout; a row beyond either end is that end, and one that is not a number is RTHYB_E_SERVO.
 * Returns 0, RTHYB_E_SERVO, or RTHYB_E_LIMIT if the simulation diverged. */
int rthyb_simulate_actuator(const rthyb_actuator_model *before, const rthyb_actuator_model *model,
                            double row, const double *x_cmd_m, size_t n, double *x_m,
                            double *v_m_per_s, double *a_m_per_s2);

typedef struct {
    double period_s, mass_kg;
    double x0_m, v0_m_per_s;
    int32_t hold; /* interpolation of the force between the rows */
    int32_t substeps;
} rthyb_body_model;

/* mass a + sum of elements = force; second order in the substep. Enter inertia as mass_kg, because elements see the
 * acceleration of the previous substep. Dry friction (coulomb, coulomb_uneven, stribeck) whose width in velocity is
 * too small for explicit integration is solved together with the motion: a sticking body stands still, except for the
 * small velocity within the width that produces the holding force. Elements are advanced in place. Returns 0,
 * RTHYB_E_MOTION, or RTHYB_E_LIMIT if the simulation diverged. */
int rthyb_simulate_body(const rthyb_body_model *model, rthyb_element *elements,
                        size_t element_count, const double *force_n, size_t n, double *x_m,
                        double *v_m_per_s, double *a_m_per_s2);

enum rthyb_iwan_size { RTHYB_IWAN_MAX = 32 };

/* y follows x through a backlash of +-half. */
int rthyb_simulate_play(double half_m, const double *x_m, size_t n, double *y_m);
/* Sum over j of share[j] times the elastic displacement of an elastic-perfectly plastic element that yields at
 * yield_m[j]. RTHYB_E_ELEMENT if count exceeds RTHYB_IWAN_MAX. */
int rthyb_simulate_iwan(const double *yield_m, const double *share, size_t count, const double *x_m,
                        size_t n, double *force);
/* cffi: end */

#endif
