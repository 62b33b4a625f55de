/* Solves L D L' x = b for the matrix of a structure's time step (rthyb_sparse.h).
 *
 * Elimination produces runs of columns with the same rows below them, called panels. Within a
 * panel, each row index is read once for all columns, and the values of a column are contiguous, so
 * that both passes are sums over contiguous memory. A few dozen panels contain most of a large
 * frame's factor. */
#include "factored.h"

enum {
    CHUNK = 256,     /* rows of a panel at a time, whose sums stay in the first-level cache */
    LANES = 4,       /* independent partial sums */
    FEW_COLUMNS = 3, /* narrower panels than this gain nothing */
};

static double dot(const double *restrict a, const double *restrict b, int32_t n)
{
    double sum[LANES] = {0.0};
    int32_t i = 0;
    for (; i + LANES <= n; i += LANES)
        for (int32_t l = 0; l < LANES; l++)
            sum[l] += a[i + l] * b[i + l];
    for (; i < n; i++)
        sum[0] += a[i] * b[i];
    return (sum[0] + sum[1]) + (sum[2] + sum[3]);
}

static void add_times(double by, const double *restrict a, double *restrict out, int32_t n)
{
    for (int32_t i = 0; i < n; i++)
        out[i] += by * a[i];
}

int panels_ok(const rthyb_symmetric *l, int32_t n, const int32_t *panel, int32_t panels)
{
    if (panels == 0)
        return 1;
    if (panels < 0 || !panel || panel[0] != 0 || panel[panels] != n)
        return 0;
    for (int32_t p = 0; p < panels; p++)
        if (panel[p + 1] <= panel[p] || panel[p + 1] > n)
            return 0;
    for (int32_t p = 0; p < panels; p++)
        for (int32_t j = panel[p]; j + 1 < panel[p + 1]; j++) {
            const int32_t rows = l->start[j + 1] - l->start[j];
            const int32_t *this = l->at + l->start[j], *next = l->at + l->start[j + 1];
            if (rows != l->start[j + 2] - l->start[j + 1] + 1 || this[0] != j + 1)
                return 0;
            for (int32_t k = 1; k < rows; k++)
                if (this[k] != next[k - 1])
                    return 0;
        }
    return 1;
}

static void down_columns(const rthyb_symmetric *l, int32_t first, int32_t end, double *restrict y)
{
    const int32_t *restrict start = l->start, *restrict at = l->at;
    const double *restrict value = l->value;
    for (int32_t j = first; j < end; j++) {
        const double yj = y[j];
        for (int32_t k = start[j]; k < start[j + 1]; k++)
            y[at[k]] -= value[k] * yj;
    }
}

static void up_columns(const rthyb_symmetric *l, int32_t first, int32_t end, double *restrict y)
{
    const int32_t *restrict start = l->start, *restrict at = l->at;
    const double *restrict value = l->value;
    for (int32_t j = end; j-- > first;) {
        double sum = y[j] * l->diagonal[j];
        for (int32_t k = start[j]; k < start[j + 1]; k++)
            sum -= value[k] * y[at[k]];
        y[j] = sum;
    }
}

/* Subtracts what all columns of a panel contribute to the rows at[0] ... below it, in chunks. */
static void down_panel(const rthyb_symmetric *l, int32_t first, int32_t end, double *restrict y)
{
    const int32_t rows = l->start[end] - l->start[end - 1];
    const int32_t *restrict at = l->at + l->start[end - 1];
    double sum[CHUNK];
    for (int32_t j = first; j + 1 < end; j++)
        add_times(-y[j], l->value + l->start[j], y + j + 1, end - 1 - j);
    for (int32_t from = 0; from < rows; from += CHUNK) {
        const int32_t count = rows - from < CHUNK ? rows - from : CHUNK;
        for (int32_t i = 0; i < count; i++)
            sum[i] = 0.0;
        for (int32_t j = first; j < end; j++)
            add_times(y[j], l->value + l->start[j] + (end - 1 - j) + from, sum, count);
        for (int32_t i = 0; i < count; i++)
            y[at[from + i]] -= sum[i];
    }
}

static void up_panel(const rthyb_symmetric *l, int32_t first, int32_t end, double *restrict y)
{
    const int32_t rows = l->start[end] - l->start[end - 1];
    const int32_t *restrict at = l->at + l->start[end - 1];
    double below[CHUNK];
    for (int32_t j = first; j < end; j++)
        y[j] *= l->diagonal[j];
    for (int32_t from = 0; from < rows; from += CHUNK) {
        const int32_t count = rows - from < CHUNK ? rows - from : CHUNK;
        for (int32_t i = 0; i < count; i++)
            below[i] = y[at[from + i]];
        for (int32_t j = first; j < end; j++)
            y[j] -= dot(l->value + l->start[j] + (end - 1 - j) + from, below, count);
    }
    for (int32_t j = end - 1; j-- > first;)
        y[j] -= dot(l->value + l->start[j], y + j + 1, end - 1 - j);
}

void factored_solve(const rthyb_symmetric *l, int32_t n, const int32_t *panel, int32_t panels,
                    double *y)
{
    if (panels == 0) {
        down_columns(l, 0, n, y);
        up_columns(l, 0, n, y);
        return;
    }
    for (int32_t p = 0; p < panels; p++) {
        const int wide = panel[p + 1] - panel[p] >= FEW_COLUMNS;
        (wide ? down_panel : down_columns)(l, panel[p], panel[p + 1], y);
    }
    for (int32_t p = panels; p-- > 0;) {
        const int wide = panel[p + 1] - panel[p] >= FEW_COLUMNS;
        (wide ? up_panel : up_columns)(l, panel[p], panel[p + 1], y);
    }
}
