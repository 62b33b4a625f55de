/* Conversion of numbers to frames and back: the frames of hw/rthyb.dbc in code, serial packets, any
 * other DBC by table. Pure functions; they read and write only the bytes of a frame. */
#include <float.h>
#include <string.h>

#include "numeric.h"

#define UNIT_X_M 1e-9 /* of the program's own frames */
#define UNIT_F_N 1e-3
#define NO_NUMBER INT32_MIN /* in these, in place of a missing displacement or force */
#define CAN_LENGTH 8
#define CAN_CRC_AT 7
#define PACKET_COMMAND 0x01 /* low byte of RTHYB_ACT_CMD */
#define PACKET_FEEDBACK 0x81
#define PACKET_COMMAND_LENGTH 8 /* without CRC */
#define PACKET_FEEDBACK_LENGTH 12
#define EXACT_BITS 53 /* of integers that a double represents exactly */
#define ID_MASK 0x1fffffffu
#define ID_STANDARD 0x7ffu

/* ---- bits of a frame ---------------------------------------------------------------------------- */

/* The next part of a signal that is within one byte. */
typedef struct {
    int32_t byte, shift, bits;
} piece;

static piece piece_at(const rthyb_signal *s, int32_t position, int32_t left)
{
    const int32_t byte = position / 8, bit = position % 8;
    const int32_t room = s->big_endian ? bit + 1 : 8 - bit;
    const int32_t bits = left < room ? left : room;
    return (piece){byte, s->big_endian ? bit + 1 - bits : bit, bits};
}

/* A big-endian signal continues downwards within a byte, and then at the top of the next one. */
static int32_t next_position(const rthyb_signal *s, int32_t position, int32_t bits)
{
    return s->big_endian ? 8 * (position / 8 + 1) + 7 : position + bits;
}

static uint64_t get_bits(const uint8_t *data, const rthyb_signal *s)
{
    uint64_t raw = 0;
    int32_t position = s->start;
    for (int32_t done = 0; done < s->length;) {
        const piece p = piece_at(s, position, s->length - done);
        const uint64_t part = (uint64_t)(data[p.byte] >> p.shift) & ((1u << p.bits) - 1u);
        raw = s->big_endian ? raw << p.bits | part : raw | part << done;
        position = next_position(s, position, p.bits);
        done += p.bits;
    }
    return raw;
}

static void put_bits(uint8_t *data, const rthyb_signal *s, uint64_t raw)
{
    int32_t position = s->start;
    for (int32_t done = 0; done < s->length;) {
        const piece p = piece_at(s, position, s->length - done);
        const int32_t from = s->big_endian ? s->length - done - p.bits : done;
        const unsigned mask = ((1u << p.bits) - 1u) << p.shift;
        const unsigned part = (unsigned)(raw >> from) << p.shift;
        data[p.byte] = (uint8_t)((data[p.byte] & ~mask) | (part & mask));
        position = next_position(s, position, p.bits);
        done += p.bits;
    }
}

static int64_t signed_value(const rthyb_signal *s, uint64_t raw)
{
    const int negative = s->kind == RTHYB_SIGNED && (raw << 1) >> s->length & 1u;
    return (int64_t)raw - (negative ? INT64_C(1) << s->length : 0);
}

static double float_value(const rthyb_signal *s, uint64_t raw)
{
    if (s->length == 64) {
        double wide;
        memcpy(&wide, &raw, sizeof wide);
        return wide;
    }
    float narrow;
    const uint32_t low = (uint32_t)raw;
    memcpy(&narrow, &low, sizeof narrow);
    return (double)narrow;
}

static uint64_t float_bits(const rthyb_signal *s, double value)
{
    if (s->length == 64) {
        uint64_t raw;
        memcpy(&raw, &value, sizeof raw);
        return raw;
    }
    uint32_t low;
    const float narrow = (float)value;
    memcpy(&low, &narrow, sizeof low);
    return low;
}

/* ---- physical values by table -------------------------------------------------------------------- */

static double greatest_float(const rthyb_signal *s)
{
    return s->length == 64 ? DBL_MAX : FLT_MAX;
}

