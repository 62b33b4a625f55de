/* Sets the registers of a traced process as the guest's kernel does: with an area that is too short
 * for the host.
 *
 * Prints "refused" if the host's kernel does not accept it; otherwise which part of the whole area
 * is as passed, and which is unchanged: "front given" and "rest kept". */
#define _GNU_SOURCE
#include <elf.h>
#include <stdio.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/uio.h>
#include <sys/wait.h>
#include <unistd.h>

enum {
    SHORT = 576, /* x87, SSE and the header; the state of AVX follows */
    XMM0 = 160
};

static char area[1 << 16], before[1 << 16];

/* At the stop, every byte of ymm0 is 0xA5: its lower half is in the front, its upper half in the
 * rest. */
__attribute__((target("avx"))) static void be_traced(void)
{
    char pattern[32];
    memset(pattern, 0xA5, sizeof pattern);
    ptrace(PTRACE_TRACEME, 0, NULL, NULL);
    __asm__ volatile("vmovdqu %0, %%ymm0\n\tint3" : : "m"(pattern) : "ymm0");
    _exit(0);
}

static size_t transfer(enum __ptrace_request request, pid_t pid, char *from, size_t bytes)
{
    struct iovec part = {from, bytes};
    return ptrace(request, pid, (void *)NT_X86_XSTATE, &part) < 0 ? 0 : part.iov_len;
}

int main(void)
{
    if (!__builtin_cpu_supports("avx"))
        return puts("no avx") < 0;
    const pid_t pid = fork();
    if (!pid)
        be_traced();
    if (waitpid(pid, NULL, 0) != pid)
        return 1;
    const size_t whole = transfer(PTRACE_GETREGSET, pid, before, sizeof before);
    char given[SHORT];
    memcpy(given, before, SHORT);
    memset(given + XMM0, 0x3C, 16);
    if (whole <= SHORT)
        puts("no area");
    else if (!transfer(PTRACE_SETREGSET, pid, given, SHORT))
        puts("refused");
    else if (transfer(PTRACE_GETREGSET, pid, area, sizeof area) == whole) {
        const int kept = !memcmp(area + SHORT, before + SHORT, whole - SHORT);
        printf("front %s\n", memcmp(area, given, SHORT) ? "other" : "given");
        printf("rest %s, %s\n", kept ? "kept" : "other",
               memchr(area + SHORT, 0xA5, whole - SHORT) ? "with ymm0" : "empty");
    }
    ptrace(PTRACE_KILL, pid, NULL, NULL);
    return waitpid(pid, NULL, 0) != pid;
}
