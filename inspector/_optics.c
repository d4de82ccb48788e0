/* Viewing directions of many pixels: Camera.rays of optics.py. */
#include "_optics.h"

i64 camera_directions(const Camera *camera, i64 n, const double *xy, double *directions) {
    for (i64 i = 0; i < n; i++) camera_direction(camera, xy[2 * i], xy[2 * i + 1], directions + 3 * i);
    return n;
}
