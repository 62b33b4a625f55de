/* A disk that takes its time, for a process that is told to load this first (LD_PRELOAD): every
   fsync RTHYB_SLOW_FSYNC_MS, every write at a place of a file RTHYB_SLOW_PWRITE_MS. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

static void wait_as_told(const char *name)
{
    const char *told = getenv(name);
    long ms = told ? atol(told) : 0;
    struct timespec left = {ms / 1000, ms % 1000 * 1000000L};
    while (nanosleep(&left, &left) != 0) {
    }
}

int fsync(int fd)
{
    int (*next)(int) = (int (*)(int))dlsym(RTLD_NEXT, "fsync");
    wait_as_told("RTHYB_SLOW_FSYNC_MS");
    return next(fd);
}

ssize_t pwrite64(int fd, const void *data, size_t size, off64_t at)
{
    ssize_t (*next)(int, const void *, size_t, off64_t) =
        (ssize_t(*)(int, const void *, size_t, off64_t))dlsym(RTLD_NEXT, "pwrite64");
    wait_as_told("RTHYB_SLOW_PWRITE_MS");
    return next(fd, data, size, at);
}
