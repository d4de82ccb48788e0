/* From the table of spots to measured highlights: flags, the fit, and how far it is believed. See highlights.py. */
#include "_kernel.h"

typedef struct {      /* what spots are flagged by, the flags' bits, and what is believed of a fit; see highlights.py */
    double min_area_px, max_area_px, lost_px, lost_variance, systematic_variance;
    double flux_sigma, clipped_flux_sigma, guessed_flux_sigma;
    i64 saturated, touching, too_small, too_large, at_edge, hot, crowded, unsure_flux, held;
} Standards;

typedef struct {      /* the panel's grey value at tile centres */
    i64 rows, columns;
    const double *tiles;
} Ground;

static i64 flags_of(const Standards *s, const double *t, double crowd) {
    double area = t[COMPONENT_PX] / crowd;
    return (t[SATURATED_PX] > 0 ? s->saturated : 0) | (crowd > 1 ? s->touching : 0) | (area < s->min_area_px ? s->too_small : 0) |
           (area > s->max_area_px ? s->too_large : 0) | (t[AT_EDGE] > 0 ? s->at_edge : 0) | (t[IS_HOT] > 0 ? s->hot : 0);
}

/* Flags, and what the fit is given of each spot. Returns whether any shows the frame's blur unclipped; -1 without memory. */
static int prepare(const Image *im, const Ground *ground, const Standards *s, i64 components, i64 n, const double *table,
                   i64 started, const double *start, i64 *flags, Given *given) {
    double *crowd = calloc((size_t)components + 1, sizeof *crowd);
    if (!crowd) return -1;
    for (i64 i = 0; i < n; i++) crowd[(i64)table[i * COLUMNS + COMPONENT]]++;
    int known = 0;
    for (i64 i = 0; i < n; i++) {
        const double *t = table + i * COLUMNS;
        double x = t[CENTRE_X], y = t[CENTRE_Y], sharing = crowd[(i64)t[COMPONENT]];
        flags[i] = flags_of(s, t, sharing);
        double level = background_at(im->height, im->width, ground->rows, ground->columns, ground->tiles, rint(y), rint(x));
        given[i] = (Given){level, t[COMPONENT_PX] / sharing, t[SATURATED_PX], t[NARROW_PX], x, y, !(flags[i] & s->held),
                           !(flags[i] & s->hot), i < started && isfinite(start[i * FOUND]) ? start + i * FOUND : NULL};
        known |= !(flags[i] & s->unsure_flux);
    }
    free(crowd);
    return known;
}

typedef struct {      /* centres (n, 2), covariance (n, 4), flux (n) and the deviation (n) of its logarithm */
    double *xy, *covariance, *flux, *flux_sigma;
} Believed;

/* What a fit is taken to say: where it ran away, and of a hot pixel, the plain centre, known badly. The flux of
 * a clipped spot hangs on its blur: in a frame that shows none unclipped it is little more than a guess. */
static void believe(const Standards *s, int blur_known, const double *t, const double *f, i64 i, const Believed *b) {
    double *xy = b->xy + 2 * i, *c = b->covariance + 4 * i, scale = f[FOUND_CHI2] <= 1 ? 1 : f[FOUND_CHI2];
    double away = fmax(fabs(f[FOUND_X] - t[CENTRE_X]), fabs(f[FOUND_Y] - t[CENTRE_Y])), peak = f[FOUND_PEAK];
    double aliased = exp(-4 * PI * PI * f[FOUND_BLUR2]);      /* of a blur too sharp for its pixels, px^2 */
    c[0] = f[FOUND_VARIANCE_X] * scale + s->systematic_variance + aliased;
    c[1] = c[2] = f[FOUND_COVARIANCE_XY] * scale;
    c[3] = f[FOUND_VARIANCE_Y] * scale + s->systematic_variance + aliased;
    xy[0] = f[FOUND_X], xy[1] = f[FOUND_Y], b->flux[i] = f[FOUND_FLUX];
    b->flux_sigma[i] = t[SATURATED_PX] > 0 ? (blur_known ? s->clipped_flux_sigma : s->guessed_flux_sigma) : s->flux_sigma;
    int fine = t[IS_HOT] == 0 && away < s->lost_px && isfinite(xy[0] + xy[1]) && b->flux[i] > 0 &&
               isfinite(b->flux[i] + c[0] + c[1] + c[3]);
    if (fine) return;
    xy[0] = t[CENTRE_X], xy[1] = t[CENTRE_Y];
    c[0] = c[3] = s->lost_variance, c[1] = c[2] = 0;
    b->flux[i] = isfinite(peak) && peak > 1 ? peak : 1;
}

/* Measure the n spots of a table (n, COLUMNS): their flags, what the fit `found` (n, FOUND), and what of it is `believed`
 * (8 n: centres, covariance, flux, its deviation). The first spots go on from `start` (started, FOUND), where that is not NaN. Returns
 * whether the frame's blur is known, or -1 without memory. */
i64 kernel_measure(const Image *im, i64 tile_rows, i64 tile_columns, const double *tiles, const Rules *u, const Standards *s,
                   i64 components, i64 n, const double *table, i64 started, const double *start, i64 *flags, double *found,
                   double *believed) {
    Given *given = malloc((size_t)(n + 1) * sizeof *given);
    if (!given) return -1;
    Ground ground = {tile_rows, tile_columns, tiles};
    Believed b = {believed, believed + 2 * n, believed + 6 * n, believed + 7 * n};
    int known = prepare(im, &ground, s, components, n, table, started, start, flags, given);
    int fine = known >= 0 && kernel_fit(im, u, n, given, found) >= 0;
    for (i64 i = 0; fine && i < n; i++) {
        if (isinf(found[i * FOUND + FOUND_CHI2])) flags[i] |= s->crowded;
        believe(s, known, table + i * COLUMNS, found + i * FOUND, i, &b);
    }
    free(given);
    return fine ? known : -1;
}
