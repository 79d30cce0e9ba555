/* One epoch of training on one thread: the arithmetic of CalibrationNetwork.forward_packed, of
 * torch.nn.functional.mse_loss and of torch.optim.Adam, in float32, with far less memory traffic:
 * - A convolution output is pooled at once; only maxima and their places are kept. The weight
 *   gradient is then summed at those places alone.
 * - Examples go forward and backward in tiles, and time in chunks, that stay in the second cache.
 * - Hidden weights are updated as soon as their gradient is complete.
 *
 * fused.py owns all memory and pads sizes so that loops over vectors have no rest. Padding has zero
 * weights, hence zero outputs and gradients, and Adam leaves it so.
 */
#include <math.h>
#include <stdint.h>
#ifdef __AVX__
#include <immintrin.h>
#endif

/* Floats of a vector, and vectors side by side in blocks of sums that fit the registers. */
#if defined(__AVX512F__)
#define LANES 16
#elif defined(__AVX__)
#define LANES 8
#else
#define LANES 4
#endif
#define WIDE (LANES == 16 ? 4 : 2)
#define ROWS 4
#define MOST 6

#define INLINE static inline __attribute__((always_inline))
#if defined(__clang__)
#define EACH(i, n) _Pragma("unroll") for (int i = 0; i < (n); i++)
#else
#define EACH(i, n) _Pragma("GCC unroll 16") for (int i = 0; i < (n); i++)
#endif

#define VECTOR(bytes) __attribute__((vector_size(bytes)))
typedef float vec VECTOR(4 * LANES);
typedef int32_t ints VECTOR(4 * LANES);
typedef uint64_t longs VECTOR(4 * LANES);
typedef float quad VECTOR(16);
/* In memory they start anywhere a float may. */
#define IN_MEMORY __attribute__((aligned(4), may_alias))
typedef vec vec_there IN_MEMORY;
typedef ints ints_there IN_MEMORY;
typedef uint32_t half_there VECTOR(2 * LANES) IN_MEMORY;

#define SLOPE 0.1f /* network.SLOPE */

typedef struct {
    /* channels, hidden and features are padded; span = taps * width */
    int64_t gyroscopes, blocks, width, span, channels, pool, pooled, hidden, features;
    int64_t tile, chunk;                /* examples and times done together */
    int64_t refetch;                    /* whether a tile's windows leave the cache meanwhile */
    int64_t kernel_row, floats;         /* of kernels; of all parameters */
    float *weights, *mean, *square, *gradient;    /* (floats); what follows lies in weights */
    float *hidden_weight, *hidden_bias;           /* (hidden, features), first of all; (hidden) */
    float *output_weight, *output_bias;           /* (gyroscopes, hidden); (gyroscopes) */
    float *convolution_weight, *convolution_bias; /* (channels, span); (channels) */
    const float *seen;                  /* (span): 1 where a kernel is, 0 elsewhere */
    const float *inputs;                /* (n, blocks, width) */
    const float *targets;               /* (n, gyroscopes) */
    float *kernels;                     /* (span / 2, kernel_row): see arrange */
    float *biases;                      /* (kernel_row) */
    float *active, *d_active;           /* (tile, hidden) */
    float *feature, *d_feature;         /* (tile, features); (tile, chunk * channels + 16) */
    int32_t *place;                     /* (tile, features): offsets of maxima in the window */
} Engine;

static int64_t smaller(int64_t a, int64_t b) { return a < b ? a : b; }

INLINE float *gradient(const Engine *e, const float *w) { return e->gradient + (w - e->weights); }
INLINE vec load(const float *from) { return *(const vec_there *)from; }
INLINE void store(float *to, vec value) { *(vec_there *)to = value; }
/* Into a register: gcc otherwise loads again for every use, and loads are what limits. */
INLINE vec load_once(const float *from) { return *(const volatile vec_there *)from; }

/* Where a > b (never if one is not a number) x, elsewhere y. */
INLINE ints greater(vec a, vec b, ints x, ints y)
{
#if defined(__AVX512F__)
    const __mmask16 first = _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GT_OQ);
    return (ints)_mm512_mask_mov_epi32((__m512i)y, first, (__m512i)x);
#else
    const ints first = a > b;
    return (first & x) | (~first & y);