static double least_raw(const rthyb_signal *s)
{
    const double width = s->kind == RTHYB_SIGNED ? -ldexp(1.0, s->length - 1) : 0.0;
    return fmax(s->low, s->kind == RTHYB_FLOAT ? -greatest_float(s) : width);
}

static double greatest_raw(const rthyb_signal *s)
{
    const double width = ldexp(1.0, s->length - (s->kind == RTHYB_SIGNED)) - 1.0;
    return fmin(s->high, s->kind == RTHYB_FLOAT ? greatest_float(s) : width);
}

/* Rounding error of a command that was sent before and has passed through its calibration, or of a
 * limit that is exactly a value of the frame: it must not count as a step of the wire. */
static double round_off(const rthyb_signal *s, double raw)
{
    return (s->kind == RTHYB_FLOAT ? 0.0 : 1e-6) + 1e-14 * fabs(raw);
}

/* Packs a value in SI units, rounded to the nearest one that the signal can represent; *packed is
 * what will be read back. */
static int put_value(uint8_t *data, const rthyb_signal *s, double value, double *packed)
{
    const double wanted = (value - s->offset) / s->scale;
    const double raw = clamp(wanted, least_raw(s), greatest_raw(s));
    if (s->kind == RTHYB_FLOAT) {
        const uint64_t bits = float_bits(s, raw);
        put_bits(data, s, bits);
        *packed = float_value(s, bits) * s->scale + s->offset;
    } else {
        const int64_t whole = llrint(raw);
        put_bits(data, s, (uint64_t)whole);
        *packed = (double)whole * s->scale + s->offset;
    }
    return fabs(raw - wanted) <= round_off(s, raw) ? RTHYB_OK : RTHYB_S_OUT_OF_RANGE;
}

/* A value in the program's own frames. */
static rthyb_signal own_signal(double unit)
{
    return (rthyb_signal){
        .kind = RTHYB_SIGNED,
        .length = 32,
        .scale = unit,
        .low = -(double)INT32_MAX,
        .high = (double)INT32_MAX,
    };
}

/* A raw value, as rounded by the signal. */
static double rounded(const rthyb_signal *s, double raw)
{
    return s->kind == RTHYB_FLOAT ? float_value(s, float_bits(s, raw)) : rint(raw);
}

/* The neighbouring raw value on the other side of `wanted`. */
static double other_side(const rthyb_signal *s, double raw, double wanted)
{
    if (s->kind == RTHYB_FLOAT && s->length == 64)
        return wanted;
    if (s->kind == RTHYB_FLOAT)
        return (double)nextafterf((float)raw, raw > wanted ? -FLT_MAX : FLT_MAX);
    return raw > wanted ? raw - 1.0 : raw + 1.0;
}

/* Range of raw values permitted for a command. */
typedef struct {
    double low, high;
} window;

static window window_of(const rthyb_signal *s, double low_m, double high_m)
{
    const double a = (low_m - s->offset) / s->scale, b = (high_m - s->offset) / s->scale;
    const double low = fmin(a, b), high = fmax(a, b);
    return (window){low - round_off(s, low), high + round_off(s, high)};
}

static int lies_in(window w, double raw)
{
    return raw >= w.low && raw <= w.high;
}

double rthyb_command_within(const rthyb_codec *codec, double x_m, double low_m, double high_m)
{
    const int table = codec->format == RTHYB_WIRE_TABLE;
    const rthyb_signal own = own_signal(UNIT_X_M);
    const rthyb_signal *s = table ? &codec->command.field[RTHYB_FIELD_X] : &own;
    const window allowed = window_of(s, low_m, high_m);
    const window frame = {least_raw(s), greatest_raw(s)};
    const double wanted = (x_m - s->offset) / s->scale;
    const double nearest = rounded(s, clamp(wanted, frame.low, frame.high));
    if (!isfinite(x_m) || lies_in(allowed, nearest))
        return x_m;
    const double other = other_side(s, nearest, wanted);
    const int good = lies_in(allowed, other) && lies_in(frame, other);
    return good ? other * s->scale + s->offset : (double)NAN;
}

