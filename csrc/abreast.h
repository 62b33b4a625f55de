/* Whether the drives of several axes count their samples by one clock. */
#ifndef RTHYB_ABREAST_H
#define RTHYB_ABREAST_H

#include "rthyb.h"

enum { ABREAST_TICKS = 64 }; /* with the counts of all axes, before they can be compared */

/* Counts begin anywhere, for drives are switched on one after another. Where each stands against the first axis'
 * is what most of the first ticks say, so that one sample that falls behind its tick decides nothing. */
typedef struct {
    uint32_t ticks;                       /* that had a say, up to ABREAST_TICKS */
    int64_t relative[RTHYB_COUPLED_MAX];  /* to the count of the first axis */
    int32_t votes[RTHYB_COUPLED_MAX];     /* for that, above those against it */
    int64_t beginning[RTHYB_COUPLED_MAX]; /* count - tick when it was heard first */
} abreast;

/* What was known is so no more: a drive was silent for so long that its count may have wrapped, or the station
 * was tripped and begins anew. */
void abreast_forget(abreast *known);
/* One tick with the counts of all n axes; usual: count - tick of each, as most of the last ticks have it. Returns
 * what rthyb_station_input says of it. */
int32_t abreast_compare(abreast *known, int n, const uint64_t *counts, uint64_t tick,
                        const int64_t *usual);

#endif
