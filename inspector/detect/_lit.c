/* From an image to the table of its spots: one pass for lit pixels, their components, clipped plateaus and peaks.
 *
 * Called through ctypes by spots.py; no Python in here, so that it builds with any C compiler and runs without the
 * interpreter's lock. Arrays are C-contiguous, counts int64; a function without memory returns a negative number.
 */
#include "_kernel.h"

WIDE static unsigned peak_u8(const uint8_t *p, i64 n) {
    uint8_t m = 0;
    for (i64 i = 0; i < n; i++) m = p[i] > m ? p[i] : m;
    return m;
}

WIDE static unsigned peak_u16(const Grey16 *p, i64 n) {
    uint16_t m = 0;
    for (i64 i = 0; i < n; i++) m = p[i] > m ? p[i] : m;
    return m;
}

enum { BLOCK = 32 };      /* pixels looked at together in a row that holds a lit one */

static unsigned block_peak(const Image *im, const uint8_t *row, i64 begin, i64 end) {
    return im->bytes == 1 ? peak_u8(row + begin, end - begin) : peak_u16((const Grey16 *)row + begin, end - begin);
}

/* Component numbers of n pixels in row-major order, 8-connected; returns their count, or -1 without memory. */
static i64 components_of(i64 n, const i64 *rows, const i64 *columns, i64 *label) {
    i64 *parent = malloc((size_t)(n ? n : 1) * sizeof *parent);
    if (!parent) return -1;
    i64 above = 0;      /* first pixel of the row above that may still touch */
    for (i64 i = 0; i < n; i++) {
        parent[i] = i;
        if (i && rows[i] == rows[i - 1] && columns[i] == columns[i - 1] + 1) join(parent, i, i - 1);
        while (above < i && (rows[above] < rows[i] - 1 || (rows[above] == rows[i] - 1 && columns[above] < columns[i] - 1)))
            above++;
        for (i64 j = above; j < i && rows[j] == rows[i] - 1 && columns[j] <= columns[i] + 1; j++) join(parent, i, j);
    }
    i64 count = 0;
    for (i64 i = 0; i < n; i++) {
        i64 r = root(parent, i);
        label[i] = r == i ? count++ : label[r];
    }
    free(parent);
    return count;
}

/* Threshold of a row at tile columns: the tile grid is bilinear between tile centres and goes on straight beyond them. */
static double row_thresholds(const double *tiles, i64 tr, i64 tc, i64 row, i64 height, double *at) {
    double y = (row + 0.5) * tr / height - 0.5, least = INFINITY;
    i64 r0 = tr > 1 ? (i64)fmin(fmax(y, 0), tr - 2) : 0, r1 = tr > 1 ? r0 + 1 : 0;
    for (i64 c = 0; c < tc; c++) {
        at[c] = tiles[r0 * tc + c] + (tiles[r1 * tc + c] - tiles[r0 * tc + c]) * (y - r0);
        least = fmin(least, at[c]);
    }
    if (tc > 1) least = fmin(least, fmin(1.5 * at[0] - 0.5 * at[1], 1.5 * at[tc - 1] - 0.5 * at[tc - 2]));
    return least;
}

static double column_threshold(const double *at, i64 tc, i64 column, i64 width) {
    double x = (column + 0.5) * tc / width - 0.5;
    i64 low = x > 0 ? (i64)x : 0, c0 = tc > 1 ? (low < tc - 2 ? low : tc - 2) : 0, c1 = tc > 1 ? c0 + 1 : 0;
    return at[c0] + (at[c1] - at[c0]) * (x - c0);
}

/* A value that no threshold of the columns from `begin` to before `end` is below: straight lines are least at their ends,
 * which are those columns and the tile centres; rounding is allowed for. */
static double block_least(const double *at, i64 tc, i64 begin, i64 end, i64 width) {
    double first = column_threshold(at, tc, begin, width), last = column_threshold(at, tc, end - 1, width);
    double least = first < last ? first : last;
    for (i64 c = 0; c < tc; c++) {
        double centre = (c + 0.5) * width / tc - 0.5;
        if (centre > begin && centre < end - 1 && at[c] < least) least = at[c];
    }
    return least - 1e-6;
}

/* Pixels above the thresholds given at (tr, tc) tile centres, as many as there is `room` for; returns how many there
 * are, or -1 past `most` or for too many tiles. `largest` gets the frame's largest grey value. */
