/* The tick: clock, link, station, record. Between waking up and waiting again, it makes no system
 * calls except those of the clock and the link, allocates no memory and takes no lock. */
#define _GNU_SOURCE /* NOLINT(bugprone-reserved-identifier,cert-dcl37-c,cert-dcl51-cpp) */

#include <errno.h>
#include <limits.h>
#include <math.h>
#include <pthread.h>
#include <string.h>
#include <time.h>

#include "internal.h"
#include "loop_state.h"
#include "numeric.h"
#include "relaxed.h"

#define HEAD_START_NS 20000000 /* from the thread being ready to the first tick */
#define LISTEN_NS 2000000      /* shortest time before the first tick in which data is accepted */
#define FIRST_PAIRS 16         /* pairs whose arrival times determine the first tick */
#define SECOND_NS 1000000000
#define STACK_BYTES (1u << 18)
#define STACK_TOUCHED (1u << 16)
#define COMMAND_BITS 8
#define STALE_ECHO 32 /* samples of 1/1024 s by which commands may arrive later than at rest */
#define ASLEEP_NS 100000000 /* no suspension is shorter; a stall between two clock reads may be */
#define RESYNC_AGE 20       /* ticks without data after which the drive's count may have wrapped */

_Static_assert(sizeof(pthread_t) <= sizeof(uint64_t), "a thread's name fits its place in the loop");

size_t rthyb_loop_size(void)
{
    return sizeof(rthyb_loop);
}

/* With few bits, an echo is ambiguous for long delays, so above 1024 Hz the limit is lowered to a
 * quarter of its range. At 1024 Hz and below it is never lowered: either the bits suffice, or they
 * never did. */
static int32_t stale_samples(const rthyb_wire *wire, double h)
{
    const uint32_t wanted = standard_ticks(STALE_ECHO, h), unambiguous = wire->echo_mask / 4;
    const uint32_t most = unambiguous > STALE_ECHO ? unambiguous : STALE_ECHO;
    return (int32_t)(wanted < most ? wanted : most);
}

/* The slots of a ring are as long as a row for its number of axes; a row for another number does
 * not fit into them. */
static int ring_fits(const rthyb_ring *ring, int32_t axes)
{
    return !ring || ring->record_words * sizeof(uint64_t) == record_bytes(axes);
}

static int sensors_of(const rthyb_station *station)
{
    return rthyb_kinematics_sensors(&station->cfg.controller.kinematics);
}

/* Whether two stations have as many sensors of each kind, so that their readings are in the same
 * channels. */
static int same_sensors(const rthyb_station *a, const rthyb_station *b)
{
    const rthyb_kinematics_config *of_a = &a->cfg.controller.kinematics;
    const rthyb_kinematics_config *of_b = &b->cfg.controller.kinematics;
    return of_a->displacement_sensors == of_b->displacement_sensors &&
           of_a->force_sensors == of_b->force_sensors;
}

/* Links that the loop receives from: those of the axes, then those that it only hears. */
static int32_t ways_of(const rthyb_loop *loop)
{
    return loop->axis_count + loop->cfg.heard_count;
}

/* Whether all links fit, and the channels for the pairs of those that are only heard. */
static int heard_ok(const rthyb_loop_config *cfg)
{
    const int32_t axes = cfg->station->cfg.controller.axis_count, heard = cfg->heard_count;
    return heard >= 0 && heard <= RTHYB_COUPLED_MAX - axes &&
           cfg->heard_channel <= (uint32_t)(RTHYB_CHANNELS_MAX - 2 * RTHYB_COUPLED_MAX);
}

/* Whether the reading of each sensor without an actuator of a station is an extra channel of an
 * axis or of a drive that is heard, which carries the whole range of the sensor: at the end of what the channel can carry, a
 * reading must be at the end of that range. */
