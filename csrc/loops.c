/* Yielding: force-displacement loops. All advance by the increment of x and are
 * rate-independent. */
#include "laws.h"
#include "numeric.h"

#define STEPS_MAX 64
#define STEP 0.05 /* of the ceiling of z: largest step along a loop */
#define NEWTON_MAX 20
#define TRAVEL_MAX_M 1e6
#define WORK_MAX_J 1e15 /* largest work over which strength may be lost */

static double power(double base, double exponent)
{
    if (exponent == 1.0)
        return base;
    if (exponent == 1.5)
        return base * sqrt(base);
    if (exponent == 2.0)
        return base * base;
    return pow(base, exponent);
}

static int steps_for(double du, double most)
{
    return fabs(du) > most ? (int)clamp(ceil(fabs(du) / most), 1.0, STEPS_MAX) : 1;
}

double rthyb_bouc_wen_ceiling(const double *p)
{
    const double sum = p[3] + p[4];
    return sum > 0.0 ? pow(p[2] / sum, 1.0 / p[5]) : RTHYB_DISPLACEMENT_MAX_M;
}

/* dz/du of Eqn 4.2, with v for z as in the paper; only the sign of du is used. Pinching reduces the
 * slope near z = 0 (Baber & Noori 1985, with their q = 0). */
static double bouc_wen_slope(const rthyb_element *e, double z, double du)
{
    const double *p = e->params;
    const double toward = du * z >= 0.0 ? 1.0 : -1.0;
    const double slope = p[2] - (p[3] * toward + p[4]) * power(fabs(z), p[5]);
    if (e->kind != RTHYB_PINCHING)
        return slope;
    const double r = z / (p[7] * p[RTHYB_BOUC_WEN_CEILING]);
    return slope * (1.0 - p[6] * exp(-r * r));
}

/* With a parameter of 0, the loss does not depend on this measure. */
static double worn_by(double measure, double scale)
{
    return scale > 0.0 ? measure / scale : 0.0;
}

/* What is left after the travel s[2] (m), the work s[3] (J) and the largest displacement s[4] (m);
 * each parameter is the one at which, without the others, 63 % of the loss has occurred. */
static double strength_left(const double *p, const double *s)
{
    const double worn = worn_by(s[2], p[7]) + worn_by(s[3], p[8]) + worn_by(s[4], p[9]);
    return 1.0 - p[6] * -expm1(-worn);
}

/* Eqn 4.1, 4.2: midpoint rule in steps of at most a twentieth of the ceiling of z. state: x of the
 * last call, z; of a degrading loop travel, work, largest |x|. The work is that of the loop before
 * degradation, and never decreases: k |z| times the distance. */
double rthyb_bouc_wen(rthyb_element *e, double x)
{
    const double *p = e->params;
    double *s = e->state;
    const double du = x - s[0], ceiling = p[RTHYB_BOUC_WEN_CEILING];
    const int steps = steps_for(du, STEP * ceiling);
    const double h = steps > 1 ? du / steps : du;
    double z = s[1], work = 0.0;
    for (int i = 0; i < steps && du != 0.0; i++) {
        const double before = z;
        const double middle = clamp(z + 0.5 * h * bouc_wen_slope(e, z, du), -ceiling, ceiling);
        z = clamp(z + h * bouc_wen_slope(e, middle, du), -ceiling, ceiling);
        work += p[0] * fabs(0.5 * (before + z) * h);
    }
    s[0] = x;
    s[1] = z;
    double strength = 1.0;
    if (e->kind == RTHYB_DEGRADATION) {
        s[2] = fmin(s[2] + fabs(du), TRAVEL_MAX_M);
        s[3] = fmin(s[3] + work, WORK_MAX_J);
        s[4] = fmax(s[4], fabs(x));
        strength = strength_left(p, s);
    }
    return p[1] * p[0] * x + (1.0 - p[1]) * p[0] * strength * z;
}

/* Springs in parallel, each with a slider, whose yield displacements are distributed uniformly over
 * xy (1 +- spread): Iwan, J. Appl. Mech. 33, 1966; after a reversal, loops follow Masing's rule
 * (1926). state: x, then the elongation of each spring. */
