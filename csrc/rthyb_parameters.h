/* What may be changed while a test runs (parameters.c). */
#ifndef RTHYB_PART_PARAMETERS_H
#define RTHYB_PART_PARAMETERS_H

#include <stdint.h>

#include "rthyb_station.h"

/* cffi: begin */

enum rthyb_parameters_size {
    RTHYB_PARAMETER_WORDS = 6 + 2 * RTHYB_CAUSE_COUNT +
    RTHYB_COUPLED_MAX * (7 + 2 * RTHYB_CAUSE_COUNT)
};

/* Of one axis, and of the interface of that number. */
typedef struct {
    int32_t own; /* 0: watches and limits of the axis are those of the set */
    rthyb_watch watch[RTHYB_CAUSE_COUNT];
    double velocity_limit_m_per_s, acceleration_limit_m_per_s2;
    rthyb_interface_config interface;
} rthyb_axis_parameters;

/* What may be changed while a test runs. Generation 0 is what the station was set up with. */
typedef struct {
    uint32_t generation;
    int32_t adapt;                        /* 0: what the control laws have learnt stays as it is */
    rthyb_watch watch[RTHYB_CAUSE_COUNT]; /* as in rthyb_station_config */
    double velocity_limit_m_per_s, acceleration_limit_m_per_s2; /* of the commands; 0 = off */
    /* As in rthyb_station_config, of paths that begin from now on; narrower than those of the path
     * that runs, that brakes to rest within them and begins anew. */
    double path_velocity_m_per_s, path_acceleration_m_per_s2, brake_acceleration_m_per_s2;
    rthyb_axis_parameters axis[RTHYB_COUPLED_MAX];
} rthyb_parameters;

/* 0 or RTHYB_E_LIMIT. */
int rthyb_parameters_check(const rthyb_parameters *parameters);
/* Before a tick: puts a set that passed in force, with its generation, in this test and the next. New
 * limits are braked into: with an acceleration limit, no harder than that; without one, a command
 * beyond a new position limit goes no further out. Outside IDLE a set that switches a limit of the
 * command off is not taken. 1 if it was taken. */
int rthyb_station_adopt(rthyb_station *station, const rthyb_parameters *parameters);

/* 1 if a command may be given in a state. */
int rthyb_command_allowed(int32_t state, int32_t command);
/* cffi: end */

#endif
