/* Counts what a complete real-time run requests from the allocator and from the kernel: loop and
 * drive in threads of their own, from start to join. Allocations in all threads except the main one
 * are counted; and from the tenth tick on, any system call except those of the clock, the link and
 * the end of a thread kills the process.
 *
 *   loop_allocation CLOCK TICKS [allocate | call]       CLOCK: enum rthyb_clock
 *
 * Prints "ELAPSED SENT ALLOCATIONS WATCHED"; WATCHED is 1 if this system can forbid calls. With the
 * last argument, the drive's thread breaks the rule once, to show that it is enforced. */
#define _GNU_SOURCE
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <pthread.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/prctl.h>
#include <sys/syscall.h>

#include "counted_allocator.h"
#include "loop_example.h"

static volatile unsigned long allocations;
static pthread_t main_thread;
static uint64_t drive_ticks, watching, broken;

static void note_allocation(void)
{
    if (main_thread && !pthread_equal(pthread_self(), main_thread))
        __atomic_fetch_add(&allocations, 1, __ATOMIC_RELAXED);
}

/* The clock; the link; the end of a thread, and waiting for it; the output at the end. */
static const long ALLOWED[] = {
    SYS_clock_nanosleep, SYS_clock_gettime,  SYS_ppoll,   SYS_recvfrom, SYS_sendto, SYS_getrusage,
    SYS_futex,           SYS_rt_sigprocmask, SYS_madvise, SYS_munmap,   SYS_exit,   SYS_exit_group,
    SYS_sched_yield,     SYS_write};
enum { ALLOWED_COUNT = sizeof ALLOWED / sizeof *ALLOWED };

/* For all threads at once. */
static int forbid_the_rest(void)
{
    struct sock_filter steps[2 * ALLOWED_COUNT + 2];
    unsigned short n = 0;
    steps[n++] =
        (struct sock_filter)BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, nr));
    for (size_t i = 0; i < ALLOWED_COUNT; i++) {
        steps[n++] =
            (struct sock_filter)BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, (unsigned)ALLOWED[i], 0, 1);
        steps[n++] = (struct sock_filter)BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW);
    }
    steps[n++] = (struct sock_filter)BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_KILL_PROCESS);
    const struct sock_fprog program = {.len = n, .filter = steps};
    return prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0 &&
           syscall(SYS_seccomp, SECCOMP_SET_MODE_FILTER, SECCOMP_FILTER_FLAG_TSYNC, &program) == 0;
}

typedef struct {
    loop_example e;
    rthyb_ticker clock;
    const char *wrong;
} run;

static void *drive(void *shared)
{
    run *r = shared;
    rthyb_tick tick;
    const int allocate = !strcmp(r->wrong, "allocate"), call = !strcmp(r->wrong, "call");
    if (allocate) /* so that the thread has its heap already */
        free(malloc(64));
    while (rthyb_ticker_wait(&r->clock, &tick)) {
        rthyb_drive_tick(&r->e.drive);
        __atomic_store_n(&drive_ticks, r->e.drive.tick, __ATOMIC_RELAXED);
        if (broken || !__atomic_load_n(&watching, __ATOMIC_RELAXED))
            continue;
        if (allocate) {
            void *volatile block = malloc(64);
            free(block);
        }
        if (call)
            syscall(SYS_getpid);
        __atomic_store_n(&broken, 1, __ATOMIC_RELAXED);
    }
    return NULL;
}

static void wait_for(const uint64_t *count, uint64_t value)
{
    while (__atomic_load_n(count, __ATOMIC_RELAXED) < value)
        sched_yield();
}

/* Zero, arm, start: a command that is not allowed in the current state is refused, and sent
 * again. */
static void operate(rthyb_loop *loop, uint64_t ticks)
{
    static const int32_t NEXT[] = {[RTHYB_IDLE] = RTHYB_CMD_ZERO,
                                   [RTHYB_ZEROED] = RTHYB_CMD_ARM,
                                   [RTHYB_ARMED] = RTHYB_CMD_START,
                                   [RTHYB_TRIPPED] = RTHYB_CMD_RESET};
    for (uint64_t at = 40; at < ticks; at += 40) {
        const uint64_t state = __atomic_load_n(&loop->state, __ATOMIC_RELAXED);
        wait_for(&loop->ticker.elapsed, at);
        rthyb_loop_beat(loop);
        if (state < RTHYB_RAMP_IN || state == RTHYB_TRIPPED)
            rthyb_loop_command(loop, NEXT[state]);
    }
    wait_for(&loop->ticker.elapsed, ticks);
}

int main(int argc, char **argv)
{
    static run r;
    pthread_t thread;
    if (argc < 3)
        return 2;
    const int32_t clock = (int32_t)strtol(argv[1], NULL, 10);
    const uint64_t ticks = strtoull(argv[2], NULL, 10);
    r.wrong = argc > 3 ? argv[3] : "";
    main_thread = pthread_self();
    if (loop_example_set_up(&r.e) || rthyb_drive_init(&r.e.drive) ||
        loop_example_init(&r.e, clock) ||
        rthyb_ticker_init(&r.clock, RTHYB_CLOCK_HOST, 1024, rthyb_now_ns()) ||
        pthread_create(&thread, NULL, drive, &r) || rthyb_loop_start(&r.e.loop, 0, -1, -1))
        return 2;
    wait_for(&r.e.loop.ticker.elapsed, 10);
    wait_for(&drive_ticks, 10);
    const int watched = forbid_the_rest();
    __atomic_store_n(&watching, 1, __ATOMIC_RELAXED);
    operate(&r.e.loop, ticks);
    if (*r.wrong)
        wait_for(&broken, 1);
    rthyb_ticker_stop(&r.e.loop.ticker);
    rthyb_loop_join(&r.e.loop);
    rthyb_ticker_stop(&r.clock);
    pthread_join(thread, NULL);
    char line[128];
    const int length = snprintf(line, sizeof line, "%llu %llu %lu %d\n",
                                (unsigned long long)r.e.loop.ticker.elapsed,
                                (unsigned long long)r.e.loop.counters.sent, allocations, watched);
    syscall(SYS_exit_group, write(1, line, (size_t)length) != length);
}
