/* The controller's end of the wire: which frames form a sample, which are late, lost or duplicated,
 * and how old the echo is. No I/O: bytes in, bytes out. */
#include "numeric.h"
#include "relaxed.h"

#define HALF_LIVES 20   /* most ticks that a half waits for its other half */
#define RESYNC_AFTER 20 /* ticks without data after which any count is accepted */
#define STUCK_AFTER 6   /* consecutive frames that repeat what is known */
#define BOTH (RTHYB_HAS_X | RTHYB_HAS_F)
#define DAMAGED (RTHYB_W_ID | RTHYB_W_LENGTH | RTHYB_W_CRC | RTHYB_W_FRAMING)

static uint32_t mask_of(int32_t bits)
{
    return bits >= 32 ? UINT32_MAX : (1u << bits) - 1u;
}

static int32_t fewer(int32_t a, int32_t b)
{
    return a < b ? a : b;
}

int rthyb_wire_init(rthyb_wire *w, const rthyb_codec *codec)
{
    const int error = rthyb_codec_check(codec);
    if (error)
        return error;
    *w = (rthyb_wire){.codec = *codec, .echo_mask = mask_of(8), .count_mask = mask_of(8)};
    w->deframer.extras = (uint8_t)codec->extra_count;
    if (codec->format == RTHYB_WIRE_TABLE) {
        const rthyb_signal *x = codec->displacement.field, *f = codec->force.field;
        const int32_t seq = codec->command.field[RTHYB_FIELD_SEQ].length;
        w->echo_mask = mask_of(fewer(x[RTHYB_FIELD_ECHO].length, seq));
        w->count_mask = mask_of(fewer(x[RTHYB_FIELD_COUNT].length, f[RTHYB_FIELD_COUNT].length));
    }
    return 0;
}

int rthyb_wire_command(rthyb_wire *w, double x_m, int32_t state, rthyb_frame *frame, double *sent_m)
{
    const rthyb_setpoint setpoint = {.x_m = x_m, .seq = w->seq + 1, .state = (uint32_t)state};
    const int code = rthyb_encode_setpoint(&w->codec, &setpoint, frame, sent_m);
    if (code & RTHYB_S_NOT_FINITE)
        return code;
    w->seq = setpoint.seq;
    add(&w->counters.sent, 1);
    return code;
}

/* Steps from one count to another that arrived `age` ticks after it: of all numbers that the bits
 * allow, the one nearest to one step per tick. Otherwise, with a short count, a gap would look like
 * a step back. */
static int64_t steps_between(const rthyb_wire *w, uint32_t earlier, uint32_t later, uint32_t age)
{
    const uint32_t mask = w->count_mask, due = age < RESYNC_AFTER ? age + 1 : 1;
    const uint32_t beyond = (later - earlier - due) & mask;
    return (int64_t)due + beyond - (beyond >= mask / 2 ? (int64_t)mask + 1 : 0);
}

/* Ticks before this one in which nothing newer than the pair arrived. */
static uint32_t pair_age(const rthyb_wire *w)
{
    return w->fresh ? 0 : w->age;
}

/* A repeated count is not a new sample, however long ago the first one was: the drive may have
 * hung. */
static int order(const rthyb_wire *w, uint32_t earlier, uint32_t later, uint32_t age)
{
    if (((later - earlier) & w->count_mask) == 0)
        return RTHYB_W_DUPLICATE;
    return steps_between(w, earlier, later, age) < 0 ? RTHYB_W_REORDERED : 0;
}

/* Compares with the newest pair, or with the half that is waiting. */
static int judge_order(const rthyb_wire *w, const rthyb_reading *r)
{
    int verdict = 0;
    if (w->counters.pairs > 0) {
        verdict = order(w, w->pair.count, r->count, pair_age(w));
        if (!w->synced)
            verdict &= ~RTHYB_W_REORDERED; /* a drive that was switched on again */
    }
    for (int i = 0; i < 2 && !verdict; i++)
        if (r->has == w->half[i].has)
            verdict = order(w, w->half[i].count, r->count, w->half_age[i]);
    return verdict;
}

static int take_pair(rthyb_wire *w, const rthyb_reading *r)
{
    const uint32_t apart = (r->count - w->pair.count) & w->count_mask;
    const uint64_t steps =
        w->synced ? (uint64_t)steps_between(w, w->pair.count, r->count, pair_age(w)) : apart;
    if (w->synced)
        add(&w->counters.missed, steps - 1);
    if (w->fresh)
        add(&w->counters.superseded, 1);
    add(&w->counters.pairs, 1);
    w->samples += steps;
    w->pair = *r;
    w->extras_refused = w->fresh ? w->extras_refused : 0;
    for (uint32_t i = 0; i < w->codec.extra_count; i++)
        w->extras_refused |= (uint32_t)!isfinite(r->extra[i]) << i;
    w->stopped = r->status & RTHYB_DEVICE_STOPPED;
    w->synced = w->fresh = 1;
    w->repeats = 0;
    return RTHYB_W_PAIR;
}

static void drop_half(rthyb_wire *w, int i)
{
    if (w->half[i].has)
        add(&w->counters.lone, 1);
    w->half[i].has = 0;
    w->half_age[i] = 0;
}

