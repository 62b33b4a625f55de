/* Preloaded into the guest's kernel where the processor has more registers than that kernel knows.
 *
 * Linux sets a traced process's extended registers (NT_X86_XSTATE) as a whole or not at all. Debian's
 * user-mode kernel 6.1 hands over an area of a fixed size, and a processor with AMX has four times
 * that: the kernel refuses, and the guest panics. Here the area that is handed over is laid over the
 * front of the process's own one, and the whole is set. */
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

/* Not at the first call: that one comes on a kernel's stack, which is too small for the linker. */
__attribute__((constructor)) static void find_ptrace(void)
{
    libc_ptrace = (ptrace_call *)dlsym(RTLD_NEXT, "ptrace");
}

/* Bytes of this processor's area, with all that its kernel has switched on. */
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
