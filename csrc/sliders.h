/* Dry friction between degrees of freedom, solved together with the step (sliders.c). */
#ifndef RTHYB_SLIDERS_H
#define RTHYB_SLIDERS_H

#include "rthyb_sparse.h"

/* Whether the sliders of a part are complete and consistent. */
int sliders_ok(const rthyb_sparse_config *cfg);
/* Solves u + G f(u) = velocity for the forces f, beginning with those that are there, in at most `sweeps` passes over
 * the sliders. force_n: of all joints; only those of sliders are used and replaced. */
void sliders_settle(const rthyb_sparse_config *cfg, const double *velocity_m_per_s, int sweeps,
                    double *force_n);

#endif
