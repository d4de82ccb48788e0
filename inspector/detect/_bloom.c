/* Spots so bright that their charge runs over: fitted with the overflow in the model.
 *
 * A full pixel passes what it cannot hold to its two neighbours along the column (or row), half each, and a share of it
 * is drained at every step. Cumulative overflow u then obeys u_i - b/2 (u_i-1 + u_i+1) = E_i - S where the pixel is
 * full, u = 0 elsewhere: a tridiagonal system on each full run, whose ends grow until no neighbour is over-full.
 */
#include "_kernel.h"

typedef struct {      /* a patch of light: data, weight (0: not used), full scale, and which way charge runs */
    i64 height, width, along_rows;
    const double *light, *weight;
    double full, end_variance;
} Patch;

enum { SPOT = 3 };                                             /* x, y, log of the flux */
enum { LEVEL, SLOPE_X, SLOPE_Y, LOG_BLUR, KEPT, SHARED };      /* after the spots' parameters */

/* Cumulative overflow of one line of n pixels; `full_pixel` marks those that run over. */
static void overflow(i64 n, const double *e, double full, double kept, double *u, uint8_t *full_pixel, double *ratio) {
    int grew = 1;
    for (i64 i = 0; i < n; i++) full_pixel[i] = e[i] > full, u[i] = 0;
    for (i64 turn = 0; grew && turn < n; turn++) {
        double half = kept / 2;
        for (i64 i = 0; i < n; i++) {      /* elimination down each run, and back substitution up */
            int chained = i && full_pixel[i - 1];
            if (!full_pixel[i]) { u[i] = ratio[i] = 0; continue; }
            double pivot = 1 - (chained ? half * ratio[i - 1] : 0);
            ratio[i] = half / pivot;
            u[i] = (e[i] - full + (chained ? half * u[i - 1] : 0)) / pivot;
        }
        for (i64 i = n - 2; i >= 0; i--)
            if (full_pixel[i] && full_pixel[i + 1]) u[i] += ratio[i] * u[i + 1];
        grew = 0;
        for (i64 i = 0; i < n; i++) {
            double from = half * ((i ? u[i - 1] : 0) + (i + 1 < n ? u[i + 1] : 0));
            if (!full_pixel[i] && e[i] + from > full * (1 + 1e-12)) full_pixel[i] = 1, grew = 1;
        }
    }
}

/* The share of a Gaussian of standard deviation s about m that pixel i collects. */
static inline double collected(double i, double m, double s) {
    return 0.5 * (erf((i - m + 0.5) / (s * SQRT_2)) - erf((i - m - 0.5) / (s * SQRT_2)));
}

/* Light of the patch for the parameters t of n spots; `ends` marks the pixels next to a full one along the run. */
static void model(const Patch *q, i64 n, const double *t, double *out, uint8_t *ends, double *room, uint8_t *marks) {
    const double *shared = t + n * SPOT;
    double s = exp(0.5 * shared[LOG_BLUR]), *ex = room, *ey = ex + q->width;
    for (i64 r = 0; r < q->height; r++)
        for (i64 c = 0; c < q->width; c++)
            out[r * q->width + c] = shared[LEVEL] + shared[SLOPE_X] * (double)c + shared[SLOPE_Y] * (double)r;
    for (i64 k = 0; k < n; k++) {
        const double *p = t + k * SPOT;
        double flux = exp(fmin(p[2], 40));
        for (i64 c = 0; c < q->width; c++) ex[c] = collected((double)c, p[0], s);
        for (i64 r = 0; r < q->height; r++) ey[r] = flux * collected((double)r, p[1], s);
        for (i64 r = 0; r < q->height; r++)
            for (i64 c = 0; c < q->width; c++) out[r * q->width + c] += ey[r] * ex[c];
    }
    i64 lines = q->along_rows ? q->width : q->height, length = q->along_rows ? q->height : q->width;
    i64 step = q->along_rows ? q->width : 1, next = q->along_rows ? 1 : q->width;
    double *e = room, *u = e + length, *ratio = u + length;
    for (i64 l = 0; l < lines; l++) {
        for (i64 i = 0; i < length; i++) e[i] = out[l * next + i * step];
        overflow(length, e, q->full, shared[KEPT], u, marks, ratio);
        for (i64 i = 0; i < length; i++) {
            double from = shared[KEPT] / 2 * ((i ? u[i - 1] : 0) + (i + 1 < length ? u[i + 1] : 0));
            out[l * next + i * step] = marks[i] ? q->full : e[i] + from;
            ends[l * next + i * step] = !marks[i] && ((i && marks[i - 1]) || (i + 1 < length && marks[i + 1]));
        }
    }
}

/* Weighted residuals (pixels) of the patch; returns their sum of squares with the prior's. */
static double residuals(const Patch *q, i64 n, i64 m, const double *t, const double *expected, const double *prior,
                        double *out, uint8_t *ends, double *room, uint8_t *marks) {
    double cost = 0;
    i64 pixels = q->height * q->width;
    model(q, n, t, out, ends, room, marks);
    for (i64 i = 0; i < pixels; i++) {
        double w = q->weight[i];
        if (ends[i] && w > 0) w = 1 / (1 / w + q->end_variance);      /* how far charge ran is known less well */
        out[i] = (q->light[i] - out[i]) * sqrt(w);
        cost += out[i] * out[i];
    }
    for (i64 a = 0; a < m; a++) cost += prior[a] * (t[a] - expected[a]) * (t[a] - expected[a]);
    return cost;
}

