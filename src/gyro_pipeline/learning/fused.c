/* One epoch of training on one thread: forward, backward and Adam for every batch.
 *
 * The arithmetic is that of CalibrationNetwork.forward_packed, torch.nn.functional.mse_loss and
 * torch.optim.Adam in float32. Three things make it several times faster:
 *
 * - A convolution output is pooled in registers as soon as it is computed; only the maximum and
 *   where it was are stored. The weight gradient is then summed at those places alone.
 * - Examples go forward and backward in tiles, and time in chunks, small enough for the caches.
 * - A chunk of the hidden weights is updated as soon as its gradient is complete.
 *
 * Sizes are padded so that no loop over vectors has a rest: channels to a multiple of 8, features
 * and hidden units to 16. Padding has zero weights, so its outputs and gradients are zero, and Adam
 * leaves it at zero. fused.py makes the layouts and owns all memory.
 */
#include <math.h>
#include <stdint.h>

#if defined(__AVX512F__)
#define LANES 16
#elif defined(__AVX__)
#define LANES 8
#else
#define LANES 4
#endif

/* Vectors side by side in a block of accumulators: 4 x 4 with 32 registers, 4 x 2 with 16. */
#if defined(__AVX512F__) || defined(__aarch64__)
#define WIDE 4
#else
#define WIDE 2
#endif
#define ROWS 4
#define POSITIONS (2 * WIDE) /* convolution outputs at once, for two vectors of channels */
#define MOST 6               /* vectors of one pass over a weight gradient */

#define INLINE static inline __attribute__((always_inline))
#define UNROLL _Pragma("GCC unroll 16")

#define VECTOR(bytes) __attribute__((vector_size(bytes)))
typedef float vec VECTOR(4 * LANES);
typedef int32_t ints VECTOR(4 * LANES);
typedef uint64_t longs VECTOR(4 * LANES);
typedef float quad VECTOR(16);
typedef float eight VECTOR(32);
/* In memory they start anywhere a float may. */
#define IN_MEMORY __attribute__((aligned(4), may_alias))
typedef vec vec_there IN_MEMORY;
typedef eight eight_there IN_MEMORY;
typedef uint64_t pair_there IN_MEMORY;
typedef uint32_t half VECTOR(2 * LANES) IN_MEMORY;
#define LOWEST ((vec){0} - INFINITY)

static const float SLOPE = 0.1f; /* network.SLOPE */

typedef struct {
    /* Sizes; channels, hidden and features are padded. span = taps * width. */
    int64_t gyroscopes, blocks, width, span, channels, pool, pooled, hidden, features;
    int64_t tile, chunk; /* examples and pooled times worked on together; see fused_plan */
    const float *inputs, *targets;
    const float *seen; /* (span): 1 where a kernel weight is, 0 where there is none */
    float *weights, *mean, *square, *gradient; /* of all parameters, see Parameters */
    float *scratch;
} Engine;

/* The order of the parameters in weights, mean, square and gradient. */
typedef struct {
    float *hidden;           /* (hidden, features) */
    float *hidden_bias;      /* (hidden) */
    float *output;           /* (gyroscopes, hidden) */
    float *convolution;      /* (channels, span) */
    float *convolution_bias; /* (channels) */
    float *output_bias;      /* (gyroscopes), padded to a multiple of 8 */
    float *end;
} Parameters;

typedef struct {
    float *pairs;      /* (span / 2, 2 * channels): two taps of each channel side by side */
    float *pair_bias;  /* (2 * channels): the bias, 0 */
    float *hidden;     /* (tile, hidden): sums, then activations */
    float *d_hidden;   /* (tile, hidden) */
    float *features;   /* (tile, features) */
    int32_t *places;   /* (tile, features): where in the window each maximum was */
    float *d_features; /* (tile, features of a chunk and padding) */
    float *end;
} Scratch;

