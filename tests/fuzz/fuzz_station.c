/* Random operators, readings, losses, skips, unsent commands, parameter sets and reloads against
 * the station with a virtual rig. The rules that must always hold are in station_rules.h.
 *
 *   fuzz_station ticks COUNT [SEED]     this many ticks, or
 *   fuzz_station seconds COUNT [SEED]   this many seconds: prints how often each rule was checked
 *                                       and, for a broken one, the seed of the episode; 1 if one
 *                                       was broken
 *   fuzz_station episode SEED [TICKS]   repeats one episode, and prints its last TICKS ticks
 *
 * Two levels: the station alone, with a rig that answers directly, and, in one of LOOP_SHARE
 * episodes, the whole loop with wire, link and drive on the stepped clock. The rows of each episode
 * are replayed. */
#define _GNU_SOURCE

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "internal.h"
#include "loop_state.h"
#include "rthyb.h"
#include "station_rules.h"
#include "station_world.h"

enum { ROWS_MAX = 1 << 15, SETS_MAX = 256, LOOP_SHARE = 12, FAULTS_MAX = 8, SHOWN_MAX = 1 << 15 };

static rthyb_record rows[ROWS_MAX];
/* With one axis: a record up to its first axis. */
static uint64_t packed[ROWS_MAX][RTHYB_TEST_WORDS + RTHYB_AXIS_WORDS];
static uint64_t again[ROWS_MAX][RTHYB_TEST_WORDS + RTHYB_AXIS_WORDS];
static size_t row_count;
static rthyb_parameters sets[SETS_MAX];
static size_t set_count;
static uint64_t shown; /* ticks of an episode that are printed */
static uint64_t station_ticks, loop_ticks, tests, trips;

typedef struct {
    observer o;
    dice d;
    world w;
    operator_mood mood;
    troubles t;
    rthyb_station station, twin, first; /* first: as initialised, for the replay */
    rthyb_rig rig;
    rthyb_codec codec;
    rthyb_calibration calibration;
    int coded;               /* commands pass through the codec, otherwise unchanged */
    uint64_t executed, most; /* ticks; most: length of the episode, from an earlier run */
    double ag_mps2[AG_MAX];
    size_t ag_count;
    rthyb_link near, far; /* from here on: for the whole loop */
    rthyb_wire wire;
    rthyb_drive drive;
    rthyb_loop loop;
    rthyb_fault faults[FAULTS_MAX];
    uint32_t mute, stall; /* ticks without a heartbeat, ticks without the drive */
} episode;

static episode one;

/* ---- what is the same on both levels ------------------------------------------------------------- */

static rthyb_signal whole(int32_t start, int32_t length)
{
    return (rthyb_signal){.length = length, .start = start, .scale = 1.0};
}

static rthyb_signal value(int32_t start, int32_t length, double scale)
{
    return (rthyb_signal){.kind = RTHYB_SIGNED,
                          .length = length,
                          .start = start,
                          .scale = scale,
                          .low = -INFINITY,
                          .high = INFINITY};
}

/* A drive by another manufacturer, with commands in steps of `step_m`. */
static void describe(rthyb_codec *codec, double step_m)
{
    rthyb_message *c = &codec->command, *x = &codec->displacement;
    *codec = (rthyb_codec){.format = RTHYB_WIRE_TABLE};
    *c = (rthyb_message){.id = 0x200, .length = 8, .crc_at = -1};
    c->field[RTHYB_FIELD_X] = value(0, 24, step_m);
    c->field[RTHYB_FIELD_SEQ] = whole(24, 8);
    c->field[RTHYB_FIELD_STATE] = whole(32, 4);
    *x = (rthyb_message){.id = 0x300, .fd = 1, .length = 12, .crc_at = -1};
    x->field[RTHYB_FIELD_X] = value(0, 32, 1e-9);
    x->field[RTHYB_FIELD_F] = value(32, 32, 1e-2);
    x->field[RTHYB_FIELD_COUNT] = whole(64, 8);
    x->field[RTHYB_FIELD_ECHO] = whole(72, 8);
    x->field[RTHYB_FIELD_STATUS] = whole(80, 4);
    codec->force = *x;
}

