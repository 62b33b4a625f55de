/* A thread with the timing of a tick and nothing to do: its delays are due to the machine.
 *
 *   reference T0_NS TICKS PRIORITY CPU      prints "executed skipped longest_ns p50_ns p99_ns
 * fifo" */
#include <stdio.h>
#include <stdlib.h>

#include "rthyb.h"

int main(int argc, char **argv)
{
    static rthyb_ticker ticker;
    rthyb_tick tick;
    if (argc != 5)
        return 2;
    const long long t0_ns = strtoll(argv[1], NULL, 10);
    const unsigned long long ticks = strtoull(argv[2], NULL, 10);
    const uint32_t got = rthyb_thread_become_real_time(
        (int32_t)strtol(argv[3], NULL, 10), (int32_t)strtol(argv[4], NULL, 10), -1, 65536);
    if (rthyb_ticker_init(&ticker, RTHYB_CLOCK_HOST, 1024, t0_ns))
        return 2;
    while (ticker.elapsed < ticks && rthyb_ticker_wait(&ticker, &tick))
        ;
    printf("%llu %llu %llu %llu %llu %d\n", (unsigned long long)ticker.executed,
           (unsigned long long)ticker.skipped, (unsigned long long)ticker.wake.max_ns,
           (unsigned long long)rthyb_latency_percentile(&ticker.wake, 0.5),
           (unsigned long long)rthyb_latency_percentile(&ticker.wake, 0.99),
           (got & RTHYB_P_FIFO) != 0);
    return 0;
}
