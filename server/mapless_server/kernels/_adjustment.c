/* Normal equations of a bundle adjustment, with the points eliminated, and points adjusted alone; see adjustment.py.
 *
 * Arrays are of doubles, contiguous, in the shapes that adjustment.py gives; observations are sorted by view. A point is
 * in few views, so the product of the rows of its observations is added block by block: the matrix of all views by all
 * points is never stored.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum { POSE = 6, MOST_INTRINSICS = 10, MOST_ROWS = POSE + MOST_INTRINSICS, LANES = 8, MOST_LANES = 2 * LANES };

/* The damping, and its factors after a step that is accepted and after one that is not: as in optimize.minimize_each. */
#define FIRST_DAMPING 1e-3
#define LOWERED 0.1
#define RAISED 10.0
#define SINGULAR 1e-14 /* least determinant, as a share of the cube of the largest element */

/* Compiled for wider vectors too, of which the dynamic linker takes the widest of the processor. Nothing is contracted or
 * reordered, so the bits are the same. */
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && defined(__GLIBC__)
#define WIDE __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define WIDE
#endif

typedef Py_ssize_t Index;

/* Eight doubles, by whatever vectors the processor has. */
typedef double Eight __attribute__((vector_size(LANES * sizeof(double))));
#define ALWAYS static inline __attribute__((always_inline))


ALWAYS void load(Eight *to, const double *from) { memcpy(to, from, sizeof(*to)); }

/* Observations by view, and the same grouped by point: those of point p are order[start[p]] to order[start[p + 1]]. */
typedef struct {
    const Index *end, *point, *view; /* end (V): where the observations of each view end */
    Index views, observations, points, intrinsics;
    Index *start, *order;
} Seen;

/* 0 without memory, or where an index is out of range. */
static int group_by_point(Seen *seen) {
    const Index count = seen->points, observations = seen->observations;
    Index begin = 0;
    for (Index v = 0; v < seen->views; begin = seen->end[v++])
        if (seen->end[v] < begin || seen->end[v] > observations) return 0;
    if (begin != observations) return 0;
    for (Index v = 0, o = 0; v < seen->views; v++)
        for (; o < seen->end[v]; o++)
            if (seen->view[o] != v || seen->point[o] < 0 || seen->point[o] >= count) return 0;
    seen->start = calloc((size_t)(count + 2 + observations), sizeof(Index));
    if (seen->start == NULL) return 0;
    seen->order = seen->start + count + 2;
    for (Index o = 0; o < observations; o++) seen->start[seen->point[o] + 2]++;
    for (Index p = 0; p < count; p++) seen->start[p + 2] += seen->start[p + 1];
    for (Index o = 0; o < observations; o++) seen->order[seen->start[seen->point[o] + 1]++] = o;
    return 1;
}

static inline Index lanes_of(const Seen *seen, Index view) {
    return view == seen->views - 1 && seen->intrinsics ? MOST_LANES : LANES;
}

static inline int rows_of(const Seen *seen, Index view) {
    return POSE + (view == seen->views - 1 ? (int)seen->intrinsics : 0);
}

static Index first_of_query(const Seen *seen) { return seen->views > 1 ? seen->end[seen->views - 2] : 0; }

/* Residuals (2, O) and their derivatives by the point (2, 3, O) and by the pose (2, 6, O); NaN behind the camera. */
WIDE static void project(const Seen *seen, const double *rotation, const double *translation, const double *x_in_world,
                    const double *focal, const double *offset, double *residual, double *by_point, double *by_pose) {
    const Index n = seen->observations;
    for (Index v = 0, o = 0; v < seen->views; v++) {
        const double *r = rotation + 9 * v, *t = translation + 3 * v;
        for (; o < seen->end[v]; o++) {
            const double *p = x_in_world + 3 * seen->point[o];
            const double x = r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + t[0];
            const double y = r[3] * p[0] + r[4] * p[1] + r[5] * p[2] + t[1];
            const double z = r[6] * p[0] + r[7] * p[1] + r[8] * p[2] + t[2];
            const double inverse = z > 0 ? 1 / z : NAN, u = x * inverse, w = y * inverse;
            const double fx = focal[o], fy = focal[n + o], sx = fx * inverse, sy = fy * inverse;
            residual[o] = u * fx + offset[o], residual[n + o] = w * fy + offset[n + o];
            for (int k = 0; k < 3; k++) {
                by_point[k * n + o] = sx * (r[k] - u * r[6 + k]);
                by_point[(3 + k) * n + o] = sy * (r[3 + k] - w * r[6 + k]);
            }
            const double of_x[POSE] = {sx, 0, -sx * u, -fx * u * w, fx * (1 + u * u), -fx * w};
            const double of_y[POSE] = {0, sy, -sy * w, -fy * (1 + w * w), fy * u * w, fy * u};
            for (int k = 0; k < POSE; k++) by_pose[k * n + o] = of_x[k], by_pose[(POSE + k) * n + o] = of_y[k];
        }
    }
}

