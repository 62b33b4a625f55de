/* A numerical part of any size,
 *   M x'' + C x' + K x + (elements) + B force = -load ag,
 * by KR-alpha (Kolay & Ricles 2014), with one sparse solution per step. With ()_f = (1 - a_f) now +
 * a_f before,
 *   S q = F_f - r_f - C (v_f + a_f gamma h q') - K (x_f + a_f beta h^2 q') - a_m M q',
 *   x += h v + (1/2 + gamma) h^2 q,   v += h q,
 * where q' is the previous q. With a_m = a_f = 0 and gamma = 1/2, this is the method of Chen &
 * Ricles (2008) for beta = 1/4, and the central difference for beta = 0. Nothing is divided by a
 * mass, so a degree of freedom may have none. S, K multiplied with q', and the elements' part
 * include the initial stiffness of the elements and of the specimen; the equation contains only
 * what is really present.
 *
 * Between force and command, only x[n+1] = base + gain force + pull ag is computed; everything else
 * waits until the command has been sent. */
#include <string.h>

#include "factored.h"
#include "numeric.h"
#include "numerical.h"
#include "sliders.h"

#define VELOCITY_MAX 1e9
#define ACCELERATION_MAX 1e15
#define VALUE_MAX 1e18

typedef const rthyb_sparse_config config;

/* ---- the state's vectors ----------------------------------------------------------------------- */

enum { VECTORS = 6 };

typedef struct {
    double *x, *v, *q;   /* at t_n; q: of the next step, without its force and excitation */
    double *last;        /* q' */
    double *to_k, *to_c; /* vectors to be multiplied with K and C */
    double *joint_force; /* of each element, at t_n */
    double *sliding;     /* velocity of each slider at t_n, without force and excitation */
    double *pull;        /* of it per unit excitation */
    double *push;        /* and per unit force, interfaces x sliders */
    sliders friction;
    rthyb_element *element;
} vectors;

static vectors vectors_of(config *c, rthyb_sparse *s)
{
    const size_t n = (size_t)c->size;
    double *first = (double *)(s + 1);
    double *forces = first + VECTORS * n, *sliding = forces + c->joints;
    const size_t many = (size_t)c->sliders;
    double *push = sliding + 2 * many, *friction = push + (size_t)c->interfaces * many;
    return (vectors){
        .x = first,
        .v = first + n,
        .q = first + 2 * n,
        .last = first + 3 * n,
        .to_k = first + 4 * n,
        .to_c = first + 5 * n,
        .joint_force = forces,
        .sliding = sliding,
        .pull = sliding + many,
        .push = push,
        .friction = sliders_at(c, friction),
        .element = (rthyb_element *)(void *)(friction + sliders_numbers(c)),
    };
}

static int sizes_ok(config *c)
{
    return c->size >= 1 && c->size <= RTHYB_SPARSE_MAX && c->interfaces >= 1 &&
           c->interfaces <= RTHYB_INTERFACES_MAX && c->joints >= 0 &&
           c->joints <= RTHYB_SPARSE_ELEMENTS_MAX && c->modes >= 0 &&
           c->modes <= RTHYB_SPARSE_MODES_MAX && c->responses >= 0 &&
           c->responses <= RTHYB_RESPONSES_MAX && c->sliders >= 0 &&
           c->sliders <= RTHYB_SLIDERS_MAX;
}

size_t rthyb_sparse_bytes(config *cfg)
{
    if (!sizes_ok(cfg))
        return 0;
    const size_t of_sliders = (size_t)cfg->sliders * (size_t)(2 + cfg->interfaces);
    const size_t numbers =
        VECTORS * (size_t)cfg->size + (size_t)cfg->joints + of_sliders + sliders_numbers(cfg);
    return sizeof(rthyb_sparse) + numbers * sizeof(double) +
           (size_t)cfg->joints * sizeof(rthyb_element);
}