static i64 find_lit(const Image *im, const double *tiles, i64 tr, i64 tc, i64 most, i64 room, i64 *rows, i64 *columns,
                    double *values, double *largest) {
    double at[64];
    unsigned top = 0;
    i64 n = 0;
    for (i64 r = 0; tc <= 64 && n <= most && r < im->height; r++) {
        const uint8_t *p = im->data + r * im->stride;
        unsigned peak = im->bytes == 1 ? peak_u8(p, im->width) : peak_u16((const Grey16 *)p, im->width);
        top = peak > top ? peak : top;
        double least = row_thresholds(tiles, tr, tc, r, im->height, at);
        if (!(peak > least)) continue;
        for (i64 b = 0; b < im->width; b += BLOCK) {      /* most blocks are dark: one look each */
            i64 end = b + BLOCK < im->width ? b + BLOCK : im->width;
            unsigned block = block_peak(im, p, b, end);
            if (!(block > least) || !(block > block_least(at, tc, b, end, im->width))) continue;
            for (i64 c = b; c < end; c++) {
                double v = grey(im, r, c);
                if (!(v > column_threshold(at, tc, c, im->width))) continue;
                if (n < room) rows[n] = r, columns[n] = c, values[n] = v;
                n++;
            }
        }
    }
    *largest = top;
    return tc > 64 || n > most ? -1 : n;
}

/* Whether a pixel is below `saturated` and no neighbour outshines it; equals go to the first in row-major order. */
static int is_peak(const Image *im, i64 row, i64 column, double value, double saturated) {
    int best = value < saturated;
    for (int d = 0; d < 9 && best; d++) {
        i64 r = row + d / 3 - 1, c = column + d % 3 - 1;
        if (d == 4 || r < 0 || r >= im->height || c < 0 || c >= im->width) continue;
        double v = grey(im, r, c);
        best = v < saturated && (d < 4 ? value > v : value >= v);
    }
    return best;
}

/* Whether a pixel is brighter than any lens could leave it: the four beside it hold under `share` of its light. */
static int is_hot(const Image *im, i64 r, i64 c, double share) {
    if (r < 1 || c < 1 || r >= im->height - 1 || c >= im->width - 1) return 0;
    double beside[4] = {grey(im, r, c - 1), grey(im, r, c + 1), grey(im, r - 1, c), grey(im, r + 1, c)};
    double corner[4] = {grey(im, r - 1, c - 1), grey(im, r - 1, c + 1), grey(im, r + 1, c - 1), grey(im, r + 1, c + 1)};
    double ground = INFINITY, low = INFINITY, high = -INFINITY, sum = 0, corners = 0;
    for (int k = 0; k < 4; k++) {
        ground = fmin(ground, beside[k]), low = fmin(low, corner[k]), high = fmax(high, corner[k]);
        sum += beside[k], corners += corner[k];
    }
    ground = fmin(ground, (corners - low - high) / 2);
    return sum - 4 * ground < share * (grey(im, r, c) - ground);
}

/* Rows of `spots` for the clipped plateaus, in order of first pixel: plateau numbers of the clipped pixels are in
 * `plateau`, -1 elsewhere. Returns their count, or -1 without memory. */
static i64 find_plateaus(i64 n, const i64 *rows, const i64 *columns, const double *values, const i64 *label,
                         double saturated, i64 *plateau, i64 room, double *spots) {
    i64 *clipped = malloc((size_t)(4 * n + 1) * sizeof *clipped), *r = clipped + n, *c = r + n, *number = c + n, m = 0;
    if (!clipped) return -1;
    for (i64 i = 0; i < n; i++) {
        plateau[i] = -1;
        if (values[i] >= saturated) clipped[m] = i, r[m] = rows[i], c[m++] = columns[i];
    }
    i64 count = components_of(m, r, c, number);
    for (i64 k = 0; k < count && k < room; k++) memset(spots + k * COLUMNS, 0, COLUMNS * sizeof *spots);
    for (i64 k = 0; k < m && count > 0; k++) {
        double *s = spots + number[k] * COLUMNS;
        plateau[clipped[k]] = number[k];
        if (number[k] >= room) continue;
        if (s[SATURATED_PX]++ == 0) s[NARROW_PX] = s[IS_HOT] = (double)c[k], s[AT_EDGE] = (double)r[k];
        s[CENTRE_X] += (double)c[k], s[CENTRE_Y] += (double)r[k], s[COMPONENT] = (double)label[clipped[k]];
        s[NARROW_PX] = fmin(s[NARROW_PX], (double)c[k]), s[IS_HOT] = fmax(s[IS_HOT], (double)c[k]);
        s[LONGER_PX] = (double)r[k];      /* rows come in order: the last is the lowest */
    }
    for (i64 k = 0; k < count && k < room; k++) {
        double *s = spots + k * COLUMNS, wide = s[IS_HOT] - s[NARROW_PX] + 1, tall = s[LONGER_PX] - s[AT_EDGE] + 1;
        s[CENTRE_X] /= s[SATURATED_PX], s[CENTRE_Y] /= s[SATURATED_PX];
        s[NARROW_PX] = fmin(wide, tall), s[LONGER_PX] = tall - wide;
    }
    free(clipped);
    return count;
}

