/* A link transports frames (link.c). */
#ifndef RTHYB_PART_LINK_H
#define RTHYB_PART_LINK_H

#include <stdint.h>

#include "rthyb_wire.h"

/* cffi: begin */

enum rthyb_link_kind {
    RTHYB_LINK_CAN, /* SocketCAN, or a SOCK_SEQPACKET socket with one struct can_frame per packet */
    RTHYB_LINK_STREAM /* tty in raw mode, or a stream socket: serial packets */
};

/* Why a link is down. */
enum rthyb_link_fault {
    RTHYB_LINK_UP,
    RTHYB_LINK_NETWORK_DOWN, /* ENETDOWN: the interface was set down, or the cable was unplugged */
    RTHYB_LINK_DEVICE_GONE,  /* ENODEV, ENXIO, EIO and other permanent errors */
    RTHYB_LINK_BUS_OFF,      /* the CAN controller has left the bus */
    RTHYB_LINK_HUNG_UP       /* the other end is closed */
};

/* May be read while the link is in use. */
typedef struct {
    uint64_t pieces_in, bytes_in; /* frames; for a stream, the result of one read */
    uint64_t pieces_out, bytes_out;
    uint64_t no_room;      /* not sent: the queue was full (ENOBUFS, EAGAIN) */
    uint64_t error_frames; /* CAN: error reports of the controller, including bus-off */
    uint64_t times_down;
} rthyb_link_counters;

/* Has its own descriptor for the device or socket that the caller opened and configured. */
typedef struct {
    int32_t kind, fd;
    uint64_t down; /* enum rthyb_link_fault, until communication resumes; any thread may read it */
    int32_t torn;  /* stream: a packet was written only in part; the next one begins with a 0 */
    rthyb_link_counters counters;
} rthyb_link;

enum rthyb_link_size { RTHYB_LINK_PIECES_MAX = 256 }; /* read in one tick */

/* Returns 0 or errno. An unknown kind and a stream without O_NONBLOCK are rejected with EINVAL, because
 * only O_NONBLOCK prevents a tty from blocking. The caller may close its own descriptor afterwards. */
int rthyb_link_open(rthyb_link *link, int32_t kind, int32_t fd);
void rthyb_link_close(rthyb_link *link);
/* 1: received a frame, or bytes of a stream; 0: nothing more to receive, or the link is down. */
int rthyb_link_receive(rthyb_link *link, rthyb_frame *frame);
/* 1: sent; 0: not sent, and counted, because the queue was full or the link is down. */
int rthyb_link_send(rthyb_link *link, const rthyb_frame *frame);
/* Waits at most most_ns for data. 1: data are available; 0: none arrived, or none can arrive because
 * the descriptor is in error or the other end is closed, in which case it returns at once. This is the
 * only function here that waits. */
int rthyb_link_wait(const rthyb_link *link, int64_t most_ns);
/* Passes everything that arrived to the wire, at most RTHYB_LINK_PIECES_MAX pieces. */
void rthyb_link_drain(rthyb_link *link, rthyb_wire *wire);
/* cffi: end */

#endif
