/* Histogram of latencies: fixed size, constant time, readable while it is written. */
#include "relaxed.h"
#include "rthyb.h"

#define SUB_BITS 5 /* 32 buckets per doubling */
#define SUBS (1u << SUB_BITS)
#define TOP_BIT 36 /* 2^36 ns and above overflow */

static uint32_t bucket_of(uint64_t ns)
{
    if (ns < SUBS)
        return (uint32_t)ns;
    const uint32_t bit = 63u - (uint32_t)__builtin_clzll(ns);
    if (bit >= TOP_BIT)
        return RTHYB_LATENCY_BUCKETS;
    return ((bit - SUB_BITS + 1u) << SUB_BITS) + (uint32_t)((ns >> (bit - SUB_BITS)) & (SUBS - 1u));
}

uint64_t rthyb_latency_edge_ns(uint32_t bucket)
{
    if (bucket < SUBS)
        return bucket;
    const uint32_t doubling = (bucket >> SUB_BITS) - 1u;
    return (uint64_t)(SUBS + (bucket & (SUBS - 1u))) << doubling;
}

void rthyb_latency_record(rthyb_latency *latency, int64_t ns)
{
    const uint64_t time_ns = ns > 0 ? (uint64_t)ns : 0u;
    add(&latency->bucket[bucket_of(time_ns)], 1u);
    add(&latency->count, 1u);
    add(&latency->sum_ns, time_ns);
    raise_to(&latency->max_ns, time_ns);
}

/* The sum of the buckets: `count` may differ from it by one while another thread records. */
static uint64_t recorded(const rthyb_latency *latency)
{
    uint64_t total = 0;
    for (uint32_t i = 0; i <= RTHYB_LATENCY_BUCKETS; i++)
        total += peek(&latency->bucket[i]);
    return total;
}

/* How many of `total` values do not exceed the quantile of this fraction; at least 1. */
static uint64_t rank_of(double fraction, uint64_t total)
{
    const double share = fraction * (double)total;
    if (!(share > 1.0))
        return 1;
    const uint64_t whole = share < (double)total ? (uint64_t)share : total;
    return (double)whole < share && whole < total ? whole + 1u : whole;
}

uint64_t rthyb_latency_percentile(const rthyb_latency *latency, double fraction)
{
    const uint64_t total = recorded(latency), max_ns = peek(&latency->max_ns);
    if (total == 0)
        return 0;
    const uint64_t rank = rank_of(fraction, total);
    uint64_t below = 0;
    for (uint32_t i = 0; i < RTHYB_LATENCY_BUCKETS; i++) {
        below += peek(&latency->bucket[i]);
        if (below >= rank) {
            const uint64_t longest = rthyb_latency_edge_ns(i + 1u) - 1u;
            return longest < max_ns ? longest : max_ns;
        }
    }
    return max_ns;
}

void rthyb_latency_merge(rthyb_latency *into, const rthyb_latency *from)
{
    for (uint32_t i = 0; i <= RTHYB_LATENCY_BUCKETS; i++)
        add(&into->bucket[i], peek(&from->bucket[i]));
    add(&into->count, peek(&from->count));
    add(&into->sum_ns, peek(&from->sum_ns));
    raise_to(&into->max_ns, peek(&from->max_ns));
}
