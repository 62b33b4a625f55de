/* The wire: frames (codec.c), serial framing (framing.c), bookkeeping (wire.c). */
#ifndef RTHYB_PART_WIRE_H
#define RTHYB_PART_WIRE_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_record.h"

/* cffi: begin */

enum rthyb_wire_size {
    RTHYB_FRAME_MAX = 64,       /* data of a CAN FD frame, bytes */
    RTHYB_SERIAL_COMMAND = 12,  /* a command on the serial line, with the 0 that ends it */
    RTHYB_SERIAL_FEEDBACK = 16, /* the same of a feedback */
    RTHYB_PACKET_MAX = 14       /* what COBS unpacks to, with its CRC */
};

enum rthyb_can_id { RTHYB_ACT_CMD = 0x101, RTHYB_ACT_FB = 0x181, RTHYB_LC_FB = 0x182 };
/* Added to a 29-bit identifier, as in SocketCAN. */
#define RTHYB_ID_EXTENDED 0x80000000

/* Bits of the status byte that the drive or the load cell sends. */
enum rthyb_device {
    RTHYB_DEVICE_STOPPED = 1, /* its own stop has begun or is done; latched there */
    RTHYB_DEVICE_INVALID = 2  /* this reading is not to be used */
};

/* What became of a frame. Above HALF: the frame was not taken. */
enum rthyb_verdict {
    RTHYB_W_PAIR = 1,         /* displacement and force of one instant are complete */
    RTHYB_W_HALF = 2,         /* one of them; it waits for the other */
    RTHYB_W_ID = 4,           /* not a frame for us */
    RTHYB_W_LENGTH = 8,       /* too short or too long */
    RTHYB_W_CRC = 16,         /* damaged */
    RTHYB_W_FRAMING = 32,     /* serial: not COBS */
    RTHYB_W_NOT_FINITE = 64,  /* says that it has no number, or holds NaN or inf */
    RTHYB_W_RANGE = 128,      /* beyond the range in the DBC */
    RTHYB_W_INVALID = 256,    /* RTHYB_DEVICE_INVALID */
    RTHYB_W_DUPLICATE = 512,  /* of a sample that is here already */
    RTHYB_W_REORDERED = 1024, /* older than what is here already */
    RTHYB_W_STUCK = 2048,     /* the drive repeats one sample again and again */
    RTHYB_W_PACKET = 4096     /* of a deframer: a whole packet, CRC good */
};

typedef struct {
    uint32_t id;    /* as in SocketCAN, flags included; serial: 0 */
    int32_t fd;     /* to be sent as CAN FD */
    int32_t length; /* bytes in data */
    uint8_t data[RTHYB_FRAME_MAX];
} rthyb_frame;

enum rthyb_signal_kind { RTHYB_UNSIGNED, RTHYB_SIGNED, RTHYB_FLOAT };

/* Where a number stands in a frame. Its value in SI is raw * scale + offset. */
typedef struct {
    int32_t kind;   /* enum rthyb_signal_kind */
    int32_t length; /* bits; 0: the frame does not have it */
    int32_t start;  /* 8 byte + bit of its lowest bit; big-endian: of its highest */
    int32_t big_endian;
    int32_t has_none; /* raw value `none` says that there is no number */
    int64_t none;
    double scale, offset;
    double low, high; /* range of the raw value, as the DBC has it */
} rthyb_signal;

enum rthyb_field {
    RTHYB_FIELD_X,
    RTHYB_FIELD_F,
    RTHYB_FIELD_SEQ,
    RTHYB_FIELD_STATE,
    RTHYB_FIELD_ECHO,
    RTHYB_FIELD_COUNT,
    RTHYB_FIELD_STATUS,
    RTHYB_FIELDS
};

typedef struct {
    uint32_t id;
    int32_t fd, length;
    int32_t crc_at; /* byte with CRC-8/SAE-J1850 of the id's low byte and all others; -1: none */
    rthyb_signal field[RTHYB_FIELDS];
    uint8_t fill[RTHYB_FRAME_MAX]; /* the bits that belong to no field */
} rthyb_message;

