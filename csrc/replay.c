/* Replays a recording with a new station: the rows are the inputs of a second pass, and its output
 * must be the same rows. */
#include <string.h>

#include "internal.h"
#include "numeric.h"

/* A tick gives no more rows than this; a longer group was not written by a station. */
enum { GROUP_MAX = RTHYB_BLIND_MAX + 2 };

static int axes_of(const rthyb_station *station)
{
    return station->cfg.controller.axis_count;
}

static int sensors_of(const rthyb_station *station)
{
    return rthyb_kinematics_sensors(&station->cfg.controller.kinematics);
}

/* The rows of one executed tick: first those of the ticks that were skipped before it, then its
 * own. Reads at most one row more than a tick can give. */
static size_t group_of(const rthyb_replay *source, int axes, size_t from, rthyb_record *group)
{
    size_t n = 0;
    while (from + n < source->count && n < GROUP_MAX) {
        memcpy(&group[n], (const char *)source->rows + (from + n) * record_bytes(axes),
               record_bytes(axes));
        if (!(group[n++].flags & RTHYB_F_BLIND))
            return n;
    }
    return 0;
}

static void take_parameters(rthyb_station *station, const rthyb_replay *source, uint32_t generation)
{
    if (generation <= station->controller.generation)
        return;
    for (size_t i = 0; i < source->parameter_count; i++)
        if (source->parameters[i].generation == generation)
            (void)rthyb_station_adopt(station, &source->parameters[i]);
}

/* Why the wire of an axis had no pair. With several axes, it had none if the row contains neither
 * of its readings. */
static int32_t lost(const rthyb_record *row, int axis, int axes)
{
    const rthyb_axis_record *a = &row->axis[axis];
    if (!(row->flags & RTHYB_F_LOST))
        return 0;
    if (axes > 1 && !(isnan(a->x_read_m) && (isnan(a->f_read_n) || a->f_read_n == 0.0)))
        return 0;
    const int32_t no_number = isnan(axes > 1 ? a->f_read_n : a->x_read_m) ? RTHYB_S_NOT_FINITE : 0;
    return RTHYB_LOST | no_number | (row->code & RTHYB_S_OUT_OF_RANGE);
}

/* What a row says of all axes together is taken from the axis that its cause names, or from the
 * first. */
static int axis_of_row(const rthyb_record *row)
{
    const int number = (int)(row->cause >> RTHYB_PLACE_BIT & 7u);
    return row->cause & RTHYB_PLACE_INTERFACE || number == 0 ? 0 : number - 1;
}

/* `sensors`: as read in this row, of the sensors without an actuator. */
static rthyb_station_input input_of(const rthyb_station *station, const rthyb_record *row,
                                    const double *sensors)
{
    const uint64_t skipped = row->tick - station->tick;
    const int axes = axes_of(station), one = axis_of_row(row) % axes;
    rthyb_station_input in = {
        .skipped = skipped < UINT32_MAX ? (uint32_t)skipped : UINT32_MAX,
        .command = (int32_t)(row->flags >> RTHYB_F_COMMAND_BIT),
        .heartbeat_late = (row->flags & RTHYB_F_SILENT) != 0,
        .taken_over = (row->flags & RTHYB_F_TAKEN_OVER) != 0,
        .apart = axes > 1 ? (int32_t)(row->cause >> RTHYB_APART_BIT & 7u) : 0,
    };
    for (int i = 0; i < axes; i++)
        in.axis[i] = (rthyb_axis_input){
            .x_m = row->axis[i].x_read_m,
            .f_n = row->axis[i].f_read_n,
            .x_cmd_m = row->axis[i].x_cmd_m,
            .lost = lost(row, i, axes),
            .link_down = axes > 1 && (row->cause >> (RTHYB_DOWN_BIT + i) & 1u),
            .drive_stopped = axes > 1 && (row->flags >> (RTHYB_F_STOPPED_BIT + i) & 1u),
        };
    if (axes == 1) {
        in.axis[0].link_down = (row->flags & RTHYB_F_DOWN) != 0;
        in.axis[0].drive_stopped = (row->flags & RTHYB_F_STOPPED) != 0;
    }
    for (int k = 0; k < sensors_of(station); k++) {
        in.sensor[k] = sensors[k];
        in.sensors_lost |= (row->cause >> (RTHYB_SILENT_BIT + k) & 1u) << k;
    }
    in.axis[one].beyond = (row->flags & RTHYB_F_BEYOND) != 0;
    return in;
}

