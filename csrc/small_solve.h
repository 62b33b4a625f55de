/* Linear systems no larger than the number of axes; the number of operations does not depend on the data. */
#ifndef RTHYB_SMALL_SOLVE_H
#define RTHYB_SMALL_SOLVE_H

#include <math.h>

#include "rthyb_kinematics.h"

/* Solves a x = b by Gauss-Jordan elimination with partial pivoting. a (n x n) is overwritten; b (n x count) is replaced
 * by x. Returns 0 if a pivot does not exceed `least`: the matrix is singular. */
static inline int small_solve(double *a, double *b, int n, int count, double least)
{
    for (int c = 0; c < n; c++) {
        int p = c;
        for (int i = c + 1; i < n; i++)
            p = fabs(a[i * n + c]) > fabs(a[p * n + c]) ? i : p;
        if (!(fabs(a[p * n + c]) > least && isfinite(a[p * n + c])))
            return 0;
        for (int k = 0; k < n; k++) {
            const double kept = a[c * n + k];
            a[c * n + k] = a[p * n + k];
            a[p * n + k] = kept;
        }
        for (int k = 0; k < count; k++) {
            const double kept = b[c * count + k];
            b[c * count + k] = b[p * count + k];
            b[p * count + k] = kept;
        }
        for (int i = 0; i < n; i++) {
            const double f = i == c ? 0.0 : a[i * n + c] / a[c * n + c];
            for (int k = c; k < n; k++)
                a[i * n + k] -= f * a[c * n + k];
            for (int k = 0; k < count; k++)
                b[i * count + k] -= f * b[c * count + k];
        }
    }
    for (int i = 0; i < n; i++)
        for (int k = 0; k < count; k++)
            b[i * count + k] /= a[i * n + i];
    return 1;
}

#endif
