/* One sample of the controller (controller.c). */
#ifndef RTHYB_PART_CONTROLLER_H
#define RTHYB_PART_CONTROLLER_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_kernels.h"
#include "rthyb_kinematics.h"
#include "rthyb_law.h"
#include "rthyb_matrix_lead.h"
#include "rthyb_matrix_rfc.h"
#include "rthyb_numerical.h"
#include "rthyb_rig.h"

/* cffi: begin */

/* What leads the command of an axis, and where that ends. */
typedef struct {
    rthyb_law_config law;
    double x_range_m, f_range_n; /* a reading beyond its sensor's range is not taken; 0 = off */
    double velocity_limit_m_per_s, acceleration_limit_m_per_s2; /* 0 = off */
    double clamp_m; /* the command stays within clamp_centre_m +-clamp_m; 0 = off */
    double clamp_centre_m;
} rthyb_axis_control;

/* Axes that act on one specimen, and the coordinates that the numerical part and they meet in: displacements
 * asked for, forces given back. Both counts are 1 to RTHYB_COUPLED_MAX. */
typedef struct {
    double period_s;
    int32_t axis_count, interface_count;
    int32_t lead_enabled;  /* 0: what the laws lead by does not reach the commands */
    int32_t estimate_held; /* what the laws have learnt stays as it is */
    rthyb_motion_config motion;
    rthyb_numerical
        numerical; /* another kind than `motion`, which then only says PRESCRIBED or not */
    rthyb_axis_control axis[RTHYB_COUPLED_MAX];
    /* Of several axes: along an interface their commands stay within +- this; 0 = off. */
    double direction_clamp[RTHYB_COUPLED_MAX];
    rthyb_rfc_config rfc[RTHYB_COUPLED_MAX]; /* of each interface */
    rthyb_kinematics_config kinematics;      /* size 0: axis i is interface i */
    rthyb_matrix_lead_config matrix_lead;    /* in place of the laws; size 0: none */
    rthyb_matrix_rfc_config matrix_rfc;      /* in place of rfc; size 0: none */
} rthyb_controller_config;

/* How the limiter goes on with one axis (limiter.c). */
typedef struct {
    double x_lim,
        step; /* command that left last, and its way from the one that left before it: as the
               * limiter had them, before the wire rounded */
    double x_lim1, step1;    /* the same before this sample, should its command not leave */
    double lower_m, upper_m; /* the command may be no further out than these now */
    int32_t gap;             /* a tick since then in which none left */
} rthyb_limiter;

typedef struct {
    double target, target1; /* displacement asked of it for t_n, and for t_{n-1} */
    double x_plc, x_plc1;   /* the same, led */
    double x_cmd, x_cmd1;   /* and as it leaves */
    double x_m1, f1;        /* of t_{n-1}, measured or made up */
    uint32_t missing;       /* samples in a row without an accepted pair of its own */
    rthyb_limiter limiter;
    rthyb_law law;
} rthyb_controller_axis;

typedef struct {
    double x_num, x_num1; /* displacement asked of the specimen for t_n, and for t_{n-1} */
    double x_m, f;        /* measured, as the kinematics has them */
    rthyb_rfc rfc;
} rthyb_controller_interface;

typedef struct {
    rthyb_controller_config cfg;
    rthyb_motion motion;
    int32_t behind;    /* the numerical part has answered but not completed the step */
    int32_t late_code; /* status bits from completing the step, for the next record */
    uint64_t tick;
    uint32_t freeze_after, extrapolate_until; /* lost samples in a row: 2.9 ms, 19.5 ms */
    double energy_error, tracking_indicator;  /* sums over the axes */
    uint32_t missing; /* samples in a row in which not every axis had an accepted pair */
    uint32_t generation;
    int32_t state;
    int32_t at_direction; /* the commands stand at what they may come to along an interface */
    int32_t posed; /* 0: at rest where the specimen has no pose; each axis stays where it is */
    /* From here on only what is counted, or set up, is ever touched. */
    rthyb_controller_axis axis[RTHYB_COUPLED_MAX];
    rthyb_controller_interface interface[RTHYB_COUPLED_MAX];
    rthyb_kinematics kinematics;
    rthyb_matrix_lead matrix_lead;
    rthyb_matrix_rfc matrix_rfc;
} rthyb_controller;

/* Of one axis. */
typedef struct {
    double x_meas_m, f_meas_n;
    int32_t lost; /* 0, or why there is no pair: RTHYB_LOST, or the bits that refused it */
} rthyb_pair;

typedef struct {
    rthyb_pair axis[RTHYB_COUPLED_MAX];
    double excitation; /* ag_mps2 of t_n; PRESCRIBED: x_num_m of t_{n+1} */
} rthyb_input;

/* RTHYB_E_KINEMATICS where axes and interfaces do not belong together. */
int rthyb_controller_init(rthyb_controller *controller, const rthyb_controller_config *cfg);
/* Fills the record of tick n; controller->axis[i].x_cmd is then the command for t_{n+1}. A pair that one axis
 * lacks is made up for all of them. */
int rthyb_controller_step(rthyb_controller *controller, const rthyb_input *input,
                          rthyb_record *record);
/* Completes a sample once its command is known; rthyb_controller_step includes it. */
void rthyb_controller_advance(rthyb_controller *controller);

/* The bare controller of one axis at a virtual rig, without states or limits: for studies of the control
 * alone. rows: of one axis. excitation[n] for n_total samples; runs ticks until count more records are written or a value is not
 * finite. Returns the number of records written; *status has all bits seen. */
size_t rthyb_run_virtual(rthyb_controller *controller, rthyb_rig *rig, const double *excitation,
                         size_t n_total, size_t count, void *rows, int32_t *status);
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
