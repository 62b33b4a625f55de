/* What the files of the core share with one another and nobody else sees. */
#ifndef RTHYB_INTERNAL_H
#define RTHYB_INTERNAL_H

#include <math.h>

#include "limiter.h"

/* One sample. path_m: the next displacement of each interface where it does not come from the equation of
 * motion; laws, RFC and monitors then stand still. blind: a skipped tick made up for, nothing is sent
 * and the drive still has the command of before. */
int rthyb_controller_sample(rthyb_controller *c, const rthyb_input *in, const double *path_m,
                            int blind, rthyb_record *record);

/* At rest with each axis where x_m says, wherever the drives were told to be before; also where these are no
 * pose of the specimen. */
void rthyb_controller_rest(rthyb_controller *c, const double *x_m);
/* Whether the specimen has a pose with its axes there. */
int rthyb_controller_has_pose(const rthyb_controller *c, const double *x_m);
/* Pose and forces along the interfaces with the axes there and such forces; 0 if there is no pose. */
int rthyb_controller_meets(const rthyb_controller *c, const double *x_m, const double *f_n,
                           double *pose, double *force);
/* What the lead of an axis reports as alpha (term 1) or beta (term 2). */
double rthyb_controller_lead(const rthyb_controller *c, int axis, int term);
/* The tangent stiffness of an interface in its own direction. */
double rthyb_controller_stiffness(const rthyb_controller *c, int interface);

/* Whether the controller's own equation of motion computes the next displacement, and not a part of the
 * caller's. A prescribed motion has no equation, whatever the part. */
static inline int has_own_part(const rthyb_controller *c)
{
    return c->cfg.numerical.kind == RTHYB_NUMERICAL_MOTION ||
           c->cfg.motion.integrator == RTHYB_PRESCRIBED;
}

static inline rthyb_numerical part_of(rthyb_controller *c)
{
    return has_own_part(c) ? (rthyb_numerical){.kind = RTHYB_NUMERICAL_MOTION,
                                               .cfg = &c->cfg.motion,
                                               .state = &c->motion}
                           : c->cfg.numerical;
}

/* Readings in the structure's own numbers, and the way of a command to the wire and back. The station
 * sees nothing else, live or replayed. */
static inline double calibrated_x(const rthyb_calibration *c, double wire_m)
{
    return c->x_gain * wire_m + c->x_offset_m;
}

static inline double calibrated_f(const rthyb_calibration *c, double wire_n)
{
    return c->f_gain * wire_n + c->f_offset_n;
}

static inline double command_to_wire(const rthyb_calibration *c, double x_m)
{
    return c->cmd_gain * x_m + c->cmd_offset_m;
}

/* What goes to the wire: never what its rounding would take beyond the station's bounds. NaN where the
 * wire has nothing between them. */
static inline double command_for_wire(const rthyb_codec *codec, const rthyb_calibration *c,
                                      const rthyb_axis_output *out)
{
    const double one = command_to_wire(c, out->low_m), other = command_to_wire(c, out->high_m);
    const int turned = one > other;
    return rthyb_command_within(codec, command_to_wire(c, out->x_cmd_m), turned ? other : one,
                                turned ? one : other);
}

static inline double command_from_wire(const rthyb_calibration *c, double wire_m)
{
    return (wire_m - c->cmd_offset_m) / c->cmd_gain;
}

/* Tells the station which displacement the drive of an axis has for the next tick: the one on the wire, to its
 * last digit, or the one before where none has left. */
static inline void note_command(rthyb_station *s, int axis, const rthyb_calibration *c, int sent,
                                double wire_m)
{
    rthyb_controller_axis *a = &s->controller.axis[axis];
    a->x_cmd = sent ? command_from_wire(c, wire_m) - s->axis[axis].tare_cmd : a->x_cmd1;
    if (!sent)
        limiter_stayed(&a->limiter);
}

/* What a record says of the pair that the station was told of an axis, or of why there was none. With one axis
 * nothing came where the row is flagged, with several the row has to say of which: its displacement is no number,
 * and its force is none either, or 0. A displacement that came and is no number keeps its force, but for a 0. */
static inline void note_pair(rthyb_axis_record *record, double x_m, double f_n, int32_t lost,
                             int axis_count)
{
    const int looks_lost = axis_count > 1 && isnan(x_m) && f_n == 0.0;
    const double none = lost & RTHYB_S_NOT_FINITE || !lost ? (double)NAN : 0.0;
    record->x_read_m = lost ? (axis_count > 1 ? (double)NAN : none) : x_m;
    record->f_read_n = lost || looks_lost ? none : f_n;
}

/* That the command of an axis did not leave; with several, which one. */
#define UNSENT_FLAGS ((uint32_t)RTHYB_F_NOT_SENT | (uint32_t)15 << RTHYB_F_UNSENT_BIT)

static inline uint32_t unsent_flag(int axis, int axis_count)
{
    return (uint32_t)RTHYB_F_NOT_SENT |
           (axis_count > 1 ? (uint32_t)1 << (RTHYB_F_UNSENT_BIT + axis) : 0u);
}

/* Of a row of so many axes. */
static inline size_t record_bytes(int32_t axis_count)
{
    return ((size_t)RTHYB_TEST_WORDS + (size_t)axis_count * RTHYB_AXIS_WORDS) * sizeof(uint64_t);
}

static inline rthyb_record *row_at(void *rows, int32_t axis_count, size_t n)
{
    return (rthyb_record *)(void *)((char *)rows + n * record_bytes(axis_count));
}

/* A drive that brakes by itself, one tick: the next target from the velocity of the last two; the same
 * one once it stands. */
static inline double braked_target(double target_m, double target1_m, double decel_m_per_s2,
                                   double period_s)
{
    const double step = target_m - target1_m, less = decel_m_per_s2 * period_s * period_s;
    return fabs(step) <= less ? target_m : target_m + step - copysign(less, step);
}

/* 0 or RTHYB_E_LIMIT. */
int rthyb_watches_check(const rthyb_watch *watch, int count);
int rthyb_path_limits_check(double velocity_m_per_s, double acceleration_m_per_s2,
                            double brake_m_per_s2);

/* What the calling thread has used since `before`. */
void rthyb_usage_since(rthyb_usage *usage, const rthyb_usage *before);

int rthyb_servo_init(rthyb_servo *servo, const rthyb_servo_config *cfg);

/* The table at t_n, before x_p[n] is applied (pure delay: with it). */
int rthyb_servo_latch(rthyb_servo *servo, double x_p_m);

/* Moves on to t_{n+1}. Only the servo-hydraulic actuator feels the specimen. Status bits tell of a
 * computation that has run off. */
int rthyb_servo_advance(rthyb_servo *servo, rthyb_element *elements, uint32_t element_count);

/* Servo-hydraulic: the command at the beginning of a sample, and what it rises by in a substep. */
void rthyb_servo_run_up(const rthyb_servo *servo, double *start, double *rise);

/* A virtual rig that has gone unstable stops at its guard instead of filling with inf. */
int rthyb_servo_confine(rthyb_servo *servo);

/* servo_valve.c: set-up of its step; one sample. */
int rthyb_valve_init(rthyb_servo *servo);
void rthyb_valve_advance(rthyb_servo *servo, rthyb_element *elements, uint32_t element_count);

double rthyb_specimen_force(rthyb_element *elements, uint32_t element_count, double x, double v,
                            double a, double dt);

#endif
