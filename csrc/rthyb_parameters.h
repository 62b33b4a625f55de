/* Parameters that can be changed while a test runs (parameters.c). */
#ifndef RTHYB_PART_PARAMETERS_H
#define RTHYB_PART_PARAMETERS_H

#include <stdint.h>

#include "rthyb_station.h"

/* cffi: begin */

enum rthyb_parameters_size {
    RTHYB_PARAMETER_WORDS = 6 + 2 * RTHYB_CAUSE_COUNT +
    RTHYB_COUPLED_MAX * (7 + 2 * RTHYB_CAUSE_COUNT)
};

/* Parameters of one axis, and of the interface with the same index. */
typedef struct {
    int32_t own; /* 0: the axis uses the watches and limits of the whole set */
    rthyb_watch watch[RTHYB_CAUSE_COUNT];
    double velocity_limit_m_per_s, acceleration_limit_m_per_s2;
    rthyb_interface_config interface;
} rthyb_axis_parameters;

/* Parameters that can be changed during a test. Generation 0 is the set with which the station was set up. */
typedef struct {
    uint32_t generation;
    int32_t adapt;                        /* 0: the control laws do not adapt */
    rthyb_watch watch[RTHYB_CAUSE_COUNT]; /* as in rthyb_station_config */
    double velocity_limit_m_per_s, acceleration_limit_m_per_s2; /* of the commands; 0 = off */
    /* As in rthyb_station_config, for paths that begin from now on. If they are tighter than those of the
     * current path, that path brakes to rest within them and then starts again. */
    double path_velocity_m_per_s, path_acceleration_m_per_s2, brake_acceleration_m_per_s2;
    rthyb_axis_parameters axis[RTHYB_COUPLED_MAX];
} rthyb_parameters;

/* 0 or RTHYB_E_LIMIT. */
int rthyb_parameters_check(const rthyb_parameters *parameters);
/* Call before a tick: applies a set that passed the check, with its generation, to this test and the next.
 * The motion is braked to comply with new limits, at most with the acceleration limit; without one, a command
 * beyond a new position limit goes no further out. Outside IDLE, a set that switches off a limit of the command
 * is rejected. Returns 1 if the set was accepted. */
int rthyb_station_adopt(rthyb_station *station, const rthyb_parameters *parameters);

/* 1 if a command is allowed in a state. */
int rthyb_command_allowed(int32_t state, int32_t command);
/* cffi: end */

#endif
