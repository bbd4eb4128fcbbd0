/* The heads of EdgePoint2: scores of all pixels, and descriptors where there are keypoints; see edgepoint2.py.
 *
 * Scores go through their layers row by row, so that what lies between these stays in the cache. The map that descriptors
 * are sampled from is computed at the pixels that a keypoint samples alone, a quarter of all.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* Compiled for wider vectors too, of which the dynamic linker takes the widest of the processor. */
#if defined(__x86_64__) && defined(__GNUC__) && __GNUC__ >= 12 && defined(__GLIBC__)
#define WIDE __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#define IS_FAST (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"))
#else
#define WIDE
#define IS_FAST 0
#endif
#ifdef __clang__
#define UNROLLED _Pragma("clang loop unroll(full)")
#else
#define UNROLLED _Pragma("GCC unroll 16")
#endif
#define ALWAYS static inline __attribute__((always_inline))

typedef Py_ssize_t Index;

enum { LANES = 16, SIDE = 3, TAPS = SIDE * SIDE, BLOCK = 8, PIXELS = 8, STEP_PX = 4, SQUARE = 2 };

/* Sixteen floats, by whatever vectors the processor has. */
typedef float Lanes __attribute__((vector_size(LANES * sizeof(float))));
typedef int32_t Mask __attribute__((vector_size(LANES * sizeof(int32_t))));

ALWAYS void load(Lanes *to, const float *from) { memcpy(to, from, sizeof(*to)); }
ALWAYS void store(float *to, const Lanes *from) { memcpy(to, from, sizeof(*from)); }
/* By a mask: compilers make a loop over floats of vectors one of single floats. */
ALWAYS void relu(Lanes *values) { *values = (Lanes)((Mask)*values & (Mask)(*values > 0)); }

/* Where a map is read between its pixels after it is enlarged by a factor: the pixel before, the one after, its share. */
static void between(Index pixel, Index factor, Index size, Index *before, Index *after, float *share) {
    const float place = ((float)pixel + 0.5f) / (float)factor - 0.5f;
    const Index first = (Index)floorf(place);
    *share = place - (float)first;
    *before = first < 0 ? 0 : first;
    *after = first + 1 < size ? first + 1 : size - 1;
}

/* A map (channels, height, width) made wider by a factor, (channels, height, factor * width). */
static void widen(const float *map, Index rows, Index width, Index factor, float *to) {
    for (Index x = 0; x < factor * width; x++) {
        Index before, after;
        float share;
        between(x, factor, width, &before, &after, &share);
        for (Index r = 0; r < rows; r++) {
            const float *row = map + r * width;
            to[r * factor * width + x] = row[before] * (1 - share) + row[after] * share;
        }
    }
}

/* Adds row y of a map that is as wide as the result, enlarged in height by a factor. */
ALWAYS void add_row(const float *map, Index channels, Index height, Index width, Index factor, Index y, float *to,
                    Index stride) {
    Index before, after;
    float share;
    between(y, factor, height, &before, &after, &share);
    for (Index c = 0; c < channels; c++) {
        const float *first = map + (c * height + before) * width, *second = map + (c * height + after) * width;
        for (Index x = 0; x < width; x++) to[c * stride + x] += first[x] * (1 - share) + second[x] * share;
    }
}

/* Sixteen pixels of some channels of a row: 3x3 taps of `sources` with the weights (in, 9, out) from channel `first` on. */
ALWAYS void convolve(const float *const rows[SIDE], Index stride, Index sources, const float *weights, Index results,
                     const float *bias, Index first, int count, Index x, int is_relu, float *to) {
    Lanes sums[BLOCK], pixels;
    UNROLLED
    for (int k = 0; k < count; k++) sums[k] = (Lanes){0} + bias[first + k];
    for (Index c = 0; c < sources; c++)
        for (int t = 0; t < TAPS; t++) {
            load(&pixels, rows[t / SIDE] + c * stride + x + t % SIDE - 1);
            const float *w = weights + (c * TAPS + t) * results + first;
            UNROLLED
            for (int k = 0; k < count; k++) sums[k] += pixels * w[k];
        }
    UNROLLED
    for (int k = 0; k < count; k++) {
        if (is_relu) relu(&sums[k]);
        store(to + (first + k) * stride + x, &sums[k]);
    }
}

