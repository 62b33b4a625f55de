/* Sensors of the virtual rigs: noise, bias, quantisation and saturation. */
#ifndef RTHYB_SENSOR_H
#define RTHYB_SENSOR_H

#include "noise.h"

static inline double sense(rthyb_noise *noise, const rthyb_sensor *sensor, double value)
{
    double reading = value + sensor->bias;
    if (sensor->noise_std > 0.0)
        reading += sensor->noise_std * normal(noise);
    if (sensor->lsb > 0.0)
        reading = sensor->lsb * nearbyint(reading / sensor->lsb);
    return sensor->range > 0.0 ? clamp(reading, -sensor->range, sensor->range) : reading;
}

static inline int sensor_ok(const rthyb_sensor *s, double most)
{
    const int lsb_ok = s->lsb == 0.0 || (s->lsb >= 1e-15 && s->lsb <= most);
    return s->noise_std >= 0.0 && s->noise_std <= most && lsb_ok && fabs(s->bias) <= most &&
           s->range >= 0.0 && s->range <= most;
}

#endif
