/* Common part of the laws that compensate with derivatives of the command,
 *   x_p = a0 x_c + a1 x_c' + a2 x_c'' + ...
 * by backward differences, and identify the coefficients from the derivatives of the measured displacement. */
#ifndef RTHYB_DERIVATIVE_LEAD_H
#define RTHYB_DERIVATIVE_LEAD_H

#include "control_law.h"

#define RTHYB_DERIVATIVES 4 /* largest number of terms, including the signal itself */

/* Backward differences of a signal at the previous sample. */
typedef struct {
    double d[RTHYB_DERIVATIVES];
} rthyb_differences;

static inline void rthyb_differences_rest(rthyb_differences *before, double x)
{
    *before = (rthyb_differences){{x}};
}

/* Computes x and its first `terms` - 1 derivatives, and stores them as the previous ones. */
static inline void rthyb_differences_step(rthyb_differences *before, int terms, double h, double x,
                                          double *out)
{
    out[0] = x;
    for (int i = 1; i < terms; i++)
        out[i] = (out[i - 1] - before->d[i - 1]) / h;
    for (int i = 0; i < terms; i++)
        before->d[i] = out[i];
}

typedef struct {
    double learnt[RTHYB_DERIVATIVES]; /* identified coefficients, in s^i */
    double used[RTHYB_DERIVATIVES];   /* coefficients in effect in the command */
    double offset;                    /* see rthyb_fade */
    rthyb_differences before;         /* of the command */
    double h;
    int32_t terms;
    double alpha, beta; /* reported: a1 in samples, a2 in samples squared */
} rthyb_derivative_lead;

static inline void rthyb_derivative_note(rthyb_derivative_lead *s)
{
    s->alpha = s->used[1] / s->h;
    s->beta = s->used[2] / s->h / s->h;
}

static inline void rthyb_derivative_rest(rthyb_derivative_lead *s, double x)
{
    rthyb_differences_rest(&s->before, x);
    s->offset = (1.0 - s->used[0]) * x;
}

static inline void rthyb_derivative_init(rthyb_derivative_lead *s, int terms, double h,
                                         const double *first, double x)
{
    *s = (rthyb_derivative_lead){.h = h, .terms = terms};
    for (int i = 0; i < terms; i++)
        s->learnt[i] = s->used[i] = first[i];
    rthyb_derivative_rest(s, x);
    rthyb_derivative_note(s);
}

/* Implements the member `lead` of a law. */
static inline int rthyb_derivative_step(rthyb_derivative_lead *s, double x_c_m, double allowed_m,
                                        double *x_p_m)
{
    int code = RTHYB_OK;
    double terms[RTHYB_DERIVATIVES], effect = 0.0, led = 0.0;
    const double x1 = s->before.d[0];
    const double x = accept(x_c_m, RTHYB_DISPLACEMENT_MAX_M, x1, &code);
    rthyb_differences_step(&s->before, s->terms, s->h, x, terms);
    for (int i = 0; i < s->terms; i++)
        effect += fabs((s->learnt[i] - s->used[i]) * terms[i]);
    const double share = rthyb_allowed_share(effect, allowed_m);
    for (int i = 0; i < s->terms; i++) {
        s->used[i] += share * (s->learnt[i] - s->used[i]);
        led += s->used[i] * terms[i];
    }
    led += rthyb_fade(&s->offset, s->used[0], x - x1);
    rthyb_derivative_note(s);
    *x_p_m = led;
    return code;
}

#endif
