/* The other end of the wire: an actuator controller with load cell and watchdog, and everything
 * that can go wrong with them and with the cable. */

#include "internal.h"
#include "numeric.h"

#define SEQ_BITS 16         /* of the program's own frames */
#define DRIFT_MAX_PPM 199.0 /* limit of a ticker's trim */
#define TWO_TO_53 9007199254740992.0

/* ---- faults ----------------------------------------------------------------------------------- */

/* splitmix64: the same seed gives the same faults */
static uint64_t random_bits(rthyb_drive *d)
{
    d->random += 0x9e3779b97f4a7c15u;
    uint64_t z = d->random;
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
    return z ^ (z >> 31);
}

static int happens(rthyb_drive *d, double probability)
{
    return (double)(random_bits(d) >> 11) / TWO_TO_53 < probability;
}

/* The fault of this kind that is active in this tick; NULL if there is none. */
static const rthyb_fault *fault(const rthyb_drive *d, int kind)
{
    for (size_t i = 0; i < d->fault_count; i++) {
        const rthyb_fault *f = &d->faults[i];
        if (f->kind == kind && d->tick >= f->first && d->tick - f->first < f->ticks)
            return f;
    }
    return NULL;
}

static double fault_value(const rthyb_drive *d, int kind)
{
    const rthyb_fault *f = fault(d, kind);
    return f ? f->value : 0.0;
}

static int is_lost(rthyb_drive *d, int kind)
{
    return fault(d, RTHYB_FAULT_SILENCE) || (fault(d, kind) && happens(d, fault_value(d, kind)));
}

static int fault_ok(const rthyb_fault *f)
{
    const double most = f->kind == RTHYB_FAULT_DELAY ? RTHYB_DRIVE_HELD_MAX - 1 : HUGE_VAL;
    return f->kind >= 0 && f->kind < RTHYB_FAULTS && f->value <= most;
}

int rthyb_drive_schedule(rthyb_drive *drive, const rthyb_fault *faults, size_t n)
{
    for (size_t i = 0; i < n; i++)
        if (!fault_ok(&faults[i]))
            return RTHYB_E_LIMIT;
    drive->faults = faults;
    drive->fault_count = n;
    return 0;
}

int rthyb_drive_init(rthyb_drive *drive)
{
    int error = rthyb_codec_check(&drive->codec);
    if (!error)
        error = rthyb_calibration_check(&drive->calibration);
    if (error)
        return error;
    if (rthyb_plant_axes(&drive->plant) == 0)
        return RTHYB_E_PLANT;
    if (!(drive->stop_decel_m_per_s2 > 0.0) || !(fabs(drive->drift_ppm) <= DRIFT_MAX_PPM))
        return RTHYB_E_LIMIT;
    const int table = drive->codec.format == RTHYB_WIRE_TABLE;
    const int32_t bits = table ? drive->codec.command.field[RTHYB_FIELD_SEQ].length : SEQ_BITS;
    *drive = (rthyb_drive){
        .plant = drive->plant,
        .link = drive->link,
        .codec = drive->codec,
        .calibration = drive->calibration,
        .origin_m = drive->origin_m,
        .stop_decel_m_per_s2 = drive->stop_decel_m_per_s2,
        .log = drive->log,
        .log_size = drive->log_size,
        .seed = drive->seed,
        .drift_ppm = drive->drift_ppm,
        .watchdog = standard_ticks(RTHYB_DRIVE_WATCHDOG, rthyb_plant_period_s(&drive->plant)),
        .random = drive->seed,
        .seq_mask = bits >= 32 ? UINT32_MAX : (1u << bits) - 1u,
        .target_m = drive->origin_m,
        .target1_m = drive->origin_m,
        .wanted_m = drive->origin_m,
    };
    return 0;
}

/* ---- commands --------------------------------------------------------------------------------- */

/* Newer than the last command. To a stopped drive, any other number is new, because the controller
 * may have been restarted. */
static int is_fresh(const rthyb_drive *d, uint32_t seq)
{
    const uint32_t steps = (seq - d->seq) & d->seq_mask;
    return steps != 0 && (d->phase == RTHYB_DRIVE_STOPPED || steps <= d->seq_mask / 2);
}

/* After a drive has stopped on its own, only its operator lets it follow again; a controller that
 * was restarted, perhaps after a crash, does not. */
static int is_released(const rthyb_drive *d)
{
    return d->state == RTHYB_NOTICE_RESET || (d->state == RTHYB_IDLE && !d->latched);
}

static void take_setpoint(rthyb_drive *d, const rthyb_setpoint *setpoint)
{
    if (!is_fresh(d, setpoint->seq))
        return;
    d->seq = setpoint->seq;
    d->state = setpoint->state;
    d->wanted_m = command_from_wire(&d->calibration, setpoint->x_m);
    d->silent = 0;
    if (d->phase != RTHYB_DRIVE_STOPPED || !is_released(d))
        return;
    d->phase = RTHYB_DRIVE_FOLLOWING;
    d->latched = 0;
}