static Parameters parameters(const Engine *e, float *base)
{
    Parameters p = {.hidden = base};
    p.hidden_bias = p.hidden + e->hidden * e->features;
    p.output = p.hidden_bias + e->hidden;
    p.convolution = p.output + e->gyroscopes * e->hidden;
    p.convolution_bias = p.convolution + e->channels * e->span;
    p.output_bias = p.convolution_bias + e->channels;
    p.end = p.output_bias + (e->gyroscopes + 7) / 8 * 8;
    return p;
}

static Scratch scratch(const Engine *e)
{
    Scratch s = {.pairs = e->scratch};
    s.pair_bias = s.pairs + e->channels * e->span;
    s.hidden = s.pair_bias + 2 * e->channels;
    s.d_hidden = s.hidden + e->tile * e->hidden;
    s.features = s.d_hidden + e->tile * e->hidden;
    s.places = (int32_t *)(s.features + e->tile * e->features);
    s.d_features = (float *)(s.places + e->tile * e->features);
    s.end = s.d_features + e->tile * (e->chunk * e->channels + 16);
    return s;
}

static int64_t smaller(int64_t a, int64_t b) { return a < b ? a : b; }
static int64_t larger(int64_t a, int64_t b) { return a > b ? a : b; }

/* Choose tile and chunk for batches of at most so many examples; return the floats of scratch. */
int64_t fused_plan(Engine *e, int64_t batch)
{
    const int64_t near = 8 << 10, middle = 128 << 10; /* floats: most of a first, a second cache */
    const int64_t example = e->blocks * e->width;
    /* A chunk of one window fits the first cache, one of all weights and features the second. */
    const int64_t by_window = near / (e->pool * e->width);
    const int64_t by_weights = middle / (e->channels * (4 * e->hidden + 3 * ROWS));
    e->chunk = larger(2, smaller(smaller(by_window, by_weights), e->pooled + 1) & ~(int64_t)1);
    /* A tile's windows stay in the second cache until they are needed again, unless that means
     * going through hidden weights too large for it once more for every tile. */
    const int small = e->hidden * e->features <= middle / 4;
    e->tile = small ? smaller(batch, middle / example) : batch;
    e->tile = larger(ROWS, (e->tile + ROWS - 1) / ROWS * ROWS);
    return scratch(e).end - e->scratch;
}

INLINE vec load(const float *from) { return *(const vec_there *)from; }
INLINE void store(float *to, vec value) { *(vec_there *)to = value; }

INLINE float total(vec value)
{
    union { vec all; quad part[LANES / 4]; } split = {value};
    quad sum = split.part[0];
    UNROLL for (int i = 1; i < LANES / 4; i++) sum += split.part[i];
    return (sum[0] + sum[2]) + (sum[1] + sum[3]);
}

/* Channels do not fill a vector, so each has two lanes: one for even taps, one for odd ones. A
 * pair of taps is then one 64-bit load to all lanes, which costs no more than that of one tap. */
static void pair_up(const Engine *e, const Scratch *s)
{
    const Parameters w = parameters(e, e->weights);
    for (int64_t c = 0; c < e->channels; c++) {
        s->pair_bias[2 * c] = w.convolution_bias[c];
        s->pair_bias[2 * c + 1] = 0;
        for (int64_t k = 0; k < e->span; k++)
            s->pairs[(k / 2 * e->channels + c) * 2 + k % 2] = w.convolution[c * e->span + k];
    }
}

/* Outputs of `count` successive positions for `wide` vectors of channels; both are constants. */
INLINE void convolve(const Engine *e, const float *x, const float *pairs,
                     const float *bias, vec (*out)[2], int count, int wide)
{
    const int64_t width = e->width, step = 2 * e->channels;
    vec sums[POSITIONS][2];
    UNROLL for (int p = 0; p < count; p++)
        UNROLL for (int v = 0; v < wide; v++) sums[p][v] = load(bias + v * LANES);
    for (int64_t k = 0; k < e->span; k += 2, pairs += step) {
        vec w[2];
        UNROLL for (int v = 0; v < wide; v++) w[v] = load(pairs + v * LANES);
        UNROLL for (int p = 0; p < count; p++) {
            const vec taps = (vec)(*(const pair_there *)(x + p * width + k) + (longs){0});
            UNROLL for (int v = 0; v < wide; v++) sums[p][v] += w[v] * taps;
        }
    }
    UNROLL for (int p = 0; p < count; p++)
        UNROLL for (int v = 0; v < wide; v++) out[p][v] = sums[p][v];
}

