/* Dry friction between degrees of freedom of a sparse part. Its force changes from one side to the other within a small
 * velocity: taken at an extrapolated velocity, as other elements are, it changes its sign at every sample as soon as
 * F h > m w. Here the force and the velocity of the same instant,
 *   u = v + gamma h q,   S q = ... - (1 - a_f) sum_k B_k f_k(u_k),
 * satisfy the law together: u + G f(u) = r, the velocity without friction.
 *
 * A pass is Newton's method in z = u + g f, g the diagonal of G: with the compliance c = 1 / f'(u) of every slider,
 *   df = (C + G)^-1 (r - u - G f),   du = c df,
 * after which every slider moves along its law to where u + g f is its new z. In z the law is nowhere steep: a slider
 * that holds has the slope 1 / g, one that slides has none. Where the laws are steps, this is the active-set method for
 * a quadratic programme with bounds. (C + G)^-1 is kept up to date for the few sliders that begin to hold or to slide.
 *
 * Between force and command there are at most three such passes, which begin with the prediction made after the last
 * command. What their limits leave is solved for after this command has been sent, before the structure moves. */
#include "sliders.h"

#include <string.h>

#include "numeric.h"

#define VELOCITY_MAX 1e6
#define VALUE_MAX 1e15
#define TINY 1e-300

/* Errors, of the largest force. 20 kN at 2.7 t move it by 7 um in a step: 1e-4 of it is less than 1 nm of the command,
 * and nothing accumulates, since the structure moves with forces that are solved for again. */
#define SETTLED 1e-9
#define SETTLED_IN_TICK 1e-4
#define EXACT 1e-13 /* of a velocity */

/* Bounds of a compliance, of g: with these, (C + G)^-1 can be computed without loss, and a pass converges as well. */
#define SLIDES 1e5
#define HOLDS 1e-9
#define FALLS 0.2 /* -g f'(u), where a law falls; from 1 on, it jumps */
/* Change of g / (c + g) that matters: it is 1 for a slider that holds, and 0 for one that slides. */
#define RELEVANT 0.02
/* Of the velocity or width: to this, a law is its tangent, but for 4e-6 of the force. */
#define LINEAR 3e-3

enum {
    PASSES = 20,
    EVALUATIONS = 30, /* of one law, in one pass */
    COST_MOST = 4,    /* of one evaluation */
    PASSES_IN_TICK = 3,
    CHANGES = 8,
    LAW_COST_IN_TICK = 144, /* of all laws, in all passes */
};

static int plausible(const double *values, size_t count)
{
    if (!values)
        return 0;
    for (size_t i = 0; i < count; i++)
        if (!(fabs(values[i]) <= VALUE_MAX))
            return 0;
    return 1;
}

int sliders_ok(const rthyb_sparse_config *cfg)
{
    const int32_t count = cfg->sliders;
    if (count == 0)
        return 1;
    if (count < 0 || count > RTHYB_SLIDERS_MAX || !cfg->slider)
        return 0;
    const size_t n = (size_t)count;
    if (!plausible(cfg->slider_w, n * (size_t)cfg->size) || !plausible(cfg->slider_g, n * n) ||
        !plausible(cfg->slider_x, n * (size_t)cfg->interfaces))
        return 0;
    for (int32_t j = 0; j < count; j++) {
        const int32_t at = cfg->slider[j];
        if (at < (j > 0 ? cfg->slider[j - 1] + 1 : 0) || at >= cfg->joints ||
            !rthyb_is_dry_friction(&cfg->joint[at].element) || cfg->slider_g[j * count + j] < 0.0)
            return 0;
    }
    return 1;
}

/* ---- the state of the sliders ------------------------------------------------------------------ */

size_t sliders_numbers(const rthyb_sparse_config *cfg)
{
    const size_t n = (size_t)cfg->sliders;
    return n * (n + 3 + sizeof(rthyb_friction_point) / sizeof(double));
}

