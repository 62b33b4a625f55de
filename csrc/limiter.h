/* Limits the commands of a group of axes: velocity, acceleration, position. */
#ifndef RTHYB_LIMITER_H
#define RTHYB_LIMITER_H

#include "rthyb.h"

#define COMMAND_MAX_M (1e2 * RTHYB_DISPLACEMENT_MAX_M)

void limiter_rest(rthyb_limiter *limiter, double x_m);
/* Limits the wanted command of the only axis. */
double limiter_single_command(rthyb_controller *c, double wanted);
/* Limits the wanted commands of n axes. */
void limiter_commands(int n, rthyb_controller *c, const double *wanted, double *command);
/* Stores the command sent in this tick; if it cannot be sent after all, limiter_stayed undoes this. blind: nothing is
 * sent. */
void limiter_note(rthyb_limiter *limiter, double x_cmd, int blind);
/* Undoes limiter_note: the limiter continues from the last command sent and its step. */
void limiter_stayed(rthyb_limiter *limiter);

#endif
