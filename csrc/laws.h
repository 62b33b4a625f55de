/* Force laws with history variables: friction.c and loops.c. element.c validates the parameters p and the motion
 * before calling them; s contains the history variables of the element, initially zero. */
#ifndef RTHYB_LAWS_H
#define RTHYB_LAWS_H

#include "rthyb.h"

double rthyb_stribeck_level(const double *p, double v);
double rthyb_lugre(const double *p, double *s, double v, double dt);
double rthyb_gap_friction(const double *p, double *s, double x);
double rthyb_friction_pendulum(const double *p, double *s, double x, double v);
/* A point of a law of dry friction (rthyb_is_dry_friction): velocity, force, and slope of the force there. */
typedef struct {
    double velocity, force, slope;
} rthyb_friction_point;
rthyb_friction_point rthyb_friction_at(const rthyb_element *e, double v);
/* A velocity small beside this one changes neither its force nor its slope much. */
double rthyb_friction_scale(const rthyb_element *e, double v);
/* The point at which u + g f(u) = r, with g >= 0: to `solved` of r, or what at most `most` evaluations of the law have
 * found; subtracts from *left what they cost: 2 for one exponential, 3 for two, 4 with a power. last: a point near it, or NULL. */
rthyb_friction_point rthyb_friction_for(const rthyb_element *e, double r, double g,
                                        const rthyb_friction_point *last, double solved, int most,
                                        int *left);

/* Asymptotic value of the hysteretic variable of Eqn 4.2: A = (B + C) |z|^eta; an element has it behind its
 * own parameters. */
enum { RTHYB_BOUC_WEN_CEILING = RTHYB_ELEMENT_PARAMS - 1 };
double rthyb_bouc_wen_ceiling(const double *p);
double rthyb_bouc_wen(rthyb_element *e, double x);
double rthyb_iwan(const double *p, double *s, double x);
double rthyb_menegotto_pinto(const double *p, double *s, double x);
double rthyb_chaboche(const double *p, double *s, double x);
double rthyb_rc_column(const double *p, double *s, double x);
double rthyb_peak_oriented(const double *p, double *s, double x);
double rthyb_nonlinear_maxwell(const double *p, double *s, double x, double dt);
double rthyb_takeda(const double *p, double *s, double x);

#endif
