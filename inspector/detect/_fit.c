/* The fit of spots: elliptical Gaussians on sloping ground, Gauss-Newton, touching spots together. See fit.py. */
#include "_kernel.h"

enum { X, Y, LOG_PEAK, SXX, SXY, SYY, BACKGROUND, SLOPE_X, SLOPE_Y, PARAMETERS };
enum { SHAPE = 6 };

struct Rules {      /* how grey values become light, what is clipped, and when a fit has settled; see fit.py */
    double black, gamma, clipped, full, level, read_dn, shot_per_dn, pattern;
    double threshold, least_radius, most_radius, tangled_px, damping, settled_px, held_share, free_share, steep_share;
    double scatter_share, sharper;
    i64 bloom_rows, bloom_columns, rounds;
};

typedef struct {      /* the spots' windows: light, weight and clipped (n, p); offsets (p); neighbours as lists */
    i64 n, p;
    double *dx, *dy, *light, *weight, *residual, *derivative;
    uint8_t *clipped;
    i64 *neighbour, *neighbours;
} Work;

static double linear(const Rules *u, double v) {
    if (u->gamma == 1) return v;
    double span = u->full - u->black, t = (v - u->black) / span;
    return (t > 0 ? pow(t, 1 / u->gamma) : 0) * span + u->black;
}

static int is_clipped(const Image *im, const Rules *u, i64 r, i64 c) {
    return r >= 0 && r < im->height && c >= 0 && c < im->width && grey(im, r, c) >= u->clipped;
}

/* Fill one spot's window. A bloomed run's ends, and in a blooming frame the clipped pixels, tell nothing: weight 0. */
static void cut(const Image *im, const Rules *u, Work *w, i64 i, const i64 *centre, double radius) {
    int blooms = u->bloom_rows || u->bloom_columns;
    for (i64 k = 0; k < w->p; k++) {
        i64 r = centre[1] + (i64)w->dy[k], c = centre[0] + (i64)w->dx[k], at = i * w->p + k;
        w->light[at] = w->weight[at] = 0, w->clipped[at] = 0;
        if (r < 0 || r >= im->height || c < 0 || c >= im->width) continue;
        if (w->dx[k] * w->dx[k] + w->dy[k] * w->dy[k] > (radius + 0.3) * (radius + 0.3)) continue;
        double v = grey(im, r, c), light = linear(u, v), signal = fmax(light - u->level, 0);
        w->light[at] = light;
        w->clipped[at] = v >= u->clipped;
        if (blooms && (w->clipped[at] || is_clipped(im, u, r + u->bloom_rows, c + u->bloom_columns) ||
                       is_clipped(im, u, r - u->bloom_rows, c - u->bloom_columns)))
            continue;
        double pattern = u->pattern * light;
        w->weight[at] = 1 / (u->read_dn * u->read_dn + signal * u->shot_per_dn + pattern * pattern);
    }
}

/* A spot's Gaussian, ready to be evaluated: centre, log of the peak, inverse blur covariance. */
typedef struct { double x, y, log_peak, xx, xy, yy; } Gaussian;

static Gaussian ready(const double *t, double x, double y) {
    double det = t[SXX] * t[SYY] - t[SXY] * t[SXY];
    Gaussian g = {t[X] + x, t[Y] + y, t[LOG_PEAK], t[SYY] / det, -t[SXY] / det, t[SXX] / det};
    return g;
}

enum { DARK = -12 };      /* a light of exp(-12) DN is none */

/* Its value at (x, y), and Sigma^-1 d in ux, uy. */
static inline double gaussian(const Gaussian *g, double x, double y, double *ux, double *uy) {
    double ex = x - g->x, ey = y - g->y;
    *ux = g->xx * ex + g->xy * ey, *uy = g->xy * ex + g->yy * ey;
    double e = g->log_peak - 0.5 * (*ux * ex + *uy * ey);
    return e < DARK ? 0 : exp(e < 40 ? e : 40);
}

static inline void derivatives(double spot, double ux, double uy, double *d) {
    d[X] = spot * ux, d[Y] = spot * uy, d[LOG_PEAK] = spot;
    d[SXX] = 0.5 * spot * ux * ux, d[SXY] = spot * ux * uy, d[SYY] = 0.5 * spot * uy * uy;
}

