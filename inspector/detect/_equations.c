/* One spot's equations: Gaussians and their derivatives over its window, products with its pixels, and a small solver. */
#include "_fit.h"

/* A spot's Gaussian, ready to be evaluated: centre, log of the peak, inverse blur covariance. */
typedef struct { double x, y, log_peak, xx, xy, yy; } Gaussian;

/* Spot j's, as seen from the middle of spot i's window. */
static Gaussian ready(const Work *w, i64 j, i64 i) {
    const double *t = w->theta + j * PARAMETERS;
    double det = t[SXX] * t[SYY] - t[SXY] * t[SXY];
    double x = (double)(w->centre[2 * j] - w->centre[2 * i]), y = (double)(w->centre[2 * j + 1] - w->centre[2 * i + 1]);
    return (Gaussian){t[X] + x, t[Y] + y, t[LOG_PEAK], t[SYY] / det, -t[SXY] / det, t[SXX] / det};
}

/* exp(x) for |x| < 700, to 1e-14 of itself, without a branch or a call, so that a loop of it runs in vectors: with
 * x = n ln 2 + r the series of exp(r), |r| < 0.35, is scaled by 2^n. Adding 1.5 * 2^52 rounds to n in the lowest bits. The
 * series is summed in pairs (Estrin), which keeps a processor's pipes fuller than term by term. */
static inline double exponential(double x) {
    const double ROUND = 0x1.8p52, LOG2_E = 0x1.71547652b82fep0, LN2_HIGH = 0x1.62e42fefa38p-1, LN2_LOW = 0x1.ef35793c7673p-45;
    double shifted = x * LOG2_E + ROUND, n = shifted - ROUND, r = (x - n * LN2_HIGH) - n * LN2_LOW, r2 = r * r, r4 = r2 * r2;
    double low = (1 + r) + r2 * (1. / 2 + r * (1. / 6)), middle = (1. / 24 + r * (1. / 120)) + r2 * (1. / 720 + r * (1. / 5040));
    double high = (1. / 40320 + r * (1. / 362880)) + r2 * (1. / 3628800 + r * (1. / 39916800)), e = low + r4 * (middle + r4 * high);
    uint64_t bits, scale;
    memcpy(&bits, &e, sizeof bits), memcpy(&scale, &shifted, sizeof scale);
    bits += scale << 52;
    memcpy(&e, &bits, sizeof e);
    return e;
}

enum { BRIGHT = 40 };      /* a light of exp(40) DN: a fit on its way to nowhere */

/* exp(e), dark and bright ends cut. */
static inline double light_of(double e) {
    double light = exponential(e > DARK ? e < BRIGHT ? e : BRIGHT : DARK);
    return e < DARK ? 0 : light;
}

/* Take a Gaussian's light at p offsets away from `residual`. */
WIDE static void subtract(const Gaussian *g, i64 p, const double *restrict dx, const double *restrict dy,
                          double *restrict residual) {
    for (i64 k = 0; k < p; k++) {
        double ex = dx[k] - g->x, ey = dy[k] - g->y, ux = g->xx * ex + g->xy * ey, uy = g->xy * ex + g->yy * ey;
        residual[k] -= light_of(g->log_peak - 0.5 * (ux * ex + uy * ey));
    }
}

/* Derivatives of a Gaussian's light at p offsets by its parameters; that by the log of its peak is the light itself. */
WIDE static void derive(const Gaussian *g, i64 p, const double *restrict dx, const double *restrict dy, double *restrict x,
                        double *restrict y, double *restrict peak, double *restrict xx, double *restrict xy,
                        double *restrict yy) {
    for (i64 k = 0; k < p; k++) {
        double ex = dx[k] - g->x, ey = dy[k] - g->y, ux = g->xx * ex + g->xy * ey, uy = g->xy * ex + g->yy * ey;
        double spot = light_of(g->log_peak - 0.5 * (ux * ex + uy * ey));
        x[k] = spot * ux, y[k] = spot * uy, peak[k] = spot;
        xx[k] = 0.5 * spot * ux * ux, xy[k] = spot * ux * uy, yy[k] = 0.5 * spot * uy * uy;
    }
}

static void derive_rows(const Gaussian *g, i64 p, const double *dx, const double *dy, double *by) {
    derive(g, p, dx, dy, by + X * p, by + Y * p, by + LOG_PEAK * p, by + SXX * p, by + SXY * p, by + SYY * p);
}

/* Four numbers side by side, wherever they lie. */
typedef double Quad __attribute__((vector_size(32), aligned(8), may_alias));

static inline Quad quad(const double *p) { return *(const Quad *)p; }

/* The LANES partial sums of two vectors together. */
static inline double total(Quad low, Quad high) {
    return ((low[0] + low[1]) + (low[2] + low[3])) + ((high[0] + high[1]) + (high[2] + high[3]));
}

/* Sum of products, in as many partial sums as fill two vectors of AVX2: the same whatever the processor's are. p is a
 * multiple of LANES. */
static inline double inner(i64 p, const double *a, const double *b) {
    Quad low = {0}, high = {0};
    for (i64 k = 0; k < p; k += LANES) low += quad(a + k) * quad(b + k), high += quad(a + k + 4) * quad(b + k + 4);
    return total(low, high);
}