/* Packs "no number"; 0 if the signal has no value for it. */
static int put_none(uint8_t *data, const rthyb_signal *s)
{
    if (s->has_none)
        put_bits(data, s, (uint64_t)s->none);
    else if (s->kind == RTHYB_FLOAT)
        put_bits(data, s, s->length == 64 ? UINT64_C(0x7ff8000000000000) : UINT64_C(0x7fc00000));
    return s->has_none || s->kind == RTHYB_FLOAT;
}

static int get_value(const uint8_t *data, const rthyb_signal *s, double *value)
{
    const uint64_t bits = get_bits(data, s);
    const double raw =
        s->kind == RTHYB_FLOAT ? float_value(s, bits) : (double)signed_value(s, bits);
    *value = raw * s->scale + s->offset;
    if (!isfinite(*value) || (s->has_none && signed_value(s, bits) == s->none))
        return RTHYB_W_NOT_FINITE;
    return raw >= s->low && raw <= s->high ? 0 : RTHYB_W_RANGE;
}

static uint32_t get_whole(const uint8_t *data, const rthyb_signal *s)
{
    return (uint32_t)get_bits(data, s);
}

/* ---- checks --------------------------------------------------------------------------------------- */

static int holds(const rthyb_message *m, const rthyb_signal *s)
{
    if (s->length < 1 || s->length > 64 || s->start < 0 || s->start >= 8 * m->length)
        return 0;
    if (!s->big_endian)
        return s->start + s->length <= 8 * m->length;
    const int32_t in_first = s->start % 8 + 1;
    const int32_t beyond = s->length > in_first ? (s->length - in_first + 7) / 8 : 0;
    return s->start / 8 + beyond < m->length;
}

static int is_number(const rthyb_message *m, const rthyb_signal *s)
{
    const int fits = s->kind == RTHYB_FLOAT ? (s->length == 32 || s->length == 64) && !s->has_none
                                            : s->length <= EXACT_BITS;
    return holds(m, s) && fits && s->kind >= RTHYB_UNSIGNED && s->kind <= RTHYB_FLOAT &&
           isfinite(s->scale) && s->scale != 0.0 && isfinite(s->offset) &&
           least_raw(s) <= greatest_raw(s);
}

static int is_value(const rthyb_message *m, enum rthyb_field field)
{
    return is_number(m, &m->field[field]);
}

static int is_whole(const rthyb_message *m, enum rthyb_field field, int32_t least_bits)
{
    const rthyb_signal *s = &m->field[field];
    if (s->length == 0 && least_bits == 0)
        return 1;
    return holds(m, s) && s->kind == RTHYB_UNSIGNED && s->length >= least_bits && s->length <= 32;
}

static int is_frame(const rthyb_message *m)
{
    const int32_t n = m->length;
    const int length_ok = (n >= 1 && n <= 8) || n == 12 || n == 16 || n == 20 || n == 24 ||
                          n == 32 || n == 48 || n == 64;
    const uint32_t most = m->id & RTHYB_ID_EXTENDED ? ID_MASK : ID_STANDARD;
    const int format_ok = m->fd >= RTHYB_CLASSIC && m->fd <= RTHYB_FD_SWITCHED;
    return length_ok && format_ok && (n <= CAN_LENGTH || m->fd) &&
           (m->id & ~RTHYB_ID_EXTENDED) <= most && m->crc_at >= -1 && m->crc_at < n;
}

static int is_feedback(const rthyb_message *m, enum rthyb_field value)
{
    return is_frame(m) && is_value(m, value) &&
           is_whole(m, RTHYB_FIELD_COUNT, RTHYB_COUNT_BITS_MIN) &&
           is_whole(m, RTHYB_FIELD_ECHO, 0) && is_whole(m, RTHYB_FIELD_STATUS, 0);
}

/* Whether a raw state is none (0), or fits its signal and has no other meaning. */
static int notice_is_valid(const rthyb_codec *codec, uint32_t raw, uint32_t other)
{
    const int32_t bits = codec->command.field[RTHYB_FIELD_STATE].length;
    const int fits = bits >= 32 || (bits > 0 && raw >> bits == 0);
    return raw == 0 || (fits && raw > RTHYB_TRIPPED && raw != other);
}

