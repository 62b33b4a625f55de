/* Preloaded library: kills its process at a chosen write, like SIGKILL: before the write, or after
 * some of its pages were copied. kill_at(n, pages): at the n-th write from now on; 0: at none. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <signal.h>
#include <stddef.h>
#include <sys/types.h>
#include <unistd.h>

static long left;
static int whole_pages;
static long seen;

void kill_at(long n, int pages)
{
    left = n;
    whole_pages = pages;
    seen = 0;
}

long writes_seen(void)
{
    return seen;
}

static int is_last(void)
{
    seen++;
    return left > 0 && --left == 0;
}

typedef ssize_t writes_at(int, const void *, size_t, off_t);

static ssize_t passed_on(const char *name, int fd, const void *data, size_t size, off_t at)
{
    writes_at *const real = (writes_at *)dlsym(RTLD_NEXT, name);
    if (is_last()) {
        const size_t first = 4096 - (size_t)at % 4096;
        for (size_t done = first; whole_pages > 0 && done < size; done += 4096, whole_pages--)
            (void)real(fd, data, done, at);
        (void)kill(getpid(), SIGKILL);
    }
    return real(fd, data, size, at);
}

ssize_t pwrite(int fd, const void *data, size_t size, off_t at)
{
    return passed_on("pwrite", fd, data, size, at);
}

ssize_t pwrite64(int fd, const void *data, size_t size, off_t at)
{
    return passed_on("pwrite64", fd, data, size, at);
}

int ftruncate(int fd, off_t size)
{
    int (*const real)(int, off_t) = (int (*)(int, off_t))dlsym(RTLD_NEXT, "ftruncate");
    if (is_last())
        (void)kill(getpid(), SIGKILL);
    return real(fd, size);
}

int ftruncate64(int fd, off_t size)
{
    int (*const real)(int, off_t) = (int (*)(int, off_t))dlsym(RTLD_NEXT, "ftruncate64");
    if (is_last())
        (void)kill(getpid(), SIGKILL);
    return real(fd, size);
}