typedef struct {
    const float *weights, *bias; /* (in, 9, out), (out) */
} Layer;

typedef struct {
    const float *half, *weights, *bias;  /* (C, H, W), (C, S), (S) */
    const float *eighth, *last;          /* (S, H / 4, W), (S, H / 16, W): widened */
    Layer layers[SIDE];                  /* S to S, S to S, S to 4 */
    Index channels, scores, height, width;
} ScoreHead;

/* Row y of the sum of the three maps' scores. */
ALWAYS void sum_row(const ScoreHead *head, Index y, float *to, Index stride) {
    const Index plane = head->height * head->width;
    for (Index first = 0; first < head->scores; first += BLOCK)
        for (Index x = 0; x < head->width; x += LANES) {
            Lanes sums[BLOCK], pixels;
            UNROLLED
            for (int k = 0; k < BLOCK; k++) sums[k] = (Lanes){0} + head->bias[first + k];
            for (Index c = 0; c < head->channels; c++) {
                load(&pixels, head->half + c * plane + y * head->width + x);
                const float *w = head->weights + c * head->scores + first;
                UNROLLED
                for (int k = 0; k < BLOCK; k++) sums[k] += pixels * w[k];
            }
            UNROLLED
            for (int k = 0; k < BLOCK; k++) store(to + (first + k) * stride + x, &sums[k]);
        }
    add_row(head->eighth, head->scores, head->height / 4, head->width, 4, y, to, stride);
    add_row(head->last, head->scores, head->height / 16, head->width, 16, y, to, stride);
}

/* Logits (2 H, 2 W). Each of three rings holds the last four rows of a layer; rows beyond the map are zeros. */
enum { RING = 4, RINGS = 3 };

static Index ring_row(const ScoreHead *head) { return head->scores * (head->width + 2 * LANES); }

WIDE static void compute_scores(const ScoreHead *head, float *memory, float *logits) {
    const Index stride = head->width + 2 * LANES, size = ring_row(head), height = head->height, width = head->width;
    const float *nothing = memory + RINGS * RING * size + LANES;
    float *last = memory + (RINGS * RING + 1) * size + LANES;
#define ROW(ring, y) (memory + ((ring) * RING + ((y) & (RING - 1))) * size + LANES)
    for (Index y = 0; y < height + SIDE; y++) {
        if (y < height) sum_row(head, y, ROW(0, y), stride);
        for (Index layer = 0; layer < SIDE; layer++) {
            const Index at = y - 1 - layer; /* this layer's row, whose three sources are there */
            if (at < 0 || at >= height) continue;
            const float *rows[SIDE];
            for (Index r = 0; r < SIDE; r++) {
                const Index source = at + r - 1;
                rows[r] = source < 0 || source >= height ? nothing : ROW(layer, source);
            }
            const Layer *its = &head->layers[layer];
            for (Index x = 0; x < width; x += LANES) {
                if (layer == SIDE - 1)
                    convolve(rows, stride, head->scores, its->weights, SQUARE * SQUARE, its->bias, 0, SQUARE * SQUARE, x, 0,
                             last);
                else
                    for (Index first = 0; first < head->scores; first += BLOCK)
                        convolve(rows, stride, head->scores, its->weights, head->scores, its->bias, first, BLOCK, x, 1,
                                 ROW(layer + 1, at));
            }
            if (layer < SIDE - 1) continue;
            for (Index a = 0; a < SQUARE; a++) {
                const float *even = last + SQUARE * a * stride, *odd = even + stride;
                float *to = logits + (SQUARE * at + a) * SQUARE * width;
                for (Index x = 0; x < width; x++) to[2 * x] = even[x], to[2 * x + 1] = odd[x];
            }
        }
    }
#undef ROW
}