/* Functions of their own, so that all registers are theirs. */
__attribute__((noinline)) static void convolve_one(const Engine *e, const float *x,
                                                   const float *pairs, const float *bias,
                                                   vec (*out)[2])
{
    convolve(e, x, pairs, bias, out, POSITIONS, 1);
}
__attribute__((noinline)) static void convolve_two(const Engine *e, const float *x,
                                                   const float *pairs, const float *bias,
                                                   vec (*out)[2])
{
    convolve(e, x, pairs, bias, out, POSITIONS, 2);
}

/* Convolve, pool and activate pooled times from..until of one window; fetch those of the next. */
INLINE void pool(const Engine *e, const float *x, const float *next, const float *pairs,
                 const float *bias, int64_t from, int64_t until, float *features,
                 int32_t *places, int wide)
{
    const int64_t width = e->width, first = from * e->pool, last = until * e->pool;
    const int many = last - first >= POSITIONS;
    vec out[POSITIONS][2], best[2] = {LOWEST, LOWEST};
    ints place[2] = {{0}}, here = (ints){0} + (int32_t)(first * width);
    int64_t position = first, left = e->pool;
    while (position < last) {
        /* The last block overlaps the one before it, so as to end with the window. */
        const int64_t start = many ? smaller(position, last - POSITIONS) : position;
        const int64_t stop = start + (many ? POSITIONS : 1);
        for (int64_t i = position * width; i < stop * width; i += 16) __builtin_prefetch(next + i);
        if (!many) convolve(e, x + start * width, pairs, bias, out, 1, wide);
        else if (wide == 1) convolve_one(e, x + start * width, pairs, bias, out);
        else convolve_two(e, x + start * width, pairs, bias, out);
        for (; position < stop; position++, here += (int32_t)width) {
            UNROLL for (int v = 0; v < wide; v++) {
                const longs both = (longs)out[position - start][v];
                const vec value = (vec)both + (vec)(both << 32 | both >> 32);
                /* The first of equals, and what is not a number, as in PyTorch. */
                const ints take = (value > best[v]) | (value != value);
                best[v] = (vec)((take & (ints)value) | (~take & (ints)best[v]));
                place[v] = (take & here) | (~take & place[v]);
            }
            if (--left) continue;
            left = e->pool;
            UNROLL for (int v = 0; v < wide; v++) {
                const vec low = SLOPE * best[v];
                const ints rising = best[v] > low;
                *(half *)(features + v * (LANES / 2)) = __builtin_convertvector(
                    (longs)((rising & (ints)best[v]) | (~rising & (ints)low)), half);
                *(half *)(places + v * (LANES / 2)) = __builtin_convertvector((longs)place[v], half);
                best[v] = LOWEST;
            }
            features += e->channels, places += e->channels;
        }
    }
}

/* Common widths as constants, whose multiples then need no registers. */
static void features_of(const Engine *e, const Scratch *s, const float *x, const float *next,
                        int64_t from, int64_t until, float *features, int32_t *places)
{
    for (int64_t c = 0; c < e->channels; c += LANES, features += LANES, places += LANES) {
        const float *pairs = s->pairs + 2 * c, *bias = s->pair_bias + 2 * c;
        if (e->channels - c < LANES) pool(e, x, next, pairs, bias, from, until, features, places, 1);
        else pool(e, x, next, pairs, bias, from, until, features, places, 2);
    }
}