double rthyb_iwan(const double *p, double *s, double x)
{
    const double k = p[0], ratio = p[1], xy = p[2], spread = p[3];
    const double du = x - s[0];
    double *stretch = s + 1;
    double sum = 0.0;
    for (int j = 0; j < RTHYB_IWAN_SLIDERS; j++) {
        const double most = xy * (1.0 + spread * ((2 * j + 1.0) / RTHYB_IWAN_SLIDERS - 1.0));
        stretch[j] = clamp(stretch[j] + du, -most, most);
        sum += stretch[j];
    }
    s[0] = x;
    return k * (ratio * x + (1.0 - ratio) * sum / RTHYB_IWAN_SLIDERS);
}

/* r / (1 + r^n)^(1/n) for r >= 0, written so that no power overflows. */
static double rounded(double r, double n)
{
    return r <= 1.0 ? r / pow(1.0 + pow(r, n), 1.0 / n) : 1.0 / pow(1.0 + pow(r, -n), 1.0 / n);
}

/* Each branch leaves its reversal (xr, fr) with slope k and bends into the line of slope b k
 * through the yield point ahead, the more gradually the larger the previous plastic excursion:
 * Menegotto & Pinto, IABSE Reports 13, 1973, with R = R0 (1 - cR1 xi / (cR2 + xi)) as in Filippou,
 * Popov & Bertero, EERC 83-19, 1983. state: x, f, xr, fr, direction, largest and smallest x of a
 * reversal. */
double rthyb_menegotto_pinto(const double *p, double *s, double x)
{
    const double k = p[0], b = p[1], xy = p[2];
    if (x == s[0])
        return s[1];
    const double way = x > s[0] ? 1.0 : -1.0;
    if (way != s[4]) {
        s[2] = s[0];
        s[3] = s[1];
        s[4] = way;
        s[5] = fmax(s[5], s[0]);
        s[6] = fmin(s[6], s[0]);
    }
    /* From the reversal to the intersection of both lines; after rounding, a reversal may lie on
     * the second line. */
    const double reach = fmax(xy + way * (b * s[2] - s[3] / k) / (1.0 - b), 1e-6 * xy);
    const double peak = fmax(way > 0.0 ? s[5] : -s[6], xy);
    const double xi = fabs(peak - (way * s[2] + reach)) / xy;
    const double bend = fmax(p[3] * (1.0 - p[4] * xi / (p[5] + xi)), 0.05);
    const double r = way * (x - s[2]) / reach;
    const double f = s[3] + way * k * reach * (b * r + (1.0 - b) * rounded(r, bend));
    const double line = b * k * x, half = (1.0 - b) * k * xy;
    s[0] = x;
    s[1] = clamp(f, line - half, line + half);
    return s[1];
}

/* A spring in series with a slider whose yield range moves and grows: its centre q by
 *   q' = H xp' - gamma q |xp'|   (Armstrong & Frederick, CEGB RD/B/N731, 1966),
 * its half-width fy + r by
 *   r = Q (1 - e^(-rate path))   (Voce 1948),
 * combined as in Chaboche, Int. J. Plasticity 2, 1986. Both are exact along the plastic path d;
 * k (x - xp - d) = q + fy + r is convex in d, so that Newton's steps approach from one side.
 * state: plastic displacement, q, plastic path. */
double rthyb_chaboche(const double *p, double *s, double x)
{
    const double k = p[0], fy = p[1], h = p[2], gamma = p[3], growth = p[4], rate = p[5];
    const double trial = k * (x - s[0]), way = trial < s[1] ? -1.0 : 1.0;
    const double middle = way * s[1];
    double d = 0.0, q = middle;
    for (int i = 0; i < NEWTON_MAX; i++) {
        const double shed = -expm1(-gamma * d);
        q = middle * (1.0 - shed) + h * (gamma * d > 1e-9 ? shed / gamma : d);
        const double lost = growth * exp(-rate * (s[2] + d));
        const double excess = way * trial - k * d - q - fy - (growth - lost);
        if (excess <= 1e-13 * (fabs(trial) + fy))
            break;
        d += excess / (k + (1.0 - shed) * fmax(h - gamma * middle, 0.0) + rate * lost);
    }
    s[0] += way * d;
    s[1] = way * q;
    s[2] = fmin(s[2] + d, 1e6);
    return k * (x - s[0]);
}

