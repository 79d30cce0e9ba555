/* fused.c on float32 samples. */

typedef uint64_t pair_there IN_MEMORY;

#define POSITIONS (2 * WIDE)

INLINE vec samples(const float *from) { return load(from); }

static int begin(void) { return 1; }
static void end(void) {}

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
