/* Preloaded into the guest's kernel if the processor has more registers than that kernel knows.
 *
 * Linux sets the extended registers of a traced process (NT_X86_XSTATE) completely or not at all.
 * Debian's user-mode kernel 6.1 passes an area of a fixed size, and a processor with AMX has four
 * times that: the kernel refuses, and the guest panics. Here, the area that is passed replaces the
 * front of the process's own area, and the result is set completely. */
#define _GNU_SOURCE
#include <cpuid.h>
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/uio.h>

typedef long ptrace_call(enum __ptrace_request request, ...);

static ptrace_call *libc_ptrace;

/* Not at the first call, which uses a kernel's stack that is too small for the dynamic linker. */
__attribute__((constructor)) static void find_ptrace(void)
{
    libc_ptrace = (ptrace_call *)dlsym(RTLD_NEXT, "ptrace");
}

/* Size of this processor's area in bytes, with all features that its kernel has enabled. */
unsigned xstate_area(void)
{
    unsigned a, bytes = 0, c, d;
    return __get_cpuid_count(0xd, 0, &a, &bytes, &c, &d) ? bytes : 0;
}

static long set_whole(pid_t pid, void *kind, const struct iovec *given)
{
    static char area[1 << 16]; /* one processor, one thread; too much for a kernel's stack */
    struct iovec whole = {area, sizeof area};
    if (libc_ptrace(PTRACE_GETREGSET, pid, kind, &whole) < 0)
        return -1;
    memcpy(area, given->iov_base, given->iov_len < whole.iov_len ? given->iov_len : whole.iov_len);
    return libc_ptrace(PTRACE_SETREGSET, pid, kind, &whole);
}

long ptrace(enum __ptrace_request request, ...)
{
    va_list arguments;
    va_start(arguments, request);
    const pid_t pid = va_arg(arguments, pid_t);
    void *const address = va_arg(arguments, void *), *const data = va_arg(arguments, void *);
    va_end(arguments);
    if (request == PTRACE_SETREGSET && address == (void *)NT_X86_XSTATE)
        return set_whole(pid, address, data);
    return libc_ptrace(request, pid, address, data);
}