/* Levenberg-Marquardt on the m = 3 n + 5 parameters `t` (in and out) with a Gaussian prior of inverse variances `prior`.
 * `covariance` gets (m, m). Returns the rounds taken, or -1 without memory; `cost` the final weighted sum of squares. */
i64 bloom_fit(i64 height, i64 width, i64 along_rows, const double *light, const double *weight, double full,
              double end_variance, i64 n, double *t, const double *prior, i64 most_rounds, double *covariance,
              double *cost, double *misfit) {
    Patch q = {height, width, along_rows, light, weight, full, end_variance};
    i64 m = n * SPOT + SHARED, pixels = height * width, longest = height > width ? height : width, round = -1;
    double *memory = malloc((size_t)(pixels * (m + 2) + 3 * longest + height + width + 2 * m * m + 4 * m) * sizeof *memory);
    uint8_t *bytes = malloc((size_t)(2 * pixels + longest));
    if (memory && bytes) {
        double *base = memory, *moved = base + pixels, *jacobian = moved + pixels, *room = jacobian + pixels * m;
        double *normal = room + 3 * longest + height + width, *system = normal + m * m, *gradient = system + m * m;
        double *step = gradient + m, *trial = step + m, *expected = trial + m, damping = 1e-3;
        uint8_t *ends = bytes, *trial_ends = ends + pixels, *marks = trial_ends + pixels;
        memcpy(expected, t, (size_t)m * sizeof *t);
        *cost = residuals(&q, n, m, t, expected, prior, base, ends, room, marks);
        for (round = 0; round < most_rounds; round++) {
            for (i64 a = 0; a < m; a++) {
                double by = a < n * SPOT ? 1e-3 : a == n * SPOT + KEPT ? 1e-4 : 1e-3;
                memcpy(trial, t, (size_t)m * sizeof *t);
                trial[a] += by;
                residuals(&q, n, m, trial, expected, prior, moved, trial_ends, room, marks);
                for (i64 i = 0; i < pixels; i++) {
                    double change = (base[i] - moved[i]) / by;      /* a run that ends elsewhere is no derivative */
                    jacobian[a * pixels + i] = ends[i] == trial_ends[i] ? change : 0;
                }
            }
            for (i64 a = 0; a < m; a++) {
                gradient[a] = -prior[a] * (t[a] - expected[a]);
                for (i64 i = 0; i < pixels; i++) gradient[a] += jacobian[a * pixels + i] * base[i];
                for (i64 b = 0; b <= a; b++) {
                    double sum = a == b ? prior[a] + 1e-12 : 0;
                    for (i64 i = 0; i < pixels; i++) sum += jacobian[a * pixels + i] * jacobian[b * pixels + i];
                    normal[a * m + b] = normal[b * m + a] = sum;
                }
            }
            double before = *cost, largest = 0;
            for (int tries = 0; tries < 8; tries++) {
                memcpy(system, normal, (size_t)(m * m) * sizeof *normal);
                memcpy(step, gradient, (size_t)m * sizeof *step);
                for (i64 a = 0; a < m; a++) system[a * m + a] *= 1 + damping;
                if (!kernel_solve(m, system, 1, step)) break;
                for (i64 a = 0; a < m; a++) trial[a] = t[a] + fmax(fmin(step[a], 0.5), -0.5) * (a < n * SPOT || a >= n * SPOT + LOG_BLUR ? 1 : 1);
                for (i64 a = n * SPOT; a < n * SPOT + LOG_BLUR; a++) trial[a] = t[a] + step[a];
                trial[n * SPOT + KEPT] = fmin(fmax(trial[n * SPOT + KEPT], 0), 0.999);
                double now = residuals(&q, n, m, trial, expected, prior, moved, trial_ends, room, marks);
                if (now < *cost) {
                    for (i64 a = 0; a < n * SPOT; a++) largest = fmax(largest, fabs(trial[a] - t[a]));
                    memcpy(t, trial, (size_t)m * sizeof *t), memcpy(base, moved, (size_t)pixels * sizeof *base);
                    memcpy(ends, trial_ends, (size_t)pixels);
                    *cost = now, damping = fmax(damping / 5, 1e-7);
                    break;
                }
                damping *= 6;
            }
            if (!(before - *cost > 1e-4 * before) && largest < 2e-3) break;
        }
        memset(covariance, 0, (size_t)(m * m) * sizeof *covariance);
        for (i64 a = 0; a < m; a++) covariance[a * m + a] = 1;
        if (!kernel_solve(m, normal, m, covariance))
            for (i64 a = 0; a < m * m; a++) covariance[a] = NAN;
        memcpy(misfit, base, (size_t)pixels * sizeof *base);
    }
    free(memory), free(bytes);
    return round;
}