typedef struct {
    double *cross, *cross_of_intrinsics; /* (O, 3, 6) and (O_q, 3, I) */
    double *pose_block, *pose_gradient, *point_block, *point_gradient;
} Equations;

/* Sums of one view: rows of its block of the matrix, and its gradient. */
typedef struct {
    Eight block[MOST_ROWS][2], gradient[2];
} ViewSums;

/* Adds an observation: residual, weight, derivatives a by the point, j (2, 16) by the unknowns of its view, of which
 * `rows` are used, in `parts` of eight. */
ALWAYS void add_observation(const double residual[2], double w, double least_curvature, double a[2][3],
                            double j[2][MOST_LANES], int rows, int parts, ViewSums *sums, double cross[3][MOST_LANES]) {
    double r0 = residual[0], r1 = residual[1];
    Eight x[2], y[2], wx[2], wy[2];
    for (int p = 0; p < parts; p++) load(&x[p], j[0] + p * LANES), load(&y[p], j[1] + p * LANES);
    if (least_curvature < 1) {
        const double squared = r0 * r0 + r1 * r1, shrink = sqrt(1 - 4 * (1 - least_curvature) * w * (1 - w));
        const double share = (1 - shrink) / (squared > 1e-12 ? squared : 1e-12), s0 = share * r0, s1 = share * r1;
        for (int k = 0; k < 3; k++) {
            const double along = s0 * a[0][k] + s1 * a[1][k];
            a[0][k] -= r0 * along, a[1][k] -= r1 * along;
        }
        for (int p = 0; p < parts; p++) {
            const Eight along = s0 * x[p] + s1 * y[p];
            x[p] -= r0 * along, y[p] -= r1 * along;
        }
        r0 /= shrink, r1 /= shrink;
    }
    double weighted[2][MOST_LANES];
    for (int p = 0; p < parts; p++) {
        wx[p] = w * x[p], wy[p] = w * y[p];
        sums->gradient[p] += wx[p] * r0 + wy[p] * r1;
        for (int m = 0; m < 3; m++) {
            const Eight its = wx[p] * a[0][m] + wy[p] * a[1][m];
            memcpy(cross[m] + p * LANES, &its, sizeof(its));
        }
        memcpy(weighted[0] + p * LANES, &wx[p], sizeof(wx[p])), memcpy(weighted[1] + p * LANES, &wy[p], sizeof(wy[p]));
    }
    for (int k = 0; k < rows; k++)
        for (int p = 0; p < parts; p++) sums->block[k][p] += weighted[0][k] * x[p] + weighted[1][k] * y[p];
}

/* Adds C and h of an observation to those of its point; see add_observation. */
ALWAYS void add_to_point(double *c, double *h, Index count, const double a[2][3], const double residual[2], double w,
                         double shrink) {
    const double r0 = residual[0] / shrink, r1 = residual[1] / shrink;
    static const int first[6] = {0, 1, 2, 0, 0, 1}, second[6] = {0, 1, 2, 1, 2, 2};
    for (int k = 0; k < 6; k++)
        c[k * count] += w * (a[0][first[k]] * a[0][second[k]] + a[1][first[k]] * a[1][second[k]]);
    for (int k = 0; k < 3; k++) h[k * count] += w * (a[0][k] * r0 + a[1][k] * r1);
}

/* Adds the equations of all observations, for the loss's weights (O,); see ViewColumns.equations. */
WIDE static void add_equations(const Seen *seen, const double *residuals, const double *by_point, const double *by_pose,
                               const double *by_intrinsics, const double *weights, double least_curvature,
                               const Equations *to) {
    const Index n = seen->observations, first = first_of_query(seen), of_query = n - first, count = seen->points;
    const Index width = POSE * seen->views + seen->intrinsics, intrinsics = seen->intrinsics;
    for (Index v = 0, o = 0; v < seen->views; v++) {
        const int rows = rows_of(seen, v);
        ViewSums sums = {0};
        for (; o < seen->end[v]; o++) {
            double a[2][3], j[2][MOST_LANES] = {{0}}, cross[3][MOST_LANES];
            const double residual[2] = {residuals[o], residuals[n + o]}, w = weights[o];
            for (int i = 0; i < 2; i++) {
                for (int k = 0; k < 3; k++) a[i][k] = by_point[(3 * i + k) * n + o];
                for (int k = 0; k < POSE; k++) j[i][k] = by_pose[(POSE * i + k) * n + o];
            }
            if (rows == POSE) {
                add_observation(residual, w, least_curvature, a, j, POSE, 1, &sums, cross);
            } else {
                for (int i = 0; i < 2; i++)
                    for (Index k = 0; k < intrinsics; k++)
                        j[i][POSE + k] = by_intrinsics[(intrinsics * i + k) * of_query + o - first];
                add_observation(residual, w, least_curvature, a, j, rows, 2, &sums, cross);
            }
            const double shrink = least_curvature < 1 ? sqrt(1 - 4 * (1 - least_curvature) * w * (1 - w)) : 1;
            add_to_point(to->point_block + seen->point[o], to->point_gradient + seen->point[o], count, a, residual, w,
                         shrink);
            for (int m = 0; m < 3; m++) {
                memcpy(to->cross + (o * 3 + m) * POSE, cross[m], POSE * sizeof(double));
                if (rows > POSE)
                    memcpy(to->cross_of_intrinsics + ((o - first) * 3 + m) * intrinsics, cross[m] + POSE,
                           (size_t)intrinsics * sizeof(double));
            }
        }
        memcpy(to->pose_gradient + POSE * v, sums.gradient, (size_t)rows * sizeof(double));
        for (int k = 0; k < rows; k++)
            memcpy(to->pose_block + (POSE * v + k) * width + POSE * v, sums.block[k], (size_t)rows * sizeof(double));
    }
}

