/* The tick thread, with every thread that may observe it or communicate with it, for a race
 * detector.
 *
 *   loop_stress          a stepped test of TICKS ticks, a second on the host clock and one on the
 *                        link's, tickers that are granted and stopped from several threads. Prints
 *                        what happened; 1 if something is inconsistent.
 *   loop_stress race     reads one counter in a forbidden way: the detector must report it.
 *
 * Threads of the stepped test: the tick thread; the clock, which is also the drive; an operator;
 * one that sets parameters; one that loads; a heartbeat; two that read every counter and histogram;
 * three readers of the ring. */
#define _GNU_SOURCE

#include <pthread.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "loop_example.h"
#include "relaxed.h"

enum { TICKS = 40000, WATCHERS = 2, READERS = 3, CAPACITY = 256, BATCH = 32 };
enum { TICKERS = 60, GRANTERS = 2, GRANTS = 200 };

#define REAL_TIME_NS 1200000000

typedef struct {
    loop_example e;
    rthyb_ring ring;
    rthyb_ticker drive_clock;
    void *map;
    size_t bytes;
    uint32_t over, race;
} bench;

typedef struct {
    bench *b;
    pthread_t thread;
    uint64_t read, lost, disordered, wanted;
    uint32_t generation;
} reader_job;

static uint64_t obeyed, refused,
    generations; /* as counted by the operator; each written by one thread */
static int faults;

static void must(int holds, const char *what)
{
    if (holds)
        return;
    fprintf(stderr, "loop_stress: broken: %s\n", what);
    __atomic_fetch_add(&faults, 1, __ATOMIC_RELAXED);
}

static int is_over(const bench *b)
{
    return (int)__atomic_load_n(&b->over, __ATOMIC_ACQUIRE);
}

static uint32_t random_below(uint64_t *state, uint32_t n)
{
    *state = *state * UINT64_C(6364136223846793005) + UINT64_C(1442695040888963407);
    return (uint32_t)(*state >> 33) % n;
}

static void start(pthread_t *thread, void *(*work)(void *), void *argument)
{
    if (pthread_create(thread, NULL, work, argument)) {
        perror("loop_stress: no thread");
        exit(2);
    }
}

/* ---- set-up ----------------------------------------------------------------------------------- */

static void set_up(bench *b, int32_t clock)
{
    memset(b, 0, sizeof *b);
    b->bytes = rthyb_ring_bytes(CAPACITY, 0, 1, 0);
    b->map = aligned_alloc(4096, (b->bytes + 4095) / 4096 * 4096);
    if (!b->map || loop_example_set_up(&b->e) || rthyb_drive_init(&b->e.drive)) {
        fprintf(stderr, "loop_stress: set-up refused\n");
        exit(2);
    }
    memset(b->map, 0, b->bytes);
    rthyb_ring_init(&b->ring, b->map, CAPACITY, 0, 1, 0);
    b->e.config.ring = &b->ring;
    must(loop_example_init(&b->e, clock) == 0, "the loop takes its clock");
}

static void tear_down(bench *b)
{
    loop_example_close(&b->e);
    free(b->map);
}

/* ---- those beside the tick thread --------------------------------------------------------------- */

static void *beat(void *shared)
{
    bench *b = shared;
    while (!is_over(b)) {
        rthyb_loop_beat(&b->e.loop);
        sched_yield();
    }
    return NULL;
}

static uint64_t sum(const uint64_t *words, size_t n)
{
    uint64_t total = 0;
    for (size_t i = 0; i < n; i++)
        total += peek(&words[i]);
    return total;
}

static void look(bench *b, rthyb_ticker_counts *last)
{
    static const double FRACTIONS[] = {0.5, 0.99, 1.0};
    rthyb_latency copy = {0};
    rthyb_ticker_counts counts;
    const rthyb_loop *loop = &b->e.loop;
    rthyb_ticker_read(&loop->ticker, &counts);
    must(counts.elapsed >= last->elapsed && counts.executed >= last->executed,
         "counters never fall");
    *last = counts;
    (void)((uint64_t)(peek_signed(&loop->arrival_error_ns) + peek_signed(&loop->trim_ppb)) +
           sum((const uint64_t *)&loop->counters, sizeof loop->counters / 8) +
           sum((const uint64_t *)&b->e.near.counters, sizeof b->e.near.counters / 8) +
           peek(&b->e.near.down) + sum(loop->delays, RTHYB_LINK_DELAYS) +
           sum((const uint64_t *)&b->e.wire.counters, sizeof b->e.wire.counters / 8));
    rthyb_latency_merge(&copy, &loop->ticker.wake);
    rthyb_latency_merge(&copy, &loop->sent);
    for (size_t i = 0; i < 3; i++)
        (void)rthyb_latency_percentile(&loop->sent, FRACTIONS[i]);
    must(peek(&loop->state) <= RTHYB_TRIPPED && peek(&loop->cause) < RTHYB_CAUSE_COUNT,
         "state and cause are known ones");
}