static void choose_wire(episode *e, int must_code)
{
    dice *d = &e->d;
    const uint32_t which = below(d, 4);
    e->coded = must_code || which > 0;
    e->codec = (rthyb_codec){.format = which % 2 ? RTHYB_WIRE_CAN : RTHYB_WIRE_SERIAL};
    double step_m = 1e-9;
    if (which == 3) {
        step_m = some(d, 1e-7, 1e-4);
        describe(&e->codec, step_m);
    }
    e->calibration = (rthyb_calibration){.x_gain = 1.0, .f_gain = 1.0, .cmd_gain = 1.0};
    if (one_in(d, 4)) {
        e->calibration.x_gain = copysign(some(d, 0.5, 2.0), between(d, -1.0, 1.0));
        e->calibration.f_gain = copysign(some(d, 0.5, 2.0), between(d, -1.0, 1.0));
        e->calibration.cmd_gain = copysign(some(d, 0.5, 2.0), between(d, -1.0, 1.0));
        e->calibration.x_offset_m = between(d, -0.01, 0.01);
        e->calibration.cmd_offset_m = between(d, -0.01, 0.01);
    }
    e->o.resolution_m = e->coded ? step_m / fabs(e->calibration.cmd_gain) : 0.0;
}

static void take_test(episode *e)
{
    while (rthyb_station_init(&e->station, &e->w.station))
        another_test(&e->d, &e->w);
    e->first = e->station;
    e->ag_count = e->w.ag_count;
    memcpy(e->ag_mps2, e->w.ag_mps2, sizeof e->ag_mps2);
    row_count = set_count = 0;
}

static int there_is_room(const episode *e)
{
    return row_count + RTHYB_BLIND_MAX + 1 < ROWS_MAX && set_count < SETS_MAX &&
           e->o.tick < UINT64_MAX / 2;
}

static const char *first_difference(const rthyb_record *a, const rthyb_record *b)
{
    if (a->tick != b->tick)
        return "tick";
    if (a->state != b->state)
        return "state";
    if (a->flags != b->flags)
        return "flags";
    if (a->code != b->code)
        return "code";
    if (a->x_num_m != b->x_num_m)
        return "x_num";
    if (a->x_plc_m != b->x_plc_m)
        return "x_plc";
    if (a->axis[0].x_cmd_m != b->axis[0].x_cmd_m)
        return "x_cmd";
    if (a->axis[0].x_meas_m != b->axis[0].x_meas_m)
        return "x_meas";
    return "another field";
}

static void judge_replay(episode *e)
{
    const rthyb_replay source = {.rows = packed,
                                 .count = row_count,
                                 .ag_mps2 = e->ag_mps2,
                                 .ag_count = e->ag_count,
                                 .axis = {{e->coded ? &e->codec : NULL, e->calibration}},
                                 .parameters = sets,
                                 .parameter_count = set_count};
    for (size_t i = 0; i < row_count; i++)
        memcpy(packed[i], &rows[i], sizeof packed[i]);
    const size_t made = rthyb_station_replay(&e->first, &source, again);
    size_t same = 0;
    while (same < made && memcmp(packed[same], again[same], sizeof packed[same]) == 0)
        same++;
    const rthyb_record *other = (const rthyb_record *)(const void *)again[same];
    if (shown && same < row_count)
        printf("replay: %zu rows of %zu, row %zu (coded %d) departs in %s: tick %" PRIu64
               " x_cmd %.17g %.17g flags %x %x\n",
               made, row_count, same, e->coded, first_difference(&rows[same], other),
               rows[same].tick, rows[same].axis[0].x_cmd_m, other->axis[0].x_cmd_m,
               rows[same].flags, other->flags);
    must(&e->o, RULE_REPLAY, same == row_count, (double)same, (double)row_count);
}