/* Residuals and derivatives (p, 9) of one spot's window, its neighbours' light subtracted. */
static void linearise(const Work *w, i64 i, const double *theta, const i64 *centre) {
    const double *t = theta + i * PARAMETERS;
    Gaussian own = ready(t, 0, 0), other[w->neighbours[i] + 1];
    for (i64 m = 0; m < w->neighbours[i]; m++) {
        i64 j = w->neighbour[i * w->n + m];
        other[m] = ready(theta + j * PARAMETERS, (double)(centre[2 * j] - centre[2 * i]), (double)(centre[2 * j + 1] - centre[2 * i + 1]));
    }
    for (i64 k = 0; k < w->p; k++) {
        i64 at = i * w->p + k;
        double *d = w->derivative + at * PARAMETERS, ux, uy, x = w->dx[k], y = w->dy[k];
        if (w->weight[at] == 0) {
            w->residual[at] = 0;
            continue;
        }
        double spot = gaussian(&own, x, y, &ux, &uy), vx, vy;
        double r = w->light[at] - spot - t[BACKGROUND] - t[SLOPE_X] * x - t[SLOPE_Y] * y;
        for (i64 m = 0; m < w->neighbours[i]; m++) r -= gaussian(other + m, x, y, &vx, &vy);
        derivatives(spot, ux, uy, d);
        d[BACKGROUND] = 1, d[SLOPE_X] = x, d[SLOPE_Y] = y;
        if (w->clipped[at] && r < 0) {      /* a clipped pixel asks only for at least this much */
            r = 0;
            memset(d, 0, PARAMETERS * sizeof *d);
        }
        w->residual[at] = r;
    }
}

