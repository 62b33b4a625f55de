/* Extra channels: quantities measured in addition to displacement and force. They are recorded under their names, and
 * used in the test only as readings of sensors without an actuator (rthyb_lone.h). Frames contain their values
 * (codec.c); the virtual rig has sensors for them (rig.c). */
#ifndef RTHYB_PART_EXTRA_H
#define RTHYB_PART_EXTRA_H

#include <stdint.h>

#include "rthyb_record.h"

/* cffi: begin */

enum rthyb_extra_size { RTHYB_EXTRAS_MAX = 8 };

/* What an extra sensor of the virtual rig measures, at the specimen. */
enum rthyb_extra_kind {
    RTHYB_EXTRA_NONE, /* 0, plus the sensor's errors */
    RTHYB_EXTRA_DISPLACEMENT,
    RTHYB_EXTRA_VELOCITY,
    RTHYB_EXTRA_ACCELERATION,
    RTHYB_EXTRA_FORCE, /* the force on the load cell */
    RTHYB_EXTRA_KINDS
};
/* cffi: end */

#endif