typedef struct {
    const float *quarter, *weights, *bias; /* (C, H, W), (C, J), (J) */
    const float *eighth, *last;            /* (H / 2, W / 2, J), (H / 8, W / 8, J) */
    const float *grouped, *grouped_bias;   /* (J / 16, 9, 16, 16) by group, tap, source and result; (J) */
    Index channels, joint, height, width;
} DescriptorHead;

/* Row y of the sum of the three maps, where it is needed. */
ALWAYS void join_row(const DescriptorHead *head, Index y, const uint8_t *needed, float *blended, float *to) {
    const Index width = head->width, joint = head->joint, plane = head->height * width;
    const float *maps[2] = {head->eighth, head->last};
    for (int m = 0; m < 2; m++) {
        const Index factor = m ? 8 : 2, its_width = width / factor;
        Index before, after;
        float share;
        between(y, factor, head->height / factor, &before, &after, &share);
        const float *first = maps[m] + before * its_width * joint, *second = maps[m] + after * its_width * joint;
        float *row = blended + m * (width / 2) * joint;
        for (Index i = 0; i < its_width * joint; i++) row[i] = first[i] * (1 - share) + second[i] * share;
    }
    for (Index x = 0; x < width; x++) {
        if (!needed[x]) continue;
        const float *sources[4];
        float shares[4];
        for (int m = 0; m < 2; m++) {
            Index before, after;
            float share;
            between(x, m ? 8 : 2, width / (m ? 8 : 2), &before, &after, &share);
            const float *row = blended + m * (width / 2) * joint;
            sources[2 * m] = row + before * joint, sources[2 * m + 1] = row + after * joint;
            shares[2 * m] = 1 - share, shares[2 * m + 1] = share;
        }
        float pixel[LANES];
        for (Index c = 0; c < head->channels; c++) pixel[c] = head->quarter[c * plane + y * width + x];
        for (Index j = 0; j < joint; j += LANES) {
            Lanes sums, other;
            load(&sums, head->bias + j);
            for (Index c = 0; c < head->channels; c++) load(&other, head->weights + c * joint + j), sums += pixel[c] * other;
            for (int m = 0; m < 4; m++) load(&other, sources[m] + j), sums += shares[m] * other;
            store(to + x * joint + j, &sums);
        }
    }
}

/* Rows of the joined map, each surrounded by a pixel of zeros: the last four that were computed. */
static float *joined_row(const DescriptorHead *head, float *ring, Index y) {
    return ring + (y & (RING - 1)) * (head->width + 2) * head->joint;
}

/* The map after its grouped 3x3 layer, at columns (count) of row y. */
ALWAYS void convolve_groups(const DescriptorHead *head, float *ring, const float *nothing, Index y, const Index *columns,
                            Index count, float *to) {
    const Index joint = head->joint;
    const float *rows[SIDE];
    for (Index r = 0; r < SIDE; r++) {
        const Index source = y + r - 1;
        rows[r] = source < 0 || source >= head->height ? nothing : joined_row(head, ring, source);
    }
    for (Index g = 0; g < joint / LANES; g++) {
        Lanes bias;
        load(&bias, head->grouped_bias + g * LANES);
        for (Index i = 0; i < count; i += PIXELS) {
            Index sources[PIXELS];
            Lanes sums[PIXELS], weights;
            for (int p = 0; p < PIXELS; p++) {
                sources[p] = columns[i + p < count ? i + p : count - 1] * joint + g * LANES;
                sums[p] = bias;
            }
            for (int t = 0; t < TAPS; t++) {
                const float *its = head->grouped + (g * TAPS + t) * LANES * LANES;
                const float *row = rows[t / SIDE] + t % SIDE * joint;
                for (int c = 0; c < LANES; c++) {
                    load(&weights, its + c * LANES);
                    UNROLLED
                    for (int p = 0; p < PIXELS; p++) sums[p] += row[sources[p] + c] * weights;
                }
            }
            UNROLLED
            for (int p = 0; p < PIXELS; p++) {
                if (i + p >= count) continue;
                relu(&sums[p]);
                store(to + (i + p) * joint + g * LANES, &sums[p]);
            }
        }
    }
}

