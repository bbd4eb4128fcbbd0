/* Nearest neighbours of descriptors of int8 by their cosines: `nearest`, see nearest.py.
 *
 * The cosine of rows i and j is (float(a_i . b_j) * inverse_length_j) * inverse_length_i. The product of whole numbers
 * is exact, so the twin in Python has the same bits. The matrix of cosines is never stored: a tile of 16 rows and 16
 * columns is multiplied in registers, and the two largest of each row and column are updated.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined(__x86_64__) && defined(__GNUC__)
#include <immintrin.h>
#define HAS_VNNI (__builtin_cpu_supports("avx512vnni") && __builtin_cpu_supports("avx512bw"))
#define VNNI __attribute__((target("avx512f,avx512bw,avx512vnni")))

enum { ROWS = 16, COLUMNS = 16, LOWEST = -2 /* below any cosine */ };

/* The instruction multiplies unsigned by signed numbers: 128 is added to those of columns, and 128 times the sum of the
 * row's subtracted from the product. */
enum { BIAS = 128 };

typedef struct {
    const int8_t *numbers; /* (count, length) */
    const float *inverse_lengths;
    Py_ssize_t count;
} Descriptors;

#ifdef __clang__
#define UNROLLED _Pragma("clang loop unroll(full)")
#else
#define UNROLLED _Pragma("GCC unroll 16")
#endif

/* Columns in groups of 16, each four numbers of 16 columns after the other; zeros beyond the last column. */
typedef struct {
    uint8_t *numbers;
    float *inverse_lengths;
    Py_ssize_t groups;
} Packed;

/* Rows in groups of 16, in the same order; zeros beyond the last row. */
typedef struct {
    int8_t *numbers;
    int32_t *minus_bias;
} Rows;

typedef struct {
    int32_t *nearest;       /* (rows) */
    float *best, *second;   /* (rows) */
    float *column_best, *column_second; /* (groups * 16) */
} Maxima;

static Py_ssize_t rounded_up(Py_ssize_t count, Py_ssize_t step) { return (count + step - 1) / step * step; }

static void pack_columns(const Descriptors *from, Py_ssize_t length, const Packed *to) {
    Py_ssize_t padded = to->groups * COLUMNS;
    memset(to->numbers, 0, padded * length);
    memset(to->inverse_lengths, 0, padded * sizeof(float));
    memcpy(to->inverse_lengths, from->inverse_lengths, from->count * sizeof(float));
    for (Py_ssize_t j = 0; j < from->count; j++) {
        const int8_t *row = from->numbers + j * length;
        uint8_t *group = to->numbers + j / COLUMNS * COLUMNS * length + j % COLUMNS * 4;
        for (Py_ssize_t k = 0; k < length; k += 4)
            for (int l = 0; l < 4; l++) group[k * COLUMNS + l] = (uint8_t)(row[k + l] + BIAS);
    }
}

static void pack_rows(const Descriptors *from, Py_ssize_t length, const Rows *to) {
    const Py_ssize_t padded = rounded_up(from->count, ROWS);
    memset(to->numbers, 0, padded * length);
    memset(to->minus_bias, 0, padded * sizeof(int32_t));
    for (Py_ssize_t i = 0; i < from->count; i++) {
        const int8_t *row = from->numbers + i * length;
        int8_t *group = to->numbers + i / ROWS * ROWS * length + i % ROWS * 4;
        int32_t sum = 0;
        for (Py_ssize_t k = 0; k < length; k++) sum += row[k];
        to->minus_bias[i] = -BIAS * sum;
        for (Py_ssize_t k = 0; k < length; k += 4) memcpy(group + k * ROWS, row + k, 4);
    }
}

/* The largest of all lanes and its column, the first of equal ones; and the second-largest. */
static void reduce_lanes(const float best[COLUMNS], const float second[COLUMNS], const int32_t at[COLUMNS],
                         const Maxima *to, Py_ssize_t row) {
    int first = 0;
    for (int l = 1; l < COLUMNS; l++)
        if (best[l] > best[first] || (best[l] == best[first] && at[l] < at[first])) first = l;
    float next = second[first];
    for (int l = 0; l < COLUMNS; l++)
        if (l != first && best[l] > next) next = best[l];
    to->nearest[row] = at[first];
    to->best[row] = best[first];
    to->second[row] = next;
}

/* Products of 16 rows with 16 columns. GCC keeps an array in memory where it is indexed by a variable, and copies each
 * sum twice a step around its intrinsic, which reads a row's numbers apart. */
