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

#define EXTRA_MAX 1e15

static inline int extra_sensors_ok(const rthyb_extra_sensor *sensors, uint32_t count)
{
    if (count > RTHYB_EXTRAS_MAX)
        return 0;
    for (uint32_t i = 0; i < count; i++)
        if (sensors[i].kind < 0 || sensors[i].kind >= RTHYB_EXTRA_KINDS ||
            !(fabs(sensors[i].gain) <= EXTRA_MAX) || !sensor_ok(&sensors[i].sensor, EXTRA_MAX))
            return 0;
    return 1;
}

/* What the extra sensors at one axis read; `measured` has the quantities by enum rthyb_extra_kind. */
static inline void sense_extras(rthyb_noise *noise, const rthyb_extra_sensor *sensors,
                                uint32_t count, const double *measured, double *readings)
{
    for (uint32_t i = 0; i < count; i++)
        readings[i] = sense(noise, &sensors[i].sensor, sensors[i].gain * measured[sensors[i].kind]);
}

#endif
