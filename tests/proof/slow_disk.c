/* A slow disk, for a process that loads this library first (LD_PRELOAD): every fsync takes
 * RTHYB_SLOW_FSYNC_MS longer, and every write at a position in a file RTHYB_SLOW_PWRITE_MS. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

static void wait_as_set(const char *name)
{
    const char *value = getenv(name);
    long ms = value ? atol(value) : 0;
    struct timespec left = {ms / 1000, ms % 1000 * 1000000L};
    while (nanosleep(&left, &left) != 0) {
    }
}

int fsync(int fd)
{
    int (*next)(int) = (int (*)(int))dlsym(RTLD_NEXT, "fsync");
    wait_as_set("RTHYB_SLOW_FSYNC_MS");
    return next(fd);
}

ssize_t pwrite64(int fd, const void *data, size_t size, off64_t at)
{
    ssize_t (*next)(int, const void *, size_t, off64_t) =
        (ssize_t(*)(int, const void *, size_t, off64_t))dlsym(RTLD_NEXT, "pwrite64");
    wait_as_set("RTHYB_SLOW_PWRITE_MS");
    return next(fd, data, size, at);
}
