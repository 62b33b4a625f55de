/* Preloaded library: counts the allocator calls of one thread. The program that evaluates the count
 * writes the kernel's id of that thread into counting_thread; 0: no thread is counted. */
#define _GNU_SOURCE
#include <unistd.h>

#include "../counted_allocator.h"

uint64_t counting_thread, counting_allocations;

static void note_allocation(void)
{
    uint64_t thread = __atomic_load_n(&counting_thread, __ATOMIC_RELAXED);
    if (thread && thread == (uint64_t)gettid())
        __atomic_fetch_add(&counting_allocations, 1, __ATOMIC_RELAXED);
}
