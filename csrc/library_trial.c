/* Tries out a user's numerical part before a test: in a child process, so that neither a crash nor
 * an endless loop affects this one. First its time is measured; then every allocation is counted
 * and every system call is forbidden. The results are returned in shared memory. */
#define _GNU_SOURCE /* NOLINT(bugprone-reserved-identifier,cert-*): asked for by name */
#include <errno.h>
#include <link.h>
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <math.h>
#include <signal.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include "rthyb.h"

enum { STEPS_MAX = 4096, WARM_UP = 64 };

typedef struct {
    rthyb_trial result;
    int64_t whole_ns[STEPS_MAX], answer_ns[STEPS_MAX];
} shared_findings;

static shared_findings *findings; /* used in the child only */

/* ---- counted allocation: calls of every loaded library into the allocator ------------------------ */

static void *(*true_malloc)(size_t);
static void *(*true_calloc)(size_t, size_t);
static void *(*true_realloc)(void *, size_t);
static void (*true_free)(void *);
static void *(*true_aligned)(size_t, size_t);
static int (*true_posix)(void **, size_t, size_t);

static void *counted_malloc(size_t size)
{
    findings->result.allocations++;
    return true_malloc(size);
}

static void *counted_calloc(size_t count, size_t size)
{
    findings->result.allocations++;
    return true_calloc(count, size);
}

static void *counted_realloc(void *block, size_t size)
{
    findings->result.allocations++;
    return true_realloc(block, size);
}

static void counted_free(void *block)
{
    if (block)
        findings->result.allocations++;
    true_free(block);
}

static void *counted_aligned(size_t alignment, size_t size)
{
    findings->result.allocations++;
    return true_aligned(alignment, size);
}

static int counted_posix(void **block, size_t alignment, size_t size)
{
    findings->result.allocations++;
    return true_posix(block, alignment, size);
}

static rthyb_any_function counted(const char *name)
{
    static const struct {
        const char *name;
        rthyb_any_function instead;
    } COUNTED[] = {
        {"malloc", (rthyb_any_function)counted_malloc},
        {"calloc", (rthyb_any_function)counted_calloc},
        {"realloc", (rthyb_any_function)counted_realloc},
        {"free", (rthyb_any_function)counted_free},
        {"aligned_alloc", (rthyb_any_function)counted_aligned},
        {"memalign", (rthyb_any_function)counted_aligned},
        {"posix_memalign", (rthyb_any_function)counted_posix},
    };
    for (size_t i = 0; i < sizeof COUNTED / sizeof *COUNTED; i++)
        if (!strcmp(name, COUNTED[i].name))
            return COUNTED[i].instead;
    return NULL;
}

/* The tables of a loaded object, from its dynamic section. */
typedef struct {
    const ElfW(Sym) * symbol;
    const char *names;
    const char *relocation[2]; /* with addends, or without */
    size_t bytes[2], entry[2];
} object_tables;

/* The loader gives addresses as integers. */
static void *place(uintptr_t address)
{
    return (void *)address; /* NOLINT(performance-no-int-to-ptr) */
}

static const void *table_at(const struct dl_phdr_info *object, uintptr_t value)
{
    /* The loader has converted these values to addresses, except in objects that it does not write
     * to. */
    return place(value < object->dlpi_addr ? object->dlpi_addr + value : value);
}

static object_tables tables_of(const struct dl_phdr_info *object, const ElfW(Dyn) * dynamic)
{
    object_tables found = {0};
    for (; dynamic->d_tag != DT_NULL; dynamic++) {
        const uintptr_t value = dynamic->d_un.d_ptr;
        switch (dynamic->d_tag) {
        case DT_SYMTAB:
            found.symbol = table_at(object, value);
            break;
        case DT_STRTAB:
            found.names = table_at(object, value);
            break;
        case DT_JMPREL:
            found.relocation[0] = table_at(object, value);
            break;
        case DT_PLTRELSZ:
            found.bytes[0] = value;
            break;
        case DT_PLTREL:
            found.entry[0] = value == DT_RELA ? sizeof(ElfW(Rela)) : sizeof(ElfW(Rel));
            break;
        case DT_RELA:
        case DT_REL:
            found.relocation[1] = table_at(object, value);
            break;
        case DT_RELASZ:
        case DT_RELSZ:
            found.bytes[1] = value;
            break;
        case DT_RELAENT:
        case DT_RELENT:
            found.entry[1] = value;
            break;
        default:
            break;
        }
    }
    return found;
}

