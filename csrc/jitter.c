/* How punctual is this PC? One thread executes a payload at the given rate; at the same time, half
 * a period later, another one executes nothing. */
#define _GNU_SOURCE /* NOLINT(bugprone-reserved-identifier,cert-dcl37-c,cert-dcl51-cpp) */

#include <errno.h>
#include <pthread.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "internal.h"

#define SECOND_NS 1000000000
#define HEAD_START_NS 20000000 /* from the last thread being ready to the first tick */
#define STACK_BYTES (1u << 18)
#define STACK_TOUCHED (1u << 16)
#define NAP_NS 1000000

typedef struct {
    double x_m, f_n;
} pair;

/* Shared by the threads of one run. */
typedef struct {
    rthyb_jitter *jitter;
    int sockets[2];   /* the controller's, the rig's */
    uint32_t ready;   /* threads waiting for the start */
    int64_t start_ns; /* 0: not set yet */
} meeting;

typedef struct {
    pthread_t threads[3];
    uint32_t count;
} team;

static int stop_requested(const rthyb_jitter *jitter)
{
    return __atomic_load_n(&jitter->stop, __ATOMIC_ACQUIRE) != 0;
}

static void nap(void)
{
    const struct timespec time = {.tv_nsec = NAP_NS};
    clock_nanosleep(CLOCK_MONOTONIC, 0, &time, NULL);
}

static uint32_t prepare(const rthyb_jitter *jitter, int32_t cpu)
{
    return rthyb_thread_become_real_time(jitter->priority, cpu, jitter->latency_fd, STACK_TOUCHED);
}

/* Reports that this thread is ready; returns the time of the first tick, 0 if there is none. */
static int64_t meet(meeting *m)
{
    int64_t start_ns = 0;
    __atomic_fetch_add(&m->ready, 1u, __ATOMIC_RELEASE);
    while (!start_ns && !stop_requested(m->jitter)) {
        nap();
        start_ns = __atomic_load_n(&m->start_ns, __ATOMIC_ACQUIRE);
    }
    return start_ns;
}

/* ---- payloads -------------------------------------------------------------------------------- */

static double excitation_at(const rthyb_jitter *jitter, uint64_t k)
{
    return jitter->excitation[k % jitter->excitation_count];
}

/* What the tick thread of a test also does with its record. */
static void keep(const rthyb_jitter *jitter, const rthyb_record *record)
{
    if (jitter->ring)
        rthyb_ring_push(jitter->ring, record, NULL);
}

/* Skipped ticks are not made up for: this measures timing, not motion. */
static void sample(rthyb_jitter *jitter, const rthyb_tick *tick)
{
    rthyb_record record;
    rthyb_input in = {.excitation = excitation_at(jitter, tick->k)};
    rthyb_rig_step(jitter->rig, jitter->controller->axis[0].x_cmd, &in.axis[0].x_meas_m,
                   &in.axis[0].f_meas_n);
    rthyb_controller_step(jitter->controller, &in, &record);
    keep(jitter, &record);
}

/* Receives everything and keeps the newest; computes; sends. None of this waits. */
static void exchange(rthyb_jitter *jitter, const rthyb_tick *tick, int socket)
{
    rthyb_record record;
    rthyb_input in = {.excitation = excitation_at(jitter, tick->k), .axis = {{.lost = RTHYB_LOST}}};
    pair newest = {0};
    while (recv(socket, &newest, sizeof newest, MSG_DONTWAIT) == (ssize_t)sizeof newest)
        in.axis[0].lost = 0;
    in.axis[0].x_meas_m = newest.x_m;
    in.axis[0].f_meas_n = newest.f_n;
    rthyb_controller_step(jitter->controller, &in, &record);
    const double command = jitter->controller->axis[0].x_cmd;
    const ssize_t sent = send(socket, &command, sizeof command, MSG_DONTWAIT | MSG_NOSIGNAL);
    keep(jitter, &record);
    jitter->measured.lost += in.axis[0].lost ? 1u : 0u;
    jitter->measured.not_sent += sent == (ssize_t)sizeof command ? 0u : 1u;
}

static void carry(meeting *m, const rthyb_tick *tick)
{
    rthyb_jitter *jitter = m->jitter;
    if (jitter->payload == RTHYB_PAYLOAD_NONE)
        return;
    if (jitter->payload == RTHYB_PAYLOAD_SAMPLE)
        sample(jitter, tick);
    else
        exchange(jitter, tick, m->sockets[0]);
    rthyb_latency_record(&jitter->measured.sent, rthyb_now_ns() - tick->woken_ns);
}

/* ---- threads --------------------------------------------------------------------------------- */