#endif
}

/* b if either is not a number. */
INLINE vec maximum(vec a, vec b)
{
#if defined(__AVX512F__)
    return (vec)_mm512_max_ps((__m512)a, (__m512)b);
#elif defined(__AVX__)
    return (vec)_mm256_max_ps((__m256)a, (__m256)b);
#else
    return (vec)greater(a, b, (ints)a, (ints)b);
#endif
}

INLINE float total(vec value)
{
    union { vec all; quad part[LANES / 4]; } split = {value};
    quad sum = split.part[0];
    EACH(i, LANES / 4 - 1) sum += split.part[i + 1];
    return (sum[0] + sum[2]) + (sum[1] + sum[3]);
}

typedef uint64_t pair_there IN_MEMORY;

#define POSITIONS (2 * WIDE)

/* Few channels do not fill a vector, so each has two lanes: one for even taps, one for odd ones. A
 * pair of taps then goes to all lanes with one 64-bit load, at the price of a single tap. Where
 * two vectors of channels are side by side, the first has the even ones and the second the odd. */
static int64_t lane_of(const Engine *e, int64_t c)
{
    const int64_t first = c / LANES * LANES;
    return e->channels - first < LANES ? 2 * c : 2 * first + c % 2 * LANES + c % LANES / 2 * 2;
}

static void arrange(const Engine *e)
{
    for (int64_t c = 0; c < e->channels; c++) {
        e->biases[lane_of(e, c)] = e->convolution_bias[c];
        for (int64_t k = 0; k < e->span; k++)
            e->kernels[k / 2 * e->kernel_row + lane_of(e, c) + k % 2] =
                e->convolution_weight[c * e->span + k];
    }
}

/* The sum of each channel's two lanes: of both vectors in the order of channels, of one twice. */
INLINE vec untangled(vec even, vec odd)
{
    const longs low = (longs){0} + UINT32_MAX, a = (longs)even, b = (longs)odd;
    const longs ahead = (a & low) | (b & ~low), swapped = (a & ~low) | (b & low);
    return (vec)ahead + (vec)(swapped << 32 | swapped >> 32);
}

INLINE half_there half(vec twice) { return __builtin_convertvector((longs)twice, half_there); }

/* Outputs of `count` successive positions for a vector of channels, or half of one. */
INLINE void convolve(const Engine *e, const float *x, int64_t channel, vec *out, int count, int full)
{
    const int64_t width = e->width, wide = full ? 2 : 1;
    const float *kernels = e->kernels + 2 * channel, *biases = e->biases + 2 * channel;
    vec sums[POSITIONS][2];
    EACH(p, count) EACH(v, wide) sums[p][v] = load(biases + v * LANES);
    for (int64_t k = 0; k < e->span; k += 2, kernels += e->kernel_row) {
        vec weights[2];
        EACH(v, wide) weights[v] = load(kernels + v * LANES);
        EACH(p, count) {
            const vec taps = (vec)(*(const pair_there *)(x + p * width + k) + (longs){0});
            EACH(v, wide) sums[p][v] += weights[v] * taps;
        }
    }
    EACH(p, count) out[p] = untangled(sums[p][0], sums[p][wide - 1]);
}

/* Not inlined, so that all registers are its own. */
__attribute__((noinline)) static void convolve_block(const Engine *e, const float *x,
                                                     int64_t channel, vec *out, int full)
{
    if (full) convolve(e, x, channel, out, POSITIONS, 1);
    else convolve(e, x, channel, out, POSITIONS, 0);
}

/* Pooled times from..until and their features f..f+columns, with any padding. */
typedef struct { int64_t from, until, f, columns; } Chunk;

static Chunk chunk_at(const Engine *e, int64_t from)
{
    const int64_t until = smaller(from + e->chunk, e->pooled), f = from * e->channels;
    return (Chunk){from, until, f, (until < e->pooled ? until * e->channels : e->features) - f};
}

/* Into the cache. */
INLINE void fetch(const void *from, int64_t bytes)
{
    for (int64_t i = 0; i < bytes; i += 64) __builtin_prefetch((const char *)from + i);
}

/* Convolve, pool and activate a chunk of one window, for a vector of channels or half of one;
 * meanwhile fetch `next` into the cache. */
