/* Telemetry ring in a mapped file: one producer that never waits, any number of readers.
 *
 * Every slot is a seqlock. The producer makes the stamp odd, stores the words, and makes the stamp
 * even; a reader copies the words between two reads of the stamp. Words are stored with release and
 * loaded with acquire, so a reader that has seen a word of a newer record also sees, at its second
 * read, that record's odd stamp or a later one, and discards the copy. This is all the ordering
 * that is needed, without a fence; on x86-64 it costs no more than plain moves.
 *
 * Only the stamps say what a slot contains; the count in the header only says where to look. A
 * producer that is killed between any two instructions leaves at most one slot with an odd
 * stamp. */
#include <math.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/vfs.h>

#include "internal.h"

#define MAGIC UINT64_C(0x676e726279687472) /* "rthybrng" in little-endian order */
#define PAGE 4096u
#define TMPFS 0x01021994
#define CAPACITY_MAX (1u << 24)
#define NEWEST_TRIES 1000 /* a killed producer may have left the status page incomplete */
#define LEAP_ROOM 64      /* a lapped reader continues 1/64 of the ring after the oldest record */

_Static_assert(sizeof(rthyb_record) == RTHYB_RECORD_WORDS * sizeof(uint64_t),
               "RTHYB_RECORD_WORDS is not the record's");
_Static_assert(sizeof(rthyb_ring_header) <= PAGE, "the header is one page");
_Static_assert(offsetof(rthyb_ring_header, pushed) == 64, "the fixed fields are one cache line");
_Static_assert(__atomic_always_lock_free(sizeof(uint64_t), 0),
               "a read-only map cannot hold a lock");

/* ---- the file --------------------------------------------------------------------------------- */

size_t rthyb_ring_about_at(void)
{
    return PAGE;
}

static size_t slots_at(size_t about_bytes)
{
    return PAGE + (about_bytes + PAGE - 1) / PAGE * PAGE;
}

static uint32_t row_bytes(int32_t axis_count, uint32_t channel_count)
{
    return (uint32_t)record_bytes(axis_count) + channel_count * (uint32_t)sizeof(double);
}

static uint32_t slot_bytes(uint32_t row)
{
    return (uint32_t)offsetof(rthyb_ring_slot, words) + row;
}

static size_t file_bytes(uint32_t capacity, size_t about_bytes, uint32_t row)
{
    return slots_at(about_bytes) + (size_t)capacity * slot_bytes(row);
}

size_t rthyb_ring_bytes(uint32_t capacity, size_t about_bytes, int32_t axis_count,
                        uint32_t channel_count)
{
    return file_bytes(capacity, about_bytes, row_bytes(axis_count, channel_count));
}

int rthyb_ring_settle(int fd, void *map, size_t bytes)
{
    struct statfs system;
    const int locked = mlock(map, bytes) == 0;
    const int in_memory = fstatfs(fd, &system) == 0 && system.f_type == TMPFS;
    memset(map, 0, bytes);
    return (locked ? RTHYB_RING_LOCKED : 0) | (in_memory ? RTHYB_RING_IN_MEMORY : 0);
}

void rthyb_ring_init(rthyb_ring *ring, void *map, uint32_t capacity, size_t about_bytes,
                     int32_t axis_count, uint32_t channel_count)
{
    rthyb_ring_header *header = map;
    const uint32_t row = row_bytes(axis_count, channel_count);
    header->layout = RTHYB_RING_LAYOUT;
    header->about_at = PAGE;
    header->about_bytes = about_bytes;
    header->slots_at = slots_at(about_bytes);
    header->file_bytes = file_bytes(capacity, about_bytes, row);
    header->capacity = capacity;
    header->slot_bytes = slot_bytes(row);
    header->record_bytes = row;
    *ring = (rthyb_ring){
        .header = header,
        .slots = (char *)map + header->slots_at,
        .mask = capacity - 1,
        .slot_bytes = header->slot_bytes,
        .record_words = (uint32_t)(record_bytes(axis_count) / sizeof(uint64_t)),
        .channel_count = channel_count,
    };
    /* Last, so that an incomplete header is never taken for a ring. */
    __atomic_store_n(&header->magic, MAGIC, __ATOMIC_RELEASE);
}

/* ---- producer --------------------------------------------------------------------------------- */

