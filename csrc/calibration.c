/* Conversion between the numbers on the wire and those of the structure. */
#include "numeric.h"

#define GAIN_MIN 1e-9
#define GAIN_MAX 1e9

static int gain_ok(double gain)
{
    return fabs(gain) >= GAIN_MIN && fabs(gain) <= GAIN_MAX;
}

int rthyb_calibration_check(const rthyb_calibration *c)
{
    const int good = gain_ok(c->x_gain) && gain_ok(c->f_gain) && gain_ok(c->cmd_gain) &&
                     fabs(c->x_offset_m) <= RTHYB_DISPLACEMENT_MAX_M &&
                     fabs(c->cmd_offset_m) <= RTHYB_DISPLACEMENT_MAX_M &&
                     fabs(c->f_offset_n) <= RTHYB_FORCE_MAX_N;
    return good ? 0 : RTHYB_E_LIMIT;
}