/* Cholesky's factor of a matrix in the order of optimize.SYMMETRIC; NaN where it is singular. */
static inline void cholesky(const double c[6], double l[6]) {
    const double largest = fmax(fmax(c[0], c[1]), c[2]), first = sqrt(c[0]);
    l[3] = c[3] / first, l[4] = c[4] / first;
    const double second = c[1] - l[3] * l[3];
    l[5] = (c[5] - l[4] * l[3]) / sqrt(second);
    const double third = c[2] - l[4] * l[4] - l[5] * l[5];
    const int is_solvable = c[0] * second * third > SINGULAR * largest * largest * largest;
    l[0] = is_solvable ? first : NAN, l[1] = is_solvable ? sqrt(second) : NAN, l[2] = is_solvable ? sqrt(third) : NAN;
}

/* Solves L y = b for columns b of three rows of a length; `inverse` are those of the diagonal. */
static inline void forward(const double l[6], const double inverse[3], Index length, double *restrict x,
                           double *restrict y, double *restrict z) {
    for (Index i = 0; i < length; i++) {
        x[i] *= inverse[0];
        y[i] = (y[i] - l[3] * x[i]) * inverse[1];
        z[i] = (z[i] - l[4] * x[i] - l[5] * y[i]) * inverse[2];
    }
}

/* Blocks of a symmetric matrix above its diagonal, padded: view v begins at row and column 8 v, the query has 16. */
static Index padded_width(const Seen *seen) { return LANES * (seen->views + 1); }

/* Adds a padded matrix and vector to a matrix (U, U), both halves of it, and a vector (U,). */
static void add_padded(const Seen *seen, const double *padded, const double *padded_vector, double *matrix,
                       double *vector) {
    const Index wide = padded_width(seen), width = POSE * seen->views + seen->intrinsics;
    for (Index v = 0; v < seen->views; v++)
        for (int i = 0; i < rows_of(seen, v); i++) {
            const Index row = POSE * v + i;
            vector[row] += padded_vector[LANES * v + i];
            for (Index w = v; w < seen->views; w++)
                for (int k = 0; k < rows_of(seen, w); k++) {
                    const Index column = POSE * w + k;
                    if (column < row) continue;
                    matrix[row * width + column] += padded[(LANES * v + i) * wide + LANES * w + k];
                    if (column > row) matrix[column * width + row] = matrix[row * width + column];
                }
        }
}

/* The rows of the observations of a point, in three columns, padded by zeros: block b begins at begin[b], of a view. */
typedef struct {
    double *column[3], *lost[2];
    Index *begin, *view, blocks;
} PointRows;

static inline void gather(const Seen *seen, Index p, const double *cross, const double *cross_of_intrinsics,
                          PointRows *to) {
    const Index first = first_of_query(seen), intrinsics = seen->intrinsics;
    Index row = 0;
    to->blocks = 0;
    for (Index i = seen->start[p]; i < seen->start[p + 1]; i++) {
        const Index o = seen->order[i], v = seen->view[o], lanes = lanes_of(seen, v);
        to->view[to->blocks] = v;
        to->begin[to->blocks++] = row;
        for (int m = 0; m < 3; m++) {
            double *its = to->column[m] + row;
            memcpy(its, cross + (o * 3 + m) * POSE, POSE * sizeof(double));
            its[POSE] = its[POSE + 1] = 0;
            if (lanes == LANES) continue;
            memset(its + LANES, 0, LANES * sizeof(double));
            memcpy(its + POSE, cross_of_intrinsics + ((o - first) * 3 + m) * intrinsics,
                   (size_t)intrinsics * sizeof(double));
        }
        row += lanes;
    }
    to->begin[to->blocks] = row;
}

/* Room for the rows of any point, and for `padded` matrices and vectors of zeros, so that no 8 doubles of a row cross a
 * line of the cache; NULL without memory. `room` is to be freed. */
