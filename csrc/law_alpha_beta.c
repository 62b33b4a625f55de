/* Phase lead (Eqn 2.5) with a curvature term; delay and curvature are estimated by recursive least
 * squares. */
#include "phase_lead.h"

typedef rthyb_phase_lead alpha_beta_state;

static const rthyb_law_parameter alpha_beta_parameters[] = {
    LEAD_PARAMETERS,
    {"delay_estimator.memory_s", "s", 0.05, 600.0, 2.0, "the memory of the estimator", 0, NULL,
     "memory {} s"},
    LEAD_FILTER_PARAMETERS,
};

static const rthyb_law_value alpha_beta_values[] = LEAD_VALUES;

static int alpha_beta_init(void *state, const rthyb_law_start *start)
{
    const double *own = start->parameters + LEAD_OWN;
    rthyb_estimator_config cfg = rthyb_lead_settings(start, 0.0);
    cfg.law = RTHYB_LAW_RLS;
    cfg.estimate_beta = 1;
    cfg.memory_samples = own[0] / start->period_s;
    cfg.cutoff_hz = own[1];
    cfg.gate_factor = own[2];
    return rthyb_lead_init(state, &cfg, start);
}

static const rthyb_control_law alpha_beta = {
    .is = {.name = "alpha-beta",
           .meaning = "phase lead with delay and curvature from recursive least squares",
           .calmer = "raise controller.delay_estimator.memory_s",
           .parameters = alpha_beta_parameters,
           .parameter_count = RTHYB_COUNT(alpha_beta_parameters),
           .values = alpha_beta_values,
           .value_count = RTHYB_COUNT(alpha_beta_values),
           .uses_rest_noise = 1,
           .with_rfc = 1,
           .learns_curvature = 1},
    .state_size = sizeof(alpha_beta_state),
    .check = rthyb_lead_check_filtered,
    .init = alpha_beta_init,
    .rest = rthyb_lead_rest,
    .observe = rthyb_lead_observe,
    .lead = rthyb_lead_lead,
};

RTHYB_LAW(alpha_beta);
