/* Replaces every allocation function of the C library by one that calls note_allocation() first. To
 * be included in one source file of a program. */
#ifndef COUNTED_ALLOCATOR_H
#define COUNTED_ALLOCATOR_H

#include <errno.h>
#include <stddef.h>
#include <stdint.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <unistd.h>

static void note_allocation(void);

void *__libc_malloc(size_t size);
void *__libc_calloc(size_t count, size_t size);
void *__libc_realloc(void *block, size_t size);
void *__libc_memalign(size_t alignment, size_t size);
void __libc_free(void *block);

void *malloc(size_t size)
{
    note_allocation();
    return __libc_malloc(size);
}

void *calloc(size_t count, size_t size)
{
    note_allocation();
    return __libc_calloc(count, size);
}

void *realloc(void *block, size_t size)
{
    note_allocation();
    return __libc_realloc(block, size);
}

void *memalign(size_t alignment, size_t size)
{
    note_allocation();
    return __libc_memalign(alignment, size);
}

void *aligned_alloc(size_t alignment, size_t size)
{
    return memalign(alignment, size);
}

int posix_memalign(void **block, size_t alignment, size_t size)
{
    *block = memalign(alignment, size);
    return *block ? 0 : ENOMEM;
}

/* The C library itself ends every thread with free(NULL), which does nothing. */
void free(void *block)
{
    if (block)
        note_allocation();
    __libc_free(block);
}

void *mmap(void *address, size_t length, int protection, int flags, int file, off_t offset)
{
    note_allocation();
    return (void *)syscall(SYS_mmap, address, length, protection, flags, file, offset);
}

int munmap(void *address, size_t length)
{
    note_allocation();
    return (int)syscall(SYS_munmap, address, length);
}

void *sbrk(intptr_t increment)
{
    (void)increment;
    note_allocation();
    errno = ENOMEM;
    return (void *)-1;
}

#endif
