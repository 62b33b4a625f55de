/* Threads that do nothing but keep time: if they are late, only the machine can be the reason.
 *
 * reference FILE: two threads that only sleep from tick to tick. "fifo" has priority over every
 * thread of the program; "other" waits like ordinary programs. Whenever one of them is late by a
 * tick or more, a line is added to the file: name, when it was due, when it woke up
 * (CLOCK_MONOTONIC, ns). */
#define _GNU_SOURCE
#include <fcntl.h>
#include <pthread.h>
#include <sched.h>
#include <stdint.h>
#include <stdio.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

#define SECOND_NS INT64_C(1000000000)
#define TICK_NS (SECOND_NS / 1024)

typedef struct {
    const char *name;
    int64_t period_ns;
    int priority;
    int file;
} reference;

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * SECOND_NS + now.tv_nsec;
}

static void note(const reference *r, int64_t due_ns, int64_t woken_ns)
{
    char line[64];
    const int length = snprintf(line, sizeof line, "%s %lld %lld\n", r->name, (long long)due_ns,
                                (long long)woken_ns);
    (void)!write(r->file, line, (size_t)length);
}

static void *sleep_and_note(void *what)
{
    const reference *const r = what;
    const struct sched_param fifo = {.sched_priority = r->priority};
    if (r->priority && pthread_setschedparam(pthread_self(), SCHED_FIFO, &fifo))
        _exit(1);
    for (int64_t due_ns = now_ns();;) {
        due_ns += r->period_ns;
        const struct timespec due = {due_ns / SECOND_NS, due_ns % SECOND_NS};
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL))
            ;
        const int64_t woken_ns = now_ns();
        if (woken_ns - due_ns < TICK_NS)
            continue;
        note(r, due_ns, woken_ns);
        due_ns = woken_ns;
    }
}

int main(int count, char **arguments)
{
    const int file = count == 2 ? open(arguments[1], O_WRONLY | O_CREAT | O_APPEND, 0644) : -1;
    if (file < 0 || mlockall(MCL_CURRENT | MCL_FUTURE))
        return 1;
    /* The stalls of interest are tens of ticks long, and on one small processor each wake-up costs
     * time. */
    reference fifo = {"fifo", 2 * TICK_NS, 99, file}, other = {"other", 8 * TICK_NS, 0, file};
    pthread_t thread;
    if (pthread_create(&thread, NULL, sleep_and_note, &fifo))
        return 1;
    (void)sleep_and_note(&other);
    return 1;
}
