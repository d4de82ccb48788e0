/* What the files of the fit share: what it goes by, the spots' windows, tangles, and one spot's equations. */
#ifndef INSPECTOR_FIT_H
#define INSPECTOR_FIT_H
#include "_kernel.h"

enum { X, Y, LOG_PEAK, SXX, SXY, SYY, BACKGROUND, SLOPE_X, SLOPE_Y, PARAMETERS };
enum { SHAPE = 6 };
enum { DARK = -12 };      /* a light of exp(-12) DN is none */
enum { LANES = 8 };      /* windows are filled up to a multiple of this with pixels without weight: sums need no remainder */

struct Rules {      /* how grey values become light, what is clipped, and when a fit has settled; see fit.py */
    double black, gamma, clipped, full, level, read_dn, shot_per_dn, pattern;
    double threshold, least_radius, most_radius, tangled_px, damping, settled_px, held_share, free_share, steep_share;
    double scatter_share, sharper, kept_share;
    double most_work;      /* of a round, in pixels at which a Gaussian is evaluated */
    i64 bloom_rows, bloom_columns, rounds;
};

/* The spots' windows: offsets (p) in order of distance, of which spot i takes the first `count[i]`, and from `begin[i]` on
 * their light, weight, what the model left over, and the least that this may be (0 if clipped, else anything); `normal`
 * (n, 9, 9) and `gradient` (n, 9); `known` (n), the variance of what a spot tells of the frame's blur, infinite for one that
 * must not tell; `moved` (n) and `last` (n, 2), how much its last step changed it and how far that took it; and the spots whose light reaches window i, from `neighbours[i]` to `neighbours[i + 1]` in the list
 * `neighbour`. */
typedef struct {
    i64 n, *begin, *count, *centre, *neighbours, *neighbour;      /* centre: column and row */
    double *dx, *dy, *light, *weight, *residual, *normal, *gradient, *theta, *expected, *prior, *step, *asks, *known, *moved, *last;
} Work;

/* A tangle: spots near each other, `size` of the list `member` from `begin` on, solved together; where that would be too
 * much work, each by itself, or not at all. `work`: of a round, in pixels at which a Gaussian is evaluated. */
typedef struct {
    i64 begin, size;
    double work, work_apart;
    enum { TOGETHER, APART, LEFT } how;
    int rests;
} Tangle;

static inline i64 row_of(const Work *w, i64 i) { return w->centre[2 * i + 1]; }

/* Residuals of one spot's window with its neighbours' light subtracted; derivatives (9, p); and the same times weight. `room`
 * is for (6, p). */
void fit_linearise(const Work *w, i64 i, double *by, double *weighted, double *room);

/* Normal matrix (9, 9) and gradient of one window, with the prior, from what fit_linearise gave. */
void fit_normal_equations(const Work *w, const Rules *u, i64 i, const double *by, const double *weighted);

/* What spot j's parameters do to spot i's equations: a block (9, SHAPE) of a tangle's system of m columns. */
void fit_couple(const Work *w, i64 i, i64 j, const double *weighted, double *room, i64 m, double *block);

/* Spots whose windows meet see each other's light; those nearer than tangled_px get one root in `parent`. `order` is room
 * for n. 0 without memory. */
int fit_find_neighbours(Work *w, const Rules *u, double widest, const double *radius, i64 *parent, i64 *order);

/* List tangles and their members; decide how each is solved, the cheapest first, within the work of a round. Returns how
 * many there are. `order` is room for n. */
i64 fit_find_tangles(const Work *w, const Rules *u, const i64 *parent, i64 *order, i64 *member, Tangle *tangle);

#endif