static size_t symbol_of(uintptr_t info)
{
    return sizeof(void *) == 8 ? (size_t)(info >> 32) : (size_t)(info >> 8);
}

static void put(uintptr_t slot, rthyb_any_function instead, uintptr_t page)
{
    const uintptr_t first = slot & ~(page - 1);
    if (!mprotect(place(first), page, PROT_READ | PROT_WRITE))
        memcpy(place(slot), (const void *)&instead, sizeof instead);
}

/* Makes an object call the counting functions; callback of dl_iterate_phdr. */
static int count_calls_of(struct dl_phdr_info *object, size_t size, void *page)
{
    (void)size;
    const ElfW(Dyn) *dynamic = NULL;
    for (int i = 0; i < object->dlpi_phnum; i++)
        if (object->dlpi_phdr[i].p_type == PT_DYNAMIC)
            dynamic = place(object->dlpi_addr + object->dlpi_phdr[i].p_vaddr);
    if (!dynamic)
        return 0;
    const object_tables t = tables_of(object, dynamic);
    for (int kind = 0; kind < 2; kind++) {
        if (!t.relocation[kind] || !t.entry[kind] || !t.symbol || !t.names)
            continue;
        for (size_t at = 0; at + t.entry[kind] <= t.bytes[kind]; at += t.entry[kind]) {
            const ElfW(Rel) *one = (const void *)(t.relocation[kind] + at);
            const size_t symbol = symbol_of(one->r_info);
            const rthyb_any_function instead =
                symbol ? counted(t.names + t.symbol[symbol].st_name) : NULL;
            if (instead)
                put(object->dlpi_addr + one->r_offset, instead, *(const uintptr_t *)page);
        }
    }
    return 0;
}

static void count_allocations(void)
{
    uintptr_t page = (uintptr_t)sysconf(_SC_PAGESIZE);
    true_malloc = malloc;
    true_calloc = calloc;
    true_realloc = realloc;
    true_free = free;
    true_aligned = aligned_alloc;
    true_posix = posix_memalign;
    (void)dl_iterate_phdr(count_calls_of, &page);
}

/* ---- forbidden system calls ---------------------------------------------------------------------- */

static void on_call(int signal, siginfo_t *about, void *context)
{
    (void)signal;
    (void)context;
    findings->result.ended = RTHYB_TRIAL_CALLED;
    findings->result.number = about->si_syscall;
    _exit(0);
}

/* Any system call except the one that ends the process raises a signal. */
static int forbid_calls(void)
{
    struct sock_filter rules[] = {
        BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, nr)),
        BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, SYS_exit_group, 0, 1),
        BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW),
        BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_TRAP),
    };
    const struct sock_fprog program = {.len = sizeof rules / sizeof *rules, .filter = rules};
    const struct sigaction action = {.sa_sigaction = on_call, .sa_flags = SA_SIGINFO};
    return !sigaction(SIGSYS, &action, NULL) && !prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) &&
           !prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, &program);
}

/* ---- the child ----------------------------------------------------------------------------------- */

typedef struct {
    const rthyb_numerical *part;
    double period_s;
    const double *k_e_n_per_m; /* row by row */
    double x[RTHYB_INTERFACES_MAX];
    uint32_t tick;
} course;

