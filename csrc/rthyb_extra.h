/* Extra channels: what is measured beside displacement and force, recorded by name and used by nothing.
 * A frame contains their values (codec.c); the virtual rig has sensors for them (rig.c). */
#ifndef RTHYB_PART_EXTRA_H
#define RTHYB_PART_EXTRA_H

#include <stdint.h>

#include "rthyb_record.h"

/* cffi: begin */

enum rthyb_extra_size { RTHYB_EXTRAS_MAX = 8 };

/* What an extra sensor of the virtual rig measures, at the specimen, without any error. */
enum rthyb_extra_kind {
    RTHYB_EXTRA_NONE, /* reads 0 and its own errors */
    RTHYB_EXTRA_DISPLACEMENT,
    RTHYB_EXTRA_VELOCITY,
    RTHYB_EXTRA_ACCELERATION,
    RTHYB_EXTRA_FORCE, /* as the load cell feels it */
    RTHYB_EXTRA_KINDS
};
/* cffi: end */

#endif
