/* The dark panel's grey value and noise from a grid of samples: the loops of lit.py, which says what is taken and why. */
#include "_kernel.h"

/* The k-th smallest of n values between `low` and `high`, by halving that range: counting has no branches to mispredict. */
WIDE static uint16_t kth(const uint16_t *v, i64 n, i64 k, uint16_t low, uint16_t high) {
    while (low < high) {
        uint16_t middle = (uint16_t)((low + high) / 2), count = 0;
        for (i64 i = 0; i < n; i++) count = (uint16_t)(count + (v[i] <= middle));
        if (count > k) high = middle; else low = (uint16_t)(middle + 1);
    }
    return low;
}

/* Pixel as integer: the loops below are as long as the estimate takes, and doubles would make them twice that. */
static inline int dn(const Image *im, const uint8_t *row, i64 column) {
    return im->bytes == 1 ? row[column] : ((const Grey16 *)row)[column];
}

/* |differences| of neighbours in a row, at every `down`-th row and `right`-th column. Returns how many. */
static i64 find_steps(const Image *im, i64 down, i64 right, uint16_t *step) {
    i64 n = 0;
    for (i64 r = down / 2; r < im->height; r += down) {
        const uint8_t *row = im->data + r * im->stride;
        for (i64 c = right / 2; c + 1 < im->width; c += right) step[n++] = (uint16_t)abs(dn(im, row, c) - dn(im, row, c + 1));
    }
    return n;
}

/* Mean of n steps, each cut at `most`. */
WIDE static double mean_step(const uint16_t *step, i64 n, double most) {
    uint32_t limit = (uint32_t)most, cut = 0;
    uint64_t total = 0;
    for (i64 begin = 0; begin < n; begin += 4096) {      /* a sum of so many fits 32 bits */
        i64 end = begin + 4096 < n ? begin + 4096 : n;
        uint32_t sum = 0;
        for (i64 i = begin; i < end; i++) {
            uint32_t over = step[i] > limit;
            sum += over ? 0 : step[i], cut += over;
        }
        total += sum;
    }
    return n ? ((double)total + (double)cut * most) / (double)n : 0;
}

static int ascending(const void *a, const void *b) {
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

/* What is told of the frame beside its tiles; lit.py reads it by the same numbers. */
enum { DARKEST, STEP, MEDIAN_TILE, DARKEST_TILE, BRIGHTEST_TILE, TOLD };

/* Medians of (rows, columns) tiles of (deep, wide) samples each, every `down`-th row and `right`-th column from the middle
 * of the first; the darkest sample; and the mean step between neighbours, cut at thrice its own mean (and one). Returns -1
 * without memory. */
i64 background_of(const Image *im, i64 down, i64 right, i64 rows, i64 columns, i64 deep, i64 wide, double *median,
                  double *told) {
    i64 tiles = rows * columns, steps = (im->height / down + 1) * (im->width / right + 1);
    double *sorted = malloc((size_t)tiles * sizeof *sorted);
    uint16_t *sample = malloc((size_t)(deep * wide + steps) * sizeof *sample), *step = sample + deep * wide, least = UINT16_MAX;
    if (sample && sorted) {
        for (i64 i = 0; i < rows; i++)
            for (i64 j = 0; j < columns; j++) {
                i64 n = 0;
                for (i64 r = 0; r < deep; r++) {
                    const uint8_t *row = im->data + (down / 2 + (i * deep + r) * down) * im->stride;
                    for (i64 c = 0; c < wide; c++) sample[n++] = (uint16_t)dn(im, row, right / 2 + (j * wide + c) * right);
                }
                uint16_t low = UINT16_MAX, high = 0;
                for (i64 k = 0; k < n; k++) low = sample[k] < low ? sample[k] : low, high = sample[k] > high ? sample[k] : high;
                median[i * columns + j] = kth(sample, n, n / 2, low, high);
                least = low < least ? low : least;
            }
        steps = find_steps(im, down, right, step);
        told[STEP] = mean_step(step, steps, 3 * mean_step(step, steps, UINT16_MAX) + 1);
        memcpy(sorted, median, (size_t)tiles * sizeof *sorted);
        qsort(sorted, (size_t)tiles, sizeof *sorted, ascending);
        told[DARKEST] = least, told[DARKEST_TILE] = sorted[0], told[BRIGHTEST_TILE] = sorted[tiles - 1];
        told[MEDIAN_TILE] = (sorted[(tiles - 1) / 2] + sorted[tiles / 2]) / 2;
    }
    int fine = sample && sorted;
    free(sample), free(sorted);
    return fine ? 0 : -1;
}

/* Where a pixel lies between tile centres: the lower tile and the share of the next; straight on beyond the outermost. */
static i64 between(double pixel, i64 length, i64 tiles, double *share) {
    double at = (pixel + 0.5) * (double)tiles / (double)length - 0.5;
    i64 low = (i64)fmin(fmax(at, 0), (double)(tiles > 1 ? tiles - 2 : 0));
    *share = at - (double)low;
    return low;
}

/* The background at a pixel, bilinear between the centres of (rows, columns) tiles of a frame. */
double background_at(i64 height, i64 width, i64 rows, i64 columns, const double *tiles, double row, double column) {
    double down, right;
    i64 r = between(row, height, rows, &down), c = between(column, width, columns, &right), next = columns > 1;
    const double *upper = tiles + r * columns + c, *lower = upper + (rows > 1 ? columns : 0);
    return (upper[0] * (1 - down) + lower[0] * down) * (1 - right) + (upper[next] * (1 - down) + lower[next] * down) * right;
}