/* ---- what is accepted -------------------------------------------------------------------------- */

static int within(const double *values, size_t count, double most)
{
    if (count > 0 && !values)
        return 0;
    for (size_t i = 0; i < count; i++)
        if (!(fabs(values[i]) <= most))
            return 0;
    return 1;
}

static int numbers_ok(const double *values, size_t count)
{
    return within(values, count, VALUE_MAX);
}

/* Whether the row starts never decrease, and all indices are from 0 to below `end`; with above_row,
 * also greater than the number of their row. */
static int places_ok(const int32_t *start, const int32_t *at, int32_t rows, int32_t end,
                     int above_row)
{
    if (!start || start[0] != 0)
        return 0;
    for (int32_t i = 0; i < rows; i++)
        if (start[i + 1] < start[i] || start[i + 1] > RTHYB_SPARSE_ENTRIES)
            return 0;
    if (start[rows] > 0 && !at)
        return 0;
    for (int32_t i = 0; i < rows; i++)
        for (int32_t k = start[i]; k < start[i + 1]; k++)
            if (at[k] >= end || at[k] < (above_row ? i + 1 : 0))
                return 0;
    return 1;
}

static int symmetric_ok(const rthyb_symmetric *a, int32_t n)
{
    return places_ok(a->start, a->at, n, n, 1) && numbers_ok(a->diagonal, (size_t)n) &&
           numbers_ok(a->value, (size_t)a->start[n]);
}

static int rows_ok(const rthyb_rows *r, int32_t rows, int32_t end)
{
    return places_ok(r->start, r->at, rows, end, 0) &&
           numbers_ok(r->weight, (size_t)r->start[rows]);
}

static int joints_ok(config *c)
{
    if (c->joints > 0 && !c->joint)
        return 0;
    for (int32_t i = 0; i < c->joints; i++) {
        const rthyb_joint *j = &c->joint[i];
        const int ends_ok =
            j->below >= -1 && j->below < c->size && j->above >= -1 && j->above < c->size;
        if (!ends_ok || j->below == j->above || !(fabs(j->stiffness_n_per_m) <= 1e15) ||
            rthyb_element_param_count(j->element.kind) < 0)
            return 0;
    }
    return 1;
}

static int start_ok(config *c)
{
    const size_t n = (size_t)c->size;
    if (!c->first_x && !c->first_v && !c->first_q)
        return 1;
    return within(c->first_x, n, RTHYB_DISPLACEMENT_MAX_M) && within(c->first_v, n, VELOCITY_MAX) &&
           within(c->first_q, n, ACCELERATION_MAX);
}

static int integrator_ok(config *c)
{
    return fabs(c->alpha_m) <= 1.0 && c->alpha_f >= 0.0 && c->alpha_f <= 0.5 && c->gamma >= 0.5 &&
           c->gamma <= 1.5 && c->beta >= 0.0 && c->beta <= 1.0;
}

static int config_error(config *c)
{
    if (!(c->period_s > 0.0 && c->period_s <= 1.0))
        return RTHYB_E_PERIOD;
    if (!sizes_ok(c) || !integrator_ok(c))
        return RTHYB_E_MOTION;
    const size_t n = (size_t)c->size, m = (size_t)c->interfaces, r = (size_t)c->modes;
    const int matrices_ok =
        symmetric_ok(&c->mass_kg, c->size) && symmetric_ok(&c->stiffness_n_per_m, c->size) &&
        (!c->damped || symmetric_ok(&c->damping_n_s_per_m, c->size)) &&
        symmetric_ok(&c->factor, c->size) && panels_ok(&c->factor, c->size, c->panel, c->panels);
    const int vectors_ok = numbers_ok(c->modal, n * r) && numbers_ok(c->modal_solved, n * r) &&
                           numbers_ok(c->modal_inner, r * r) && numbers_ok(c->load_kg, n) &&
                           numbers_ok(c->k_e_n_per_m, m) &&
                           (!c->k_e_between || numbers_ok(c->k_e_between, m * m)) &&
                           numbers_ok(c->by_force, n * m) && numbers_ok(c->first_by_force, n * m) &&
                           numbers_ok(c->by_excitation, n) && numbers_ok(c->first_by_excitation, n);
    const int rest_ok = fabs(c->by_mass_per_s) <= 1e9 && fabs(c->by_stiffness_s) <= 1e9 &&
                        rows_ok(&c->interface, c->interfaces, c->size) && joints_ok(c) &&
                        sliders_ok(c) && start_ok(c) &&
                        rows_ok(&c->response, c->responses, c->size + c->joints + c->interfaces);
    return matrices_ok && vectors_ok && rest_ok ? 0 : RTHYB_E_MOTION;
}

