/* The wire: frames (codec.c), serial framing (framing.c), bookkeeping (wire.c). */
#ifndef RTHYB_PART_WIRE_H
#define RTHYB_PART_WIRE_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_extra.h"
#include "rthyb_frame.h"
#include "rthyb_record.h"

/* cffi: begin */

enum rthyb_wire_size {
    RTHYB_SERIAL_COMMAND = 12,  /* a command on the serial line, including the final 0 */
    RTHYB_SERIAL_FEEDBACK = 16, /* feedback without extra channels, each of which adds 4 */
    RTHYB_PACKET_MAX = 14,      /* after COBS decoding, including the CRC, without them */
    RTHYB_PACKET_ROOM = RTHYB_PACKET_MAX + 4 * RTHYB_EXTRAS_MAX
};

enum rthyb_can_id { RTHYB_ACT_CMD = 0x101, RTHYB_ACT_FB = 0x181, RTHYB_LC_FB = 0x182 };
/* Set in a 29-bit identifier, as in SocketCAN. */
#define RTHYB_ID_EXTENDED 0x80000000

/* Bits of the status byte sent by the drive or the load cell. */
enum rthyb_device {
    RTHYB_DEVICE_STOPPED = 1, /* its own stop has begun or is complete; latched in the drive */
    RTHYB_DEVICE_INVALID = 2  /* this reading must not be used */
};

/* What was done with a frame. With a value above HALF, the frame was rejected. */
enum rthyb_verdict {
    RTHYB_W_PAIR = 1,         /* displacement and force of one instant are available */
    RTHYB_W_HALF = 2,         /* one of them, waiting for the other */
    RTHYB_W_ID = 4,           /* a frame with another identifier */
    RTHYB_W_LENGTH = 8,       /* too short or too long */
    RTHYB_W_CRC = 16,         /* damaged */
    RTHYB_W_FRAMING = 32,     /* serial: invalid COBS */
    RTHYB_W_NOT_FINITE = 64,  /* marked as having no number, or contains NaN or inf */
    RTHYB_W_RANGE = 128,      /* outside the range in the DBC file */
    RTHYB_W_INVALID = 256,    /* RTHYB_DEVICE_INVALID */
    RTHYB_W_DUPLICATE = 512,  /* belongs to a sample already received */
    RTHYB_W_REORDERED = 1024, /* older than a sample already received */
    RTHYB_W_STUCK = 2048,     /* the drive repeats the same sample */
    RTHYB_W_PACKET = 4096     /* from a deframer: complete packet with valid CRC */
};

enum rthyb_signal_kind { RTHYB_UNSIGNED, RTHYB_SIGNED, RTHYB_FLOAT };

/* Position of a number in a frame. The value in SI units is raw * scale + offset. */
typedef struct {
    int32_t kind;   /* enum rthyb_signal_kind */
    int32_t length; /* bits; 0: not in this frame */
    int32_t start;  /* 8 * byte + bit of the lowest bit; big-endian: of the highest bit */
    int32_t big_endian;
    int32_t has_none; /* the raw value `none` means that there is no number */
    int64_t none;
    double scale, offset;
    double low, high; /* range of the raw value, as in the DBC file */
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
    int32_t fd; /* enum rthyb_frame_format */
    int32_t length;
    /* byte with the CRC-8/SAE-J1850 of the low byte of the id and all other bytes; -1: none */
    int32_t crc_at;
    rthyb_signal field[RTHYB_FIELDS];
    uint8_t fill[RTHYB_FRAME_MAX]; /* bits that belong to no field */
} rthyb_message;

enum rthyb_wire_format {
    RTHYB_WIRE_CAN,    /* hw/rthyb.dbc, with hand-written code */
    RTHYB_WIRE_SERIAL, /* the same numbers in COBS packets */
    RTHYB_WIRE_TABLE   /* any DBC file, by table */
};

/* A value of an extra channel in the feedback. */
typedef struct {
    int32_t in_force; /* TABLE: in the force frame, else in the displacement frame */
    /* SERIAL: position from the beginning of the packet, after its status byte */
    rthyb_signal signal;
} rthyb_extra;

