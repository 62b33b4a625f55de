/* Arbitrary bytes against the wire. Whatever is received:
 *   - a frame that is damaged, or not addressed to this end, changes nothing but its counter;
 *   - a pair is newer than the one before, unless the line was silent in between;
 *   - values that are passed on are finite, and every tick without a pair reports that;
 *   - an encoded command is decoded as it was sent.
 *
 * With clang and libFuzzer: make fuzz. As a separate program (-DRTHYB_FUZZ_ALONE), with the
 * arguments COUNT and SEED: generates COUNT inputs and prints how many frames they contained. */
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "rthyb.h"

#define DAMAGED (RTHYB_W_ID | RTHYB_W_LENGTH | RTHYB_W_CRC | RTHYB_W_FRAMING)

static unsigned long long frames_seen, pairs_seen;

static void must(int holds, const char *what)
{
    if (!holds) {
        fprintf(stderr, "fuzz_wire: broken: %s\n", what);
        abort();
    }
}

typedef struct {
    const uint8_t *at;
    size_t left;
} source;

static uint8_t next_byte(source *s)
{
    if (!s->left)
        return 0;
    s->left--;
    return *s->at++;
}

static uint32_t next_word(source *s)
{
    uint32_t word = 0;
    for (int i = 0; i < 4; i++)
        word = word << 8 | next_byte(s);
    return word;
}

/* ---- the codecs ----------------------------------------------------------------------------------- */

static rthyb_signal whole(int32_t start, int32_t length, int32_t big_endian)
{
    return (rthyb_signal){.length = length, .start = start, .big_endian = big_endian, .scale = 1.0};
}

static rthyb_signal value(int32_t kind, int32_t start, int32_t length, int32_t big_endian)
{
    return (rthyb_signal){.kind = kind,
                          .length = length,
                          .start = start,
                          .big_endian = big_endian,
                          .scale = -2.5e-7,
                          .offset = 0.125,
                          .low = -INFINITY,
                          .high = INFINITY};
}

/* A drive by another manufacturer: CAN FD, both values in one frame, floats and odd big-endian
 * positions. */
static void describe_one_frame(rthyb_codec *codec)
{
    rthyb_message *c = &codec->command, *x = &codec->displacement;
    *c = (rthyb_message){.id = 0x18ff1234 | RTHYB_ID_EXTENDED, .fd = 1, .length = 16, .crc_at = 15};
    c->field[RTHYB_FIELD_X] = value(RTHYB_FLOAT, 3, 64, 0);
    c->field[RTHYB_FIELD_SEQ] = whole(75, 13, 1);
    *x = (rthyb_message){.id = 0x223, .fd = 1, .length = 64, .crc_at = -1};
    x->field[RTHYB_FIELD_X] = value(RTHYB_FLOAT, 61, 32, 1);
    x->field[RTHYB_FIELD_F] = value(RTHYB_SIGNED, 102, 53, 1);
    x->field[RTHYB_FIELD_COUNT] = whole(500, 12, 0);
    x->field[RTHYB_FIELD_ECHO] = whole(490, 9, 0);
    x->field[RTHYB_FIELD_STATUS] = whole(0, 2, 0);
    codec->force = *x;
}

/* Two frames, with values of few bits, a limited range and a code for "no number". */
static void describe_two_frames(rthyb_codec *codec)
{
    rthyb_message *c = &codec->command, *x = &codec->displacement, *f = &codec->force;
    *c = (rthyb_message){.id = 0x101, .length = 4, .crc_at = -1};
    c->field[RTHYB_FIELD_X] = value(RTHYB_SIGNED, 7, 19, 1);
    c->field[RTHYB_FIELD_SEQ] = whole(24, 4, 0);
    *x = (rthyb_message){.id = 0x181, .length = 5, .crc_at = 0};
    x->field[RTHYB_FIELD_X] = value(RTHYB_UNSIGNED, 9, 17, 0);
    x->field[RTHYB_FIELD_X].low = 100.0;
    x->field[RTHYB_FIELD_X].has_none = 1;
    x->field[RTHYB_FIELD_X].none = 99;
    x->field[RTHYB_FIELD_COUNT] = whole(32, RTHYB_COUNT_BITS_MIN, 0);
    x->field[RTHYB_FIELD_ECHO] = whole(37, 3, 0);
    *f = *x;
    f->id = 0x182;
    f->field[RTHYB_FIELD_F] = x->field[RTHYB_FIELD_X];
}

