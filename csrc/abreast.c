/* The drives' counts against one another.
 *
 * On one clock the difference of two counts stays what it was, but for the sample that falls now before its tick
 * and now behind it. So it may change by one. It is compared with that of the first ticks for as long as the
 * drives are heard, at rest too: two clocks that differ by 20 ppm are a sample apart within a minute, and no
 * shorter look would find them. */
#include "abreast.h"

#include <stdlib.h>
#include <string.h>

enum { MOST = RTHYB_COUPLED_MAX };

void abreast_forget(abreast *known)
{
    memset(known, 0, sizeof *known);
}

/* Majority vote of Boyer and Moore (1981): the difference that more than half of the ticks have is the one that
 * is left, without a list of them. */
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

/* Of two counts that part either may be the wrong one. The one that has just left its place among the ticks is;
 * where all of them creep, the one that has crept farthest from the ticks. */
static int who_left(const abreast *known, int n, const uint64_t *counts, uint64_t tick,
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
    return most - least > 1 ? 1 + who_left(known, n, counts, tick, usual) : 0;
}
