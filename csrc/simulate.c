/* Simulators for the diagnosis: an actuator that follows its recorded command, and a body that is
 * moved by a known force. Both use a finer time grid than the recording and return values at its
 * rows. */
#include "laws.h"
#include "numeric.h"

#define SUBSTEPS_MAX 256

static int actuator_ok(const rthyb_actuator_model *m)
{
    const int time_ok = m->period_s > 0.0 && m->period_s <= 1.0 && fabs(m->delay_s) <= 10.0 &&
                        fabs(m->shift_s) <= 10.0 && fabs(m->delay_rate_s2_per_m) <= 1e3;
    const int lag_ok = m->natural_frequency_hz > 0.0 && m->natural_frequency_hz <= 1e6 &&
                       m->damping_ratio > 0.0 && m->damping_ratio <= 1e4 && fabs(m->gain) <= 1e6;
    return time_ok && lag_ok && m->velocity_limit_m_per_s >= 0.0 &&
           (m->hold == RTHYB_ZOH || m->hold == RTHYB_FOH) && m->limit_at >= 0 && m->limit_at <= 1 &&
           m->rate_of >= 0 && m->rate_of <= 1;
}

/* The command at a row, which need not be an integer; constant before the first row and after the
 * last. */
static double command_at(const double *u, size_t n, double row, int32_t hold)
{
    if (!(row > 0.0))
        return u[0];
    const double last = (double)(n - 1);
    if (row >= last)
        return u[n - 1];
    const size_t i = (size_t)row;
    return hold == RTHYB_ZOH ? u[i] : u[i] + (row - (double)i) * (u[i + 1] - u[i]);
}

typedef struct {
    const rthyb_actuator_model *model;
    const double *u;
    size_t n;
    double w2, d;      /* omega squared, 2 zeta omega */
    double lead;       /* 2 zeta / omega: delay in following a command of constant velocity, s */
    double late, rows; /* delay that does not depend on the velocity, in s and in rows */
} lag;

static double wanted(const lag *s, double row, double v)
{
    const rthyb_actuator_model *m = s->model;
    if (m->delay_rate_s2_per_m == 0.0)
        return m->gain * command_at(s->u, s->n, row - s->rows, m->hold);
    double speed = v;
    if (m->rate_of == 1) {
        const double at = row - s->rows;
        speed = (command_at(s->u, s->n, at + 0.5, RTHYB_FOH) -
                 command_at(s->u, s->n, at - 0.5, RTHYB_FOH)) /
                m->period_s;
    }
    const double late = s->late + m->delay_rate_s2_per_m * fabs(speed);
    return m->gain * command_at(s->u, s->n, row - late / m->period_s, m->hold);
}

static double pull(const lag *s, double u, double x, double v)
{
    return s->w2 * (u - x) - s->d * v;
}

/* Free motion of the lag over a given time: displacement and velocity from those at its start. */
typedef struct {
    double xx, xv, vx, vv;
    double per_s; /* one over that time; 0 if it is 0 */
} passage;

/* exp(A t) of x'' + d x' + w^2 x = 0, for any damping. */
static passage passage_of(double w2, double d, double t)
{
    const double half = 0.5 * d, square = half * half - w2;
    double cosine, sine; /* for the root times t; the sine divided by the root */
    const double decay = exp(-half * t);
    if (square > 1e-9 * w2) {
        const double root = sqrt(square);
        const double slow = exp((root - half) * t), fast = exp(-(root + half) * t);
        cosine = 0.5 * (slow + fast);
        sine = 0.5 * (slow - fast) / root;
    } else if (square < -1e-9 * w2) {
        const double root = sqrt(-square);
        cosine = decay * cos(root * t);
        sine = decay * sin(root * t) / root;
    } else {
        cosine = decay;
        sine = decay * t;
    }
    return (passage){.xx = cosine + half * sine,
                     .xv = sine,
                     .vx = -w2 * sine,
                     .vv = cosine - half * sine,
                     .per_s = t > 0.0 ? 1.0 / t : 0.0};
}

