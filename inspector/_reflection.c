/* The inverse of reflection.py, which says what the mathematics is: closed form, for one pixel or one pair at a time.
 *
 * It is here because a frame asks for it a hundred times on a few numbers each, where numpy's calls cost a hundred times
 * the arithmetic. Plain C through ctypes; nothing fails: what has no solution comes out infinite or NaN.
 */
#include "_reflection.h"

enum { MOST_ROUNDS = 40 };      /* a near lamp is seen from the spot, which moves with the seed: each round wins a digit or two */
static const double SETTLED_MM = 1e-11;
static const double UP[3] = {0, 0, 1};

static void unit(double v[3]) {
    double length = sqrt(dot(v, v));
    for (int k = 0; k < 3; k++) v[k] /= length;
}

/* Unit vector from a point towards the lamp. */
static void toward_lamp(const Scene *scene, const double *point, double out[3]) {
    for (int k = 0; k < 3; k++) out[k] = scene->lamp[k] - (scene->lamp_is_near ? point[k] : 0);
    if (scene->lamp_is_near) unit(out);
}

static double mirrored(int axis) { return axis == 2 ? -1 : 1; }

void reflection_rays(const Camera *camera, i64 n, const double *xy, double step, Ray *rays) {
    for (i64 i = 0; i < n; i++) {
        double d[3][3], j[2][3], gram[4], inverse[4];
        for (int m = 0; m < 3; m++) {
            camera_direction(camera, xy[2 * i] + (m == 1) * step, xy[2 * i + 1] + (m == 2) * step, d[m]);
            unit(d[m]);
        }
        for (int m = 0; m < 2; m++) {
            for (int k = 0; k < 3; k++) j[m][k] = (d[m + 1][k] - d[0][k]) / step;
            double lengthwise = dot(j[m], d[0]);      /* a ray says nothing along itself */
            for (int k = 0; k < 3; k++) j[m][k] -= lengthwise * d[0][k];
        }
        for (int m = 0; m < 4; m++) gram[m] = dot(j[m / 2], j[m % 2]);
        invert_2x2(gram, inverse);
        for (int k = 0; k < 3; k++) {
            rays[i].along[k] = d[0][k];
            for (int m = 0; m < 2; m++) rays[i].across[m][k] = inverse[2 * m] * j[0][k] + inverse[2 * m + 1] * j[1][k];
        }
    }
}

void reflection_direction(const Scene *scene, const Ray *ray, double toward[2]) {
    const double *eye = scene->eye;
    double reach = ray->along[2] < 0 ? -eye[2] / ray->along[2] : NAN, foot[3], lamp[3], direct[3], mirror[3], apart[3];
    for (int k = 0; k < 3; k++) foot[k] = eye[k] + reach * ray->along[k];
    toward_lamp(scene, foot, lamp);
    for (int k = 0; k < 3; k++) direct[k] = lamp[k] - ray->along[k], mirror[k] = mirrored(k) * eye[k] - foot[k];
    unit(direct), unit(mirror);
    for (int k = 0; k < 3; k++) mirror[k] += lamp[k];
    unit(mirror);
    for (int k = 0; k < 3; k++) apart[k] = (mirror[k] + UP[k]) * mirrored(k) - direct[k] - UP[k];
    for (int m = 0; m < 2; m++) toward[m] = dot(ray->across[m], apart) / reach;
}

void reflection_lift(const Scene *scene, const Ray *ray, double lift[2]) {
    double reach = ray->along[2] < 0 ? -scene->eye[2] / ray->along[2] : NAN;
    for (int m = 0; m < 2; m++) lift[m] = -2 * dot(ray->across[m], UP) / reach;
}

void reflection_directions(const Scene *scene, i64 n, const Ray *rays, double *toward) {
    for (i64 i = 0; i < n; i++) reflection_direction(scene, rays + i, toward + 2 * i);
}

/* Inverse of a symmetric 3 x 3 matrix by cofactors. */
static void invert_3x3(const double m[9], double out[9]) {
    double a = m[0], b = m[1], c = m[2], d = m[4], e = m[5], f = m[8];
    out[0] = d * f - e * e, out[4] = a * f - c * c, out[8] = a * d - b * b;
    out[1] = out[3] = c * e - b * f;
    out[2] = out[6] = b * e - c * d;
    out[5] = out[7] = b * c - a * e;
    double scale = 1 / (a * out[0] + b * out[1] + c * out[2]);
    for (int k = 0; k < 9; k++) out[k] *= scale;
}

typedef struct {      /* one spot: camera seen from `origin` (mirrored for the mirror spot), ray, weight, its two equations */
    double eye[3], along[3], across[2][3], reach, normal[3], rows[2][3], seen[2];
    const double *weight;
} View;

/* mm at the spot become pixels by its distance; where the ray meets the panel is near enough, and sets weights only. */
static void look(const Scene *scene, const Ray *ray, const double *weight, const double *origin, int is_mirror, View *v) {
    for (int k = 0; k < 3; k++) {
        v->eye[k] = scene->eye[k] * (is_mirror ? mirrored(k) : 1) - origin[k];
        v->along[k] = ray->along[k] * (is_mirror ? mirrored(k) : 1);
    }
    v->reach = fmax(fabs(v->eye[2]) / fmax(fabs(v->along[2]), 1e-9), 1e-3);
    for (int m = 0; m < 2; m++) {
        for (int k = 0; k < 3; k++) v->across[m][k] = ray->across[m][k] * (is_mirror ? mirrored(k) : 1) / v->reach;
        v->seen[m] = dot(v->across[m], v->eye);
    }
    v->weight = weight;
}

