/* The fit of spots: elliptical Gaussians on sloping ground, Gauss-Newton, touching spots together. See fit.py. */
#include "_fit.h"

static double linear(const Rules *u, double v) {
    if (u->gamma == 1) return v;
    double span = u->full - u->black, t = (v - u->black) / span;
    return (t > 0 ? pow(t, 1 / u->gamma) : 0) * span + u->black;
}

static int is_clipped(const Image *im, const Rules *u, i64 r, i64 c) {
    return r >= 0 && r < im->height && c >= 0 && c < im->width && grey(im, r, c) >= u->clipped;
}

/* Fill one spot's window. A bloomed run's ends, and in a blooming frame the clipped pixels, tell nothing: weight 0. */
static void cut(const Image *im, const Rules *u, Work *w, i64 i, i64 inside) {
    int blooms = u->bloom_rows || u->bloom_columns;
    for (i64 k = 0; k < w->count[i]; k++) {
        i64 r = w->centre[2 * i + 1] + (i64)w->dy[k], c = w->centre[2 * i] + (i64)w->dx[k], at = w->begin[i] + k;
        w->light[at] = w->weight[at] = 0, w->asks[at] = -INFINITY;
        if (k >= inside || r < 0 || r >= im->height || c < 0 || c >= im->width) continue;
        double v = grey(im, r, c), light = linear(u, v), signal = fmax(light - u->level, 0);
        w->light[at] = light;
        if (v >= u->clipped) w->asks[at] = 0;
        if (blooms && (v >= u->clipped || is_clipped(im, u, r + u->bloom_rows, c + u->bloom_columns) ||
                       is_clipped(im, u, r - u->bloom_rows, c - u->bloom_columns)))
            continue;
        double pattern = u->pattern * light;
        w->weight[at] = 1 / (u->read_dn * u->read_dn + signal * u->shot_per_dn + pattern * pattern);
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

/* Go on from an earlier fit of the spot. What is under it is found in one step, wherever that starts. */
static void take_up(const double *found, const i64 *centre, double *t) {
    t[X] = found[FOUND_X] - (double)centre[0], t[Y] = found[FOUND_Y] - (double)centre[1], t[LOG_PEAK] = log(found[FOUND_PEAK]);
    t[SXX] = found[FOUND_BLUR_XX], t[SXY] = found[FOUND_BLUR_XY], t[SYY] = found[FOUND_BLUR_YY];
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

static double bounded(double v, double limit) { return v > limit ? limit : v < -limit ? -limit : isfinite(v) ? v : 0; }

/* Take a step as far as the linear model can be believed; half of one that goes back over more than half of the last, or a
 * spot narrower than its blur may be would go to and fro for good. Returns the larger move of the centre that was asked for;
 * `shape` gets the largest relative change of peak and blur, a tenth of it. */
static double apply(double *t, double *step, double *last, double *shape) {
    double least = fmin(t[SXX], t[SYY]), blur = 0.3 * least, moved = fmax(fabs(step[X]), fabs(step[Y]));
    int back = step[X] * last[0] + step[Y] * last[1] < -0.5 * (last[0] * last[0] + last[1] * last[1]);
    *shape = fmax(fabs(step[LOG_PEAK]), fmax(fabs(step[SXX]), fabs(step[SYY])) / least) / 10;
    for (int a = 0; back && a < PARAMETERS; a++) step[a] /= 2;
    last[0] = bounded(step[X], 0.5), last[1] = bounded(step[Y], 0.5);
    t[X] += last[0], t[Y] += last[1], t[LOG_PEAK] += bounded(step[LOG_PEAK], 1);
    for (int a = SXX; a <= SYY; a++) t[a] += bounded(step[a], blur);
    for (int a = BACKGROUND; a < PARAMETERS; a++) t[a] += bounded(step[a], 1e6);
    return moved;
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

/* Expect of every spot the blur that the frame shows: the median of all that tell, each by how well it knows its own. How far
 * it may be from that is a share of it. `usual` has that blur; it is kept, and 0 returned, while the median is near it. */
static int expect_usual_blur(const Work *w, const Rules *u, const Given *spots, Weighed *sample, double usual[3]) {
    double median[3], changed = 0;
    for (int a = SXX; a <= SYY; a++) {
        i64 m = 0;
        for (i64 i = 0; i < w->n; i++) {
            const double *t = w->theta + i * PARAMETERS;
            double scatter = u->scatter_share * (t[SXX] + t[SYY]) / 2;
            if (isfinite(w->known[i])) sample[m++] = (Weighed){t[a], 1 / (w->known[i] + scatter * scatter)};
        }
        if (!m) return 0;
        median[a - SXX] = weighed_median(m, sample);
        changed = fmax(changed, fabs(median[a - SXX] - usual[a - SXX]));
    }
    double size = (median[0] + median[2]) / 2;
    if (changed < u->kept_share * size) return 0;
    memcpy(usual, median, sizeof median);
    for (i64 i = 0; i < w->n; i++) {
        double spread = (spots[i].is_free ? u->free_share : u->held_share) * size;
        for (int a = SXX; a <= SYY; a++)
            w->expected[i * PARAMETERS + a] = usual[a - SXX], w->prior[i * PARAMETERS + a] = 1 / (spread * spread);
    }
    return 1;
}

/* Scratch of the spots solved together: derivatives of each, the same weighted, a spot's, their system and step. */
typedef struct { double *by, *weighted, *room, *system, *step; } Scratch;

/* The step of `size` spots solved together: each one's own equations, with what the others' parameters do to them. */
static int joint_step(const Work *w, const Rules *u, i64 size, const i64 *member, const Scratch *s) {
    i64 m = size * PARAMETERS, done = 0;
    memset(s->system, 0, (size_t)(m * m) * sizeof *s->system);
    for (i64 a = 0; a < size; a++) {
        i64 i = member[a];
        double *rows = s->system + a * PARAMETERS * m;
        for (int x = 0; x < PARAMETERS; x++) {
            memcpy(rows + x * m + a * PARAMETERS, w->normal + (i * PARAMETERS + x) * PARAMETERS, PARAMETERS * sizeof *rows);
            rows[x * m + a * PARAMETERS + x] *= 1 + u->damping;
        }
        memcpy(s->step + a * PARAMETERS, w->gradient + i * PARAMETERS, PARAMETERS * sizeof *s->step);
        for (i64 b = 0; b < size; b++)
            if (a != b) fit_couple(w, i, member[b], s->weighted + done, s->room, m, rows + b * PARAMETERS);
        done += w->count[i] * PARAMETERS;
    }
    return kernel_solve(m, s->system, 1, s->step);
}

/* The step of one spot by its own equations, and how well it knows its own blur. */
static void own_step(const Work *w, const Rules *u, i64 i, const Given *spot) {
    double own[PARAMETERS * PARAMETERS], right[PARAMETERS * 2] = {0};
    memcpy(own, w->normal + i * PARAMETERS * PARAMETERS, sizeof own);
    for (int x = 0; x < PARAMETERS; x++) right[2 * x] = w->gradient[i * PARAMETERS + x];
    right[2 * SXX + 1] = right[2 * SYY + 1] = 0.5;
    int fine = kernel_solve(PARAMETERS, own, 2, right);
    for (int x = 0; x < PARAMETERS; x++) w->step[i * PARAMETERS + x] = fine ? right[2 * x] : 0;
    double variance = (right[2 * SXX + 1] + right[2 * SYY + 1]) / 2, told = 1 / variance - w->prior[i * PARAMETERS + SXX];
    int tells = spot->tells_blur && !((u->bloom_rows || u->bloom_columns) && spot->clipped > 0);
    w->known[i] = fine && tells && told > 0 ? 1 / told : INFINITY;
}

/* The Gauss-Newton step of `size` spots together, kept for when all have theirs. */
static void find_step(Work *w, const Rules *u, const Given *spots, i64 size, const i64 *member, const Scratch *s) {
    i64 done = 0;
    for (i64 a = 0; a < size; a++) {
        i64 i = member[a];
        fit_linearise(w, i, s->by, s->weighted + done, s->room);
        fit_normal_equations(w, u, i, s->by, s->weighted + done);
        own_step(w, u, i, spots + i);
        done += w->count[i] * PARAMETERS;
    }
    if (size == 1 || !joint_step(w, u, size, member, s)) return;
    for (i64 a = 0; a < size; a++) memcpy(w->step + member[a] * PARAMETERS, s->step + a * PARAMETERS, PARAMETERS * sizeof *s->step);
}

/* Whether a tangle's spots, and all whose light reaches them, have settled. */
static int has_settled(const Work *w, const Rules *u, const Tangle *t, const i64 *member) {
    double most = 0;
    for (i64 a = t->begin; a < t->begin + t->size; a++) {
        i64 i = member[a];
        most = fmax(most, w->moved[i]);
        for (i64 m = w->neighbours[i]; m < w->neighbours[i + 1]; m++) most = fmax(most, w->moved[w->neighbour[m]]);
    }
    return most < u->settled_px;
}

/* Rounds over all spots until all have settled in one. A tangle rests as long as nothing that it hangs on changes. */
static i64 settle(Work *w, const Rules *u, const Given *spots, i64 count, Tangle *tangle, const i64 *member,
                  Weighed *sample, const Scratch *s) {
    i64 round = 0;
    int changed = 1;
    double most = INFINITY, shape, usual[3] = {INFINITY, INFINITY, INFINITY};
    for (; round < u->rounds && !(most < u->settled_px); round++) {
        if (round) changed = expect_usual_blur(w, u, spots, sample, usual);
        for (i64 k = 0; k < count; k++) {
            Tangle *t = tangle + k;
            i64 each = t->how == APART ? 1 : t->size;
            t->rests = t->how == LEFT || (!changed && has_settled(w, u, t, member));
            for (i64 a = 0; !t->rests && a < t->size; a += each) find_step(w, u, spots, each, member + t->begin + a, s);
        }
        most = 0;
        for (i64 k = 0; k < count; k++)
            for (i64 a = tangle[k].begin; !tangle[k].rests && a < tangle[k].begin + tangle[k].size; a++) {
                double *theta = w->theta + member[a] * PARAMETERS;
                double moved = apply(theta, w->step + member[a] * PARAMETERS, w->last + 2 * member[a], &shape);
                most = fmax(most, moved), w->moved[member[a]] = theta[LOG_PEAK] < DARK ? 0 : fmax(moved, shape);
            }
    }
    return round;
}

/* A spot's brightness and shape as they stand, fitted or guessed. */
static void report_shape(const double *t, double *found) {
    double blur2 = sqrt(fmax(t[SXX] * t[SYY] - t[SXY] * t[SXY], 1e-6)), peak = exp(t[LOG_PEAK]);
    found[FOUND_PEAK] = peak, found[FOUND_FLUX] = 2 * PI * blur2 * peak, found[FOUND_BLUR2] = blur2;
    found[FOUND_BLUR_XX] = t[SXX], found[FOUND_BLUR_XY] = t[SXY], found[FOUND_BLUR_YY] = t[SYY];
}

/* What is said of a spot before its fit, and for good of one that is left: no variance, and that nothing fits. */
static void report_guess(const double *t, const Given *spot, double *found) {
    for (int a = 0; a < FOUND; a++) found[a] = NAN;
    found[FOUND_X] = found[FOUND_MISFIT_X] = spot->x, found[FOUND_Y] = found[FOUND_MISFIT_Y] = spot->y;
    found[FOUND_CHI2] = INFINITY, found[FOUND_MISFIT_SIGMA] = 0, found[FOUND_GROUND] = t[BACKGROUND];
    report_shape(t, found);
}

/* What the fit found of spot i: chi2 is per degree of freedom, the misfit where the data exceed the model most. */
static void report(const Work *w, i64 i, double *found) {
    const double *t = w->theta + i * PARAMETERS, *residual = w->residual + w->begin[i], *weight = w->weight + w->begin[i];
    double a[PARAMETERS * PARAMETERS], right[PARAMETERS * 2] = {0}, sum = 0, worst = -INFINITY;
    i64 used = 0, where = 0;
    memcpy(a, w->normal + i * PARAMETERS * PARAMETERS, sizeof a);
    right[0] = right[3] = 1;
    int fine = kernel_solve(PARAMETERS, a, 2, right);
    for (i64 k = 0; k < w->count[i]; k++) {
        double deviation = residual[k] * sqrt(weight[k]);
        sum += deviation * deviation;
        used += weight[k] > 0 && w->asks[w->begin[i] + k] < 0;
        if (weight[k] > 0 && deviation > worst) worst = deviation, where = k;
    }
    found[FOUND_VARIANCE_X] = fine ? right[0] : NAN, found[FOUND_COVARIANCE_XY] = right[1], found[FOUND_VARIANCE_Y] = right[3];
    found[FOUND_CHI2] = sum / (double)(used > PARAMETERS + 1 ? used - PARAMETERS : 1);
    found[FOUND_MISFIT_X] = (double)w->centre[2 * i] + w->dx[where], found[FOUND_MISFIT_Y] = (double)row_of(w, i) + w->dy[where];
    found[FOUND_MISFIT_SIGMA] = isfinite(worst) ? worst : 0;
    found[FOUND_X] = (double)w->centre[2 * i] + t[X], found[FOUND_Y] = (double)row_of(w, i) + t[Y];
    report_shape(t, found);
}

/* Offsets within a radius, nearest first; `within[d2]` gets how many have a squared distance of at most d2. */
static void list_offsets(double radius, double *dx, double *dy, i64 *within) {
    i64 most = (i64)((radius + 0.3) * (radius + 0.3)), span = (i64)radius;
    for (i64 d2 = 0; d2 <= most; d2++) within[d2] = 0;
    for (int fill = 0; fill < 2; fill++) {
        for (i64 y = -span; y <= span; y++)
            for (i64 x = -span; x <= span; x++) {
                i64 d2 = x * x + y * y;
                if (d2 > most) continue;
                if (fill) dx[within[d2]] = (double)x, dy[within[d2]] = (double)y;
                within[d2]++;
            }
        i64 sum = 0;      /* where those of each distance begin; once they are filled in, where they end */
        for (i64 d2 = 0; !fill && d2 <= most; d2++) { i64 here = within[d2]; within[d2] = sum, sum += here; }
    }
}

typedef struct { void *piece[16]; int count, failed; } Memory;      /* what is freed at the end */

static void *take(Memory *m, i64 count, size_t size) {
    void *p = malloc((size_t)count * size + 1);
    m->failed |= !p;
    return m->piece[m->count++] = p;
}

/* Lay out all windows and fill them, with first guess and prior of each spot. 0 without memory. */
static int open_windows(const Image *im, const Rules *u, const Given *spots, double widest, double *radius, Work *w, Memory *m) {
    const i64 Q = PARAMETERS;
    i64 n = w->n, span = (i64)widest, most = (2 * span + 1) * (2 * span + 1) + LANES, pixels = 0;
    i64 *within = take(m, (span + 1) * (span + 1) + 1, sizeof *within), *whole = take(m, 6 * n + 2, sizeof *whole), *inside = whole + 5 * n + 2;
    double *each = take(m, n * (Q * Q + 5 * Q + 4), sizeof *each), *offsets = take(m, 2 * most, sizeof *offsets);
    if (m->failed) return 0;
    w->begin = whole, w->count = whole + n, w->centre = whole + 2 * n, w->neighbours = whole + 4 * n;
    w->normal = each, w->gradient = each + n * Q * Q, w->theta = w->gradient + n * Q, w->expected = w->theta + n * Q;
    w->prior = w->expected + n * Q, w->step = w->prior + n * Q, w->known = w->step + n * Q;
    w->moved = w->known + n, w->last = w->moved + n;
    w->dx = offsets, w->dy = offsets + most;
    memset(offsets, 0, (size_t)(2 * most) * sizeof *offsets), memset(w->moved, 0, (size_t)(3 * n) * sizeof *w->moved);
    list_offsets(widest, w->dx, w->dy, within);
    for (i64 i = 0; i < n; i++) {
        radius[i] = window_radius(u, spots + i);
        w->centre[2 * i] = (i64)rint(spots[i].x), w->centre[2 * i + 1] = (i64)rint(spots[i].y);
        w->begin[i] = pixels, inside[i] = within[(i64)((radius[i] + 0.3) * (radius[i] + 0.3))];
        pixels += w->count[i] = (inside[i] + LANES - 1) / LANES * LANES;
    }
    double *light = take(m, 4 * pixels, sizeof *light);
    if (m->failed) return 0;
    w->light = light, w->weight = light + pixels, w->residual = light + 2 * pixels, w->asks = light + 3 * pixels;
    for (i64 i = 0; i < n; i++) {
        guess(im, u, spots + i, w->centre + 2 * i, w->theta + i * Q);
        cut(im, u, w, i, inside[i]);
        set_prior(u, w->theta + i * Q, spots[i].is_free, w->prior + i * Q);
    }
    memcpy(w->expected, w->theta, (size_t)(n * Q) * sizeof *w->theta);
    for (i64 i = 0; i < n; i++)
        if (spots[i].start) take_up(spots[i].start, w->centre + 2 * i, w->theta + i * Q);
    return 1;
}

/* Room for the largest tangle that is solved together. */
static int make_room(const Work *w, i64 count, const Tangle *tangle, const i64 *member, i64 widest_count, Scratch *s, Memory *m) {
    i64 largest = 1, pixels = widest_count, columns;
    for (i64 k = 0; k < count; k++) {
        if (tangle[k].how != TOGETHER) continue;
        i64 sum = 0;
        for (i64 a = 0; a < tangle[k].size; a++) sum += w->count[member[tangle[k].begin + a]];
        pixels = sum > pixels ? sum : pixels, largest = tangle[k].size > largest ? tangle[k].size : largest;
    }
    columns = largest * PARAMETERS;
    s->by = take(m, widest_count * PARAMETERS, sizeof(double)), s->weighted = take(m, pixels * PARAMETERS, sizeof(double));
    s->room = take(m, widest_count * SHAPE, sizeof(double)), s->step = take(m, columns, sizeof(double));
    s->system = take(m, columns * columns, sizeof(double));
    return !m->failed;
}

/* Fit n spots; what was found goes to `found` (n, FOUND). Spots of tangles that are too much work keep their first guess,
 * and an infinite chi2. Returns the rounds taken, or -1 without memory. */
i64 kernel_fit(const Image *im, const Rules *u, i64 n, const Given *spots, double *found) {
    Memory m = {.count = 0};
    Work w = {.n = n};
    Scratch s;
    double widest = u->least_radius;
    i64 rounds = -1, widest_count = 0, *parent = take(&m, 3 * n, sizeof *parent), *order = parent + n, *member = order + n;
    double *radius = take(&m, n, sizeof *radius);
    Tangle *tangle = take(&m, n, sizeof *tangle);
    Weighed *sample = take(&m, n, sizeof *sample);
    for (i64 i = 0; i < n; i++) widest = fmax(widest, window_radius(u, spots + i));
    int fine = !m.failed && open_windows(im, u, spots, widest, radius, &w, &m);
    fine = fine && fit_find_neighbours(&w, u, widest, radius, parent, order);
    if (fine) {
        i64 count = fit_find_tangles(&w, u, parent, order, member, tangle);
        for (i64 i = 0; i < n; i++) {
            widest_count = w.count[i] > widest_count ? w.count[i] : widest_count;
            w.known[i] = INFINITY;
            report_guess(w.theta + i * PARAMETERS, spots + i, found + i * FOUND);
        }
        fine = make_room(&w, count, tangle, member, widest_count, &s, &m);
        if (fine) rounds = settle(&w, u, spots, count, tangle, member, sample, &s);
        for (i64 k = 0; fine && k < count; k++)
            for (i64 a = 0; tangle[k].how != LEFT && a < tangle[k].size; a++) {
                i64 i = member[tangle[k].begin + a];
                report(&w, i, found + i * FOUND);
            }
    }
    free(w.neighbour);
    for (int k = 0; k < m.count; k++) free(m.piece[k]);
    return rounds;
}