INLINE void pool(const Engine *e, const float *x, const float *next, Chunk now, int64_t channel,
                 float *feature, int32_t *place, int full)
{
    const int64_t width = e->width, first = now.from * e->pool, last = now.until * e->pool;
    const int many = last >= POSITIONS;
    const vec lowest = (vec){0} - INFINITY;
    vec out[POSITIONS], best = lowest;
    ints at = {0}, here = (ints){0} + (int32_t)(first * width);
    int64_t position = first, left = e->pool;
    while (position < last) {
        /* The last block overlaps the one before it, so as not to leave the window. */
        const int64_t start = many ? smaller(position, last - POSITIONS) : position;
        const int64_t stop = start + (many ? POSITIONS : 1);
        fetch(next + (position - first) * width, (stop - position) * width * (int64_t)sizeof *x);
        if (many) convolve_block(e, x + start * width, channel, out, full);
        else convolve(e, x + start * width, channel, out, 1, full);
        for (; position < stop; position++, here += (int32_t)width) {
            const vec value = out[position - start];
            at = greater(value, best, here, at); /* the first of equals, as in PyTorch */
            best = maximum(value, best);
            if (--left) continue;
            const vec active = maximum(best, SLOPE * best);
            if (full) *(vec_there *)feature = active, *(ints_there *)place = at;
            else *(half_there *)feature = half(active), *(half_there *)place = half((vec)at);
            best = lowest, left = e->pool;
            feature += e->channels, place += e->channels;
        }
    }
}

/* active (n, hidden) += features (n, columns) times weights (hidden, columns) transposed */
static void hidden_sums(const Engine *e, int64_t n, Chunk now)
{
    for (int64_t b = 0; b < n; b += ROWS)
        for (int64_t j = 0; j < e->hidden; j += WIDE) {
            const float *x = e->feature + b * e->features + now.f;
            const float *w = e->hidden_weight + j * e->features + now.f;
            vec sum[ROWS][WIDE] = {0};
            for (int64_t f = 0; f < now.columns; f += LANES) {
                vec columns[WIDE];
                EACH(k, WIDE) columns[k] = load_once(w + k * e->features + f);
                EACH(i, ROWS) {
                    const vec row = load_once(x + i * e->features + f);
                    EACH(k, WIDE) sum[i][k] += row * columns[k];
                }
            }
            float *to = e->active + b * e->hidden + j;
            EACH(i, ROWS) EACH(k, WIDE) to[i * e->hidden + k] += total(sum[i][k]);
        }
}

/* A block of the product below, of a constant number of vectors. */
INLINE void outer(const float *x, int64_t x_row, int64_t x_step, const float *y, int64_t y_step,
                  int64_t n, float *to, int64_t to_row, int fresh, int wide)
{
    vec sum[ROWS][WIDE];
    EACH(i, ROWS) EACH(k, wide) sum[i][k] = fresh ? (vec){0} : load(to + i * to_row + k * LANES);
    for (int64_t s = 0; s < n; s++) {
        vec row[WIDE];
        EACH(k, wide) row[k] = load_once(y + s * y_step + k * LANES);
        EACH(i, ROWS) EACH(k, wide) sum[i][k] += x[i * x_row + s * x_step] * row[k];
    }
    EACH(i, ROWS) EACH(k, wide) store(to + i * to_row + k * LANES, sum[i][k]);
}

/* to (rows, columns) = x (rows, n) times y (n, columns), or += where not fresh */
static void product(const float *x, int64_t x_row, int64_t x_step, const float *y, int64_t y_step,
                    int64_t n, float *to, int64_t to_row, int64_t rows, int64_t columns, int fresh)
{
    for (int64_t f = 0; f < columns; f += WIDE * LANES)
        for (int64_t r = 0; r < rows; r += ROWS)
            switch (smaller(WIDE, (columns - f) / LANES)) {
#define OUTER(wide) \
    case wide: outer(x + r * x_row, x_row, x_step, y + f, y_step, n, to + r * to_row + f, to_row, \
                     fresh, wide); break;
                OUTER(1) OUTER(2)
#if WIDE == 4
                OUTER(3) OUTER(4)
#endif
            }
}

