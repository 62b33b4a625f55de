/* Sensors without an actuator: readings, tare and checks.
 *
 * They count like the sensors of the axes: as long as one of them has no usable reading, everything
 * is predicted, and after as many ticks as for a pair the test trips. */
#include "station.h"

int lone_is_displacement(const rthyb_station *s, int k)
{
    return k < s->cfg.controller.kinematics.displacement_sensors;
}

static int is_sensible(const rthyb_station *s, int k, double reading)
{
    const double most = lone_is_displacement(s, k) ? RTHYB_DISPLACEMENT_MAX_M : RTHYB_FORCE_MAX_N;
    return judge(reading, most) == RTHYB_OK;
}

static int is_off_scale(const rthyb_station *s, int k, double reading)
{
    const double range = s->cfg.lone[k].range;
    return range > 0.0 && fabs(reading) >= range;
}

/* Whether a value is missing, by the input of a tick. */
static int is_lost(const rthyb_station_input *in, int k)
{
    return (int)(in->sensors_lost >> k & 1u);
}

int lone_check(const rthyb_station_config *cfg)
{
    int good = 1;
    for (int k = 0; k < RTHYB_SENSORS_ALL; k++) {
        const rthyb_lone_config *own = &cfg->lone[k];
        good = good && own->frozen_ticks >= 0 && differ_allowance_ok(&own->allowance) &&
               own->range >= 0.0 && own->rest_spread >= 0.0 && own->tare_most >= 0.0 &&
               !rthyb_watches_check(&own->stuck, 1) && !rthyb_watches_check(&own->jump, 1) &&
               !rthyb_watches_check(&own->disagreement, 1);
    }
    return good ? 0 : RTHYB_E_LIMIT;
}

static finding at_end_of_range(const rthyb_station *s, int k, double reading)
{
    const int cause = lone_is_displacement(s, k) ? RTHYB_CAUSE_POSITION : RTHYB_CAUSE_FORCE;
    return (finding){cause, reading, s->cfg.lone[k].range, of_sensor(k)};
}

int lone_is_sound(const rthyb_station *s, const rthyb_station_input *in, finding *found)
{
    for (int k = 0; k < lones_of(s); k++) {
        if (!is_lost(in, k) && isfinite(in->sensor[k]) && is_off_scale(s, k, in->sensor[k])) {
            *found = at_end_of_range(s, k, in->sensor[k]);
            return 0;
        }
        if (is_lost(in, k) || !is_sensible(s, k, in->sensor[k])) {
            /* The controller has not counted this tick yet. */
            const double missing = s->controller.sensor_missing[k] + 1.0;
            *found = (finding){RTHYB_CAUSE_SENSOR_LOST, missing, s->ticks.lost, of_sensor(k)};
            return 0;
        }
    }
    return 1;
}

int lone_look(rthyb_station *s, const rthyb_station_input *in)
{
    int all = 1;
    for (int k = 0; k < lones_of(s); k++) {
        rthyb_lone *own = &s->lone[k];
        own->lost = is_lost(in, k);
        own->reading = own->lost ? (double)NAN : in->sensor[k];
        own->has_reading = is_sensible(s, k, own->reading);
        /* However large: what no load cell can measure is beyond the end of its range too. */
        own->off_scale = isfinite(own->reading) && is_off_scale(s, k, own->reading);
        all = all && own->has_reading;
    }
    return all;
}

int lone_off_scale(const rthyb_station *s)
{
    int bits = 0;
    for (int k = 0; k < lones_of(s); k++)
        if (s->lone[k].off_scale)
            bits |= lone_is_displacement(s, k) ? AXIS_OFF_X : AXIS_OFF_F;
    return bits;
}

uint32_t lone_leaps(rthyb_station *s)
{
    uint32_t leapt = 0;
    for (int k = 0; k < lones_of(s); k++) {
        rthyb_lone *own = &s->lone[k];
        const int cause =
            lone_is_displacement(s, k) ? RTHYB_CAUSE_SENSOR_JUMP : RTHYB_CAUSE_FORCE_JUMP;
        const finding at = {.cause = cause, .where = of_sensor(k)};
        if (!watch_is_steady(s, &s->cfg.lone[k].jump, at, &own->leaps, own->seen, own->reading))
            leapt |= 1u << k;
    }
    return leapt;
}