/* Exact for a command that changes linearly from u0 to u1 in the given time. */
static void follow(const lag *s, const passage *p, double u0, double u1, double *x, double *v)
{
    const double slope = (u1 - u0) * p->per_s, lead = slope * s->lead;
    const double y = *x - (u0 - lead), w = *v - slope;
    *x = p->xx * y + p->xv * w + u1 - lead;
    *v = p->vx * y + p->vv * w + slope;
}

/* Displacement and velocity of the actuator, and the command that it follows at that time. */
typedef struct {
    double x, v, u;
} place;

typedef struct {
    double *x, *v, *a;
} rows;

static void run_linear(const lag *s, size_t first, size_t end, place *p, rows out)
{
    const rthyb_actuator_model *m = s->model;
    /* Where the rows of the delayed command lie between two rows. */
    const double knot = s->rows - floor(s->rows), h = m->period_s;
    const passage before = passage_of(s->w2, s->d, knot * h);
    const passage after = passage_of(s->w2, s->d, (1.0 - knot) * h);
    double u0 = wanted(s, (double)first, 0.0);
    for (size_t i = first; i < end; i++) {
        const double row = (double)i, tiny = 1e-9;
        out.x[i] = p->x;
        out.v[i] = p->v;
        /* For a held command, the one that was followed up to this row, as latched by the rig. */
        out.a[i] = pull(s, m->hold == RTHYB_FOH ? u0 : p->u, p->x, p->v);
        const double u1 = m->hold == RTHYB_FOH ? wanted(s, row + knot, 0.0) : u0;
        const double u2 = m->hold == RTHYB_FOH ? u1 : wanted(s, row + knot + tiny, 0.0);
        const double u3 = m->hold == RTHYB_FOH ? wanted(s, row + 1.0, 0.0) : u2;
        follow(s, &before, u0, u1, &p->x, &p->v);
        follow(s, &after, u2, u3, &p->x, &p->v);
        p->u = u3;
        u0 = m->hold == RTHYB_FOH ? u3 : wanted(s, row + 1.0, 0.0);
    }
}

enum { PIECES = 8 };

static void run_limited(const lag *s, size_t first, size_t end, place *p, rows out)
{
    const rthyb_actuator_model *m = s->model;
    const double h = m->period_s / PIECES, most = m->velocity_limit_m_per_s;
    const int command = most > 0.0 && m->limit_at == 0, actuator = most > 0.0 && m->limit_at == 1;
    const passage piece = passage_of(s->w2, s->d, h);
    for (size_t i = first; i < end; i++) {
        out.x[i] = p->x;
        out.v[i] = p->v;
        out.a[i] = pull(s, p->u, p->x, p->v);
        /* At its own velocity limit, the actuator is not accelerated any further. */
        if (actuator && p->v * out.a[i] > 0.0 && fabs(p->v) >= most)
            out.a[i] = 0.0;
        for (int k = 1; k <= PIECES; k++) {
            double u1 = wanted(s, (double)i + (double)k / PIECES, p->v);
            if (command)
                u1 = p->u + clamp(u1 - p->u, -most * h, most * h);
            const double from = p->x;
            follow(s, &piece, p->u, u1, &p->x, &p->v);
            if (actuator) {
                p->x = from + clamp(p->x - from, -most * h, most * h);
                p->v = clamp(p->v, -most, most);
            }
            p->u = u1;
        }
    }
}

/* From one instant to another within a row, both given in rows. */
static void run_part(const lag *s, double from, double to, place *p)
{
    const rthyb_actuator_model *m = s->model;
    const int curved = m->delay_rate_s2_per_m != 0.0 || m->velocity_limit_m_per_s != 0.0;
    const double at = floor(from) + (s->rows - floor(s->rows)), knot = clamp(at, from, to);
    const double most = m->velocity_limit_m_per_s, tiny = 1e-9;
    const int pieces = curved ? PIECES : 2;
    for (int k = 0; k < pieces; k++) {
        const double even = (to - from) / pieces;
        const double r0 = curved ? from + k * even : (k ? knot : from);
        const double r1 = curved ? r0 + even : (k ? to : knot);
        const double h = (r1 - r0) * m->period_s;
        if (!(h > 0.0))
            continue;
        const double held = wanted(s, r0 + tiny, p->v);
        double u0 = curved ? p->u : held;
        double u1 = m->hold == RTHYB_FOH || curved ? wanted(s, r1, p->v) : held;
        if (most > 0.0 && m->limit_at == 0)
            u1 = u0 + clamp(u1 - u0, -most * h, most * h);
        const passage piece = passage_of(s->w2, s->d, h);
        const double before = p->x;
        follow(s, &piece, u0, u1, &p->x, &p->v);
        if (most > 0.0 && m->limit_at == 1) {
            p->x = before + clamp(p->x - before, -most * h, most * h);
            p->v = clamp(p->v, -most, most);
        }
        p->u = u1;
    }
}

