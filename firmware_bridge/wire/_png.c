/* Rows of a PNG file to pixels: filters undone (PNG specification, 9.2).
 *
 * Called through ctypes by image.py; no Python in here, so that it builds with any C compiler and runs without the
 * interpreter's lock. Whatever the bytes say, no more is read or written than the arguments allow.
 */
#include <stdint.h>
#include <string.h>

typedef int64_t i64;

enum { NONE, SUB, UP };

/* Bytes less the one before them; the sum stays in a register, where `out` would have to be waited for. */
static void sub_1(const uint8_t *in, uint8_t *out, i64 n) {
    uint8_t left = 0;
    for (i64 i = 0; i < n; i++) out[i] = left = (uint8_t)(left + in[i]);
}

/* The same for pixels of two bytes. */
static void sub_2(const uint8_t *in, uint8_t *out, i64 n) {
    uint8_t high = 0, low = 0;
    for (i64 i = 0; i + 1 < n; i += 2) {
        out[i] = high = (uint8_t)(high + in[i]);
        out[i + 1] = low = (uint8_t)(low + in[i + 1]);
    }
}

static void up(const uint8_t *restrict in, const uint8_t *restrict above, uint8_t *restrict out, i64 n) {
    for (i64 i = 0; i < n; i++) out[i] = (uint8_t)(above[i] + in[i]);
}

/* `height` rows, each a filter's number and the bytes of `width` pixels, of `depth` (1 or 2) bytes each, into `out`
 * without the numbers. How many rows are done: height, or those before the first that has another filter. */
i64 png_rows(const uint8_t *in, i64 height, i64 width, i64 depth, uint8_t *out) {
    i64 n = width * depth;
    for (i64 row = 0; row < height; row++, in += n + 1, out += n) {
        if (in[0] == NONE || (in[0] == UP && row == 0))
            memcpy(out, in + 1, (size_t)n);
        else if (in[0] == SUB && depth == 1)
            sub_1(in + 1, out, n);
        else if (in[0] == SUB)
            sub_2(in + 1, out, n);
        else if (in[0] == UP)
            up(in + 1, out - n, out, n);
        else
            return row;
    }
    return height;
}