void lone_take(const rthyb_station *s, uint32_t leapt, rthyb_input *pairs)
{
    for (int k = 0; k < lones_of(s); k++) {
        const rthyb_lone *own = &s->lone[k];
        pairs->sensor[k] = own->reading - own->tare;
        pairs->sensor_lost[k] = own->lost || leapt >> k & 1u ? RTHYB_LOST : 0;
        if (own->off_scale)
            pairs->sensor_lost[k] = RTHYB_LOST | RTHYB_S_OUT_OF_RANGE;
    }
}

/* Whether, since a sensor began to repeat its reading, the command has moved an axis by more than
 * the readings of that axis vary at rest, in a direction that the sensor responds to. With pins, a
 * displacement sensor responds more or less to every direction: the command must have moved the
 * sensor itself by more than its readings vary at rest. */
static int has_moved(const rthyb_station *s, int k)
{
    const rthyb_kinematics_config *tie = &s->cfg.controller.kinematics;
    const int m = interfaces_of(s), p = tie->displacement_sensors;
    double of_axes[RTHYB_COUPLED_SQUARE] = {0.0}, now[RTHYB_COUPLED_MAX] = {0.0};
    for (int j = 0; j < m; j++)
        now[j] = s->controller.interface[j].x_num;
    if (k < p && tie->kind == RTHYB_KINEMATICS_PINS) {
        const double none[RTHYB_COUPLED_MAX] = {0.0};
        double moved[RTHYB_SENSORS_ALL] = {0.0};
        rthyb_kinematics_change(tie, s->lone[k].still_at, now, none, moved);
        return fabs(moved[k]) > s->cfg.lone[k].rest_spread;
    }
    const double *row =
        k < p ? tie->reads + (ptrdiff_t)k * m : tie->carries + (ptrdiff_t)(k - p) * m;
    rthyb_kinematics_jacobian(&s->controller.kinematics, of_axes);
    for (int j = 0; j < m; j++) {
        const double way = now[j] - s->lone[k].still_at[j];
        for (int i = 0; i < axes_of(s) && row[j] != 0.0; i++)
            if (fabs(of_axes[i * m + j] * way) > s->cfg.axis[i].rest_spread_m)
                return 1;
    }
    return 0;
}

static void check_stuck(rthyb_station *s, int k)
{
    rthyb_lone *own = &s->lone[k];
    const rthyb_watch *watch = &s->cfg.lone[k].stuck;
    if (own->reading != own->still || !is_moving(s->state)) {
        own->still = own->reading;
        own->still_ticks = 0;
        for (int j = 0; j < interfaces_of(s); j++)
            own->still_at[j] = s->controller.interface[j].x_num;
        return;
    }
    own->still_ticks++;
    if (!(watch->value > 0.0) || (double)own->still_ticks < watch->value || !has_moved(s, k))
        return;
    const int cause =
        lone_is_displacement(s, k) ? RTHYB_CAUSE_SENSOR_STUCK : RTHYB_CAUSE_FORCE_STUCK;
    const finding found = {cause, (double)own->still_ticks, watch->value, of_sensor(k)};
    s->noted |= watch_react(s, found, watch->reaction, RTHYB_S_SENSOR_STUCK);
}

void lone_note(rthyb_station *s)
{
    for (int k = 0; k < lones_of(s); k++) {
        check_stuck(s, k);
        s->lone[k].seen = s->lone[k].reading;
    }
}

void lone_begin_tare(rthyb_station *s)
{
    for (int k = 0; k < lones_of(s); k++) {
        s->lone[k].sum = 0.0;
        s->lone[k].low = (double)INFINITY;
        s->lone[k].high = -(double)INFINITY;
        s->lone[k].repeats = (rthyb_repeats){.count = 0};
    }
}

int lone_add_to_tare(rthyb_station *s, finding *found)
{
    for (int k = 0; k < lones_of(s); k++) {
        rthyb_lone *own = &s->lone[k];
        const double most = s->cfg.lone[k].rest_spread;
        own->sum += own->reading;
        own->low = fmin(own->low, own->reading);
        own->high = fmax(own->high, own->reading);
        const double spread = own->high - own->low;
        if (most > 0.0 && spread > most) {
            *found = (finding){RTHYB_CAUSE_NONE, spread, most, of_sensor(k)};
            return 0;
        }
    }
    return 1;
}