static double share(double part, double whole)
{
    return clamp(part / whole, 0.0, 1.0);
}

/* Remaining strength, remaining stiffness in either direction, and the distance that cracks
 * slip. */
typedef struct {
    double strength, stiffness_up, stiffness_down, slip_m;
} wear;

/* By amplitude and by energy, as in the two terms of Park & Ang, J. Struct. Eng. 111, 1985.
 * Unloading is directed at a pivot at -pivot times the yield point: the factor (1 + pivot) /
 * (ductility + pivot) on the stiffness of the yielding part is the result of the pivot rule of
 * Sivaselvan & Reinhorn at the largest x. */
static wear column_wear(const double *p, const double *s)
{
    const double xy = p[2], pivot = p[4], spent = share(s[5], p[7]);
    const double up = fmax(s[2] - xy, 0.0), down = fmax(-s[3] - xy, 0.0);
    const double stiffness = (1.0 + pivot) * (1.0 - p[9] * spent);
    return (wear){
        .strength = (1.0 - p[6] * share(fmax(up, down), p[5] - xy)) * (1.0 - p[8] * spent),
        .stiffness_up = stiffness / (1.0 + up / xy + pivot),
        .stiffness_down = stiffness / (1.0 + down / xy + pivot),
        .slip_m = p[10] * (up + down),
    };
}

/* dz/du, way = sgn(du): a Bouc-Wen loop with eta1 = eta2 = 1/2, in series with a slip-lock spring
 * whose flexibility is a bell-shaped function of the force. */
static double column_slope(const double *p, const wear *left, double z, double way)
{
    const double ahead = way * z; /* above 0: the motion increases the force */
    const double unloading = z < 0.0 ? left->stiffness_down : left->stiffness_up;
    const double bent = ahead > 0.0 ? 1.0 - power(ahead, p[3]) : 1.0;
    const double slope = unloading / (p[2] * left->strength) * bent;
    const double off = (ahead - p[11]) / p[12];
    const double slip = sqrt(2.0 / RTHYB_PI) * left->slip_m / p[12] * exp(-0.5 * off * off);
    return slope / (1.0 + slope * slip);
}

/* The smooth model of Sivaselvan & Reinhorn, J. Eng. Mech. 126, 2000; slip begins with yielding. z:
 * force of the yielding part, relative to its strength. state: x, z, largest and smallest x, work,
 * largest work so far, f. */
double rthyb_rc_column(const double *p, double *s, double x)
{
    const double elastic = p[1] * p[0], yielding = (1.0 - p[1]) * p[0] * p[2];
    const double du = x - s[0], way = du < 0.0 ? -1.0 : 1.0;
    if (du == 0.0)
        return s[6];
    s[2] = fmax(s[2], x);
    s[3] = fmin(s[3], x);
    const wear left = column_wear(p, s);
    const int steps = steps_for(du, STEP * p[2] * left.strength);
    const double h = du / steps;
    double z = s[1];
    for (int i = 0; i < steps; i++) {
        const double middle = clamp(z + 0.5 * h * column_slope(p, &left, z, way), -1.0, 1.0);
        z = clamp(z + h * column_slope(p, &left, middle, way), -1.0, 1.0);
    }
    const double force = yielding * left.strength;
    s[4] = clamp(s[4] + 0.5 * force * (s[1] + z) * du, -1e100, 1e100);
    s[5] = fmax(s[5], s[4]);
    s[0] = x;
    s[1] = z;
    s[6] = elastic * x + force * z;
    return s[6];
}

/* A spring without loops of its own that is slack within the largest displacement so far, and whose
 * force returns, on each side, to where that was reached: the peak-oriented rule (Clough & Johnston,
 * Proc. Japan Earthq. Eng. Symp., 1966; with pinching, Ibarra, Medina & Krawinkler, Earthq. Eng. Struct. Dyn. 34, 2005),
 * with powers for their straight lines. state: largest x and -x so far. */