static lag lag_of(const rthyb_actuator_model *model, const double *u, size_t n)
{
    const double w = 2.0 * RTHYB_PI * model->natural_frequency_hz;
    const double late = model->delay_s + model->shift_s;
    return (lag){.model = model,
                 .u = u,
                 .n = n,
                 .w2 = w * w,
                 .d = 2.0 * model->damping_ratio * w,
                 .lead = 2.0 * model->damping_ratio / w,
                 .late = late,
                 .rows = late / model->period_s};
}

static void run_actuator(const lag *s, size_t first, size_t end, place *p, rows out)
{
    const rthyb_actuator_model *m = s->model;
    if (m->delay_rate_s2_per_m == 0.0 && m->velocity_limit_m_per_s == 0.0)
        run_linear(s, first, end, p, out);
    else
        run_limited(s, first, end, p, out);
}

int rthyb_simulate_actuator(const rthyb_actuator_model *before, const rthyb_actuator_model *model,
                            double row, const double *x_cmd_m, size_t n, double *x_m,
                            double *v_m_per_s, double *a_m_per_s2)
{
    if (!actuator_ok(model) || !actuator_ok(before) || isnan(row))
        return RTHYB_E_SERVO;
    if (n == 0)
        return 0;
    const lag first = lag_of(before, x_cmd_m, n), then = lag_of(model, x_cmd_m, n);
    const rows out = {x_m, v_m_per_s, a_m_per_s2};
    const double last = (double)(n - 1), change = clamp(row, 0.0, last);
    const size_t whole = (size_t)change;
    place p = {.x = wanted(change > 0.0 ? &first : &then, 0.0, 0.0)};
    p.u = p.x;
    run_actuator(&first, 0, whole, &p, out);
    if (change > (double)whole) { /* the model changes within this row */
        place kept = p;
        run_actuator(&first, whole, whole + 1, &kept, out);
        run_part(&first, (double)whole, change, &p);
        run_part(&then, change, (double)whole + 1.0, &p);
    }
    run_actuator(&then, change > (double)whole ? whole + 1 : whole, n, &p, out);
    return fabs(x_m[n - 1]) <= RTHYB_DISPLACEMENT_MAX_M ? 0 : RTHYB_E_LIMIT;
}

/* Dry friction that is solved for together with the motion: forces in either direction, and the
 * width of the transition between them. As an explicit force, it is stable only for steps in which
 * it changes the velocity by less than that width; a body that sticks would chatter and creep. */
typedef struct {
    double up, down, width;
} friction;

#define FRICTION_MAX 4
#define SATURATED 19.0 /* widths from which smooth_sign is 1 */
/* Change of velocity in a step, in widths, above which friction is solved for: explicit steps
 * diverge at two. */
#define STIFF 0.5
#define STICKS_MAX 4
#define SOLVE_MAX 60

typedef struct {
    const rthyb_element *from[FRICTION_MAX];
    friction now[FRICTION_MAX]; /* at the velocity of the last call of levels_at */
    size_t count;
    uint64_t taken;               /* one bit for each element that is not an explicit force */
    double up, down, least, most; /* sums of the forces; least and largest width */
} dry;

/* 0 if the element is not dry friction. */
static int friction_of(const rthyb_element *e, double v, friction *out)
{
    const double *p = e->params;
    switch (e->kind) {
    case RTHYB_COULOMB:
        *out = (friction){p[0], p[0], p[1]};
        return 1;
    case RTHYB_COULOMB_UNEVEN:
        *out = (friction){p[0], p[1], p[2]};
        return 1;
    case RTHYB_STRIBECK: {
        const double level = rthyb_stribeck_level(p, v);
        *out = (friction){level, level, p[3]};
        return 1;
    }
    default:
        return 0;
    }
}

