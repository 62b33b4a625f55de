/* Command and measured displacement after identical low-pass filters, from which laws identify their parameters. */
#ifndef RTHYB_FILTER_PAIR_H
#define RTHYB_FILTER_PAIR_H

#include "control_law.h"
#include "lowpass.h"

#define RTHYB_PAIR_SECTIONS 3 /* largest number of sections: sixth order */

typedef struct {
    rthyb_lowpass filter[RTHYB_PAIR_SECTIONS];
    double state_u[RTHYB_PAIR_SECTIONS][2], state_m[RTHYB_PAIR_SECTIONS][2];
    double last_u, last_m; /* last valid inputs */
    int32_t sections;
    int32_t primed; /* a pair has been processed */
} rthyb_filter_pair;

static inline void rthyb_pair_init(rthyb_filter_pair *s, int sections, double cutoff_hz, double h,
                                   double x0_m)
{
    *s = (rthyb_filter_pair){.sections = sections, .last_u = x0_m, .last_m = x0_m};
    butterworth_design(s->filter, sections, cutoff_hz, h);
}

/* Filters a pair. The filters start at rest at the first pair. Returns the status bits of the pair. */
static inline int rthyb_pair_step(rthyb_filter_pair *s, double x_p_m, double x_m_m, double *u,
                                  double *m)
{
    int code = RTHYB_OK;
    s->last_u = accept(x_p_m, RTHYB_DISPLACEMENT_MAX_M, s->last_u, &code);
    s->last_m = accept(x_m_m, RTHYB_DISPLACEMENT_MAX_M, s->last_m, &code);
    if (!s->primed) {
        butterworth_rest(s->filter, s->sections, s->state_u, s->last_u);
        butterworth_rest(s->filter, s->sections, s->state_m, s->last_m);
        s->primed = 1;
    }
    *u = butterworth_step(s->filter, s->sections, s->state_u, s->last_u);
    *m = butterworth_step(s->filter, s->sections, s->state_m, s->last_m);
    return code;
}

#endif