static double *make_room(const Seen *seen, Index padded, PointRows *rows, void **room) {
    Index most = 1;
    for (Index p = 0; p < seen->points; p++) {
        const Index its = seen->start[p + 1] - seen->start[p];
        most = its > most ? its : most;
    }
    const Index height = most * MOST_LANES, wide = padded_width(seen), sums = padded * wide * (wide + 1);
    *room = calloc((size_t)(sums + 5 * height + 2 * most + 1 + LANES), sizeof(double));
    if (*room == NULL) return NULL;
    const size_t line = LANES * sizeof(double);
    double *memory = (double *)(((uintptr_t)*room + line - 1) / line * line);
    for (int m = 0; m < 3; m++) rows->column[m] = memory + sums + m * height;
    for (int m = 0; m < 2; m++) rows->lost[m] = memory + sums + (3 + m) * height;
    rows->begin = (Index *)(memory + sums + 5 * height), rows->view = rows->begin + most + 1;
    return memory;
}

/* Writes rows of a point to where they were gathered from. */
static inline void scatter(const Seen *seen, Index p, const PointRows *from, double *cross,
                           double *cross_of_intrinsics) {
    const Index first = first_of_query(seen), intrinsics = seen->intrinsics;
    for (Index b = 0; b < from->blocks; b++) {
        const Index o = seen->order[seen->start[p] + b];
        for (int m = 0; m < 3; m++) {
            const double *its = from->column[m] + from->begin[b];
            memcpy(cross + (o * 3 + m) * POSE, its, POSE * sizeof(double));
            if (from->view[b] == seen->views - 1 && intrinsics)
                memcpy(cross_of_intrinsics + ((o - first) * 3 + m) * intrinsics, its + POSE,
                       (size_t)intrinsics * sizeof(double));
        }
    }
}

/* Subtracts from 8 columns of so many rows, at least 6, the products of columns a with rows b of 8. */
ALWAYS void subtract(double *to, Index wide, Index rows, const double *const a[3], Index i, const double *const b[3],
                     Index k, int depth) {
    Eight its[3], sums;
    for (int d = 0; d < depth; d++) load(&its[d], b[d] + k);
    for (Index r = 0; r < rows; r++, to += wide) {
        load(&sums, to);
        for (int d = 0; d < depth; d++) sums -= a[d][i + r] * its[d];
        memcpy(to, &sums, sizeof(sums));
    }
}

/* The same where most blocks have the rows of a pose. */
ALWAYS void subtract_block(double *to, Index wide, Index rows, const double *const a[3], Index i, Index k, int depth) {
    if (rows == POSE) subtract(to, wide, POSE, a, i, a, k, depth);
    else subtract(to, wide, rows, a, i, a, k, depth);
}

/* Subtracts from a padded matrix, and the vector after it, E C^-1 E^T and E C^-1 h; writes E L^-T. */
WIDE static void eliminate(const Seen *seen, double damping, const double *point_block, const double *point_gradient,
                           const double *cross, const double *cross_of_intrinsics, double *factor, double *gradient,
                           double *left, double *left_of_intrinsics, PointRows *rows, double *padded) {
    const Index count = seen->points, wide = padded_width(seen);
    double *vector = padded + wide * wide;
    for (Index p = 0; p < count; p++) {
        double c[6], l[6], h[3], inverse[3];
        for (int k = 0; k < 6; k++) c[k] = point_block[k * count + p] * (k < 3 ? 1 + damping : 1);
        for (int k = 0; k < 3; k++) h[k] = point_gradient[k * count + p];
        cholesky(c, l);
        for (int k = 0; k < 3; k++) inverse[k] = 1 / l[k];
        forward(l, inverse, 1, h, h + 1, h + 2);
        for (int k = 0; k < 6; k++) factor[k * count + p] = l[k];
        for (int k = 0; k < 3; k++) gradient[k * count + p] = h[k];
        gather(seen, p, cross, cross_of_intrinsics, rows);
        forward(l, inverse, rows->begin[rows->blocks], rows->column[0], rows->column[1], rows->column[2]);
        scatter(seen, p, rows, left, left_of_intrinsics);
        const double *fx = rows->column[0], *fy = rows->column[1], *fz = rows->column[2];
        const double *const its_columns[3] = {fx, fy, fz};
        for (Index b = 0; b < rows->blocks; b++) {
            const Index i = rows->begin[b], v = rows->view[b], its = rows_of(seen, v);
            double *row = padded + LANES * v * wide;
            for (Index k = 0; k < its; k++) vector[LANES * v + k] -= fx[i + k] * h[0] + fy[i + k] * h[1] + fz[i + k] * h[2];
            for (Index d = b; d < rows->blocks; d++)
                for (Index k = rows->begin[d], c = LANES * rows->view[d]; k < rows->begin[d + 1]; k += LANES, c += LANES)
                    subtract_block(row + c, wide, its, its_columns, i, k, 3);
        }
    }
}

