/* One substep of the servo-hydraulic actuator: the force on the table, and the table's motion for a given next
 * velocity. PI loop on the table's displacement, first-order valve, square-root load flow (natural velocity
 * feedback), oil column as spring and damper, moving mass with friction. Velocities are defined midway between
 * substeps (leapfrog); linear damping is implicit. */
#ifndef RTHYB_HYDRAULIC_H
#define RTHYB_HYDRAULIC_H

#include "numeric.h"

/* Force of the oil column without its damping of the table's velocity; the command is held over h. */
static inline double hydraulic_push(rthyb_servo *s, double command, double h, double per_stall)
{
    const rthyb_servo_config *c = &s->cfg;
    const double error = command - s->x;
    s->integral = clamp(s->integral + h * error, -1e3, 1e3);
    const double wanted = c->kp_per_s * error + c->ki_per_s2 * s->integral;
    s->valve += s->valve_gain * (wanted - s->valve);
    s->valve = clamp(s->valve, -c->flow_limit_m_per_s, c->flow_limit_m_per_s);
    const double load = copysign(per_stall, s->valve) * s->oil_force;
    s->piston_velocity = s->valve * sqrt(clamp(1.0 - load, 0.0, 2.0));

    const double spring = c->oil_stiffness_n_per_m * (s->piston - s->x);
    return spring + c->oil_damping_n_s_per_m * s->piston_velocity;
}

/* Advances the table, given its velocity in the middle of the next substep. */
static inline void hydraulic_move(rthyb_servo *s, double half_velocity, double h, double per_h)
{
    const rthyb_servo_config *c = &s->cfg;
    const double before = s->half_velocity;
    s->half_velocity = half_velocity;
    s->a = (s->half_velocity - before) * per_h;
    s->v = s->half_velocity + 0.5 * h * s->a;
    s->x += h * s->half_velocity;
    s->piston += h * s->piston_velocity;
    s->oil_force = c->oil_stiffness_n_per_m * (s->piston - s->x) +
                   c->oil_damping_n_s_per_m * (s->piston_velocity - s->v);
}

#endif
