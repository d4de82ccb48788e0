/* Which spots see each other's light, which are so near that they are solved together, and how much work that is. */
#include "_fit.h"

/* How far apart two spots are along the axis on which they are further. */
static double distance(const Work *w, i64 i, i64 j) {
    return fmax(fabs((double)(w->centre[2 * i] - w->centre[2 * j])), fabs((double)(row_of(w, i) - row_of(w, j))));
}

static int ascending_whole(const void *a, const void *b) {
    i64 x = *(const i64 *)a, y = *(const i64 *)b;
    return (x > y) - (x < y);
}

int fit_find_neighbours(Work *w, const Rules *u, double widest, const double *radius, i64 *parent, i64 *order) {
    for (i64 i = 0; i < w->n; i++) parent[i] = i, order[i] = row_of(w, i) * w->n + i;
    qsort(order, (size_t)w->n, sizeof *order, ascending_whole);
    memset(w->neighbours, 0, (size_t)(w->n + 2) * sizeof *w->neighbours);
    for (int fill = 0; fill < 2; fill++) {      /* counted from the second place on, then listed from the first */
        i64 *next = w->neighbours + (fill ? 1 : 2);
        for (i64 a = 0; a < w->n; a++)
            for (i64 i = order[a] % w->n, b = a + 1; b < w->n; b++) {
                i64 j = order[b] % w->n;
                if ((double)(row_of(w, j) - row_of(w, i)) > 2 * widest) break;
                double far = distance(w, i, j);
                if (far > radius[i] + radius[j]) continue;
                if (fill) w->neighbour[next[i]++] = j, w->neighbour[next[j]++] = i;
                else next[i]++, next[j]++;
                if (fill && far <= u->tangled_px) join(parent, i, j);
            }
        if (fill) break;
        for (i64 i = 0; i < w->n; i++) w->neighbours[i + 2] += w->neighbours[i + 1];
        w->neighbour = malloc((size_t)(w->neighbours[w->n + 1] + 1) * sizeof *w->neighbour);
        if (!w->neighbour) return 0;
    }
    for (i64 i = 0; i < w->n; i++) parent[i] = root(parent, i);
    return 1;
}

static int by_work(const void *a, const void *b) {
    double x = ((const Tangle *)a)->work, y = ((const Tangle *)b)->work;
    return (x > y) - (x < y);
}

/* Work of the m spots of a tangle in a round: theirs, and that of their common system. */
static void estimate_work(const Work *w, const i64 *parent, const i64 *member, Tangle *t) {
    double columns = (double)(t->size * PARAMETERS);
    t->work = t->size > 1 ? columns * columns * columns / 20 : 0, t->work_apart = 0;
    for (i64 a = 0; a < t->size; a++) {
        i64 i = member[t->begin + a], from = w->neighbours[i], to = w->neighbours[i + 1];
        t->work_apart += (double)(w->count[i] * (2 + to - from));
        for (i64 m = from; m < to; m++)
            if (parent[w->neighbour[m]] == parent[i]) t->work += (double)(w->count[i] * SHAPE);
    }
    t->work += t->work_apart;
}

i64 fit_find_tangles(const Work *w, const Rules *u, const i64 *parent, i64 *order, i64 *member, Tangle *tangle) {
    i64 count = 0, n = 0;
    double left = u->most_work;
    for (i64 i = 0; i < w->n; i++)
        if (parent[i] == i) order[i] = count, tangle[count++] = (Tangle){.size = 0};
    for (i64 i = 0; i < w->n; i++) tangle[order[parent[i]]].size++;
    for (i64 k = 0; k < count; k++) tangle[k].begin = n, n += tangle[k].size, tangle[k].size = 0;
    for (i64 i = 0; i < w->n; i++) {
        Tangle *t = tangle + order[parent[i]];
        member[t->begin + t->size++] = i;
    }
    for (i64 k = 0; k < count; k++) estimate_work(w, parent, member, tangle + k);
    qsort(tangle, (size_t)count, sizeof *tangle, by_work);
    for (i64 k = 0; k < count; k++) {
        Tangle *t = tangle + k;
        t->how = t->work <= left ? TOGETHER : t->work_apart <= left ? APART : LEFT;
        left -= t->how == TOGETHER ? t->work : t->how == APART ? t->work_apart : 0;
    }
    return count;
}