static void *watch(void *shared)
{
    bench *b = shared;
    rthyb_ticker_counts last = {0};
    volatile uint64_t sink = 0;
    while (!is_over(b)) {
        look(b, &last);
        if (b->race)
            sink += *(volatile uint64_t *)&b->e.loop.counters.records;
        sched_yield();
    }
    return NULL;
}

/* What an operator would do next, sometimes something that is not allowed. */
static int32_t next_command(uint64_t state, uint64_t *random)
{
    static const int32_t USUAL[] = {
        [RTHYB_IDLE] = RTHYB_CMD_ZERO,    [RTHYB_ZEROED] = RTHYB_CMD_ARM,
        [RTHYB_ARMED] = RTHYB_CMD_START,  [RTHYB_RAMP_IN] = RTHYB_CMD_START,
        [RTHYB_RUNNING] = RTHYB_CMD_HOLD, [RTHYB_HOLD] = RTHYB_CMD_RESUME,
        [RTHYB_RAMP_OUT] = RTHYB_CMD_ARM, [RTHYB_TRIPPED] = RTHYB_CMD_RESET};
    const uint32_t whim = random_below(random, 40);
    if (whim == 0)
        return RTHYB_CMD_TRIP;
    if (whim < 4)
        return 1 + (int32_t)random_below(random, RTHYB_CMD_COUNT - 1);
    return USUAL[state];
}

static void *operate(void *shared)
{
    bench *b = shared;
    uint64_t random = 1, tick = 0, last_tick = 0;
    while (!is_over(b)) {
        const int32_t command = next_command(peek(&b->e.loop.state), &random);
        uint64_t generation = rthyb_loop_command(&b->e.loop, command);
        int answer = 0;
        must(generation == generations + 1, "an answered mailbox takes a command");
        generations = generation;
        if (random_below(&random, 8) == 0) { /* a TRIP does not wait for the answer */
            must(rthyb_loop_command(&b->e.loop, RTHYB_CMD_TRIP) > generation,
                 "a TRIP takes its place");
            generation = ++generations;
        }
        while (!answer && !is_over(b)) {
            answer = rthyb_loop_answered(&b->e.loop, generation, &tick);
            sched_yield();
        }
        must(!answer || tick >= last_tick, "answers come in order");
        last_tick = tick;
        obeyed += answer == 1;
        refused += answer == 2;
    }
    return NULL;
}

static void *follow(void *argument)
{
    reader_job *job = argument;
    rthyb_ring_reader reader;
    rthyb_record records[BATCH]; /* room for rows of any number of axes */
    must(rthyb_ring_attach(&reader, job->b->map, job->b->bytes) == 0, "a reader finds the ring");
    for (;;) {
        const int over = is_over(job->b);
        const size_t count = rthyb_ring_read(&reader, records, BATCH);
        for (size_t i = 0; i < count; i++) {
            const rthyb_record *row =
                (const void *)((const char *)records + i * rthyb_record_bytes(1));
            job->disordered += row->tick < job->wanted;
            job->disordered += row->generation < job->generation;
            job->wanted = row->tick + 1;
            job->generation = row->generation;
        }
        job->read += count;
        job->lost = reader.lost;
        (void)rthyb_ring_newest(&reader, records);
        if (over && count == 0)
            return NULL;
    }
}

/* ---- parameters --------------------------------------------------------------------------------- */

/* Set number k: every value in it identifies the set. */
static rthyb_parameters parameters(uint64_t k)
{
    const double part = 1.0 + 1e-3 * (double)(k % 1000);
    rthyb_parameters p = {.adapt = 1,
                          .velocity_limit_m_per_s = 0.5 * part,
                          .acceleration_limit_m_per_s2 = 500.0 * part,
                          .path_velocity_m_per_s = 0.05 * part,
                          .path_acceleration_m_per_s2 = part};
    for (int i = RTHYB_CAUSE_POSITION; i < RTHYB_CAUSE_COUNT; i++)
        p.watch[i] = (rthyb_watch){.value = 1e6 * part};
    return p;
}

