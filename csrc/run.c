/* Runs without a station: the bare controller at a virtual rig, and the structure without either. */
#include <string.h>

#include "internal.h"
#include "numeric.h"
/* CMake has it made; plain gcc does without. */
#ifdef RTHYB_SOURCE_HASH_FILE
#include RTHYB_SOURCE_HASH_FILE
#else
#define RTHYB_SOURCE_HASH ""
#endif

/* The excitation of tick n; for a prescribed motion that is the command of tick n + 1. */
static double excitation_at(const rthyb_controller *c, const double *excitation, size_t n_total)
{
    const int prescribed = c->cfg.motion.integrator == RTHYB_PRESCRIBED;
    const uint64_t n = c->tick + (prescribed ? 1u : 0u);
    if (n < n_total)
        return excitation[n];
    return prescribed && n_total > 0 ? excitation[n_total - 1] : 0.0;
}

size_t rthyb_run_virtual(rthyb_controller *controller, rthyb_rig *rig, const double *excitation,
                         size_t n_total, size_t count, void *rows, int32_t *status)
{
    rthyb_record record;
    *status = RTHYB_OK;
    size_t done = 0;
    while (done < count && !(*status & RTHYB_S_NOT_FINITE)) {
        rthyb_input in = {.excitation = excitation_at(controller, excitation, n_total)};
        rthyb_rig_step(rig, controller->axis[0].x_cmd, &in.axis[0].x_meas_m, &in.axis[0].f_meas_n);
        *status |= rthyb_controller_step(controller, &in, &record);
        memcpy(row_at(rows, 1, done++), &record, record_bytes(1));
    }
    return done;
}

int rthyb_run_reference(rthyb_motion *motion, rthyb_element *elements, size_t element_count,
                        const double *ag_mps2, size_t n, double *x_m, double *v_m_per_s,
                        double *force_n)
{
    const rthyb_numerical part = {
        .kind = RTHYB_NUMERICAL_MOTION, .cfg = &motion->cfg, .state = motion};
    return rthyb_numerical_reference(&part, elements, element_count, ag_mps2, n,
                                     motion->cfg.period_s, x_m, v_m_per_s, force_n, x_m, 0);
}

size_t rthyb_record_bytes(int32_t axis_count)
{
    return record_bytes(axis_count);
}

const char *rthyb_version(void)
{
    return RTHYB_VERSION;
}

const char *rthyb_source_hash(void)
{
    return RTHYB_SOURCE_HASH;
}

const char *rthyb_compiler(void)
{
    return __VERSION__;
}