static void store(const rthyb_ring *ring, rthyb_ring_slot *slot, uint64_t number,
                  const rthyb_record *record, const double *channels)
{
    const char *bytes = (const char *)record;
    __atomic_store_n(&slot->stamp, 2 * number + 1, __ATOMIC_RELAXED);
    for (size_t i = 0; i < ring->record_words; i++) {
        uint64_t word;
        memcpy(&word, bytes + i * sizeof word, sizeof word);
        __atomic_store_n(&slot->words[i], word, __ATOMIC_RELEASE);
    }
    for (uint32_t i = 0; i < ring->channel_count; i++) {
        const double value = channels ? channels[i] : (double)NAN;
        uint64_t word;
        memcpy(&word, &value, sizeof word);
        __atomic_store_n(&slot->words[ring->record_words + i], word, __ATOMIC_RELEASE);
    }
    __atomic_store_n(&slot->stamp, 2 * number + 2, __ATOMIC_RELEASE);
}

static void set_phase(rthyb_ring *ring, uint64_t phase)
{
    __atomic_store_n(&ring->header->phase, phase, __ATOMIC_RELEASE);
}

static void append(rthyb_ring *ring, const rthyb_record *record, const double *channels)
{
    void *slot = ring->slots + (ring->pushed & ring->mask) * ring->slot_bytes;
    store(ring, slot, ring->pushed, record, channels);
    ring->pushed++;
    __atomic_store_n(&ring->header->pushed, ring->pushed, __ATOMIC_RELEASE);
}

static void show(rthyb_ring *ring, const rthyb_record *record, const double *channels)
{
    store(ring, &ring->header->newest, ring->shown++, record, channels);
}

/* The black box: what led to a trip, and one second of what followed. */
static void push_tripped(rthyb_ring *ring, const rthyb_record *record, const double *channels)
{
    if (ring->tripped == RTHYB_RING_AFTER_TRIP) {
        show(ring, record, channels);
        return;
    }
    append(ring, record, channels);
    if (++ring->tripped < RTHYB_RING_AFTER_TRIP)
        return;
    /* Page before phase, here, and record before phase, below: what a reader finds never becomes
     * older. */
    show(ring, record, channels);
    set_phase(ring, RTHYB_RING_FROZEN);
}

static void forget_trip(rthyb_ring *ring)
{
    ring->tripped = 0;
    set_phase(ring, RTHYB_RING_OPEN);
}

void rthyb_ring_push(rthyb_ring *ring, const rthyb_record *record, const double *channels)
{
    if (record->state == RTHYB_TRIPPED) {
        push_tripped(ring, record, channels);
        return;
    }
    append(ring, record, channels);
    if (ring->tripped)
        forget_trip(ring);
}

void rthyb_ring_push_run(rthyb_ring *ring, const void *rows, size_t n, const double *channels)
{
    const char *row = rows;
    for (size_t i = 0; i < n; i++, row += ring->record_words * sizeof(uint64_t))
        rthyb_ring_push(ring, (const rthyb_record *)(const void *)row,
                        channels ? channels + i * ring->channel_count : NULL);
}

void rthyb_ring_close(rthyb_ring *ring)
{
    set_phase(ring, ring->header->phase | RTHYB_RING_CLOSED);
}

/* ---- reader ----------------------------------------------------------------------------------- */

/* A row of one or several axes, with or without channels; the description in the file says
 * which. */
static int is_row(uint32_t bytes)
{
    return bytes >= row_bytes(1, 0) && bytes <= row_bytes(RTHYB_COUPLED_MAX, RTHYB_CHANNELS_MAX) &&
           bytes % sizeof(uint64_t) == 0;
}

static int sizes_agree(const rthyb_ring_header *h)
{
    const int capacity_ok =
        h->capacity > 0 && h->capacity <= CAPACITY_MAX && (h->capacity & (h->capacity - 1)) == 0;
    const int about_ok = h->about_at == PAGE && h->about_bytes <= CAPACITY_MAX;
    return capacity_ok && about_ok && h->slots_at == slots_at(h->about_bytes) &&
           h->file_bytes == file_bytes(h->capacity, h->about_bytes, h->record_bytes);
}

static int refusal(const rthyb_ring_header *h, size_t bytes)
{
    if (bytes < sizeof *h)
        return RTHYB_RING_FOREIGN;
    const uint64_t magic = __atomic_load_n(&h->magic, __ATOMIC_ACQUIRE);
    if (magic != MAGIC)
        return magic == 0 ? RTHYB_RING_UNFINISHED : RTHYB_RING_FOREIGN;
    if (h->layout != RTHYB_RING_LAYOUT)
        return RTHYB_RING_OTHER_LAYOUT;
    if (!is_row(h->record_bytes) || h->slot_bytes != slot_bytes(h->record_bytes))
        return RTHYB_RING_OTHER_RECORD;
    if (!sizes_agree(h))
        return RTHYB_RING_DAMAGED;
    return bytes < h->file_bytes ? RTHYB_RING_TRUNCATED : 0;
}