static void choose_codec(rthyb_codec *codec, unsigned which)
{
    *codec = (rthyb_codec){.format = RTHYB_WIRE_TABLE};
    if (which % 4 < 2)
        codec->format = which % 4 ? RTHYB_WIRE_SERIAL : RTHYB_WIRE_CAN;
    else if (which % 4 == 2)
        describe_one_frame(codec);
    else
        describe_two_frames(codec);
}

/* ---- what comes, and what must hold ---------------------------------------------------------------- */

static void check_pair(const rthyb_wire *before, const rthyb_wire *after)
{
    const uint32_t steps = (after->pair.count - before->pair.count) & after->count_mask;
    if (before->synced)
        must(steps >= 1 && (before->age || steps <= after->count_mask / 2),
             "a pair is newer than the one before");
    must(after->fresh && after->counters.pairs > before->counters.pairs, "a pair is counted");
    must(isfinite(after->pair.x_m) && isfinite(after->pair.f_n), "a pair is finite");
    pairs_seen++;
}

static void check_untouched(const rthyb_wire *before, const rthyb_wire *after)
{
    static rthyb_wire a, b;
    a = *before;
    b = *after;
    memset(&a.counters, 0, sizeof a.counters);
    memset(&b.counters, 0, sizeof b.counters);
    must(memcmp(&a, &b, sizeof a) == 0, "a bad frame changes nothing");
}

static void receive(rthyb_wire *wire, const rthyb_frame *frame)
{
    static rthyb_wire before;
    before = *wire;
    const int verdict = rthyb_wire_receive(wire, frame);
    frames_seen++;
    must(verdict != 0, "every frame has a verdict");
    must(wire->counters.frames == before.counters.frames + 1, "every frame is counted");
    if (verdict & RTHYB_W_PAIR)
        check_pair(&before, wire);
    else if (verdict & DAMAGED)
        check_untouched(&before, wire);
    else
        must(wire->counters.pairs == before.counters.pairs, "no pair is taken unsaid");
}

/* A frame with arbitrary content. */
static void receive_anything(rthyb_wire *wire, source *s)
{
    static const uint32_t ids[] = {0x101, 0x181, 0x182, 0x223, 0x18ff1234 | RTHYB_ID_EXTENDED};
    const uint8_t how = next_byte(s);
    rthyb_frame frame = {.id = how & 8 ? next_word(s) : ids[how % 5]};
    frame.length = how & 16 ? next_byte(s) % (RTHYB_FRAME_MAX + 1) : 8;
    for (int32_t i = 0; i < frame.length; i++)
        frame.data[i] = next_byte(s);
    receive(wire, &frame);
}

static void feed(rthyb_wire *wire, const uint8_t *bytes, size_t n)
{
    const uint64_t frames = wire->counters.frames, pairs = wire->counters.pairs;
    rthyb_wire_feed(wire, bytes, n);
    must(wire->deframer.length <= RTHYB_PACKET_MAX, "a packet stays within its bounds");
    frames_seen += wire->counters.frames - frames;
    pairs_seen += wire->counters.pairs - pairs;
}

static double next_double(source *s)
{
    const uint64_t bits = (uint64_t)next_word(s) << 32 | next_word(s);
    double number;
    memcpy(&number, &bits, sizeof number);
    return bits & 1 ? (double)(int32_t)(uint32_t)(bits >> 32) * 1e-9 : number;
}