/* The map at pixels (count), in order; `needed` are the pixels around these. `memory` is of zeros. */
WIDE static void compute_map(const DescriptorHead *head, const uint8_t *needed, const Index *columns, const Index *row_end,
                             float *memory, float *map) {
    const Index size = (head->width + 2) * head->joint;
    float *nothing = memory + RING * size, *blended = nothing + size;
    for (Index y = 0; y <= head->height; y++) {
        if (y < head->height)
            join_row(head, y, needed + y * head->width, blended, joined_row(head, memory, y) + head->joint);
        if (!y) continue;
        const Index begin = y > 1 ? row_end[y - 2] : 0;
        convolve_groups(head, memory, nothing, y - 1, columns + begin, row_end[y - 1] - begin, map + begin * head->joint);
    }
}

/* The four pixels around a keypoint and their shares; -1 beyond the map, where it is zero. */
static void corners(const DescriptorHead *head, const double keypoint[2], Index pixels[4], float shares[4]) {
    const double x = (keypoint[0] + 0.5) / STEP_PX - 0.5, y = (keypoint[1] + 0.5) / STEP_PX - 0.5;
    const double left = floor(x), top = floor(y);
    const float right = (float)(x - left), low = (float)(y - top);
    for (int i = 0; i < 4; i++) {
        const double column = left + i % 2, row = top + i / 2;
        const int is_inside = column >= 0 && column < (double)head->width && row >= 0 && row < (double)head->height;
        pixels[i] = is_inside ? (Index)row * head->width + (Index)column : -1;
        shares[i] = (i % 2 ? right : 1 - right) * (i / 2 ? low : 1 - low);
    }
}

/* Samples (count, J) of the map at keypoints (count, 2), x and y in pixels of the photograph. 0 without memory. */
static int sample(const DescriptorHead *head, const double *keypoints, Index count, float *samples) {
    const Index width = head->width, height = head->height, joint = head->joint, size = width * height;
    /* The row of each pixel in the map, or -1; columns of the pixels in the map; where they end in each row. */
    Index *rows = malloc((size_t)(2 * size + height) * sizeof(Index)), *columns = rows + size, *row_end = columns + size;
    uint8_t *needed = calloc((size_t)size, 1);
    float *memory = calloc((size_t)((RING + 1) * (width + 2) * joint + width * joint), sizeof(float)), *map = NULL;
    if (rows && needed && memory) {
        Index found = 0, around[4];
        float shares[4];
        for (Index i = 0; i < size; i++) rows[i] = -1;
        for (Index k = 0; k < count; k++) {
            corners(head, keypoints + 2 * k, around, shares);
            for (int i = 0; i < 4; i++)
                if (around[i] >= 0) rows[around[i]] = 0;
        }
        for (Index y = 0; y < height; row_end[y++] = found)
            for (Index x = 0; x < width; x++) {
                if (rows[y * width + x] < 0) continue;
                rows[y * width + x] = found, columns[found++] = x;
                for (Index v = y ? y - 1 : 0; v <= y + 1 && v < height; v++)
                    for (Index u = x ? x - 1 : 0; u <= x + 1 && u < width; u++) needed[v * width + u] = 1;
            }
        map = malloc((size_t)(found * joint + 1) * sizeof(float));
        if (map) {
            compute_map(head, needed, columns, row_end, memory, map);
            memset(samples, 0, (size_t)(count * joint) * sizeof(float));
            for (Index k = 0; k < count; k++) {
                corners(head, keypoints + 2 * k, around, shares);
                for (int i = 0; i < 4; i++) {
                    if (around[i] < 0) continue;
                    const float *its = map + rows[around[i]] * joint;
                    for (Index j = 0; j < joint; j++) samples[k * joint + j] += shares[i] * its[j];
                }
            }
        }
    }
    const int done = map != NULL;
    free(rows), free(needed), free(memory), free(map);
    return done;
}

/* Pixels of a map (height, width) above a threshold and all others of their 5x5 window, row by row, but for those at a
 * border of at least two pixels. `found` (2, room) has their rows, then their columns; -1 if there are more. */
