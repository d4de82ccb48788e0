/* Rows of a PNG file to pixels: filters undone (PNG specification, 9.2).
 *
 * Called through ctypes by image.py; no Python in here, so that it builds with any C compiler and runs without the
 * interpreter's lock. Whatever the bytes say, no more is read or written than the arguments allow.
 */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#ifdef __SSE2__
#include <emmintrin.h>
#endif

typedef int64_t i64;

enum { NONE, SUB, UP, AVERAGE, PAETH };

static void up(const uint8_t *in, const uint8_t *above, uint8_t *out, i64 n) {
    for (i64 i = 0; i < n; i++) out[i] = (uint8_t)(above[i] + in[i]);
}

enum { PIXEL_BYTES = 2 };

static inline int nearest(int left, int up, int corner) {
    int to_left = abs(up - corner), to_up = abs(left - corner), to_corner = abs(left + up - 2 * corner);
    int upper = to_up <= to_corner ? up : corner;
    return to_left <= to_up && to_left <= to_corner ? left : upper;
}

/* Filters that look to the left, by pixels of `pixel` bytes. What was just written stays in registers, where `out`
 * would have to be waited for; so `pixel` and `filter` are constants where this is called. */
static inline void along(int filter, const uint8_t *in, const uint8_t *above, uint8_t *out, i64 n, const int pixel) {
    uint8_t left[PIXEL_BYTES] = {0}, corner[PIXEL_BYTES] = {0};
    for (i64 i = 0; i + pixel <= n; i += pixel)
        for (int k = 0; k < pixel; k++) {
            uint8_t up = filter == SUB ? 0 : above[i + k];
            int foretold = filter == SUB ? left[k] : filter == AVERAGE ? (left[k] + up) / 2 : nearest(left[k], up, corner[k]);
            out[i + k] = left[k] = (uint8_t)(in[i + k] + foretold);
            corner[k] = up;
        }
}

/* SUB of pixels of one byte, which is what frames are recorded in. On an x86-64 sixteen at a time: four steps sum them up by
 * themselves, and only one addition waits for the sixteen before. */
static void sub_1(const uint8_t *in, uint8_t *out, i64 n) {
    i64 i = 0;
#ifdef __SSE2__
    for (__m128i left = _mm_setzero_si128(); i + 16 <= n; i += 16) {
        __m128i x = _mm_loadu_si128((const __m128i *)(in + i));
        x = _mm_add_epi8(x, _mm_slli_si128(x, 1)), x = _mm_add_epi8(x, _mm_slli_si128(x, 2));
        x = _mm_add_epi8(x, _mm_slli_si128(x, 4)), x = _mm_add_epi8(x, _mm_slli_si128(x, 8));
        x = _mm_add_epi8(x, left);
        _mm_storeu_si128((__m128i *)(out + i), x);
        left = _mm_shufflehi_epi16(_mm_unpackhi_epi8(x, x), 0xff), left = _mm_unpackhi_epi64(left, left); /* its last byte */
    }
#endif
    for (uint8_t left = i ? out[i - 1] : 0; i < n; i++) out[i] = left = (uint8_t)(left + in[i]);
}

/* One row by its filter, below another; whether there is such a filter. */
static int undone(int filter, const uint8_t *in, const uint8_t *above, uint8_t *out, i64 n, i64 pixel) {
    switch (filter) {
    case NONE: memcpy(out, in, (size_t)n); break;
    case UP: up(in, above, out, n); break;
    case SUB: pixel == 1 ? sub_1(in, out, n) : along(SUB, in, above, out, n, 2); break;
    case AVERAGE: pixel == 1 ? along(AVERAGE, in, above, out, n, 1) : along(AVERAGE, in, above, out, n, 2); break;
    case PAETH: pixel == 1 ? along(PAETH, in, above, out, n, 1) : along(PAETH, in, above, out, n, 2); break;
    default: return 0;
    }
    return 1;
}

/* `height` rows, each a filter's number and the bytes of `width` pixels, of `depth` (1 or 2) bytes each, into `out`
 * without the numbers. How many rows are done: height, or those before the first whose filter there is not. */
i64 png_rows(const uint8_t *in, i64 height, i64 width, i64 depth, uint8_t *out) {
    i64 n = width * depth;
    const uint8_t *above = memset(out, 0, (size_t)(height ? n : 0)); /* each byte is read before it is written */
    for (i64 row = 0; row < height; row++, in += n + 1, above = out, out += n)
        if (!undone(in[0], in + 1, above, out, n, depth)) return row;
    return height;
}