/* Steps (P, 3) of the points for a motion (U,) of the cameras. */
WIDE static void step_points(const Seen *seen, const double *factor, const double *gradient, const double *cross,
                             const double *cross_of_intrinsics, const double *motion, double *steps) {
    const Index count = seen->points, n = seen->observations, first = first_of_query(seen);
    for (Index p = 0; p < count; p++)
        for (int k = 0; k < 3; k++) steps[3 * p + k] = gradient[k * count + p];
    for (Index o = 0; o < n; o++) {
        double *s = steps + 3 * seen->point[o];
        const double *of_view = motion + POSE * seen->view[o];
        for (int m = 0; m < 3; m++) {
            const double *e = cross + (o * 3 + m) * POSE;
            s[m] += ((e[0] * of_view[0] + e[1] * of_view[1]) + (e[2] * of_view[2] + e[3] * of_view[3])) +
                    (e[4] * of_view[4] + e[5] * of_view[5]);
            if (o < first) continue;
            const double *i = cross_of_intrinsics + ((o - first) * 3 + m) * seen->intrinsics;
            for (Index k = 0; k < seen->intrinsics; k++) s[m] += i[k] * of_view[POSE + k];
        }
    }
    for (Index p = 0; p < count; p++) {
        double l[6], *s = steps + 3 * p;
        for (int k = 0; k < 6; k++) l[k] = factor[k * count + p];
        s[2] = -s[2] / l[2];
        s[1] = (-s[1] - l[5] * s[2]) / l[1];
        s[0] = (-s[0] - l[3] * s[1] - l[4] * s[2]) / l[0];
    }
}

/* Subtracts from matrices (V, U, U), gradients (V, U) the part of each reference's observations; see dispersion.py.
 *
 * The first of each are of all observations, and stay; gain is (3, 2, O), misfit (2, O).
 */
WIDE static void leave_each_out(const Seen *seen, const double *gain, const double *misfit, const double *cross,
                           const double *cross_of_intrinsics, PointRows *rows, double *padded, double *matrices,
                           double *gradients) {
    const Index n = seen->observations, wide = padded_width(seen), width = POSE * seen->views + seen->intrinsics;
    for (Index p = 0; p < seen->points; p++) {
        gather(seen, p, cross, cross_of_intrinsics, rows);
        const Index height = rows->begin[rows->blocks];
        double *lx = rows->lost[0], *ly = rows->lost[1];
        const double *const its_columns[3] = {lx, ly, NULL};
        for (Index i = seen->start[p]; i < seen->start[p + 1]; i++) {
            const Index o = seen->order[i], v = seen->view[o];
            if (v == seen->views - 1) continue;
            double *matrix = padded + v * wide * (wide + 1), *gradient = matrix + wide * wide;
            for (int a = 0; a < 2; a++) {
                const double x = gain[a * n + o], y = gain[(2 + a) * n + o], z = gain[(4 + a) * n + o];
                double *restrict its = a ? ly : lx;
                for (Index k = 0; k < height; k++)
                    its[k] = rows->column[0][k] * x + rows->column[1][k] * y + rows->column[2][k] * z;
            }
            for (Index b = 0; b < rows->blocks; b++) {
                const Index k = rows->begin[b], w = rows->view[b], its = rows_of(seen, w);
                double *row = matrix + LANES * w * wide;
                for (Index r = 0; r < its; r++) gradient[LANES * w + r] += lx[k + r] * misfit[o] + ly[k + r] * misfit[n + o];
                for (Index d = b; d < rows->blocks; d++)
                    for (Index m = rows->begin[d], c = LANES * rows->view[d]; m < rows->begin[d + 1]; m += LANES, c += LANES)
                        subtract_block(row + c, wide, its, its_columns, k, m, 2);
            }
        }
    }
    for (Index v = 0; v + 1 < seen->views; v++) {
        double *matrix = matrices + (v + 1) * width * width;
        const double *its_sums = padded + v * wide * (wide + 1);
        add_padded(seen, its_sums, its_sums + wide * wide, matrix, gradients + (v + 1) * width);
        for (int k = 0; k < POSE; k++) {
            const Index its = POSE * v + k; /* only the prior is left of its own pose */
            gradients[(v + 1) * width + its] = 0;
            for (Index i = 0; i < width; i++) matrix[its * width + i] = matrix[i * width + its] = 0;
        }
    }
}

/* Observations by point: those of point p are start[p] to start[p + 1]; the arrays as in observations.py. */
typedef struct {
    const Index *start;
    const double *rotation, *translation, *focal, *offset;
    Index count;
} ByPoint;

