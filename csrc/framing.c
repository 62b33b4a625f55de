/* Protection and delimiting of frames: CRC-8/SAE-J1850, CRC-16/CCITT-FALSE, COBS (Cheshire & Baker,
 * Consistent Overhead Byte Stuffing, 1999). */
#include "rthyb.h"

#define CRC16_BYTES 2

uint8_t rthyb_crc8(const uint8_t *bytes, size_t n)
{
    /* x^8 + x^4 + x^3 + x^2 + 1, four bits at a time */
    static const uint8_t step[16] = {0x00, 0x1d, 0x3a, 0x27, 0x74, 0x69, 0x4e, 0x53,
                                     0xe8, 0xf5, 0xd2, 0xcf, 0x9c, 0x81, 0xa6, 0xbb};
    unsigned crc = 0xff;
    for (size_t i = 0; i < n; i++) {
        crc ^= bytes[i];
        crc = ((crc << 4) & 0xff) ^ step[crc >> 4];
        crc = ((crc << 4) & 0xff) ^ step[crc >> 4];
    }
    return (uint8_t)(crc ^ 0xff);
}

uint16_t rthyb_crc16(const uint8_t *bytes, size_t n)
{
    /* x^16 + x^12 + x^5 + 1, four bits at a time */
    static const uint16_t step[16] = {0x0000, 0x1021, 0x2042, 0x3063, 0x4084, 0x50a5,
                                      0x60c6, 0x70e7, 0x8108, 0x9129, 0xa14a, 0xb16b,
                                      0xc18c, 0xd1ad, 0xe1ce, 0xf1ef};
    unsigned crc = 0xffff;
    for (size_t i = 0; i < n; i++) {
        crc ^= (unsigned)bytes[i] << 8;
        crc = ((crc << 4) & 0xffff) ^ step[crc >> 12];
        crc = ((crc << 4) & 0xffff) ^ step[crc >> 12];
    }
    return (uint16_t)crc;
}

size_t rthyb_cobs_encode(const uint8_t *bytes, size_t n, uint8_t *out)
{
    size_t code = 0, at = 1; /* out[code] will hold the distance to the next 0 */
    for (size_t i = 0; i < n; i++) {
        if (bytes[i]) {
            out[at++] = bytes[i];
        } else {
            out[code] = (uint8_t)(at - code);
            code = at++;
        }
    }
    out[code] = (uint8_t)(at - code);
    out[at] = 0;
    return at + 1;
}

static void push(rthyb_deframer *d, uint8_t byte)
{
    if (d->length < RTHYB_PACKET_MAX + 4 * d->extras && d->length < RTHYB_PACKET_ROOM)
        d->data[d->length++] = byte;
    else
        d->too_long = 1;
}

/* After the delimiter, a 0: checks what was received before it. */
static int finish(const rthyb_deframer *d, rthyb_frame *packet)
{
    if (!d->begun)
        return 0; /* two delimiters in a row: an idle line, or a sender that starts with one */
    if (d->too_long)
        return RTHYB_W_LENGTH;
    if (d->left)
        return RTHYB_W_FRAMING;
    if (d->length <= CRC16_BYTES)
        return RTHYB_W_LENGTH;
    const int32_t n = d->length - CRC16_BYTES;
    if (rthyb_crc16(d->data, (size_t)n) != (d->data[n] | d->data[n + 1] << 8))
        return RTHYB_W_CRC;
    *packet = (rthyb_frame){.length = n};
    for (int32_t i = 0; i < n; i++)
        packet->data[i] = d->data[i];
    return RTHYB_W_PACKET;
}

int rthyb_deframer_byte(rthyb_deframer *d, uint8_t byte, rthyb_frame *packet)
{
    if (byte == 0) {
        const int verdict = finish(d, packet);
        *d = (rthyb_deframer){.extras = d->extras};
        return verdict;
    }
    if (d->left) {
        push(d, byte);
        d->left--;
    } else {
        if (d->begun)
            push(d, 0); /* the zero that the previous code stands for */
        d->begun = 1;
        d->left = (uint8_t)(byte - 1);
    }
    return 0;
}
