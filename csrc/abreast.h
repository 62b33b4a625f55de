/* Checks that the drives of several axes count their samples on one clock. */
#ifndef RTHYB_ABREAST_H
#define RTHYB_ABREAST_H

#include "rthyb.h"

enum {
    ABREAST_TICKS = 64
}; /* ticks with the counts of all axes that are needed before a comparison */

/* Counts have arbitrary initial values, because drives are switched on at different times. The offset of each count
 * from that of the first axis is determined by majority over the first ticks, so that a single late sample has no
 * effect. */
typedef struct {
    uint32_t ticks;                       /* ticks evaluated so far, up to ABREAST_TICKS */
    int64_t relative[RTHYB_COUPLED_MAX];  /* offset from the count of the first axis */
    int32_t votes[RTHYB_COUPLED_MAX];     /* votes for that offset minus votes against it */
    int64_t beginning[RTHYB_COUPLED_MAX]; /* count - tick when the first count arrived */
} abreast;

/* Discards the offsets: a drive was silent for so long that its count may have wrapped around, or the station starts
 * again after a trip. */
void abreast_forget(abreast *known);
/* Evaluates a tick with the counts of all n axes; usual: count - tick of each axis in most of the recent ticks. Returns
 * the value for rthyb_station_input.apart. */
int32_t abreast_compare(abreast *known, int n, const uint64_t *counts, uint64_t tick,
                        const int64_t *usual);

#endif