/* sums (rows, hidden) += features (rows, n) times weights (hidden, n) transposed */
static void hidden_sums(const Engine *e, const float *features, const float *weights, int64_t n,
                        int64_t rows, float *sums)
{
    for (int64_t b = 0; b < rows; b += ROWS)
        for (int64_t j = 0; j < e->hidden; j += WIDE) {
            const float *x = features + b * e->features, *w = weights + j * e->features;
            vec sum[ROWS][WIDE] = {0};
            for (int64_t f = 0; f < n; f += LANES)
                UNROLL for (int i = 0; i < ROWS; i++)
                    UNROLL for (int k = 0; k < WIDE; k++)
                        sum[i][k] += load(x + i * e->features + f) * load(w + k * e->features + f);
            UNROLL for (int i = 0; i < ROWS; i++)
                UNROLL for (int k = 0; k < WIDE; k++)
                    sums[(b + i) * e->hidden + j + k] += total(sum[i][k]);
        }
}

/* a block of (ROWS, wide vectors) += sum over n of x times vector y; wide is a constant */
INLINE void outer(const float *x, int64_t x_row, int64_t x_step, const float *y, int64_t y_step,
                  int64_t n, float *to, int64_t to_row, int fresh, int wide)
{
    vec sum[ROWS][WIDE];
    UNROLL for (int i = 0; i < ROWS; i++)
        UNROLL for (int k = 0; k < wide; k++)
            sum[i][k] = fresh ? (vec){0} : load(to + i * to_row + k * LANES);
    for (int64_t s = 0; s < n; s++)
        UNROLL for (int i = 0; i < ROWS; i++)
            UNROLL for (int k = 0; k < wide; k++)
                sum[i][k] += x[i * x_row + s * x_step] * load(y + s * y_step + k * LANES);
    UNROLL for (int i = 0; i < ROWS; i++)
        UNROLL for (int k = 0; k < wide; k++) store(to + i * to_row + k * LANES, sum[i][k]);
}

/* to (rows, columns) = or += sum over n of x (rows, n; any strides) times y (n, columns) */
static void product(const float *x, int64_t x_row, int64_t x_step, const float *y, int64_t y_step,
                    int64_t n, float *to, int64_t to_row, int64_t rows, int64_t columns, int fresh)
{
    for (int64_t f = 0; f < columns; f += WIDE * LANES)
        for (int64_t r = 0; r < rows; r += ROWS) {
#define OUTER(wide) \
    outer(x + r * x_row, x_row, x_step, y + f, y_step, n, to + r * to_row + f, to_row, fresh, wide)
            switch (smaller(WIDE, (columns - f) / LANES)) {
            case 1: OUTER(1); break;
            case 2: OUTER(2); break;
#if WIDE > 2
            case 3: OUTER(3); break;
            case 4: OUTER(4); break;
#endif
            }
        }
}

/* Output layer and loss of one example, and the gradients from there to the hidden sums. */
static double head(const Engine *e, const Parameters *w, const Parameters *g, const float *target,
                   float scale, float *active, float *d_hidden)
{
    double loss = 0;
    for (int64_t j = 0; j < e->hidden; j++) {
        const float sum = active[j] + w->hidden_bias[j];
        active[j] = sum > 0 ? sum : SLOPE * sum;
        d_hidden[j] = 0;
    }
    for (int64_t o = 0; o < e->gyroscopes; o++) {
        const float *row = w->output + o * e->hidden;
        float *d_row = g->output + o * e->hidden;
        vec sum = {0};
        for (int64_t j = 0; j < e->hidden; j += LANES) sum += load(row + j) * load(active + j);
        const float miss = total(sum) + w->output_bias[o] - target[o], d = scale * miss;
        loss += (double)miss * miss;
        g->output_bias[o] += d;
        for (int64_t j = 0; j < e->hidden; j += LANES) {
            store(d_row + j, load(d_row + j) + d * load(active + j));
            store(d_hidden + j, load(d_hidden + j) + d * load(row + j));
        }
    }
    for (int64_t j = 0; j < e->hidden; j++) {
        d_hidden[j] *= active[j] > 0 ? 1 : SLOPE;
        g->hidden_bias[j] += d_hidden[j];
    }
    return loss;
}

