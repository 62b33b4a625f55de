/* Preloaded: counts what one thread asks of the allocator. The thread's pthread_t is written into
 * counting_thread by whoever wants to know; 0: nobody is watched. */
#define _GNU_SOURCE
#include <pthread.h>

#include "../counted_allocator.h"

uint64_t counting_thread, counting_allocations;

static void note_allocation(void)
{
    if (__atomic_load_n(&counting_thread, __ATOMIC_RELAXED) == (uint64_t)pthread_self())
        __atomic_fetch_add(&counting_allocations, 1, __ATOMIC_RELAXED);
}