uint64_t rthyb_ring_pushed(const rthyb_ring_reader *reader)
{
    return __atomic_load_n(&reader->header->pushed, __ATOMIC_ACQUIRE);
}

static uint64_t oldest(const rthyb_ring_reader *reader)
{
    const uint64_t pushed = rthyb_ring_pushed(reader);
    return pushed > reader->capacity ? pushed - reader->capacity : 0;
}

int rthyb_ring_attach(rthyb_ring_reader *reader, const void *map, size_t bytes)
{
    const rthyb_ring_header *header = map;
    const int refused = refusal(header, bytes);
    if (refused)
        return refused;
    *reader = (rthyb_ring_reader){
        .header = header,
        .slots = (const char *)map + header->slots_at,
        .capacity = header->capacity,
        .mask = header->capacity - 1,
        .slot_bytes = header->slot_bytes,
        .row_words = header->record_bytes / (uint32_t)sizeof(uint64_t),
    };
    reader->next = oldest(reader);
    return 0;
}

/* Copies the words; returns 0, with an invalid row, if the stamp of the slot has changed
 * meanwhile. */
static int copy(const rthyb_ring_reader *reader, const rthyb_ring_slot *slot, uint64_t stamp,
                char *bytes)
{
    for (size_t i = 0; i < reader->row_words; i++) {
        const uint64_t word = __atomic_load_n(&slot->words[i], __ATOMIC_ACQUIRE);
        memcpy(bytes + i * sizeof word, &word, sizeof word);
    }
    return __atomic_load_n(&slot->stamp, __ATOMIC_RELAXED) == stamp;
}

enum found { HERE, NOT_YET, GONE };

static const rthyb_ring_slot *slot_of(const rthyb_ring_reader *reader, uint64_t number)
{
    return (const void *)(reader->slots + (number & reader->mask) * reader->slot_bytes);
}

static enum found look(const rthyb_ring_reader *reader, char *row)
{
    const rthyb_ring_slot *slot = slot_of(reader, reader->next);
    const uint64_t wanted = 2 * reader->next + 2;
    const uint64_t stamp = __atomic_load_n(&slot->stamp, __ATOMIC_ACQUIRE);
    if (stamp < wanted)
        return NOT_YET;
    return stamp == wanted && copy(reader, slot, stamp, row) ? HERE : GONE;
}

/* Skips one half-written record; a lapped reader continues where it is not lapped again at once. */
static void leap(rthyb_ring_reader *reader)
{
    const uint64_t first = oldest(reader);
    const uint64_t to =
        first > reader->next ? first + reader->capacity / LEAP_ROOM : reader->next + 1;
    reader->lost += to - reader->next;
    reader->next = to;
}

size_t rthyb_ring_read(rthyb_ring_reader *reader, void *rows, size_t n)
{
    const size_t pitch = reader->row_words * sizeof(uint64_t);
    char *row = rows;
    if (n == 0)
        return 0;
    enum found found = look(reader, row);
    while (found == GONE && reader->next <= rthyb_ring_pushed(reader)) {
        leap(reader);
        found = look(reader, row);
    }
    size_t count = 0;
    while (found == HERE) {
        reader->next++;
        if (++count == n)
            break;
        row += pitch;
        found = look(reader, row);
    }
    return count;
}

int rthyb_ring_phase(const rthyb_ring_reader *reader)
{
    return (int)(__atomic_load_n(&reader->header->phase, __ATOMIC_ACQUIRE) &
                 (RTHYB_RING_FROZEN | RTHYB_RING_CLOSED));
}

int rthyb_ring_newest(const rthyb_ring_reader *reader, void *row)
{
    for (int i = 0; i < NEWEST_TRIES; i++) {
        const int frozen = rthyb_ring_phase(reader) & RTHYB_RING_FROZEN;
        const uint64_t last = rthyb_ring_pushed(reader) - 1;
        const rthyb_ring_slot *slot = frozen ? &reader->header->newest : slot_of(reader, last);
        const uint64_t stamp = __atomic_load_n(&slot->stamp, __ATOMIC_ACQUIRE);
        if (stamp == 0)
            return 0;
        /* A slot that was overwritten meanwhile may be newer than the count, and a phase that has
         * changed meanwhile newer than the page: the next call would then find something older. */
        const int counted = frozen ? stamp % 2 == 0 : stamp == 2 * last + 2;
        if (counted && copy(reader, slot, stamp, row) &&
            (rthyb_ring_phase(reader) & RTHYB_RING_FROZEN) == frozen)
            return 1;
    }
    return 0;
}
