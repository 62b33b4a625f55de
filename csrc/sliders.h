/* Dry friction between degrees of freedom, solved together with the step (sliders.c). */
#ifndef RTHYB_SLIDERS_H
#define RTHYB_SLIDERS_H

#include "laws.h"
#include "rthyb_sparse.h"

/* The sliders of a part, and where their state is. Each array has one value per slider, `inverse` one per pair. */
typedef struct {
    int32_t count;
    const rthyb_joint *joint;
    const int32_t *which; /* indices of joints */
    const double *g;
    double *free;       /* velocity without friction, r */
    double *left;       /* r - u - G f: what is not solved yet */
    double *compliance; /* C in the inverse */
    double *inverse;    /* (C + G)^-1 */
    rthyb_friction_point *at;
} sliders;

/* Whether the sliders of a part are complete and consistent. */
int sliders_ok(const rthyb_sparse_config *cfg);
/* Size of their state. */
size_t sliders_numbers(const rthyb_sparse_config *cfg);
sliders sliders_at(const rthyb_sparse_config *cfg, double *memory);
/* At rest, without force. */
void sliders_start(const sliders *s);
/* Solves u + G f(u) = free, beginning with what is there. */
void sliders_settle(const sliders *s, const double *free_m_per_s);
/* The same, and prepares sliders_answer. */
void sliders_predict(const sliders *s, const double *free_m_per_s);
/* The same between force and command: begins with what sliders_predict has found for another `free`, with limited
 * work. */
rthyb_friction_effort sliders_answer(const sliders *s, const double *free_m_per_s);

#endif