/* Fill in what each spot shares with its component, and whether it is a hot pixel. 0 without memory. */
static int describe(const Image *im, i64 n, const i64 *rows, const i64 *columns, const i64 *label, i64 components,
                    double hot_share, i64 count, double *spots) {
    double *sum = calloc((size_t)(4 * components + 1), sizeof *sum);
    if (!sum) return 0;
    for (i64 i = 0; i < n; i++) {
        double *s = sum + 4 * label[i];
        s[0]++, s[1] += (double)columns[i], s[2] += (double)rows[i];
        if (rows[i] == 0 || columns[i] == 0 || rows[i] == im->height - 1 || columns[i] == im->width - 1) s[3] = 1;
    }
    for (i64 k = 0; k < count; k++) {
        double *t = spots + k * COLUMNS, *s = sum + 4 * (i64)t[COMPONENT];
        t[COMPONENT_PX] = s[0], t[COMPONENT_X] = s[1] / s[0], t[COMPONENT_Y] = s[2] / s[0], t[AT_EDGE] = s[3];
        t[IS_HOT] = is_hot(im, (i64)rint(t[CENTRE_Y]), (i64)rint(t[CENTRE_X]), hot_share);
    }
    free(sum);
    return 1;
}

/* How long the clipped plateaus are: the longest one's greater extent, the mean of tall less wide, and its largest size. */
enum { LONGEST, MEAN_TALLER, MOST_TALLER };

static void sum_up(i64 plateaus, const double *spots, double *extent) {
    memset(extent, 0, 3 * sizeof *extent);
    for (i64 k = 0; k < plateaus; k++) {
        const double *s = spots + k * COLUMNS;
        extent[LONGEST] = fmax(extent[LONGEST], s[NARROW_PX] + fabs(s[LONGER_PX]));
        extent[MOST_TALLER] = fmax(extent[MOST_TALLER], fabs(s[LONGER_PX]));
        extent[MEAN_TALLER] += s[LONGER_PX] / (double)plateaus;
    }
}

typedef struct { i64 lit, components, spots, plateaus; } Counts;

/* Lit pixels, (4, room) of them: rows, columns, component and plateau; their values; and the table of spots, each as far as
 * there is room. `counts` gets how many of each there are; `told` the largest grey value and the plateaus' extent. Returns
 * 0, -1 past `most` lit pixels, -2 without memory. */
i64 kernel_detect(const Image *im, const double *tiles, i64 tr, i64 tc, i64 most, double saturated, double hot_share,
                  i64 room, i64 *pixels, double *values, i64 spot_room, double *spots, Counts *counts, double *told) {
    i64 *rows = pixels, *columns = rows + room, *label = columns + room, *plateau = label + room;
    i64 n = counts->lit = find_lit(im, tiles, tr, tc, most, room, rows, columns, values, told);
    if (n < 0) return -1;
    if (n > room) return 0;
    i64 components = counts->components = components_of(n, rows, columns, label);
    i64 count = counts->plateaus = find_plateaus(n, rows, columns, values, label, saturated, plateau, spot_room, spots);
    if (components < 0 || count < 0) return -2;
    for (i64 i = 0; i < n; i++) {
        if (!is_peak(im, rows[i], columns[i], values[i], saturated)) continue;
        if (count < spot_room) {
            double *s = spots + count * COLUMNS;
            memset(s, 0, COLUMNS * sizeof *s);
            s[CENTRE_X] = (double)columns[i], s[CENTRE_Y] = (double)rows[i], s[COMPONENT] = (double)label[i];
        }
        count++;
    }
    counts->spots = count;
    if (count > spot_room) return 0;
    sum_up(counts->plateaus, spots, told + 1);
    return describe(im, n, rows, columns, label, components, hot_share, count, spots) ? 0 : -2;
}