enum rthyb_wire_format {
    RTHYB_WIRE_CAN,    /* hw/rthyb.dbc, its code written by hand */
    RTHYB_WIRE_SERIAL, /* the same numbers in COBS packets */
    RTHYB_WIRE_TABLE   /* any DBC, by table */
};

typedef struct {
    int32_t format; /* enum rthyb_wire_format; only TABLE needs the messages */
    /* displacement and force with one id: one frame holds both. */
    rthyb_message command, displacement, force;
    /* Raw state by which a table's drive is told so, beyond those of enum rthyb_state. 0: it cannot be,
     * and is told IDLE. */
    uint32_t reset, leaving;
} rthyb_codec;

/* What a command says in the place of the controller's state, beside enum rthyb_state. */
enum rthyb_told {
    RTHYB_TOLD_RESET =
        8, /* an operator's: a drive that stands after a stop of its own follows again */
    RTHYB_TOLD_LEAVING =
        9 /* the silence that follows is meant: it is no reason to ask for a reset */
};

enum rthyb_wire_error { RTHYB_E_CODEC = 64 };

/* A shorter count comes round while one half of a pair may still wait for the other. */
enum rthyb_codec_size { RTHYB_COUNT_BITS_MIN = 5 };

typedef struct {
    double x_m;
    uint32_t seq;   /* one more with every command */
    uint32_t state; /* enum rthyb_state, or enum rthyb_told */
} rthyb_setpoint;

enum rthyb_reading_part { RTHYB_HAS_X = 1, RTHYB_HAS_F = 2 };

typedef struct {
    uint32_t has;    /* enum rthyb_reading_part */
    uint32_t echo;   /* low bits of the seq of the command applied at the instant of this sample */
    uint32_t count;  /* the drive's samples */
    uint32_t status; /* enum rthyb_device */
    double x_m, f_n;
} rthyb_reading;

/* 0, or RTHYB_E_CODEC for a table that does not fit its frames. The functions below trust a codec
 * that passed. */
int rthyb_codec_check(const rthyb_codec *codec);

/* A command as bytes; CAN: a frame, serial: what is to be written. *sent_m is the displacement as
 * the drive will read it. RTHYB_OK; RTHYB_S_OUT_OF_RANGE for one that the frame cannot hold, sent as
 * the nearest that it can; RTHYB_S_NOT_FINITE: there is no frame, its length is 0. */
int rthyb_encode_setpoint(const rthyb_codec *codec, const rthyb_setpoint *setpoint,
                          rthyb_frame *frame, double *sent_m);
/* For a displacement between two bounds: itself, where what a frame rounds it to lies between them as
 * well, to a millionth of a step; else the value of the frame next to it that does. NaN: none does. */
double rthyb_command_within(const rthyb_codec *codec, double x_m, double low_m, double high_m);
/* A sample of the drive as one or two frames; returns how many. 0 if a value is not finite and the
 * table has no way to say so. */
int rthyb_encode_feedback(const rthyb_codec *codec, const rthyb_reading *reading,
                          rthyb_frame frames[2]);
/* 0, or why the frame is not taken (enum rthyb_verdict). serial: the frame is a deframer's packet.
 * After NOT_FINITE, RANGE and INVALID the reading's count is good, its values are not. */
int rthyb_decode_setpoint(const rthyb_codec *codec, const rthyb_frame *frame,
                          rthyb_setpoint *setpoint);
int rthyb_decode_feedback(const rthyb_codec *codec, const rthyb_frame *frame,
                          rthyb_reading *reading);

/* CRC-8/SAE-J1850 and CRC-16/CCITT-FALSE. */
uint8_t rthyb_crc8(const uint8_t *bytes, size_t n);
uint16_t rthyb_crc16(const uint8_t *bytes, size_t n);
/* Fewer than 254 bytes -> n + 2 bytes without a 0 but the last, which ends the packet. */
size_t rthyb_cobs_encode(const uint8_t *bytes, size_t n, uint8_t *out);

