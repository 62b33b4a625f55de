/* Exchange of frames over a descriptor that the caller has opened. Only rthyb_link_wait waits. If
 * the kernel reports a broken link, that is remembered until data is received or sent again. */
#define _GNU_SOURCE /* NOLINT(bugprone-reserved-identifier,cert-dcl37-c,cert-dcl51-cpp) */

#include <errno.h>
#include <fcntl.h>
#include <linux/can.h>
#include <linux/can/error.h>
#include <poll.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include "relaxed.h"
#include "rthyb.h"

#define SECOND_NS 1000000000

int rthyb_link_open(rthyb_link *link, int32_t kind, int32_t fd)
{
    if (kind != RTHYB_LINK_CAN && kind != RTHYB_LINK_STREAM)
        return EINVAL;
    const int flags = fcntl(fd, F_GETFL);
    if (flags < 0)
        return errno;
    if (kind == RTHYB_LINK_STREAM && !(flags & O_NONBLOCK))
        return EINVAL;
    const int own = fcntl(fd, F_DUPFD_CLOEXEC, 0);
    if (own < 0)
        return errno;
    *link = (rthyb_link){.kind = kind, .fd = own};
    return 0;
}

void rthyb_link_close(rthyb_link *link)
{
    if (link->fd >= 0)
        close(link->fd);
    link->fd = -1;
}

static void go_down(rthyb_link *link, int fault)
{
    if (peek(&link->down) == RTHYB_LINK_UP)
        add(&link->counters.times_down, 1);
    put(&link->down, (uint64_t)fault);
}

/* 1 if the error is a temporary lack of space or data. */
static int passes(int error)
{
    return error == EAGAIN || error == EWOULDBLOCK || error == ENOBUFS || error == EINTR ||
           error == ENOMEM;
}

static void note_error(rthyb_link *link, int error)
{
    if (error == ENETDOWN)
        go_down(link, RTHYB_LINK_NETWORK_DOWN);
    else if (error == EPIPE || error == ECONNRESET || error == ENOTCONN)
        go_down(link, RTHYB_LINK_HUNG_UP);
    else if (!passes(error))
        go_down(link, RTHYB_LINK_DEVICE_GONE);
}

/* ---- CAN -------------------------------------------------------------------------------------- */

static void note_error_frame(rthyb_link *link, uint32_t id)
{
    add(&link->counters.error_frames, 1);
    if (id & CAN_ERR_BUSOFF)
        go_down(link, RTHYB_LINK_BUS_OFF);
}

/* The size distinguishes a CAN FD frame from a classic one. A length that exceeds the frame's
 * maximum is replaced by 0, which no codec accepts. */
static void unpack(const struct canfd_frame *raw, size_t size, rthyb_frame *frame)
{
    const int fd = size == CANFD_MTU, most = fd ? CANFD_MAX_DLEN : CAN_MAX_DLEN;
    *frame = (rthyb_frame){.id = raw->can_id, .fd = fd};
    if (raw->len > most)
        return;
    frame->length = raw->len;
    memcpy(frame->data, raw->data, raw->len);
}

static int receive_can(rthyb_link *link, rthyb_frame *frame)
{
    struct canfd_frame raw;
    for (int i = 0; i < RTHYB_LINK_PIECES_MAX; i++) {
        const ssize_t got = recv(link->fd, &raw, sizeof raw, MSG_DONTWAIT | MSG_TRUNC);
        if (got <= 0) {
            note_error(link, got == 0 ? EPIPE : errno);
            return 0;
        }
        add(&link->counters.pieces_in, 1);
        add(&link->counters.bytes_in, (uint64_t)got);
        if (got != CAN_MTU && got != CANFD_MTU)
            continue;
        if (raw.can_id & CAN_ERR_FLAG) {
            note_error_frame(link, raw.can_id);
            continue;
        }
        put(&link->down, RTHYB_LINK_UP);
        unpack(&raw, (size_t)got, frame);
        return 1;
    }
    return 0;
}

