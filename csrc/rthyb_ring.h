/* The telemetry ring (ring.c). */
#ifndef RTHYB_PART_RING_H
#define RTHYB_PART_RING_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_record.h"

/* cffi: begin */

typedef struct rthyb_ring rthyb_ring;

enum rthyb_ring_size {
    RTHYB_RING_LAYOUT = 3,                                         /* version of this layout */
    RTHYB_RING_CAPACITY = 65536,                                   /* records in a ring: 64 s */
    RTHYB_ROW_WORDS_MAX = RTHYB_RECORD_WORDS + RTHYB_CHANNELS_MAX, /* a record and its channels */
    RTHYB_RING_AFTER_TRIP = 1024 /* records stored after a TRIP before the ring is frozen */
};

/* Bit mask. */
enum rthyb_ring_phase {
    RTHYB_RING_OPEN = 0,
    RTHYB_RING_FROZEN = 1, /* not written after a TRIP, until the state changes */
    RTHYB_RING_CLOSED = 2  /* the producer ended normally */
};

/* Reasons for which rthyb_ring_attach rejects a mapping. */
enum rthyb_ring_refusal {
    RTHYB_RING_FOREIGN = 1, /* not a ring */
    RTHYB_RING_UNFINISHED,  /* the producer did not complete its initialisation */
    RTHYB_RING_OTHER_LAYOUT,
    RTHYB_RING_OTHER_RECORD,
    RTHYB_RING_TRUNCATED, /* shorter than its header states */
    RTHYB_RING_DAMAGED    /* contradictory sizes */
};

/* Result of rthyb_ring_settle; bit mask. */
enum rthyb_ring_fact {
    RTHYB_RING_LOCKED = 1,   /* cannot be paged out */
    RTHYB_RING_IN_MEMORY = 2 /* on tmpfs: the producer never waits for write-back */
};

/* One row (a record and its channels) and its stamp, which is 2 n + 1 while row n is being written,
 * 2 n + 2 once it is complete, and 0 if nothing was ever written. In the file, a slot has only as many words
 * as the ring uses. */
typedef struct {
    uint64_t stamp;
    uint64_t words[RTHYB_ROW_WORDS_MAX];
} rthyb_ring_slot;

/* Start of the file. The fields from magic to about_bytes are the same in every layout. */
typedef struct {
    uint64_t magic;
    uint32_t layout, record_bytes;  /* size of a row: a record and its channels */
    uint64_t about_at, about_bytes; /* JSON: fields, units, versions, process */
    uint64_t slots_at, file_bytes;
    uint32_t capacity, slot_bytes;
    uint64_t spare[1];
    uint64_t pushed;        /* number of records so far, and number of the next record */
    uint64_t phase;         /* enum rthyb_ring_phase bits */
    uint64_t apart[6];      /* the next field starts a cache line */
    rthyb_ring_slot newest; /* status page: newest record while the ring is frozen */
} rthyb_ring_header;

/* State of the producer; one thread at a time. */
struct rthyb_ring {
    rthyb_ring_header *header;
    char *slots;
    uint64_t mask;
    uint64_t pushed, shown; /* records in the ring, records on the status page */
    uint32_t slot_bytes, record_words, channel_count;
    uint32_t tripped; /* records stored since the TRIP */
};

/* A reader of a mapping, which may be read-only. Readers are independent of one another, and the producer
 * does not know of them. */
typedef struct {
    const rthyb_ring_header *header;
    const char *slots;
    uint64_t capacity, mask;
    uint32_t slot_bytes, row_words;
    uint64_t next; /* number of the next record to read */
    uint64_t lost; /* records overwritten before they could be read */
} rthyb_ring_reader;

/* File size for a capacity (a power of two), a length of the description in bytes, and numbers of axes and of
 * channels (at most RTHYB_CHANNELS_MAX) of each row. */
size_t rthyb_ring_bytes(uint32_t capacity, size_t about_bytes, int32_t axis_count,
                        uint32_t channel_count);
/* Offset of the description in the file, in bytes. */
size_t rthyb_ring_about_at(void);
/* Locks the mapping in memory and writes to all of it once; returns enum rthyb_ring_fact bits. The blocks
 * of the file must already be allocated (posix_fallocate). Call it before the start only. */
int rthyb_ring_settle(int fd, void *map, size_t bytes);
/* Writes the header into a settled mapping of rthyb_ring_bytes() bytes that already contains the
 * description. Readers can attach from then on. */
void rthyb_ring_init(rthyb_ring *ring, void *map, uint32_t capacity, size_t about_bytes,
                     int32_t axis_count, uint32_t channel_count);
/* Never waits, fails or calls the kernel. In state TRIPPED, RTHYB_RING_AFTER_TRIP records are stored;
 * further records update only the status page until the state changes.
 * channels: one value per channel of the ring; NULL stores NaN. */
void rthyb_ring_push(rthyb_ring *ring, const rthyb_record *record, const double *channels);
/* Consecutive rows with as many axes as the ring has. channels: values of each row in turn, or NULL. */
void rthyb_ring_push_run(rthyb_ring *ring, const void *rows, size_t n, const double *channels);
void rthyb_ring_close(rthyb_ring *ring);

/* Attaches to a mapping of a complete file, positioned before its oldest record; 0 or enum
 * rthyb_ring_refusal. Whatever the file contains, nothing beyond `bytes` is read. */
int rthyb_ring_attach(rthyb_ring_reader *reader, const void *map, size_t bytes);
/* Reads up to n consecutive rows of record_bytes each; the number of the first is next - (returned count).
 * A gap before them is added to lost. 0: nothing new. */
size_t rthyb_ring_read(rthyb_ring_reader *reader, void *rows, size_t n);
/* Reads the newest row, even while the ring is frozen; 0 if there is none. */
int rthyb_ring_newest(const rthyb_ring_reader *reader, void *row);
uint64_t rthyb_ring_pushed(const rthyb_ring_reader *reader);
/* enum rthyb_ring_phase bits. */
int rthyb_ring_phase(const rthyb_ring_reader *reader);
/* cffi: end */

#endif