static int32_t feedback_length(const rthyb_codec *codec)
{
    return PACKET_FEEDBACK_LENGTH + 4 * (int32_t)codec->extra_count;
}

/* Whether each extra channel fits its frame, or the packet after its fixed part. */
static int are_extras(const rthyb_codec *codec)
{
    if (codec->extra_count > RTHYB_EXTRAS_MAX ||
        (codec->format == RTHYB_WIRE_CAN && codec->extra_count > 0))
        return 0;
    const int serial = codec->format == RTHYB_WIRE_SERIAL;
    const rthyb_message packet = {.length = serial ? feedback_length(codec) : 0};
    for (uint32_t i = 0; i < codec->extra_count; i++) {
        const rthyb_extra *e = &codec->extra[i];
        const rthyb_message *m = e->in_force ? &codec->force : &codec->displacement;
        if (!is_number(serial ? &packet : m, &e->signal) ||
            (serial && e->signal.start < 8 * PACKET_FEEDBACK_LENGTH))
            return 0;
    }
    return 1;
}

int rthyb_codec_check(const rthyb_codec *codec)
{
    if (!are_extras(codec))
        return RTHYB_E_CODEC;
    if (codec->format == RTHYB_WIRE_CAN || codec->format == RTHYB_WIRE_SERIAL)
        return 0;
    const rthyb_message *c = &codec->command, *x = &codec->displacement, *f = &codec->force;
    const int good = codec->format == RTHYB_WIRE_TABLE && is_frame(c) &&
                     is_value(c, RTHYB_FIELD_X) && is_whole(c, RTHYB_FIELD_SEQ, 4) &&
                     is_whole(c, RTHYB_FIELD_STATE, 0) && is_feedback(x, RTHYB_FIELD_X) &&
                     is_feedback(f, RTHYB_FIELD_F) && c->id != x->id && c->id != f->id &&
                     (x->id != f->id || x->length == f->length) &&
                     notice_is_valid(codec, codec->reset, codec->leaving) &&
                     notice_is_valid(codec, codec->leaving, codec->reset);
    return good ? 0 : RTHYB_E_CODEC;
}

/* Values at the ends of a signal. The value for "no number" is not one of its numbers, even if it is
 * at an end. */
static window ends_of(const rthyb_signal *s, double gain, double offset)
{
    const int apart = s->has_none && s->kind != RTHYB_FLOAT;
    const double low = least_raw(s), high = greatest_raw(s), none = (double)s->none;
    const double a = (apart && none == low ? low + 1.0 : low) * s->scale + s->offset;
    const double b = (apart && none == high ? high - 1.0 : high) * s->scale + s->offset;
    const double x = gain * a + offset, y = gain * b + offset;
    return (window){fmin(x, y), fmax(x, y)};
}

/* A converter that saturates sends the end of its range. */
double rthyb_extra_reach(const rthyb_codec *codec, uint32_t number)
{
    if (number >= codec->extra_count)
        return 0.0;
    const window ends = ends_of(&codec->extra[number].signal, 1.0, 0.0);
    return fmax(0.0, fmin(-ends.low, ends.high));
}

double rthyb_reading_reach(const rthyb_codec *codec, int32_t part, double gain, double offset)
{
    const int of_x = part == RTHYB_HAS_X, table = codec->format == RTHYB_WIRE_TABLE;
    const rthyb_signal own = own_signal(of_x ? UNIT_X_M : UNIT_F_N);
    const rthyb_message *m = of_x ? &codec->displacement : &codec->force;
    const rthyb_signal *s = &m->field[of_x ? RTHYB_FIELD_X : RTHYB_FIELD_F];
    const window ends = ends_of(table ? s : &own, gain, offset);
    const int one_sign = ends.low >= 0.0 || ends.high <= 0.0;
    return one_sign ? fmax(-ends.low, ends.high) : fmin(-ends.low, ends.high);
}

/* ---- frames by table ------------------------------------------------------------------------------ */

static uint8_t crc_of(uint32_t id, const uint8_t *data, int32_t length, int32_t crc_at)
{
    uint8_t covered[RTHYB_FRAME_MAX + 1];
    size_t n = 0;
    covered[n++] = (uint8_t)id;
    for (int32_t i = 0; i < length; i++)
        if (i != crc_at)
            covered[n++] = data[i];
    return rthyb_crc8(covered, n);
}

