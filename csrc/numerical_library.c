/* A user's own numerical part: its values are accepted only if they are plausible. */
#include <string.h>

#include "numeric.h"
#include "numerical.h"

#define EXCITATION_MAX 1e4
/* Its square, as in an rms, is finite. */
#define RESPONSE_MAX 1e150

typedef const rthyb_library_config config;

typedef struct {
    double x[RTHYB_INTERFACES_MAX], x1[RTHYB_INTERFACES_MAX], x2[RTHYB_INTERFACES_MAX];
    /* In the order of the part; the displacements are in that of the program. */
    double force[RTHYB_INTERFACES_MAX];
    double excitation;
    int64_t refused; /* return value of its init */
} library_state;

static void *state_of(const rthyb_numerical *part)
{
    config *c = part->cfg;
    return c->instance ? c->instance : (void *)((library_state *)part->state + 1);
}

/* Whether each interface of the part has exactly one place. */
static int each_once(config *c)
{
    uint32_t taken = 0;
    for (int i = 0; i < c->interfaces; i++) {
        if (c->place[i] < 0 || c->place[i] >= c->interfaces)
            return 0;
        taken |= UINT32_C(1) << c->place[i];
    }
    return taken == (UINT32_C(1) << c->interfaces) - 1;
}

static size_t size(const void *cfg)
{
    config *c = cfg;
    if (c->interfaces < 1 || c->interfaces > RTHYB_INTERFACES_MAX || c->responses < 0 ||
        c->responses > RTHYB_RESPONSES_MAX || c->state_bytes < 0 ||
        c->state_bytes > RTHYB_LIBRARY_STATE_MAX || !each_once(c))
        return 0;
    return sizeof(library_state) + (c->instance ? 0 : (size_t)c->state_bytes);
}

static int init(const rthyb_numerical *part, double x0_m)
{
    config *c = part->cfg;
    const size_t bytes = size(c);
    if (!bytes || !c->calls.init || !c->calls.answer)
        return RTHYB_E_MOTION;
    if (!(c->setup.period_s > 0.0 && c->setup.period_s <= 1.0))
        return RTHYB_E_PERIOD;
    if (x0_m != 0.0)
        return RTHYB_E_LIMIT;
    memset(part->state, 0, bytes);
    library_state *s = part->state;
    s->refused = c->calls.init(state_of(part), &c->setup);
    return s->refused ? RTHYB_E_MOTION : 0;
}

int32_t rthyb_library_refusal(const rthyb_numerical *part)
{
    return (int32_t)((const library_state *)part->state)->refused;
}

/* Forces in the order of the part. */
static const double *taken_forces(config *c, library_state *s, const double *force_n, int *code)
{
    for (int i = 0; i < c->interfaces; i++) {
        double *own = &s->force[c->place[i]];
        *own = accept(force_n[i], RTHYB_FORCE_MAX_N, *own, code);
    }
    return s->force;
}

/* If a value was not written, or is not a number, the interface stays where it is; a value that is
 * too large is limited. */
static double taken(double next, double before, int *code)
{
    if (isnan(next)) {
        *code |= RTHYB_S_NOT_FINITE;
        return before;
    }
    return confine(next, RTHYB_DISPLACEMENT_MAX_M, code);
}

static int answer(const rthyb_numerical *part, double excitation, const double *force_n,
                  double *x_next_m)
{
    config *c = part->cfg;
    library_state *s = part->state;
    double next[RTHYB_INTERFACES_MAX];
    int code = RTHYB_OK;
    s->excitation = accept(excitation, EXCITATION_MAX, s->excitation, &code);
    const double *force = taken_forces(c, s, force_n, &code);
    for (int i = 0; i < c->interfaces; i++)
        next[i] = (double)NAN;
    const int refused = c->calls.answer(state_of(part), s->excitation, force, next) != 0;
    for (int i = 0; i < c->interfaces; i++) {
        s->x2[i] = s->x1[i];
        s->x1[i] = s->x[i];
        s->x[i] = refused ? s->x[i] : taken(next[c->place[i]], s->x[i], &code);
        x_next_m[i] = s->x[i];
    }
    return code | (refused ? RTHYB_S_OUT_OF_RANGE : RTHYB_OK);
}

static int advance(const rthyb_numerical *part)
{
    config *c = part->cfg;
    const int refused = c->calls.advance && c->calls.advance(state_of(part)) != 0;
    return refused ? RTHYB_S_OUT_OF_RANGE : RTHYB_OK;
}

static void freeze(const rthyb_numerical *part, const double *force_n)
{
    config *c = part->cfg;
    library_state *s = part->state;
    int code = RTHYB_OK;
    const double *force = taken_forces(c, s, force_n, &code);
    if (c->calls.freeze)
        c->calls.freeze(state_of(part), force);
}

/* For a part that reports only its position. */
static void look(const rthyb_numerical *part, rthyb_interface *at)
{
    config *c = part->cfg;
    const library_state *s = part->state;
    const double h = c->setup.period_s;
    for (int i = 0; i < c->interfaces; i++)
        at[i] = (rthyb_interface){
            .x = s->x[i],
            .v = (3.0 * s->x[i] - 4.0 * s->x1[i] + s->x2[i]) / (2.0 * h),
            .a = (s->x[i] - 2.0 * s->x1[i] + s->x2[i]) / (h * h),
            .x1 = s->x1[i],
            .x2 = s->x2[i],
        };
}

/* NaN: not written, no number, or too large. A recorded 0 would look like a value of the part. */
static size_t report(const rthyb_numerical *part, double *values, size_t most)
{
    config *c = part->cfg;
    double all[RTHYB_RESPONSES_MAX];
    if (!c->calls.report || c->responses == 0)
        return 0;
    for (int i = 0; i < c->responses; i++)
        all[i] = (double)NAN;
    c->calls.report(state_of(part), all);
    const size_t count = (size_t)c->responses < most ? (size_t)c->responses : most;
    for (size_t i = 0; i < count; i++)
        values[i] = fabs(all[i]) <= RESPONSE_MAX ? all[i] : (double)NAN;
    return count;
}

static void before_save(const rthyb_numerical *part)
{
    config *c = part->cfg;
    if (c->calls.save)
        c->calls.save(state_of(part));
}

static void after_restore(const rthyb_numerical *part)
{
    config *c = part->cfg;
    if (c->calls.restore)
        c->calls.restore(state_of(part));
}

static int32_t interfaces(const void *cfg)
{
    return ((const rthyb_library_config *)cfg)->interfaces;
}

const rthyb_numerical_ops rthyb_library_ops = {
    .size = size,
    .interfaces = interfaces,
    .init = init,
    .answer = answer,
    .advance = advance,
    .freeze = freeze,
    .look = look,
    .report = report,
    .before_save = before_save,
    .after_restore = after_restore,
};