/* Output layer and loss of one example, and the gradients from there down to the hidden sums. */
static double head(const Engine *e, const float *target, float scale, float *active,
                   float *d_active)
{
    double loss = 0;
    for (int64_t j = 0; j < e->hidden; j++) {
        const float sum = active[j] + e->hidden_bias[j];
        active[j] = sum > 0 ? sum : SLOPE * sum;
    }
    for (int64_t o = 0; o < e->gyroscopes; o++) {
        const float *row = e->output_weight + o * e->hidden;
        float *d_row = gradient(e, row);
        vec sum = {0};
        for (int64_t j = 0; j < e->hidden; j += LANES) sum += load(row + j) * load(active + j);
        const float miss = total(sum) + e->output_bias[o] - target[o], d = scale * miss;
        loss += (double)miss * miss;
        gradient(e, e->output_bias)[o] += d;
        for (int64_t j = 0; j < e->hidden; j += LANES) {
            store(d_row + j, load(d_row + j) + d * load(active + j));
            store(d_active + j, load(d_active + j) + d * load(row + j));
        }
    }
    for (int64_t j = 0; j < e->hidden; j++) {
        d_active[j] *= active[j] > 0 ? 1 : SLOPE;
        gradient(e, e->hidden_bias)[j] += d_active[j];
    }
    return loss;
}

/* to (2 channels of wide vectors) += d times the window at the maximum, over n times. Two channels at
 * once wait less for their last sums. */
INLINE void weigh(const Engine *e, const float *x, const float *d, const int32_t *place, int64_t n,
                  float *to, int wide)
{
    vec sums[2][MOST];
    EACH(i, 2) EACH(v, wide) sums[i][v] = load(to + i * e->span + v * LANES);
    for (int64_t t = 0; t < n; t++, d += e->channels, place += e->channels)
        EACH(i, 2) EACH(v, wide) sums[i][v] += d[i] * load(x + place[i] + v * LANES);
    EACH(i, 2) EACH(v, wide) store(to + i * e->span + v * LANES, sums[i][v]);
}

/* The convolution's gradient from n pooled times of one window; meanwhile fetch `next`. */
static void convolution_gradient(const Engine *e, const float *x, const float *next,
                                 const float *d, const int32_t *place, int64_t n)
{
    const int64_t part = e->refetch * n * e->pool * e->width / e->channels;
    const int64_t vectors = e->span / LANES, passes = (vectors + MOST - 1) / MOST;
    float *bias = gradient(e, e->convolution_bias);
    for (int64_t t = 0; t < n; t++)
        for (int64_t c = 0; c < e->channels; c++) bias[c] += d[t * e->channels + c];
    for (int64_t c = 0; c < e->channels; c += 2, d += 2, place += 2) {
        float *to = gradient(e, e->convolution_weight + c * e->span);
        fetch(next + c * part, 2 * part * (int64_t)sizeof *x);
        for (int64_t pass = 0, v = 0, until; pass < passes; pass++, v = until) {
            until = (pass + 1) * vectors / passes;
            switch (until - v) {
#define WEIGH(wide) \
    case wide: weigh(e, x + v * LANES, d, place, n, to + v * LANES, wide); break;
                WEIGH(1) WEIGH(2) WEIGH(3) WEIGH(4) WEIGH(5) WEIGH(6)
            }
        }
    }
}

/* Adam as in PyTorch; rate and root correct for the zeros that both means started from. */
static void adam(const Engine *e, int64_t first, int64_t n, float rate, float root)
{
    for (int64_t i = first; i < first + n; i++) {
        const float g = e->gradient[i];
        e->mean[i] += 0.1f * (g - e->mean[i]);
        e->square[i] = 0.999f * e->square[i] + 0.001f * g * g; /* 1 - 0.999f is not 0.001f */
        e->weights[i] -= rate * (e->mean[i] / (sqrtf(e->square[i]) * root + 1e-8f));
    }
}