/* `inner` of a row with each of `count` rows that follow each other, three at a time: sums that do not wait for each other. */
static inline void inner_each(i64 p, const double *a, const double *b, int count, double *out) {
    int n = 0;
    for (; n + 3 <= count; n += 3) {
        const double *b0 = b + n * p, *b1 = b0 + p, *b2 = b1 + p;
        Quad low0 = {0}, high0 = {0}, low1 = {0}, high1 = {0}, low2 = {0}, high2 = {0};
        for (i64 k = 0; k < p; k += LANES) {
            Quad low = quad(a + k), high = quad(a + k + 4);
            low0 += low * quad(b0 + k), high0 += high * quad(b0 + k + 4);
            low1 += low * quad(b1 + k), high1 += high * quad(b1 + k + 4);
            low2 += low * quad(b2 + k), high2 += high * quad(b2 + k + 4);
        }
        out[n] = total(low0, high0), out[n + 1] = total(low1, high1), out[n + 2] = total(low2, high2);
    }
    for (; n < count; n++) out[n] = inner(p, a, b + n * p);
}

/* What the model leaves over, and how much each pixel counts: a clipped one asks only for at least this much. */
WIDE static void compare(i64 p, const double *t, const double *restrict light, const double *restrict weight,
                         const double *restrict clipped, const double *restrict dx, const double *restrict dy,
                         const double *restrict spot, double *restrict residual, double *restrict counts) {
    for (i64 k = 0; k < p; k++) {
        double over = residual[k] + light[k] - spot[k] - t[BACKGROUND] - t[SLOPE_X] * dx[k] - t[SLOPE_Y] * dy[k];
        counts[k] = over < clipped[k] ? 0 : weight[k];
        residual[k] = counts[k] > 0 ? over : 0;
    }
}

WIDE static void weigh(i64 p, const double *restrict counts, const double *restrict by, double *restrict weighted) {
    for (int a = 0; a < PARAMETERS; a++)
        for (i64 k = 0; k < p; k++) weighted[a * p + k] = counts[k] * by[a * p + k];
}

void fit_linearise(const Work *w, i64 i, double *by, double *weighted, double *room) {
    i64 p = w->count[i], at = w->begin[i];
    double *residual = w->residual + at;
    Gaussian own = ready(w, i, i);
    derive_rows(&own, p, w->dx, w->dy, by);
    for (i64 k = 0; k < p; k++) by[BACKGROUND * p + k] = 1;
    memcpy(by + SLOPE_X * p, w->dx, (size_t)p * sizeof *by), memcpy(by + SLOPE_Y * p, w->dy, (size_t)p * sizeof *by);
    memset(residual, 0, (size_t)p * sizeof *residual);
    for (i64 m = w->neighbours[i]; m < w->neighbours[i + 1]; m++) {
        Gaussian other = ready(w, w->neighbour[m], i);
        subtract(&other, p, w->dx, w->dy, residual);
    }
    compare(p, w->theta + i * PARAMETERS, w->light + at, w->weight + at, w->asks + at, w->dx, w->dy, by + LOG_PEAK * p, residual, room);
    weigh(p, room, by, weighted);
}

WIDE void fit_normal_equations(const Work *w, const Rules *u, i64 i, const double *by, const double *weighted) {
    i64 p = w->count[i];
    const double *t = w->theta + i * PARAMETERS, *expected = w->expected + i * PARAMETERS, *prior = w->prior + i * PARAMETERS;
    double *matrix = w->normal + i * PARAMETERS * PARAMETERS, *gradient = w->gradient + i * PARAMETERS;
    for (int a = 0; a < PARAMETERS; a++) {
        inner_each(p, weighted + a * p, by, a + 1, matrix + a * PARAMETERS);
        for (int b = 0; b < a; b++) matrix[b * PARAMETERS + a] = matrix[a * PARAMETERS + b];
        double hold = prior[a] * ((a == SXX || a == SYY) && t[a] < expected[a] ? u->sharper : 1);
        matrix[a * PARAMETERS + a] += hold + 1e-9 * matrix[a * PARAMETERS + a] + 1e-12;
        gradient[a] = inner(p, weighted + a * p, w->residual + w->begin[i]) - hold * (t[a] - expected[a]);
    }
}

WIDE void fit_couple(const Work *w, i64 i, i64 j, const double *weighted, double *restrict room, i64 m, double *block) {
    i64 p = w->count[i];
    Gaussian other = ready(w, j, i);
    derive_rows(&other, p, w->dx, w->dy, room);
    for (int x = 0; x < PARAMETERS; x++) inner_each(p, weighted + x * p, room, SHAPE, block + x * m);
}

/* Solve the m x m system in place by elimination with pivots; columns of `right` are (m, k). 0 where singular. */
int kernel_solve(i64 m, double *a, i64 k, double *right) {
    for (i64 c = 0; c < m; c++) {
        i64 pivot = c;
        for (i64 r = c + 1; r < m; r++)
            if (fabs(a[r * m + c]) > fabs(a[pivot * m + c])) pivot = r;
        double lead = a[pivot * m + c];
        if (!(fabs(lead) > 0) || !isfinite(lead)) return 0;
        if (pivot != c) {
            for (i64 j = c; j < m; j++) { double s = a[c * m + j]; a[c * m + j] = a[pivot * m + j]; a[pivot * m + j] = s; }
            for (i64 j = 0; j < k; j++) { double s = right[c * k + j]; right[c * k + j] = right[pivot * k + j]; right[pivot * k + j] = s; }
        }
        for (i64 r = c + 1; r < m; r++) {
            double f = a[r * m + c] / lead;
            if (f == 0) continue;
            for (i64 j = c + 1; j < m; j++) a[r * m + j] -= f * a[c * m + j];
            for (i64 j = 0; j < k; j++) right[r * k + j] -= f * right[c * k + j];
        }
    }
    for (i64 r = m - 1; r >= 0; r--)
        for (i64 j = 0; j < k; j++) {
            double s = right[r * k + j];
            for (i64 c = r + 1; c < m; c++) s -= a[r * m + c] * right[c * k + j];
            right[r * k + j] = s / a[r * m + r];
        }
    return 1;
}