/* Whether the command of this axis was sent. */
static int left(const rthyb_record *row, int axis, int axes)
{
    const uint32_t of_axis = (uint32_t)1 << (RTHYB_F_UNSENT_BIT + axis);
    return !(row->flags & (axes > 1 ? of_axis : (uint32_t)RTHYB_F_NOT_SENT));
}

/* As in the loop: rounded by the wire, or not sent. */
static int send_again(rthyb_station *station, const rthyb_replay *source,
                      const rthyb_station_output *out, int axis, int was_sent)
{
    rthyb_frame frame;
    double sent_m = 0.0;
    const rthyb_replay_axis *at = &source->axis[axis];
    const rthyb_setpoint setpoint = {
        .x_m = command_for_wire(at->codec, &at->calibration, &out->axis[axis]),
        .state = (uint32_t)out->sent_state,
    };
    const int code = rthyb_encode_setpoint(at->codec, &setpoint, &frame, &sent_m);
    const int sent = was_sent && !(code & RTHYB_S_NOT_FINITE);
    note_command(station, axis, &at->calibration, sent, sent_m);
    return sent;
}

/* What link and clock have added to a row. */
static void copy_surroundings(const rthyb_record *from, int axes, rthyb_record *to)
{
    to->due_ns = from->due_ns;
    to->wake_late_ns = from->wake_late_ns;
    to->sent_late_ns = from->sent_late_ns;
    for (int i = 0; i < axes; i++) {
        to->axis[i].echo = from->axis[i].echo;
        to->axis[i].count = from->axis[i].count;
    }
}

static void complete(const rthyb_record *row, uint32_t unsent, rthyb_record *made)
{
    made->flags |= row->flags & RTHYB_F_SLIP;
    made->flags = (made->flags & ~UNSENT_FLAGS) | unsent;
}

/* Replays one group, which begins at row `first`; returns the number of rows that it gave. */
static size_t replay_group(rthyb_station *station, const rthyb_replay *source, size_t first,
                           const rthyb_record *rows, size_t n, rthyb_record *made)
{
    rthyb_station_output out;
    const rthyb_record *row = &rows[n - 1];
    const int axes = axes_of(station);
    uint32_t unsent = 0;
    take_parameters(station, source, row->generation);
    const size_t count = (size_t)sensors_of(station);
    static const double none[RTHYB_SENSORS_ALL] = {0.0};
    const double *sensors = source->sensors ? source->sensors + (first + n - 1) * count : none;
    const rthyb_station_input in = input_of(station, row, sensors);
    rthyb_station_tick(station, &in, source->ag_mps2, source->ag_count, made, &out);
    for (int i = 0; i < axes; i++) {
        int sent = left(row, i, axes) && out.send;
        if (out.send && source->axis[i].codec)
            sent = send_again(station, source, &out, i, sent);
        unsent |= sent ? 0u : unsent_flag(i, axes);
    }
    for (size_t i = 0; i < n && i < out.records; i++)
        copy_surroundings(&rows[i], axes, &made[i]);
    if (out.records == n)
        complete(row, unsent, &made[n - 1]);
    return out.records;
}

size_t rthyb_station_replay(rthyb_station *station, const rthyb_replay *source, void *out)
{
    rthyb_record rows[GROUP_MAX], made[RTHYB_BLIND_MAX + 1] = {{0}};
    const int axes = axes_of(station);
    size_t done = 0;
    while (done < source->count) {
        const size_t n = group_of(source, axes, done, rows);
        if (n == 0 || rows[n - 1].tick < station->tick)
            return done;
        const size_t got = replay_group(station, source, done, rows, n, made);
        for (size_t i = 0; i < n && i < got; i++)
            memcpy(row_at(out, axes, done + i), &made[i], record_bytes(axes));
        if (got != n)
            return done + (n < got ? n : got);
        done += n;
    }
    return done;
}
