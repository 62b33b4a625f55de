/* Common part of the laws inverse and gain-alpha-beta: the phase lead of Eqn 2.5 with a gain in addition to delay and
 * curvature, and both poles of its roll-off at one frequency. The three quantities are estimated by recursive least
 * squares. In the law inverse, an inverse of the identified response of the rig follows. */
#ifndef RTHYB_GAIN_LEAD_H
#define RTHYB_GAIN_LEAD_H

#include "control_law.h"

#define LEAD_TERMS 3    /* gain, delay, curvature */
#define INVERSE_ORDER 5 /* of the fitted inverse, numerator and denominator */

/* C(z) = 1 + sum of b_j ((1 - 1/z) / h)^j / (1 + r (1 - 1/z))^5, r = rho / (1 - rho), j from 0. With the
 * gain 1 + b0 separated, the rest acts on differences only, so that the output at rest is exact:
 *   C(z) = 1 + b0 + sum of c_j (1 - 1/z)^j / (...)^5, j from 1,  c_j = b_j / h^j - b0 (5 over j) r^j. */
typedef struct {
    double gain, rho;
    double c[INVERSE_ORDER]; /* c_1 to c_5, times (1 - rho)^5 */
    /* x[n-1], and its differences of order 0 to 4 at the previous sample */
    double x1, past[INVERSE_ORDER];
    double pole[INVERSE_ORDER]; /* states of the denominator */
} rthyb_inverse;

typedef struct {
    double h, w1, w2, s; /* s = w1 + w2 + 1 */
    double first[LEAD_TERMS], low[LEAD_TERMS], high[LEAD_TERMS];
    /* estimates: gain - 1, delay in samples, curvature in samples squared */
    double learnt[LEAD_TERMS];
    double used[LEAD_TERMS];    /* the values in effect in the command */
    double x1, x2, e1, e2;      /* x_c[n-1], x_c[n-2], lead - x_c */
    double offset;              /* see rthyb_fade */
    double last_p, last_m;      /* last valid inputs */
    rthyb_inverse inverse, rig; /* applied to the command; its inverse: the identified rig */
    /* Filter pair */
    rthyb_lowpass filter;
    double filter_p[2], filter_m[2], level_p, level_m, level_weight, least_weight;
    double p1, p2, m1, m2;
    /* Least squares: upper triangle row by row, right-hand side, and the contribution of the rest noise to both */
    double r[6], q[LEAD_TERMS], noise_r[6], noise_q[LEAD_TERMS], ridge[LEAD_TERMS];
    double weight, forget, short_power, gate_power;
    double led_first;                     /* delay compensated by the inverse, samples */
    double delay, gain, shift, curvature; /* reported */
} rthyb_gain_lead;

/* One table per law, because its keys begin with its name. clang-format off */
#define GAIN_LEAD_PARAMETERS(table, delay_least, roll_off_hz, roll_off_key)                         \
    {table ".roll_off_hz",       "Hz", 1.0,          400.0,           roll_off_hz,                  \
     "the roll-off of the lead", 0,    roll_off_key, "roll-off {} Hz"},                             \
        {table ".cutoff_hz",                                                                        \
         "Hz",                                                                                      \
         0.5,                                                                                       \
         400.0,                                                                                     \
         10.0,                                                                                      \
         "the cut-off of the filter pair",                                                          \
         0,                                                                                         \
         NULL,                                                                                      \
         NULL},                                                                                     \
        {table ".gate_factor",                                                                      \
         "",                                                                                        \
         0.0,                                                                                       \
         1e6,                                                                                       \
         10.0,                                                                                      \
         "the ratio of power to noise at rest that opens the gate",                                 \
         0,                                                                                         \
         NULL,                                                                                      \
         NULL},                                                                                     \
        {table ".memory_s", "s", 0.05, 600.0, 1.0, "the memory of the estimator", 0, NULL,          \
         "memory {} s"},                                                                            \
        {table ".gain_sigma",                                                                       \
         "",                                                                                        \
         0.0,                                                                                       \
         10.0,                                                                                      \
         0.05,                                                                                      \
         "the standard deviation of the gain from its initial value",                               \
         RTHYB_OPEN_LOW,                                                                            \
         NULL,                                                                                      \
         NULL},                                                                                     \
        {table ".delay_sigma_s",                                                                    \
         "s",                                                                                       \
         0.0,                                                                                       \
         1.0,                                                                                       \
         0.00390625,                                                                                \
         "the standard deviation of the delay from its initial value",                              \
         RTHYB_OPEN_LOW,                                                                            \
         NULL,                                                                                      \
         NULL},                                                                                     \
        {table ".curvature_sigma_s2",                                                               \
         "s^2",                                                                                     \
         0.0,                                                                                       \
         1.0,                                                                                       \
         1.52587890625e-5,                                                                          \
         "the standard deviation of the curvature term from its initial value",                     \
         RTHYB_OPEN_LOW,                                                                            \
         NULL,                                                                                      \
         NULL},                                                                                     \
        {table ".gain_most", "", 0.0, 0.9, 0.3, "the largest change of the gain", 0, NULL, NULL},   \
        {table ".delay_least_s", "s", -1.0, 1.0, delay_least, "the smallest delay", 0, NULL, NULL}, \
    {                                                                                               \
        table ".delay_most_s", "s", 0.0, 1.0, 0.05859375, "the largest delay", RTHYB_OPEN_LOW,      \
            NULL, NULL                                                                              \
    }
/* clang-format on */

enum {
    GAIN_LEAD_ROLL_OFF,
    GAIN_LEAD_CUTOFF,
    GAIN_LEAD_GATE,
    GAIN_LEAD_MEMORY,
    GAIN_LEAD_SIGMA, /* of the gain; followed by those of delay and curvature */
    GAIN_LEAD_SIGMA_DELAY,
    GAIN_LEAD_SIGMA_CURVATURE,
    GAIN_LEAD_GAIN_MOST,
    GAIN_LEAD_LEAST,
    GAIN_LEAD_MOST,
    GAIN_LEAD_OWN /* first parameter specific to a law */
};

/* p: the first of the table's ten parameters. */
int rthyb_gain_lead_check(const double *p, double period_s, rthyb_law_complaint *why);
/* b: coefficients b0 to b5 of the inverse, b_j in s^j; NULL: no inverse, C = 1. inverse_roll_off_hz: frequency of its
 * poles. first: initial gain - 1, delay in s, curvature in s^2. */
int rthyb_gain_lead_init(rthyb_gain_lead *s, const double *p, const double *first, const double *b,
                         double inverse_roll_off_hz, const rthyb_law_start *start);
/* Whether all zeros of the inverse, which are the poles of the identified rig, lie inside the unit circle. */
int rthyb_inverse_is_stable(const double *b, double roll_off_hz, double period_s);
void rthyb_gain_lead_rest(void *state, double x_m);
int rthyb_gain_lead_observe(void *state, double x_p_m, double x_m_m, int frozen);
int rthyb_gain_lead_lead(void *state, double x_c_m, double allowed_m, double *x_p_m);

#endif
