/* Force laws with history variables: friction.c and loops.c. element.c validates the parameters p and the motion
 * before calling them; s contains the history variables of the element, initially zero. */
#ifndef RTHYB_LAWS_H
#define RTHYB_LAWS_H

#include "rthyb.h"

double rthyb_stribeck_level(const double *p, double v);
double rthyb_lugre(const double *p, double *s, double v, double dt);
double rthyb_gap_friction(const double *p, double *s, double x);
double rthyb_friction_pendulum(const double *p, double *s, double x, double v);
/* Force f of dry friction (rthyb_is_dry_friction) whose velocity u depends on it: u + g f(u) = r, with g >= 0. */
double rthyb_friction_for(const rthyb_element *e, double r, double g);

/* Asymptotic value of the hysteretic variable of Eqn 4.2: A = (B + C) |z|^eta. */
double rthyb_bouc_wen_ceiling(const double *p);
double rthyb_bouc_wen(rthyb_element *e, double x);
double rthyb_iwan(const double *p, double *s, double x);
double rthyb_menegotto_pinto(const double *p, double *s, double x);
double rthyb_chaboche(const double *p, double *s, double x);
double rthyb_rc_column(const double *p, double *s, double x);

#endif