typedef struct {
    int32_t format; /* enum rthyb_wire_format; only TABLE needs the messages */
    /* If displacement and force have the same id, one frame contains both. */
    rthyb_message command, displacement, force;
    /* TABLE: raw state values for reset and leaving, in addition to those of enum rthyb_state. 0: the drive
     * has no such state, and IDLE is sent. */
    uint32_t reset, leaving;
    uint32_t extra_count; /* CAN: 0, its frames are full */
    rthyb_extra extra[RTHYB_EXTRAS_MAX];
} rthyb_codec;

/* Values in a command in place of the controller's state, in addition to enum rthyb_state. */
enum rthyb_notice {
    RTHYB_NOTICE_RESET = 8,  /* by the operator: a drive that stopped itself must follow again */
    RTHYB_NOTICE_LEAVING = 9 /* commands now end intentionally: no reset will be required */
};

enum rthyb_wire_error { RTHYB_E_CODEC = 64 };

/* A shorter count would wrap around while half of a pair may still be waiting for the other. */
enum rthyb_codec_size { RTHYB_COUNT_BITS_MIN = 5 };

typedef struct {
    double x_m;
    uint32_t seq;   /* incremented with every command */
    uint32_t state; /* enum rthyb_state, or enum rthyb_notice */
} rthyb_setpoint;

enum rthyb_reading_part { RTHYB_HAS_X = 1, RTHYB_HAS_F = 2 };

typedef struct {
    uint32_t has;   /* enum rthyb_reading_part */
    uint32_t echo;  /* low bits of the seq of the command in effect at the instant of this sample */
    uint32_t count; /* sample count of the drive */
    uint32_t status; /* enum rthyb_device */
    double x_m, f_n;
    double extra[RTHYB_EXTRAS_MAX]; /* NaN: not in this frame, or no number */
    uint32_t beyond; /* bits of extra channels with a value outside the range in the DBC file */
} rthyb_reading;

/* 0, or RTHYB_E_CODEC if the table does not fit its frames. The functions below require a codec that
 * passed this check. */
int rthyb_codec_check(const rthyb_codec *codec);
/* Greatest magnitude of which an extra channel carries every value, of either sign; 0: none. A value that it cannot
 * carry arrives, from a converter that saturates, with at least that magnitude. */
double rthyb_extra_reach(const rthyb_codec *codec, uint32_t number);
/* The same of a reading of the axis, gain * wire + offset; of readings of one sign only, the far end. part: RTHYB_HAS_X
 * or RTHYB_HAS_F. */
double rthyb_reading_reach(const rthyb_codec *codec, int32_t part, double gain, double offset);

/* Encodes a command: for CAN as a frame, for a serial line as the bytes to write. *sent_m is the displacement as the
 * drive will decode it. Returns RTHYB_OK; RTHYB_S_OUT_OF_RANGE if the frame cannot represent the value, and contains
 * the nearest possible one; RTHYB_S_NOT_FINITE if there is no frame (its length is 0). */
int rthyb_encode_setpoint(const rthyb_codec *codec, const rthyb_setpoint *setpoint,
                          rthyb_frame *frame, double *sent_m);
/* For a displacement between two bounds: returns it unchanged if the value to which a frame rounds it also lies between
 * them, to within a millionth of a step; otherwise the nearest frame value that does. NaN: none. */
double rthyb_command_within(const rthyb_codec *codec, double x_m, double low_m, double high_m);
/* Encodes a sample of the drive as one or two frames; returns their number. 0: not finite, and the table cannot say so. */
int rthyb_encode_feedback(const rthyb_codec *codec, const rthyb_reading *reading,
                          rthyb_frame frames[2]);
/* 0, or the reason why the frame is rejected (enum rthyb_verdict). For a serial line, the frame is a packet from the
 * deframer. After NOT_FINITE, RANGE and INVALID, the count of the reading is valid but its values are not. */
int rthyb_decode_setpoint(const rthyb_codec *codec, const rthyb_frame *frame,
                          rthyb_setpoint *setpoint);
int rthyb_decode_feedback(const rthyb_codec *codec, const rthyb_frame *frame,
                          rthyb_reading *reading);

/* CRC-8/SAE-J1850 and CRC-16/CCITT-FALSE. */
uint8_t rthyb_crc8(const uint8_t *bytes, size_t n);
uint16_t rthyb_crc16(const uint8_t *bytes, size_t n);
/* Encodes fewer than 254 bytes as n + 2 bytes, of which only the last, the end of the packet, is 0. */
size_t rthyb_cobs_encode(const uint8_t *bytes, size_t n, uint8_t *out);

