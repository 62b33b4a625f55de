/* Preloaded library: counts the allocator calls of one thread. The program that evaluates the count
 * writes the pthread_t of that thread into counting_thread; 0: no thread is counted. */
#define _GNU_SOURCE
#include <pthread.h>

#include "../counted_allocator.h"

uint64_t counting_thread, counting_allocations;

static void note_allocation(void)
{
    if (__atomic_load_n(&counting_thread, __ATOMIC_RELAXED) == (uint64_t)pthread_self())
        __atomic_fetch_add(&counting_allocations, 1, __ATOMIC_RELAXED);
}