static void show(const episode *e, const event *v)
{
    const rthyb_record *r = &v->rows[v->count - 1];
    const rthyb_station *s = &e->station;
    if (e->executed + shown < e->most)
        return;
    printf("%" PRIu64
           " %d>%d cmd %d%s skip %u lost %d down %d stop %d late %d beyond %d | x %.9g f "
           "%.9g | num %.9g plc %.9g cmd %.9g -> %.9g%s | step %.3g flags %x code %x cause %d\n",
           e->o.tick, v->was, v->is, v->in.command, v->refused ? "!" : "", v->in.skipped,
           v->in.axis[0].lost, v->in.axis[0].link_down, v->in.axis[0].drive_stopped,
           v->in.heartbeat_late, v->in.axis[0].beyond, v->in.axis[0].x_m - s->axis[0].tare_x,
           v->in.axis[0].f_n - s->axis[0].tare_f, r->x_num_m, r->x_plc_m, r->axis[0].x_cmd_m,
           v->at_drive_m, v->sent ? "" : " unsent", e->o.step_m, r->flags & 0x801fff, r->code,
           s->cause);
}

static void judge(episode *e, const event *v)
{
    if (shown)
        show(e, v);
    e->executed++;
    tests += v->in.command == RTHYB_CMD_START && !v->refused;
    trips += v->is == RTHYB_TRIPPED && v->was != RTHYB_TRIPPED;
    observe(&e->o, v, &e->station, e->ag_count);
}

/* ---- the station alone ---------------------------------------------------------------------------- */

/* A drive that follows its commands, and stops on command or when it receives none. */
typedef struct {
    double target_m; /* of the rig, from its own zero */
    int latched;
    int follows, tells; /* tells: has a status byte */
    uint32_t silent;
    int beyond;     /* the wire could not represent the last command */
    int taken_over; /* an earlier station has sent it taken_m */
    double taken_m;
} plain_drive;

static void drive_stops(plain_drive *p)
{
    p->latched = p->latched || p->follows;
    p->follows = 0;
}

/* After a stop on its own, it follows again when it is reset, and not before. */
static void drive_hears(plain_drive *p, const world *w, int state, double x_m)
{
    if (state == RTHYB_NOTICE_RESET || (state == RTHYB_IDLE && !p->latched)) {
        p->follows = 1;
        p->latched = 0;
    }
    if (state == RTHYB_TRIPPED)
        drive_stops(p);
    if (p->follows)
        p->target_m = x_m - w->origin_m;
    p->silent = 0;
}

static void drive_ticks(episode *e, plain_drive *p, uint32_t count, double *x_m, double *f_n)
{
    const uint32_t most = count < 64 ? count : 64;
    for (uint32_t i = 0; i < most; i++)
        (void)rthyb_rig_step(&e->rig, p->target_m, x_m, f_n);
    p->silent = p->silent < UINT32_MAX - count ? p->silent + count : UINT32_MAX;
    if (p->silent >= RTHYB_DRIVE_WATCHDOG)
        drive_stops(p);
}

/* Without a wire, commands arrive as computed, and none is lost. */
static int pass_on(episode *e, plain_drive *p, const rthyb_station_output *out, int unsent)
{
    rthyb_frame frame;
    double wire_m = 0.0;
    if (!e->coded) {
        drive_hears(p, &e->w, out->sent_state, out->axis[0].x_cmd_m);
        return 1;
    }
    const double wanted_m = command_for_wire(&e->codec, &e->calibration, &out->axis[0]);
    const rthyb_setpoint setpoint = {.x_m = wanted_m, .state = (uint32_t)out->sent_state};
    const int code = rthyb_encode_setpoint(&e->codec, &setpoint, &frame, &wire_m);
    const int sent = !unsent && !(code & RTHYB_S_NOT_FINITE);
    p->beyond =
        (isnan(wanted_m) && isfinite(out->axis[0].x_cmd_m)) || (code & RTHYB_S_OUT_OF_RANGE);
    note_command(&e->station, 0, &e->calibration, sent, wire_m);
    if (sent)
        drive_hears(p, &e->w, out->sent_state, command_from_wire(&e->calibration, wire_m));
    return sent;
}

