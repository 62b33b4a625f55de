/* What the files of the core share with one another and nobody else sees. */
#ifndef RTHYB_INTERNAL_H
#define RTHYB_INTERNAL_H

#include "rthyb.h"

/* One sample. path_m: the next displacement where it does not come from the equation of motion;
 * estimator, RFC and monitors then stand still. blind: a skipped tick made up for, nothing is sent
 * and the drive still has the command of before. */
int rthyb_controller_sample(rthyb_controller *c, const rthyb_input *in, const double *path_m,
                            int blind, rthyb_record *record);

/* What the calling thread has used since `before`. */
void rthyb_usage_since(rthyb_usage *usage, const rthyb_usage *before);

int rthyb_servo_init(rthyb_servo *servo, const rthyb_servo_config *cfg);

/* The table at t_n, before x_p[n] is applied (pure delay: with it). */
int rthyb_servo_latch(rthyb_servo *servo, double x_p_m);

/* Moves on to t_{n+1}. Only the servo-hydraulic actuator feels the specimen. Status bits tell of a
 * computation that has run off. */
int rthyb_servo_advance(rthyb_servo *servo, rthyb_element *elements, uint32_t element_count);

double rthyb_specimen_force(rthyb_element *elements, uint32_t element_count, double x, double v,
                            double a, double dt);

#endif
