/* Common part of the laws that compensate with four equally spaced samples of the command,
 *   x_p = th0 x_c[n] + th1 x_c[n-d] + th2 x_c[n-2d] + th3 x_c[n-3d],
 * and identify the th from the same samples of the low-pass filtered measurement, by a recursion of the form
 *   K = P phi / (r + phi' P phi),   th += K (p - th' phi),   P = P - K phi' P + Q:
 * recursive least squares with r = 1 and Q = 0, or a Kalman filter for a random walk of th. */
#ifndef RTHYB_FIR_LEAD_H
#define RTHYB_FIR_LEAD_H

#include "filter_pair.h"

#define RTHYB_TAPS 4
#define RTHYB_FIR_SECTIONS 2   /* sections of the low-pass filter: fourth order */
#define RTHYB_FIR_HISTORY 256u /* samples */

typedef struct {
    double x[RTHYB_FIR_HISTORY];
    uint32_t at; /* index of the newest sample */
} rthyb_fir_line;

typedef struct {
    rthyb_filter_pair pair;
    double learnt[RTHYB_TAPS]; /* identified th */
    double used[RTHYB_TAPS];   /* th in effect in the command */
    double p[RTHYB_TAPS][RTHYB_TAPS];
    double noise2, walk2, p_max; /* r; Q of each th; upper bound of P */
    double most;                 /* upper bound of |th| */
    double offset, h;
    rthyb_fir_line x, m; /* history of the command, and of the filtered x_m */
    uint32_t apart;      /* d, samples */
    double alpha;        /* reported: compensated delay in samples */
} rthyb_fir_lead;

/* Settings of all such laws. The initial P has three variances: of the sum of th, of the direction of the delay, and
 * of the two remaining directions, all along the discrete orthogonal polynomials of four points. */
typedef struct {
    double delay_s, apart_s, cutoff_hz, most;
    double p_sum, p_delay, p_rest;
    double noise2, walk2;
} rthyb_fir_settings;

int rthyb_fir_init(rthyb_fir_lead *s, const rthyb_fir_settings *given,
                   const rthyb_law_start *start);
/* Index of the setting to change: 1 the cut-off, 2 the spacing; or -1. */
int rthyb_fir_check(double cutoff_hz, double apart_s, double period_s,
                    rthyb_law_complaint *complaint);
void rthyb_fir_rest(rthyb_fir_lead *s, double x_m);
int rthyb_fir_observe(rthyb_fir_lead *s, double x_p_m, double x_m_m, int frozen);
int rthyb_fir_step(rthyb_fir_lead *s, double x_c_m, double allowed_m, double *x_p_m);

#define RTHYB_FIR_VALUES(state)                                                                    \
    {                                                                                              \
        {"alpha", "samples", "lead", offsetof(state, fir.alpha)},                                  \
            {"th0", "", "th0", offsetof(state, fir.used[0])},                                      \
            {"th1", "", "th1", offsetof(state, fir.used[1])},                                      \
            {"th2", "", "th2", offsetof(state, fir.used[2])},                                      \
        {                                                                                          \
            "th3", "", "th3", offsetof(state, fir.used[3])                                         \
        }                                                                                          \
    }

#endif