/* Features and their part of the hidden sums for n examples. */
static void forward(const Engine *e, const int64_t *order, int64_t n, Chunk now)
{
    const int64_t window = e->blocks * e->width, time = e->pool * e->width;
    for (int64_t b = 0; b < n; b++) {
        int64_t next = order[b + 1] * window + now.from * time;
        if (b + 1 == n) /* the next chunk, or else the next tile */
            next = now.until < e->pooled ? order[0] * window + now.until * time : order[n] * window;
        for (int64_t c = 0; c < e->channels; c += LANES) {
            float *feature = e->feature + b * e->features + now.f + c;
            int32_t *place = e->place + b * e->features + now.f + c;
            const float *x = e->inputs + order[b] * window, *then = e->inputs + next;
            if (e->channels - c < LANES) pool(e, x, then, now, c, feature, place, 0);
            else pool(e, x, then, now, c, feature, place, 1);
        }
    }
    hidden_sums(e, n, now);
}

/* Gradients of the hidden layer's and the convolution's weights; the first tile's replace. */
static void backward(const Engine *e, const int64_t *order, int64_t n, Chunk now, int is_first)
{
    const int64_t d_row = e->chunk * e->channels + 16;
    const int64_t window = e->blocks * e->width, time = e->pool * e->width;
    const float *weight = e->hidden_weight + now.f, *feature = e->feature + now.f;
    product(e->d_active, e->hidden, 1, weight, e->features, e->hidden, e->d_feature, d_row, n,
            now.columns, 1);
    product(e->d_active, 1, e->hidden, feature, e->features, n, gradient(e, weight), e->features,
            e->hidden, now.columns, is_first);
    for (int64_t b = 0; b < n; b++, feature += e->features) {
        float *d = e->d_feature + b * d_row;
        for (int64_t i = 0; i < now.columns; i++) d[i] *= feature[i] > 0 ? 1 : SLOPE;
        int64_t next = order[b + 1 < n ? b + 1 : 0] * window + now.from * time;
        if (b + 1 == n) next -= now.from ? e->chunk * time : 0;
        convolution_gradient(e, e->inputs + order[b] * window, e->inputs + next, d,
                             e->place + b * e->features + now.f, now.until - now.from);
    }
}

/* One step of the optimiser; returns the sum of squared errors before it. */
static double step(const Engine *e, const int64_t *order, int64_t n, float rate, float root)
{
    const int64_t others = e->hidden * e->features; /* where all but the hidden weights start */
    const float scale = 2.0f / (float)(n * e->gyroscopes);
    double loss = 0;
    arrange(e);
    for (int64_t i = others; i < e->floats; i++) e->gradient[i] = 0;
    for (int64_t done = 0; done < n; done += e->tile, order += e->tile) {
        const int64_t size = smaller(e->tile, n - done);
        for (int64_t i = 0; i < e->tile * e->hidden; i++) e->active[i] = e->d_active[i] = 0;
        for (int64_t from = 0; from < e->pooled; from += e->chunk)
            forward(e, order, size, chunk_at(e, from));
        for (int64_t b = 0; b < size; b++)
            loss += head(e, e->targets + order[b] * e->gyroscopes, scale,
                         e->active + b * e->hidden, e->d_active + b * e->hidden);
        /* Backward in time as well: the last chunk is still in the cache. */
        for (int64_t from = (e->pooled - 1) / e->chunk * e->chunk; from >= 0; from -= e->chunk) {
            const Chunk now = chunk_at(e, from);
            backward(e, order, size, now, done == 0);
            for (int64_t j = 0; done + size == n && j < e->hidden; j++)
                adam(e, j * e->features + now.f, now.columns, rate, root);
        }
    }
    float *kernels = gradient(e, e->convolution_weight);
    for (int64_t i = 0; i < e->channels * e->span; i++) kernels[i] *= e->seen[i % e->span];
    adam(e, others, e->floats - others, rate, root);
    return loss;
}

/* Train on the n examples in this order (and read one index more), in batches; `steps` were made
 * before. Returns the sum of squared errors, each as it was before its batch's step. */
double fused_epoch(const Engine *e, const int64_t *order, int64_t n, int64_t batch, int64_t steps,
                   double learning_rate)
{
    double loss = 0;
    for (int64_t done = 0; done < n; done += batch) {
        const double first = 1 - pow(0.9, (double)++steps), second = 1 - pow(0.999, (double)steps);
        loss += step(e, order + done, smaller(batch, n - done), (float)(learning_rate / first),
                     (float)(1 / sqrt(second)));
    }
    return loss;
}
