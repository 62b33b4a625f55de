/* Numbers with one writer and any number of readers; no thread waits. */
#ifndef RTHYB_RELAXED_H
#define RTHYB_RELAXED_H

#include <stdint.h>

static inline uint64_t peek(const uint64_t *number)
{
    return __atomic_load_n(number, __ATOMIC_RELAXED);
}

/* NOLINTNEXTLINE(readability-non-const-parameter): the store is a builtin */
static inline void put(uint64_t *number, uint64_t value)
{
    __atomic_store_n(number, value, __ATOMIC_RELAXED);
}

static inline int64_t peek_signed(const int64_t *number)
{
    return __atomic_load_n(number, __ATOMIC_RELAXED);
}

/* NOLINTNEXTLINE(readability-non-const-parameter): the store is a builtin */
static inline void put_signed(int64_t *number, int64_t value)
{
    __atomic_store_n(number, value, __ATOMIC_RELAXED);
}

/* For the writer only, because load and store are not one atomic operation. */
static inline void add(uint64_t *number, uint64_t more)
{
    put(number, peek(number) + more);
}

static inline void raise_to(uint64_t *number, uint64_t value)
{
    if (value > peek(number))
        put(number, value);
}

#endif