VNNI static inline __attribute__((always_inline)) void multiply(const int8_t *rows, const int32_t *minus_bias,
                                                                const uint8_t *columns, Py_ssize_t length,
                                                                __m512i products[ROWS]) {
    __m512i sums[ROWS];
    UNROLLED
    for (int r = 0; r < ROWS; r++) sums[r] = _mm512_set1_epi32(minus_bias[r]);
    for (Py_ssize_t k = 0; k < length; k += 4) {
        const __m512i of_columns = _mm512_loadu_si512(columns + k * COLUMNS);
        UNROLLED
        for (int r = 0; r < ROWS; r++) {
            const int8_t(*of_row)[4] = (const int8_t(*)[4])(rows + k * ROWS + r * 4);
            __asm__("vpdpbusd %2%{1to16%}, %1, %0" : "+v"(sums[r]) : "v"(of_columns), "m"(*of_row));
        }
    }
    UNROLLED
    for (int r = 0; r < ROWS; r++) products[r] = sums[r];
}

VNNI static void find(const Rows *rows, const float *inverse_lengths, Py_ssize_t count, const Packed *columns,
                      Py_ssize_t column_count, Py_ssize_t length, const Maxima *to) {
    const __m512i lanes = _mm512_set_epi32(15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0);
    const __m512 lowest = _mm512_set1_ps(LOWEST);
    for (Py_ssize_t g = 0; g < columns->groups; g++) {
        _mm512_storeu_ps(to->column_best + g * COLUMNS, lowest);
        _mm512_storeu_ps(to->column_second + g * COLUMNS, lowest);
    }
    for (Py_ssize_t i = 0; i < count; i += ROWS) {
        const int used = count - i < ROWS ? (int)(count - i) : ROWS;
        __m512 best[ROWS], second[ROWS], of_rows[ROWS];
        __m512i at[ROWS];
        UNROLLED
        for (int r = 0; r < ROWS; r++) {
            best[r] = second[r] = lowest, at[r] = _mm512_setzero_si512();
            of_rows[r] = _mm512_set1_ps(r < used ? inverse_lengths[i + r] : 0);
        }
        for (Py_ssize_t g = 0; g < columns->groups; g++) {
            __m512i products[ROWS];
            multiply(rows->numbers + i * length, rows->minus_bias + i, columns->numbers + g * COLUMNS * length, length,
                     products);
            const Py_ssize_t left = column_count - g * COLUMNS;
            const __mmask16 valid = left < COLUMNS ? (__mmask16)((1 << left) - 1) : 0xffff;
            const __m512 inverse = _mm512_loadu_ps(columns->inverse_lengths + g * COLUMNS);
            const __m512i column = _mm512_add_epi32(lanes, _mm512_set1_epi32((int32_t)(g * COLUMNS)));
            __m512 column_best = _mm512_loadu_ps(to->column_best + g * COLUMNS);
            __m512 column_second = _mm512_loadu_ps(to->column_second + g * COLUMNS);
            UNROLLED
            for (int r = 0; r < ROWS; r++) {
                const __m512 scaled = _mm512_mul_ps(_mm512_cvtepi32_ps(products[r]), inverse);
                const __m512 cosine = _mm512_mask_mul_ps(lowest, r < used ? valid : 0, scaled, of_rows[r]);
                at[r] = _mm512_mask_mov_epi32(at[r], _mm512_cmp_ps_mask(cosine, best[r], _CMP_GT_OQ), column);
                second[r] = _mm512_max_ps(second[r], _mm512_min_ps(best[r], cosine));
                best[r] = _mm512_max_ps(best[r], cosine);
                column_second = _mm512_max_ps(column_second, _mm512_min_ps(column_best, cosine));
                column_best = _mm512_max_ps(column_best, cosine);
            }
            _mm512_storeu_ps(to->column_best + g * COLUMNS, column_best);
            _mm512_storeu_ps(to->column_second + g * COLUMNS, column_second);
        }
        UNROLLED
        for (int r = 0; r < ROWS; r++) {
            if (r >= used) continue;
            float best_of[COLUMNS], second_of[COLUMNS];
            int32_t at_of[COLUMNS];
            _mm512_storeu_ps(best_of, best[r]);
            _mm512_storeu_ps(second_of, second[r]);
            _mm512_storeu_si512(at_of, at[r]);
            reduce_lanes(best_of, second_of, at_of, to, i + r);
        }
    }
}

