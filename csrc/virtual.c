/* Tests in virtual time: the station of a test in real time, with the virtual rig called directly. */
#include <string.h>

#include "internal.h"
#include "numeric.h"

int rthyb_virtual_init(rthyb_virtual *test)
{
    if (!(test->stop_decel_m_per_s2 > 0.0) || test->freedoms < 0 ||
        test->freedoms > RTHYB_DENSE_MAX)
        return RTHYB_E_LIMIT;
    if (test->station->cfg.controller.period_s != test->rig->cfg.servo.period_s)
        return RTHYB_E_PERIOD;
    test->phase = RTHYB_DRIVE_FOLLOWING;
    test->target_m = test->target1_m = 0.0;
    return 0;
}

/* What the drive makes of what the station sent, for the next tick. */
static void drive(rthyb_virtual *test, const rthyb_station_output *out)
{
    double next = test->target_m;
    if (test->phase == RTHYB_DRIVE_FOLLOWING && out->state == RTHYB_TRIPPED)
        test->phase = RTHYB_DRIVE_STOPPING;
    if (test->phase == RTHYB_DRIVE_FOLLOWING) {
        next = out->send ? out->axis[0].x_cmd_m : next;
    } else if (test->phase == RTHYB_DRIVE_STOPPING) {
        next = braked_target(test->target_m, test->target1_m, test->stop_decel_m_per_s2,
                             test->rig->cfg.servo.period_s);
        test->phase = next == test->target_m ? RTHYB_DRIVE_STOPPED : RTHYB_DRIVE_STOPPING;
    }
    test->target1_m = test->target_m;
    test->target_m = next;
}

/* What stands in the row of this tick: the part has not made its next step yet. */
static void note_freedoms(rthyb_virtual *test)
{
    const rthyb_numerical part = part_of(&test->station->controller);
    double *to = test->station->channel + (test->truth ? 2 : 0);
    (void)rthyb_numerical_report(&part, to, (size_t)test->freedoms);
}

static void tick(rthyb_virtual *test, int32_t command, rthyb_record *record)
{
    rthyb_station *station = test->station;
    const int32_t before = station->state;
    rthyb_station_output out;
    rthyb_station_input in = {
        .command = command,
        .drive_stopped = test->phase != RTHYB_DRIVE_FOLLOWING,
        .taken_over = !station->seen,
        .axis = {{.x_cmd_m = test->target_m}},
    };
    (void)rthyb_rig_step(test->rig, test->target_m, &in.axis[0].x_m, &in.axis[0].f_n);
    if (test->freedoms > 0)
        note_freedoms(test);
    (void)rthyb_station_tick(station, &in, test->ag_mps2, test->ag_count, record, &out);
    rthyb_station_advance(station);
    record->due_ns = llrint((double)record->tick * station->cfg.controller.period_s * 1e9);
    note_pair(record, in.axis[0].x_m, in.axis[0].f_n, 0);
    if (test->truth) {
        station->channel[0] = test->rig->x_true_m;
        station->channel[1] = test->rig->f_true_n;
    }
    drive(test, &out);
    /* What a test comes to must not depend on how long its rig was zeroed and ramped in. */
    if (before == RTHYB_RAMP_IN && station->state == RTHYB_RUNNING)
        rthyb_rig_reseed(test->rig);
}

size_t rthyb_virtual_run(rthyb_virtual *test, int32_t command, size_t count, rthyb_record *records,
                         double *channels, uint32_t channel_count)
{
    const rthyb_station *station = test->station;
    size_t done = 0;
    int told = 0;
    while (done < count && !told) {
        const int32_t state = station->state, zeroing = station->zeroing;
        tick(test, done == 0 ? command : RTHYB_CMD_NONE, &records[done]);
        if (channel_count > 0)
            memcpy(channels + done * channel_count, station->channel,
                   channel_count * sizeof *channels);
        told = station->state != state || (station->zeroing == 2 && zeroing != 2);
        done++;
    }
    return done;
}
