/* Where the commands of a group of axes end: velocity, acceleration, position. */
#ifndef RTHYB_LIMITER_H
#define RTHYB_LIMITER_H

#include "rthyb.h"

#define COMMAND_MAX_M (1e2 * RTHYB_DISPLACEMENT_MAX_M)

void limiter_rest(rthyb_limiter *limiter, double x_m);
/* What leaves of what is wanted, one of each axis. */
void limiter_commands(rthyb_controller *c, const double *wanted, double *command);
/* What leaves in this tick, unless it finds no room: then limiter_stayed takes it back. blind: nothing does. */
void limiter_note(rthyb_limiter *limiter, double x_cmd, int blind);
/* It goes on from the command that left last, and from the step that led to it. */
void limiter_stayed(rthyb_limiter *limiter);

#endif
