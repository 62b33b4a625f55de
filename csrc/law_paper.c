/* Chen & Tsai (15WCEE 2012): phase lead (Eqn 2.5) with the delay estimated by the gradient law of
 * Eqn 2.6-2.11, as printed. */
#include "phase_lead.h"

typedef rthyb_phase_lead paper_state;

static const rthyb_law_parameter paper_parameters[] = {
    LEAD_PARAMETERS,
    {"delay_estimator.gain_per_mm2_per_sample", "", 0.0, 1e3, 0.03,
     "the adaptive gain gamma (Eqn 2.11)", 0, NULL, "γ = {} per mm² per sample"},
};

static const rthyb_law_value paper_values[] = LEAD_VALUES;

static int paper_init(void *state, const rthyb_law_start *start)
{
    const double *own = start->parameters + LEAD_OWN;
    /* The gain of the test file is per mm^2, that of the estimator per reference^2. */
    const double mm = start->parameters[LEAD_REFERENCE] / 1e-3;
    rthyb_estimator_config cfg = rthyb_lead_settings(start, own[0] * (mm * mm));
    cfg.law = RTHYB_LAW_GRADIENT;
    return rthyb_lead_init(state, &cfg, start);
}

static const rthyb_control_law paper = {
    .is = {.name = "paper",
           .meaning = "phase lead with the adaptive delay of the paper, as printed",
           .calmer =
               "lower controller.delay_estimator.gain_per_mm2_per_sample, or set controller.type = "
               "\"robust\", which does not learn from noise",
           .parameters = paper_parameters,
           .parameter_count = RTHYB_COUNT(paper_parameters),
           .values = paper_values,
           .value_count = RTHYB_COUNT(paper_values),
           .with_rfc = 1,
           .as_printed = 1},
    .state_size = sizeof(paper_state),
    .check = rthyb_lead_check,
    .init = paper_init,
    .rest = rthyb_lead_rest,
    .observe = rthyb_lead_observe,
    .lead = rthyb_lead_lead,
};

RTHYB_LAW(paper);
