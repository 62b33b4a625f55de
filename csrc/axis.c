/* Checks of the readings of one axis; the station decides about the reaction. */
#include "axis.h"

#include "numeric.h"

int axis_check(const rthyb_axis_config *cfg)
{
    const int good = cfg->x_frozen_ticks >= 0 && cfg->f_frozen_ticks >= 0 &&
                     cfg->x_range_m >= 0.0 && cfg->f_range_n >= 0.0 && cfg->tare_most_m >= 0.0 &&
                     cfg->tare_most_n >= 0.0 && cfg->rest_spread_m > 0.0;
    return good ? 0 : RTHYB_E_LIMIT;
}

int axis_is_sensible(const rthyb_axis_input *in)
{
    return !in->lost && judge(in->x_m, RTHYB_DISPLACEMENT_MAX_M) == RTHYB_OK &&
           judge(in->f_n, RTHYB_FORCE_MAX_N) == RTHYB_OK;
}

int axis_off_scale(const rthyb_axis_config *cfg, const rthyb_axis_input *in)
{
    const double x_range = cfg->x_range_m, f_range = cfg->f_range_n;
    return (x_range > 0.0 && fabs(in->x_m) >= x_range ? AXIS_OFF_X : 0) |
           (f_range > 0.0 && fabs(in->f_n) >= f_range ? AXIS_OFF_F : 0);
}

void axis_begin_tare(rthyb_axis *a)
{
    a->sum_x = a->sum_f = 0.0;
    a->low_x = RTHYB_DISPLACEMENT_MAX_M;
    a->high_x = -RTHYB_DISPLACEMENT_MAX_M;
    a->repeats_x = a->repeats_f = (rthyb_repeats){.count = 0};
}

int axis_add_to_tare(rthyb_axis *a, const rthyb_axis_config *cfg, const rthyb_axis_input *in)
{
    a->sum_x += in->x_m;
    a->sum_f += in->f_n;
    a->low_x = fmin(a->low_x, in->x_m);
    a->high_x = fmax(a->high_x, in->x_m);
    return !(a->high_x - a->low_x > cfg->rest_spread_m);
}

int axis_repeats(rthyb_repeats *seen, double reading, int32_t most)
{
    const int again = seen->count > 0 && reading == seen->reading;
    seen->count = again ? seen->count + (seen->count < INT32_MAX) : 1;
    seen->reading = reading;
    return most > 0 && seen->count >= most;
}

int axis_is_frozen(rthyb_axis *a, const rthyb_axis_config *cfg, const rthyb_axis_input *in,
                   finding *found)
{
    const int of_x = axis_repeats(&a->repeats_x, in->x_m, cfg->x_frozen_ticks);
    const int of_f = axis_repeats(&a->repeats_f, in->f_n, cfg->f_frozen_ticks);
    if (of_x)
        *found = (finding){RTHYB_CAUSE_SENSOR_STUCK, a->repeats_x.count, cfg->x_frozen_ticks, 0};
    else if (of_f)
        *found = (finding){RTHYB_CAUSE_FORCE_STUCK, a->repeats_f.count, cfg->f_frozen_ticks, 0};
    return of_x || of_f;
}

int axis_is_far_off(const rthyb_axis_config *cfg, double x_m, double f_n, finding *found)
{
    const double most_m = cfg->tare_most_m, most_n = cfg->tare_most_n;
    if (most_n > 0.0 && fabs(f_n) > most_n)
        *found = (finding){RTHYB_CAUSE_RIG_FORCE, f_n, most_n, 0};
    else if (most_m > 0.0 && fabs(x_m) > most_m)
        *found = (finding){RTHYB_CAUSE_RIG_POSITION, x_m, most_m, 0};
    else
        return 0;
    return 1;
}

double axis_take_tare(rthyb_axis *a, double x_m, double f_n, double x_cmd_m, int known)
{
    a->tare_x = x_m;
    a->tare_f = f_n;
    /* The drive stays where it is. If an earlier tare has already determined the offset between
     * command and reading, that offset is not a distance to travel: every test would travel it
     * again. */
    a->tare_cmd = known ? x_cmd_m : x_m;
    a->gap = a->tare_cmd - x_cmd_m;
    return x_cmd_m - a->tare_cmd;
}

int axis_is_stuck(rthyb_stillness *still, double reading, double x_cmd_m, int moves, double most,
                  double spread_m)
{
    if (reading != still->reading || !moves) {
        *still = (rthyb_stillness){reading, x_cmd_m, 0};
        return 0;
    }
    still->ticks++;
    return most > 0.0 && (double)still->ticks >= most && fabs(x_cmd_m - still->command) > spread_m;
}

int axis_count_leaps(rthyb_leaps *leaps, double level, double most)
{
    const int again = leaps->count > 0 && fabs(level - leaps->level) <= most;
    leaps->count = again ? leaps->count + 1 : 1;
    leaps->level = level;
    return leaps->count;
}

void axis_watch_rest(rthyb_axis *a, double x_m, double spread_m, int ceased, uint32_t most)
{
    if (fabs(x_m - a->rest_x) > spread_m || ceased) {
        a->rest_x = x_m;
        a->rest_ticks = 0;
    }
    a->rest_ticks += a->rest_ticks < most;
}

void axis_count_overload(rthyb_overload *over, uint64_t gone, int is_beyond, int counts,
                         uint64_t most)
{
    over->calm = is_beyond ? 0 : over->calm + gone;
    if (!counts || over->calm >= most)
        over->ticks = 0;
    else if (is_beyond)
        over->ticks += gone;
}