/* The cost of a point; with a hessian (order of SYMMETRIC) and gradient of half of it, if these are not NULL. */
static inline double cost_of_point(const ByPoint *seen, Index p, const double x[3], double scale, double *hessian,
                            double *gradient) {
    const Index n = seen->count;
    const double *r = seen->rotation, *t = seen->translation;
    double cost = 0;
    for (Index o = seen->start[p]; o < seen->start[p + 1]; o++) {
        double c[3], residual[2];
        for (int i = 0; i < 3; i++)
            c[i] = r[3 * i * n + o] * x[0] + r[(3 * i + 1) * n + o] * x[1] + r[(3 * i + 2) * n + o] * x[2] + t[i * n + o];
        const double inverse = c[2] > 0 ? 1 / c[2] : NAN;
        for (int i = 0; i < 2; i++) residual[i] = c[i] * inverse * seen->focal[i * n + o] + seen->offset[i * n + o];
        const double squared = residual[0] * residual[0] + residual[1] * residual[1];
        const double root = sqrt(1 + squared / (scale * scale));
        cost += 2 * scale * scale * (root - 1);
        if (hessian == NULL) continue;
        for (int i = 0; i < 2; i++) {
            const double slope = seen->focal[i * n + o] * inverse, ideal = c[i] * inverse;
            double a[3];
            for (int k = 0; k < 3; k++) a[k] = slope * (r[(3 * i + k) * n + o] - ideal * r[(6 + k) * n + o]);
            for (int k = 0; k < 3; k++) hessian[k] += a[k] * a[k] / root, gradient[k] += a[k] * residual[i] / root;
            hessian[3] += a[0] * a[1] / root, hessian[4] += a[0] * a[2] / root, hessian[5] += a[1] * a[2] / root;
        }
    }
    return cost;
}

/* By the adjugate; NaN where it is singular. */
static inline void solve(const double h[6], const double b[3], double x[3]) {
    const double xx = h[1] * h[2] - h[5] * h[5], xy = h[4] * h[5] - h[3] * h[2], xz = h[3] * h[5] - h[4] * h[1];
    const double yy = h[0] * h[2] - h[4] * h[4], yz = h[3] * h[4] - h[0] * h[5], zz = h[0] * h[1] - h[3] * h[3];
    const double determinant = h[0] * xx + h[3] * xy + h[4] * xz;
    double largest = 0;
    for (int k = 0; k < 6; k++) largest = fabs(h[k]) > largest ? fabs(h[k]) : largest;
    const double by = fabs(determinant) > SINGULAR * largest * largest * largest ? determinant : NAN;
    x[0] = (xx * b[0] + xy * b[1] + xz * b[2]) / by;
    x[1] = (xy * b[0] + yy * b[1] + yz * b[2]) / by;
    x[2] = (xz * b[0] + yz * b[1] + zz * b[2]) / by;
}

/* Moves each point (P, 3) to the least cost near it, by a number of Levenberg-Marquardt steps. */
WIDE static void adjust_each(const ByPoint *seen, Index points, double scale, Index iterations, double *x_in_world) {
    for (Index p = 0; p < points; p++) {
        double *x = x_in_world + 3 * p, damping = FIRST_DAMPING, least = cost_of_point(seen, p, x, scale, NULL, NULL);
        for (Index i = 0; i < iterations; i++) {
            double hessian[6] = {0}, gradient[3] = {0}, step[3];
            cost_of_point(seen, p, x, scale, hessian, gradient);
            for (int k = 0; k < 3; k++) hessian[k] *= 1 + damping;
            solve(hessian, gradient, step);
            const double moved[3] = {x[0] - step[0], x[1] - step[1], x[2] - step[2]};
            const double cost = cost_of_point(seen, p, moved, scale, NULL, NULL);
            if (cost <= least) { /* false for NaN */
                memcpy(x, moved, sizeof(moved));
                least = cost, damping *= LOWERED;
            } else {
                damping *= RAISED;
            }
        }
    }
}

enum { MOST_ARRAYS = 16 };

/* The arrays that follow `first` numbers in the arguments of a call. */
typedef struct {
    Py_buffer buffers[MOST_ARRAYS];
    int count;
} Arrays;

static void release(Arrays *arrays) {
    while (arrays->count) PyBuffer_Release(&arrays->buffers[--arrays->count]);
}

/* Those from `written` on are written to; 0 with an exception. */
static int acquire(PyObject *arguments, int first, int count, int written, Arrays *arrays) {
    arrays->count = 0;
    if (PyTuple_Size(arguments) != first + count) {
        PyErr_SetString(PyExc_TypeError, "the number of arguments is wrong");
        return 0;
    }
    for (; arrays->count < count; arrays->count++) {
        PyObject *array = PyTuple_GetItem(arguments, first + arrays->count);
        const int flags = PyBUF_C_CONTIGUOUS | (arrays->count < written ? 0 : PyBUF_WRITABLE);
        if (PyObject_GetBuffer(array, &arrays->buffers[arrays->count], flags)) {
            release(arrays);
            return 0;
        }
    }
    return 1;
}

static Index length_of(const Arrays *arrays, int which) { return arrays->buffers[which].len / 8; }

static double *doubles(const Arrays *arrays, int which) { return arrays->buffers[which].buf; }

/* Whether the arrays from `first` on have these numbers of elements. */
static int have_lengths(const Arrays *arrays, int first, const Index *lengths) {
    for (int i = first; i < arrays->count; i++)
        if (arrays->buffers[i].len != lengths[i - first] * 8) return 0;
    return 1;
}

