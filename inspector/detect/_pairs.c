/* Candidate pairs of one frame, sieved and scored: the loops of pairs.py, which says what each number means. */
#include "../_reflection.h"

static const double PI = 3.14159265358979323846;

typedef struct {
    double largest_radius_mm, bend_share, bend_px, model_share, worth, ratio_sigma, paint_index;
    double sunk_share, usual_radius_mm, radius_scatter, chance_ratio_sigma, least_odds, spots_a_px2;
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

static double squared(double x) { return x * x; }
static double log_normal(double x, double variance) { return -0.5 * (x * x / variance + log(2 * PI * variance)); }
static double below(double x) { return 0.5 * erfc(-x / sqrt(2)); }

/* Log of the density, per pixel, of a true pair's mirror spot so far beside the line of resting seeds, `off` px with that
 * variance. A sunk seed's lies up to `sunk_px` to one side: its centre is anywhere from a radius high to the surface. */
static double log_beside(const Rules *u, double off, double variance, double sunk_px) {
    double rests = exp(log_normal(off, variance)), sigma = sqrt(variance);
    double a = off / sigma, b = (off - sunk_px) / sigma;
    double sunk = fabs(sunk_px) > 0.1 * sigma ? (below(a) - below(b)) / sunk_px : rests;
    return log((1 - u->sunk_share) * rests + u->sunk_share * fabs(sunk));
}

/* What a couple costs: the log odds that chance put the second spot there, of such a brightness, against a seed's. */
static Score score(const Scene *scene, const Rules *u, const Spots *spots, i64 a, i64 b, const double toward[2], double along_px) {
    const double *ca = spots->covariance + 4 * a, *cb = spots->covariance + 4 * b;
    double weight[2][4], scale = hypot(toward[0], toward[1]), across[2] = {-toward[1] / scale, toward[0] / scale};
    const Ray *ray = spots->rays + a;
    Seed seed;
    invert_2x2(ca, weight[0]), invert_2x2(cb, weight[1]);
    reflection_solve(scene, ray, spots->rays + b, weight[0], weight[1], &seed);
    double radius = seed.theta[2], off = across[0] * seed.off[0] + across[1] * seed.off[1];
    double variance = squared(u->model_share * along_px);
    for (int m = 0; m < 4; m++) variance += across[m / 2] * across[m % 2] * (ca[m] + cb[m]);
    double lift[2];
    reflection_lift(scene, ray, lift);
    double sunk_px = -radius * (across[0] * lift[0] + across[1] * lift[1]);
    double beside = log_beside(u, off, variance, sunk_px);
    double along = log_normal(log(radius / u->usual_radius_mm), squared(u->radius_scatter)) - log(along_px);
    double sa = spots->flux_sigma[a], sb = spots->flux_sigma[b], noise = sa * sa + sb * sb;
    double ratio = log(spots->flux[a] / spots->flux[b] / expected_ratio(ray, spots->rays + b, &seed, u->paint_index));
    double bright = log_normal(ratio, squared(u->ratio_sigma) + noise) - log_normal(ratio, squared(u->chance_ratio_sigma) + noise);
    double odds = beside + along + bright - log(u->spots_a_px2);
    return (Score){u->worth + u->least_odds - odds, radius, log(spots->flux[a] / (radius * radius))};
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
            Score found = score(scene, u, &spots, a, b, toward, along);
            if (!(found.radius_mm > 0 && found.radius_mm < u->largest_radius_mm && found.cost < u->worth)) continue;
            if (count < most) direct[count] = a, mirror[count] = b, scores[count] = found;
            count++;
        }
    }
    return count;
}