static void keep_time(meeting *m, rthyb_timing *timing, int64_t offset_ns)
{
    rthyb_tick tick;
    rthyb_usage before;
    timing->privileges = prepare(m->jitter, m->jitter->cpu);
    const int64_t start_ns = meet(m);
    if (!start_ns)
        return;
    (void)rthyb_ticker_init(&timing->ticker, RTHYB_CLOCK_HOST, m->jitter->rate_hz,
                            start_ns + offset_ns);
    rthyb_thread_usage(&before);
    while (timing->ticker.elapsed < m->jitter->ticks && !stop_requested(m->jitter) &&
           rthyb_ticker_wait(&timing->ticker, &tick)) {
        if (timing == &m->jitter->measured)
            carry(m, &tick);
    }
    rthyb_usage_since(&timing->usage, &before);
}

static void *measured_thread(void *shared)
{
    meeting *m = shared;
    keep_time(m, &m->jitter->measured, 0);
    return NULL;
}

static void *reference_thread(void *shared)
{
    meeting *m = shared;
    keep_time(m, &m->jitter->reference, SECOND_NS / 2 / m->jitter->rate_hz);
    return NULL;
}

/* The rig at the other end of the link: answers each command with the pair latched before it. */
static void *rig_thread(void *shared)
{
    meeting *m = shared;
    double command;
    pair latched;
    prepare(m->jitter, -1);
    __atomic_fetch_add(&m->ready, 1u, __ATOMIC_RELEASE);
    while (recv(m->sockets[1], &command, sizeof command, 0) == (ssize_t)sizeof command) {
        rthyb_rig_step(m->jitter->rig, command, &latched.x_m, &latched.f_n);
        send(m->sockets[1], &latched, sizeof latched, MSG_DONTWAIT | MSG_NOSIGNAL);
    }
    return NULL;
}

/* ---- a run ----------------------------------------------------------------------------------- */

static int begin(team *crew, const pthread_attr_t *attributes, void *(*thread)(void *), meeting *m)
{
    const int error = pthread_create(&crew->threads[crew->count], attributes, thread, m);
    crew->count += error ? 0u : 1u;
    return error;
}

static int begin_all(team *crew, meeting *m)
{
    pthread_attr_t attributes;
    int error = pthread_attr_init(&attributes);
    if (error)
        return error;
    error = pthread_attr_setstacksize(&attributes, STACK_BYTES);
    if (!error)
        error = begin(crew, &attributes, measured_thread, m);
    if (!error)
        error = begin(crew, &attributes, reference_thread, m);
    if (!error && m->jitter->payload == RTHYB_PAYLOAD_EXCHANGE)
        error = begin(crew, &attributes, rig_thread, m);
    pthread_attr_destroy(&attributes);
    return error;
}

static void give_start(meeting *m, uint32_t count)
{
    while (__atomic_load_n(&m->ready, __ATOMIC_ACQUIRE) < count && !stop_requested(m->jitter))
        nap();
    __atomic_store_n(&m->start_ns, rthyb_now_ns() + HEAD_START_NS, __ATOMIC_RELEASE);
}

/* The rig waits for commands; its thread ends when the link is closed after the last one. */
static void join_all(const team *crew, const meeting *m)
{
    for (uint32_t i = 0; i < crew->count; i++) {
        if (i == 2)
            shutdown(m->sockets[0], SHUT_RDWR);
        pthread_join(crew->threads[i], NULL);
    }
}

static int payload_ok(const rthyb_jitter *jitter)
{
    if (jitter->payload == RTHYB_PAYLOAD_NONE)
        return 1;
    return (jitter->payload == RTHYB_PAYLOAD_SAMPLE || jitter->payload == RTHYB_PAYLOAD_EXCHANGE) &&
           jitter->controller && jitter->rig && jitter->excitation && jitter->excitation_count > 0;
}

int rthyb_jitter_run(rthyb_jitter *jitter)
{
    meeting m = {.jitter = jitter};
    team crew = {.count = 0};
    rthyb_ticker trial;
    if (!payload_ok(jitter) || rthyb_ticker_init(&trial, RTHYB_CLOCK_HOST, jitter->rate_hz, 0))
        return EINVAL;
    if (socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0, m.sockets))
        return errno;
    const int error = begin_all(&crew, &m);
    if (error)
        rthyb_jitter_stop(jitter);
    else
        give_start(&m, crew.count);
    join_all(&crew, &m);
    close(m.sockets[0]);
    close(m.sockets[1]);
    return error;
}

void rthyb_jitter_stop(rthyb_jitter *jitter)
{
    __atomic_store_n(&jitter->stop, 1u, __ATOMIC_RELEASE);
}