/* ---- products and the solve -------------------------------------------------------------------- */

/* out -= a x */
static void subtract_product(const rthyb_symmetric *a, int32_t n, const double *restrict x,
                             double *restrict out)
{
    const int32_t *restrict start = a->start, *restrict at = a->at;
    const double *restrict value = a->value;
    for (int32_t i = 0; i < n; i++) {
        const double xi = x[i];
        double sum = a->diagonal[i] * xi;
        for (int32_t k = start[i]; k < start[i + 1]; k++) {
            const int32_t j = at[k];
            sum += value[k] * x[j];
            out[j] -= value[k] * xi;
        }
        out[i] -= sum;
    }
}

static double dot(const double *restrict a, const double *restrict b, int32_t n)
{
    double sum = 0.0;
    for (int32_t i = 0; i < n; i++)
        sum += a[i] * b[i];
    return sum;
}

static double row_sum(const rthyb_rows *rows, int32_t row, const double *x)
{
    double sum = 0.0;
    for (int32_t k = rows->start[row]; k < rows->start[row + 1]; k++)
        sum += rows->weight[k] * x[rows->at[k]];
    return sum;
}

static void add_row(const rthyb_rows *rows, int32_t row, double by, double *x)
{
    for (int32_t k = rows->start[row]; k < rows->start[row + 1]; k++)
        x[rows->at[k]] += by * rows->weight[k];
}

/* Sherman-Morrison-Woodbury: (S0 + g U U')^-1 = S0^-1 - Z (1/g + U' Z)^-1 U' S0^-1. */
void rthyb_sparse_solve(config *cfg, double *values)
{
    const int32_t n = cfg->size, r = cfg->modes;
    double along[RTHYB_SPARSE_MODES_MAX];
    factored_solve(&cfg->factor, n, cfg->panel, cfg->panels, values);
    for (int32_t j = 0; j < r; j++)
        along[j] = dot(cfg->modal + (size_t)j * (size_t)n, values, n);
    for (int32_t j = 0; j < r; j++) {
        const double by = dot(cfg->modal_inner + (size_t)j * (size_t)r, along, r);
        const double *z = cfg->modal_solved + (size_t)j * (size_t)n;
        for (int32_t i = 0; i < n; i++)
            values[i] -= by * z[i];
    }
}

/* ---- the step ---------------------------------------------------------------------------------- */

static double gain_of(config *c)
{
    return (0.5 + c->gamma) * c->period_s * c->period_s;
}

static double across(const rthyb_joint *joint, const double *x)
{
    return (joint->above < 0 ? 0.0 : x[joint->above]) - (joint->below < 0 ? 0.0 : x[joint->below]);
}

static void push_apart(const rthyb_joint *joint, double force, double *out)
{
    if (joint->above >= 0)
        out[joint->above] -= force;
    if (joint->below >= 0)
        out[joint->below] += force;
}

/* Evaluates the elements at the new x; adds to `out` the part of the old and the new force that K
 * does not include. Velocity and acceleration are those used with C and M. The new force of a
 * slider is not known yet. */
