/* The telemetry ring under load, without Python: for a race detector and for timing.
 *
 *   ring_stress                one producer at full speed, three readers, a ring that laps them
 *                              often. Prints "pushed read lost torn disordered", a line per reader.
 *   ring_stress speed          prints "name ns" for one record, the smallest of many rounds. */
#include "rthyb.h"

#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#ifndef CAPACITY
#define CAPACITY 128
#endif

enum { READERS = 3, PUSHES = 400000, TRIP = 3000, BATCH = 32, ROUNDS = 60 };

/* With one axis: a record up to its first axis. */
enum { ROW_BYTES = (RTHYB_TEST_WORDS + RTHYB_AXIS_WORDS) * (int)sizeof(uint64_t) };

typedef struct {
    uint64_t words[RTHYB_TEST_WORDS + RTHYB_AXIS_WORDS];
} row;

typedef struct {
    rthyb_ring_reader ring;
    const int *done;
    uint64_t read, torn, disordered, wanted, newest;
} reader_job;

/* A record in which every word identifies it; sometimes a long TRIP. */
static rthyb_record made(uint64_t n)
{
    const double x = (double)n;
    const int32_t low = (int32_t)(n & 0x7fffffff);
    return (rthyb_record){
        .tick = n,
        .due_ns = (int64_t)n,
        .wake_late_ns = low,
        .sent_late_ns = low,
        .flags = (uint32_t)low,
        .generation = (uint32_t)low,
        .axis[0].x_read_m = x,
        .axis[0].f_read_n = x,
        .state = n / TRIP % 8 == 7 ? RTHYB_TRIPPED : RTHYB_RUNNING,
        .cause = (uint32_t)low,
        .axis[0].missing = (uint32_t)low,
        .axis[0].echo = (uint8_t)n,
        .ag_mps2 = x,
        .x_num_m = x,
        .x_plc_m = x,
        .axis[0].x_cmd_m = x,
        .axis[0].x_meas_m = x,
        .axis[0].f_meas_n = x,
        .alpha = x,
        .beta = x,
        .k_t_n_per_m = x,
        .energy_error_j = x,
        .tracking_indicator_m2 = x,
    };
}

static int is_whole(const rthyb_record *record)
{
    const rthyb_record wanted = made(record->tick);
    return memcmp(record, &wanted, ROW_BYTES) == 0;
}

static void take(reader_job *job, const row *rows, size_t count)
{
    for (size_t i = 0; i < count; i++) {
        const rthyb_record *record = (const void *)rows[i].words;
        job->torn += !is_whole(record);
        job->disordered += record->tick < job->wanted;
        job->wanted = record->tick + 1;
    }
    job->read += count;
}

static void look_at_newest(reader_job *job)
{
    rthyb_record newest;
    if (!rthyb_ring_newest(&job->ring, &newest))
        return;
    job->torn += !is_whole(&newest);
    job->disordered += newest.tick < job->newest;
    job->newest = newest.tick;
}

static void *follow(void *argument)
{
    reader_job *job = argument;
    row rows[BATCH];
    for (;;) {
        const int done = __atomic_load_n(job->done, __ATOMIC_ACQUIRE);
        const size_t count = rthyb_ring_read(&job->ring, rows, BATCH);
        take(job, rows, count);
        look_at_newest(job);
        if (done && count == 0)
            return NULL;
    }
}

static void *new_ring(rthyb_ring *ring, uint32_t capacity, size_t *bytes)
{
    *bytes = rthyb_ring_bytes(capacity, 0, 1, 0);
    void *map = aligned_alloc(4096, (*bytes + 4095) / 4096 * 4096);
    if (!map)
        exit(2);
    memset(map, 0, *bytes);
    rthyb_ring_init(ring, map, capacity, 0, 1, 0);
    return map;
}

static int stress(void)
{
    rthyb_ring ring;
    size_t bytes;
    int done = 0;
    void *map = new_ring(&ring, CAPACITY, &bytes);
    reader_job jobs[READERS] = {0};
    pthread_t threads[READERS];
    for (int i = 0; i < READERS; i++) {
        jobs[i].done = &done;
        if (rthyb_ring_attach(&jobs[i].ring, map, bytes) ||
            pthread_create(&threads[i], NULL, follow, &jobs[i]))
            return 2;
    }
    for (uint64_t n = 0; n < PUSHES; n++) {
        const rthyb_record record = made(n);
        rthyb_ring_push(&ring, &record, NULL);
    }
    __atomic_store_n(&done, 1, __ATOMIC_RELEASE);
    for (int i = 0; i < READERS; i++) {
        (void)pthread_join(threads[i], NULL);
        printf("%llu %llu %llu %llu %llu\n", (unsigned long long)ring.pushed,
               (unsigned long long)jobs[i].read, (unsigned long long)jobs[i].ring.lost,
               (unsigned long long)jobs[i].torn, (unsigned long long)jobs[i].disordered);
    }
    free(map);
    return 0;
}

/* ---- stop-watch ------------------------------------------------------------------------------- */

static double now_ns(void)
{
    struct timespec t;
    (void)timespec_get(&t, TIME_UTC);
    return 1e9 * (double)t.tv_sec + (double)t.tv_nsec;
}

static rthyb_record records[BATCH];
static row rows_read[RTHYB_RING_CAPACITY];

typedef struct {
    rthyb_ring ring;
    rthyb_ring_reader reader;
    rthyb_ring_slot *copies;
} bench;

static void push_all(bench *b)
{
    for (size_t i = 0; i < RTHYB_RING_CAPACITY; i++)
        rthyb_ring_push(&b->ring, &records[i % BATCH], NULL);
}

static void read_all(bench *b)
{
    for (size_t i = 0; i < RTHYB_RING_CAPACITY / BATCH; i++)
        (void)rthyb_ring_read(&b->reader, rows_read[i * BATCH].words, BATCH);
}

/* For comparison: the same bytes to the same two places, without any ordering. */
static void copy_all(bench *b)
{
    for (size_t i = 0; i < RTHYB_RING_CAPACITY; i++) {
        memcpy(b->copies[i].words, &records[i % BATCH], ROW_BYTES);

        __asm__ volatile("" : : "r"(b->copies) : "memory");
    }
}

static double least_ns(void (*work)(bench *), bench *b)
{
    double least = 1e300;
    for (int i = 0; i < ROUNDS; i++) {
        if (work == read_all)
            b->reader.next = b->ring.pushed - RTHYB_RING_CAPACITY;
        const double start = now_ns();
        work(b);
        const double taken = (now_ns() - start) / RTHYB_RING_CAPACITY;
        least = taken < least ? taken : least;
    }
    return least;
}

static int speed(void)
{
    bench b;
    size_t bytes;
    void *map = new_ring(&b.ring, RTHYB_RING_CAPACITY, &bytes);
    b.copies = calloc(RTHYB_RING_CAPACITY, sizeof *b.copies);
    if (!b.copies || rthyb_ring_attach(&b.reader, map, bytes))
        return 2;
    for (size_t i = 0; i < BATCH; i++)
        records[i] = made(i);
    printf("copy %.2f\n", least_ns(copy_all, &b));
    printf("push %.2f\n", least_ns(push_all, &b));
    printf("read %.2f\n", least_ns(read_all, &b));
    free(b.copies);
    free(map);
    return 0;
}

int main(int argc, char **argv)
{
    return argc > 1 && strcmp(argv[1], "speed") == 0 ? speed() : stress();
}