/* A sample as an intact drive sends it, possibly with one bit inverted. */
static void receive_sample(rthyb_wire *wire, source *s)
{
    rthyb_frame frames[2];
    const uint8_t how = next_byte(s);
    const rthyb_reading reading = {.x_m = how & 1 ? next_double(s) : 0.01,
                                   .f_n = how & 2 ? next_double(s) : -5.0,
                                   .count = wire->pair.count + (how >> 4) - 2,
                                   .echo = wire->seq - (how >> 6)};
    const int n = rthyb_encode_feedback(&wire->codec, &reading, frames);
    if (n > 0 && how & 4) {
        rthyb_frame *hit = &frames[how >> 3 & (n - 1)];
        const uint8_t where = next_byte(s);
        hit->data[where / 8 % hit->length] ^= (uint8_t)(1u << where % 8);
    }
    for (int i = 0; i < n; i++)
        if (wire->codec.format == RTHYB_WIRE_SERIAL)
            feed(wire, frames[i].data, (size_t)frames[i].length);
        else
            receive(wire, &frames[i]);
}

static void receive_stream(rthyb_wire *wire, source *s)
{
    size_t n = next_byte(s) % 64;
    if (n > s->left)
        n = s->left;
    feed(wire, s->at, n);
    s->at += n;
    s->left -= n;
}

static void tick(rthyb_wire *wire)
{
    rthyb_feedback feedback;
    const int fresh = wire->fresh;
    const int lost = rthyb_wire_take(wire, &feedback);
    must(isfinite(feedback.x_m) && isfinite(feedback.f_n), "what is handed on is finite");
    must(lost ? (lost & RTHYB_LOST) != 0 : fresh, "only a new pair is given as one");
    must(feedback.delay >= -1, "a delay is known or not");
    must(!wire->fresh, "a pair is taken once");
}

static void command(rthyb_wire *wire, source *s)
{
    rthyb_frame frame, packet;
    rthyb_setpoint back;
    rthyb_deframer deframer = {0};
    double sent_m = 0.0;
    const double x_m = next_double(s);
    const int code = rthyb_wire_command(wire, x_m, next_byte(s) % 8, &frame, &sent_m);
    must(isfinite(x_m) == !(code & RTHYB_S_NOT_FINITE), "no command but a finite one is made");
    if (code & RTHYB_S_NOT_FINITE)
        return;
    packet = frame;
    if (wire->codec.format == RTHYB_WIRE_SERIAL)
        for (int32_t i = 0; i < frame.length; i++)
            rthyb_deframer_byte(&deframer, frame.data[i], &packet);
    const int verdict = rthyb_decode_setpoint(&wire->codec, &packet, &back);
    must(verdict == 0 && back.x_m == sent_m, "a command is read as it was sent");
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static rthyb_codec codec;
    static rthyb_wire wire;
    source s = {data, size};
    choose_codec(&codec, next_byte(&s));
    must(rthyb_wire_init(&wire, &codec) == 0, "the tables fit their frames");
    while (s.left) {
        switch (next_byte(&s) % 8) {
        case 0:
            tick(&wire);
            break;
        case 1:
            command(&wire, &s);
            break;
        case 2:
        case 3:
            receive_stream(&wire, &s);
            break;
        case 4:
            receive_anything(&wire, &s);
            break;
        default:
            receive_sample(&wire, &s);
            break;
        }
    }
    return 0;
}

#ifdef RTHYB_FUZZ_ALONE
static uint64_t random_state;

/* splitmix64 */
static uint64_t random_word(void)
{
    uint64_t z = random_state += UINT64_C(0x9e3779b97f4a7c15);
    z = (z ^ z >> 30) * UINT64_C(0xbf58476d1ce4e5b9);
    z = (z ^ z >> 27) * UINT64_C(0x94d049bb133111eb);
    return z ^ z >> 31;
}

int main(int argc, char **argv)
{
    static uint8_t input[4096];
    const unsigned long long count = argc > 1 ? strtoull(argv[1], NULL, 10) : 1;
    random_state = argc > 2 ? strtoull(argv[2], NULL, 10) : 1;
    for (unsigned long long i = 0; i < count; i++) {
        for (size_t k = 0; k < sizeof input; k++)
            input[k] = (uint8_t)random_word();
        LLVMFuzzerTestOneInput(input, sizeof input);
    }
    printf("%llu %llu\n", frames_seen, pairs_seen);
    return 0;
}
#endif