static void add_joints(config *c, vectors *s, double *restrict out)
{
    const double h = c->period_s, af = c->alpha_f, gamma_h = c->gamma * h;
    const double of_q = af * c->beta * h * h;
    int32_t slider = 0;
    for (int32_t i = 0; i < c->joints; i++) {
        const rthyb_joint *joint = &c->joint[i];
        if (slider < c->sliders && c->slider[slider] == i) {
            push_apart(joint, af * s->joint_force[i], out);
            slider++;
            continue;
        }
        const double a = across(joint, s->last);
        const double v = across(joint, s->v) + gamma_h * a;
        const double now = rthyb_element_force(&s->element[i], across(joint, s->x), v, a, h);
        const double force = (1.0 - af) * now + af * s->joint_force[i];
        const double in_k = joint->stiffness_n_per_m * (across(joint, s->to_k) - of_q * a);
        s->joint_force[i] = now;
        push_apart(joint, force - in_k, out);
    }
}

/* Computes x and v at t_{n+1}, and the vectors to be multiplied with K and C. Returns whether all
 * values are plausible. */
static int move(config *c, vectors *s)
{
    const double h = c->period_s, gain = gain_of(c), af = c->alpha_f;
    const double x_of_q = (1.0 - af) * gain + af * c->beta * h * h;
    const double v_of_q = (1.0 - af) * h + af * c->gamma * h;
    double *restrict x = s->x, *restrict v = s->v, *restrict to_k = s->to_k,
                     *restrict to_c = s->to_c;
    const double *restrict q = s->last;
    int ok = 1;
    for (int32_t i = 0; i < c->size; i++) {
        to_k[i] = x[i] + (1.0 - af) * h * v[i] + x_of_q * q[i];
        to_c[i] = v[i] + v_of_q * q[i];
        x[i] += h * v[i] + gain * q[i];
        v[i] += h * q[i];
        ok &= (fabs(x[i]) <= RTHYB_DISPLACEMENT_MAX_M) & (fabs(v[i]) <= VELOCITY_MAX) &
              (fabs(q[i]) <= ACCELERATION_MAX);
    }
    return ok;
}

/* A part that grows without bound ends at rest at the limit of plausible values, not at
 * infinity. */
static int stop_at_the_edge(config *c, rthyb_sparse *s, vectors *all)
{
    int code = RTHYB_S_OUT_OF_RANGE;
    for (int32_t i = 0; i < c->size; i++) {
        all->x[i] = confine(all->x[i], RTHYB_DISPLACEMENT_MAX_M, &code);
        all->to_k[i] = all->x[i];
        all->v[i] = all->last[i] = all->to_c[i] = 0.0;
    }
    for (int32_t i = 0; i < c->interfaces; i++) {
        s->x1[i] = s->x2[i] = s->x[i];
        s->a[i] = 0.0;
    }
    return code;
}

/* -C to_c; Rayleigh damping is included in the other two products. */
static void damp(config *c, const double *restrict to_c, double *restrict out)
{
    const int32_t n = c->size;
    if (c->damped)
        subtract_product(&c->damping_n_s_per_m, n, to_c, out);
    for (int32_t j = 0; j < c->modes; j++) {
        const double *u = c->modal + (size_t)j * (size_t)n;
        const double by = dot(u, to_c, n);
        for (int32_t i = 0; i < n; i++)
            out[i] -= by * u[i];
    }
}

/* Velocities of the sliders without their friction, in the step that the present force and
 * excitation begin. */
static void sliding_now(config *c, const rthyb_sparse *s, const vectors *all, double *now)
{
    const int32_t n = c->sliders;
    for (int32_t j = 0; j < n; j++)
        now[j] = all->sliding[j] + all->pull[j] * s->excitation;
    for (int32_t i = 0; i < c->interfaces; i++)
        for (int32_t j = 0; j < n; j++)
            now[j] += all->push[i * n + j] * s->force[i];
}