/* False without memory. */
static int find_nearest(const Descriptors *first, const Descriptors *second, Py_ssize_t length, const Maxima *to) {
    const Py_ssize_t groups = rounded_up(second->count, COLUMNS) / COLUMNS, padded = groups * COLUMNS;
    const Py_ssize_t count = rounded_up(first->count, ROWS);
    float *floats = malloc(padded * (length + 3 * sizeof(float)) + count * (length + sizeof(int32_t)));
    if (floats == NULL) return 0;
    const Rows rows = {(int8_t *)(floats + 3 * padded + count), (int32_t *)(floats + 3 * padded)};
    Packed columns = {(uint8_t *)rows.numbers + count * length, floats, groups};
    Maxima found = *to;
    found.column_best = floats + padded, found.column_second = floats + 2 * padded;
    pack_columns(second, length, &columns);
    pack_rows(first, length, &rows);
    find(&rows, first->inverse_lengths, first->count, &columns, second->count, length, &found);
    memcpy(to->column_best, found.column_best, second->count * sizeof(float));
    memcpy(to->column_second, found.column_second, second->count * sizeof(float));
    free(floats);
    return 1;
}

#else
#define HAS_VNNI 0
typedef struct {
    const int8_t *numbers;
    const float *inverse_lengths;
    Py_ssize_t count;
} Descriptors;
typedef struct {
    int32_t *nearest;
    float *best, *second, *column_best, *column_second;
} Maxima;
static int find_nearest(const Descriptors *first, const Descriptors *second, Py_ssize_t length, const Maxima *to) {
    (void)first, (void)second, (void)length, (void)to;
    return 0;
}
#endif

/* Longer descriptors would overflow the sums of products, and sizes. */
enum { LONGEST = 32768 };

enum { FIRST, SECOND, FIRST_LENGTHS, SECOND_LENGTHS, NEAREST, BEST, SECOND_BEST, COLUMN_BEST, COLUMN_SECOND, BUFFERS };

static PyObject *nearest(PyObject *Py_UNUSED(module), PyObject *arguments) {
    Py_buffer b[BUFFERS] = {{0}};
    Py_ssize_t length;
    PyObject *result = NULL;
    if (!PyArg_ParseTuple(arguments, "ny*y*y*y*w*w*w*w*w*", &length, &b[0], &b[1], &b[2], &b[3], &b[4], &b[5], &b[6],
                          &b[7], &b[8]))
        return NULL;
    const Py_ssize_t rows = b[FIRST_LENGTHS].len / 4, columns = b[SECOND_LENGTHS].len / 4;
    int fits = length > 0 && length % 4 == 0 && length <= LONGEST;
    fits = fits && b[FIRST].len == rows * length && b[SECOND].len == columns * length;
    for (int i = NEAREST; i < BUFFERS; i++) fits &= b[i].len == 4 * (i < COLUMN_BEST ? rows : columns);
    if (!fits || !HAS_VNNI) {
        PyErr_SetString(PyExc_ValueError, "the sizes of the arrays do not fit, or the processor has no VNNI");
    } else {
        const Descriptors first = {b[FIRST].buf, b[FIRST_LENGTHS].buf, rows};
        const Descriptors second = {b[SECOND].buf, b[SECOND_LENGTHS].buf, columns};
        const Maxima to = {b[NEAREST].buf, b[BEST].buf, b[SECOND_BEST].buf, b[COLUMN_BEST].buf, b[COLUMN_SECOND].buf};
        int done;
        Py_BEGIN_ALLOW_THREADS
        done = find_nearest(&first, &second, length, &to);
        Py_END_ALLOW_THREADS
        result = done ? Py_NewRef(Py_None) : PyErr_NoMemory();
    }
    for (int i = 0; i < BUFFERS; i++) PyBuffer_Release(&b[i]);
    return result;
}

static PyObject *is_fast(PyObject *Py_UNUSED(module), PyObject *Py_UNUSED(arguments)) {
    return PyBool_FromLong(HAS_VNNI);
}

static PyMethodDef methods[] = {
    {"nearest", nearest, METH_VARARGS, "Writes the two largest cosines of each row and column; see nearest.py."},
    {"is_fast", is_fast, METH_NOARGS, "Whether this processor has the instructions."},
    {NULL, NULL, 0, NULL},
};
static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_nearest", NULL, 0, methods, NULL, NULL, NULL, NULL};
PyMODINIT_FUNC PyInit__nearest(void) { return PyModuleDef_Init(&definition); }