/* gradient (wide vectors and perhaps eight) += sum over times of d times the window at the
 * maximum; returns the sum of d. Two sums each, as one would wait for itself. */
INLINE float weigh(const float *x, const float *d, const int32_t *places, int64_t step, int64_t n,
                   float *gradient, int wide, int rest)
{
    vec sums[2][MOST] = {0};
    eight last[2] = {0};
    float bias[2] = {0};
    for (int64_t t = 0; t < n; t += 2)
        UNROLL for (int i = 0; i < 2; i++) {
            if (i && t + 1 == n) break;
            const float scale = d[(t + i) * step], *at = x + places[(t + i) * step];
            UNROLL for (int v = 0; v < wide; v++) sums[i][v] += scale * load(at + v * LANES);
            if (rest) last[i] += scale * *(const eight_there *)(at + wide * LANES);
            bias[i] += scale;
        }
    UNROLL for (int v = 0; v < wide; v++)
        store(gradient + v * LANES, load(gradient + v * LANES) + (sums[0][v] + sums[1][v]));
    if (rest) *(eight_there *)(gradient + wide * LANES) += last[0] + last[1];
    return bias[0] + bias[1];
}

/* The convolution's gradient from n pooled times of one window. */
static void convolution_gradient(const Engine *e, const Parameters *g, const float *x,
                                 const float *d, const int32_t *places, int64_t n)
{
    for (int64_t c = 0; c < e->channels; c++, d++, places++) {
        float *to = g->convolution + c * e->span, bias = 0;
        for (int64_t k = 0, wide; k < e->span; k += wide) {
            const int64_t left = (e->span - k) / LANES, passes = (left + MOST - 1) / MOST;
            const int64_t now = passes > 1 ? (left + passes - 1) / passes : left;
            const int rest = passes < 2 && (e->span - k) % LANES;
            wide = now * LANES + (rest ? 8 : 0);
            switch (2 * now + rest) {
#define WEIGH(wide, rest) bias = weigh(x + k, d, places, e->channels, n, to + k, wide, rest)
#define CASES(wide) \
    case 2 * wide: WEIGH(wide, 0); break; \
    case 2 * wide + 1: WEIGH(wide, 1); break;
                CASES(0) CASES(1) CASES(2) CASES(3) CASES(4) CASES(5) CASES(6)
            }
        }
        g->convolution_bias[c] += bias;
    }
}

/* PyTorch's Adam with betas 0.9 and 0.999 and eps 1e-8. */
static void adam(int64_t n, float *restrict weight, float *restrict mean, float *restrict square,
                 const float *restrict gradient, float rate, float root)
{
    for (int64_t i = 0; i < n; i++) {
        const float g = gradient[i];
        mean[i] += 0.1f * (g - mean[i]);
        square[i] = 0.999f * square[i] + 0.001f * g * g;
        weight[i] -= rate * (mean[i] / (sqrtf(square[i]) * root + 1e-8f));
    }
}

typedef struct {
    float rate, root; /* Adam's at this step: corrected learning rate, 1 / sqrt(correction) */
    int64_t examples;
} Batch;

/* What is read after example b of a tile: the next example, or the next chunk, or the next tile. */
static const float *next_window(const Engine *e, const int64_t *order, int64_t n, int64_t b, int64_t from, int64_t until, int is_last)
{
    int64_t shift = 0;
    if (b + 1 < n) b++;
    else if (until < e->pooled) b = 0, shift = (until - from) * e->pool * e->width;
    else if (!is_last) b++, shift = -from * e->pool * e->width;
    return e->inputs + order[b] * e->blocks * e->width + shift;
}