static void *set_parameters(void *shared)
{
    bench *b = shared;
    for (uint64_t k = 1; !is_over(b); k++) {
        rthyb_parameters p = parameters(k);
        must(rthyb_loop_set_parameters(&b->e.loop, &p) == 0, "a good set is published");
        must(p.generation == k, "each set has its generation");
        for (int i = 0; i < 4 && !rthyb_loop_set_taken(&b->e.loop, p.generation); i++)
            sched_yield();
        must(rthyb_loop_set_taken(&b->e.loop, p.generation) != 2, "a good set is not refused");
        sched_yield();
    }
    return NULL;
}

/* After the end of the thread: the set in effect is one that was published, in all its parts. */
static void check_parameters(const bench *b)
{
    const rthyb_parameters p = parameters(b->e.station.controller.generation);
    const rthyb_station_config *cfg = &b->e.station.cfg;
    must(cfg->path_velocity_m_per_s == p.path_velocity_m_per_s &&
             cfg->path_acceleration_m_per_s2 == p.path_acceleration_m_per_s2 &&
             cfg->watch[RTHYB_CAUSE_POSITION].value == p.watch[RTHYB_CAUSE_POSITION].value &&
             cfg->watch[RTHYB_CAUSE_ENERGY].value == p.watch[RTHYB_CAUSE_ENERGY].value,
         "parameters are taken whole");
    must(b->e.loop.counters.parameters > 100, "parameters are taken");
}

/* ---- loads -------------------------------------------------------------------------------------- */

/* The same station again and again, which is accepted in any state. */
static void *load(void *shared)
{
    bench *b = shared;
    uint64_t taken = 0;
    while (!is_over(b)) {
        const rthyb_load again = {&b->e.station, &b->ring, b->e.ag_mps2, EXAMPLE_TICKS};
        const uint64_t generation = rthyb_loop_load(&b->e.loop, &again);
        int answer = 0;
        while (!answer && !is_over(b)) {
            answer = rthyb_loop_loaded(&b->e.loop, generation);
            sched_yield();
        }
        must(answer != 2, "the same station is never refused");
        taken += answer == 1;
    }
    must(taken > 10, "loads are taken");
    return NULL;
}

/* ---- a whole test ------------------------------------------------------------------------------- */

typedef struct {
    pthread_t heart, operator, parameters, loads, watchers[WATCHERS];
    reader_job readers[READERS];
} company;

static void gather(company *c, bench *b)
{
    start(&c->heart, beat, b);
    start(&c->operator, operate, b);
    start(&c->parameters, set_parameters, b);
    start(&c->loads, load, b);
    for (int i = 0; i < WATCHERS; i++)
        start(&c->watchers[i], watch, b);
    for (int i = 0; i < READERS; i++) {
        c->readers[i] = (reader_job){.b = b};
        start(&c->readers[i].thread, follow, &c->readers[i]);
    }
}

static void dismiss(company *c, bench *b)
{
    __atomic_store_n(&b->over, 1u, __ATOMIC_RELEASE);
    pthread_join(c->heart, NULL);
    pthread_join(c->operator, NULL);
    pthread_join(c->parameters, NULL);
    pthread_join(c->loads, NULL);
    for (int i = 0; i < WATCHERS; i++)
        pthread_join(c->watchers[i], NULL);
    for (int i = 0; i < READERS; i++) {
        const reader_job *job = &c->readers[i];
        pthread_join(job->thread, NULL);
        must(job->disordered == 0, "a reader sees the ticks in order");
        must(job->read + job->lost == b->ring.pushed, "a reader accounts for every record");
    }
}

static void add_up(const bench *b, const char *name)
{
    const rthyb_ticker *t = &b->e.loop.ticker;
    const rthyb_loop_counters *n = &b->e.loop.counters;
    must(t->executed + t->skipped == t->elapsed, "executed + skipped == elapsed");
    must(t->longest_skip > RTHYB_LOST_TICKS || n->records == t->elapsed, "a record for each tick");
    must(n->sent == b->e.near.counters.pieces_out, "what was sent has left");
    printf("%s: %llu ticks, %llu skipped, %llu commands obeyed, %llu refused\n", name,
           (unsigned long long)t->elapsed, (unsigned long long)t->skipped,
           (unsigned long long)obeyed, (unsigned long long)refused);
}

/* The drive's tick, then the loop's; sometimes with skips. */
static void run_stepped(bench *b)
{
    uint64_t random = 2;
    uint64_t executed = 0;
    while (b->e.drive.tick < TICKS) {
        const uint64_t skips = random_below(&random, 100) ? 0 : 1 + random_below(&random, 6);
        for (uint64_t i = 0; i <= skips; i++)
            rthyb_drive_tick(&b->e.drive);
        if (skips)
            rthyb_ticker_miss(&b->e.loop.ticker, skips);
        rthyb_ticker_grant(&b->e.loop.ticker, 1);
        executed += 1 + skips;
        while (peek(&b->e.loop.counters.records) < executed)
            sched_yield();
    }
}