static void begin(const rthyb_message *m, rthyb_frame *frame)
{
    *frame = (rthyb_frame){.id = m->id, .fd = m->fd, .length = m->length};
    memcpy(frame->data, m->fill, (size_t)m->length);
}

static void seal(const rthyb_message *m, rthyb_frame *frame)
{
    if (m->crc_at >= 0)
        frame->data[m->crc_at] = crc_of(m->id, frame->data, m->length, m->crc_at);
}

static int recognise(const rthyb_message *m, const rthyb_frame *frame)
{
    if (frame->id != m->id)
        return RTHYB_W_ID;
    if (frame->length != m->length)
        return RTHYB_W_LENGTH;
    const int32_t at = m->crc_at;
    const int sound = at < 0 || crc_of(m->id, frame->data, m->length, at) == frame->data[at];
    return sound ? 0 : RTHYB_W_CRC;
}

/* The drive's own value for a state. If it has none for a notice, 0 (IDLE) is sent, which has no
 * effect. */
static uint32_t state_to_table(const rthyb_codec *codec, uint32_t state)
{
    if (state == RTHYB_NOTICE_RESET)
        return codec->reset;
    return state == RTHYB_NOTICE_LEAVING ? codec->leaving : state;
}

static uint32_t state_from_table(const rthyb_codec *codec, uint32_t raw)
{
    if (raw != 0 && raw == codec->reset)
        return RTHYB_NOTICE_RESET;
    if (raw != 0 && raw == codec->leaving)
        return RTHYB_NOTICE_LEAVING;
    /* The program's own value of a notice has no meaning in this table. */
    return raw == RTHYB_NOTICE_RESET || raw == RTHYB_NOTICE_LEAVING ? UINT32_MAX : raw;
}

static int table_put_setpoint(const rthyb_codec *codec, const rthyb_setpoint *setpoint,
                              rthyb_frame *frame, double *sent_m)
{
    const rthyb_message *m = &codec->command;
    begin(m, frame);
    put_bits(frame->data, &m->field[RTHYB_FIELD_SEQ], setpoint->seq);
    put_bits(frame->data, &m->field[RTHYB_FIELD_STATE], state_to_table(codec, setpoint->state));
    const int code = put_value(frame->data, &m->field[RTHYB_FIELD_X], setpoint->x_m, sent_m);
    seal(m, frame);
    return code;
}

static int table_get_setpoint(const rthyb_codec *codec, const rthyb_frame *frame,
                              rthyb_setpoint *setpoint)
{
    const rthyb_message *m = &codec->command;
    const int verdict = recognise(m, frame);
    if (verdict)
        return verdict;
    setpoint->seq = get_whole(frame->data, &m->field[RTHYB_FIELD_SEQ]);
    const uint32_t state = get_whole(frame->data, &m->field[RTHYB_FIELD_STATE]);
    setpoint->state = state_from_table(codec, state);
    return get_value(frame->data, &m->field[RTHYB_FIELD_X], &setpoint->x_m);
}

static int put_reading(uint8_t *data, const rthyb_signal *s, double value)
{
    double packed;
    if (!isfinite(value))
        return put_none(data, s);
    put_value(data, s, value, &packed);
    return 1;
}

/* Packs the extra channels that are in a frame: all of them, or those of one of two frames. */
static void put_extras(const rthyb_codec *codec, const rthyb_reading *reading, int x, int f,
                       uint8_t *data)
{
    for (uint32_t i = 0; i < codec->extra_count; i++)
        if (codec->extra[i].in_force ? f : x)
            (void)put_reading(data, &codec->extra[i].signal, reading->extra[i]);
}

/* An extra channel that is not a number, or out of range, does not make the frame invalid. */
static void get_extras(const rthyb_codec *codec, const uint8_t *data, int x, int f,
                       rthyb_reading *reading)
{
    for (uint32_t i = 0; i < codec->extra_count; i++) {
        double value;
        if (!(codec->extra[i].in_force ? f : x))
            continue;
        const int verdict = get_value(data, &codec->extra[i].signal, &value);
        reading->extra[i] = verdict & RTHYB_W_NOT_FINITE ? (double)NAN : value;
        reading->beyond |= (uint32_t)(verdict == RTHYB_W_RANGE) << i;
    }
}

