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

typedef struct {      /* a grey image of 1 or 2 bytes a pixel; rows lie `stride` bytes apart */
    const uint8_t *data;
    i64 bytes, height, width, stride;
} Image;

static inline double grey(const Image *im, i64 row, i64 column) {
    const uint8_t *p = im->data + row * im->stride;
    return im->bytes == 1 ? p[column] : ((const uint16_t *)p)[column];
}

/* Union-find with path halving; roots are the least index of their set. */
static inline i64 root(i64 *parent, i64 x) {
    while (parent[x] != x) x = parent[x] = parent[parent[x]];
    return x;
}

static inline void join(i64 *parent, i64 a, i64 b) {
    a = root(parent, a), b = root(parent, b);
    if (a < b) parent[b] = a; else parent[a] = b;
}

int kernel_solve(i64 m, double *a, i64 k, double *right);

#endif