static void stepped_test(bench *b, int race)
{
    company c;
    set_up(b, RTHYB_CLOCK_STEPPED);
    b->race = (uint32_t)race;
    must(rthyb_loop_start(&b->e.loop, 0, -1, -1) == 0, "the tick thread starts");
    gather(&c, b);
    run_stepped(b);
    rthyb_ticker_stop(&b->e.loop.ticker);
    must(rthyb_loop_join(&b->e.loop) == 0, "the tick thread ends");
    dismiss(&c, b);
    add_up(b, "stepped");
    check_parameters(b);
    must(b->e.loop.counters.refused >= refused, "every refusal is counted");
    must(obeyed > 20 && refused > 20, "the operator had his way, and had it not");
    tear_down(b);
}

/* ---- real time ----------------------------------------------------------------------------------- */

static void *drive(void *shared)
{
    bench *b = shared;
    rthyb_drive_run(&b->e.drive, &b->drive_clock);
    return NULL;
}

static void sleep_ns(int64_t ns)
{
    const struct timespec time = {.tv_sec = ns / 1000000000, .tv_nsec = ns % 1000000000};
    clock_nanosleep(CLOCK_MONOTONIC, 0, &time, NULL);
}

static void real_time_test(bench *b, int32_t clock, const char *name)
{
    company c;
    pthread_t thread;
    obeyed = refused = generations = 0;
    set_up(b, clock);
    must(rthyb_ticker_init(&b->drive_clock, RTHYB_CLOCK_HOST, 1024, rthyb_now_ns()) == 0, "a clock");
    start(&thread, drive, b);
    must(rthyb_loop_start(&b->e.loop, 0, -1, -1) == 0, "the tick thread starts");
    gather(&c, b);
    sleep_ns(REAL_TIME_NS);
    rthyb_ticker_stop(&b->e.loop.ticker);
    must(rthyb_loop_join(&b->e.loop) == 0, "the tick thread ends");
    rthyb_ticker_stop(&b->drive_clock);
    pthread_join(thread, NULL);
    dismiss(&c, b);
    add_up(b, name);
    must(b->e.loop.ticker.executed == b->e.loop.ticker.wake.count,
         "each waking is in the histogram");
    tear_down(b);
}

/* ---- tickers alone -------------------------------------------------------------------------------- */

static void *grant(void *shared)
{
    for (int i = 0; i < GRANTS; i++)
        rthyb_ticker_grant(shared, 1);
    return NULL;
}

static void *wait_for_ticks(void *shared)
{
    rthyb_tick tick;
    while (rthyb_ticker_wait(shared, &tick))
        ;
    return NULL;
}

/* Stopped while the others grant and it waits; every third time after everything was done. */
static void ticker_test(void)
{
    uint64_t done = 0;
    for (int n = 0; n < TICKERS; n++) {
        rthyb_ticker ticker;
        pthread_t waiter, granters[GRANTERS];
        must(rthyb_ticker_init(&ticker, RTHYB_CLOCK_STEPPED, 1024, 0) == 0, "a clock");
        start(&waiter, wait_for_ticks, &ticker);
        for (int i = 0; i < GRANTERS; i++)
            start(&granters[i], grant, &ticker);
        while (n % 3 == 0 && peek(&ticker.executed) < GRANTERS * GRANTS)
            sched_yield();
        rthyb_ticker_stop(&ticker);
        pthread_join(waiter, NULL);
        for (int i = 0; i < GRANTERS; i++)
            pthread_join(granters[i], NULL);
        must(ticker.executed <= GRANTERS * GRANTS, "no tick without a word");
        must(n % 3 || ticker.executed == GRANTERS * GRANTS, "a tick for each word");
        done += ticker.executed;
    }
    printf("tickers: %d of them, %llu ticks\n", TICKERS, (unsigned long long)done);
}

int main(int argc, char **argv)
{
    static bench b;
    const int race = argc > 1 && strcmp(argv[1], "race") == 0;
    stepped_test(&b, race);
    if (!race) {
        real_time_test(&b, RTHYB_CLOCK_HOST, "host clock");
        real_time_test(&b, RTHYB_CLOCK_LINK, "link clock");
        ticker_test();
    }
    return faults > 0;
}
