/* A control law by name for C programs, with its own defaults. */
#ifndef RTHYB_LAW_EXAMPLE_H
#define RTHYB_LAW_EXAMPLE_H

#include <math.h>
#include <string.h>

#include "rthyb.h"

/* A setting without a default has the value `instead`. */
static inline rthyb_law_config law_of_kind(int32_t kind, double instead)
{
    const rthyb_law_description *is = rthyb_law_describe(kind);
    rthyb_law_config law = {.kind = kind, .adapts = 1, .rest_noise_m = 2e-6};
    for (uint32_t i = 0; is && i < is->parameter_count; i++) {
        const double standard = is->parameters[i].standard;
        law.parameters[i] = isnan(standard) ? instead : standard;
    }
    return law;
}

static inline rthyb_law_config law_example(const char *name, double instead)
{
    return law_of_kind(rthyb_law_find(name), instead);
}

/* Has no effect on a law without such a setting. */
static inline void law_set(rthyb_law_config *law, const char *key, double value)
{
    const rthyb_law_description *is = rthyb_law_describe(law->kind);
    for (uint32_t i = 0; is && i < is->parameter_count; i++) {
        if (!strcmp(is->parameters[i].key, key))
            law->parameters[i] = value;
    }
}

#endif
