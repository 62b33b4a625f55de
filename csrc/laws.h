/* Force laws with a memory, one element each: friction.c and loops.c. element.c checks parameters p and
 * motion before it calls them; s is the element's history, which begins with zeros. */
#ifndef RTHYB_LAWS_H
#define RTHYB_LAWS_H

#include "rthyb.h"

double rthyb_stribeck_level(const double *p, double v);
double rthyb_lugre(const double *p, double *s, double v, double dt);
double rthyb_gap_friction(const double *p, double *s, double x);
double rthyb_friction_pendulum(const double *p, double *s, double x, double v);

/* Where the hysteretic variable of Eqn 4.2 comes to rest: A = (B + C) |z|^eta. */
double rthyb_bouc_wen_ceiling(const double *p);
double rthyb_bouc_wen(rthyb_element *e, double x);
double rthyb_iwan(const double *p, double *s, double x);
double rthyb_menegotto_pinto(const double *p, double *s, double x);
double rthyb_chaboche(const double *p, double *s, double x);
double rthyb_rc_column(const double *p, double *s, double x);

#endif