/* Completes the half that is waiting for this one; otherwise this one waits. */
static int join(rthyb_wire *w, const rthyb_reading *r)
{
    const int mine = r->has == RTHYB_HAS_X ? 0 : 1, other = 1 - mine;
    drop_half(w, mine);
    w->half[mine] = *r;
    if (!w->half[other].has || ((w->half[other].count ^ r->count) & w->count_mask))
        return RTHYB_W_HALF;
    rthyb_reading pair = w->half[0];
    pair.has = BOTH;
    pair.f_n = w->half[1].f_n;
    pair.status |= w->half[1].status;
    for (uint32_t i = 0; i < w->codec.extra_count; i++)
        if (w->codec.extra[i].in_force)
            pair.extra[i] = w->half[1].extra[i];
    pair.beyond |= w->half[1].beyond;
    w->half[0].has = w->half[1].has = 0;
    return take_pair(w, &pair);
}

static void tally_verdict(rthyb_wire *w, int verdict)
{
    rthyb_wire_counters *c = &w->counters;
    add(&c->frames, 1);
    add(&c->other_id, (verdict & RTHYB_W_ID) != 0);
    add(&c->bad_length, (verdict & RTHYB_W_LENGTH) != 0);
    add(&c->bad_crc, (verdict & RTHYB_W_CRC) != 0);
    add(&c->bad_framing, (verdict & RTHYB_W_FRAMING) != 0);
    add(&c->not_finite, (verdict & RTHYB_W_NOT_FINITE) != 0);
    add(&c->out_of_range, (verdict & RTHYB_W_RANGE) != 0);
    add(&c->invalid, (verdict & RTHYB_W_INVALID) != 0);
    add(&c->duplicate, (verdict & RTHYB_W_DUPLICATE) != 0);
    add(&c->reordered, (verdict & RTHYB_W_REORDERED) != 0);
    add(&c->stuck, (verdict & RTHYB_W_STUCK) != 0);
}

static int judge_and_join(rthyb_wire *w, const rthyb_reading *r, int verdict)
{
    const int late = judge_order(w, r);
    if (late == RTHYB_W_DUPLICATE && ++w->repeats >= STUCK_AFTER)
        return late | RTHYB_W_STUCK;
    if (late)
        return late;
    /* That the drive has stopped is true whatever its sensors read, and whether or not the other
     * half arrives. */
    w->stopped |= r->status & RTHYB_DEVICE_STOPPED;
    if (!verdict)
        return r->has == BOTH ? take_pair(w, r) : join(w, r);
    w->refused |= verdict & RTHYB_W_NOT_FINITE ? RTHYB_S_NOT_FINITE : RTHYB_S_OUT_OF_RANGE;
    return verdict;
}

int rthyb_wire_receive(rthyb_wire *w, const rthyb_frame *frame)
{
    rthyb_reading reading;
    int verdict = rthyb_decode_feedback(&w->codec, frame, &reading);
    if (!(verdict & DAMAGED))
        verdict = judge_and_join(w, &reading, verdict);
    tally_verdict(w, verdict);
    return verdict;
}

int rthyb_wire_feed(rthyb_wire *w, const uint8_t *bytes, size_t n)
{
    rthyb_frame packet;
    int all = 0;
    for (size_t i = 0; i < n; i++) {
        int verdict = rthyb_deframer_byte(&w->deframer, bytes[i], &packet);
        if (verdict == RTHYB_W_PACKET)
            verdict = rthyb_wire_receive(w, &packet);
        else if (verdict)
            tally_verdict(w, verdict);
        all |= verdict;
    }
    return all;
}

/* A half must not be joined with one that is a whole round of the count younger, even if ticks are
 * skipped in between. */
static uint32_t half_lives(const rthyb_wire *w)
{
    const uint32_t half_round = w->count_mask / 2 + 1;
    return half_round < HALF_LIVES ? half_round : HALF_LIVES;
}

static void age_halves(rthyb_wire *w)
{
    for (int i = 0; i < 2; i++)
        if (w->half[i].has && ++w->half_age[i] > half_lives(w))
            drop_half(w, i);
}

/* Only the echo of a command that was sent from this end is meaningful. */
static int32_t delay(const rthyb_wire *w)
{
    const uint32_t steps = (w->seq - w->pair.echo) & w->echo_mask;
    const int known = w->echo_mask && w->counters.pairs > 0 && steps < w->counters.sent &&
                      steps <= w->echo_mask / 2;
    return known ? (int32_t)(steps & INT32_MAX) : -1;
}

int rthyb_wire_take(rthyb_wire *w, rthyb_feedback *feedback)
{
    const int fresh = w->fresh, refused = w->refused;
    w->fresh = w->refused = 0;
    age_halves(w);
    w->age = fresh ? 0 : w->age + (w->age < UINT32_MAX);
    if (!fresh)
        add(&w->counters.stale, 1);
    if (w->age >= RESYNC_AFTER)
        w->synced = 0;
    *feedback = (rthyb_feedback){
        .x_m = w->pair.x_m,
        .f_n = w->pair.f_n,
        .echo = w->pair.echo,
        .count = w->pair.count,
        .status = (w->pair.status & ~(uint32_t)RTHYB_DEVICE_STOPPED) | w->stopped,
        .delay = delay(w),
        .age = w->age,
        .samples = w->samples,
    };
    if (refused & RTHYB_S_NOT_FINITE)
        return RTHYB_LOST | RTHYB_S_NOT_FINITE;
    return fresh ? RTHYB_OK : RTHYB_LOST | refused;
}

int rthyb_wire_is_new(const rthyb_wire *w)
{
    return w->counters.pairs > 0 && w->age == 0;
}

void rthyb_wire_record_extras(const rthyb_wire *w, double *channels)
{
    for (uint32_t i = 0; i < w->codec.extra_count; i++) {
        const uint32_t at = w->extra_channel + i;
        if (at < RTHYB_CHANNELS_MAX)
            channels[at] = rthyb_wire_is_new(w) && !(w->pair.beyond >> i & 1u) ? w->pair.extra[i]
                                                                               : (double)NAN;
    }
}