static int table_put_reading(const rthyb_codec *codec, const rthyb_message *m,
                             const rthyb_reading *reading, uint32_t has, rthyb_frame *frame)
{
    int good = 1;
    begin(m, frame);
    put_bits(frame->data, &m->field[RTHYB_FIELD_ECHO], reading->echo);
    put_bits(frame->data, &m->field[RTHYB_FIELD_COUNT], reading->count);
    put_bits(frame->data, &m->field[RTHYB_FIELD_STATUS], reading->status);
    if (has & RTHYB_HAS_X)
        good &= put_reading(frame->data, &m->field[RTHYB_FIELD_X], reading->x_m);
    if (has & RTHYB_HAS_F)
        good &= put_reading(frame->data, &m->field[RTHYB_FIELD_F], reading->f_n);
    put_extras(codec, reading, (has & RTHYB_HAS_X) != 0, (has & RTHYB_HAS_F) != 0, frame->data);
    seal(m, frame);
    return good;
}

static int table_put_feedback(const rthyb_codec *codec, const rthyb_reading *reading,
                              rthyb_frame frames[2])
{
    const rthyb_message *x = &codec->displacement, *f = &codec->force;
    if (x->id == f->id) {
        rthyb_message both = *x;
        both.field[RTHYB_FIELD_F] = f->field[RTHYB_FIELD_F];
        return table_put_reading(codec, &both, reading, RTHYB_HAS_X | RTHYB_HAS_F, &frames[0]);
    }
    const int good = table_put_reading(codec, x, reading, RTHYB_HAS_X, &frames[0]) &
                     table_put_reading(codec, f, reading, RTHYB_HAS_F, &frames[1]);
    return good ? 2 : 0;
}

static int table_get_feedback(const rthyb_codec *codec, const rthyb_frame *frame,
                              rthyb_reading *reading)
{
    const rthyb_message *x = &codec->displacement, *f = &codec->force;
    const rthyb_message *m = frame->id == x->id ? x : f;
    int verdict = recognise(m, frame);
    if (verdict)
        return verdict;
    reading->echo = get_whole(frame->data, &m->field[RTHYB_FIELD_ECHO]);
    reading->count = get_whole(frame->data, &m->field[RTHYB_FIELD_COUNT]);
    reading->status = get_whole(frame->data, &m->field[RTHYB_FIELD_STATUS]);
    if (frame->id == x->id) {
        reading->has |= RTHYB_HAS_X;
        verdict |= get_value(frame->data, &x->field[RTHYB_FIELD_X], &reading->x_m);
    }
    if (frame->id == f->id) {
        reading->has |= RTHYB_HAS_F;
        verdict |= get_value(frame->data, &f->field[RTHYB_FIELD_F], &reading->f_n);
    }
    get_extras(codec, frame->data, frame->id == x->id, frame->id == f->id, reading);
    return verdict;
}

/* ---- our own frames ------------------------------------------------------------------------------- */

static void put_i32(uint8_t *data, int32_t value)
{
    const uint32_t bits = (uint32_t)value;
    for (int i = 0; i < 4; i++)
        data[i] = (uint8_t)(bits >> (8 * i));
}

