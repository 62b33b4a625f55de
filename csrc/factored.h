/* Solution with a factored matrix, by panels of columns with entries in the same rows (factored.c). */
#ifndef RTHYB_FACTORED_H
#define RTHYB_FACTORED_H

#include "rthyb_sparse.h"

/* Whether panel[0] = 0 < panel[1] < ... < panel[panels] = n are valid panels of l; 0 panels are always valid. */
int panels_ok(const rthyb_symmetric *l, int32_t n, const int32_t *panel, int32_t panels);
/* y = (L D L')^-1 y, in place; column by column if there are no panels. */
void factored_solve(const rthyb_symmetric *l, int32_t n, const int32_t *panel, int32_t panels,
                    double *y);

#endif