static int sensors_ok(const rthyb_loop_config *cfg, const rthyb_station *station)
{
    const int ways = cfg->station->cfg.controller.axis_count + cfg->heard_count;
    for (int k = 0; k < sensors_of(station); k++) {
        const int32_t axis = cfg->sensor_axis[k];
        const double range = station->cfg.lone[k].range;
        if (axis < 0 || axis >= ways || !(range > 0.0) ||
            !(rthyb_extra_reach(&cfg->axis[axis].wire->codec, cfg->sensor_extra[k]) >= range))
            return 0;
    }
    return 1;
}

int rthyb_loop_init(rthyb_loop *loop, const rthyb_loop_config *cfg)
{
    const double h = cfg->station->cfg.controller.period_s;
    memset(loop, 0, sizeof *loop);
    loop->cfg = *cfg;
    loop->axis_count = cfg->station->cfg.controller.axis_count;
    loop->apart = RTHYB_APART_UNKNOWN;
    loop->rate_hz = rthyb_ticker_rate_hz(h);
    if (!loop->rate_hz)
        return RTHYB_E_PERIOD;
    if (!heard_ok(cfg) || !sensors_ok(cfg, cfg->station))
        return RTHYB_E_KINEMATICS;
    loop->heartbeat_ticks = standard_ticks(RTHYB_HEARTBEAT_TICKS, h);
    loop->watchdog_ticks = standard_ticks(RTHYB_DRIVE_WATCHDOG, h);
    loop->half_period_ns = SECOND_NS / 2 / loop->rate_hz;
    int error = ring_fits(cfg->ring, loop->axis_count) ? 0 : RTHYB_E_LIMIT;
    for (int i = 0; i < ways_of(loop); i++) {
        loop->way[i].delay = -1;
        loop->way[i].stale = stale_samples(cfg->axis[i].wire, h);
        error = error ? error : rthyb_calibration_check(&cfg->axis[i].calibration);
    }
    if (!error && cfg->clock == RTHYB_CLOCK_LINK)
        error = rthyb_phase_init(&loop->phase, loop->rate_hz, cfg->lead_ns);
    return error ? error : rthyb_ticker_init(&loop->ticker, cfg->clock, loop->rate_hz, 0);
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

/* The drives keep following: the next station begins with the last commands of the previous one. A
 * station that was replaced before its first reading has sent no command, and passes on those that
 * it was given itself. */
static void hand_over(rthyb_loop *loop, const rthyb_station *next)
{
    const rthyb_station *last = loop->cfg.station;
    loop->taken_over = last->seen && !next->seen;
    loop->offered = (last->seen || loop->offered) && !next->seen;
    for (int i = 0; i < loop->axis_count; i++) {
        rthyb_loop_way *way = &loop->way[i];
        way->beyond = 0;
        if (!last->seen)
            continue;
        way->taken_cmd_m = last->controller.axis[i].x_cmd + last->axis[i].tare_cmd;
        way->offered_x_m = last->axis[i].seen_x;
    }
}

void rthyb_loop_continue_from(rthyb_loop *loop, const rthyb_last_command *last)
{
    loop->offered = 1;
    for (int i = 0; i < loop->axis_count; i++) {
        loop->cfg.axis[i].wire->seq = last[i].seq;
        loop->way[i].taken_cmd_m = last[i].x_cmd_m;
        loop->way[i].offered_x_m = last[i].x_m;
    }
}

static void take_load(rthyb_loop *loop, const rthyb_tick *tick)
{
    const uint64_t generation = acquire(&loop->loads);
    if (generation == loop->load_answer >> 1)
        return;
    const rthyb_load *load = &loop->load;
    const int another = load->station != loop->cfg.station;
    const rthyb_controller_config *next = &load->station->cfg.controller;
    const int unfit = another && (loop->cfg.station->state != RTHYB_IDLE ||
                                  next->axis_count != loop->axis_count ||
                                  !same_sensors(load->station, loop->cfg.station) ||
                                  !sensors_ok(&loop->cfg, load->station) ||
                                  next->period_s != loop->cfg.station->cfg.controller.period_s);
    const int refused = unfit || !ring_fits(load->ring, loop->axis_count);
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
    loop->silence = beat == loop->last_beat ? loop->silence + ticks : 0;
    loop->last_beat = beat;
    const int late = loop->silence > loop->heartbeat_ticks;
    add(&loop->counters.late_heartbeats, (uint64_t)late);
    return late;
}

/* ---- one tick --------------------------------------------------------------------------------- */

/* A tick that woke up late, or after skipped ticks, does not show anything about the drive's clock:
 * it may have taken the sample that belongs to the next tick. A tick that waits for a sample rather
 * than for a time never shows anything. */
static int is_punctual(const rthyb_loop *loop, const rthyb_tick *tick)
{
    const int timeless = loop->cfg.unpaced && loop->ticker.clock == RTHYB_CLOCK_STEPPED;
    return !timeless && !tick->skipped && tick->woken_ns - tick->due_ns < loop->half_period_ns;
}

static void set_offset(rthyb_loop_way *way, int64_t offset)
{
    way->offset = way->offset_seen = offset;
    way->offset_known = 1;
    way->votes = 0;
    memset(way->vote_map, 0, sizeof way->vote_map);
}

/* Stores the votes of the last RTHYB_SLIP_WINDOW ticks that had one. */
static void vote(rthyb_loop_way *way, int for_it)
{
    uint64_t *word = &way->vote_map[(way->voted / 64) % (RTHYB_SLIP_WINDOW / 64)];
    const uint64_t bit = (uint64_t)1 << (way->voted % 64);
    way->votes += for_it - ((*word & bit) != 0);
    *word = for_it ? *word | bit : *word & ~bit;
    way->voted++;
}

/* Compares the two clocks; 1 for a slip. Lost and late pairs have no effect. If a sample arrives
 * just as the tick is due, jitter decides on which side of it the sample falls: only a change that
 * a clear majority of the last ticks has seen is a slip. */
static int has_slipped(rthyb_loop *loop, rthyb_loop_way *way, const rthyb_feedback *feedback,
                       uint64_t k, uint32_t age)
{
    const int64_t offset = (int64_t)(feedback->samples - k);
    if (!way->offset_known || age >= RESYNC_AGE) {
        set_offset(way, offset);
    } else {
        if (way->votes == 0)
            way->offset_seen = offset;
        vote(way, offset != way->offset && offset == way->offset_seen);
    }
    if (way->votes < RTHYB_SLIP_VOTES)
        return 0;
    set_offset(way, way->offset_seen);
    add(&loop->counters.slips, 1);
    return 1;
}

/* What a tick receives from one axis, */
typedef struct {
    rthyb_feedback feedback;
    int lost;
} arrival;

/* and from all axes. */
typedef struct {
    arrival axis[RTHYB_COUPLED_MAX];
    int slipped;
    int32_t apart;
} arrivals;

/* Receives what has arrived at this instant or before. */
static void take_in(rthyb_loop *loop, int axis, int64_t now_ns)
{
    const rthyb_loop_axis *at = &loop->cfg.axis[axis];
    const uint64_t pairs = peek(&at->wire->counters.pairs);
    rthyb_link_drain(at->link, at->wire);
    if (peek(&at->wire->counters.pairs) != pairs)
        loop->way[axis].arrived_ns = now_ns;
}

static int is_at_rest(const rthyb_station *s)
{
    return s->state == RTHYB_IDLE || s->state == RTHYB_ZEROED || s->state == RTHYB_ARMED;
}

/* A drive that acts on old commands counts as unreachable, however new its readings are. (If it
 * receives no commands at all, its own watchdog stops it earlier.) The reference is the delay at
 * rest. */
static int is_belated(const rthyb_loop *loop, rthyb_loop_way *way, const rthyb_feedback *feedback)
{
    if (feedback->delay < 0)
        return 0;
    if (is_at_rest(loop->cfg.station)) {
        way->usual_delay = feedback->delay;
        return 0;
    }
    return feedback->delay - way->usual_delay >= way->stale;
}

static void take_axis(rthyb_loop *loop, int axis, const rthyb_tick *tick, arrivals *all)
{
    rthyb_loop_way *way = &loop->way[axis];
    arrival *found = &all->axis[axis];
    const uint32_t age = loop->cfg.axis[axis].wire->age;
    take_in(loop, axis, tick->woken_ns);
    found->lost = rthyb_wire_take(loop->cfg.axis[axis].wire, &found->feedback);
    rthyb_wire_record_extras(loop->cfg.axis[axis].wire, loop->cfg.station->channel);
    if (found->lost)
        return;
    put_signed(&way->delay, found->feedback.delay);
    if (is_belated(loop, way, &found->feedback)) {
        add(&loop->counters.belated, 1);
        found->lost = RTHYB_LOST;
        return;
    }
    if (is_punctual(loop, tick))
        all->slipped |= has_slipped(loop, way, &found->feedback, tick->k, age);
}

/* Whether the drives are still on one clock. A tick in which an axis has no pair is not evaluated.
 * The comparison starts again after a trip and, at rest, when a count may have wrapped: after a
 * long silence, or a suspension of the PC. */
static int32_t compare_clocks(rthyb_loop *loop, const rthyb_tick *tick, const arrivals *all)
{
    const rthyb_station *s = loop->cfg.station;
    uint64_t counts[RTHYB_COUPLED_MAX] = {0};
    int64_t usual[RTHYB_COUPLED_MAX] = {0};
    int whole = 1, wrapped = tick->skipped >= RESYNC_AGE;
    for (int i = 0; i < loop->axis_count; i++) {
        const arrival *found = &all->axis[i];
        whole = whole && !found->lost;
        wrapped |= found->feedback.age >= RESYNC_AGE;
        counts[i] = found->feedback.samples;
        usual[i] = loop->way[i].offset;
    }
    if (s->state == RTHYB_TRIPPED || (wrapped && is_at_rest(s))) {
        abreast_forget(&loop->abreast);
        loop->apart = RTHYB_APART_UNKNOWN;
    } else if (whole) {
        loop->apart = abreast_compare(&loop->abreast, loop->axis_count, counts, tick->k, usual);
    }
    return loop->apart;
}

/* Takes the pair of a drive that receives no commands: its readings go to the channels of the row,
 * NaN without a pair, and nothing else depends on them or on its status. */
static void hear(rthyb_loop *loop, int way, const rthyb_tick *tick)
{
    const rthyb_loop_axis *at = &loop->cfg.axis[way];
    const int32_t place = 2 * (way - loop->axis_count);
    double *channel = loop->cfg.station->channel + loop->cfg.heard_channel + place;
    rthyb_feedback feedback;
    take_in(loop, way, tick->woken_ns);
    const int lost = rthyb_wire_take(at->wire, &feedback);
    channel[0] = lost ? (double)NAN : calibrated_x(&at->calibration, feedback.x_m);
    channel[1] = lost ? (double)NAN : calibrated_f(&at->calibration, feedback.f_n);
}

static void take_feedback(rthyb_loop *loop, const rthyb_tick *tick, arrivals *all)
{
    all->slipped = all->apart = 0;
    for (int i = 0; i < loop->axis_count; i++)
        take_axis(loop, i, tick, all);
    for (int i = loop->axis_count; i < ways_of(loop); i++)
        hear(loop, i, tick);
    if (loop->axis_count > 1)
        all->apart = compare_clocks(loop, tick, all);
}

static int send_command(rthyb_loop *loop, int axis, const rthyb_station_output *out)
{
    const rthyb_loop_axis *at = &loop->cfg.axis[axis];
    rthyb_loop_way *way = &loop->way[axis];
    rthyb_frame frame;
    double sent_m = 0.0;
    const double wanted_m = command_for_wire(&at->wire->codec, &at->calibration, &out->axis[axis]);
    const int nowhere = isnan(wanted_m) && isfinite(out->axis[axis].x_cmd_m);
    const int code = rthyb_wire_command(at->wire, wanted_m, out->sent_state, &frame, &sent_m);
    way->beyond = nowhere || (code & RTHYB_S_OUT_OF_RANGE);
    add(&loop->counters.beyond, (uint64_t)way->beyond);
    const int sent = !(code & RTHYB_S_NOT_FINITE) && rthyb_link_send(at->link, &frame);
    note_command(loop->cfg.station, axis, &at->calibration, sent, sent_m);
    add(sent ? &loop->counters.sent : &loop->counters.not_sent, 1);
    return sent;
}

/* Flags of the commands that were not sent. */
static uint32_t send_commands(rthyb_loop *loop, const rthyb_station_output *out)
{
    uint32_t unsent = 0;
    for (int i = 0; i < loop->axis_count; i++) {
        const int sent = !out->send || send_command(loop, i, out);
        loop->way[i].unsent = sent ? 0 : loop->way[i].unsent + 1;
        unsent |= sent ? 0u : unsent_flag(i, loop->axis_count);
    }
    return unsent;
}

static int32_t short_ns(int64_t ns)
{
    return ns > INT32_MAX ? INT32_MAX : (int32_t)ns;
}

static void complete(rthyb_loop *loop, const rthyb_tick *tick, const arrivals *found)
{
    rthyb_record *last = &loop->records[loop->record_count - 1];
    for (uint32_t i = 0; i < loop->record_count; i++) {
        rthyb_record *record = &loop->records[i];
        const uint64_t k = tick->k - (last->tick - record->tick);
        record->due_ns = rthyb_ticker_due_ns(&loop->ticker, k) - loop->ticker.t0_ns;
    }
    last->wake_late_ns = short_ns(tick->woken_ns - tick->due_ns);
    for (int i = 0; i < loop->axis_count; i++) {
        last->axis[i].echo = (uint16_t)found->axis[i].feedback.echo;
        last->axis[i].count = (uint16_t)found->axis[i].feedback.count;
    }
    last->flags |= found->slipped ? (uint32_t)RTHYB_F_SLIP : 0u;
}

static void note_sent(rthyb_loop *loop, const rthyb_tick *tick, uint32_t unsent)
{
    rthyb_record *record = &loop->records[loop->record_count - 1];
    record->flags = (record->flags & ~UNSENT_FLAGS) | unsent;
    if (unsent || loop->ticker.clock == RTHYB_CLOCK_STEPPED)
        return;
    const int64_t now_ns = rthyb_now_ns();
    record->sent_late_ns = short_ns(now_ns - tick->due_ns);
    rthyb_latency_record(&loop->sent, now_ns - tick->woken_ns);
}

static void follow_drive(rthyb_loop *loop, const rthyb_tick *tick, const arrivals *found)
{
    const int came = !found->axis[0].lost && is_punctual(loop, tick) && !loop->flooded;
    const double after_due_ns = (double)(loop->way[0].arrived_ns - tick->due_ns);
    rthyb_phase *phase = &loop->phase;
    rthyb_ticker_trim(&loop->ticker, rthyb_phase_step(phase, came, after_due_ns));
    put_signed(&loop->arrival_error_ns, llrint(phase->error_ns));
    put_signed(&loop->trim_ppb, llrint(phase->trim_ns * loop->rate_hz));
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
    /* For skipped ticks, nothing is known except the record. */
    const uint32_t last = loop->record_count - 1;
    for (uint32_t i = 0; i < last; i++)
        rthyb_ring_push(loop->cfg.ring, &loop->records[i], NULL);
    rthyb_ring_push(loop->cfg.ring, &loop->records[last], loop->cfg.station->channel);
}

/* Also if the link was down and is up again: between two ticks, a lot can happen to a plug. And if
 * it has accepted no command for as long as the drive's own watchdog waits: the drive has stopped
 * then, even if it cannot report that. */
static int is_down(rthyb_loop *loop, int axis)
{
    const rthyb_link *link = loop->cfg.axis[axis].link;
    rthyb_loop_way *way = &loop->way[axis];
    const uint64_t times = peek(&link->counters.times_down);
    const int again = times != way->downs_seen || way->unsent >= loop->watchdog_ticks;
    way->downs_seen = times;
    return again || peek(&link->down) != RTHYB_LINK_UP;
}

/* Whether the station continues with the commands that the drives have. Nothing is sent until the
 * readings allow it; if a drive stops or moves in the meantime, that command is no longer valid. */
static int takes_over(rthyb_loop *loop, const arrivals *found, const rthyb_station_input *in)
{
    int stopped = 0, elsewhere = 0, lost = 0;
    for (int i = 0; i < loop->axis_count; i++) {
        const double away = in->axis[i].x_m - loop->way[i].offered_x_m;
        const int still = fabs(away) <= loop->cfg.station->cfg.axis[i].rest_spread_m;
        stopped |= in->axis[i].drive_stopped;
        elsewhere |= !found->axis[i].lost && !loop->taken_over && !still;
        lost |= found->axis[i].lost;
    }
    loop->offered = loop->offered && !loop->cfg.station->seen && !stopped && !elsewhere;
    return !lost && (loop->taken_over || loop->offered);
}

static void note_delays(rthyb_loop *loop, const arrivals *found)
{
    const int32_t most = RTHYB_LINK_DELAYS - 1;
    const int running = loop->records[loop->record_count - 1].state == RTHYB_RUNNING;
    for (int i = 0; i < loop->axis_count && running; i++) {
        const int32_t delay = found->axis[i].feedback.delay;
        if (!found->axis[i].lost && delay >= 0)
            add(&loop->delays[delay < most ? delay : most], 1);
    }
}

/* Number of skipped ticks for the station. While the PC is suspended, the clock of the ticks stops,
 * but the drive does not. */
static uint32_t skipped_ticks(rthyb_loop *loop, const rthyb_tick *tick)
{
    const int timeless = loop->ticker.clock == RTHYB_CLOCK_STEPPED && !loop->cfg.unpaced;
    const int woke_up = !timeless && rthyb_ticker_slept_ns(&loop->ticker) >= ASLEEP_NS;
    if (woke_up)
        add(&loop->counters.suspended, 1);
    const uint64_t lost = loop->cfg.station->ticks.lost;
    const uint64_t skipped = woke_up && tick->skipped < lost ? lost : tick->skipped;
    return skipped < UINT32_MAX ? (uint32_t)skipped : UINT32_MAX;
}

static rthyb_axis_input gather_axis(rthyb_loop *loop, int axis, const arrival *found)
{
    const rthyb_calibration *calibration = &loop->cfg.axis[axis].calibration;
    return (rthyb_axis_input){
        .x_m = calibrated_x(calibration, found->feedback.x_m),
        .f_n = calibrated_f(calibration, found->feedback.f_n),
        .x_cmd_m = loop->way[axis].taken_cmd_m,
        .lost = found->lost,
        .link_down = is_down(loop, axis),
        .drive_stopped = (found->feedback.status & RTHYB_DEVICE_STOPPED) != 0,
        .beyond = loop->way[axis].beyond,
    };
}

/* A channel that arrives without a number is NaN, like such a reading of an axis, even if another
 * pair with a number followed in the same tick. A value beyond the range of its signal is kept: the
 * station finds it at the end of the sensor's range. */
static void gather_sensors(const rthyb_loop *loop, rthyb_station_input *in)
{
    for (int k = 0; k < sensors_of(loop->cfg.station); k++) {
        const rthyb_wire *wire = loop->cfg.axis[loop->cfg.sensor_axis[k]].wire;
        const uint32_t extra = loop->cfg.sensor_extra[k];
        in->sensor[k] = wire->extras_refused >> extra & 1u ? (double)NAN : wire->pair.extra[extra];
        in->sensors_lost |= (uint32_t)!rthyb_wire_is_new(wire) << k;
    }
}

static rthyb_station_input gather(rthyb_loop *loop, const rthyb_tick *tick, uint64_t mail,
                                  arrivals *found)
{
    const int waiting = mail >> COMMAND_BITS != loop->answer >> COMMAND_BITS;
    int down = 0, stopped = 0;
    rthyb_station_input in = {
        .command = waiting ? (int32_t)(mail & ((1u << COMMAND_BITS) - 1u)) : RTHYB_CMD_NONE,
    };
    take_feedback(loop, tick, found);
    for (int i = 0; i < loop->axis_count; i++) {
        in.axis[i] = gather_axis(loop, i, &found->axis[i]);
        down |= in.axis[i].link_down;
        stopped |= in.axis[i].drive_stopped;
    }
    gather_sensors(loop, &in);
    add(&loop->counters.down, (uint64_t)down);
    add(&loop->counters.stopped, (uint64_t)stopped);
    in.skipped = skipped_ticks(loop, tick);
    in.heartbeat_late = heartbeat_late(loop, 1 + tick->skipped);
    in.apart = found->apart;
    in.taken_over = takes_over(loop, found, &in);
    return in;
}

static void execute(rthyb_loop *loop, const rthyb_tick *tick)
{
    arrivals found = {.slipped = 0};
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
    note_delays(loop, &found);
    const uint32_t unsent = send_commands(loop, &out);
    if (out.send)
        note_sent(loop, tick, unsent);
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

/* Until the tick is due, receives data from the first axis, whose drive the ticks follow, and
 * stores the arrival times. A link that sends continuously wakes the thread only a limited number
 * of times; what it sends after that has no arrival time. */
static void listen(rthyb_loop *loop)
{
    loop->flooded = 0;
    const int64_t due_ns = rthyb_ticker_due_ns(&loop->ticker, loop->ticker.elapsed);
    for (int i = 0; i < RTHYB_WAKE_UPS_MAX; i++) {
        if (!rthyb_link_wait(loop->cfg.axis[0].link, due_ns - rthyb_now_ns()))
            return;
        add(&loop->counters.wake_ups, 1);
        take_in(loop, 0, rthyb_now_ns());
    }
    loop->flooded = 1;
}

static int wait_for_tick(rthyb_loop *loop, rthyb_tick *tick)
{
    if (loop->ticker.clock == RTHYB_CLOCK_LINK)
        listen(loop);
    return rthyb_ticker_wait(&loop->ticker, tick);
}

/* A packet that has arrived in part is continued, so that the rest of it does not count as
 * damaged. */
static void drop_old(rthyb_loop *loop, int axis)
{
    rthyb_frame frame, packet;
    const rthyb_loop_axis *at = &loop->cfg.axis[axis];
    const int serial = at->wire->codec.format == RTHYB_WIRE_SERIAL;
    for (int i = 0; i < RTHYB_OLD_PIECES_MAX && rthyb_link_receive(at->link, &frame); i++) {
        for (int32_t k = 0; serial && k < frame.length; k++)
            (void)rthyb_deframer_byte(&at->wire->deframer, frame.data[k], &packet);
        add(&loop->counters.old, 1);
    }
    loop->way[axis].downs_seen = peek(&at->link->counters.times_down);
}

void rthyb_loop_drop_old(rthyb_loop *loop)
{
    for (int i = 0; i < ways_of(loop); i++)
        drop_old(loop, i);
}

/* Arrival times of the next pairs of the first axis, at most FIRST_PAIRS; returns how many arrived
 * within twice the time they should take. The pairs are not used otherwise: the state of the wire
 * begins with the first tick. */
static uint32_t time_first_pairs(rthyb_loop *loop, int64_t *arrived_ns)
{
    const rthyb_loop_axis *at = &loop->cfg.axis[0];
    rthyb_wire aside = *at->wire;
    uint32_t count = 0;
    const int64_t until_ns = rthyb_now_ns() + (int64_t)4 * FIRST_PAIRS * loop->half_period_ns;
    for (int i = 0; i < FIRST_PAIRS * RTHYB_WAKE_UPS_MAX && count < FIRST_PAIRS; i++) {
        const uint64_t pairs = aside.counters.pairs;
        if (!rthyb_link_wait(at->link, until_ns - rthyb_now_ns()))
            break;
        const int64_t now_ns = rthyb_now_ns();
        rthyb_link_drain(at->link, &aside);
        if (aside.counters.pairs != pairs)
            arrived_ns[count++] = now_ns;
    }
    add(&loop->counters.old, aside.counters.pairs - at->wire->counters.pairs);
    at->wire->deframer = aside.deframer;
    return count;
}

/* When the first tick is due, not before `from_ns`. With the link clock, it is placed according to
 * the drive's samples: by trimming alone this would take seconds, 10 s from half a period off at
 * 256 Hz. */
static int64_t first_due(rthyb_loop *loop, int64_t from_ns, const int64_t *arrived_ns,
                         uint32_t count)
{
    if (count == 0)
        return from_ns;
    const uint32_t typical = rthyb_phase_typical(&loop->phase, arrived_ns, count);
    const int64_t wanted_ns = arrived_ns[typical] + llrint(loop->phase.lead_ns);
    const double periods = ceil((double)(from_ns - wanted_ns) / loop->phase.period_ns);
    return wanted_ns + llrint(fmax(periods, 0.0) * loop->phase.period_ns);
}

/* The first tick is like all others: what it takes has arrived just before it. */
static void begin_ticking(rthyb_loop *loop)
{
    int64_t arrived_ns[FIRST_PAIRS];
    uint32_t timed = 0;
    if (loop->ticker.clock == RTHYB_CLOCK_LINK) {
        rthyb_loop_drop_old(loop);
        timed = time_first_pairs(loop, arrived_ns);
    }
    const int64_t listen_ns =
        4 * loop->half_period_ns > LISTEN_NS ? 4 * loop->half_period_ns : LISTEN_NS;
    const int64_t from_ns = rthyb_now_ns() + HEAD_START_NS;
    put_signed(&loop->ticker.t0_ns, first_due(loop, from_ns, arrived_ns, timed));
    const int64_t until_ns = loop->ticker.t0_ns - listen_ns;
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
        begin_ticking(loop);
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

int rthyb_loop_last(const rthyb_loop *loop, rthyb_last_command *last)
{
    const rthyb_station *s = loop->cfg.station;
    for (int i = 0; i < loop->axis_count; i++)
        last[i] = (rthyb_last_command){
            .x_cmd_m = s->controller.axis[i].x_cmd + s->axis[i].tare_cmd,
            .x_m = s->axis[i].seen_x,
            .seq = loop->cfg.axis[i].wire->seq,
        };
    return s->seen && is_at_rest(s);
}

/* This command was sent before, so the wire can represent it exactly. */
static int send_leaving(const rthyb_loop *loop, int axis)
{
    const rthyb_station *s = loop->cfg.station;
    const rthyb_loop_axis *at = &loop->cfg.axis[axis];
    rthyb_frame frame;
    double sent_m;
    const double wire_m =
        command_to_wire(&at->calibration, s->controller.axis[axis].x_cmd + s->axis[axis].tare_cmd);
    const int code = rthyb_wire_command(at->wire, wire_m, RTHYB_NOTICE_LEAVING, &frame, &sent_m);
    return !(code & RTHYB_S_NOT_FINITE) && rthyb_link_send(at->link, &frame);
}

int rthyb_loop_leave(rthyb_loop *loop)
{
    int sent = loop->cfg.station->seen && is_at_rest(loop->cfg.station);
    for (int i = 0; i < loop->axis_count && sent; i++)
        sent = send_leaving(loop, i);
    return sent;
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
    };
    for (int i = 0; i < RTHYB_COUPLED_MAX; i++)
        view->delay[i] = i < loop->axis_count ? peek_signed(&loop->way[i].delay) : -1;
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
