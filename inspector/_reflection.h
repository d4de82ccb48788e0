/* A seed and its two highlights, inverse: shared by reflection.py and by the pairing in detect/. */
#ifndef INSPECTOR_REFLECTION_H
#define INSPECTOR_REFLECTION_H
#include <math.h>

#include "_optics.h"

typedef struct {      /* the camera's centre, mm; the lamp's position, mm, or, where it is not near, its unit direction */
    double eye[3], lamp[3];
    i64 lamp_is_near;
} Scene;

typedef struct {      /* a pixel's viewing ray: unit direction, and what turns mm across it at unit distance into pixels */
    double along[3], across[2][3];
} Ray;

typedef struct {      /* place and radius (mm) with their covariance, the spare equation's chi2, the normals at the spots,
                       * how far the mirror spot is seen from where it should be of the direct one, px, and what share of
                       * its height a sunk seed would be read low by (reflection_seeds alone says that) */
    double theta[3], covariance[9], chi2, direct_normal[3], mirror_normal[3], off[2], sunk_share;
} Seed;

/* Rays of n pixels (n, 2); their derivatives from directions a step (px) to the right and below. */
void reflection_rays(const Camera *camera, i64 n, const double *xy, double step, Ray *rays);

/* Pixels from direct to mirror spot of a small seed at the ray's foot, per mm of radius. NaN where there is no foot. */
void reflection_direction(const Scene *scene, const Ray *ray, double toward[2]);

/* How the mirror spot moves against the direct one, px, per mm by which a seed's centre is higher at the ray's foot. */
void reflection_lift(const Scene *scene, const Ray *ray, double lift[2]);

/* The resting seed that explains two rays best; `weight` are the inverse covariances of their pixels (symmetric 2 x 2). */
void reflection_solve(const Scene *scene, const Ray *direct, const Ray *mirror, const double direct_weight[4],
                      const double mirror_weight[4], Seed *seed);

/* Inverse of a symmetric 2 x 2 matrix; infinite or NaN where there is none. */
static inline void invert_2x2(const double m[4], double out[4]) {
    double scale = 1 / (m[0] * m[3] - m[1] * m[2]);
    out[0] = m[3] * scale, out[1] = out[2] = -m[1] * scale, out[3] = m[0] * scale;
}

static inline double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

#endif