/* Add one spot's two equations in (X, Y, R) to the normal equations. */
static void add_equations(const Scene *scene, View *v, const double *origin, double matrix[9], double right[3]) {
    double spot[3], lever[3];
    for (int k = 0; k < 3; k++) spot[k] = origin[k] + v->eye[k] + v->reach * v->along[k];
    toward_lamp(scene, spot, v->normal);
    for (int k = 0; k < 3; k++) v->normal[k] -= v->along[k];
    unit(v->normal);
    for (int k = 0; k < 3; k++) lever[k] = v->normal[k] + UP[k];
    for (int m = 0; m < 2; m++)
        v->rows[m][0] = v->across[m][0], v->rows[m][1] = v->across[m][1], v->rows[m][2] = dot(v->across[m], lever);
    for (int a = 0; a < 3; a++) {
        double w[2];      /* a row of (rows^T weight) */
        for (int m = 0; m < 2; m++) w[m] = v->rows[0][a] * v->weight[m] + v->rows[1][a] * v->weight[2 + m];
        for (int b = 0; b < 3; b++) matrix[3 * a + b] += w[0] * v->rows[0][b] + w[1] * v->rows[1][b];
        right[a] += w[0] * v->seen[0] + w[1] * v->seen[1];
    }
}

/* The spot's misfit r in pixels, as the model has it less as it is seen, and its chi2. */
static double chi2_of(const View *v, const double *theta, double r[2]) {
    for (int m = 0; m < 2; m++) r[m] = dot(v->rows[m], theta) - v->seen[m];
    return r[0] * (v->weight[0] * r[0] + v->weight[1] * r[1]) + r[1] * (v->weight[2] * r[0] + v->weight[3] * r[1]);
}

void reflection_solve(const Scene *scene, const Ray *direct, const Ray *mirror, const double direct_weight[4],
                      const double mirror_weight[4], Seed *seed) {
    View views[2];
    double down = fmax(fabs(direct->along[2]), 1e-9), origin[3] = {0};      /* near the seed: its small radius is not lost */
    for (int k = 0; k < 2; k++) origin[k] = scene->eye[k] + fabs(scene->eye[2]) / down * direct->along[k];
    look(scene, direct, direct_weight, origin, 0, &views[0]);
    look(scene, mirror, mirror_weight, origin, 1, &views[1]);
    double moved = INFINITY;
    for (int round = 0; round < (scene->lamp_is_near ? MOST_ROUNDS : 1) && moved > SETTLED_MM; round++) {
        double matrix[9] = {0}, right[3] = {0};
        for (int s = 0; s < 2; s++) add_equations(scene, &views[s], origin, matrix, right);
        invert_3x3(matrix, seed->covariance);
        for (int k = 0; k < 3; k++) seed->theta[k] = dot(seed->covariance + 3 * k, right);
        moved = 0;
        for (int s = 0; s < 2; s++) {
            double way[3], before = views[s].reach;      /* from the eye to the spot S + R n, S = (X, Y, R) */
            for (int k = 0; k < 3; k++)
                way[k] = seed->theta[k] + seed->theta[2] * views[s].normal[k] - views[s].eye[k];
            views[s].reach = dot(way, views[s].along);
            moved = fmax(moved, fabs(views[s].reach - before));
        }
    }
    double direct_off[2], mirror_off[2];
    seed->chi2 = chi2_of(&views[0], seed->theta, direct_off) + chi2_of(&views[1], seed->theta, mirror_off);
    for (int m = 0; m < 2; m++) seed->off[m] = direct_off[m] - mirror_off[m];
    for (int k = 0; k < 2; k++) seed->theta[k] += origin[k];
    for (int k = 0; k < 3; k++) seed->direct_normal[k] = views[0].normal[k], seed->mirror_normal[k] = views[1].normal[k];
}

static const double SUNK_CENTRE = 0.5;      /* height of a sunk seed's centre over its radius, in the middle of 0.3 to 0.9 */

/* What share of the height c + R is missed when a seed with its centre so low is taken to rest. In the limit of small R the
 * spots are R shine + c lift apart; what of that lies along the resting direction, R (shine + lift), is taken for R. */
static double sunk_share(const Scene *scene, const Ray *ray) {
    double toward[2], lift[2];
    reflection_direction(scene, ray, toward), reflection_lift(scene, ray, lift);
    double along = (lift[0] * toward[0] + lift[1] * toward[1]) / (toward[0] * toward[0] + toward[1] * toward[1]);
    return 1 - 2 * (1 - along + SUNK_CENTRE * along) / (1 + SUNK_CENTRE);
}

/* Seeds of n pairs: indices into rays and covariances (4 each, px^2). */
void reflection_seeds(const Scene *scene, i64 n, const i64 *direct, const i64 *mirror, const Ray *rays,
                      const double *covariance, Seed *seeds) {
    for (i64 i = 0; i < n; i++) {
        double weight[2][4];
        invert_2x2(covariance + 4 * direct[i], weight[0]);
        invert_2x2(covariance + 4 * mirror[i], weight[1]);
        reflection_solve(scene, rays + direct[i], rays + mirror[i], weight[0], weight[1], seeds + i);
        seeds[i].sunk_share = sunk_share(scene, rays + direct[i]);
    }
}