static dry dry_of(const rthyb_element *elements, size_t count, double step)
{
    dry out = {.least = INFINITY};
    for (size_t i = 0; i < count && i < 64 && out.count < FRICTION_MAX; i++) {
        friction f;
        if (!friction_of(&elements[i], 0.0, &f) || !(fmax(f.up, f.down) * step > STIFF * f.width))
            continue;
        out.least = fmin(out.least, f.width);
        out.most = fmax(out.most, f.width);
        out.from[out.count++] = &elements[i];
        out.taken |= (uint64_t)1 << i;
    }
    return out;
}

static void levels_at(dry *d, double v)
{
    d->up = d->down = 0.0;
    for (size_t j = 0; j < d->count; j++) {
        friction_of(d->from[j], v, &d->now[j]);
        d->up += d->now[j].up;
        d->down += d->now[j].down;
    }
}

static double drag(const dry *d, double v, double *slope)
{
    double sum = 0.0;
    *slope = 0.0;
    for (size_t j = 0; j < d->count; j++) {
        const double level = v < 0.0 ? d->now[j].down : d->now[j].up;
        const double share = smooth_sign(v / d->now[j].width);
        sum += level * share;
        *slope += level * (1.0 - share * share) / d->now[j].width;
    }
    return sum;
}

/* The velocity v with v + step drag(v) = alone: between 0 and alone, because drag has the sign of
 * v. near: an initial estimate, which is close to the solution if the body sticks. */
static double dragged(const dry *d, double alone, double step, double near)
{
    const double whole = step * (alone < 0.0 ? d->down : d->up), past = fabs(alone) - whole;
    if (past > SATURATED * d->most)
        return copysign(past, alone);
    if (!(whole > 0.0)) /* no resistance in this direction */
        return alone;
    double low = fmin(alone, 0.0), high = fmax(alone, 0.0), v = clamp(near, low, high);
    for (int k = 0; k < STICKS_MAX && d->count == 1; k++) {
        const double share = (alone - v) / whole, from = v;
        if (fabs(share) > 0.99)
            break;
        v = d->least * atanh(share);
        if (fabs(v - from) <= 1e-6 * whole)
            return v;
    }
    v = clamp(v, low, high);
    for (int k = 0; k < SOLVE_MAX; k++) {
        double slope;
        const double over = v + step * drag(d, v, &slope) - alone;
        *(over > 0.0 ? &high : &low) = v;
        const double next = v - over / (1.0 + step * slope), before = v;
        v = next >= low && next <= high ? next : 0.5 * (low + high);
        if (fabs(v - before) <= 1e-6 * d->least)
            break;
    }
    return v;
}

/* A step with friction and another acceleration a, the mean over the step, from a velocity at which
 * friction takes off `held` m/s^2. Returns the velocity at the end. If the body comes to rest
 * within the step, it continues from there: *way is then its displacement, otherwise NaN. */
static double rubbed(const dry *d, double v, double held, double a, double h, double mass,
                     double *way)
{
    *way = NAN;
    const double before = a - held;
    const int slides = fabs(v) > SATURATED * d->most;
    if (!slides || !(v * (v + before * h) < 0.0))
        return dragged(d, v + h * a, h / mass, v);
    const double until = clamp(-v / before, 0.0, h), left = h - until;
    const double end = dragged(d, left * a, left / mass, 0.0);
    *way = 0.5 * (v * until + end * left);
    return end;
}

/* Deceleration by friction at a velocity; a body at rest is held with as much as is needed, up to
 * the limit. */
static double held_back(const dry *d, double v, double a, double mass)
{
    if (v > SATURATED * d->most)
        return d->up / mass;
    if (v < -SATURATED * d->most)
        return -d->down / mass;
    double slope;
    const double up = d->up / mass, down = d->down / mass;
    if (fabs(v) < d->least) /* well below its largest force: the body is at rest */
        return clamp(a, -down, up);
    const double own = drag(d, v, &slope) / mass;
    return fabs(own) < 0.999 * (own < 0.0 ? down : up) ? clamp(a, -down, up) : own;
}