/* Finds packets in a stream of bytes; after an error it resynchronises at the next 0. Initialise it with zeros. */
typedef struct {
    uint8_t data[RTHYB_PACKET_ROOM];
    uint8_t length;   /* bytes in data */
    uint8_t left;     /* bytes until the next code byte */
    uint8_t begun;    /* a byte was received since the last 0 */
    uint8_t too_long; /* longer than any packet: waiting for the 0 */
    uint8_t extras;   /* set by the caller: number of extra channels in a packet */
} rthyb_deframer;

/* 0: packet not complete. RTHYB_W_PACKET: *packet contains the bytes without the CRC. Otherwise the error. */
int rthyb_deframer_byte(rthyb_deframer *deframer, uint8_t byte, rthyb_frame *packet);

/* May be read while the wire is in use. */
typedef struct {
    uint64_t sent;   /* commands */
    uint64_t frames; /* frames and packets received, valid or not */
    uint64_t pairs;  /* used */
    uint64_t other_id, bad_length, bad_crc, bad_framing, not_finite, out_of_range, invalid;
    uint64_t duplicate, reordered;
    uint64_t stuck;      /* duplicates after many other duplicates */
    uint64_t lone;       /* halves whose other half did not arrive */
    uint64_t missed;     /* samples missing according to the drive's count */
    uint64_t superseded; /* pairs followed by another within one tick */
    uint64_t stale;      /* ticks without a new pair */
} rthyb_wire_counters;

/* The controller's end of the wire. */
typedef struct {
    rthyb_codec codec;
    rthyb_deframer deframer;
    uint32_t seq; /* of the last command */
    uint32_t echo_mask, count_mask;
    rthyb_reading half[2];   /* displacement, force: waiting for the other half; has = 0: none */
    uint32_t half_age[2];    /* ticks */
    rthyb_reading pair;      /* newest */
    uint64_t samples;        /* its count, without wrap-around */
    uint32_t age;            /* ticks since it arrived */
    uint32_t stopped;        /* RTHYB_DEVICE_STOPPED or 0, from the last intact frame */
    uint32_t repeats;        /* consecutive frames without new data */
    int32_t synced;          /* the next count is known from pair.count */
    int32_t fresh, refused;  /* since the last take: whether a pair came; enum rthyb_status */
    uint32_t extras_refused; /* bit i: extra channel i had no number in a pair of the newest tick */
    rthyb_wire_counters counters;
    uint32_t extra_channel; /* set by the caller: index of a row's first extra channel */
} rthyb_wire;

typedef struct {
    double x_m, f_n; /* newest pair, 0 before the first */
    uint32_t echo, count, status;
    /* Samples between the command for this tick and the one in effect at the instant of the pair; -1: unknown. */
    int32_t delay;
    uint32_t age; /* ticks since the pair arrived; 0: new in this tick */
    /* the drive's count without wrap-around; after 20 ticks of silence only modulo 2^bits */
    uint64_t samples;
} rthyb_feedback;

/* 0 or RTHYB_E_CODEC. */
int rthyb_wire_init(rthyb_wire *wire, const rthyb_codec *codec);
/* Encodes the next command with the next seq; see rthyb_encode_setpoint. */
int rthyb_wire_command(rthyb_wire *wire, double x_m, int32_t state, rthyb_frame *frame,
                       double *sent_m);
/* Processes a received CAN frame: enum rthyb_verdict. ID, LENGTH, CRC, FRAMING: only that counter changes. */
int rthyb_wire_receive(rthyb_wire *wire, const rthyb_frame *frame);
/* Processes bytes from the serial line, in pieces of any size; returns all verdicts combined. */
int rthyb_wire_feed(rthyb_wire *wire, const uint8_t *bytes, size_t n);
/* Call once per tick, after processing everything received and before making the command: returns the newest pair. The
 * result is RTHYB_OK, or the reason why there is none, for rthyb_input.lost. */
int rthyb_wire_take(rthyb_wire *wire, rthyb_feedback *feedback);
/* After rthyb_wire_take: the extra channels of a pair that was new in this tick; NaN if there was none. */
void rthyb_wire_record_extras(const rthyb_wire *wire, double *channels);
/* cffi: end */

#endif
