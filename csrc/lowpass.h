/* Butterworth low-pass filters of even order: second-order sections by the bilinear transform, prewarped to keep the
 * cut-off frequency exact. */
#ifndef RTHYB_LOWPASS_H
#define RTHYB_LOWPASS_H

#include "numeric.h"

/* damping: 2 zeta of the section's pole pair; a single section with sqrt(2) is the second-order filter. */
static inline rthyb_lowpass lowpass_design(double cutoff_hz, double period_s, double damping)
{
    const double k = tan(RTHYB_PI * cutoff_hz * period_s);
    const double norm = 1.0 / (1.0 + damping * k + k * k);
    rthyb_lowpass f = {.b0 = k * k * norm, .b1 = 2.0 * k * k * norm, .b2 = k * k * norm};
    f.a1 = 2.0 * (k * k - 1.0) * norm;
    f.a2 = (1.0 - damping * k + k * k) * norm;
    return f;
}

/* Transposed direct form II. */
static inline double lowpass_step(const rthyb_lowpass *f, double *s, double x)
{
    const double y = f->b0 * x + s[0];
    s[0] = f->b1 * x - f->a1 * y + s[1];
    s[1] = f->b2 * x - f->a2 * y;
    return y;
}

static inline void lowpass_rest(const rthyb_lowpass *f, double *s, double x0)
{
    s[1] = (f->b2 - f->a2) * x0;
    s[0] = (f->b1 - f->a1) * x0 + s[1];
}

/* All n sections of a filter of order 2 n; pole pair i is at an angle of pi (2 i + 1) / (4 n) from the imaginary
 * axis. */
static inline void butterworth_design(rthyb_lowpass *sections, int n, double cutoff_hz,
                                      double period_s)
{
    for (int i = 0; i < n; i++) {
        const double angle = RTHYB_PI * (2.0 * i + 1.0) / (4.0 * n);
        sections[i] = lowpass_design(cutoff_hz, period_s, 2.0 * sin(angle));
    }
}

static inline double butterworth_step(const rthyb_lowpass *sections, int n, double (*s)[2],
                                      double x)
{
    for (int i = 0; i < n; i++)
        x = lowpass_step(&sections[i], s[i], x);
    return x;
}

static inline void butterworth_rest(const rthyb_lowpass *sections, int n, double (*s)[2], double x0)
{
    for (int i = 0; i < n; i++)
        lowpass_rest(&sections[i], s[i], x0);
}

#endif
