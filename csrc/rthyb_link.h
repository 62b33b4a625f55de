/* A link: what carries the frames (link.c). */
#ifndef RTHYB_PART_LINK_H
#define RTHYB_PART_LINK_H

#include <stdint.h>

#include "rthyb_wire.h"

/* cffi: begin */

enum rthyb_link_kind {
    RTHYB_LINK_CAN,   /* SocketCAN; or a SOCK_SEQPACKET socket, each packet a struct can_frame */
    RTHYB_LINK_STREAM /* tty in raw mode, or a stream socket: serial packets */
};

/* Why a link is down. */
enum rthyb_link_fault {
    RTHYB_LINK_UP,
    RTHYB_LINK_NETWORK_DOWN, /* ENETDOWN: the interface was set down, or the cable pulled */
    RTHYB_LINK_DEVICE_GONE,  /* ENODEV, ENXIO, EIO and other errors that do not pass */
    RTHYB_LINK_BUS_OFF,      /* the CAN controller has left the bus */
    RTHYB_LINK_HUNG_UP       /* the other end is closed */
};

/* May be read while the link is in use. */
typedef struct {
    uint64_t pieces_in, bytes_in; /* frames; stream: what one read gave */
    uint64_t pieces_out, bytes_out;
    uint64_t no_room;      /* not sent: the queue was full (ENOBUFS, EAGAIN) */
    uint64_t error_frames; /* CAN: reports of the controller, bus-off among them */
    uint64_t times_down;
} rthyb_link_counters;

/* A descriptor of its own on what the caller opened and set up. */
typedef struct {
    int32_t kind, fd;
    uint64_t down; /* enum rthyb_link_fault; until something comes or goes again; for any thread */
    int32_t torn;  /* stream: half of a packet was written, the next one begins with a 0 */
    rthyb_link_counters counters;
} rthyb_link;

enum rthyb_link_size { RTHYB_LINK_PIECES_MAX = 256 }; /* taken in one tick */

/* 0 or errno. Refuses with EINVAL an unknown kind, and a stream without O_NONBLOCK: a tty has no
 * other way not to wait. The caller may close its own descriptor. */
int rthyb_link_open(rthyb_link *link, int32_t kind, int32_t fd);
void rthyb_link_close(rthyb_link *link);
/* 1: a frame, or some bytes of a stream; 0: nothing more, or down. */
int rthyb_link_receive(rthyb_link *link, rthyb_frame *frame);
/* 1: sent; 0: lost, counted, for want of room or because the link is down. */
int rthyb_link_send(rthyb_link *link, const rthyb_frame *frame);
/* Waits for something to come, so long at most. 1: it did; 0: not, or nothing ever will, because the
 * descriptor is in error or its other end closed: then it does not wait. The one function here that
 * waits. */
int rthyb_link_wait(const rthyb_link *link, int64_t most_ns);
/* Everything that came, into the wire; RTHYB_LINK_PIECES_MAX pieces at most. */
void rthyb_link_drain(rthyb_link *link, rthyb_wire *wire);
/* cffi: end */

#endif
