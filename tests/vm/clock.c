/* Preloaded into the guest's kernel: a clock that makes the host appear faster and free of stalls.
 *
 * The guest's kernel is a process. It takes its time from the host, sets a timer for the next thing
 * that is due, and reads the time again when the timer expires. If the host stalls for 30 ms, it
 * reads the time too late: whatever is more than a moment after the due time is omitted from the
 * guest's time. And a kernel that traces its programs from outside takes 15 to 60 ms to start one
 * or to give it memory, without interruption: the guest's time runs at a third of the pace, so that
 * this takes a third as long. The scenarios test what the program does, not what stalls the machine
 * that they happen to run on. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdint.h>
#include <time.h>

#define SECOND_NS 1000000000LL
/* Measured on a slow day, with another guest at work: with 1, two thirds of the scenarios over
 * SocketCAN meet a kernel that is busy for 20 ticks; with 3, two of 28. Most of a scenario is
 * starting programs, so that it takes less than twice as long. */
#define SLOWER 3
/* Two reads of the clock may be this far apart with nothing due in between: half a tick of the
 * program. */
#define MOMENT_NS 500000LL

typedef int get_call(clockid_t clock, struct timespec *time);
typedef int set_call(timer_t timer, int flags, const struct itimerspec *wanted, struct itimerspec *old);

static get_call *libc_get;
static set_call *libc_set;
/* The host's clock at the last call of `look`, the guest's time then, and when its timer is due. */
static int64_t host_ns, guest_ns, due_ns = INT64_MAX;

static int64_t in_ns(const struct timespec *time)
{
    return SECOND_NS * time->tv_sec + time->tv_nsec;
}

static struct timespec in_words(int64_t ns)
{
    return (struct timespec){ns / SECOND_NS, ns % SECOND_NS};
}

static int64_t read_host(void)
{
    struct timespec now;
    (void)libc_get(CLOCK_MONOTONIC, &now);
    return in_ns(&now);
}

/* Not at the first call, which uses a kernel's stack that is too small for the dynamic linker. */
__attribute__((constructor)) static void begin(void)
{
    libc_get = (get_call *)dlsym(RTLD_NEXT, "clock_gettime");
    libc_set = (set_call *)dlsym(RTLD_NEXT, "timer_settime");
    host_ns = guest_ns = read_host();
}

/* There is one processor, and one thread that reads. A timer that is never set again must not stop
 * the time. */
static void look(void)
{
    const int64_t now_ns = read_host(), passed_ns = now_ns - host_ns;
    const int64_t next_ns = guest_ns + passed_ns / SLOWER;
    const int64_t last_ns = due_ns < INT64_MAX ? due_ns + MOMENT_NS : INT64_MAX;
    if (next_ns > last_ns && passed_ns < SECOND_NS)
        guest_ns = last_ns > guest_ns ? last_ns : guest_ns;
    else
        guest_ns = next_ns;
    host_ns = now_ns;
}

int clock_gettime(clockid_t clock, struct timespec *time)
{
    if (clock != CLOCK_MONOTONIC)
        return libc_get(clock, time);
    look();
    *time = in_words(guest_ns);
    return 0;
}

int timer_settime(timer_t timer, int flags, const struct itimerspec *wanted, struct itimerspec *old)
{
    const int64_t ahead_ns = in_ns(&wanted->it_value), every_ns = in_ns(&wanted->it_interval);
    const struct itimerspec slower = {in_words(SLOWER * every_ns), in_words(SLOWER * ahead_ns)};
    look();
    due_ns = ahead_ns && !every_ns ? guest_ns + ahead_ns : INT64_MAX;
    return libc_set(timer, flags, &slower, old);
}