static PyObject *sizes_do_not_fit(Arrays *arrays) {
    release(arrays);
    PyErr_SetString(PyExc_ValueError, "the sizes of the arrays, or indices in them, do not fit");
    return NULL;
}

/* From the arrays end (V), point (O), view (O). */
static Seen seen_of(const Arrays *arrays, Index points, Index intrinsics) {
    const Seen seen = {arrays->buffers[0].buf, arrays->buffers[1].buf, arrays->buffers[2].buf, length_of(arrays, 0),
                       length_of(arrays, 1),   points, intrinsics, NULL, NULL};
    return seen;
}

/* Reads points, intrinsics and a number, then the arrays; checks sizes that depend on the observations. */
static int begin(PyObject *arguments, int numbers, int count, int written, Arrays *arrays, Seen *seen) {
    const Index points = PyLong_AsSsize_t(PyTuple_GetItem(arguments, 0));
    const Index intrinsics = PyLong_AsSsize_t(PyTuple_GetItem(arguments, 1));
    if (PyErr_Occurred() || !acquire(arguments, numbers, count, written, arrays)) return 0;
    *seen = seen_of(arrays, points, intrinsics);
    if (seen->views < 1 || points < 0 || intrinsics < 0 || intrinsics > MOST_INTRINSICS ||
        arrays->buffers[2].len != arrays->buffers[1].len || !group_by_point(seen)) {
        free(seen->start);
        sizes_do_not_fit(arrays);
        return 0;
    }
    return 1;
}

static PyObject *project_call(PyObject *Py_UNUSED(module), PyObject *arguments) {
    Arrays a;
    Seen seen;
    if (!begin(arguments, 2, 11, 8, &a, &seen)) return NULL;
    const Index n = seen.observations;
    const Index lengths[] = {9 * seen.views, 3 * seen.views, 3 * seen.points, 2 * n, 2 * n, 2 * n, 6 * n, 12 * n};
    const int fits = have_lengths(&a, 3, lengths);
    if (fits) {
        Py_BEGIN_ALLOW_THREADS
        project(&seen, doubles(&a, 3), doubles(&a, 4), doubles(&a, 5), doubles(&a, 6), doubles(&a, 7), doubles(&a, 8),
                doubles(&a, 9), doubles(&a, 10));
        Py_END_ALLOW_THREADS
    }
    free(seen.start);
    if (!fits) return sizes_do_not_fit(&a);
    release(&a);
    Py_RETURN_NONE;
}

static PyObject *equations_call(PyObject *Py_UNUSED(module), PyObject *arguments) {
    Arrays a;
    Seen seen;
    const double least_curvature = PyFloat_AsDouble(PyTuple_GetItem(arguments, 2));
    if (PyErr_Occurred() || !begin(arguments, 3, 14, 8, &a, &seen)) return NULL;
    const Index n = seen.observations, of_query = n - first_of_query(&seen), i = seen.intrinsics;
    const Index u = POSE * seen.views + i, p = seen.points;
    const Index lengths[] = {2 * n, 6 * n, 12 * n, 2 * i * of_query, n, 18 * n, 3 * i * of_query, u * u, u, 6 * p, 3 * p};
    const int fits = have_lengths(&a, 3, lengths);
    if (fits) {
        const Equations to = {doubles(&a, 8),  doubles(&a, 9),  doubles(&a, 10),
                              doubles(&a, 11), doubles(&a, 12), doubles(&a, 13)};
        Py_BEGIN_ALLOW_THREADS
        add_equations(&seen, doubles(&a, 3), doubles(&a, 4), doubles(&a, 5), doubles(&a, 6), doubles(&a, 7),
                      least_curvature, &to);
        Py_END_ALLOW_THREADS
    }
    free(seen.start);
    if (!fits) return sizes_do_not_fit(&a);
    release(&a);
    Py_RETURN_NONE;
}

static PyObject *eliminate_call(PyObject *Py_UNUSED(module), PyObject *arguments) {
    Arrays a;
    Seen seen;
    PointRows rows;
    const double damping = PyFloat_AsDouble(PyTuple_GetItem(arguments, 2));
    if (PyErr_Occurred() || !begin(arguments, 3, 13, 7, &a, &seen)) return NULL;
    const Index n = seen.observations, of_query = n - first_of_query(&seen), i = seen.intrinsics;
    const Index u = POSE * seen.views + i, p = seen.points;
    const Index rows_length = 18 * n, its_length = 3 * i * of_query;
    const Index lengths[] = {6 * p, 3 * p, rows_length, its_length, 6 * p, 3 * p, rows_length, its_length, u * u, u};
    const int fits = have_lengths(&a, 3, lengths);
    void *room = NULL;
    double *padded = fits ? make_room(&seen, 1, &rows, &room) : NULL;
    if (padded) {
        Py_BEGIN_ALLOW_THREADS
        eliminate(&seen, damping, doubles(&a, 3), doubles(&a, 4), doubles(&a, 5), doubles(&a, 6), doubles(&a, 7),
                  doubles(&a, 8), doubles(&a, 9), doubles(&a, 10), &rows, padded);
        add_padded(&seen, padded, padded + padded_width(&seen) * padded_width(&seen), doubles(&a, 11), doubles(&a, 12));
        Py_END_ALLOW_THREADS
    }
    free(seen.start);
    if (!fits) return sizes_do_not_fit(&a);
    release(&a);
    free(room);
    return room ? Py_NewRef(Py_None) : PyErr_NoMemory();
}

