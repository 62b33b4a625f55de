/* The tick: clock, link, station, record. Between waking up and waiting again it makes no system
 * call but those of the clock and the link, allocates nothing and takes no lock. */
#define _GNU_SOURCE /* NOLINT(bugprone-reserved-identifier,cert-dcl37-c,cert-dcl51-cpp) */

#include <limits.h>
#include <pthread.h>
#include <string.h>

#include "internal.h"
#include "relaxed.h"

#define HEAD_START_NS 20000000 /* from the thread being ready to the first tick */
#define STACK_BYTES (1u << 18)
#define STACK_TOUCHED (1u << 16)
#define COMMAND_BITS 8
#define RESYNC_AGE 20 /* ticks of silence after which the drive's count may have wrapped */

_Static_assert(sizeof(pthread_t) <= sizeof(uint64_t), "a thread's name fits rthyb_loop.thread");

int rthyb_loop_init(rthyb_loop *loop, int32_t clock)
{
    *loop = (rthyb_loop){
        .station = loop->station,
        .wire = loop->wire,
        .link = loop->link,
        .ring = loop->ring,
        .ag_mps2 = loop->ag_mps2,
        .ag_count = loop->ag_count,
        .delay = -1,
        .cpu = -1,
        .latency_fd = -1,
    };
    return rthyb_ticker_init(&loop->ticker, clock, 0);
}

/* ---- mailbox and heartbeat -------------------------------------------------------------------- */

static uint64_t acquire(const uint64_t *word)
{
    return __atomic_load_n(word, __ATOMIC_ACQUIRE);
}

/* NOLINTNEXTLINE(readability-non-const-parameter): the store is a builtin */
static void release(uint64_t *word, uint64_t value)
{
    __atomic_store_n(word, value, __ATOMIC_RELEASE);
}

uint64_t rthyb_loop_command(rthyb_loop *loop, int32_t command)
{
    const uint64_t last = peek(&loop->mail) >> COMMAND_BITS;
    const int answered = acquire(&loop->answer) >> COMMAND_BITS == last;
    if (command <= RTHYB_CMD_NONE || command >= RTHYB_CMD_COUNT)
        return 0;
    if (!answered && command != RTHYB_CMD_TRIP)
        return 0;
    release(&loop->mail, (last + 1) << COMMAND_BITS | (uint64_t)command);
    return last + 1;
}

int rthyb_loop_answered(const rthyb_loop *loop, uint64_t generation, uint64_t *tick)
{
    const uint64_t answer = acquire(&loop->answer);
    if (answer >> COMMAND_BITS < generation)
        return 0;
    *tick = peek(&loop->answer_tick);
    return answer & 1u ? 2 : 1;
}

void rthyb_loop_beat(rthyb_loop *loop)
{
    __atomic_fetch_add(&loop->heartbeat, 1u, __ATOMIC_RELAXED);
}

static int heartbeat_late(rthyb_loop *loop, uint64_t ticks)
{
    const uint64_t beat = peek(&loop->heartbeat);
    loop->silence = beat == loop->heard ? loop->silence + ticks : 0;
    loop->heard = beat;
    const int late = loop->silence > RTHYB_HEARTBEAT_TICKS;
    add(&loop->counters.late_heartbeats, (uint64_t)late);
    return late;
}

/* ---- one tick --------------------------------------------------------------------------------- */

/* The two clocks against each other. A lost pair changes nothing, one that comes late for good is a
 * slip as much as one that comes early. */
static void watch_slip(rthyb_loop *loop, const rthyb_feedback *feedback, uint64_t k, uint32_t age)
{
    const int64_t offset = (int64_t)(feedback->samples - k);
    if (loop->offset_known && age < RESYNC_AGE && offset != loop->offset)
        add(&loop->counters.slips, 1);
    loop->offset = offset;
    loop->offset_known = 1;
}

static int take_feedback(rthyb_loop *loop, const rthyb_tick *tick, rthyb_feedback *feedback)
{
    const uint32_t age = loop->wire->age;
    rthyb_link_drain(loop->link, loop->wire);
    const int lost = rthyb_wire_take(loop->wire, feedback);
    if (!lost) {
        loop->delay = feedback->delay;
        watch_slip(loop, feedback, tick->k, age);
    }
    return lost;
}

/* The displacement that the drive has for the next tick: the one on the wire, to its last digit, or
 * the one before where none has left. */
static int send_command(rthyb_loop *loop, const rthyb_station_output *out)
{
    rthyb_frame frame;
    double sent_m = 0.0;
    rthyb_station *station = loop->station;
    const int code = rthyb_wire_command(loop->wire, out->x_cmd_m, out->state, &frame, &sent_m);
    const int sent = !(code & RTHYB_S_NOT_FINITE) && rthyb_link_send(loop->link, &frame);
    station->controller.x_cmd = sent ? sent_m - station->tare_x : station->controller.x_cmd1;
    add(sent ? &loop->counters.sent : &loop->counters.not_sent, 1);
    return sent;
}

static int32_t short_ns(int64_t ns)
{
    return ns > INT32_MAX ? INT32_MAX : (int32_t)ns;
}

/* The raw reading of a tick without a pair: 0 where nothing came, the lowest value for no number. */
static int32_t raw(int32_t value, int lost)
{
    if (!lost)
        return value;
    return lost & RTHYB_S_NOT_FINITE ? INT32_MIN : 0;
}