static int32_t get_i32(const uint8_t *data)
{
    uint32_t bits = 0;
    for (int i = 0; i < 4; i++)
        bits |= (uint32_t)data[i] << (8 * i);
    int32_t value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

/* In units of the wire; saturates one step before NO_NUMBER. */
static int32_t to_wire(double value, double unit)
{
    if (!isfinite(value))
        return NO_NUMBER;
    return (int32_t)lrint(clamp(value / unit, -(double)INT32_MAX, (double)INT32_MAX));
}

static int from_wire(const uint8_t *data, double unit, double *value)
{
    const int32_t raw = get_i32(data);
    *value = (double)raw * unit;
    return raw == NO_NUMBER ? RTHYB_W_NOT_FINITE : 0;
}

/* x i32, seq u16, state u8: bytes 0 to 6 of the CAN frame, and of the packet after its type. */
static int put_command(uint8_t *data, const rthyb_setpoint *setpoint, double *sent_m)
{
    const int32_t raw = to_wire(setpoint->x_m, UNIT_X_M);
    put_i32(data, raw);
    data[4] = (uint8_t)setpoint->seq;
    data[5] = (uint8_t)(setpoint->seq >> 8);
    data[6] = (uint8_t)setpoint->state;
    *sent_m = (double)raw * UNIT_X_M;
    return fabs(setpoint->x_m / UNIT_X_M) > (double)INT32_MAX ? RTHYB_S_OUT_OF_RANGE : RTHYB_OK;
}

static int get_command(const uint8_t *data, rthyb_setpoint *setpoint)
{
    setpoint->seq = (uint32_t)data[4] | (uint32_t)data[5] << 8;
    setpoint->state = data[6];
    return from_wire(data, UNIT_X_M, &setpoint->x_m);
}

static void put_tail(uint8_t *data, const rthyb_reading *reading)
{
    data[0] = (uint8_t)reading->echo;
    data[1] = (uint8_t)reading->count;
    data[2] = (uint8_t)reading->status;
}

static void get_tail(const uint8_t *data, rthyb_reading *reading)
{
    reading->echo = data[0];
    reading->count = data[1];
    reading->status = data[2];
}

static void can_begin(uint32_t id, rthyb_frame *frame)
{
    *frame = (rthyb_frame){.id = id, .length = CAN_LENGTH};
}

static void can_seal(rthyb_frame *frame)
{
    frame->data[CAN_CRC_AT] = crc_of(frame->id, frame->data, CAN_LENGTH, CAN_CRC_AT);
}

static int can_recognise(const rthyb_frame *frame)
{
    if (frame->length != CAN_LENGTH)
        return RTHYB_W_LENGTH;
    const uint8_t crc = crc_of(frame->id, frame->data, CAN_LENGTH, CAN_CRC_AT);
    return crc == frame->data[CAN_CRC_AT] ? 0 : RTHYB_W_CRC;
}

static int can_put_feedback(const rthyb_reading *reading, rthyb_frame frames[2])
{
    can_begin(RTHYB_ACT_FB, &frames[0]);
    can_begin(RTHYB_LC_FB, &frames[1]);
    put_i32(frames[0].data, to_wire(reading->x_m, UNIT_X_M));
    put_i32(frames[1].data, to_wire(reading->f_n, UNIT_F_N));
    for (int i = 0; i < 2; i++) {
        put_tail(frames[i].data + 4, reading);
        can_seal(&frames[i]);
    }
    return 2;
}

static int can_get_feedback(const rthyb_frame *frame, rthyb_reading *reading)
{
    if (frame->id != RTHYB_ACT_FB && frame->id != RTHYB_LC_FB)
        return RTHYB_W_ID;
    const int verdict = can_recognise(frame);
    if (verdict)
        return verdict;
    get_tail(frame->data + 4, reading);
    reading->has = frame->id == RTHYB_ACT_FB ? RTHYB_HAS_X : RTHYB_HAS_F;
    return frame->id == RTHYB_ACT_FB ? from_wire(frame->data, UNIT_X_M, &reading->x_m)
                                     : from_wire(frame->data, UNIT_F_N, &reading->f_n);
}

static void serial_seal(uint8_t *packet, size_t n, rthyb_frame *frame)
{
    const uint16_t crc = rthyb_crc16(packet, n);
    packet[n] = (uint8_t)crc;
    packet[n + 1] = (uint8_t)(crc >> 8);
    *frame = (rthyb_frame){0};
    frame->length = (int32_t)rthyb_cobs_encode(packet, n + 2, frame->data);
}

static int serial_recognise(const rthyb_frame *frame, uint8_t type, int32_t length)
{
    if (frame->length < 1 || frame->data[0] != type)
        return RTHYB_W_ID;
    return frame->length == length ? 0 : RTHYB_W_LENGTH;
}

static int serial_put_setpoint(const rthyb_setpoint *setpoint, rthyb_frame *frame, double *sent_m)
{
    uint8_t packet[RTHYB_PACKET_MAX] = {PACKET_COMMAND};
    const int code = put_command(packet + 1, setpoint, sent_m);
    serial_seal(packet, PACKET_COMMAND_LENGTH, frame);
    return code;
}

static int serial_put_feedback(const rthyb_codec *codec, const rthyb_reading *reading,
                               rthyb_frame *frame)
{
    uint8_t packet[RTHYB_PACKET_ROOM] = {PACKET_FEEDBACK};
    put_i32(packet + 1, to_wire(reading->x_m, UNIT_X_M));
    put_i32(packet + 5, to_wire(reading->f_n, UNIT_F_N));
    put_tail(packet + 9, reading);
    put_extras(codec, reading, 1, 1, packet);
    serial_seal(packet, (size_t)feedback_length(codec), frame);
    return 1;
}

static int serial_get_feedback(const rthyb_codec *codec, const rthyb_frame *frame,
                               rthyb_reading *reading)
{
    const int verdict = serial_recognise(frame, PACKET_FEEDBACK, feedback_length(codec));
    if (verdict)
        return verdict;
    get_extras(codec, frame->data, 1, 1, reading);
    get_tail(frame->data + 9, reading);
    reading->has = RTHYB_HAS_X | RTHYB_HAS_F;
    return from_wire(frame->data + 1, UNIT_X_M, &reading->x_m) |
           from_wire(frame->data + 5, UNIT_F_N, &reading->f_n);
}

/* ---- whichever format ----------------------------------------------------------------------------- */

int rthyb_encode_setpoint(const rthyb_codec *codec, const rthyb_setpoint *setpoint,
                          rthyb_frame *frame, double *sent_m)
{
    if (!isfinite(setpoint->x_m)) {
        *frame = (rthyb_frame){0};
        return RTHYB_S_NOT_FINITE;
    }
    if (codec->format == RTHYB_WIRE_TABLE)
        return table_put_setpoint(codec, setpoint, frame, sent_m);
    if (codec->format == RTHYB_WIRE_SERIAL)
        return serial_put_setpoint(setpoint, frame, sent_m);
    can_begin(RTHYB_ACT_CMD, frame);
    const int code = put_command(frame->data, setpoint, sent_m);
    can_seal(frame);
    return code;
}

int rthyb_encode_feedback(const rthyb_codec *codec, const rthyb_reading *reading,
                          rthyb_frame frames[2])
{
    if (codec->format == RTHYB_WIRE_TABLE)
        return table_put_feedback(codec, reading, frames);
    if (codec->format == RTHYB_WIRE_SERIAL)
        return serial_put_feedback(codec, reading, frames);
    return can_put_feedback(reading, frames);
}

int rthyb_decode_setpoint(const rthyb_codec *codec, const rthyb_frame *frame,
                          rthyb_setpoint *setpoint)
{
    *setpoint = (rthyb_setpoint){0};
    if (codec->format == RTHYB_WIRE_TABLE)
        return table_get_setpoint(codec, frame, setpoint);
    if (codec->format == RTHYB_WIRE_SERIAL) {
        const int verdict = serial_recognise(frame, PACKET_COMMAND, PACKET_COMMAND_LENGTH);
        return verdict ? verdict : get_command(frame->data + 1, setpoint);
    }
    if (frame->id != RTHYB_ACT_CMD)
        return RTHYB_W_ID;
    const int verdict = can_recognise(frame);
    return verdict ? verdict : get_command(frame->data, setpoint);
}

int rthyb_decode_feedback(const rthyb_codec *codec, const rthyb_frame *frame,
                          rthyb_reading *reading)
{
    int verdict;
    *reading = (rthyb_reading){0};
    for (int i = 0; i < RTHYB_EXTRAS_MAX; i++)
        reading->extra[i] = (double)NAN;
    if (codec->format == RTHYB_WIRE_TABLE)
        verdict = table_get_feedback(codec, frame, reading);
    else if (codec->format == RTHYB_WIRE_SERIAL)
        verdict = serial_get_feedback(codec, frame, reading);
    else
        verdict = can_get_feedback(frame, reading);
    return reading->status & RTHYB_DEVICE_INVALID ? verdict | RTHYB_W_INVALID : verdict;
}