enum { MARGIN = 2 };

static Index find_maxima(const float *map, Index height, Index width, Index border, float threshold, int32_t *found,
                         Index room) {
    Index count = 0;
    for (Index y = border; y < height - border; y++)
        for (Index x = border; x < width - border; x++) {
            const float *here = map + y * width + x, value = *here;
            if (!(value > threshold) || !(value > here[1]) || !(value > here[-1])) continue;
            int is_largest = 1;
            for (Index v = -MARGIN; v <= MARGIN && is_largest; v++)
                for (Index u = -MARGIN; u <= MARGIN; u++) is_largest &= (!u && !v) || value > here[v * width + u];
            if (!is_largest) continue;
            if (count == room) return -1;
            found[count] = (int32_t)y, found[room + count++] = (int32_t)x;
        }
    return count;
}

enum { MOST_ARRAYS = 12 };

typedef struct {
    Py_buffer buffers[MOST_ARRAYS];
    int count;
} Arrays;

static void release(Arrays *arrays) {
    while (arrays->count) PyBuffer_Release(&arrays->buffers[--arrays->count]);
}

/* The arrays after so many numbers, of which the last is written to; 0 with an exception. */
static int acquire(PyObject *arguments, Index *numbers, int first, int count, Arrays *arrays) {
    arrays->count = 0;
    if (PyTuple_Size(arguments) != first + count) {
        PyErr_SetString(PyExc_TypeError, "the number of arguments is wrong");
        return 0;
    }
    for (int i = 0; i < first; i++) {
        numbers[i] = PyLong_AsSsize_t(PyTuple_GetItem(arguments, i));
        if (PyErr_Occurred()) return 0;
        if (numbers[i] < 1 || numbers[i] > 1 << 16) {
            PyErr_SetString(PyExc_ValueError, "a size is out of range");
            return 0;
        }
    }
    for (; arrays->count < count; arrays->count++) {
        const int flags = PyBUF_C_CONTIGUOUS | (arrays->count == count - 1 ? PyBUF_WRITABLE : 0);
        if (PyObject_GetBuffer(PyTuple_GetItem(arguments, first + arrays->count), &arrays->buffers[arrays->count], flags)) {
            release(arrays);
            return 0;
        }
    }
    return 1;
}

static int have_bytes(const Arrays *arrays, const Index *lengths) {
    for (int i = 0; i < arrays->count; i++)
        if (arrays->buffers[i].len != lengths[i]) return 0;
    return 1;
}

static PyObject *sizes_do_not_fit(Arrays *arrays) {
    release(arrays);
    PyErr_SetString(PyExc_ValueError, "the sizes of the arrays do not fit");
    return NULL;
}

static PyObject *scores_call(PyObject *Py_UNUSED(module), PyObject *arguments) {
    Arrays a;
    Index sizes[4];
    if (!acquire(arguments, sizes, 4, 12, &a)) return NULL;
    const Index c = sizes[0], s = sizes[1], h = sizes[2], w = sizes[3], f = sizeof(float);
    const Index lengths[] = {c * h * w * f, c * s * f,        s * f, s * (h / 4) * (w / 4) * f, s * (h / 16) * (w / 16) * f,
                             s * TAPS * s * f, s * f,      s * TAPS * s * f, s * f,      s * TAPS * 4 * f, 4 * f, 4 * h * w * f};
    if (s % BLOCK || h % 16 || w % 16 || !have_bytes(&a, lengths)) return sizes_do_not_fit(&a);
    ScoreHead head = {a.buffers[0].buf, a.buffers[1].buf, a.buffers[2].buf, NULL, NULL, {{0}}, c, s, h, w};
    for (int i = 0; i < SIDE; i++)
        head.layers[i].weights = a.buffers[5 + 2 * i].buf, head.layers[i].bias = a.buffers[6 + 2 * i].buf;
    const Index rings = (RINGS * RING + 2) * s * (w + 2 * LANES), eighth = s * (h / 4) * w, last = s * (h / 16) * w;
    float *memory = calloc((size_t)(rings + eighth + last), sizeof(float));
    if (memory) {
        Py_BEGIN_ALLOW_THREADS
        widen(a.buffers[3].buf, s * (h / 4), w / 4, 4, memory + rings);
        widen(a.buffers[4].buf, s * (h / 16), w / 16, 16, memory + rings + eighth);
        head.eighth = memory + rings, head.last = memory + rings + eighth;
        compute_scores(&head, memory, a.buffers[11].buf);
        Py_END_ALLOW_THREADS
    }
    free(memory);
    release(&a);
    return memory ? Py_NewRef(Py_None) : PyErr_NoMemory();
}