static void take_friction(config *c, const vectors *all)
{
    for (int32_t j = 0; j < c->sliders; j++)
        all->joint_force[c->slider[j]] = all->friction.at[j].force;
}

/* The sliders' forces with which the structure makes this step. */
static void settle_friction(config *c, const rthyb_sparse *s, const vectors *all)
{
    double now[RTHYB_SLIDERS_MAX];
    sliding_now(c, s, all, now);
    sliders_settle(&all->friction, now);
    take_friction(c, all);
}

/* Most of the work on the forces of the next step, with the present force and excitation as a prediction. */
static void predict_friction(config *c, const rthyb_sparse *s, const vectors *all)
{
    const double gamma_h = c->gamma * c->period_s;
    double now[RTHYB_SLIDERS_MAX];
    for (int32_t j = 0; j < c->sliders; j++) {
        const rthyb_joint *joint = &c->joint[c->slider[j]];
        all->sliding[j] = across(joint, all->v) + gamma_h * across(joint, all->q);
    }
    sliding_now(c, s, all, now);
    sliders_predict(&all->friction, now);
    take_friction(c, all);
}

/* The sliders' forces, now that force and excitation are known, and their part of x[n+1]. */
static void add_friction(config *c, rthyb_sparse *s, double *x_next)
{
    const vectors all = vectors_of(c, s);
    double now[RTHYB_SLIDERS_MAX];
    sliding_now(c, s, &all, now);
    s->friction_effort = sliders_answer(&all.friction, now);
    take_friction(c, &all);
    for (int32_t i = 0; i < c->interfaces; i++)
        for (int32_t j = 0; j < c->sliders; j++)
            x_next[i] -= c->slider_x[i * c->sliders + j] * all.friction.at[j].force;
}

/* The sliders at rest, and what moves them. */
static void start_friction(config *c, const vectors *all)
{
    const double gamma_h = c->gamma * c->period_s;
    const int32_t n = c->sliders;
    sliders_start(&all->friction);
    for (int32_t j = 0; j < n; j++) {
        const rthyb_joint *joint = &c->joint[c->slider[j]];
        all->pull[j] = gamma_h * across(joint, c->by_excitation);
        for (int32_t i = 0; i < c->interfaces; i++)
            all->push[i * n + j] =
                gamma_h * across(joint, c->by_force + (size_t)i * (size_t)c->size);
    }
}

/* q of the next step, without its force and excitation. */
static void look_ahead(config *c, rthyb_sparse *s, vectors *all)
{
    const int32_t n = c->size;
    const double af = c->alpha_f, h = c->period_s, of_q = af * c->beta * h * h;
    double *restrict q = all->q;
    double *restrict to_k = all->to_k, *restrict to_c = all->to_c;
    for (int32_t i = 0; i < n; i++)
        q[i] = -af * s->excitation * c->load_kg[i];
    for (int32_t i = 0; i < c->interfaces; i++) {
        const double x =
            row_sum(&c->interface, i, to_k) - of_q * row_sum(&c->interface, i, all->last);
        add_row(&c->interface, i, c->k_e_n_per_m[i] * x - af * s->force[i], q);
        for (int32_t j = 0; c->k_e_between && j < c->interfaces; j++)
            add_row(&c->interface, j, c->k_e_between[j * c->interfaces + i] * x, q);
    }
    add_joints(c, all, q);
    damp(c, to_c, q);
    for (int32_t i = 0; i < n; i++) {
        to_k[i] += c->by_stiffness_s * to_c[i];
        to_c[i] = c->by_mass_per_s * to_c[i] + c->alpha_m * all->last[i];
    }
    subtract_product(&c->stiffness_n_per_m, n, to_k, q);
    subtract_product(&c->mass_kg, n, to_c, q);
    rthyb_sparse_solve(c, q);
    if (c->sliders > 0)
        predict_friction(c, s, all);
}

