/* The dark panel's grey value and noise from a grid of samples: the loops of lit.py, which says what is taken and why. */
#include "_kernel.h"

/* The k-th smallest of n values between `low` and `high`, by halving that range: counting has no branches to mispredict. */
static uint16_t kth(const uint16_t *v, i64 n, i64 k, uint16_t low, uint16_t high) {
    while (low < high) {
        uint16_t middle = (uint16_t)((low + high) / 2), count = 0;
        for (i64 i = 0; i < n; i++) count = (uint16_t)(count + (v[i] <= middle));
        if (count > k) high = middle; else low = (uint16_t)(middle + 1);
    }
    return low;
}

/* Pixel as integer: the loops below are as long as the estimate takes, and doubles would make them twice that. */
static inline int dn(const Image *im, const uint8_t *row, i64 column) {
    return im->bytes == 1 ? row[column] : ((const uint16_t *)row)[column];
}

/* Mean |difference| of neighbours in a row at every `down`-th row and `right`-th column, each cut at `most`. */
static double mean_step(const Image *im, i64 down, i64 right, double most) {
    i64 sum = 0, n = 0, limit = (i64)most, cut = 0;
    for (i64 r = down / 2; r < im->height; r += down) {
        const uint8_t *row = im->data + r * im->stride;
        for (i64 c = right / 2; c + 1 < im->width; c += right, n++) {
            int step = abs(dn(im, row, c) - dn(im, row, c + 1)), over = step > limit;
            sum += over ? 0 : step, cut += over;
        }
    }
    return n ? ((double)sum + (double)cut * most) / (double)n : 0;
}

/* Medians of (rows, columns) tiles of (deep, wide) samples each, every `down`-th row and `right`-th column from the middle
 * of the first; the darkest sample; and the mean step between neighbours, cut at thrice its own mean (and one). Returns -1
 * without memory. */
i64 background_of(const void *data, i64 bytes, i64 height, i64 width, i64 stride, i64 down, i64 right, i64 rows, i64 columns,
                  i64 deep, i64 wide, double *median, double *darkest, double *step) {
    Image im = {data, bytes, height, width, stride};
    uint16_t *sample = malloc((size_t)(deep * wide) * sizeof *sample), least = UINT16_MAX;
    if (!sample) return -1;
    for (i64 i = 0; i < rows; i++)
        for (i64 j = 0; j < columns; j++) {
            i64 n = 0;
            for (i64 r = 0; r < deep; r++) {
                const uint8_t *row = im.data + (down / 2 + (i * deep + r) * down) * stride;
                for (i64 c = 0; c < wide; c++) sample[n++] = (uint16_t)dn(&im, row, right / 2 + (j * wide + c) * right);
            }
            uint16_t low = UINT16_MAX, high = 0;
            for (i64 k = 0; k < n; k++) low = sample[k] < low ? sample[k] : low, high = sample[k] > high ? sample[k] : high;
            median[i * columns + j] = kth(sample, n, n / 2, low, high);
            least = low < least ? low : least;
        }
    free(sample);
    *darkest = least;
    *step = mean_step(&im, down, right, UINT16_MAX);
    *step = mean_step(&im, down, right, 3 * *step + 1);
    return 0;
}

/* Where a pixel lies between tile centres: the lower tile and the share of the next; constant beyond the outermost. */
static i64 between(i64 pixel, i64 length, i64 tiles, double *share) {
    double at = ((double)pixel + 0.5) * (double)tiles / (double)length - 0.5;
    i64 low = (i64)fmin(fmax(at, 0), (double)(tiles > 1 ? tiles - 2 : 0));
    *share = at - (double)low;
    return low;
}

/* The background (n) at pixels, bilinear between the centres of (rows, columns) tiles of a frame. */
i64 background_at(i64 height, i64 width, i64 rows, i64 columns, const double *tiles, i64 n, const i64 *row, const i64 *column,
                  double *level) {
    for (i64 k = 0; k < n; k++) {
        double down, right;
        i64 r = between(row[k], height, rows, &down), c = between(column[k], width, columns, &right);
        const double *upper = tiles + r * columns + c, *lower = upper + (rows > 1 ? columns : 0);
        i64 next = columns > 1;
        level[k] = (upper[0] * (1 - down) + lower[0] * down) * (1 - right) + (upper[next] * (1 - down) + lower[next] * down) * right;
    }
    return n;
}
