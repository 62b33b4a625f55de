/* Makes a thread real-time. Wherever possible, the result is read back afterwards: a container may
 * accept a call without any effect. */
#define _GNU_SOURCE /* NOLINT(bugprone-reserved-identifier,cert-dcl37-c,cert-dcl51-cpp) */

#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <unistd.h>

#include "internal.h"

#define PAGE_BYTES 4096

/* Affects the calling thread only; threads and processes that it starts do not inherit the
 * priority. */
static uint32_t become_fifo(int32_t priority)
{
    struct sched_param wanted = {.sched_priority = priority}, found;
    sched_setscheduler(0, SCHED_FIFO | SCHED_RESET_ON_FORK, &wanted);
    if ((sched_getscheduler(0) & ~SCHED_RESET_ON_FORK) != SCHED_FIFO || sched_getparam(0, &found))
        return 0;
    return found.sched_priority == priority ? RTHYB_P_FIFO : 0;
}

static uint32_t stay_on(int32_t cpu)
{
    cpu_set_t set;
    CPU_ZERO(&set);
    CPU_SET((size_t)cpu, &set);
    sched_setaffinity(0, sizeof set, &set);
    CPU_ZERO(&set);
    if (sched_getaffinity(0, sizeof set, &set))
        return 0;
    return CPU_COUNT(&set) == 1 && CPU_ISSET((size_t)cpu, &set) ? RTHYB_P_CPU : 0;
}

static uint32_t lock_memory(void)
{
    return mlockall(MCL_CURRENT | MCL_FUTURE) == 0 ? RTHYB_P_MEMORY : 0;
}

void rthyb_memory_unlock(void)
{
    munlockall();
}

/* The device returns the value in effect as four bytes. */
static uint32_t processors_stay_awake(int32_t latency_fd)
{
    int32_t value = -1;
    const ssize_t got = latency_fd < 0 ? -1 : pread(latency_fd, &value, sizeof value, 0);
    return got == (ssize_t)sizeof value && value == 0 ? RTHYB_P_AWAKE : 0;
}

static uint32_t block_signals(void)
{
    sigset_t all, found;
    sigfillset(&all);
    pthread_sigmask(SIG_SETMASK, &all, NULL);
    if (pthread_sigmask(SIG_SETMASK, NULL, &found))
        return 0;
    return sigismember(&found, SIGINT) == 1 && sigismember(&found, SIGTERM) == 1 ? RTHYB_P_SIGNALS
                                                                                 : 0;
}

/* Page by page, one level deeper in each call, so that no page is accessed for the first time
 * later. */
static void touch_stack(size_t bytes)
{
    volatile char page[PAGE_BYTES];
    page[0] = 0;
    if (bytes > sizeof page)
        touch_stack(bytes - sizeof page);
    page[sizeof page - 1] = page[0]; /* keeps this frame until here */
}

uint32_t rthyb_thread_become_real_time(int32_t priority, int32_t cpu, int32_t latency_fd,
                                       size_t stack_bytes)
{
    uint32_t got = block_signals() | lock_memory() | processors_stay_awake(latency_fd);
    touch_stack(stack_bytes);
    /* Without FIFO, the kernel may delay timers by 50 us to group them; this call needs no
     * privilege. */
    prctl(PR_SET_TIMERSLACK, 1UL, 0UL, 0UL, 0UL);
    if (cpu >= 0 && cpu < CPU_SETSIZE)
        got |= stay_on(cpu);
    if (priority > 0)
        got |= become_fifo(priority);
    return got;
}

void rthyb_thread_usage(rthyb_usage *usage)
{
    struct rusage found = {0};
    getrusage(RUSAGE_THREAD, &found);
    *usage = (rthyb_usage){
        .major_faults = (uint64_t)found.ru_majflt,
        .minor_faults = (uint64_t)found.ru_minflt,
        .waits = (uint64_t)found.ru_nvcsw,
        .preemptions = (uint64_t)found.ru_nivcsw,
    };
}

void rthyb_usage_since(rthyb_usage *usage, const rthyb_usage *before)
{
    rthyb_thread_usage(usage);
    usage->major_faults -= before->major_faults;
    usage->minor_faults -= before->minor_faults;
    usage->waits -= before->waits;
    usage->preemptions -= before->preemptions;
}