static void complete(rthyb_loop *loop, const rthyb_tick *tick, const rthyb_feedback *feedback,
                     int lost)
{
    rthyb_record *last = &loop->records[loop->record_count - 1];
    for (uint32_t i = 0; i < loop->record_count; i++) {
        rthyb_record *record = &loop->records[i];
        const uint64_t k = tick->k - (last->tick - record->tick);
        record->due_ns = rthyb_ticker_due_ns(&loop->ticker, k) - loop->ticker.t0_ns;
    }
    last->wake_late_ns = short_ns(tick->woken_ns - tick->due_ns);
    last->x_raw = raw(feedback->x_raw, lost);
    last->f_raw = raw(feedback->f_raw, lost);
    last->echo = (uint8_t)feedback->echo;
    last->count = (uint8_t)feedback->count;
}

static void note_sent(rthyb_loop *loop, const rthyb_tick *tick, int sent)
{
    rthyb_record *record = &loop->records[loop->record_count - 1];
    const uint32_t flag = RTHYB_F_NOT_SENT;
    record->flags = sent ? record->flags & ~flag : record->flags | flag;
    if (!sent || loop->ticker.clock == RTHYB_CLOCK_STEPPED)
        return;
    const int64_t now_ns = rthyb_now_ns();
    record->sent_late_ns = short_ns(now_ns - tick->due_ns);
    rthyb_latency_record(&loop->sent, now_ns - tick->woken_ns);
}

static void answer(rthyb_loop *loop, uint64_t mail, int refused, uint64_t tick)
{
    const uint64_t generation = mail >> COMMAND_BITS;
    if (generation == loop->answer >> COMMAND_BITS)
        return;
    add(&loop->counters.refused, (uint64_t)(refused != 0));
    put(&loop->answer_tick, tick);
    release(&loop->answer, generation << COMMAND_BITS | (uint64_t)(refused != 0));
}

static void publish(rthyb_loop *loop)
{
    put(&loop->state, (uint64_t)loop->station->state);
    put(&loop->cause, (uint64_t)loop->station->cause);
    add(&loop->counters.records, loop->record_count);
    if (loop->ring)
        rthyb_ring_push_run(loop->ring, loop->records, loop->record_count);
}

/* Also if it was down and is back already: between two ticks, a lot can happen to a plug. */
static int is_down(rthyb_loop *loop)
{
    const uint64_t times = peek(&loop->link->counters.times_down);
    const int again = times != loop->downs_seen;
    loop->downs_seen = times;
    return again || loop->link->down != RTHYB_LINK_UP;
}

static rthyb_station_input gather(rthyb_loop *loop, const rthyb_tick *tick, uint64_t mail,
                                  rthyb_feedback *feedback)
{
    const int lost = take_feedback(loop, tick, feedback);
    const int stopped = !lost && feedback->status & RTHYB_DEVICE_STOPPED;
    const int down = is_down(loop) || stopped;
    const int waiting = mail >> COMMAND_BITS != loop->answer >> COMMAND_BITS;
    add(&loop->counters.down, (uint64_t)down);
    return (rthyb_station_input){
        .x_m = feedback->x_m,
        .f_n = feedback->f_n,
        .lost = lost,
        .skipped = tick->skipped < UINT32_MAX ? (uint32_t)tick->skipped : UINT32_MAX,
        .command = waiting ? (int32_t)(mail & ((1u << COMMAND_BITS) - 1u)) : RTHYB_CMD_NONE,
        .link_down = down,
        .heartbeat_late = heartbeat_late(loop, 1 + tick->skipped),
    };
}

static void execute(rthyb_loop *loop, const rthyb_tick *tick)
{
    rthyb_feedback feedback;
    rthyb_station_output out;
    const uint64_t mail = acquire(&loop->mail);
    const rthyb_station_input in = gather(loop, tick, mail, &feedback);
    rthyb_station_tick(loop->station, &in, loop->ag_mps2, loop->ag_count, loop->records, &out);
    loop->record_count = out.records;
    complete(loop, tick, &feedback, in.lost);
    if (out.send)
        note_sent(loop, tick, send_command(loop, &out));
    publish(loop);
    answer(loop, mail, out.refused, tick->k);
}

void rthyb_loop_step(rthyb_loop *loop)
{
    rthyb_tick tick;
    rthyb_ticker_step(&loop->ticker, &tick);
    execute(loop, &tick);
}

/* ---- its thread ------------------------------------------------------------------------------- */

static void *tick_thread(void *shared)
{
    rthyb_loop *loop = shared;
    rthyb_tick tick;
    rthyb_usage before;
    loop->privileges =
        rthyb_thread_become_real_time(loop->priority, loop->cpu, loop->latency_fd, STACK_TOUCHED);
    if (loop->ticker.clock == RTHYB_CLOCK_HOST)
        loop->ticker.t0_ns = rthyb_now_ns() + HEAD_START_NS;
    rthyb_thread_usage(&before);
    while (rthyb_ticker_wait(&loop->ticker, &tick))
        execute(loop, &tick);
    rthyb_usage_since(&loop->usage, &before);
    return NULL;
}

int rthyb_loop_start(rthyb_loop *loop)
{
    pthread_attr_t attributes;
    pthread_t thread;
    int error = pthread_attr_init(&attributes);
    if (error)
        return error;
    error = pthread_attr_setstacksize(&attributes, STACK_BYTES);
    if (!error)
        error = pthread_create(&thread, &attributes, tick_thread, loop);
    if (!error)
        memcpy(&loop->thread, &thread, sizeof thread);
    pthread_attr_destroy(&attributes);
    return error;
}

int rthyb_loop_join(rthyb_loop *loop)
{
    pthread_t thread;
    memcpy(&thread, &loop->thread, sizeof thread);
    return pthread_join(thread, NULL);
}
