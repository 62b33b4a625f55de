/* The kernels of the paper: phase lead (plc.c), delay estimator (delay_estimator.c) and
 * restoring-force compensator (rfc.c). */
#ifndef RTHYB_PART_KERNELS_H
#define RTHYB_PART_KERNELS_H

#include <stddef.h>
#include <stdint.h>

#include "rthyb_record.h"

/* cffi: begin */

/* ---- phase-lead compensator (plc.c) --------------------------------------------------------- */

typedef struct {
    double w1, w2;
    double x1, x2;      /* x_c[n-1], x_c[n-2] */
    double y1, y2;      /* x_p[n-1], x_p[n-2] */
    double alpha, beta; /* last good values */
} rthyb_plc;

/* 1 if the poles of Eqn 2.5 lie inside the unit circle (Fig. 2.1), else 0. */
int rthyb_plc_is_stable(double w1, double w2);
int rthyb_plc_init(rthyb_plc *plc, double w1, double w2, double x0_m);
int rthyb_plc_step(rthyb_plc *plc, double alpha, double beta, double x_c_m, double *x_p_m);
int rthyb_plc_run(rthyb_plc *plc, const double *alpha, const double *beta, const double *x_c_m,
                  double *x_p_m, size_t n);

/* ---- delay estimator (delay_estimator.c) ---------------------------------------------------- */

enum rthyb_estimator_law {
    RTHYB_LAW_FIXED,    /* alpha and beta keep their initial values */
    RTHYB_LAW_GRADIENT, /* Eqn 2.6-2.11 as printed */
    RTHYB_LAW_ROBUST,   /* the same with filter pair, gate, projection, normalisation by power */
    RTHYB_LAW_RLS       /* recursive least squares of alpha, or of alpha and beta */
};

typedef struct {
    int32_t law;           /* enum rthyb_estimator_law */
    int32_t estimate_beta; /* RLS only */
    double alpha0, beta0;
    double period_s;
    double reference_m;    /* unit of mu and phi in the normalisation 1 + phi^2: the paper's 1 mm */
    double gain;           /* gradient: per reference^2 per sample; robust: per sample */
    double memory_samples; /* RLS: number of samples in which the weight of a sample falls to 1/e */
    double cutoff_hz;      /* filter pair of robust and RLS */
    double alpha_min, alpha_max;
    double rest_noise_m; /* standard deviation of x_m measured at rest */
    /* adapt only while the power of phi exceeds this multiple of its power at rest */
    double gate_factor;
} rthyb_estimator_config;

typedef struct {
    double b0, b1, b2, a1, a2;
} rthyb_lowpass;

typedef struct {
    rthyb_estimator_config cfg;
    double w1, w2; /* of the compensator that uses the estimate */
    rthyb_lowpass filter;
    double unit;                     /* 1 / reference_m */
    double filter_p[2], filter_m[2]; /* states of the pair: low-pass */
    double level_p, level_m;         /* offsets that the pair subtracts */
    double level_weight;             /* weight of a sample in the offsets; 1 before the first */
    double p1, p2, m1, m2;           /* x_p[n-1], x_p[n-2], x_m[n-1], x_m[n-2], filtered */
    double last_p, last_m;           /* last good inputs */
    double alpha, beta;
    double power;                     /* mean phi^2 over about 2 s */
    double short_power;               /* mean phi^2 over 0.2 s, for the gate */
    double gate_power;                /* what short_power must exceed */
    double forget;                    /* RLS: lambda */
    double r11, r12, r22, q1, q2;     /* RLS: weighted normal equations */
    double noise11, noise12, noise22; /* RLS: contribution of the noise at rest per sample */
    double noise1, noise2;
    double weight;         /* RLS: sum of weights */
    double ridge1, ridge2; /* RLS: weights of the initial values */
    int32_t open;          /* state of the gate, for the record */
} rthyb_estimator;

int rthyb_estimator_init(rthyb_estimator *est, const rthyb_estimator_config *cfg, double w1,
                         double w2, double x0_m);
/* If frozen != 0, the pair is stored but alpha and beta are not changed. */
int rthyb_estimator_step(rthyb_estimator *est, double x_p_m, double x_m_m, int frozen);
int rthyb_estimator_run(rthyb_estimator *est, const double *x_p_m, const double *x_m_m,
                        double *alpha, double *beta, size_t n);

/* ---- restoring-force compensator (rfc.c) ---------------------------------------------------- */

enum rthyb_tangent {
    RTHYB_TANGENT_MEAN_OF_RATIOS, /* Eqn 3.3 */
    RTHYB_TANGENT_LEAST_SQUARES   /* slope of f over x_m in the same window */
};

enum rthyb_divisor {
    RTHYB_DIVISOR_PRINTED, /* T0 + 1 terms divided by T0, as printed in Eqn 3.3 */
    RTHYB_DIVISOR_TERMS    /* divided by the number of terms */
};

typedef struct {
    int32_t enabled;
    int32_t tangent;     /* enum rthyb_tangent */
    int32_t divisor;     /* enum rthyb_divisor; mean of ratios only */
    int32_t window;      /* T0, samples */
    double k_e_n_per_m;  /* elastic stiffness, upper bound */
    uint64_t end_tick;   /* t_ex: from this tick on, k_exp = k_e again (stage 3) */
    double rest_noise_m; /* least squares: k is held while the motion of x_m is within this noise */
    double period_s;     /* sample period; used by the low-pass filter only */
    double cutoff_hz;    /* of the low-pass filter on x_c - x_m; 0: no filter */
    double lateness_s;   /* delay of the force used, relative to x_m */
} rthyb_rfc_config;

typedef struct {
    rthyb_rfc_config cfg;
    uint64_t tick;
    uint32_t head, filled; /* next sample to be overwritten; samples in the window */
    double k_n_per_m;      /* bounded k_exp[n] */
    double ratio;          /* last term of Eqn 3.3 */
    double x1, f1, c1, v1; /* last good inputs */
    rthyb_lowpass filter;
    double filter_s[2];
    double x[RTHYB_WINDOW_MAX]; /* the T0 samples before the newest: x_m, or ratios (Eqn 3.3) */
    double f[RTHYB_WINDOW_MAX];
} rthyb_rfc;

int rthyb_rfc_init(rthyb_rfc *rfc, const rthyb_rfc_config *cfg, double x0_m, double f0_n);
/* force_n = f + k_exp (LP(x_c - x_m) + lateness v_c), the force in the equation of motion. v_c is used only
 * if lateness is not 0. If frozen != 0, k_exp is held. */
int rthyb_rfc_step(rthyb_rfc *rfc, double x_c_m, double v_c_m_per_s, double x_m_m, double f_n,
                   int frozen, double *force_n);
/* Stores a sample of a motion along a path without adapting k_exp. */
void rthyb_rfc_follow(rthyb_rfc *rfc, double x_c_m, double x_m_m, double f_n);
/* v_c may be NULL, which means 0. */
int rthyb_rfc_run(rthyb_rfc *rfc, const double *x_c_m, const double *v_c_m_per_s,
                  const double *x_m_m, const double *f_n, double *force_n, double *k_n_per_m,
                  size_t n);
/* cffi: end */

#endif
