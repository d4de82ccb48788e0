/* Candidate pairs of one frame, sieved and scored: the loops of pairs.py, which says what each number means. */
#include "../_reflection.h"

typedef struct {
    double largest_radius_mm, bend_share, bend_px, model_share, worth, ratio_sigma, paint_index;
} Rules;

typedef struct {      /* the frame's spots, n of each: pixels (n, 2), their covariance (n, 4), flux, sigma of log flux */
    const double *xy, *covariance, *flux, *flux_sigma;
    const Ray *rays;
} Spots;

typedef struct {
    double cost, radius_mm, size;
} Score;

/* Reflectance of the clear coat for unpolarised light (Fresnel). */
static double fresnel(double cosine, double index) {
    double inside = sqrt(1 - (1 - cosine * cosine) / (index * index));
    double s = (cosine - index * inside) / (cosine + index * inside), p = (inside - index * cosine) / (inside + index * cosine);
    return (s * s + p * p) / 2;
}

/* Flux of the direct spot over the mirror spot's: one reflection against two. A small convex mirror sends the same
 * flux whatever the angle, so only the reflectances differ. */
static double expected_ratio(const Ray *direct, const Ray *mirror, const Seed *seed, double index) {
    double down[3] = {mirror->along[0], mirror->along[1], -mirror->along[2]};
    double sphere = fresnel(fabs(dot(down, seed->mirror_normal)), index), paint = fresnel(fabs(down[2]), index);
    return fresnel(fabs(dot(direct->along, seed->direct_normal)), index) / (sphere * paint);
}

/* Inverse of a spot's covariance with the model's own variance added. */
static void weigh(const Spots *spots, i64 i, double model, double weight[4]) {
    const double *c = spots->covariance + 4 * i;
    double sum[4] = {c[0] + model, c[1], c[2], c[3] + model};
    invert_2x2(sum, weight);
}

static Score score(const Scene *scene, const Rules *u, const Spots *spots, i64 a, i64 b, double along_px) {
    double weight[2][4], model = u->model_share * along_px * (u->model_share * along_px);
    Seed seed;
    weigh(spots, a, model, weight[0]), weigh(spots, b, model, weight[1]);
    reflection_solve(scene, spots->rays + a, spots->rays + b, weight[0], weight[1], &seed);
    double sa = spots->flux_sigma[a], sb = spots->flux_sigma[b], radius = seed.theta[2];
    double ratio = log(spots->flux[a] / spots->flux[b] / expected_ratio(spots->rays + a, spots->rays + b, &seed, u->paint_index));
    double cost = seed.chi2 / 2 + ratio * ratio / (2 * (u->ratio_sigma * u->ratio_sigma + sa * sa + sb * sb));
    return (Score){cost, radius, log(spots->flux[a] / (radius * radius))};
}

/* All ordered couples among the m `able` spots that lie along the direction from direct to mirror spot and fit the model
 * at all. Returns how many there are; only the first `most` are written. */
i64 pairs_candidates(const Scene *scene, const Rules *u, i64 m, const i64 *able, const double *xy, const double *covariance,
                     const double *flux, const double *flux_sigma, const Ray *rays, i64 most, i64 *direct, i64 *mirror,
                     Score *scores) {
    Spots spots = {xy, covariance, flux, flux_sigma, rays};
    i64 count = 0;
    for (i64 i = 0; i < m; i++) {
        double toward[2];
        i64 a = able[i];
        reflection_direction(scene, rays + a, toward);
        double scale = hypot(toward[0], toward[1]);
        for (i64 j = 0; j < m; j++) {
            i64 b = able[j];
            double x = xy[2 * b] - xy[2 * a], y = xy[2 * b + 1] - xy[2 * a + 1];
            double along = (x * toward[0] + y * toward[1]) / scale, beside = fabs(y * toward[0] - x * toward[1]) / scale;
            if (!(along > 0.5 && along < u->largest_radius_mm * scale && beside < u->bend_px + u->bend_share * along)) continue;
            Score found = score(scene, u, &spots, a, b, along);
            if (!(found.radius_mm > 0 && found.radius_mm < u->largest_radius_mm && found.cost < u->worth)) continue;
            if (count < most) direct[count] = a, mirror[count] = b, scores[count] = found;
            count++;
        }
    }
    return count;
}
