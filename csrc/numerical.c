/* Numerical parts by kind. A new kind needs a file of its own, a number in rthyb.h and a row
 * here. */
#include "numerical.h"

#include <string.h>

#include "internal.h"
#include "numeric.h"

static const rthyb_numerical_ops *const KINDS[RTHYB_NUMERICAL_KINDS] = {
    [RTHYB_NUMERICAL_MOTION] = &rthyb_motion_ops,
    [RTHYB_NUMERICAL_DENSE] = &rthyb_dense_ops,
    [RTHYB_NUMERICAL_SPARSE] = &rthyb_sparse_ops,
    [RTHYB_NUMERICAL_LIBRARY] = &rthyb_library_ops,
};

const rthyb_numerical_ops *rthyb_numerical_find(int32_t kind)
{
    return kind >= 0 && kind < RTHYB_NUMERICAL_KINDS ? KINDS[kind] : NULL;
}

size_t rthyb_numerical_size(const rthyb_numerical *part)
{
    const rthyb_numerical_ops *ops = rthyb_numerical_find(part->kind);
    return ops && part->cfg ? ops->size(part->cfg) : 0;
}

int32_t rthyb_numerical_interfaces(const rthyb_numerical *part)
{
    const rthyb_numerical_ops *ops = rthyb_numerical_find(part->kind);
    if (!ops)
        return 0;
    return ops->interfaces ? ops->interfaces(part->cfg) : 1;
}

int rthyb_numerical_init(const rthyb_numerical *part, double x0_m)
{
    const rthyb_numerical_ops *ops = rthyb_numerical_find(part->kind);
    if (!ops || !part->cfg || !part->state)
        return RTHYB_E_MOTION;
    return ops->init(part, x0_m);
}

int rthyb_numerical_answer(const rthyb_numerical *part, double excitation, const double *force_n,
                           double *x_next_m)
{
    return KINDS[part->kind]->answer(part, excitation, force_n, x_next_m);
}

int rthyb_numerical_advance(const rthyb_numerical *part)
{
    const rthyb_numerical_ops *ops = KINDS[part->kind];
    return ops->advance ? ops->advance(part) : RTHYB_OK;
}

void rthyb_numerical_freeze(const rthyb_numerical *part, const double *force_n)
{
    const rthyb_numerical_ops *ops = KINDS[part->kind];
    if (ops->freeze)
        ops->freeze(part, force_n);
}

void rthyb_numerical_save(const rthyb_numerical *part, void *bytes)
{
    const rthyb_numerical_ops *ops = KINDS[part->kind];
    if (ops->before_save)
        ops->before_save(part);
    memcpy(bytes, part->state, ops->size(part->cfg));
}

void rthyb_numerical_restore(const rthyb_numerical *part, const void *bytes)
{
    const rthyb_numerical_ops *ops = KINDS[part->kind];
    memcpy(part->state, bytes, ops->size(part->cfg));
    if (ops->after_restore)
        ops->after_restore(part);
}

void rthyb_numerical_look(const rthyb_numerical *part, rthyb_interface *at)
{
    KINDS[part->kind]->look(part, at);
}

size_t rthyb_numerical_report(const rthyb_numerical *part, double *values, size_t most)
{
    return KINDS[part->kind]->report(part, values, most);
}

int rthyb_numerical_reference(const rthyb_numerical *part, rthyb_element *elements,
                              size_t element_count, const double *ag_mps2, size_t n,
                              double period_s, double *x_m, double *v_m_per_s, double *force_n,
                              double *all_m, size_t freedoms)
{
    if (element_count > RTHYB_ELEMENTS_MAX || rthyb_numerical_interfaces(part) != 1)
        return RTHYB_S_OUT_OF_RANGE;
    int code = RTHYB_OK;
    for (size_t i = 0; i < n; i++) {
        rthyb_interface at;
        rthyb_numerical_look(part, &at);
        x_m[i] = at.x;
        v_m_per_s[i] = at.v;
        force_n[i] =
            rthyb_specimen_force(elements, (uint32_t)element_count, at.x, at.v, at.a, period_s);
        double next;
        code |= rthyb_numerical_answer(part, ag_mps2[i], &force_n[i], &next);
        (void)rthyb_numerical_report(part, all_m + i * freedoms, freedoms);
        code |= rthyb_numerical_advance(part);
    }
    return code;
}