static int64_t now_ns(void)
{
    struct timespec t;
    (void)clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

/* A test as it might be: a slow and a fast wave as ground motion, and the force of an elastic
 * specimen. */
static int answer_once(course *c)
{
    double force[RTHYB_INTERFACES_MAX];
    const int32_t m = rthyb_numerical_interfaces(c->part);
    const double t = c->tick++ * c->period_s;
    for (int32_t i = 0; i < m; i++) {
        force[i] = 0.0;
        for (int32_t j = 0; j < m; j++)
            force[i] += c->k_e_n_per_m[i * m + j] * c->x[j];
    }
    return rthyb_numerical_answer(c->part, 0.3 * sin(9.0 * t) + 0.2 * sin(50.0 * t), force, c->x);
}

static int step_once(course *c)
{
    double values[RTHYB_RESPONSES_MAX];
    int code = answer_once(c);
    (void)rthyb_numerical_report(c->part, values, RTHYB_RESPONSES_MAX);
    code |= rthyb_numerical_advance(c->part);
    return code;
}

static void by_the_clock(course *c, uint32_t steps)
{
    rthyb_trial *r = &findings->result;
    for (uint32_t i = 0; i < WARM_UP; i++)
        r->status |= step_once(c);
    for (uint32_t i = 0; i < steps; i++) {
        const int64_t begun = now_ns();
        r->status |= answer_once(c);
        findings->answer_ns[i] = now_ns() - begun;
        r->status |= rthyb_numerical_advance(c->part);
        findings->whole_ns[i] = now_ns() - begun;
        r->steps++;
    }
}

static void under_watch(course *c, uint32_t steps)
{
    rthyb_trial *r = &findings->result;
    const double force[RTHYB_INTERFACES_MAX] = {0.0};
    count_allocations();
    r->watched = forbid_calls();
    r->allocations = 0;
    r->stage = RTHYB_TRIAL_WATCHED;
    for (uint32_t i = 0; i < steps; i++) {
        r->status |= step_once(c);
        if (i % 8 == 0)
            rthyb_numerical_freeze(c->part, force);
    }
}

/* Does not return; reports everything it finds in shared memory. */
static void child(const rthyb_numerical *part, double period_s, const double *k_e_n_per_m,
                  uint32_t steps)
{
    const int crashes[] = {SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT, SIGINT, SIGTERM};
    for (size_t i = 0; i < sizeof crashes / sizeof *crashes; i++)
        (void)signal(crashes[i], SIG_DFL);
    course c = {.part = part, .period_s = period_s, .k_e_n_per_m = k_e_n_per_m};
    rthyb_trial *r = &findings->result;
    const int refused = rthyb_numerical_init(part, 0.0);
    if (refused) {
        r->ended = RTHYB_TRIAL_REFUSED;
        r->number = part->kind == RTHYB_NUMERICAL_LIBRARY ? rthyb_library_refusal(part) : refused;
        _exit(0);
    }
    r->stage = RTHYB_TRIAL_IN_STEPS;
    by_the_clock(&c, steps);
    under_watch(&c, steps);
    r->ended = RTHYB_TRIAL_DONE;
    _exit(0);
}

/* ---- the parent ---------------------------------------------------------------------------------- */

static int by_size(const void *a, const void *b)
{
    const int64_t one = *(const int64_t *)a, other = *(const int64_t *)b;
    return (one > other) - (one < other);
}

static void sum_up(shared_findings *f, rthyb_trial *result)
{
    *result = f->result;
    if (f->result.steps == 0)
        return;
    const uint32_t middle = f->result.steps / 2, last = f->result.steps - 1;
    qsort(f->whole_ns, f->result.steps, sizeof *f->whole_ns, by_size);
    qsort(f->answer_ns, f->result.steps, sizeof *f->answer_ns, by_size);
    result->step_s = 1e-9 * (double)f->whole_ns[middle];
    result->worst_s = 1e-9 * (double)f->whole_ns[last];
    result->answer_s = 1e-9 * (double)f->answer_ns[middle];
}

/* Waits for the child, and kills it when its time is up. Returns its status, or -1. */
static int status_of(pid_t process, double most_s)
{
    const struct timespec nap = {.tv_nsec = 500000};
    const int64_t deadline = now_ns() + (int64_t)(most_s * 1e9);
    int status = 0;
    for (;;) {
        const pid_t ended = waitpid(process, &status, WNOHANG);
        if (ended == process)
            return status;
        if (ended < 0 && errno != EINTR)
            return -1;
        if (now_ns() > deadline)
            break;
        (void)nanosleep(&nap, NULL);
    }
    (void)kill(process, SIGKILL);
    while (waitpid(process, &status, 0) < 0 && errno == EINTR)
        ;
    return -1;
}

void rthyb_part_try(const rthyb_numerical *part, double period_s, const double *k_e_n_per_m,
                    uint32_t steps, double most_s, rthyb_trial *result)
{
    *result = (rthyb_trial){.ended = RTHYB_TRIAL_NOT_TRIED};
    shared_findings *shared =
        mmap(NULL, sizeof *shared, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (shared == MAP_FAILED)
        return;
    const pid_t process = fork();
    if (process == 0) {
        findings = shared;
        child(part, period_s, k_e_n_per_m, steps < STEPS_MAX ? steps : STEPS_MAX);
    }
    if (process > 0) {
        const int status = status_of(process, most_s);
        sum_up(shared, result);
        if (status == -1) {
            result->ended = RTHYB_TRIAL_STUCK;
        } else if (WIFSIGNALED(status)) {
            result->ended = RTHYB_TRIAL_CRASHED;
            result->number = WTERMSIG(status);
        } else if (result->ended == RTHYB_TRIAL_NOT_TRIED) {
            result->ended = RTHYB_TRIAL_ENDED;
            result->number = WEXITSTATUS(status);
        }
    }
    (void)munmap(shared, sizeof *shared);
}
