/* Where a pixel looks: the camera of optics.py, inverse. */
#ifndef INSPECTOR_OPTICS_H
#define INSPECTOR_OPTICS_H
#include <stdint.h>

typedef int64_t i64;

typedef struct {      /* sensor mm = (pixel - origin) pitch; undistorted; then `factor` and `offset` turn it into the world */
    double kappa1, origin[2], pitch[2], factor[2][3], offset[3];
} Camera;

/* Direction in the world, not normalised, from the centre of projection through a pixel. */
static inline void camera_direction(const Camera *c, double x, double y, double direction[3]) {
    double u = (x - c->origin[0]) * c->pitch[0], v = (y - c->origin[1]) * c->pitch[1];
    double undistorted = 1 + c->kappa1 * (u * u + v * v);
    for (int k = 0; k < 3; k++) direction[k] = undistorted * (u * c->factor[0][k] + v * c->factor[1][k]) + c->offset[k];
}

#endif
