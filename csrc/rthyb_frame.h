/* A CAN frame, or a packet of the serial line, as a link exchanges it. */
#ifndef RTHYB_PART_FRAME_H
#define RTHYB_PART_FRAME_H

#include <stdint.h>

/* cffi: begin */
enum rthyb_frame_size {
    RTHYB_FRAME_MAX = 64 /* data of a CAN FD frame, bytes */
};

/* Format of a CAN frame. */
enum rthyb_frame_format {
    RTHYB_CLASSIC = 0,
    RTHYB_FD = 1,         /* CAN FD, all of it at one bit rate */
    RTHYB_FD_SWITCHED = 2 /* CAN FD, its data at the higher bit rate of the data phase */
};

typedef struct {
    uint32_t id;    /* as in SocketCAN, flags included; serial: 0 */
    int32_t fd;     /* enum rthyb_frame_format in which it is sent; received: 0 or not */
    int32_t length; /* bytes in data */
    uint8_t data[RTHYB_FRAME_MAX];
} rthyb_frame;
/* cffi: end */

#endif