static void adopt(episode *e)
{
    rthyb_parameters p = some_parameters(&e->d, &e->station.cfg, &e->w.size);
    const rthyb_station_config before = e->station.cfg;
    if (rthyb_parameters_check(&p))
        return;
    p.generation = (uint32_t)set_count + 1;
    sets[set_count++] = p;
    const int taken = rthyb_station_adopt(&e->station, &p);
    const rthyb_station_config *after = &e->station.cfg;
    const int whole_set =
        memcmp(after->watch, p.watch, sizeof p.watch) == 0 &&
        after->controller.axis[0].velocity_limit_m_per_s == p.velocity_limit_m_per_s &&
        after->path_velocity_m_per_s == p.path_velocity_m_per_s;
    must(&e->o, RULE_PARAMETERS,
         taken ? whole_set
               : memcmp(after, &before, sizeof before) == 0 && e->station.state != RTHYB_IDLE,
         taken, whole_set);
    e->o.adopted = e->o.adopted || taken;
}

/* The same tick without the refused command has the same result. */
static void judge_refusal(episode *e, const event *v, const rthyb_station_output *out)
{
    static rthyb_record other[RTHYB_BLIND_MAX + 1];
    rthyb_station_output plain;
    rthyb_station_input in = v->in;
    const uint32_t mask = ~(uint32_t)(RTHYB_F_REFUSED | 0xffu << RTHYB_F_COMMAND_BIT);
    in.command = RTHYB_CMD_NONE;
    rthyb_station_tick(&e->twin, &in, e->ag_mps2, e->ag_count, other, &plain);
    const rthyb_record *a = &v->rows[v->count - 1], *b = &other[plain.records - 1];
    const int same = plain.axis[0].x_cmd_m == out->axis[0].x_cmd_m && plain.state == out->state &&
                     plain.send == out->send && plain.axis[0].low_m == out->axis[0].low_m &&
                     (a->flags & mask) == (b->flags & mask) && a->x_num_m == b->x_num_m &&
                     e->twin.cause == e->station.cause && e->twin.in_state == e->station.in_state &&
                     e->twin.leg == e->station.leg && e->twin.zeroing == e->station.zeroing &&
                     e->twin.path[0].ticks == e->station.path[0].ticks &&
                     e->twin.axis[0].tare_x == e->station.axis[0].tare_x;
    must(&e->o, RULE_REFUSED, same, v->in.command, v->was);
}

static void tick_alone(episode *e, plain_drive *p)
{
    dice *d = &e->d;
    rthyb_station_output out;
    surroundings around = {0};
    rthyb_station_input *in = &around.in;
    drive_ticks(e, p, 1, &in->axis[0].x_m, &in->axis[0].f_n);
    in->axis[0].x_m += e->w.origin_m;
    in->command = operate(d, &e->mood, e->station.state);
    suffer_all(d, &e->t, &e->w.size, &e->station.cfg, &around);
    if (in->skipped)
        drive_ticks(e, p, in->skipped, &(double){0.0}, &(double){0.0});
    in->axis[0].drive_stopped = in->axis[0].drive_stopped || (p->tells && !p->follows);
    in->axis[0].beyond = p->beyond;
    in->taken_over = p->taken_over && !e->station.seen;
    in->axis[0].x_cmd_m = p->taken_m;
    const int was = e->station.state;
    if (in->command)
        e->twin = e->station;
    rthyb_record *made = &rows[row_count];
    rthyb_station_tick(&e->station, in, e->ag_mps2, e->ag_count, made, &out);
    event v = {.in = *in,
               .rows = made,
               .count = out.records,
               .was = was,
               .is = out.state,
               .wanted = out.send,
               .refused = out.refused};
    if (out.refused)
        judge_refusal(e, &v, &out);
    v.sent = out.send && pass_on(e, p, &out, around.unsent);
    v.at_drive_m = e->station.controller.axis[0].x_cmd + e->station.axis[0].tare_cmd;
    rthyb_record *last = &made[out.records - 1];
    last->flags &= ~(uint32_t)RTHYB_F_NOT_SENT;
    last->flags |= v.sent ? 0u : (uint32_t)RTHYB_F_NOT_SENT;
    row_count += out.records;
    judge(e, &v);
    station_ticks += 1u + (in->skipped < RTHYB_LOST_TICKS ? in->skipped : RTHYB_LOST_TICKS);
}