static PyObject *step_call(PyObject *Py_UNUSED(module), PyObject *arguments) {
    Arrays a;
    Seen seen;
    if (!begin(arguments, 2, 9, 8, &a, &seen)) return NULL;
    const Index n = seen.observations, of_query = n - first_of_query(&seen), i = seen.intrinsics, p = seen.points;
    const Index lengths[] = {6 * p, 3 * p, 18 * n, 3 * i * of_query, POSE * seen.views + i, 3 * p};
    const int fits = have_lengths(&a, 3, lengths);
    if (fits) {
        Py_BEGIN_ALLOW_THREADS
        step_points(&seen, doubles(&a, 3), doubles(&a, 4), doubles(&a, 5), doubles(&a, 6), doubles(&a, 7),
                    doubles(&a, 8));
        Py_END_ALLOW_THREADS
    }
    free(seen.start);
    if (!fits) return sizes_do_not_fit(&a);
    release(&a);
    Py_RETURN_NONE;
}

static PyObject *leave_out_call(PyObject *Py_UNUSED(module), PyObject *arguments) {
    Arrays a;
    Seen seen;
    PointRows rows;
    if (!begin(arguments, 2, 9, 7, &a, &seen)) return NULL;
    const Index n = seen.observations, of_query = n - first_of_query(&seen), i = seen.intrinsics, v = seen.views;
    const Index u = POSE * v + i, lengths[] = {6 * n, 2 * n, 18 * n, 3 * i * of_query, v * u * u, v * u};
    const int fits = have_lengths(&a, 3, lengths);
    void *room = NULL;
    double *padded = fits ? make_room(&seen, v - 1, &rows, &room) : NULL;
    if (padded) {
        Py_BEGIN_ALLOW_THREADS
        leave_each_out(&seen, doubles(&a, 3), doubles(&a, 4), doubles(&a, 5), doubles(&a, 6), &rows, padded,
                       doubles(&a, 7), doubles(&a, 8));
        Py_END_ALLOW_THREADS
    }
    free(seen.start);
    if (!fits) return sizes_do_not_fit(&a);
    release(&a);
    free(room);
    return room ? Py_NewRef(Py_None) : PyErr_NoMemory();
}

static PyObject *adjust_call(PyObject *Py_UNUSED(module), PyObject *arguments) {
    Arrays a;
    const double scale = PyFloat_AsDouble(PyTuple_GetItem(arguments, 0));
    const Index iterations = PyLong_AsSsize_t(PyTuple_GetItem(arguments, 1));
    if (PyErr_Occurred() || !acquire(arguments, 2, 6, 5, &a)) return NULL;
    const Index points = length_of(&a, 0) - 1, n = length_of(&a, 3) / 2;
    const Index lengths[] = {9 * n, 3 * n, 2 * n, 2 * n, 3 * points};
    const ByPoint seen = {a.buffers[0].buf, doubles(&a, 1), doubles(&a, 2), doubles(&a, 3), doubles(&a, 4), n};
    int fits = points >= 0 && have_lengths(&a, 1, lengths) && seen.start[0] == 0 && seen.start[points] == n;
    for (Index p = 0; fits && p < points; p++) fits = seen.start[p] <= seen.start[p + 1];
    if (!fits) return sizes_do_not_fit(&a);
    Py_BEGIN_ALLOW_THREADS
    adjust_each(&seen, points, scale, iterations, doubles(&a, 5));
    Py_END_ALLOW_THREADS
    release(&a);
    Py_RETURN_NONE;
}

static PyMethodDef methods[] = {
    {"project", project_call, METH_VARARGS, "Writes residuals and their derivatives; see adjustment.py."},
    {"equations", equations_call, METH_VARARGS, "Writes normal equations; see adjustment.py."},
    {"eliminate", eliminate_call, METH_VARARGS, "Eliminates the points; see adjustment.py."},
    {"step", step_call, METH_VARARGS, "Writes steps of the points; see adjustment.py."},
    {"leave_each_out", leave_out_call, METH_VARARGS, "Subtracts each reference's part; see adjustment.py."},
    {"adjust_each", adjust_call, METH_VARARGS, "Moves points to their least costs; see adjustment.py."},
    {NULL, NULL, 0, NULL},
};
static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_adjustment", NULL, 0, methods, NULL, NULL, NULL, NULL};
PyMODINIT_FUNC PyInit__adjustment(void) { return PyModuleDef_Init(&definition); }