static void note_base(config *c, rthyb_sparse *s, const vectors *all)
{
    const double h = c->period_s, gain = gain_of(c);
    for (int32_t i = 0; i < c->interfaces; i++)
        s->base[i] = row_sum(&c->interface, i, all->x) + h * row_sum(&c->interface, i, all->v) +
                     gain * row_sum(&c->interface, i, all->q);
}

static int advance(const rthyb_numerical *part)
{
    config *c = part->cfg;
    rthyb_sparse *s = part->state;
    vectors all = vectors_of(c, s);
    const int32_t n = c->size, first = !s->stepped;
    const double *by_force = first ? c->first_by_force : c->by_force;
    const double *by_excitation = first ? c->first_by_excitation : c->by_excitation;
    double *restrict last = all.last;
    const double *restrict q = all.q;
    if (!first && c->sliders > 0)
        settle_friction(c, s, &all);
    for (int32_t i = 0; i < n; i++)
        last[i] = q[i] + s->excitation * by_excitation[i];
    for (int32_t j = 0; j < c->interfaces; j++)
        for (int32_t i = 0; i < n; i++)
            last[i] += s->force[j] * by_force[(size_t)j * (size_t)n + (size_t)i];
    for (int32_t j = 0; j < (first ? 0 : c->sliders); j++)
        for (int32_t i = 0; i < n; i++)
            last[i] -=
                all.joint_force[c->slider[j]] * c->slider_w[(size_t)j * (size_t)n + (size_t)i];
    int code = s->ran_off ? RTHYB_S_OUT_OF_RANGE : RTHYB_OK;
    s->stepped = 1;
    for (int32_t i = 0; i < c->interfaces; i++)
        s->a[i] = row_sum(&c->interface, i, last);
    if (!move(c, &all) || code != RTHYB_OK)
        code |= stop_at_the_edge(c, s, &all);
    look_ahead(c, s, &all);
    note_base(c, s, &all);
    return code;
}

static int answer(const rthyb_numerical *part, double excitation, const double *force_n,
                  double *x_next_m)
{
    rthyb_sparse *s = part->state;
    const int m = s->interfaces;
    const double *gain = s->gain[s->stepped], *pull = s->pull[s->stepped];
    int code = RTHYB_OK, bad = RTHYB_OK;
    double friction[RTHYB_INTERFACES_MAX] = {0};
    s->excitation = accept(excitation, 1e4, s->excitation, &code);
    for (int j = 0; j < m; j++)
        s->force[j] = accept(force_n[j], RTHYB_FORCE_MAX_N, s->force[j], &code);
    config *c = part->cfg;
    if (c->sliders > 0 && s->stepped)
        add_friction(c, s, friction);
    for (int i = 0; i < m; i++) {
        double next = s->base[i] + pull[i] * s->excitation;
        for (int j = 0; j < m; j++)
            next += gain[i * m + j] * s->force[j];
        next += friction[i];
        s->x2[i] = s->x1[i];
        s->x1[i] = s->x[i];
        s->x[i] = confine(next, RTHYB_DISPLACEMENT_MAX_M, &bad);
        x_next_m[i] = s->x[i];
    }
    s->ran_off = bad != RTHYB_OK;
    return code | bad;
}

/* ---- set-up ------------------------------------------------------------------------------------ */

static void note_gains(config *c, rthyb_sparse *s)
{
    const double gain = gain_of(c);
    const size_t n = (size_t)c->size;
    const int m = c->interfaces;
    const double *forces[] = {c->first_by_force, c->by_force};
    const double *pulls[] = {c->first_by_excitation, c->by_excitation};
    for (int one = 0; one < 2; one++)
        for (int i = 0; i < m; i++) {
            s->pull[one][i] = gain * row_sum(&c->interface, i, pulls[one]);
            for (int j = 0; j < m; j++)
                s->gain[one][i * m + j] =
                    gain * row_sum(&c->interface, i, forces[one] + (size_t)j * n);
        }
}