static void take_command(rthyb_drive *d, const rthyb_frame *frame)
{
    rthyb_setpoint setpoint;
    d->now.frames++;
    if (rthyb_decode_setpoint(&d->codec, frame, &setpoint)) {
        d->now.refused++;
        return;
    }
    d->now.x_m = setpoint.x_m;
    d->now.seq = setpoint.seq;
    d->now.state = setpoint.state;
    take_setpoint(d, &setpoint);
}

static void take_bytes(rthyb_drive *d, const rthyb_frame *bytes, int lost)
{
    rthyb_frame packet;
    for (int32_t i = 0; i < bytes->length; i++) {
        const int verdict = rthyb_deframer_byte(&d->deframer, bytes->data[i], &packet);
        if (lost || !verdict)
            continue;
        if (verdict == RTHYB_W_PACKET) {
            take_command(d, &packet);
        } else {
            d->now.frames++;
            d->now.refused++;
        }
    }
}

static void take_commands(rthyb_drive *d)
{
    rthyb_frame frame;
    const int lost = is_lost(d, RTHYB_FAULT_DROP_COMMAND);
    d->now.frames = d->now.refused = 0;
    d->silent++;
    for (int i = 0; i < RTHYB_LINK_PIECES_MAX && rthyb_link_receive(d->link, &frame); i++) {
        if (d->codec.format == RTHYB_WIRE_SERIAL)
            take_bytes(d, &frame, lost);
        else if (!lost)
            take_command(d, &frame);
    }
}

/* ---- motion ----------------------------------------------------------------------------------- */

static void watch(rthyb_drive *d)
{
    const int commanded = d->state == RTHYB_TRIPPED;
    if (d->phase != RTHYB_DRIVE_FOLLOWING || (!commanded && d->silent < d->watchdog))
        return;
    d->phase = RTHYB_DRIVE_STOPPING;
    d->latched = d->state != RTHYB_NOTICE_LEAVING;
}

/* One tick of braking, from the velocity of the last two targets. */
static double brake(rthyb_drive *d)
{
    const double next = braked_target(d->target_m, d->target1_m, d->stop_decel_m_per_s2,
                                      rthyb_plant_period_s(&d->plant));
    if (next == d->target_m)
        d->phase = RTHYB_DRIVE_STOPPED;
    return next;
}

static void move(rthyb_drive *d)
{
    double target = d->target_m;
    if (d->phase == RTHYB_DRIVE_FOLLOWING)
        target = d->wanted_m;
    else if (d->phase == RTHYB_DRIVE_STOPPING)
        target = brake(d);
    d->target1_m = d->target_m;
    d->target_m = target;
}

/* ---- feedback --------------------------------------------------------------------------------- */

static double stuck(rthyb_drive *d, double x_m)
{
    const int in_force = fault(d, RTHYB_FAULT_STUCK) != NULL;
    if (!in_force || !d->stuck)
        d->stuck_m = x_m;
    d->stuck = in_force;
    return d->stuck_m;
}

/* Displacement and force as read by sensors that are mounted according to the calibration. */
static void to_wire(const rthyb_calibration *c, rthyb_reading *r)
{
    r->x_m = (r->x_m - c->x_offset_m) / c->x_gain;
    r->f_n = (r->f_n - c->f_offset_n) / c->f_gain;
}

/* Readings of the axis' sensors, as reported by the drive. */
static rthyb_reading measure(rthyb_drive *d, int32_t axis, double x_m, double f_n)
{
    rthyb_reading r = {.has = RTHYB_HAS_X | RTHYB_HAS_F, .echo = d->seq};
    r.x_m = stuck(d, x_m + d->origin_m) + fault_value(d, RTHYB_FAULT_JUMP);
    r.f_n = f_n + fault_value(d, RTHYB_FAULT_FORCE);
    to_wire(&d->calibration, &r);
    if (fault(d, RTHYB_FAULT_NOT_FINITE))
        r.x_m = (double)NAN;
    r.count = (uint32_t)d->tick;
    r.status = d->phase == RTHYB_DRIVE_FOLLOWING ? 0u : RTHYB_DEVICE_STOPPED;
    rthyb_plant_extra(&d->plant, axis, r.extra);
    return r;
}

static void damage(rthyb_drive *d, rthyb_frame *frame)
{
    if (!fault(d, RTHYB_FAULT_CORRUPT) || frame->length < 1)
        return;
    const uint64_t bit = random_bits(d) % (8u * (uint64_t)frame->length);
    frame->data[bit / 8] ^= (uint8_t)(1u << (bit % 8));
}

static rthyb_held *free_place(rthyb_drive *d)
{
    for (int i = 0; i < RTHYB_DRIVE_HELD_MAX; i++)
        if (d->held[i].count == 0)
            return &d->held[i];
    return NULL;
}