/* Normal matrix (9, 9) and gradient of one window, with the prior. */
static void normal_equations(const Work *w, const Rules *u, i64 i, const double *t, const double *expected, const double *prior,
                             double *matrix, double *gradient) {
    memset(matrix, 0, PARAMETERS * PARAMETERS * sizeof *matrix);
    memset(gradient, 0, PARAMETERS * sizeof *gradient);
    for (i64 k = 0; k < w->p; k++) {
        i64 at = i * w->p + k;
        const double *d = w->derivative + at * PARAMETERS;
        if (w->weight[at] == 0) continue;
        for (int a = 0; a < PARAMETERS; a++) {
            double wd = w->weight[at] * d[a];
            gradient[a] += wd * w->residual[at];
            for (int b = 0; b <= a; b++) matrix[a * PARAMETERS + b] += wd * d[b];
        }
    }
    for (int a = 0; a < PARAMETERS; a++) {
        for (int b = 0; b < a; b++) matrix[b * PARAMETERS + a] = matrix[a * PARAMETERS + b];
        double hold = prior[a] * ((a == SXX || a == SYY) && t[a] < expected[a] ? u->sharper : 1);
        matrix[a * PARAMETERS + a] += hold + 1e-9 * matrix[a * PARAMETERS + a] + 1e-12;
        gradient[a] -= hold * (t[a] - expected[a]);
    }
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

/* Newton step of a tangle: each member's own equations, with what the other members' parameters do to them. */
static int joint_step(const Work *w, const Rules *u, const double *theta, const i64 *centre, i64 size, const i64 *members,
                      const double *normal, const double *gradient, double *step) {
    i64 m = size * PARAMETERS;
    double *system = calloc((size_t)(m * m + m), sizeof *system), *right = system + m * m;
    if (!system) return 0;
    for (i64 a = 0; a < size; a++) {
        i64 i = members[a];
        for (int x = 0; x < PARAMETERS; x++) {
            double *row = system + (a * PARAMETERS + x) * m;
            memcpy(row + a * PARAMETERS, normal + (i * PARAMETERS + x) * PARAMETERS, PARAMETERS * sizeof *row);
            row[a * PARAMETERS + x] *= 1 + u->damping;
            right[a * PARAMETERS + x] = gradient[i * PARAMETERS + x];
        }
        for (i64 b = 0; b < size; b++) {
            i64 j = members[b];
            if (a == b) continue;
            Gaussian g = ready(theta + j * PARAMETERS, (double)(centre[2 * j] - centre[2 * i]), (double)(centre[2 * j + 1] - centre[2 * i + 1]));
            for (i64 k = 0; k < w->p; k++) {
                i64 at = i * w->p + k;
                double d[SHAPE], ux, uy;
                if (w->weight[at] == 0) continue;
                double spot = gaussian(&g, w->dx[k], w->dy[k], &ux, &uy);
                derivatives(spot, ux, uy, d);
                for (int x = 0; x < PARAMETERS; x++) {
                    double wd = w->weight[at] * w->derivative[at * PARAMETERS + x];
                    double *row = system + (a * PARAMETERS + x) * m + b * PARAMETERS;
                    for (int y = 0; y < SHAPE; y++) row[y] += wd * d[y];
                }
            }
        }
    }
    int fine = kernel_solve(m, system, 1, right);
    if (fine)
        for (i64 a = 0; a < size; a++) memcpy(step + members[a] * PARAMETERS, right + a * PARAMETERS, PARAMETERS * sizeof *step);
    free(system);
    return fine;
}

static double bounded(double v, double limit) { return v > limit ? limit : v < -limit ? -limit : isfinite(v) ? v : 0; }

/* Keep a step where the linear model can be believed; returns the larger move of the centre. */
static double apply(double *t, const double *step) {
    double blur = 0.3 * fmin(t[SXX], t[SYY]);
    t[X] += bounded(step[X], 0.5), t[Y] += bounded(step[Y], 0.5), t[LOG_PEAK] += bounded(step[LOG_PEAK], 1);
    for (int a = SXX; a <= SYY; a++) t[a] += bounded(step[a], blur);
    for (int a = BACKGROUND; a < PARAMETERS; a++) t[a] += bounded(step[a], 1e6);
    return fmax(fabs(step[X]), fabs(step[Y]));
}

typedef struct { double value, weight; } Weighed;

static int by_value(const void *a, const void *b) {
    double x = ((const Weighed *)a)->value, y = ((const Weighed *)b)->value;
    return (x > y) - (x < y);
}

static double weighed_median(i64 n, Weighed *sample) {
    double half = 0, sum = 0;
    i64 k = 0;
    for (i64 i = 0; i < n; i++) half += sample[i].weight / 2;
    qsort(sample, (size_t)n, sizeof *sample, by_value);
    while (k < n - 1 && (sum += sample[k].weight) < half) k++;
    return sample[k].value;
}

/* Expect of every spot the blur that the frame shows: the median of all that tell, each by how well it knows its own
 * (`known`, variance; infinite for one that must not tell). How far it may be from that is a share of it. */
static void expect_usual_blur(const Rules *u, i64 n, const double *theta, const double *known, const Given *spots,
                              double *expected, double *prior, Weighed *sample) {
    double usual[3];
    for (int a = SXX; a <= SYY; a++) {
        i64 m = 0;
        for (i64 i = 0; i < n; i++) {
            const double *t = theta + i * PARAMETERS;
            double scatter = u->scatter_share * (t[SXX] + t[SYY]) / 2;
            if (isfinite(known[i])) sample[m++] = (Weighed){t[a], 1 / (known[i] + scatter * scatter)};
        }
        if (!m) return;
        usual[a - SXX] = weighed_median(m, sample);
    }
    double size = (usual[0] + usual[2]) / 2;
    for (i64 i = 0; i < n; i++) {
        double spread = (spots[i].is_free ? u->free_share : u->held_share) * size;
        for (int a = SXX; a <= SYY; a++)
            expected[i * PARAMETERS + a] = usual[a - SXX], prior[i * PARAMETERS + a] = 1 / (spread * spread);
    }
}

/* First guess of a spot. A Gaussian of peak P covers 2 pi s^2 ln(P/T) pixels above a threshold T. */
static void guess(const Image *im, const Rules *u, const Given *spot, const i64 *centre, double *t) {
    double level = spot->ground, clipped = spot->clipped, area = spot->area;
    double base = linear(u, level), threshold = linear(u, fmax(u->threshold, level + 1));
    double peak = fmax((clipped > 0 ? u->full : linear(u, grey(im, centre[1], centre[0]))) - base, 1);
    double ring = clipped > 0 ? fmax(area - clipped, 4) : area;
    double blur = ring / (2 * PI * log(fmax(peak / (threshold - base), 1.3)));
    blur = fmin(fmax(blur, 0.25), 16);
    memset(t, 0, PARAMETERS * sizeof *t);
    t[X] = spot->x - (double)centre[0], t[Y] = spot->y - (double)centre[1];
    t[LOG_PEAK] = log(peak) + fmin(spot->narrow * spot->narrow / (8 * blur), 5);
    t[SXX] = t[SYY] = blur, t[BACKGROUND] = base;
}

/* Radius of a spot's window: its component's share and some background around it. */
static double window_radius(const Rules *u, const Given *spot) {
    return fmin(fmax(ceil(sqrt(spot->area / PI)) + 2, u->least_radius), u->most_radius);
}

static void set_prior(const Rules *u, const double *start, int is_free, double *prior) {
    double spread = (is_free ? u->free_share : u->held_share) * start[SXX];
    double steep = u->steep_share * exp(fmin(start[LOG_PEAK], 6)) + 2;
    memset(prior, 0, PARAMETERS * sizeof *prior);
    for (int a = SXX; a <= SYY; a++) prior[a] = 1 / (spread * spread);
    prior[SLOPE_X] = prior[SLOPE_Y] = 1 / (steep * steep);
}

/* Spots nearer than reach_px see each other's light; groups nearer than tangled_px are numbered in `tangle`. */
static void find_neighbours(Work *w, const Rules *u, double reach_px, const i64 *centre, i64 *tangle) {
    for (i64 i = 0; i < w->n; i++) tangle[i] = i, w->neighbours[i] = 0;
    for (i64 i = 0; i < w->n; i++)
        for (i64 j = 0; j < w->n; j++) {
            double far = fmax(fabs((double)(centre[2 * i] - centre[2 * j])), fabs((double)(centre[2 * i + 1] - centre[2 * j + 1])));
            if (i == j || far > reach_px) continue;
            w->neighbour[i * w->n + w->neighbours[i]++] = j;
            if (far <= u->tangled_px) join(tangle, i, j);
        }
    for (i64 i = 0; i < w->n; i++) tangle[i] = root(tangle, i);
}

/* One Gauss-Newton round over all spots; returns the largest move. */
static double fit_round(const Work *w, const Rules *u, const i64 *centre, const i64 *tangle, const double *expected,
                        const double *prior, const Given *spots, double *theta, double *normal, double *gradient, double *step,
                        double *known, i64 *members) {
    const i64 Q = PARAMETERS, QQ = PARAMETERS * PARAMETERS;
    double most = 0;
    int blooms = u->bloom_rows || u->bloom_columns;
    for (i64 i = 0; i < w->n; i++) {
        double a[PARAMETERS * PARAMETERS], right[PARAMETERS * 2] = {0};
        linearise(w, i, theta, centre);
        normal_equations(w, u, i, theta + i * Q, expected + i * Q, prior + i * Q, normal + i * QQ, gradient + i * Q);
        memcpy(a, normal + i * QQ, sizeof a);
        for (int x = 0; x < PARAMETERS; x++) right[2 * x] = gradient[i * Q + x];
        right[2 * SXX + 1] = 0.5, right[2 * SYY + 1] = 0.5;
        int fine = kernel_solve(PARAMETERS, a, 2, right);
        for (int x = 0; x < PARAMETERS; x++) step[i * Q + x] = fine ? right[2 * x] : 0;
        double variance = (right[2 * SXX + 1] + right[2 * SYY + 1]) / 2, own = 1 / variance - prior[i * Q + SXX];
        int tells = spots[i].tells_blur && !(blooms && spots[i].clipped > 0);
        known[i] = fine && tells && own > 0 ? 1 / own : INFINITY;
    }
    for (i64 i = 0; i < w->n; i++) {
        i64 size = 0;
        for (i64 j = i; tangle[i] == i && j < w->n; j++)
            if (tangle[j] == i) members[size++] = j;
        if (size > 1 && size <= 64) joint_step(w, u, theta, centre, size, members, normal, gradient, step);
    }
    for (i64 i = 0; i < w->n; i++) most = fmax(most, apply(theta + i * Q, step + i * Q));
    return most;
}

/* What the fit found of spot i: chi2 is per degree of freedom, the misfit where the data exceed the model most. */
static void report(const Work *w, i64 i, const i64 *centre, const double *t, const double *normal, double *found) {
    double a[PARAMETERS * PARAMETERS], right[PARAMETERS * 2] = {0}, sum = 0, worst = -INFINITY;
    i64 used = 0, where = 0;
    memcpy(a, normal, sizeof a);
    right[0] = right[3] = 1;
    int fine = kernel_solve(PARAMETERS, a, 2, right);
    for (i64 k = 0; k < w->p; k++) {
        i64 at = i * w->p + k;
        double deviation = w->residual[at] * sqrt(w->weight[at]);
        sum += deviation * deviation;
        used += w->weight[at] > 0 && !w->clipped[at];
        if (w->weight[at] > 0 && deviation > worst) worst = deviation, where = k;
    }
    double blur2 = sqrt(fmax(t[SXX] * t[SYY] - t[SXY] * t[SXY], 1e-6)), peak = exp(t[LOG_PEAK]);
    found[FOUND_X] = (double)centre[0] + t[X], found[FOUND_Y] = (double)centre[1] + t[Y];
    found[FOUND_VARIANCE_X] = fine ? right[0] : NAN, found[FOUND_COVARIANCE_XY] = right[1], found[FOUND_VARIANCE_Y] = right[3];
    found[FOUND_PEAK] = peak, found[FOUND_FLUX] = 2 * PI * blur2 * peak, found[FOUND_BLUR2] = blur2;
    found[FOUND_CHI2] = sum / (double)(used > PARAMETERS + 1 ? used - PARAMETERS : 1);
    found[FOUND_MISFIT_X] = (double)centre[0] + w->dx[where], found[FOUND_MISFIT_Y] = (double)centre[1] + w->dy[where];
    found[FOUND_MISFIT_SIGMA] = isfinite(worst) ? worst : 0;
    found[FOUND_BLUR_XX] = t[SXX], found[FOUND_BLUR_XY] = t[SXY], found[FOUND_BLUR_YY] = t[SYY];
}

static double *take(double **pool, i64 count) { double *p = *pool; *pool += count; return p; }

/* Fit n spots; what was found goes to `found` (n, FOUND). Returns the rounds taken, or -1 without memory. */
i64 kernel_fit(const Image *im, const Rules *u, i64 n, const Given *spots, double *found) {
    const i64 Q = PARAMETERS;
    double widest = u->least_radius;
    for (i64 i = 0; i < n; i++) widest = fmax(widest, window_radius(u, spots + i));
    i64 span = (i64)widest, p = 0, most_p = (2 * span + 1) * (2 * span + 1), rounds = -1;
    i64 doubles = 2 * most_p + n * most_p * (3 + Q) + n * Q * (Q + 5) + 3 * n;
    double *memory = malloc((size_t)doubles * sizeof *memory), *pool = memory;
    i64 *index = malloc((size_t)(n * n + 5 * n) * sizeof *index);
    uint8_t *clipped = malloc((size_t)(n * most_p));
    if (memory && index && clipped) {
        Work w = {.n = n, .clipped = clipped, .neighbour = index, .neighbours = index + n * n};
        i64 *tangle = index + n * n + n, *members = tangle + n, *centre = members + n;
        w.dx = take(&pool, most_p), w.dy = take(&pool, most_p);
        for (i64 y = -span; y <= span; y++)
            for (i64 x = -span; x <= span; x++)
                if (x * x + y * y <= (widest + 0.3) * (widest + 0.3)) w.dx[p] = (double)x, w.dy[p++] = (double)y;
        w.p = p;
        w.light = take(&pool, n * p), w.weight = take(&pool, n * p), w.residual = take(&pool, n * p);
        w.derivative = take(&pool, n * p * Q);
        double *normal = take(&pool, n * Q * Q), *gradient = take(&pool, n * Q), *step = take(&pool, n * Q);
        double *expected = take(&pool, n * Q), *prior = take(&pool, n * Q), *theta = take(&pool, n * Q), *known = take(&pool, n);
        Weighed *sample = (Weighed *)take(&pool, 2 * n);
        for (i64 i = 0; i < n; i++) {
            const Given *spot = spots + i;
            centre[2 * i] = (i64)rint(spot->x), centre[2 * i + 1] = (i64)rint(spot->y);
            guess(im, u, spot, centre + 2 * i, theta + i * Q);
            cut(im, u, &w, i, centre + 2 * i, window_radius(u, spot));
            set_prior(u, theta + i * Q, spots[i].is_free, prior + i * Q);
            found[i * FOUND + FOUND_GROUND] = theta[i * Q + BACKGROUND];
        }
        find_neighbours(&w, u, 2 * widest, centre, tangle);
        memcpy(expected, theta, (size_t)(n * Q) * sizeof *theta);
        for (rounds = 0; rounds < u->rounds; rounds++) {
            if (rounds) expect_usual_blur(u, n, theta, known, spots, expected, prior, sample);
            double moved = fit_round(&w, u, centre, tangle, expected, prior, spots, theta, normal, gradient, step, known, members);
            if (moved < u->settled_px) break;
        }
        for (i64 i = 0; i < n; i++) report(&w, i, centre + 2 * i, theta + i * Q, normal + i * Q * Q, found + i * FOUND);
    }
    free(memory), free(index), free(clipped);
    return rounds;
}
