/* A user's own numerical part with two interfaces, in C: the corner of a frame, which two actuators move sideways
 * (interface 1, m and N) and turn (interface 2, rad and N m). M x'' + C x' + K x + force = -M r ag with r = (1, 0)
 * by the CR algorithm (Chen & Ricles 2008, J. Eng. Mech. 134:8), which is stable for any stiffness: the elastic
 * stiffness of the specimen, both interfaces together, is part of S = M + h/2 C + h^2/4 (K + K_e).
 *
 *   cc -O2 -ffp-contract=off -shared -fPIC -I csrc examples/own_parts/corner.c -o examples/own_parts/corner.so
 *   rthyb run examples/own_parts/corner.toml
 */
#include <string.h>

#include "rthyb_library.h"

enum { MASS, INERTIA, DAMPING, TURN_DAMPING, STIFFNESS, TURN_STIFFNESS, COUPLING };
enum { INTERFACES = 2 };

typedef struct {
    double h, mass[INTERFACES], damping[INTERFACES], stiffness[INTERFACES][INTERFACES];
    double per_step[INTERFACES][INTERFACES]; /* S^-1 */
    double x[INTERFACES], v[INTERFACES];     /* at t_n */
    double net[INTERFACES];                  /* forces of the step that answer has begun */
} corner;

int32_t rthyb_part_version(void)
{
    return RTHYB_LIBRARY_VERSION;
}

int32_t rthyb_part_interfaces(void)
{
    return INTERFACES;
}

void rthyb_part_names(int32_t of, char *text)
{
    strcpy(text, of == RTHYB_PART_PARAMETERS
                     ? "mass_kg inertia_kg_m2 damping_n_s_per_m damping_n_m_s_per_rad "
                       "stiffness_n_per_m stiffness_n_m_per_rad coupling_n"
                     : "corner_velocity[m/s] corner_rate[rad/s]");
}

int64_t rthyb_part_state_bytes(const rthyb_part_setup *setup)
{
    (void)setup;
    return sizeof(corner);
}

int32_t rthyb_part_init(void *state, const rthyb_part_setup *setup)
{
    corner *s = state;
    const double *p = setup->parameter, *k_e = setup->stiffness_n_per_m, h = setup->period_s;
    s->h = h;
    for (int i = 0; i < INTERFACES; i++) {
        s->mass[i] = p[MASS + i];
        s->damping[i] = p[DAMPING + i];
        s->stiffness[i][i] = p[STIFFNESS + i];
    }
    s->stiffness[0][1] = s->stiffness[1][0] = p[COUPLING];
    double a[INTERFACES][INTERFACES];
    for (int i = 0; i < INTERFACES; i++) {
        for (int j = 0; j < INTERFACES; j++)
            a[i][j] = 0.25 * h * h * (s->stiffness[i][j] + k_e[i * INTERFACES + j]);
        a[i][i] += s->mass[i] + 0.5 * h * s->damping[i];
    }
    const double det = a[0][0] * a[1][1] - a[0][1] * a[1][0];
    if (!(s->mass[0] > 0.0 && s->mass[1] > 0.0 && det > 0.0))
        return 1;
    s->per_step[0][0] = a[1][1] / det;
    s->per_step[1][1] = a[0][0] / det;
    s->per_step[0][1] = -a[0][1] / det;
    s->per_step[1][0] = -a[1][0] / det;
    return 0;
}

/* Only what the command needs: q, the weighted acceleration, and x + h v + h^2 q. */
int32_t rthyb_part_answer(void *state, double ag_mps2, const double *force_n, double *x_next_m)
{
    corner *s = state;
    for (int i = 0; i < INTERFACES; i++) {
        s->net[i] = -force_n[i] - s->damping[i] * s->v[i];
        for (int j = 0; j < INTERFACES; j++)
            s->net[i] -= s->stiffness[i][j] * s->x[j];
    }
    s->net[0] -= s->mass[0] * ag_mps2;
    for (int i = 0; i < INTERFACES; i++) {
        const double q = s->per_step[i][0] * s->net[0] + s->per_step[i][1] * s->net[1];
        x_next_m[i] = s->x[i] + s->h * s->v[i] + s->h * s->h * q;
    }
    return 0;
}

int32_t rthyb_part_advance(void *state)
{
    corner *s = state;
    for (int i = 0; i < INTERFACES; i++) {
        const double q = s->per_step[i][0] * s->net[0] + s->per_step[i][1] * s->net[1];
        s->x[i] += s->h * s->v[i] + s->h * s->h * q;
        s->v[i] += s->h * q;
    }
    return 0;
}

void rthyb_part_report(const void *state, double *values)
{
    const corner *s = state;
    for (int i = 0; i < INTERFACES; i++)
        values[i] = s->v[i];
}
