/* Sensors without an actuator: further displacement sensors and load cells at the specimen of several axes
 * (lone.c). What they measure, and how it enters the pose and the interface forces, is part of the kinematics. */
#ifndef RTHYB_PART_LONE_H
#define RTHYB_PART_LONE_H

#include <stdint.h>

#include "rthyb_disagreement.h"
#include "rthyb_kinematics.h"
#include "rthyb_watch.h"

/* cffi: begin */

/* Values before tare, in m or N. */
typedef struct {
    double range;              /* a reading at or beyond it is not used; 0 = off */
    rthyb_watch stuck;         /* value: ticks */
    rthyb_watch jump;          /* value: change from one reading to the next */
    rthyb_watch disagreement;  /* value: difference from what the other sensors imply */
    rthyb_allowance allowance; /* for that difference */
    /* ZERO is refused if the reading varies by more than the first, or if the tare exceeds the second; 0 = no limit */
    double rest_spread, tare_most;
    int32_t frozen_ticks; /* ZERO is refused after so many equal readings in a row; 0 = no limit */
} rthyb_lone_config;

/* State; readings are before tare. */
typedef struct {
    double tare, sum, low, high; /* low, high: of the readings of the tare so far */
    rthyb_repeats repeats;       /* of the tare */
    double reading;              /* as received in this tick; NaN if nothing was */
    double seen; /* last reading of a tick in which every axis and every sensor had one */
    rthyb_leaps leaps;
    /* repeated reading, for how many ticks it has been repeated, and the commands along the interface when the
     * repetition began */
    double still, still_at[RTHYB_COUPLED_MAX];
    uint64_t still_ticks;
    int32_t lost, has_reading, off_scale; /* in this tick */
} rthyb_lone;
/* cffi: end */

#endif