/* Another test with the same drive. */
static void reload(episode *e, plain_drive *p)
{
    judge_replay(e);
    p->taken_over = e->station.seen || p->taken_over;
    if (e->station.seen)
        p->taken_m = e->station.controller.axis[0].x_cmd + e->station.axis[0].tare_cmd;
    p->beyond = 0;
    another_test(&e->d, &e->w);
    take_test(e);
    observe_another(&e->o);
}

static void alone(episode *e)
{
    dice *d = &e->d;
    plain_drive p = {.tells = !one_in(d, 4)};
    const uint64_t length = (uint64_t)ticks(d, 300.0, 12000.0);
    choose_wire(e, 0);
    for (uint64_t n = 0; n < length && !e->o.over && there_is_room(e); n++) {
        if (one_in(d, 700))
            adopt(e);
        if (e->station.state == RTHYB_IDLE && one_in(d, 400))
            reload(e, &p);
        tick_alone(e, &p);
    }
    if (!e->o.over)
        judge_replay(e);
}

/* ---- the whole loop -------------------------------------------------------------------------------- */

static int open_links(episode *e)
{
    int ends[2];
    const int serial = e->codec.format == RTHYB_WIRE_SERIAL;
    const int kind = serial ? RTHYB_LINK_STREAM : RTHYB_LINK_CAN;
    const int type = (serial ? SOCK_STREAM : SOCK_SEQPACKET) | SOCK_NONBLOCK;
    if (socketpair(AF_UNIX, type, 0, ends))
        return -1;
    const int error =
        rthyb_link_open(&e->near, kind, ends[0]) | rthyb_link_open(&e->far, kind, ends[1]);
    close(ends[0]);
    close(ends[1]);
    return error;
}

static void some_faults(episode *e, uint64_t length)
{
    dice *d = &e->d;
    const double x = e->w.size.peak_m, force = e->w.size.k_e_n_per_m * x;
    const double most[RTHYB_FAULTS] = {
        [RTHYB_FAULT_DROP] = 1.0, [RTHYB_FAULT_DROP_COMMAND] = 1.0, [RTHYB_FAULT_DROP_FORCE] = 1.0,
        [RTHYB_FAULT_DELAY] = 20, [RTHYB_FAULT_JUMP] = 2.0 * x,     [RTHYB_FAULT_FORCE] = 3 * force,
    };
    for (int i = 0; i < FAULTS_MAX; i++) {
        rthyb_fault *f = &e->faults[i];
        f->kind = (int32_t)below(d, RTHYB_FAULTS);
        f->first = below(d, (uint32_t)length);
        f->ticks = (uint64_t)ticks(d, 1.0, one_in(d, 4) ? 2000.0 : 60.0);
        f->value = most[f->kind] * between(d, 0.0, 1.0);
    }
    must(&e->o, RULE_DRIVE, !rthyb_drive_schedule(&e->drive, e->faults, below(d, FAULTS_MAX + 1)),
         0.0, 0.0);
}

static int set_up_loop(episode *e)
{
    e->drive = (rthyb_drive){.plant = {RTHYB_PLANT_RIG, &e->rig},
                             .link = &e->far,
                             .codec = e->codec,
                             .calibration = e->calibration,
                             .origin_m = e->w.origin_m,
                             .stop_decel_m_per_s2 = some(&e->d, 0.1, 10.0),
                             .seed = throw_bits(&e->d)};
    const rthyb_loop_config config = {.station = &e->station,
                                      .axis = {{&e->wire, &e->near, e->calibration}},
                                      .ag_mps2 = e->ag_mps2,
                                      .ag_count = e->ag_count,
                                      .clock = RTHYB_CLOCK_STEPPED};
    return rthyb_wire_init(&e->wire, &e->codec) || rthyb_drive_init(&e->drive) ||
           rthyb_loop_init(&e->loop, &config) || open_links(e);
}

