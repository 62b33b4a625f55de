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

/* How the command of an axis is compensated and limited. */
typedef struct {
    rthyb_law_config law;
    double x_range_m, f_range_n; /* a reading beyond its sensor's range is rejected; 0 = off */
    double velocity_limit_m_per_s, acceleration_limit_m_per_s2; /* 0 = off */
    double clamp_m; /* the command stays within clamp_centre_m +-clamp_m; 0 = off */
    double clamp_centre_m;
} rthyb_axis_control;

/* Axes that act on one specimen, and the interface coordinates that connect them to the numerical part:
 * commands in one direction, forces in the other. Both counts are 1 to RTHYB_COUPLED_MAX, and there are no more
 * interfaces than axes. */
typedef struct {
    double period_s;
    int32_t axis_count, interface_count;
    int32_t lead_enabled;  /* 0: commands are not compensated; the laws still run */
    int32_t estimate_held; /* not 0: the laws do not adapt */
    rthyb_motion_config motion;
    /* If it is of another kind than RTHYB_NUMERICAL_MOTION, it is used instead of `motion`, unless that is
     * PRESCRIBED. */
    rthyb_numerical numerical;
    rthyb_axis_control axis[RTHYB_COUPLED_MAX];
    /* With several axes: bound, +-, on the command in each interface coordinate; 0 = off. */
    double direction_clamp[RTHYB_COUPLED_MAX];
    rthyb_rfc_config rfc[RTHYB_COUPLED_MAX]; /* for each interface */
    rthyb_kinematics_config kinematics;      /* size 0: axis i is interface i */
    /* replaces the laws; size 0: none; only if there are as many interfaces as axes */
    rthyb_matrix_lead_config matrix_lead;
    rthyb_matrix_rfc_config matrix_rfc; /* replaces rfc; size 0: none */
} rthyb_controller_config;

/* State of the limiter for one axis (limiter.c). */
typedef struct {
    /* x_lim: last command sent; step: its change from the previous one. Both as computed by the limiter, before
     * rounding on the wire. */
    double x_lim, step;
    /* x_lim and step before this sample, to restore them if its command is not sent */
    double x_lim1, step1;
    double lower_m, upper_m; /* current bounds of the command */
    int32_t gap; /* not 0: at least one tick without a command since the last one was sent */
} rthyb_limiter;

typedef struct {
    double target, target1; /* command for t_n, and for t_{n-1} */
    double x_plc, x_plc1;   /* the same after compensation */
    double x_cmd, x_cmd1;   /* the same after limiting: as sent */
    double x_m1, f1;        /* at t_{n-1}, measured or predicted */
    double apart;           /* with redundant actuators: target minus that of the common pose */
    uint32_t missing;       /* consecutive samples in which this axis had no accepted pair */
    rthyb_limiter limiter;
    rthyb_law law;
} rthyb_controller_axis;

typedef struct {
    double x_num, x_num1; /* command for t_n, and for t_{n-1} */
    double x_m, f;        /* measured, as computed by the kinematics */
    rthyb_rfc rfc;
} rthyb_controller_interface;

typedef struct {
    rthyb_controller_config cfg;
    rthyb_motion motion;
    int32_t behind;    /* the numerical part has answered but not completed the step */
    int32_t late_code; /* status bits from completing the step, for the next record */
    uint64_t tick;
    /* in consecutive lost samples, chosen so that they last 2.9 ms and 19.5 ms */
    uint32_t freeze_after, extrapolate_until;
    double energy_error, tracking_indicator; /* sums over the axes */
    uint32_t missing; /* consecutive samples in which at least one axis had no accepted pair */
    uint32_t generation;
    int32_t state;
    int32_t at_direction; /* the command in an interface coordinate is at its bound */
    /* 0: the axes are at positions that correspond to no pose of the specimen, so each axis is held where it is */
    int32_t posed;
    int32_t alone; /* one axis, and neither kinematics nor matrices */
    /* Of the following, only the entries in use, and the parts that were configured, are ever accessed. */
    rthyb_controller_axis axis[RTHYB_COUPLED_MAX];
    rthyb_controller_interface interface[RTHYB_COUPLED_MAX];
    /* Of the sensors without an actuator, displacements, then forces: reading of the last sample, measured or
     * predicted, and consecutive samples without an accepted reading. */
    double sensor[RTHYB_SENSORS_ALL];
    uint32_t sensor_missing[RTHYB_SENSORS_ALL];
    rthyb_kinematics kinematics;
    rthyb_matrix_lead matrix_lead;
    rthyb_matrix_rfc matrix_rfc;
} rthyb_controller;

/* Readings of one axis. */
typedef struct {
    double x_meas_m, f_meas_n;
    /* 0, or why there is no pair: RTHYB_LOST, or the status bits for which it was rejected */
    int32_t lost;
} rthyb_pair;

typedef struct {
    rthyb_pair axis[RTHYB_COUPLED_MAX];
    /* of the sensors without an actuator; lost: as in rthyb_pair */
    double sensor[RTHYB_SENSORS_ALL];
    int32_t sensor_lost[RTHYB_SENSORS_ALL];
    double excitation; /* ag_mps2 at t_n; PRESCRIBED: x_num_m at t_{n+1} */
} rthyb_input;

/* RTHYB_E_KINEMATICS if axes and interfaces do not match. */
int rthyb_controller_init(rthyb_controller *controller, const rthyb_controller_config *cfg);
/* Fills the record of tick n; controller->axis[i].x_cmd is then the command for t_{n+1}. If the pair of one axis
 * is missing, the pairs of all axes are predicted. */
int rthyb_controller_step(rthyb_controller *controller, const rthyb_input *input,
                          rthyb_record *record);
/* Completes a sample after its command is known; rthyb_controller_step includes this. */
void rthyb_controller_advance(rthyb_controller *controller);

/* Runs the controller of one axis with a virtual rig, without the station's states and limits, for studies of the
 * control only.
 * rows: records of one axis. excitation: n_total samples. Runs until `count` more records have been written or a
 * value is not finite. Returns the number of records written; *status combines all status bits. */
size_t rthyb_run_virtual(rthyb_controller *controller, rthyb_rig *rig, const double *excitation,
                         size_t n_total, size_t count, void *rows, int32_t *status);
/* Reference simulation: numerical part and specimen, connected without actuator or sensors. Elements are
 * advanced in place. Returns RTHYB_OK or the status bits; RTHYB_S_OUT_OF_RANGE at once if there are too many
 * elements. Enter mass as added_mass_kg, because an inertia element would see the acceleration of the previous
 * step. */
int rthyb_run_reference(rthyb_motion *motion, rthyb_element *elements, size_t element_count,
                        const double *ag_mps2, size_t n, double *x_m, double *v_m_per_s,
                        double *force_n);
/* The same with a numerical part of any kind, at its period. Enter the known mass and damping of the specimen in
 * the part. all_m: n rows of the `freedoms` values that the part reports. RTHYB_S_OUT_OF_RANGE at once for a part
 * with more than one interface. */
int rthyb_numerical_reference(const rthyb_numerical *part, rthyb_element *elements,
                              size_t element_count, const double *ag_mps2, size_t n,
                              double period_s, double *x_m, double *v_m_per_s, double *force_n,
                              double *all_m, size_t freedoms);
/* cffi: end */

#endif