double rthyb_peak_oriented(const double *p, double *s, double x)
{
    const int down = x < 0.0;
    const double far = fabs(x), reach = p[2];
    s[down] = fmax(s[down], far);
    const double peak = fmax(s[down], p[5]);
    const double most = p[down] * reach * power(peak / reach, p[4]);
    return copysign(most * power(far / peak, p[3]), x);
}

/* One side of a Takeda loop, counted in its own direction: its strength, the excursion at which reloading aims, the
 * force there, and the slope of unloading from it. */
typedef struct {
    double strength, peak_m, force_n, unloading;
} aim;

/* First loading: k up to xy, then a k, the corner rounded as by Menegotto & Pinto; softening ends at zero force. */
static double first_loading(const double *p, double strength, double far)
{
    const double r = far / p[2];
    return strength * p[0] * p[2] * fmax(p[1] * r + (1.0 - p[1]) * rounded(r, p[3]), 0.0);
}

/* A side that has not yielded is aimed at as far out as the other side has been, up to its yield point. Unloading is
 * never softer than straight to zero, or a closed cycle would give energy. */
static aim aim_at(const double *p, const double *s, int down)
{
    const double xy = p[2], size = down ? p[8] : 1.0;
    const double peak = fmax(s[3 + down], fmin(s[4 - down], xy));
    const double strength = size * exp(-s[6] / p[7]), far = fmax(peak, xy);
    const double softened = size * p[0] * power(xy / far, p[4]);
    return (aim){
        .strength = strength,
        .peak_m = peak,
        .force_n = first_loading(p, strength, peak),
        .unloading = fmax(softened, first_loading(p, size, far) / far),
    };
}

/* From where the force was zero towards the aim, in two straight lines. Their corner lies at p[6] of the force: if p[5]
 * is 0, on the direct line, or with p[9] = 0 where the force was zero; if it is 1, on the line of unloading. */
static double reloading(const double *p, const aim *to, double zero, double x)
{
    if (x <= zero)
        return 0.0;
    const double way = fmax(to->peak_m - zero, 1e-9 * to->peak_m);
    const double direct = zero + p[9] * p[6] * way;
    const double late = to->peak_m - (1.0 - p[6]) * to->force_n / to->unloading;
    const double corner = direct + p[5] * (clamp(late, direct, to->peak_m - 1e-3 * way) - direct);
    if (x < corner)
        return p[6] * to->force_n * (x - zero) / (corner - zero);
    return to->force_n * (p[6] + (1.0 - p[6]) * share(x - corner, to->peak_m - corner));
}

/* Unloading softens with the largest excursion of its side, as (xy / peak)^exponent (Takeda, Sozen & Nielsen,
 * J. Struct. Div. ASCE 96, 1970); reloading aims at the largest excursion of the other one (Clough & Johnston,
 * 1966), with pinching in two lines (Ibarra, Medina & Krawinkler, Earthq. Eng. Struct. Dyn. 34, 2005); strength
 * decreases with the work done. state: x, f, x where f was zero last, largest x and -x, work, largest work so far. */
double rthyb_takeda(const double *p, double *s, double x)
{
    if (x == s[0])
        return s[1];
    const int down = x < s[0];
    const double way = down ? -1.0 : 1.0, here = way * x, before = s[1];
    double from = way * s[0], f = way * s[1];
    if (f < 0.0) {
        const double slope = aim_at(p, s, !down).unloading;
        const double zero = fmin(from - f / slope, here);
        f += slope * (here - from);
        if (f >= 0.0) {
            s[2] = way * zero;
            from = zero;
            f = 0.0;
        }
    }
    if (f >= 0.0) {
        const aim to = aim_at(p, s, down);
        const double most = here > to.peak_m ? first_loading(p, to.strength, here)
                                             : reloading(p, &to, way * s[2], here);
        f = fmin(f + to.unloading * (here - from), most);
        s[3 + down] = fmax(s[3 + down], here);
    }
    s[5] = clamp(s[5] + 0.5 * (before + way * f) * (x - s[0]), -1e100, 1e100);
    s[0] = x;
    s[1] = way * f;
    s[6] = fmax(s[6], s[5]);
    return s[1];
}
