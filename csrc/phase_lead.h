/* Common part of the laws paper, robust and alpha-beta: the compensator of Eqn 2.5 with its curvature term (plc.c),
 * which uses estimates of alpha and beta (delay_estimator.c). */
#ifndef RTHYB_PHASE_LEAD_H
#define RTHYB_PHASE_LEAD_H

#include "control_law.h"

typedef struct {
    rthyb_estimator estimator;
    rthyb_plc plc;
    double alpha, beta; /* as used by the compensator: bounded and rate-limited */
} rthyb_phase_lead;

/* Common parameters; the tables of all three laws begin with them, in this order. */
enum {
    LEAD_W1,
    LEAD_W2,
    LEAD_ALPHA0,
    LEAD_BETA0,
    LEAD_ALPHA_MIN,
    LEAD_ALPHA_MAX,
    LEAD_REFERENCE,
    LEAD_OWN /* first parameter specific to a law */
};

/* clang-format off */
#define LEAD_ROLL_OFF "identified.roll_off_hz"
#define LEAD_PARAMETERS                                                                            \
    {"w1", "", -1e3, 1e3, 3.0, "the weighting W1 (Eqn 2.3)", 0, LEAD_ROLL_OFF, NULL},              \
    {"w2", "", -1e3, 1e3, 2.0, "the weighting W2 (Eqn 2.3)", 0, LEAD_ROLL_OFF, NULL},              \
    {"alpha0", "samples", 0.0, 1000.0, NAN, "the initial delay", 0, "identified.alpha", NULL},     \
    {"beta0", "", -5e5, 5e5, 0.0, "the initial curvature term", 0, LEAD_ROLL_OFF, NULL},                    \
    {"delay_estimator.alpha_min", "samples", 0.0, 1000.0, 0.0, "the smallest delay", 0, NULL, NULL}, \
    {"delay_estimator.alpha_max", "samples", 0.0, 1000.0, 60.0, "the largest delay", 0, NULL, NULL}, \
    {"delay_estimator.reference_displacement_m", "m", 1e-6, 10.0, 1e-3,                            \
     "the reference displacement of the normalisation", 0, NULL, NULL}
#define LEAD_FILTER_PARAMETERS                                                                     \
    {"delay_estimator.cutoff_hz", "Hz", 0.5, 400.0, 25.0, "the cut-off of the filter pair", 0, LEAD_ROLL_OFF, NULL}, \
    {"delay_estimator.gate_factor", "", 0.0, 1e6, 10.0,                                            \
     "the ratio of power to noise at rest that opens the gate", 0, NULL, NULL}
/* clang-format on */

#define LEAD_VALUES                                                                                \
    {                                                                                              \
        {"alpha", "samples", "delay estimate", offsetof(rthyb_phase_lead, alpha)},                 \
        {                                                                                          \
            "beta", "samples²", "curvature term", offsetof(rthyb_phase_lead, beta)                 \
        }                                                                                          \
    }

int rthyb_lead_check(const double *p, double period_s, rthyb_law_complaint *why);
/* For laws with the filter pair, whose cut-off is the second parameter specific to the law. */
int rthyb_lead_check_filtered(const double *p, double period_s, rthyb_law_complaint *why);
/* Settings of the estimator from the common parameters, at this rate; the caller sets law, memory and filter. gain: as
 * in the table, per sample of 1/1024 s. */
rthyb_estimator_config rthyb_lead_settings(const rthyb_law_start *start, double gain);
int rthyb_lead_init(rthyb_phase_lead *lead, const rthyb_estimator_config *cfg,
                    const rthyb_law_start *start);

void rthyb_lead_rest(void *state, double x_m);
int rthyb_lead_observe(void *state, double x_p_m, double x_m_m, int frozen);
int rthyb_lead_lead(void *state, double x_c_m, double allowed_m, double *x_p_m);

#endif