static double resisted(rthyb_element *elements, size_t count, uint64_t taken, double x, double v,
                       double a, double dt)
{
    double sum = 0.0;
    for (size_t i = 0; i < count; i++)
        if (i >= 64 || !(taken >> i & 1u))
            sum += rthyb_element_force(&elements[i], x, v, a, dt);
    return sum;
}

int rthyb_simulate_body(const rthyb_body_model *model, rthyb_element *elements,
                        size_t element_count, const double *force_n, size_t n, double *x_m,
                        double *v_m_per_s, double *a_m_per_s2)
{
    const int ok = model->period_s > 0.0 && model->period_s <= 1.0 && model->mass_kg > 0.0 &&
                   model->mass_kg <= 1e12 && model->substeps >= 1 &&
                   model->substeps <= SUBSTEPS_MAX && fabs(model->x0_m) <= 1e3 &&
                   fabs(model->v0_m_per_s) <= 1e6 &&
                   (model->hold == RTHYB_ZOH || model->hold == RTHYB_FOH);
    if (!ok)
        return RTHYB_E_MOTION;
    const double dr = 1.0 / model->substeps, h = model->period_s / model->substeps;
    const double mass = model->mass_kg;
    dry d = dry_of(elements, element_count, h / mass);
    double x = model->x0_m, v = model->v0_m_per_s, held = 0.0, a = 0.0;
    int code = RTHYB_OK;
    if (n > 0)
        a = (force_n[0] - resisted(elements, element_count, d.taken, x, v, 0.0, h)) / mass;
    if (d.count > 0) {
        levels_at(&d, v);
        held = held_back(&d, v, a, mass);
    }
    for (size_t i = 0; i < n; i++) {
        x_m[i] = x;
        v_m_per_s[i] = v;
        a_m_per_s2[i] = a - held;
        for (int k = 1; k <= model->substeps; k++) {
            const double p = command_at(force_n, n, (double)i + k * dr, model->hold);
            const double next = x + h * v + 0.5 * h * h * (a - held), guess = v + h * (a - held);
            const double net =
                p - resisted(elements, element_count, d.taken, next, guess, a - held, h);
            const double mean = 0.5 * (a + net / mass);
            double way = NAN;
            v = confine(d.count > 0 ? rubbed(&d, v, held, mean, h, mass, &way) : v + h * mean, 1e6,
                        &code);
            x = confine(isnan(way) ? next : x + way, RTHYB_DISPLACEMENT_MAX_M, &code);
            a = confine(net / mass, 1e9, &code);
            if (d.count > 0) {
                levels_at(&d, v);
                held = held_back(&d, v, a, mass);
            }
        }
    }
    return code == RTHYB_OK ? 0 : RTHYB_E_LIMIT;
}

/* Two points connected with a play of +-half: the follower stays at rest until it is pushed. */
int rthyb_simulate_play(double half_m, const double *x_m, size_t n, double *y_m)
{
    double y = n > 0 ? x_m[0] : 0.0;
    for (size_t i = 0; i < n; i++) {
        y = clamp(y, x_m[i] - half_m, x_m[i] + half_m);
        y_m[i] = y;
    }
    return half_m >= 0.0 ? 0 : RTHYB_E_ELEMENT;
}

/* Elastic, perfectly plastic springs of stiffness share[j] in parallel, each yielding at
 * yield_m[j]; every plastic loop that follows Masing's rule is such a sum. */
int rthyb_simulate_iwan(const double *yield_m, const double *share, size_t count, const double *x_m,
                        size_t n, double *force)
{
    double z[RTHYB_IWAN_MAX] = {0};
    if (count > RTHYB_IWAN_MAX)
        return RTHYB_E_ELEMENT;
    double before = n > 0 ? x_m[0] : 0.0;
    for (size_t j = 0; j < count; j++)
        z[j] = clamp(before, -yield_m[j], yield_m[j]);
    for (size_t i = 0; i < n; i++) {
        const double du = x_m[i] - before;
        double sum = 0.0;
        for (size_t j = 0; j < count; j++) {
            z[j] = clamp(z[j] + du, -yield_m[j], yield_m[j]);
            sum += share[j] * z[j];
        }
        force[i] = sum;
        before = x_m[i];
    }
    return 0;
}
