/* The telemetry ring (ring.c). */
#ifndef RTHYB_PART_RING_H
#define RTHYB_PART_RING_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_record.h"

/* cffi: begin */

typedef struct rthyb_ring rthyb_ring;

enum rthyb_ring_size {
    RTHYB_RING_LAYOUT = 3,                                         /* version of the layout below */
    RTHYB_RING_CAPACITY = 65536,                                   /* records of a ring: 64 s */
    RTHYB_ROW_WORDS_MAX = RTHYB_RECORD_WORDS + RTHYB_CHANNELS_MAX, /* a record and its channels */
    RTHYB_RING_AFTER_TRIP = 1024 /* records kept of a TRIP before the ring stands still */
};

/* Bits. */
enum rthyb_ring_phase {
    RTHYB_RING_OPEN = 0,
    RTHYB_RING_FROZEN = 1, /* stands still after a TRIP, until the state is another */
    RTHYB_RING_CLOSED = 2  /* its producer ended in good order */
};

/* What rthyb_ring_attach refuses. */
enum rthyb_ring_refusal {
    RTHYB_RING_FOREIGN = 1, /* no ring at all */
    RTHYB_RING_UNFINISHED,  /* its producer did not get as far as the start */
    RTHYB_RING_OTHER_LAYOUT,
    RTHYB_RING_OTHER_RECORD,
    RTHYB_RING_TRUNCATED, /* shorter than it says */
    RTHYB_RING_DAMAGED    /* sizes that contradict one another */
};

/* What rthyb_ring_settle reached; bits. */
enum rthyb_ring_fact {
    RTHYB_RING_LOCKED = 1,   /* cannot be paged out */
    RTHYB_RING_IN_MEMORY = 2 /* on tmpfs: no write-back ever makes the producer wait */
};

/* One row, a record and its channels, with its stamp: 2 n + 1 while row number n is being written,
 * 2 n + 2 when it is there. 0: never written. In the file a slot ends with the words that its ring has. */
typedef struct {
    uint64_t stamp;
    uint64_t words[RTHYB_ROW_WORDS_MAX];
} rthyb_ring_slot;

/* Beginning of the file. magic to about_bytes have their place in every layout. */
typedef struct {
    uint64_t magic;
    uint32_t layout, record_bytes;  /* of a row: a record and its channels */
    uint64_t about_at, about_bytes; /* JSON: fields, units, versions, process */
    uint64_t slots_at, file_bytes;
    uint32_t capacity, slot_bytes;
    uint64_t spare[1];
    uint64_t pushed;        /* records so far: the next one has this number */
    uint64_t phase;         /* enum rthyb_ring_phase bits */
    uint64_t apart[6];      /* what follows begins a cache line */
    rthyb_ring_slot newest; /* status page: the newest record while the ring is frozen */
} rthyb_ring_header;

/* The producer's own side; one thread at a time. */
struct rthyb_ring {
    rthyb_ring_header *header;
    char *slots;
    uint64_t mask;
    uint64_t pushed, shown; /* records in the ring, records on the status page */
    uint32_t slot_bytes, record_words, channel_count;
    uint32_t tripped; /* records taken since the TRIP */
};

/* One reader of a mapping that may be read-only. Readers do not know of one another, and the
 * producer knows of none. */
typedef struct {
    const rthyb_ring_header *header;
    const char *slots;
    uint64_t capacity, mask;
    uint32_t slot_bytes, row_words;
    uint64_t next; /* number of the record to be read next */
    uint64_t lost; /* records overwritten, or half written, before they were read */
} rthyb_ring_reader;

/* Size of the file for a capacity, a power of two, so many bytes of description, and rows of so many axes and
 * channels, RTHYB_CHANNELS_MAX at most. */
size_t rthyb_ring_bytes(uint32_t capacity, size_t about_bytes, int32_t axis_count,
                        uint32_t channel_count);
/* Where the description begins, bytes from the start of the file. */
size_t rthyb_ring_about_at(void);
/* Locks the mapping and writes all of it once; returns enum rthyb_ring_fact bits. The file must
 * have its blocks already (posix_fallocate). Before the start only. */
int rthyb_ring_settle(int fd, void *map, size_t bytes);
/* Writes the header over a settled mapping of rthyb_ring_bytes() bytes whose description is in its
 * place; from then on readers find a ring. */
void rthyb_ring_init(rthyb_ring *ring, void *map, uint32_t capacity, size_t about_bytes,
                     int32_t axis_count, uint32_t channel_count);
/* Never waits, fails or calls the kernel. RTHYB_RING_AFTER_TRIP records in state TRIPPED are taken,
 * further ones go to the status page alone until the state is another. */
/* channels: as many values as the ring has channels; NULL: not known, they become NaN. */
void rthyb_ring_push(rthyb_ring *ring, const rthyb_record *record, const double *channels);
/* Rows of as many axes as the ring has, one after the other; channels: of each in turn, or NULL. */
void rthyb_ring_push_run(rthyb_ring *ring, const void *rows, size_t n, const double *channels);
void rthyb_ring_close(rthyb_ring *ring);

/* Takes a mapping of a whole file and stands before its oldest record; 0 or enum
 * rthyb_ring_refusal. Nothing outside bytes is read, whatever the file holds. */
int rthyb_ring_attach(rthyb_ring_reader *reader, const void *map, size_t bytes);
/* Up to n rows of record_bytes each without a gap between them, the first with the number
 * next - (returned count). A gap before them shows in lost. 0: nothing new. */
size_t rthyb_ring_read(rthyb_ring_reader *reader, void *rows, size_t n);
/* The newest row, also while the ring is frozen; 0 if there is none. */
int rthyb_ring_newest(const rthyb_ring_reader *reader, void *row);
uint64_t rthyb_ring_pushed(const rthyb_ring_reader *reader);
/* enum rthyb_ring_phase bits. */
int rthyb_ring_phase(const rthyb_ring_reader *reader);
/* cffi: end */

#endif
