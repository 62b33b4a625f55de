/* Comparison of the drives' sample counts.
 *
 * If the drives share one clock, the difference of two counts is constant, except that a sample may
 * arrive just before or just after its tick. So it may change by one. It is compared with the
 * difference in the first ticks for as long as the drives respond, also at rest: two clocks that
 * differ by 20 ppm are one sample apart after a minute, which no shorter observation would
 * reveal. */
#include "abreast.h"

#include <stdlib.h>
#include <string.h>

enum { MOST = RTHYB_COUPLED_MAX };

void abreast_forget(abreast *known)
{
    memset(known, 0, sizeof *known);
}

/* Majority vote of Boyer and Moore (1981): the difference that occurs in more than half of the
 * ticks remains, without a list of them. */
static void vote(abreast *known, int axis, int64_t relative)
{
    if (known->votes[axis] == 0)
        known->relative[axis] = relative;
    known->votes[axis] += relative == known->relative[axis] ? 1 : -1;
}

static int farthest(int n, const int64_t *away)
{
    int most = 0;
    for (int i = 1; i < n; i++)
        if (llabs(away[i]) > llabs(away[most]))
            most = i;
    return most;
}

/* If two counts differ, either may be the wrong one. It is the one that has just changed its offset
 * from the ticks; if all drift slowly, it is the one that has drifted farthest from the ticks. */
static int which_drifted(const abreast *known, int n, const uint64_t *counts, uint64_t tick,
                         const int64_t *usual)
{
    int64_t lately[MOST] = {0}, ever[MOST] = {0};
    for (int i = 0; i < n; i++) {
        const int64_t own = (int64_t)(counts[i] - tick);
        lately[i] = own - usual[i];
        ever[i] = own - known->beginning[i];
    }
    const int one = farthest(n, lately);
    return llabs(lately[one]) > 1 ? one : farthest(n, ever);
}

int32_t abreast_compare(abreast *known, int n, const uint64_t *counts, uint64_t tick,
                        const int64_t *usual)
{
    int64_t least = 0, most = 0;
    for (int i = 0; i < n && known->ticks == 0; i++)
        known->beginning[i] = (int64_t)(counts[i] - tick);
    for (int i = 1; i < n; i++) {
        const int64_t relative = (int64_t)(counts[i] - counts[0]);
        if (known->ticks < ABREAST_TICKS)
            vote(known, i, relative);
        const int64_t ahead = relative - known->relative[i];
        least = ahead < least ? ahead : least;
        most = ahead > most ? ahead : most;
    }
    known->ticks += known->ticks < ABREAST_TICKS;
    if (known->ticks < ABREAST_TICKS)
        return RTHYB_APART_UNKNOWN;
    return most - least > 1 ? 1 + which_drifted(known, n, counts, tick, usual) : 0;
}