static void enqueue(rthyb_drive *d, const rthyb_reading *reading)
{
    rthyb_held *place = free_place(d);
    if (!place || is_lost(d, RTHYB_FAULT_DROP))
        return;
    const rthyb_fault *swap = fault(d, RTHYB_FAULT_REORDER);
    place->after = swap && (d->tick - swap->first) % 2 == 0;
    place->due = d->tick + (uint64_t)fault_value(d, RTHYB_FAULT_DELAY) + (uint64_t)place->after;
    place->count = rthyb_encode_feedback(&d->codec, reading, place->frames);
    for (int i = 0; i < place->count; i++)
        damage(d, &place->frames[i]);
    if (place->count == 2 && is_lost(d, RTHYB_FAULT_DROP_FORCE))
        place->count = 1;
}

static void send_held(rthyb_drive *d, rthyb_held *h)
{
    const int times = fault(d, RTHYB_FAULT_DUPLICATE) ? 2 : 1;
    for (int i = 0; i < h->count; i++)
        for (int j = 0; j < times; j++)
            (void)rthyb_link_send(d->link, &h->frames[i]);
    h->count = 0;
}

/* Sends what is due, in the order of due times; swapped frames after the others of their tick. */
static void send_due(rthyb_drive *d)
{
    for (;;) {
        rthyb_held *first = NULL;
        for (int i = 0; i < RTHYB_DRIVE_HELD_MAX; i++) {
            rthyb_held *h = &d->held[i];
            if (h->count == 0 || h->due > d->tick)
                continue;
            if (!first || 2 * h->due + (uint64_t)h->after < 2 * first->due + (uint64_t)first->after)
                first = h;
        }
        if (!first)
            return;
        send_held(d, first);
    }
}

/* ---- one sample ------------------------------------------------------------------------------- */

static void note(rthyb_drive *d, const rthyb_reading *reading)
{
    d->now.target_m = d->target_m;
    d->now.read_x_m = reading->x_m;
    d->now.read_f_n = reading->f_n;
    d->now.phase = (uint32_t)d->phase;
    d->now.silent = d->silent;
    if (d->tick < d->log_size)
        d->log[d->tick] = d->now;
}

static void listen(rthyb_drive *d)
{
    take_commands(d);
    watch(d);
    move(d);
}

static void reply(rthyb_drive *d, int32_t axis, double x_m, double f_n)
{
    const rthyb_reading reading = measure(d, axis, x_m, f_n);
    enqueue(d, &reading);
    send_due(d);
    note(d, &reading);
    d->tick++;
}

/* All commands are received before the rig moves, and it moves only once. */
static void tick_all(rthyb_drive *const *drives, int count)
{
    double target[RTHYB_COUPLED_MAX] = {0.0}, x[RTHYB_COUPLED_MAX], f[RTHYB_COUPLED_MAX];
    for (int i = 0; i < count; i++) {
        listen(drives[i]);
        target[i] = drives[i]->target_m - drives[i]->origin_m;
    }
    (void)rthyb_plant_step(&drives[0]->plant, target, x, f);
    for (int i = 0; i < count; i++)
        reply(drives[i], i, x[i], f[i]);
}

void rthyb_drive_tick(rthyb_drive *drive)
{
    tick_all(&drive, 1);
}

int rthyb_drives_check(const rthyb_drives *drives)
{
    int good = drives->count >= 1 && drives->count <= RTHYB_COUPLED_MAX;
    for (int i = 0; good && i < drives->count; i++)
        good = drives->drive[i]->plant.state == drives->drive[0]->plant.state;
    return good && rthyb_plant_axes(&drives->drive[0]->plant) == drives->count ? 0 : RTHYB_E_PLANT;
}

void rthyb_drives_tick(rthyb_drives *drives)
{
    tick_all(drives->drive, drives->count);
}

/* Trims by the whole nanoseconds that the drive's clock gains in a tick; the remainder is carried
 * over. */
static void drift(rthyb_drive *d, rthyb_ticker *ticker)
{
    d->gained_ns += d->drift_ppm * rthyb_plant_period_s(&d->plant) * 1e3;
    const double whole = trunc(d->gained_ns);
    rthyb_ticker_trim(ticker, -(int64_t)whole);
    d->gained_ns -= whole;
}

void rthyb_drive_run(rthyb_drive *drive, rthyb_ticker *ticker)
{
    rthyb_tick tick;
    while (rthyb_ticker_wait(ticker, &tick)) {
        rthyb_drive_tick(drive);
        drift(drive, ticker);
    }
}

void rthyb_drives_run(rthyb_drives *drives, rthyb_ticker *ticker)
{
    rthyb_tick tick;
    while (rthyb_ticker_wait(ticker, &tick)) {
        rthyb_drives_tick(drives);
        drift(drives->drive[0], ticker);
    }
}