/* Forward and backward for the examples of one tile. */
static double tile(const Engine *e, const int64_t *order, int64_t n, const Batch *batch, int is_first,
                   int is_last)
{
    const Scratch s = scratch(e);
    const Parameters w = parameters(e, e->weights), g = parameters(e, e->gradient);
    const int64_t window = e->blocks * e->width, rows = (n + ROWS - 1) / ROWS * ROWS;
    const int64_t d_row = e->chunk * e->channels + 16;
    for (int64_t i = 0; i < rows * e->hidden; i++) s.hidden[i] = s.d_hidden[i] = 0;
    for (int64_t from = 0; from < e->pooled; from += e->chunk) {
        const int64_t until = smaller(from + e->chunk, e->pooled), f = from * e->channels;
        const int64_t columns = (until < e->pooled ? until * e->channels : e->features) - f;
        for (int64_t b = 0; b < n; b++)
            features_of(e, &s, e->inputs + order[b] * window, next_window(e, order, n, b, from, until, is_last), from, until,
                        s.features + b * e->features + f, s.places + b * e->features + f);
        hidden_sums(e, s.features + f, w.hidden + f, columns, rows, s.hidden);
    }
    double loss = 0;
    for (int64_t b = 0; b < n; b++)
        loss += head(e, &w, &g, e->targets + order[b] * e->gyroscopes,
                     2.0f / (float)(batch->examples * e->gyroscopes), s.hidden + b * e->hidden,
                     s.d_hidden + b * e->hidden);
    /* Backward in time: the last chunk is still in the caches. */
    for (int64_t from = (e->pooled - 1) / e->chunk * e->chunk; from >= 0; from -= e->chunk) {
        const int64_t until = smaller(from + e->chunk, e->pooled), f = from * e->channels;
        const int64_t columns = (until < e->pooled ? until * e->channels : e->features) - f;
        product(s.d_hidden, e->hidden, 1, w.hidden + f, e->features, e->hidden, s.d_features,
                d_row, rows, columns, 1);
        product(s.d_hidden, 1, e->hidden, s.features + f, e->features, rows, g.hidden + f,
                e->features, e->hidden, columns, is_first);
        for (int64_t b = 0; b < n; b++) {
            float *d = s.d_features + b * d_row;
            const float *active = s.features + b * e->features + f;
            for (int64_t i = 0; i < columns; i++) d[i] *= active[i] > 0 ? 1 : SLOPE;
            convolution_gradient(e, &g, e->inputs + order[b] * window, d,
                                 s.places + b * e->features + f, until - from);
        }
        for (int64_t j = 0; is_last && j < e->hidden; j++) {
            const int64_t at = j * e->features + f;
            adam(columns, e->weights + at, e->mean + at, e->square + at, e->gradient + at,
                 batch->rate, batch->root);
        }
    }
    return loss;
}

/* Train on the examples in this order in batches of at most the planned size; `steps` were made
 * before. Returns the sum of squared errors, each as it was before its batch's step. */
double fused_epoch(const Engine *e, const int64_t *order, int64_t n, int64_t batch_size,
                   int64_t steps, double learning_rate)
{
    const Scratch s = scratch(e);
    const Parameters g = parameters(e, e->gradient);
    const int64_t rest = g.hidden_bias - g.hidden, others = g.end - g.hidden_bias;
    double loss = 0;
    for (int64_t done = 0; done < n; done += batch_size) {
        const int64_t size = smaller(batch_size, n - done);
        steps++;
        const Batch batch = {(float)(learning_rate / (1 - pow(0.9, (double)steps))),
                             (float)(1 / sqrt(1 - pow(0.999, (double)steps))), size};
        pair_up(e, &s);
        for (int64_t i = 0; i < others; i++) g.hidden_bias[i] = 0;
        for (int64_t at = 0; at < size; at += e->tile)
            loss += tile(e, order + done + at, smaller(e->tile, size - at), &batch, at == 0,
                         at + e->tile >= size);
        for (int64_t c = 0; c < e->channels; c++)
            for (int64_t k = 0; k < e->span; k++) g.convolution[c * e->span + k] *= e->seen[k];
        adam(others, e->weights + rest, e->mean + rest, e->square + rest, e->gradient + rest,
             batch.rate, batch.root);
    }
    return loss;
}