static void tick_drive(episode *e)
{
    const rthyb_drive *d = &e->drive;
    const int was = d->phase, latched = d->latched;
    rthyb_drive_tick(&e->drive);
    const int follows = d->phase == RTHYB_DRIVE_FOLLOWING;
    const int heard = d->now.frames > d->now.refused;
    must(&e->o, RULE_DRIVE,
         !follows || (d->silent < RTHYB_DRIVE_WATCHDOG && d->state != RTHYB_TRIPPED), d->silent,
         d->state);
    if (was != RTHYB_DRIVE_FOLLOWING && follows)
        must(&e->o, RULE_DRIVE,
             was == RTHYB_DRIVE_STOPPED && heard &&
                 (!latched || d->state == RTHYB_NOTICE_RESET || d->now.frames > 1),
             was, d->state);
    must(&e->o, RULE_FINITE, isfinite(d->target_m), d->target_m, 0.0);
}

/* The inputs of the station, as recorded by the loop. */
static event as_written(const episode *e, uint32_t skipped, int was, int wanted)
{
    const rthyb_record *last = &rows[row_count + e->loop.record_count - 1];
    const uint32_t flags = last->flags;
    event v = {.rows = &rows[row_count],
               .count = e->loop.record_count,
               .was = was,
               .is = e->station.state,
               .wanted = wanted,
               .sent = wanted && !(flags & RTHYB_F_NOT_SENT),
               .refused = (flags & RTHYB_F_REFUSED) != 0,
               .at_drive_m = e->station.controller.axis[0].x_cmd + e->station.axis[0].tare_cmd};
    v.in.skipped = skipped;
    v.in.command = (int32_t)(flags >> RTHYB_F_COMMAND_BIT);
    v.in.axis[0].link_down = (flags & RTHYB_F_DOWN) != 0;
    v.in.axis[0].drive_stopped = (flags & RTHYB_F_STOPPED) != 0;
    v.in.heartbeat_late = (flags & RTHYB_F_SILENT) != 0;
    v.in.axis[0].beyond = (flags & RTHYB_F_BEYOND) != 0;
    v.in.axis[0].x_m = last->axis[0].x_read_m;
    v.in.axis[0].f_n = last->axis[0].f_read_n;
    if (flags & RTHYB_F_LOST)
        v.in.axis[0].lost = RTHYB_LOST | (isnan(last->axis[0].x_read_m) ? RTHYB_S_NOT_FINITE : 0);
    return v;
}

static void step_loop(episode *e, uint32_t skipped)
{
    const rthyb_loop_counters *c = &e->loop.counters;
    const uint64_t wanted = c->sent + c->not_sent;
    const int was = e->station.state;
    rthyb_ticker_miss(&e->loop.ticker, skipped);
    rthyb_loop_step(&e->loop);
    memcpy(&rows[row_count], e->loop.records, e->loop.record_count * sizeof rows[0]);
    const event v = as_written(e, skipped, was, c->sent + c->not_sent > wanted);
    row_count += e->loop.record_count;
    loop_ticks += e->loop.record_count;
    judge(e, &v);
}

static void publish(episode *e)
{
    rthyb_parameters p = some_parameters(&e->d, &e->station.cfg, &e->w.size);
    if (rthyb_loop_set_parameters(&e->loop, &p))
        return;
    sets[set_count++] = p;
    e->o.adopted = 1;
}

static void load_another(episode *e)
{
    const rthyb_load load = {&e->twin, NULL, e->ag_mps2, 0};
    judge_replay(e);
    e->twin = e->station;
    e->loop.cfg.station = &e->twin; /* a copy, which is about to be replaced */
    another_test(&e->d, &e->w);
    take_test(e);
    const rthyb_load next = {&e->station, load.ring, e->ag_mps2, e->ag_count};
    rthyb_loop_load(&e->loop, &next);
    observe_another(&e->o);
}

/* Skips, a drive that stands still so that the queue fills, an operator's program that hangs. */
static uint32_t trouble_the_loop(episode *e)
{
    dice *d = &e->d;
    e->stall -= e->stall > 0;
    e->mute -= e->mute > 0;
    if (!e->t.rarity || !one_in(d, e->t.rarity))
        return 0;
    if (one_in(d, 4))
        e->stall = (uint32_t)ticks(d, 1.0, 400.0);
    if (one_in(d, 20))
        e->mute = (uint32_t)ticks(d, 500.0, 2000.0);
    return one_in(d, 2) ? some_skips(d, one_in(d, 20) ? TROUBLE_LONG_SKIP : TROUBLE_SKIPS) : 0;
}

