/* The control laws that are built in, and the calls to the law in use. */
#include <string.h>

#include "control_law.h"
#include "phase_lead.h"

/* Pointers to the laws, placed side by side by the linker, which defines the two names. */
extern const rthyb_control_law *const
    __start_rthyb_laws[]; /* NOLINT(bugprone-reserved-identifier,cert-*) */
extern const rthyb_control_law *const
    __stop_rthyb_laws[]; /* NOLINT(bugprone-reserved-identifier,cert-*) */

size_t rthyb_law_count(void)
{
    /* In C these are two arrays, whose pointers must not be subtracted. */
    const uintptr_t bytes = (uintptr_t)__stop_rthyb_laws - (uintptr_t)__start_rthyb_laws;
    return bytes / sizeof __start_rthyb_laws[0];
}

const rthyb_control_law *rthyb_law_at(int32_t kind)
{
    return kind >= 0 && (size_t)kind < rthyb_law_count() ? __start_rthyb_laws[kind] : NULL;
}

int32_t rthyb_law_find(const char *name)
{
    for (int32_t i = 0; (size_t)i < rthyb_law_count(); i++) {
        if (!strcmp(__start_rthyb_laws[i]->is.name, name))
            return i;
    }
    return -1;
}

const rthyb_law_description *rthyb_law_describe(int32_t kind)
{
    const rthyb_control_law *law = rthyb_law_at(kind);
    return law ? &law->is : NULL;
}

size_t rthyb_law_state_size(int32_t kind)
{
    const rthyb_control_law *law = rthyb_law_at(kind);
    return law ? law->state_size : 0;
}

int rthyb_law_check(int32_t kind, const double *parameters, double period_s,
                    rthyb_law_complaint *complaint)
{
    const rthyb_control_law *law = rthyb_law_at(kind);
    return law && law->check ? law->check(parameters, period_s, complaint) : -1;
}

static int32_t offset_of(const rthyb_law_description *is, const char *name)
{
    for (uint32_t i = 0; i < is->value_count; i++) {
        if (!strcmp(is->values[i].name, name))
            return (int32_t)is->values[i].offset;
    }
    return -1;
}

int rthyb_law_init(rthyb_law *law, const rthyb_law_config *cfg, double period_s, double x0_m)
{
    const rthyb_control_law *kind = cfg->own ? cfg->own : rthyb_law_at(cfg->kind);
    if (!kind || kind->state_size > sizeof law->state)
        return RTHYB_E_LAW;
    if (!(period_s > 0.0 && period_s <= 1.0))
        return RTHYB_E_PERIOD;
    if (!(cfg->rest_noise_m >= 0.0 && cfg->rest_noise_m <= 1.0))
        return RTHYB_E_LAW;
    if (judge(x0_m, RTHYB_DISPLACEMENT_MAX_M) != RTHYB_OK)
        return RTHYB_E_LIMIT;
    for (uint32_t i = 0; i < kind->is.parameter_count; i++) {
        if (!isfinite(cfg->parameters[i]))
            return RTHYB_E_LAW;
    }
    rthyb_law_complaint complaint;
    if (!cfg->own && rthyb_law_check(cfg->kind, cfg->parameters, period_s, &complaint) >= 0)
        return RTHYB_E_LAW;
    const rthyb_law_start start = {
        .parameters = cfg->parameters,
        .period_s = period_s,
        .x0_m = x0_m,
        .rest_noise_m = cfg->rest_noise_m,
    };
    *law = (rthyb_law){.cfg = *cfg};
    law->alpha_at = offset_of(&kind->is, "alpha");
    law->beta_at = offset_of(&kind->is, "beta");
    return kind->init(&law->state, &start);
}

/* For a law that rthyb_law_init has accepted: called in every tick, without checking again. */
static inline const rthyb_control_law *law_of(const rthyb_law *law)
{
    return law->cfg.own ? law->cfg.own : __start_rthyb_laws[law->cfg.kind];
}

void rthyb_law_rest(rthyb_law *law, double x_m)
{
    if (judge(x_m, RTHYB_DISPLACEMENT_MAX_M) == RTHYB_OK)
        law_of(law)->rest(&law->state, x_m);
}

/* The lead that most laws have in common is called by name: the compiler inlines it, and a sample of
 * one axis takes a tenth less time. */
int rthyb_law_observe(rthyb_law *law, double x_p_m, double x_m_m, int frozen)
{
    const rthyb_control_law *kind = law_of(law);
    const int held = frozen || !law->cfg.adapts;
    if (kind->observe == rthyb_lead_observe)
        return rthyb_lead_observe(&law->state, x_p_m, x_m_m, held);
    return kind->observe(&law->state, x_p_m, x_m_m, held);
}

/* What is passed to a function that is not inlined lies in memory from there on: only a copy is, so
 * that the command stays in a register otherwise. */
int rthyb_law_lead(rthyb_law *law, double x_c_m, double allowed_m, double *x_p_m)
{
    const rthyb_control_law *kind = law_of(law);
    double x_p = 0.0;
    int code;
    if (kind->lead == rthyb_lead_lead) {
        code = rthyb_lead_lead(&law->state, x_c_m, allowed_m, &x_p);
    } else {
        double found = x_p;
        code = kind->lead(&law->state, x_c_m, allowed_m, &found);
        x_p = found;
    }
    *x_p_m = x_p;
    return code;
}

double rthyb_law_value_at(const rthyb_law *law, int32_t offset)
{
    double value = (double)NAN;
    if (offset >= 0)
        memcpy(&value, law->state.bytes + offset, sizeof value);
    return value;
}

void rthyb_law_report(const rthyb_law *law, double *values)
{
    const rthyb_law_description *is = &law_of(law)->is;
    for (uint32_t i = 0; i < is->value_count; i++)
        values[i] = rthyb_law_value_at(law, (int32_t)is->values[i].offset);
}

uint32_t rthyb_law_report_beside(const rthyb_law *law, double *values, uint32_t most)
{
    const rthyb_law_description *is = &law_of(law)->is;
    uint32_t count = 0;
    for (uint32_t i = 0; i < is->value_count && count < most; i++) {
        const int32_t at = (int32_t)is->values[i].offset;
        if (at != law->alpha_at && at != law->beta_at)
            values[count++] = rthyb_law_value_at(law, at);
    }
    return count;
}

int rthyb_law_run(rthyb_law *law, const double *x_c_m, double *x_p_m, size_t n)
{
    int code = RTHYB_OK;
    for (size_t i = 0; i < n; i++)
        code |= rthyb_law_lead(law, x_c_m[i], 0.0, &x_p_m[i]);
    return code;
}
