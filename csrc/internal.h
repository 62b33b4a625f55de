/* Declarations shared by the files of the core, not part of its interface. */
#ifndef RTHYB_INTERNAL_H
#define RTHYB_INTERNAL_H

#include <math.h>

#include "limiter.h"

/* One sample. path_m: the next displacement of each interface if a path, not the equation of motion, determines it;
 * laws, RFC and monitors are then inactive. blind: a skipped tick that is processed later; nothing is sent, and the
 * previous command remains in effect at the drive. */
int rthyb_controller_sample(rthyb_controller *c, const rthyb_input *in, const double *path_m,
                            int blind, rthyb_record *record);

/* Sets the controller at rest with the axes at x_m, regardless of earlier commands, even if no pose of the specimen
 * corresponds to x_m. */
void rthyb_controller_rest(rthyb_controller *c, const double *x_m);
/* Whether a pose of the specimen corresponds to x_m. */
int rthyb_controller_has_pose(const rthyb_controller *c, const double *x_m);
/* Pose, and forces in interface coordinates, for given positions and forces of the axes, and readings of the sensors
 * without an actuator; 0 if there is no pose. */
int rthyb_controller_meets(const rthyb_controller *c, const double *x_m, const double *f_n,
                           const double *sensor, double *pose, double *force);
/* Value that the control law of an axis reports as alpha (term 1) or beta (term 2). */
double rthyb_controller_lead(const rthyb_controller *c, int axis, int term);
/* Diagonal entry of the tangent stiffness for an interface. */
double rthyb_controller_stiffness(const rthyb_controller *c, int interface);

/* Whether the controller's own equation of motion, not a part provided by the caller, computes the next displacement.
 * A prescribed motion has no equation of motion, whatever the part. */
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

/* Conversion of readings and commands between wire and structure. The station only uses calibrated values, in a live
 * test as well as in a replay. */
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

/* Value for the wire, chosen so that rounding on the wire does not exceed the station's bounds. NaN if the wire cannot
 * represent any value between them. */
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

/* After rthyb_wire_take: whether a pair was new in this tick. */
int rthyb_wire_is_new(const rthyb_wire *wire);

/* Stores the command in effect at the drive of an axis in the next tick: the value on the wire exactly as rounded, or
 * the previous one if none was sent. */
static inline void note_command(rthyb_station *s, int axis, const rthyb_calibration *c, int sent,
                                double wire_m)
{
    rthyb_controller_axis *a = &s->controller.axis[axis];
    a->x_cmd = sent ? command_from_wire(c, wire_m) - s->axis[axis].tare_cmd : a->x_cmd1;
    if (!sent)
        limiter_stayed(&a->limiter);
}

/* Stores in a record the pair of an axis as received by the station, or the reason why there was none. With one axis,
 * a flag of the row indicates that nothing was received. With several axes, the readings of the axis themselves must
 * indicate it: displacement NaN and force NaN or 0. If a displacement was received as NaN, its force is kept, except
 * that a force of 0 is stored as NaN. */
static inline void note_pair(rthyb_axis_record *record, double x_m, double f_n, int32_t lost,
                             int axis_count)
{
    const int looks_lost = axis_count > 1 && isnan(x_m) && f_n == 0.0;
    const double none = lost & RTHYB_S_NOT_FINITE || !lost ? (double)NAN : 0.0;
    record->x_read_m = lost ? (axis_count > 1 ? (double)NAN : none) : x_m;
    record->f_read_n = lost || looks_lost ? none : f_n;
}

/* Flags for a command that was not sent; with several axes, also of which axis. */
#define UNSENT_FLAGS ((uint32_t)RTHYB_F_NOT_SENT | (uint32_t)15 << RTHYB_F_UNSENT_BIT)

static inline uint32_t unsent_flag(int axis, int axis_count)
{
    return (uint32_t)RTHYB_F_NOT_SENT |
           (axis_count > 1 ? (uint32_t)1 << (RTHYB_F_UNSENT_BIT + axis) : 0u);
}

/* Size of a row with this number of axes. */
static inline size_t record_bytes(int32_t axis_count)
{
    return ((size_t)RTHYB_TEST_WORDS + (size_t)axis_count * RTHYB_AXIS_WORDS) * sizeof(uint64_t);
}

static inline rthyb_record *row_at(void *rows, int32_t axis_count, size_t n)
{
    return (rthyb_record *)(void *)((char *)rows + n * record_bytes(axis_count));
}

/* Next target of a drive that brakes on its own, computed from its last two targets; unchanged once it is at rest. */
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

/* System usage of the calling thread since `before`. */
void rthyb_usage_since(rthyb_usage *usage, const rthyb_usage *before);

int rthyb_servo_init(rthyb_servo *servo, const rthyb_servo_config *cfg);

/* State of the table at t_n, before x_p[n] is applied (pure delay: after). */
int rthyb_servo_latch(rthyb_servo *servo, double x_p_m);

/* Advances to t_{n+1}. Of these actuators, only the servo-hydraulic one is affected by the specimen. Status bits report
 * a computation that diverged. */
int rthyb_servo_advance(rthyb_servo *servo, rthyb_element *elements, uint32_t element_count);

/* Servo-hydraulic: command at the beginning of a sample, and its increment per substep. */
void rthyb_servo_run_up(const rthyb_servo *servo, double *start, double *rise);

/* Bounds the state, so that an unstable virtual rig stops at its bounds instead of producing infinite values. */
int rthyb_servo_confine(rthyb_servo *servo);

/* servo_valve.c: initialisation, and one sample. */
int rthyb_valve_init(rthyb_servo *servo);
void rthyb_valve_advance(rthyb_servo *servo, rthyb_element *elements, uint32_t element_count);

double rthyb_specimen_force(rthyb_element *elements, uint32_t element_count, double x, double v,
                            double a, double dt);

#endif
