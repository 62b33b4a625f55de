/* The tick: clock, link, station, record. Between waking up and waiting again it makes no system
 * call but those of the clock and the link, allocates nothing and takes no lock. */
#define _GNU_SOURCE /* NOLINT(bugprone-reserved-identifier,cert-dcl37-c,cert-dcl51-cpp) */

#include <errno.h>
#include <limits.h>
#include <math.h>
#include <pthread.h>
#include <string.h>
#include <time.h>

#include "internal.h"
#include "loop_state.h"
#include "relaxed.h"

#define HEAD_START_NS 20000000 /* from the thread being ready to the first tick */
#define LISTEN_NS 2000000      /* before the first tick: what comes from then on counts */
#define SECOND_NS 1000000000
#define STACK_BYTES (1u << 18)
#define STACK_TOUCHED (1u << 16)
#define COMMAND_BITS 8
#define HALF_PERIOD_NS 488281
#define NS_TO_PPB 1024.0    /* of a period */
#define STALE_ECHO 32       /* samples by which commands may arrive later than they did at rest */
#define ASLEEP_NS 100000000 /* no suspension is shorter; a stall may be, between two clocks */
#define RESYNC_AGE 20       /* ticks of silence after which the drive's count may have wrapped */

_Static_assert(sizeof(pthread_t) <= sizeof(uint64_t), "a thread's name fits its place in the loop");

size_t rthyb_loop_size(void)
{
    return sizeof(rthyb_loop);
}