/* A part begins at the state in its settings; the caller cannot choose another one. */
static int init(const rthyb_numerical *part, double x0_m)
{
    config *c = part->cfg;
    rthyb_sparse *s = part->state;
    const int error = config_error(c);
    if (error)
        return error;
    if (x0_m != 0.0)
        return RTHYB_E_LIMIT;
    memset(s, 0, rthyb_sparse_bytes(c));
    s->size = c->size;
    s->interfaces = c->interfaces;
    s->joints = c->joints;
    vectors all = vectors_of(c, s);
    if (c->first_x) {
        const size_t bytes = (size_t)c->size * sizeof(double);
        memcpy(all.x, c->first_x, bytes);
        memcpy(all.v, c->first_v, bytes);
        memcpy(all.q, c->first_q, bytes);
    }
    for (int32_t i = 0; i < c->joints; i++) {
        const rthyb_joint *joint = &c->joint[i];
        all.element[i] = joint->element;
        all.joint_force[i] = rthyb_element_force(&all.element[i], across(joint, all.x),
                                                 across(joint, all.v), 0.0, c->period_s);
    }
    start_friction(c, &all);
    note_gains(c, s);
    for (int i = 0; i < c->interfaces; i++)
        s->x[i] = s->x1[i] = s->x2[i] = row_sum(&c->interface, i, all.x);
    note_base(c, s, &all);
    for (int i = 0; i < c->interfaces; i++)
        if (judge(s->base[i], RTHYB_DISPLACEMENT_MAX_M) != RTHYB_OK)
            return RTHYB_E_LIMIT;
    return 0;
}

/* ---- what is asked of it ----------------------------------------------------------------------- */

size_t rthyb_sparse_displacements(config *cfg, const rthyb_sparse *state, double *values,
                                  size_t most)
{
    const size_t n = (size_t)cfg->size, count = n < most ? n : most;
    memcpy(values, state + 1, count * sizeof(double));
    return count;
}

/* As in motion.c: v is (x[n] - x[n-1]) / h, half a step old. */
static void look(const rthyb_numerical *part, rthyb_interface *at)
{
    config *c = part->cfg;
    const rthyb_sparse *s = part->state;
    for (int i = 0; i < s->interfaces; i++)
        at[i] = (rthyb_interface){
            .x = s->x[i],
            .v = (3.0 * s->x[i] - 4.0 * s->x1[i] + s->x2[i]) / (2.0 * c->period_s),
            .a = s->a[i],
            .x1 = s->x1[i],
            .x2 = s->x2[i],
        };
}

static double term(config *c, const rthyb_sparse *s, int32_t at)
{
    const double *x = (const double *)(s + 1), *forces = x + VECTORS * (size_t)c->size;
    if (at < c->size)
        return x[at];
    at -= c->size;
    return at < c->joints ? forces[at] : s->force[at - c->joints];
}

static size_t report(const rthyb_numerical *part, double *values, size_t most)
{
    config *c = part->cfg;
    const rthyb_rows *rows = &c->response;
    const size_t count = (size_t)c->responses < most ? (size_t)c->responses : most;
    for (size_t i = 0; i < count; i++) {
        double sum = 0.0;
        for (int32_t k = rows->start[i]; k < rows->start[i + 1]; k++)
            sum += rows->weight[k] * term(c, part->state, rows->at[k]);
        values[i] = sum;
    }
    return count;
}

static size_t size(const void *cfg)
{
    return cfg ? rthyb_sparse_bytes(cfg) : 0;
}

static int32_t interfaces(const void *cfg)
{
    return ((const rthyb_sparse_config *)cfg)->interfaces;
}

const rthyb_numerical_ops rthyb_sparse_ops = {
    .size = size,
    .interfaces = interfaces,
    .init = init,
    .answer = answer,
    .advance = advance,
    .look = look,
    .report = report,
};
