/* One sample of the controller (controller.c). */
#ifndef RTHYB_PART_CONTROLLER_H
#define RTHYB_PART_CONTROLLER_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_kernels.h"
#include "rthyb_law.h"
#include "rthyb_numerical.h"
#include "rthyb_rig.h"

/* cffi: begin */

typedef struct {
    double period_s;
    int32_t lead_enabled; /* 0: what the law leads by does not reach the command */
    rthyb_law_config law;
    rthyb_rfc_config rfc;
    rthyb_motion_config motion;
    rthyb_numerical
        numerical; /* another kind than `motion`, which then only says PRESCRIBED or not */
    double x_range_m, f_range_n; /* a reading beyond its sensor's range is not taken; 0 = off */
    double velocity_limit_m_per_s, acceleration_limit_m_per_s2; /* 0 = off */
    double clamp_m; /* the command never leaves clamp_centre_m +-clamp_m; 0 = off */
    double clamp_centre_m;
    int32_t estimate_held; /* what the law has learnt stays as it is */
} rthyb_controller_config;

typedef struct {
    rthyb_controller_config cfg;
    rthyb_law law;
    rthyb_rfc rfc;
    rthyb_motion motion;
    int32_t behind;    /* the numerical part has answered and has the rest of that step to do */
    int32_t late_code; /* status bits of that rest, for the next record */
    uint64_t tick;
    double x_num, x_plc, x_cmd; /* commands for t_n */
    double x_cmd1;              /* command for t_{n-1} */
    double x_lim, step;         /* command that left last, and its way from the one that left before
                                 * it: as the limiter had them, before the wire rounded */
    double x_lim1, step1;       /* the same before this sample, should its command not leave */
    uint32_t freeze_after, extrapolate_until; /* lost samples in a row: 2.9 ms, 19.5 ms */
    double lower_m, upper_m;                  /* the command may be no further out than these now */
    int32_t gap;                              /* a tick since then in which none left */
    double x_m1, f1, x_num1;
    double energy_error, tracking_indicator;
    uint32_t missing; /* samples in a row without an accepted pair */
    uint32_t generation;
    int32_t state;
} rthyb_controller;

typedef struct {
    double x_meas_m;
    double f_meas_n;
    double excitation; /* ag_mps2 of t_n; PRESCRIBED: x_num_m of t_{n+1} */
    int32_t lost;      /* 0, or why there is no pair: RTHYB_LOST, or the bits that refused it */
} rthyb_input;

int rthyb_controller_init(rthyb_controller *controller, const rthyb_controller_config *cfg);
/* Fills the record of tick n; controller->x_cmd is then the command for t_{n+1}. */
int rthyb_controller_step(rthyb_controller *controller, const rthyb_input *input,
                          rthyb_record *record);
/* What a sample has left to do once its command is known; rthyb_controller_step has done it. */
void rthyb_controller_advance(rthyb_controller *controller);

/* The bare controller at a virtual rig, without states or limits: for studies of the control alone.
 * excitation[n] for n_total samples; runs ticks until count more records are written or a value is not
 * finite. Returns the number of records written; *status has all bits seen. */
size_t rthyb_run_virtual(rthyb_controller *controller, rthyb_rig *rig, const double *excitation,
                         size_t n_total, size_t count, rthyb_record *records, int32_t *status);
/* The numerical structure and the specimen joined without actuator or sensor: the reference.
 * elements are advanced in place. Returns RTHYB_OK or the status bits seen; with too many elements
 * RTHYB_S_OUT_OF_RANGE at once. Mass belongs into added_mass_kg: an inertia element here has the
 * acceleration of the step before. */
int rthyb_run_reference(rthyb_motion *motion, rthyb_element *elements, size_t element_count,
                        const double *ag_mps2, size_t n, double *x_m, double *v_m_per_s,
                        double *force_n);
/* The same with a numerical part of any kind, and of its period; what is known of the specimen's mass
 * and damping belongs into the part's own. all_m: what the part reports at each instant, `freedoms`
 * values, n rows of them. RTHYB_S_OUT_OF_RANGE at once for a part with more than one interface. */
int rthyb_numerical_reference(const rthyb_numerical *part, rthyb_element *elements,
                              size_t element_count, const double *ag_mps2, size_t n,
                              double period_s, double *x_m, double *v_m_per_s, double *force_n,
                              double *all_m, size_t freedoms);
/* cffi: end */

#endif