static void whole_loop(episode *e)
{
    dice *d = &e->d;
    const uint64_t length = (uint64_t)ticks(d, 300.0, 8000.0);
    choose_wire(e, 1);
    must(&e->o, RULE_DRIVE, !set_up_loop(e), 0.0, 0.0);
    some_faults(e, length);
    for (uint64_t n = 0; n < length && !e->o.over && there_is_room(e); n++) {
        const uint32_t skipped = trouble_the_loop(e);
        for (uint32_t i = 0; i <= skipped && i < 64 && !e->stall; i++)
            tick_drive(e);
        if (e->station.state == RTHYB_IDLE && one_in(d, 400))
            load_another(e);
        if (one_in(d, 700))
            publish(e);
        if (!e->mute)
            rthyb_loop_beat(&e->loop);
        (void)rthyb_loop_command(&e->loop, operate(d, &e->mood, e->station.state));
        step_loop(e, skipped);
    }
    if (!e->o.over)
        judge_replay(e);
    rthyb_link_close(&e->near);
    rthyb_link_close(&e->far);
}

/* ---- an episode ------------------------------------------------------------------------------------ */

static void play(uint64_t seed)
{
    episode *e = &one;
    const uint64_t most = e->most;
    memset(e, 0, sizeof *e);
    e->most = most;
    e->d.state = seed;
    e->o.seed = seed;
    do
        set_up_world(&e->d, &e->w);
    while (rthyb_rig_init(&e->rig, &e->w.rig));
    e->mood = some_mood(&e->d);
    e->t = some_troubles(&e->d);
    take_test(e);
    if (one_in(&e->d, LOOP_SHARE))
        whole_loop(e);
    else
        alone(e);
}

/* ---- all of them ----------------------------------------------------------------------------------- */

static double seconds_now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static int report(uint64_t episodes, double seconds)
{
    int broken = 0;
    for (int i = 0; i < RULES; i++) {
        const rule_tally *t = &tally[i];
        printf("%12" PRIu64 "  %s\n", t->met, RULE_TEXT[i]);
        if (!t->broken)
            continue;
        broken = 1;
        printf("      broken %" PRIu64 " times, at first in episode 0x%" PRIx64 ", tick %" PRIu64
               ": %.9g, bound %.9g\n",
               t->broken, t->seed, t->tick, t->value, t->bound);
    }
    printf("%" PRIu64 " episodes, %" PRIu64 " ticks of the station alone, %" PRIu64
           " of the loop, %" PRIu64 " tests, %" PRIu64 " trips, %.0f ticks/s: %s\n",
           episodes, station_ticks, loop_ticks, tests, trips,
           (double)(station_ticks + loop_ticks) / seconds, broken ? "BROKEN" : "nothing broken");
    return broken;
}

static int play_many(int timed, uint64_t count, uint64_t seed)
{
    dice seeds = {seed};
    uint64_t episodes = 0;
    const double begun = seconds_now();
    while (timed ? seconds_now() - begun < (double)count : station_ticks + loop_ticks < count) {
        play(throw_bits(&seeds));
        episodes++;
    }
    return report(episodes, seconds_now() - begun);
}

static int play_again(uint64_t seed, uint64_t last)
{
    play(seed);
    one.most = one.executed;
    memset(tally, 0, sizeof tally);
    shown = last;
    play(seed);
    return report(1, 1.0);
}

int main(int argc, char **argv)
{
    const uint64_t count = argc > 2 ? strtoull(argv[2], NULL, 0) : 0;
    const uint64_t third = argc > 3 ? strtoull(argv[3], NULL, 0) : 0;
    if (argc > 2 && strcmp(argv[1], "episode") == 0)
        return play_again(count, argc > 3 ? third : 40);
    if (argc > 2 && strcmp(argv[1], "ticks") == 0)
        return play_many(0, count, third);
    if (argc > 2 && strcmp(argv[1], "seconds") == 0)
        return play_many(1, count, third);
    fprintf(stderr,
            "fuzz_station: ticks COUNT [SEED], seconds COUNT [SEED], episode SEED [TICKS]\n");
    return 2;
}