static PyObject *samples_call(PyObject *Py_UNUSED(module), PyObject *arguments) {
    Arrays a;
    Index sizes[4];
    if (!acquire(arguments, sizes, 4, 9, &a)) return NULL;
    const Index c = sizes[0], j = sizes[1], h = sizes[2], w = sizes[3], f = sizeof(float);
    const Index count = a.buffers[7].len / (2 * (Index)sizeof(double));
    const Index lengths[] = {c * h * w * f, c * j * f, j * f, j * (h / 2) * (w / 2) * f, j * (h / 8) * (w / 8) * f,
                             j * TAPS * LANES * f, j * f, count * 2 * (Index)sizeof(double), count * j * f};
    if (j % LANES || c > LANES || h % 8 || w % 8 || !have_bytes(&a, lengths)) return sizes_do_not_fit(&a);
    const DescriptorHead head = {a.buffers[0].buf, a.buffers[1].buf, a.buffers[2].buf, a.buffers[3].buf, a.buffers[4].buf,
                                 a.buffers[5].buf, a.buffers[6].buf, c, j, h, w};
    int done;
    Py_BEGIN_ALLOW_THREADS
    done = sample(&head, a.buffers[7].buf, count, a.buffers[8].buf);
    Py_END_ALLOW_THREADS
    release(&a);
    return done ? Py_NewRef(Py_None) : PyErr_NoMemory();
}

static PyObject *maxima_call(PyObject *Py_UNUSED(module), PyObject *arguments) {
    Py_buffer map, found;
    Py_ssize_t height, width, border;
    float threshold;
    if (!PyArg_ParseTuple(arguments, "nnnfy*w*", &height, &width, &border, &threshold, &map, &found)) return NULL;
    const Index room = found.len / (2 * (Index)sizeof(int32_t));
    Index count = -1;
    if (height > 0 && width > 0 && border >= MARGIN && map.len / (Index)sizeof(float) / width == height &&
        map.len == height * width * (Index)sizeof(float)) {
        Py_BEGIN_ALLOW_THREADS
        count = find_maxima(map.buf, height, width, border, threshold, found.buf, room);
        Py_END_ALLOW_THREADS
    }
    PyBuffer_Release(&map);
    PyBuffer_Release(&found);
    if (count >= 0) return PyLong_FromSsize_t(count);
    PyErr_SetString(PyExc_ValueError, "the sizes of the arrays do not fit");
    return NULL;
}

static PyObject *is_fast(PyObject *Py_UNUSED(module), PyObject *Py_UNUSED(arguments)) {
    return PyBool_FromLong(IS_FAST);
}

static PyMethodDef methods[] = {
    {"is_fast", is_fast, METH_NOARGS, "Whether this processor has the vectors that it is compiled for."},
    {"maxima", maxima_call, METH_VARARGS, "Writes strict maxima and returns their number; see edgepoint2.py."},
    {"scores", scores_call, METH_VARARGS, "Writes logits; see edgepoint2.py."},
    {"samples", samples_call, METH_VARARGS, "Writes samples of the descriptors' map; see edgepoint2.py."},
    {NULL, NULL, 0, NULL},
};
static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_edgepoint2", NULL, 0, methods, NULL, NULL, NULL, NULL};
PyMODINIT_FUNC PyInit__edgepoint2(void) { return PyModuleDef_Init(&definition); }