int lone_is_frozen(rthyb_station *s, finding *found)
{
    int frozen = 0;
    for (int k = 0; k < lones_of(s); k++) {
        rthyb_repeats *seen = &s->lone[k].repeats;
        const int32_t most = s->cfg.lone[k].frozen_ticks;
        if (!axis_repeats(seen, s->lone[k].reading, most) || frozen)
            continue;
        const int cause =
            lone_is_displacement(s, k) ? RTHYB_CAUSE_SENSOR_STUCK : RTHYB_CAUSE_FORCE_STUCK;
        *found = (finding){cause, seen->count, most, of_sensor(k)};
        frozen = 1;
    }
    return frozen;
}

int lone_is_far_off(const rthyb_station *s, finding *found)
{
    for (int k = 0; k < lones_of(s); k++) {
        const double tare = s->lone[k].sum / s->cfg.tare_ticks, most = s->cfg.lone[k].tare_most;
        if (!(most > 0.0) || !(fabs(tare) > most))
            continue;
        const int cause =
            lone_is_displacement(s, k) ? RTHYB_CAUSE_RIG_POSITION : RTHYB_CAUSE_RIG_FORCE;
        *found = (finding){cause, tare, most, of_sensor(k)};
        return 1;
    }
    return 0;
}

void lone_take_tare(rthyb_station *s)
{
    for (int k = 0; k < lones_of(s); k++)
        s->lone[k].tare = s->lone[k].sum / s->cfg.tare_ticks;
}

void lone_seen(const rthyb_station *s, double *values)
{
    for (int k = 0; k < lones_of(s); k++)
        values[k] = s->lone[k].seen - s->lone[k].tare;
}

int lone_finds(const rthyb_station *s, int which, finding *found)
{
    for (int k = 0; k < lones_of(s); k++) {
        const rthyb_lone *own = &s->lone[k];
        if (!own->off_scale || !(which & (lone_is_displacement(s, k) ? AXIS_OFF_X : AXIS_OFF_F)))
            continue;
        *found = at_end_of_range(s, k, own->reading);
        return 1;
    }
    return 0;
}

int lone_not_taken(const rthyb_station *s, uint32_t axis_missing, finding *found)
{
    const uint32_t *missing = s->controller.sensor_missing;
    int longest = -1;
    for (int k = 0; k < lones_of(s); k++)
        if (missing[k] > (longest < 0 ? axis_missing : missing[longest]))
            longest = k;
    if (longest < 0)
        return 0;
    const rthyb_lone *own = &s->lone[longest];
    *found =
        (finding){RTHYB_CAUSE_SENSOR_LOST, missing[longest], s->ticks.lost, of_sensor(longest)};
    if (own->has_reading && !own->off_scale && own->leaps.count > 0) {
        found->cause =
            lone_is_displacement(s, longest) ? RTHYB_CAUSE_SENSOR_JUMP : RTHYB_CAUSE_FORCE_JUMP;
        found->value = own->leaps.level - own->seen;
        found->limit = s->cfg.lone[longest].jump.value;
    }
    return 1;
}

int lone_withholds(const rthyb_station *s, finding *found)
{
    if (!lone_not_taken(s, s->ticks.lost - 1, found))
        return 0;
    const int k = found->where - SENSOR_PLACE;
    if (s->lone[k].off_scale)
        *found = at_end_of_range(s, k, s->lone[k].reading);
    return 1;
}

int lone_not_finite(const rthyb_station *s, const rthyb_input *in)
{
    for (int k = 0; k < lones_of(s); k++)
        if (!in->sensor_lost[k] && !isfinite(in->sensor[k]))
            return of_sensor(k);
    return 0;
}

void lone_note_channels(rthyb_station *s)
{
    const uint32_t count = (uint32_t)lones_of(s);
    for (uint32_t k = 0; k < s->cfg.lone_channel_count && k < 2 * count; k++)
        s->channel[s->cfg.lone_channel + k] =
            k < count ? s->controller.sensor[k] : s->lone[k - count].reading;
}

uint32_t lone_silent_bits(const rthyb_station *s)
{
    uint32_t bits = 0;
    for (int k = 0; k < lones_of(s); k++)
        bits |= (uint32_t)(s->lone[k].lost != 0) << (RTHYB_SILENT_BIT + k);
    return bits;
}