sliders sliders_at(const rthyb_sparse_config *cfg, double *memory)
{
    const size_t n = (size_t)cfg->sliders;
    return (sliders){
        .count = cfg->sliders,
        .joint = cfg->joint,
        .which = cfg->slider,
        .g = cfg->slider_g,
        .free = memory,
        .left = memory + n,
        .compliance = memory + 2 * n,
        .inverse = memory + 3 * n,
        .at = (rthyb_friction_point *)(void *)(memory + 3 * n + n * n),
    };
}

static double own_g(const sliders *s, int32_t j)
{
    return s->g[(size_t)j * (size_t)s->count + (size_t)j];
}

static const rthyb_element *law_of(const sliders *s, int32_t j)
{
    return &s->joint[s->which[j]].element;
}

/* The compliance for the inverse. A law that falls so steeply that it may jump counts as less steep. */
static double compliance_of(const sliders *s, int32_t j)
{
    const double g = own_g(s, j), unit = g > 0.0 ? g : 1.0;
    const double slope = greater_of(s->at[j].slope * unit, -FALLS);
    return fabs(slope) * SLIDES > 1.0
               ? unit * (slope > 0.0 ? greater_of(1.0 / slope, HOLDS) : 1.0 / slope)
               : unit * SLIDES;
}

static double holding(const sliders *s, int32_t j, double compliance)
{
    const double g = own_g(s, j);
    return g / (compliance + g);
}

void sliders_start(const sliders *s)
{
    for (int32_t j = 0; j < s->count; j++) {
        s->at[j] = rthyb_friction_at(law_of(s, j), 0.0);
        s->free[j] = 0.0;
    }
}

/* out += by x */
static inline void add_times(double by, const double *restrict x, double *restrict out, int32_t n)
{
    for (int32_t i = 0; i < n; i++)
        out[i] += by * x[i];
}

/* out += a by, with a symmetric (n x n); four columns at a time, so that `out` is read and written less often. */
static void add_product(const double *restrict a, const double *restrict by, double *restrict out,
                        int32_t n)
{
    int32_t k = 0;
    for (; k + 4 <= n; k += 4) {
        const double *restrict c = a + (size_t)k * (size_t)n;
        const double b0 = by[k], b1 = by[k + 1], b2 = by[k + 2], b3 = by[k + 3];
        for (int32_t i = 0; i < n; i++)
            out[i] += (b0 * c[i] + b1 * c[n + i]) + (b2 * c[2 * n + i] + b3 * c[3 * n + i]);
    }
    for (; k < n; k++)
        add_times(by[k], a + (size_t)k * (size_t)n, out, n);
}

/* (C + G)^-1, by elimination in place; symmetric and positive definite, so that no pivot has to be chosen. */
static void invert(const sliders *s)
{
    const int32_t n = s->count;
    memcpy(s->inverse, s->g, (size_t)n * (size_t)n * sizeof(double));
    for (int32_t j = 0; j < n; j++) {
        s->compliance[j] = compliance_of(s, j);
        s->inverse[j * n + j] += s->compliance[j];
    }
    for (int32_t k = 0; k < n; k++) {
        double *pivot = s->inverse + (size_t)k * (size_t)n;
        /* Where rounding has made a pivot vanish, two sliders are one: its compliance is raised. */
        const double least = HOLDS * greater_of(own_g(s, k), HOLDS);
        const double by = 1.0 / (fabs(pivot[k]) > least ? pivot[k] : least);
        pivot[k] = 1.0;
        for (int32_t i = 0; i < n; i++)
            pivot[i] *= by;
        for (int32_t i = 0; i < n; i++) {
            double *row = s->inverse + (size_t)i * (size_t)n;
            const double f = row[k];
            if (i == k)
                continue;
            row[k] = 0.0;
            add_times(-f, pivot, row, n);
        }
    }
}

/* Sliders whose compliance has changed since the inverse was computed: the inverse is that, less the sum of
 * by column column' (Sherman & Morrison). For a few sliders, this takes far less time than changing the inverse. */
typedef struct {
    int32_t count, which[CHANGES];
    double before[CHANGES], by[CHANGES], column[CHANGES][RTHYB_SLIDERS_MAX];
} changes;