/* Finds packets in a stream of bytes; after damage it is in step again at the next 0. All zero is
 * its start. */
typedef struct {
    uint8_t data[RTHYB_PACKET_MAX];
    uint8_t length;   /* bytes in data */
    uint8_t left;     /* bytes until the next code byte */
    uint8_t begun;    /* a byte came since the last 0 */
    uint8_t too_long; /* nothing fits any more: wait for the 0 */
} rthyb_deframer;

/* 0: nothing yet. RTHYB_W_PACKET: *packet has the bytes without their CRC. Else what was damaged. */
int rthyb_deframer_byte(rthyb_deframer *deframer, uint8_t byte, rthyb_frame *packet);

/* May be read while the wire is in use. */
typedef struct {
    uint64_t sent;   /* commands */
    uint64_t frames; /* frames and packets that came, good or bad */
    uint64_t pairs;  /* taken */
    uint64_t other_id, bad_length, bad_crc, bad_framing, not_finite, out_of_range, invalid;
    uint64_t duplicate, reordered;
    uint64_t stuck;      /* duplicates after many others */
    uint64_t lone;       /* halves whose other half did not come */
    uint64_t missed;     /* samples that the drive's count skips */
    uint64_t superseded; /* pairs followed by another within one tick */
    uint64_t stale;      /* ticks without a new pair */
} rthyb_wire_counters;

/* One end of the wire, the controller's. */
typedef struct {
    rthyb_codec codec;
    rthyb_deframer deframer;
    uint32_t seq; /* of the last command */
    uint32_t echo_mask, count_mask;
    rthyb_reading half[2]; /* displacement, force: what waits for its other half; has 0: none */
    uint32_t half_age[2];  /* ticks */
    rthyb_reading pair;    /* newest */
    uint64_t samples;      /* its count, unwrapped */
    uint32_t age;          /* ticks since it came */
    uint32_t stopped;      /* RTHYB_DEVICE_STOPPED: last word of any frame that was intact, or 0 */
    uint32_t repeats;      /* frames in a row that bring nothing new */
    int32_t synced;        /* pair.count says which count comes next */
    int32_t fresh;         /* pair came since the last take */
    int32_t refused;       /* enum rthyb_status: readings refused since the last take */
    rthyb_wire_counters counters;
} rthyb_wire;

typedef struct {
    double x_m, f_n; /* newest pair, 0 before the first */
    uint32_t echo, count, status;
    /* Samples between the command for this tick and the one that the drive had applied at the
     * instant of the pair; -1: not known. */
    int32_t delay;
    uint32_t age; /* ticks since the pair came, 0: fresh */
    uint64_t
        samples; /* the drive's count, unwrapped; after 20 ticks of silence only modulo 2^bits */
} rthyb_feedback;

/* 0 or RTHYB_E_CODEC. */
int rthyb_wire_init(rthyb_wire *wire, const rthyb_codec *codec);
/* The next command, with the next seq; as rthyb_encode_setpoint. */
int rthyb_wire_command(rthyb_wire *wire, double x_m, int32_t state, rthyb_frame *frame,
                       double *sent_m);
/* A CAN frame that came. Returns its enum rthyb_verdict. One with ID, LENGTH, CRC or FRAMING
 * changes nothing but its counter. */
int rthyb_wire_receive(rthyb_wire *wire, const rthyb_frame *frame);
/* Bytes that came from the serial line, in pieces of any size; all verdicts together. */
int rthyb_wire_feed(rthyb_wire *wire, const uint8_t *bytes, size_t n);
/* Once a tick, after all that came was taken in and before the command is made: the newest pair.
 * RTHYB_OK, or why there is none: for rthyb_input.lost. */
int rthyb_wire_take(rthyb_wire *wire, rthyb_feedback *feedback);
/* cffi: end */

#endif
