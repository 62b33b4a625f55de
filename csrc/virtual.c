/* Tests in virtual time: the station of a real-time test, with the virtual rig called directly. */
#include <string.h>

#include "internal.h"
#include "numeric.h"

enum { MOST = RTHYB_COUPLED_MAX };

static int axes_of(const rthyb_virtual *test)
{
    return test->station->cfg.controller.axis_count;
}

int rthyb_virtual_init(rthyb_virtual *test)
{
    if (!(test->stop_decel_m_per_s2 > 0.0) || test->freedoms < 0 ||
        test->freedoms > RTHYB_DENSE_MAX)
        return RTHYB_E_LIMIT;
    double sensor[RTHYB_SENSORS_ALL];
    if (rthyb_plant_axes(&test->plant) != axes_of(test) ||
        rthyb_plant_sensors(&test->plant, sensor) !=
            rthyb_kinematics_sensors(&test->station->cfg.controller.kinematics))
        return RTHYB_E_PLANT;
    if (test->station->cfg.controller.period_s != rthyb_plant_period_s(&test->plant))
        return RTHYB_E_PERIOD;
    for (int i = 0; i < MOST; i++) {
        test->phase[i] = RTHYB_DRIVE_FOLLOWING;
        test->target_m[i] = test->target1_m[i] = 0.0;
    }
    return 0;
}

/* What the drive of an axis does with the output of the station, for the next tick. */
static void drive(rthyb_virtual *test, int i, const rthyb_station_output *out)
{
    const double now = test->target_m[i];
    double next = now;
    if (test->phase[i] == RTHYB_DRIVE_FOLLOWING && out->state == RTHYB_TRIPPED)
        test->phase[i] = RTHYB_DRIVE_STOPPING;
    if (test->phase[i] == RTHYB_DRIVE_FOLLOWING) {
        next = out->send ? out->axis[i].x_cmd_m : next;
    } else if (test->phase[i] == RTHYB_DRIVE_STOPPING) {
        next = braked_target(now, test->target1_m[i], test->stop_decel_m_per_s2,
                             test->station->cfg.controller.period_s);
        test->phase[i] = next == now ? RTHYB_DRIVE_STOPPED : RTHYB_DRIVE_STOPPING;
    }
    test->target1_m[i] = now;
    test->target_m[i] = next;
}

/* Values for the row of this tick: the numerical part has not made its next step yet. */
static void note_freedoms(rthyb_virtual *test)
{
    const rthyb_numerical part = part_of(&test->station->controller);
    double *to = test->station->channel + (test->truth ? (ptrdiff_t)2 * axes_of(test) : 0);
    (void)rthyb_numerical_report(&part, to, (size_t)test->freedoms);
}

static void note_truth(rthyb_virtual *test)
{
    double x[MOST], f[MOST];
    rthyb_plant_truth(&test->plant, x, f);
    for (int i = 0; i < axes_of(test); i++) {
        test->station->channel[(ptrdiff_t)2 * i] = x[i];
        test->station->channel[(ptrdiff_t)2 * i + 1] = f[i];
    }
}

static rthyb_station_input read_rig(rthyb_virtual *test, int32_t command)
{
    rthyb_station_input in = {.command = command, .taken_over = !test->station->seen};
    double x[MOST], f[MOST];
    (void)rthyb_plant_step(&test->plant, test->target_m, x, f);
    for (int i = 0; i < axes_of(test); i++)
        in.axis[i] = (rthyb_axis_input){
            .x_m = x[i],
            .f_n = f[i],
            .x_cmd_m = test->target_m[i],
            .drive_stopped = test->phase[i] != RTHYB_DRIVE_FOLLOWING,
        };
    (void)rthyb_plant_sensors(&test->plant, in.sensor);
    return in;
}

static void tick(rthyb_virtual *test, int32_t command, rthyb_record *record)
{
    rthyb_station *station = test->station;
    const int32_t before = station->state;
    rthyb_station_output out;
    const rthyb_station_input in = read_rig(test, command);
    if (test->freedoms > 0)
        note_freedoms(test);
    (void)rthyb_station_tick(station, &in, test->ag_mps2, test->ag_count, record, &out);
    rthyb_station_advance(station);
    record->due_ns = llrint((double)record->tick * station->cfg.controller.period_s * 1e9);
    for (int i = 0; i < axes_of(test); i++) {
        note_pair(&record->axis[i], in.axis[i].x_m, in.axis[i].f_n, 0, axes_of(test));
        drive(test, i, &out);
    }
    if (test->truth)
        note_truth(test);
    /* The result of a test must not depend on the duration of zeroing and ramp-in. */
    if (before == RTHYB_RAMP_IN && station->state == RTHYB_RUNNING)
        rthyb_plant_reseed(&test->plant);
}

size_t rthyb_virtual_run(rthyb_virtual *test, int32_t command, size_t count, void *rows,
                         double *channels, uint32_t channel_count)
{
    const rthyb_station *station = test->station;
    const int axes = axes_of(test);
    rthyb_record record;
    size_t done = 0;
    int has_changed = 0;
    while (done < count && !has_changed) {
        const int32_t state = station->state, zeroing = station->zeroing;
        tick(test, done == 0 ? command : RTHYB_CMD_NONE, &record);
        memcpy(row_at(rows, axes, done), &record, record_bytes(axes));
        if (channel_count > 0)
            memcpy(channels + done * channel_count, station->channel,
                   channel_count * sizeof *channels);
        has_changed = station->state != state || (station->zeroing > 1 && zeroing <= 1);
        done++;
    }
    return done;
}