static void change(const sliders *s, changes *c, int32_t k, double compliance)
{
    const int32_t n = s->count, at = c->count++;
    double *column = c->column[at];
    memcpy(column, s->inverse + (size_t)k * (size_t)n, (size_t)n * sizeof(double));
    for (int32_t i = 0; i < at; i++)
        add_times(-c->by[i] * c->column[i][k], c->column[i], column, n);
    const double more = compliance - s->compliance[k];
    c->by[at] = more / (1.0 + more * column[k]);
    c->which[at] = k;
    c->before[at] = s->compliance[k];
    s->compliance[k] = compliance;
}

/* step = (C + G)^-1 left */
static void solve(const sliders *s, const changes *c, double *step)
{
    const int32_t n = s->count;
    memset(step, 0, (size_t)n * sizeof *step);
    add_product(s->inverse, s->left, step, n);
    for (int32_t i = 0; i < c->count; i++) {
        double along = 0.0;
        for (int32_t j = 0; j < n; j++)
            along += c->column[i][j] * s->left[j];
        add_times(-c->by[i] * along, c->column[i], step, n);
    }
}

/* ---- solving ----------------------------------------------------------------------------------- */

static double largest_force(const sliders *s)
{
    double largest = 0.0;
    for (int32_t j = 0; j < s->count; j++)
        largest = greater_of(largest, fabs(s->at[j].force));
    return largest;
}

/* What the law of each slider and the velocities differ by, r - u - G f; returns the largest, as a force: that
 * which would be missing if the slider held. */
static double leave(const sliders *s)
{
    const int32_t n = s->count;
    double most = 0.0, force[RTHYB_SLIDERS_MAX] = {0.0};
    for (int32_t j = 0; j < n; j++) {
        s->left[j] = s->free[j] - s->at[j].velocity;
        force[j] = -s->at[j].force;
    }
    add_product(s->g, force, s->left, n);
    for (int32_t j = 0; j < n; j++)
        most = greater_of(most, fabs(s->left[j]) / greater_of(own_g(s, j), TINY));
    return most;
}

/* How exactly a pass moves a slider along its law, and how many evaluations of laws there may still be. */
typedef struct {
    double solved, linear;
    int of_one, left;
} accuracy;

/* Moves a slider to where u + g f = z: along the tangent of its law, if that is as good as the law there. */
static void slide(const sliders *s, int32_t j, double z, accuracy *to)
{
    rthyb_friction_point *at = &s->at[j];
    const double g = own_g(s, j), v = at->velocity;
    const double more = (z - v - g * at->force) / (1.0 + g * at->slope);
    if (fabs(more) < to->linear * rthyb_friction_scale(law_of(s, j), v)) {
        at->velocity += more;
        at->force += more * at->slope;
    } else if (to->left > 0) {
        *at = rthyb_friction_for(law_of(s, j), z, g, at, to->solved, to->of_one, &to->left);
    }
}

/* One pass: missed receives the forces that the laws do not have at their new place. Returns the largest error of the
 * forces, that of the velocities included. */
static double pass(const sliders *s, const changes *c, accuracy *to, double *missed)
{
    const int32_t n = s->count;
    double step[RTHYB_SLIDERS_MAX], most = 0.0;
    solve(s, c, step);
    for (int32_t j = 0; j < n; j++) {
        rthyb_friction_point *at = &s->at[j];
        const double g = own_g(s, j), force = at->force + step[j];
        const double z = at->velocity + s->compliance[j] * step[j] + g * force;
        missed[j] = s->left[j] = 0.0;
        if (judge(z, VELOCITY_MAX) != RTHYB_OK)
            continue; /* as an element: the force of the last plausible velocity */
        slide(s, j, z, to);
        missed[j] = force - at->force;
        s->left[j] = z - at->velocity - g * at->force;
        const double late = s->left[j] * at->slope / (1.0 + g * fabs(at->slope));
        most = greater_of(most, greater_of(fabs(missed[j]), fabs(late)));
    }
    /* The linear solution had no error: what is left comes from the forces that were missed. */
    for (int32_t j = 0; j < n; j++)
        s->left[j] -= own_g(s, j) * missed[j];
    add_product(s->g, missed, s->left, n);
    return most;
}

