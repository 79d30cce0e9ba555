/* fused.c on bfloat16 samples, for processors that multiply them. */
#if !defined(__AVX512BF16__)
#error this processor has no products of bfloat16
#endif

typedef int32_t pair_there IN_MEMORY;

#define POSITIONS 16

/* Each of 16 in the upper half of a float. */
INLINE vec samples(const sample *from)
{
    const __m512i halves = _mm512_castsi256_si512(_mm256_loadu_si256((const __m256i *)from));
    const ints upper = {0, 1 << 16, 2 << 16, 3 << 16, 4 << 16, 5 << 16, 6 << 16, 7 << 16, 8 << 16,
                        9 << 16, 10 << 16, 11 << 16, 12 << 16, 13 << 16, 14 << 16, 15 << 16};
    return (vec)_mm512_maskz_permutexvar_epi16(0xaaaaaaaa, (__m512i)upper, halves);
}

INLINE half_there half(vec value) { return *(const half_there *)&value; }

/* To the nearest, of two as near to the even one, as in PyTorch. */
static sample rounded(float value)
{
    const union { float number; uint32_t bits; } all = {value};
    return (sample)((all.bits + 0x7fff + (all.bits >> 16 & 1)) >> 16);
}

/* Pairs of taps side by side, channel by channel. */
static void arrange(const Engine *e)
{
    for (int64_t c = 0; c < e->channels; c++) {
        e->biases[c] = e->convolution_bias[c];
        for (int64_t k = 0; k < e->span; k++)
            e->kernels[k / 2 * e->kernel_row + 2 * c + k % 2] =
                rounded(e->convolution_weight[c * e->span + k]);
    }
}

/* Outputs of `count` successive positions for a vector of channels. */
INLINE void convolve(const Engine *e, const sample *x, int64_t channel, vec *out, int count, int full)
{
    (void)full;
    vec sums[POSITIONS];
    EACH(p, count) sums[p] = load(e->biases + channel);
    for (int64_t k = 0; k < e->span; k += 2) {
        const sample *kernels = e->kernels + k / 2 * e->kernel_row + 2 * channel;
        const __m512bh weights = (__m512bh)load((const float *)kernels);
        EACH(p, count) {
            const ints taps = *(const pair_there *)(x + p * e->width + k) + (ints){0};
            sums[p] = (vec)_mm512_dpbf16_ps((__m512)sums[p], weights, (__m512bh)taps);
        }
    }
    EACH(p, count) out[p] = sums[p];
}

#if defined(__AMX_BF16__) && defined(__linux__)
#include <sys/syscall.h>
#include <unistd.h>

/* Tiles 1 and 2 hold 32 taps of 16 positions and of 16 channels, 3 and 4 half as many. */
static int begin(void)
{
    const struct { uint8_t palette, start, zero[14]; uint16_t bytes[16]; uint8_t rows[16]; } tiles =
        {.palette = 1, .bytes = {64, 64, 64, 32, 64}, .rows = {16, 16, 16, 16, 8}};
    if (syscall(SYS_arch_prctl, 0x1023 /* ask for */, 18 /* tile data */)) return 0;
    _tile_loadconfig(&tiles);
    return 1;
}

static void end(void) { _tile_release(); }

static void convolve_block(const Engine *e, const sample *x, int64_t channel, vec *out, int full)
{
    const sample *kernels = e->kernels + 2 * channel;
    const int64_t row = 2 * e->kernel_row, width = 2 * e->width; /* bytes */
    int64_t k = 0;
    (void)full;
    _tile_loadd(0, e->biases + channel, 0);
    for (; k + 32 <= e->span; k += 32, kernels += 16 * e->kernel_row) {
        _tile_loadd(1, x + k, width);
        _tile_loadd(2, kernels, row);
        _tile_dpbf16ps(0, 1, 2);
    }
    if (k < e->span) {
        _tile_loadd(3, x + k, width);
        _tile_loadd(4, kernels, row);
        _tile_dpbf16ps(0, 3, 4);
    }
    _tile_stored(0, out, sizeof *out);
}

#else

static int begin(void) { return 1; }
static void end(void) {}

__attribute__((noinline)) static void convolve_block(const Engine *e, const sample *x,
                                                     int64_t channel, vec *out, int full)
{
    convolve(e, x, channel, out, POSITIONS, full);
}

#endif