static ssize_t send_can(const rthyb_link *link, const rthyb_frame *frame)
{
    struct canfd_frame raw = {.can_id = frame->id, .len = (uint8_t)frame->length};
    if (frame->fd == RTHYB_FD_SWITCHED)
        raw.flags = CANFD_BRS;
    memcpy(raw.data, frame->data, (size_t)frame->length);
    const size_t size = frame->fd ? CANFD_MTU : CAN_MTU;
    return send(link->fd, &raw, size, MSG_DONTWAIT | MSG_NOSIGNAL);
}

/* ---- stream ----------------------------------------------------------------------------------- */

/* Reading from a terminal returns nothing both when no data has arrived and when the device is
 * gone. */
static int hung_up(const rthyb_link *link)
{
    struct pollfd look = {.fd = link->fd, .events = POLLIN};
    return poll(&look, 1, 0) > 0 && (look.revents & (POLLHUP | POLLERR | POLLNVAL));
}

static int receive_stream(rthyb_link *link, rthyb_frame *frame)
{
    *frame = (rthyb_frame){0};
    const ssize_t got = read(link->fd, frame->data, sizeof frame->data);
    if (got > 0) {
        frame->length = (int32_t)got;
        put(&link->down, RTHYB_LINK_UP);
        add(&link->counters.pieces_in, 1);
        add(&link->counters.bytes_in, (uint64_t)got);
        return 1;
    }
    if (got < 0)
        note_error(link, errno);
    else if (hung_up(link))
        go_down(link, RTHYB_LINK_HUNG_UP);
    return 0;
}

/* Sends a whole packet or returns an error; a packet that was sent in part is terminated by a 0
 * before the next one. */
static ssize_t send_stream(rthyb_link *link, const rthyb_frame *frame)
{
    uint8_t bytes[RTHYB_FRAME_MAX + 1] = {0};
    const size_t before = link->torn ? 1 : 0, size = before + (size_t)frame->length;
    memcpy(bytes + before, frame->data, (size_t)frame->length);
    const ssize_t sent = write(link->fd, bytes, size);
    if (sent <= 0)
        return sent;
    link->torn = (size_t)sent < size;
    add(&link->counters.bytes_out, (uint64_t)sent);
    if (!link->torn)
        return sent;
    errno = EAGAIN;
    return -1;
}

/* ---- either ----------------------------------------------------------------------------------- */

int rthyb_link_receive(rthyb_link *link, rthyb_frame *frame)
{
    return link->kind == RTHYB_LINK_CAN ? receive_can(link, frame) : receive_stream(link, frame);
}

int rthyb_link_send(rthyb_link *link, const rthyb_frame *frame)
{
    const int can = link->kind == RTHYB_LINK_CAN;
    if (frame->length < 0 || frame->length > RTHYB_FRAME_MAX)
        return 0;
    const ssize_t sent = can ? send_can(link, frame) : send_stream(link, frame);
    if (sent > 0) {
        add(&link->counters.pieces_out, 1);
        if (can)
            add(&link->counters.bytes_out, (uint64_t)sent);
        if (peek(&link->down) != RTHYB_LINK_BUS_OFF) /* off the bus, frames only fill a queue */
            put(&link->down, RTHYB_LINK_UP);
        return 1;
    }
    if (sent < 0 && !passes(errno))
        note_error(link, errno);
    else
        add(&link->counters.no_room, 1);
    return 0;
}

int rthyb_link_wait(const rthyb_link *link, int64_t most_ns)
{
    struct pollfd look = {.fd = link->fd, .events = POLLIN};
    const struct timespec most = {.tv_sec = most_ns / SECOND_NS, .tv_nsec = most_ns % SECOND_NS};
    if (most_ns <= 0 || ppoll(&look, 1, &most, NULL) <= 0)
        return 0;
    return look.revents == POLLIN;
}

void rthyb_link_drain(rthyb_link *link, rthyb_wire *wire)
{
    rthyb_frame frame;
    const int serial = wire->codec.format == RTHYB_WIRE_SERIAL;
    for (int i = 0; i < RTHYB_LINK_PIECES_MAX && rthyb_link_receive(link, &frame); i++) {
        if (serial)
            rthyb_wire_feed(wire, frame.data, (size_t)frame.length);
        else
            rthyb_wire_receive(wire, &frame);
    }
}
