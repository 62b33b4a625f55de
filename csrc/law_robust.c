/* Phase lead (Eqn 2.5) with the delay estimated by the gradient law, extended by filter pair, gate,
 * projection and power normalisation. */
#include "phase_lead.h"

typedef rthyb_phase_lead robust_state;

static const rthyb_law_parameter robust_parameters[] = {
    LEAD_PARAMETERS,
    {"delay_estimator.rate_per_sample", "", 0.0, 1.0, 0.002, "the rate of adaptation per sample", 0,
     NULL, "rate {} per sample"},
    LEAD_FILTER_PARAMETERS,
};

static const rthyb_law_value robust_values[] = LEAD_VALUES;

static int robust_init(void *state, const rthyb_law_start *start)
{
    const double *own = start->parameters + LEAD_OWN;
    rthyb_estimator_config cfg = rthyb_lead_settings(start, own[0]);
    cfg.law = RTHYB_LAW_ROBUST;
    cfg.cutoff_hz = own[1];
    cfg.gate_factor = own[2];
    return rthyb_lead_init(state, &cfg, start);
}

static const rthyb_control_law robust = {
    .is = {.name = "robust",
           .meaning = "phase lead that adapts the delay to motion, not to noise",
           .calmer = "lower controller.delay_estimator.rate_per_sample, or raise its gate_factor",
           .parameters = robust_parameters,
           .parameter_count = RTHYB_COUNT(robust_parameters),
           .values = robust_values,
           .value_count = RTHYB_COUNT(robust_values),
           .uses_rest_noise = 1,
           .with_rfc = 1},
    .state_size = sizeof(robust_state),
    .check = rthyb_lead_check_filtered,
    .init = robust_init,
    .rest = rthyb_lead_rest,
    .observe = rthyb_lead_observe,
    .lead = rthyb_lead_lead,
};

RTHYB_LAW(robust);