/* Notes the sliders that have begun to hold or to slide, of those with at least a tenth of the largest miss. */
static void follow(const sliders *s, const double *missed, double largest, changes *c)
{
    for (int32_t j = 0; j < s->count && c->count < CHANGES; j++) {
        if (fabs(missed[j]) < 0.1 * largest)
            continue;
        const double compliance = compliance_of(s, j);
        if (fabs(holding(s, j, compliance) - holding(s, j, s->compliance[j])) >= RELEVANT)
            change(s, c, j, compliance);
    }
}

/* One slider after the other, each exactly (Gauss-Seidel): slow, but lowers a convex function as long as no law
 * falls, and so leads out of where passes go in circles. */
static void sweep(const sliders *s)
{
    const int32_t n = s->count;
    int left = COST_MOST * n * EVALUATIONS;
    for (int32_t j = 0; j < n; j++) {
        const double *g = s->g + (size_t)j * (size_t)n;
        double free = s->free[j];
        for (int32_t k = 0; k < n; k++)
            free -= k == j ? 0.0 : g[k] * s->at[k].force;
        if (judge(free, VELOCITY_MAX) == RTHYB_OK)
            s->at[j] =
                rthyb_friction_for(law_of(s, j), free, g[j], NULL, EXACT, EVALUATIONS, &left);
    }
}

/* Returns whether the inverse has been computed. */
static int settle(const sliders *s, const double *free_m_per_s)
{
    const changes none = {.count = 0};
    double missed[RTHYB_SLIDERS_MAX], before = INFINITY;
    memcpy(s->free, free_m_per_s, (size_t)s->count * sizeof(double));
    for (int32_t j = 0; j < s->count; j++) /* not along a tangent any more */
        s->at[j] = rthyb_friction_at(law_of(s, j), s->at[j].velocity);
    if (leave(s) <= SETTLED * largest_force(s))
        return 0;
    for (int i = 0; i < PASSES; i++) {
        accuracy to = {
            .solved = EXACT, .of_one = EVALUATIONS, .left = COST_MOST * s->count * EVALUATIONS};
        invert(s);
        const double most = pass(s, &none, &to, missed);
        if (!(most > SETTLED * largest_force(s)))
            break;
        if (most > 0.5 * before) {
            sweep(s);
            leave(s);
            before = INFINITY;
        } else {
            before = most;
        }
    }
    return 1;
}

void sliders_settle(const sliders *s, const double *free_m_per_s)
{
    (void)settle(s, free_m_per_s);
}

void sliders_predict(const sliders *s, const double *free_m_per_s)
{
    if (!settle(s, free_m_per_s))
        invert(s);
}

rthyb_friction_effort sliders_answer(const sliders *s, const double *free_m_per_s)
{
    rthyb_friction_effort effort = {0};
    double missed[RTHYB_SLIDERS_MAX];
    changes c = {.count = 0};
    accuracy to = {.solved = SETTLED_IN_TICK * 1e-2, .linear = LINEAR, .left = LAW_COST_IN_TICK};
    for (int32_t j = 0; j < s->count; j++) {
        s->left[j] += free_m_per_s[j] - s->free[j];
        s->free[j] = free_m_per_s[j];
    }
    while (effort.passes < PASSES_IN_TICK) {
        to.of_one = effort.passes == 1 ? 2 : 1;
        const double most = pass(s, &c, &to, missed);
        effort.passes++;
        effort.settled = to.left > 0 && most <= SETTLED_IN_TICK * largest_force(s);
        if (effort.settled)
            break;
        if (effort.passes < PASSES_IN_TICK)
            follow(s, missed, most, &c);
    }
    effort.changes = c.count;
    effort.law_cost = LAW_COST_IN_TICK - to.left;
    while (c.count > 0) { /* the inverse is what it was */
        c.count--;
        s->compliance[c.which[c.count]] = c.before[c.count];
    }
    return effort;
}
