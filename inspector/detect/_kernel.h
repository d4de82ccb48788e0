/* What the detection's C files share: the image, and a small dense solver. */
#ifndef INSPECTOR_KERNEL_H
#define INSPECTOR_KERNEL_H
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define PI 3.14159265358979323846
#define SQRT_2 1.41421356237309504880

typedef int64_t i64;

/* Loops worth compiling for wide vectors too; the loader takes what the processor has. Without fused multiply-add: a
 * result is the same on every x86-64. Elsewhere the plain build already has the processor's vectors. */
#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
#define WIDE __attribute__((target_clones("avx2", "default")))
#else
#define WIDE
#endif

typedef struct {      /* a grey image of 1 or 2 bytes a pixel; rows lie `stride` bytes apart */
    const uint8_t *data;
    i64 bytes, height, width, stride;
} Image;

/* A pixel of two bytes, wherever it lies: a buffer may begin at an odd address, and not every processor reads there. */
typedef uint16_t __attribute__((aligned(1), may_alias)) Grey16;

static inline double grey(const Image *im, i64 row, i64 column) {
    const uint8_t *p = im->data + row * im->stride;
    return im->bytes == 1 ? p[column] : ((const Grey16 *)p)[column];
}

/* Columns of a spot's row in the table that kernel_detect fills; spots.py reads them by the same numbers. */
enum { CENTRE_X, CENTRE_Y, COMPONENT, SATURATED_PX, NARROW_PX, LONGER_PX, COMPONENT_PX, COMPONENT_X, COMPONENT_Y, AT_EDGE,
       IS_HOT, COLUMNS };

/* A spot before its fit: the ground's grey value, its share of its component's pixels, how many of its own are clipped, the
 * clipped lobe's lesser extent, where it is, whether it may have a blur of its own, whether it is one that tells the frame's,
 * and what an earlier fit found of it (FOUND), or NULL. */
typedef struct { double ground, area, clipped, narrow, x, y; int is_free, tells_blur; const double *start; } Given;

/* Columns of what the fit found of a spot; fit.py reads them by the same numbers. */
enum { FOUND_X, FOUND_Y, FOUND_VARIANCE_X, FOUND_COVARIANCE_XY, FOUND_VARIANCE_Y, FOUND_PEAK, FOUND_FLUX, FOUND_BLUR2,
       FOUND_CHI2, FOUND_MISFIT_X, FOUND_MISFIT_Y, FOUND_MISFIT_SIGMA, FOUND_GROUND, FOUND_BLUR_XX, FOUND_BLUR_XY,
       FOUND_BLUR_YY, FOUND };

/* Union-find with path halving; roots are the least index of their set. */
static inline i64 root(i64 *parent, i64 x) {
    while (parent[x] != x) x = parent[x] = parent[parent[x]];
    return x;
}

static inline void join(i64 *parent, i64 a, i64 b) {
    a = root(parent, a), b = root(parent, b);
    if (a < b) parent[b] = a; else parent[a] = b;
}

double background_at(i64 height, i64 width, i64 rows, i64 columns, const double *tiles, double row, double column);
typedef struct Rules Rules;
i64 kernel_fit(const Image *im, const Rules *u, i64 n, const Given *spots, double *found);
int kernel_solve(i64 m, double *a, i64 k, double *right);

#endif
