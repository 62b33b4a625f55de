/* A user's own numerical part in C: m x'' + c x' + k x + force = -m ag by central difference, like
 * the built-in part with one degree of freedom.
 *
 *   cc -O2 -ffp-contract=off -shared -fPIC -I csrc examples/own_parts/oscillator.c -o oscillator.so
 */
#include <string.h>

#include "rthyb_library.h"

enum { MASS, DAMPING, STIFFNESS };

typedef struct {
    double mass, damping, stiffness, h;
    double x, x1; /* displacement at t_n and at the previous sample, m */
} oscillator;

int32_t rthyb_part_version(void)
{
    return RTHYB_LIBRARY_VERSION;
}

int32_t rthyb_part_interfaces(void)
{
    return 1;
}

void rthyb_part_names(int32_t of, char *text)
{
    strcpy(text, of == RTHYB_PART_PARAMETERS ? "mass_kg damping_n_s_per_m stiffness_n_per_m"
                                             : "velocity[m/s]");
}

int64_t rthyb_part_state_bytes(const rthyb_part_setup *setup)
{
    (void)setup;
    return sizeof(oscillator);
}

int32_t rthyb_part_init(void *state, const rthyb_part_setup *setup)
{
    oscillator *s = state;
    s->mass = setup->parameter[MASS];
    s->damping = setup->parameter[DAMPING];
    s->stiffness = setup->parameter[STIFFNESS];
    s->h = setup->period_s;
    return s->mass > 0.0 && s->damping >= 0.0 ? 0 : 1;
}

int32_t rthyb_part_answer(void *state, double ag_mps2, const double *force_n, double *x_next_m)
{
    oscillator *s = state;
    const double half = 0.5 * s->h * s->damping;
    const double net = -s->mass * ag_mps2 - s->stiffness * s->x - force_n[0];
    const double next =
        s->x + ((s->mass - half) * (s->x - s->x1) + s->h * s->h * net) * (1.0 / (s->mass + half));
    s->x1 = s->x;
    s->x = *x_next_m = next;
    return 0;
}

void rthyb_part_report(const void *state, double *values)
{
    const oscillator *s = state;
    values[0] = (s->x - s->x1) / s->h;
}