int rthyb_loop_init(rthyb_loop *loop, const rthyb_loop_config *cfg)
{
    *loop = (rthyb_loop){.cfg = *cfg, .delay = -1};
    int error = rthyb_calibration_check(&cfg->calibration);
    if (!error && cfg->clock == RTHYB_CLOCK_LINK)
        error = rthyb_phase_init(&loop->phase, cfg->lead_ns);
    return error ? error : rthyb_ticker_init(&loop->ticker, cfg->clock, 0);
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

uint64_t rthyb_loop_load(rthyb_loop *loop, const rthyb_load *load)
{
    const uint64_t generation = peek(&loop->loads) + 1;
    loop->load = *load;
    release(&loop->loads, generation);
    return generation;
}

int rthyb_loop_loaded(const rthyb_loop *loop, uint64_t generation)
{
    const uint64_t answer = acquire(&loop->load_answer);
    if (answer >> 1 < generation)
        return 0;
    return answer & 1u ? 2 : 1;
}

/* The drive goes on following: what the last station told it is where the next one begins. One that was
 * replaced before its first reading has told it nothing, and passes on what it was to begin with. */
static void hand_over(rthyb_loop *loop, const rthyb_station *next)
{
    const rthyb_station *last = loop->cfg.station;
    loop->taken_over = last->seen && !next->seen;
    loop->offered = (last->seen || loop->offered) && !next->seen;
    loop->beyond = 0;
    if (!last->seen)
        return;
    loop->taken_cmd_m = last->controller.x_cmd + last->axis[0].tare_cmd;
    loop->offered_x_m = last->axis[0].seen_x;
}

void rthyb_loop_go_on(rthyb_loop *loop, double x_cmd_m, double x_m, uint32_t seq)
{
    loop->cfg.wire->seq = seq;
    loop->offered = 1;
    loop->taken_cmd_m = x_cmd_m;
    loop->offered_x_m = x_m;
}

static void take_load(rthyb_loop *loop, const rthyb_tick *tick)
{
    const uint64_t generation = acquire(&loop->loads);
    if (generation == loop->load_answer >> 1)
        return;
    const rthyb_load *load = &loop->load;
    const int another = load->station != loop->cfg.station;
    const int refused = another && loop->cfg.station->state != RTHYB_IDLE;
    if (!refused) {
        if (another) {
            put(&loop->load_tick, tick->k - tick->skipped);
            hand_over(loop, load->station);
        }
        loop->cfg.station = load->station;
        loop->cfg.ring = load->ring;
        loop->cfg.ag_mps2 = load->ag_mps2;
        loop->cfg.ag_count = load->ag_count;
    }
    release(&loop->load_answer, generation << 1 | (uint64_t)refused);
}

int rthyb_loop_set_parameters(rthyb_loop *loop, rthyb_parameters *parameters)
{
    const int error = rthyb_parameters_check(parameters);
    if (error)
        return error;
    parameters->generation = ++loop->generation;
    rthyb_handover_write(&loop->handover, parameters);
    return 0;
}

static void take_parameters(rthyb_loop *loop)
{
    rthyb_parameters parameters;
    if (!rthyb_handover_read(&loop->handover, &parameters))
        return;
    const int taken = rthyb_station_adopt(loop->cfg.station, &parameters);
    add(taken ? &loop->counters.parameters : &loop->counters.parameters_refused, 1);
    release(&loop->set_answer, (uint64_t)parameters.generation << 1 | (uint64_t)!taken);
}

int rthyb_loop_set_taken(const rthyb_loop *loop, uint32_t generation)
{
    const uint64_t answer = acquire(&loop->set_answer);
    if (answer >> 1 < generation)
        return 0;
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

/* A tick that woke late, or after others that it slept through, says nothing about the drive's clock: it
 * may have taken a sample that was the next one's. One that waits for a sample and not for the time says
 * nothing ever. */
static int is_punctual(const rthyb_loop *loop, const rthyb_tick *tick)
{
    const int timeless = loop->cfg.unpaced && loop->ticker.clock == RTHYB_CLOCK_STEPPED;
    return !timeless && !tick->skipped && tick->woken_ns - tick->due_ns < HALF_PERIOD_NS;
}

static void know_offset(rthyb_loop *loop, int64_t offset)
{
    loop->offset = loop->offset_seen = offset;
    loop->offset_known = 1;
    loop->votes = 0;
    memset(loop->vote_map, 0, sizeof loop->vote_map);
}

/* Keeps the votes of the last RTHYB_SLIP_WINDOW ticks that had one. */
static void vote(rthyb_loop *loop, int for_it)
{
    uint64_t *word = &loop->vote_map[(loop->voted / 64) % (RTHYB_SLIP_WINDOW / 64)];
    const uint64_t bit = (uint64_t)1 << (loop->voted % 64);
    loop->votes += for_it - ((*word & bit) != 0);
    *word = for_it ? *word | bit : *word & ~bit;
    loop->voted++;
}

/* The two clocks against each other; 1 for a slip. A lost or a late pair changes nothing. Where a
 * sample arrives as the tick is due, jitter decides on which side it falls, now here, now there: a
 * slip is one that a clear majority of the last ticks has seen. */
static int has_slipped(rthyb_loop *loop, const rthyb_feedback *feedback, uint64_t k, uint32_t age)
{
    const int64_t offset = (int64_t)(feedback->samples - k);
    if (!loop->offset_known || age >= RESYNC_AGE) {
        know_offset(loop, offset);
    } else {
        if (loop->votes == 0)
            loop->offset_seen = offset;
        vote(loop, offset != loop->offset && offset == loop->offset_seen);
    }
    if (loop->votes < RTHYB_SLIP_VOTES)
        return 0;
    know_offset(loop, loop->offset_seen);
    add(&loop->counters.slips, 1);
    return 1;
}

typedef struct {
    rthyb_feedback feedback;
    int lost, slipped;
} arrival;

/* What came at this instant or before it. */
static void take_in(rthyb_loop *loop, int64_t now_ns)
{
    const uint64_t pairs = peek(&loop->cfg.wire->counters.pairs);
    rthyb_link_drain(loop->cfg.link, loop->cfg.wire);
    if (peek(&loop->cfg.wire->counters.pairs) != pairs)
        loop->arrived_ns = now_ns;
}

/* A drive that acts on old commands is as good as out of reach, however fresh its readings are. One that
 * hears none says so before: its own watchdog is the shorter. What is usual is what was so at rest. */
static int is_belated(rthyb_loop *loop, const rthyb_feedback *feedback)
{
    const int32_t state = loop->cfg.station->state;
    if (feedback->delay < 0)
        return 0;
    if (state == RTHYB_IDLE || state == RTHYB_ZEROED || state == RTHYB_ARMED) {
        loop->usual_delay = feedback->delay;
        return 0;
    }
    return feedback->delay - loop->usual_delay >= STALE_ECHO;
}

static void take_feedback(rthyb_loop *loop, const rthyb_tick *tick, arrival *found)
{
    const uint32_t age = loop->cfg.wire->age;
    take_in(loop, tick->woken_ns);
    found->lost = rthyb_wire_take(loop->cfg.wire, &found->feedback);
    rthyb_wire_tell_extras(loop->cfg.wire, loop->cfg.station->channel);
    found->slipped = 0;
    if (found->lost)
        return;
    put_signed(&loop->delay, found->feedback.delay);
    if (is_belated(loop, &found->feedback)) {
        add(&loop->counters.belated, 1);
        found->lost = RTHYB_LOST;
        return;
    }
    if (is_punctual(loop, tick))
        found->slipped = has_slipped(loop, &found->feedback, tick->k, age);
}

static int send_command(rthyb_loop *loop, const rthyb_station_output *out)
{
    rthyb_frame frame;
    double sent_m = 0.0;
    const double wanted_m =
        command_for_wire(&loop->cfg.wire->codec, &loop->cfg.calibration, &out->axis[0]);
    const int nowhere = isnan(wanted_m) && isfinite(out->axis[0].x_cmd_m);
    const int code = rthyb_wire_command(loop->cfg.wire, wanted_m, out->told, &frame, &sent_m);
    loop->beyond = nowhere || (code & RTHYB_S_OUT_OF_RANGE);
    add(&loop->counters.beyond, (uint64_t)loop->beyond);
    const int sent = !(code & RTHYB_S_NOT_FINITE) && rthyb_link_send(loop->cfg.link, &frame);
    note_command(loop->cfg.station, &loop->cfg.calibration, sent, sent_m);
    add(sent ? &loop->counters.sent : &loop->counters.not_sent, 1);
    return sent;
}

static int32_t short_ns(int64_t ns)
{
    return ns > INT32_MAX ? INT32_MAX : (int32_t)ns;
}

static void complete(rthyb_loop *loop, const rthyb_tick *tick, const arrival *found)
{
    rthyb_record *last = &loop->records[loop->record_count - 1];
    for (uint32_t i = 0; i < loop->record_count; i++) {
        rthyb_record *record = &loop->records[i];
        const uint64_t k = tick->k - (last->tick - record->tick);
        record->due_ns = rthyb_ticker_due_ns(&loop->ticker, k) - loop->ticker.t0_ns;
    }
    last->wake_late_ns = short_ns(tick->woken_ns - tick->due_ns);
    last->axis[0].echo = (uint16_t)found->feedback.echo;
    last->axis[0].count = (uint16_t)found->feedback.count;
    last->flags |= found->slipped ? (uint32_t)RTHYB_F_SLIP : 0u;
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

static void follow_drive(rthyb_loop *loop, const rthyb_tick *tick, const arrival *found)
{
    const int came = !found->lost && is_punctual(loop, tick) && !loop->overheard;
    const double after_due_ns = (double)(loop->arrived_ns - tick->due_ns);
    rthyb_phase *phase = &loop->phase;
    rthyb_ticker_trim(&loop->ticker, rthyb_phase_step(phase, came, after_due_ns));
    put_signed(&loop->arrival_error_ns, llrint(phase->error_ns));
    put_signed(&loop->trim_ppb, llrint(phase->trim_ns * NS_TO_PPB));
    put(&loop->locked, (uint64_t)phase->locked);
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
    put(&loop->state, (uint64_t)loop->cfg.station->state);
    put(&loop->cause, (uint64_t)loop->cfg.station->cause);
    put(&loop->cause_tick, loop->cfg.station->cause_tick);
    add(&loop->counters.records, loop->record_count);
    if (!loop->cfg.ring || loop->record_count == 0)
        return;
    /* Of what was slept through nobody knows more than its record. */
    const uint32_t last = loop->record_count - 1;
    rthyb_ring_push_run(loop->cfg.ring, loop->records, last, NULL);
    rthyb_ring_push(loop->cfg.ring, &loop->records[last], loop->cfg.station->channel);
}

/* Also if it was down and is back already: between two ticks, a lot can happen to a plug. And if it took
 * no command for as long as the drive's own watchdog waits: a drive that cannot say so has stopped. */
static int is_down(rthyb_loop *loop)
{
    const uint64_t times = peek(&loop->cfg.link->counters.times_down);
    const int again = times != loop->downs_seen || loop->unsent >= RTHYB_DRIVE_WATCHDOG;
    loop->downs_seen = times;
    return again || peek(&loop->cfg.link->down) != RTHYB_LINK_UP;
}

/* Whether the station is to go on with the command that the drive has. Until a reading is good enough for
 * it nothing is sent: a drive that stops, or moves, meanwhile has that command no more. */
static int takes_over(rthyb_loop *loop, const arrival *found, double x_m, int stopped)
{
    const int still = fabs(x_m - loop->offered_x_m) <= loop->cfg.station->cfg.axis[0].rest_spread_m;
    const int elsewhere = !found->lost && !loop->taken_over && !still;
    loop->offered = loop->offered && !loop->cfg.station->seen && !stopped && !elsewhere;
    return !found->lost && (loop->taken_over || loop->offered);
}

static void note_delay(rthyb_loop *loop, const arrival *found)
{
    const int32_t delay = found->feedback.delay, most = RTHYB_LINK_DELAYS - 1;
    const int running = loop->records[loop->record_count - 1].state == RTHYB_RUNNING;
    if (running && !found->lost && delay >= 0)
        add(&loop->delays[delay < most ? delay : most], 1);
}

/* Ticks that the station has to be told of as skipped. The clock of the ticks stands still while the PC is
 * suspended, the drive does not. */
static uint32_t skipped_ticks(rthyb_loop *loop, const rthyb_tick *tick)
{
    const int timeless = loop->ticker.clock == RTHYB_CLOCK_STEPPED && !loop->cfg.unpaced;
    const int woke_up = !timeless && rthyb_ticker_slept_ns(&loop->ticker) >= ASLEEP_NS;
    if (woke_up)
        add(&loop->counters.suspended, 1);
    const uint64_t skipped =
        woke_up && tick->skipped < RTHYB_LOST_TICKS ? RTHYB_LOST_TICKS : tick->skipped;
    return skipped < UINT32_MAX ? (uint32_t)skipped : UINT32_MAX;
}

static rthyb_station_input gather(rthyb_loop *loop, const rthyb_tick *tick, uint64_t mail,
                                  arrival *found)
{
    take_feedback(loop, tick, found);
    const int stopped = (found->feedback.status & RTHYB_DEVICE_STOPPED) != 0;
    const int down = is_down(loop);
    const double x_m = calibrated_x(&loop->cfg.calibration, found->feedback.x_m);
    const int waiting = mail >> COMMAND_BITS != loop->answer >> COMMAND_BITS;
    add(&loop->counters.down, (uint64_t)down);
    add(&loop->counters.stopped, (uint64_t)stopped);
    return (rthyb_station_input){
        .axis = {{.x_m = x_m,
                  .f_n = calibrated_f(&loop->cfg.calibration, found->feedback.f_n),
                  .x_cmd_m = loop->taken_cmd_m}},
        .lost = found->lost,
        .skipped = skipped_ticks(loop, tick),
        .command = waiting ? (int32_t)(mail & ((1u << COMMAND_BITS) - 1u)) : RTHYB_CMD_NONE,
        .link_down = down,
        .drive_stopped = stopped,
        .heartbeat_late = heartbeat_late(loop, 1 + tick->skipped),
        .beyond = loop->beyond,
        .taken_over = takes_over(loop, found, x_m, stopped),
    };
}

static void execute(rthyb_loop *loop, const rthyb_tick *tick)
{
    arrival found;
    rthyb_station_output out;
    take_load(loop, tick);
    take_parameters(loop);
    const uint64_t mail = acquire(&loop->mail);
    const rthyb_station_input in = gather(loop, tick, mail, &found);
    rthyb_station_tick(loop->cfg.station, &in, loop->cfg.ag_mps2, loop->cfg.ag_count, loop->records,
                       &out);
    loop->record_count = out.records;
    loop->taken_over = 0;
    complete(loop, tick, &found);
    note_delay(loop, &found);
    const int sent = !out.send || send_command(loop, &out);
    loop->unsent = sent ? 0 : loop->unsent + 1;
    if (out.send)
        note_sent(loop, tick, sent);
    rthyb_station_advance(loop->cfg.station);
    if (loop->ticker.clock == RTHYB_CLOCK_LINK)
        follow_drive(loop, tick, &found);
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

/* Until the tick is due: takes in what comes, and notes when. A link that babbles wakes it so many
 * times and no more; what it brings after that has no stamp. */
static void listen(rthyb_loop *loop)
{
    loop->overheard = 0;
    const int64_t due_ns = rthyb_ticker_due_ns(&loop->ticker, loop->ticker.elapsed);
    for (int i = 0; i < RTHYB_WAKE_UPS_MAX; i++) {
        if (!rthyb_link_wait(loop->cfg.link, due_ns - rthyb_now_ns()))
            return;
        add(&loop->counters.wake_ups, 1);
        take_in(loop, rthyb_now_ns());
    }
    loop->overheard = 1;
}

static int wait_for_tick(rthyb_loop *loop, rthyb_tick *tick)
{
    if (loop->ticker.clock == RTHYB_CLOCK_LINK)
        listen(loop);
    return rthyb_ticker_wait(&loop->ticker, tick);
}

/* A packet that came in part goes on: its rest shall not count as damage. */
void rthyb_loop_drop_old(rthyb_loop *loop)
{
    rthyb_frame frame, packet;
    const int serial = loop->cfg.wire->codec.format == RTHYB_WIRE_SERIAL;
    for (int i = 0; i < RTHYB_OLD_PIECES_MAX && rthyb_link_receive(loop->cfg.link, &frame); i++) {
        for (int32_t at = 0; serial && at < frame.length; at++)
            (void)rthyb_deframer_byte(&loop->cfg.wire->deframer, frame.data[at], &packet);
        add(&loop->counters.old, 1);
    }
    loop->downs_seen = peek(&loop->cfg.link->counters.times_down);
}

/* The first tick is one like all others: what it takes came just before it. */
static void set_off(rthyb_loop *loop)
{
    put_signed(&loop->ticker.t0_ns, rthyb_now_ns() + HEAD_START_NS);
    const int64_t until_ns = loop->ticker.t0_ns - LISTEN_NS;
    const struct timespec until = {.tv_sec = until_ns / SECOND_NS, .tv_nsec = until_ns % SECOND_NS};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL) == EINTR)
        ;
    rthyb_loop_drop_old(loop);
}

static void *tick_thread(void *shared)
{
    rthyb_loop *loop = shared;
    rthyb_tick tick;
    rthyb_usage before;
    loop->privileges =
        rthyb_thread_become_real_time(loop->priority, loop->cpu, loop->latency_fd, STACK_TOUCHED);
    if (loop->ticker.clock != RTHYB_CLOCK_STEPPED)
        set_off(loop);
    rthyb_thread_usage(&before);
    while (wait_for_tick(loop, &tick))
        execute(loop, &tick);
    rthyb_usage_since(&loop->usage, &before);
    return NULL;
}

int rthyb_loop_start(rthyb_loop *loop, int32_t priority, int32_t cpu, int32_t latency_fd)
{
    loop->priority = priority;
    loop->cpu = cpu;
    loop->latency_fd = latency_fd;
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

static int ended_at_rest(const rthyb_station *s)
{
    return s->seen &&
           (s->state == RTHYB_IDLE || s->state == RTHYB_ZEROED || s->state == RTHYB_ARMED);
}

int rthyb_loop_last(const rthyb_loop *loop, double *x_cmd_m, double *x_m, uint32_t *seq)
{
    const rthyb_station *s = loop->cfg.station;
    *x_cmd_m = s->controller.x_cmd + s->axis[0].tare_cmd;
    *x_m = s->axis[0].seen_x;
    *seq = loop->cfg.wire->seq;
    return ended_at_rest(s);
}

int rthyb_loop_leave(rthyb_loop *loop)
{
    const rthyb_station *s = loop->cfg.station;
    if (!ended_at_rest(s))
        return 0;
    /* What has left once is on a value of the wire. */
    rthyb_frame frame;
    double sent_m;
    const double wire_m =
        command_to_wire(&loop->cfg.calibration, s->controller.x_cmd + s->axis[0].tare_cmd);
    const int code =
        rthyb_wire_command(loop->cfg.wire, wire_m, RTHYB_TOLD_LEAVING, &frame, &sent_m);
    return !(code & RTHYB_S_NOT_FINITE) && rthyb_link_send(loop->cfg.link, &frame);
}

int rthyb_loop_join(rthyb_loop *loop)
{
    pthread_t thread;
    memcpy(&thread, &loop->thread, sizeof thread);
    return pthread_join(thread, NULL);
}

/* ---- what others may know of it ------------------------------------------------------------------ */

void rthyb_loop_look(const rthyb_loop *loop, rthyb_loop_view *view)
{
    *view = (rthyb_loop_view){
        .state = peek(&loop->state),
        .cause = peek(&loop->cause),
        .cause_tick = peek(&loop->cause_tick),
        .load_tick = peek(&loop->load_tick),
        .began_ns = peek_signed(&loop->ticker.t0_ns),
        .arrival_error_ns = peek_signed(&loop->arrival_error_ns),
        .trim_ppb = peek_signed(&loop->trim_ppb),
        .locked = peek(&loop->locked),
        .delay = peek_signed(&loop->delay),
    };
}

const rthyb_loop_counters *rthyb_loop_counted(const rthyb_loop *loop)
{
    return &loop->counters;
}

const uint64_t *rthyb_loop_delays(const rthyb_loop *loop)
{
    return loop->delays;
}

const rthyb_latency *rthyb_loop_sent(const rthyb_loop *loop)
{
    return &loop->sent;
}

rthyb_ticker *rthyb_loop_ticker(rthyb_loop *loop)
{
    return &loop->ticker;
}

const rthyb_record *rthyb_loop_records(const rthyb_loop *loop, uint32_t *count)
{
    *count = loop->record_count;
    return loop->records;
}

uint32_t rthyb_loop_ended(const rthyb_loop *loop, rthyb_usage *usage)
{
    *usage = loop->usage;
    return loop->privileges;
}
