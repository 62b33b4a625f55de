/* A recording through a fresh station: its rows are the inputs of a second pass, and what comes out
 * has to be the same rows again. */
#include "internal.h"
#include "numeric.h"

/* The rows of one executed tick: those of the ticks that were skipped before it, then its own. */
static size_t group_size(const rthyb_record *rows, size_t count)
{
    size_t n = 0;
    while (n < count && rows[n].flags & RTHYB_F_BLIND)
        n++;
    return n < count ? n + 1 : 0;
}

static void take_parameters(rthyb_station *station, const rthyb_replay *source, uint32_t generation)
{
    if (generation <= station->controller.generation)
        return;
    for (size_t i = 0; i < source->parameter_count; i++)
        if (source->parameters[i].generation == generation)
            (void)rthyb_station_adopt(station, &source->parameters[i]);
}

/* Why the wire had no pair. */
static int32_t lost(const rthyb_record *row)
{
    if (!(row->flags & RTHYB_F_LOST))
        return 0;
    const int32_t no_number = isnan(row->axis[0].x_read_m) ? RTHYB_S_NOT_FINITE : 0;
    return RTHYB_LOST | no_number | (row->code & RTHYB_S_OUT_OF_RANGE);
}

static rthyb_station_input input_of(const rthyb_station *station, const rthyb_record *row)
{
    const uint64_t skipped = row->tick - station->tick;
    return (rthyb_station_input){
        .axis = {{.x_m = row->axis[0].x_read_m,
                  .f_n = row->axis[0].f_read_n,
                  .x_cmd_m = row->axis[0].x_cmd_m}},
        .lost = lost(row),
        .skipped = skipped < UINT32_MAX ? (uint32_t)skipped : UINT32_MAX,
        .command = (int32_t)(row->flags >> RTHYB_F_COMMAND_BIT),
        .link_down = (row->flags & RTHYB_F_DOWN) != 0,
        .drive_stopped = (row->flags & RTHYB_F_STOPPED) != 0,
        .heartbeat_late = (row->flags & RTHYB_F_SILENT) != 0,
        .beyond = (row->flags & RTHYB_F_BEYOND) != 0,
        .taken_over = (row->flags & RTHYB_F_TAKEN_OVER) != 0,
    };
}

/* As the loop has sent it: rounded by the wire, or not at all. */
static int send_again(rthyb_station *station, const rthyb_replay *source,
                      const rthyb_station_output *out, int was_sent)
{
    rthyb_frame frame;
    double sent_m = 0.0;
    const rthyb_setpoint setpoint = {
        .x_m = command_for_wire(source->codec, &source->calibration, &out->axis[0]),
        .state = (uint32_t)out->told,
    };
    const int code = rthyb_encode_setpoint(source->codec, &setpoint, &frame, &sent_m);
    const int sent = was_sent && !(code & RTHYB_S_NOT_FINITE);
    note_command(station, &source->calibration, sent, sent_m);
    return sent;
}

/* What the link and the clock added to a row. */
static void copy_surroundings(const rthyb_record *from, rthyb_record *to)
{
    to->due_ns = from->due_ns;
    to->wake_late_ns = from->wake_late_ns;
    to->sent_late_ns = from->sent_late_ns;
    to->axis[0].echo = from->axis[0].echo;
    to->axis[0].count = from->axis[0].count;
}

static void complete(const rthyb_record *row, int sent, rthyb_record *made)
{
    made->flags |= row->flags & RTHYB_F_SLIP;
    made->flags &= ~(uint32_t)RTHYB_F_NOT_SENT;
    made->flags |= sent ? 0u : (uint32_t)RTHYB_F_NOT_SENT;
}

/* One group again; returns how many rows it became. */
static size_t replay_group(rthyb_station *station, const rthyb_replay *source,
                           const rthyb_record *rows, size_t n, rthyb_record *made)
{
    rthyb_station_output out;
    const rthyb_record *row = &rows[n - 1];
    take_parameters(station, source, row->generation);
    const rthyb_station_input in = input_of(station, row);
    rthyb_station_tick(station, &in, source->ag_mps2, source->ag_count, made, &out);
    int sent = !(row->flags & RTHYB_F_NOT_SENT) && out.send;
    if (out.send && source->codec)
        sent = send_again(station, source, &out, sent);
    for (size_t i = 0; i < n && i < out.records; i++)
        copy_surroundings(&rows[i], &made[i]);
    if (out.records == n)
        complete(row, sent, &made[n - 1]);
    return out.records;
}

size_t rthyb_station_replay(rthyb_station *station, const rthyb_replay *source, rthyb_record *out)
{
    rthyb_record made[RTHYB_BLIND_MAX + 1] = {{0}};
    size_t done = 0;
    while (done < source->count) {
        const rthyb_record *rows = source->rows + done;
        const size_t n = group_size(rows, source->count - done);
        if (n == 0 || rows[n - 1].tick < station->tick)
            return done;
        const size_t got = replay_group(station, source, rows, n, made);
        for (size_t i = 0; i < n && i < got; i++)
            out[done + i] = made[i];
        if (got != n)
            return done + (n < got ? n : got);
        done += n;
    }
    return done;
}
