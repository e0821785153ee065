// The CPU engine's loops in C++, serial: what a compiler makes of the same work. `benchmarks/rasterizer.py` compiles it
// on the spot and calls it through ctypes. Tiles are 16x16, a row of a tile is one AVX-512 vector; everything is float.
//
//   plain  every pixel of every listed pair, the textbook loop: no tile is left early, no pixel row is skipped
//   exact  what the engine does with the same lists: only the pixel rows that a splat reaches and that have light left,
//          a tile left once dark
//
// Columns of `geometry` and of the blocks are those of `foldgauss/render/_cpu_kernels.py`:
// alpha = 2^(LOG - (P dx + Q dy)^2 - (R dy)^2), drawn where the exponent is at least LEAST.

#include <algorithm>
#include <cmath>
#include <cstdint>

namespace {

constexpr int TILE = 16, BLOCK = 64, COLUMNS = 8, CHANNELS = 3;
enum { X, Y, P, Q, R, LOG, LEAST };

typedef float Row __attribute__((vector_size(64)));  // 16 pixels; g++ splits it where registers are narrower
typedef int32_t Whole __attribute__((vector_size(64)));
const Row COLUMN = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

// 2^x for -126 < x <= 0, as the engine.
inline Row power_of_two(Row x) {
    const Whole whole = __builtin_convertvector(x - 0.5f, Whole);
    const Row part = x - __builtin_convertvector(whole, Row);
    Row y = 1.3264727e-3f * part + 9.671513e-3f;
    y = y * part + 5.5507336e-2f;
    y = y * part + 0.24022242f;
    y = y * part + 0.693147f;
    y = y * part + 1.0f;
    return reinterpret_cast<Row>(reinterpret_cast<Whole>(y) + (whole << 23));
}

inline bool all_dark(Row light, float finished) {
    const Whole lit = light > finished;
    int any = 0;
    for (int x = 0; x < TILE; ++x) any |= lit[x];
    return !any;
}

struct Tile {
    Row light[TILE], color[CHANNELS][TILE];

    void clear() {
        std::fill_n(light, TILE, Row{} + 1.0f);
        std::fill_n(&color[0][0], CHANNELS * TILE, Row{});
    }

    bool dark(float finished) const {
        Row most = light[0];
        for (int y = 1; y < TILE; ++y) most = most > light[y] ? most : light[y];
        return all_dark(most, finished);
    }

    void write(const float *background, float *image, float *out, int top, int left, int height, int width) const {
        for (int y = 0; y < std::min(TILE, height - top); ++y)
            for (int x = 0; x < std::min(TILE, width - left); ++x) {
                const int64_t at = int64_t(top + y) * width + left + x;
                out[at] = light[y][x];
                for (int c = 0; c < CHANNELS; ++c)
                    image[int64_t(c) * height * width + at] = color[c][y][x] + light[y][x] * background[c];
            }
    }
};

// One row of pixels of one splat: its share of the light, and its colours.
inline void blend_row(float p, float shear, float drop, float least, const float *own, int stride, float ceiling,
                      float finished, Row &light, Row *color, int step) {
    const Row across = p * COLUMN + shear, power = drop - across * across;
    Row alpha = power_of_two(power);
    alpha = alpha < ceiling ? alpha : Row{} + ceiling;
    alpha = power >= least ? alpha : Row{};
    const Row weight = alpha * (light > finished ? light : Row{});
    light -= weight;
    for (int c = 0; c < CHANNELS; ++c) color[c * step] += weight * own[c * stride];
}

// Pixel rows first <= row < last of a tile that the ellipse reaches; see `_pixel_rows` of the engine.
inline void pixel_rows(float x, float y, float p, float q, float r, float level, int &first, int &last) {
    const float square = q * q + r * r, inverse = 1.0f / square, shear = p * q;
    const float turn = -q * std::sqrt(level) / (p * r), left = -x, right = TILE - 1 - x;
    const float above = std::min(std::max(turn, left), right), below = std::min(std::max(-turn, left), right);
    const float half_above = std::sqrt(std::max(square * level - (p * r * above) * (p * r * above), 0.0f));
    const float half_below = std::sqrt(std::max(square * level - (p * r * below) * (p * r * below), 0.0f));
    const float low = std::min(std::max(y - (shear * below + half_below) * inverse, 0.0f), float(TILE));
    const float high = std::min(std::max(y - (shear * above - half_above) * inverse, -1.0f), float(TILE - 1));
    first = static_cast<int>(low);
    first += first < low;
    last = std::max(static_cast<int>(high + 1.0f), first);
}

// As the engine: a row of pixels after another, its light and colours in registers, the splats that reach it in turn.
void blend_block(int num, const float *block, const int *first, const int *last, float ceiling, float finished,
                 Tile &tile) {
    for (int row = 0; row < TILE; ++row) {
        alignas(64) float shear[BLOCK], drop[BLOCK];
        uint64_t left = 0;
        for (int e = 0; e < num; ++e) {
            left |= uint64_t((first[e] <= row) & (row < last[e])) << e;
            const float dy = row - block[Y * BLOCK + e], along = block[R * BLOCK + e] * dy;
            shear[e] = block[Q * BLOCK + e] * dy - block[P * BLOCK + e] * block[X * BLOCK + e];
            drop[e] = block[LOG * BLOCK + e] - along * along;
        }
        if (!left || all_dark(tile.light[row], finished)) continue;
        Row light = tile.light[row], color[CHANNELS];
        for (int c = 0; c < CHANNELS; ++c) color[c] = tile.color[c][row];
        for (; left; left &= left - 1) {
            const int e = __builtin_ctzll(left);
            blend_row(block[P * BLOCK + e], shear[e], drop[e], block[LEAST * BLOCK + e], block + 7 * BLOCK + e, BLOCK,
                      ceiling, finished, light, color, 1);
        }
        tile.light[row] = light;
        for (int c = 0; c < CHANNELS; ++c) tile.color[c][row] = color[c];
    }
}

}  // namespace

extern "C" {

// Tiles row by row; tile t lists splats listed[start[t]] .. listed[start[t + 1]], front to back.
void plain(int height, int width, const int64_t *start, const int32_t *listed, const float *geometry,
           const float *colors, const float *background, float ceiling, float finished, float *image, float *light) {
    const int across = (width + TILE - 1) / TILE, down = (height + TILE - 1) / TILE;
    Tile tile;
    for (int t = 0; t < across * down; ++t) {
        const int left = t % across * TILE, top = t / across * TILE;
        tile.clear();
        for (int64_t k = start[t]; k < start[t + 1]; ++k) {
            const float *own = geometry + int64_t(listed[k]) * COLUMNS, *rgb = colors + int64_t(listed[k]) * CHANNELS;
            const float x = own[X] - left - 0.5f, y = own[Y] - top - 0.5f;
            const float p = own[P], q = own[Q], r = own[R], log = own[LOG], least = own[LEAST];
            for (int row = 0; row < TILE; ++row) {
                const float dy = row - y;
                blend_row(p, q * dy - p * x, log - r * dy * r * dy, least, rgb, 1, ceiling, finished, tile.light[row],
                          &tile.color[0][row], TILE);
            }
        }
        tile.write(background, image, light, top, left, height, width);
    }
}

void exact(int height, int width, const int64_t *start, const int32_t *listed, const float *geometry,
           const float *colors, const float *background, float ceiling, float finished, float *image, float *light) {
    const int across = (width + TILE - 1) / TILE, down = (height + TILE - 1) / TILE;
    Tile tile;
    alignas(64) float block[(7 + CHANNELS) * BLOCK];
    alignas(64) int first[BLOCK], last[BLOCK];
    for (int t = 0; t < across * down; ++t) {
        const int left = t % across * TILE, top = t / across * TILE;
        tile.clear();
        for (int64_t k = start[t]; k < start[t + 1]; k += BLOCK) {
            if (k > start[t] && tile.dark(finished)) break;
            const int num = static_cast<int>(std::min<int64_t>(BLOCK, start[t + 1] - k));
            for (int e = 0; e < num; ++e) {
                const float *own = geometry + int64_t(listed[k + e]) * COLUMNS;
                const float *rgb = colors + int64_t(listed[k + e]) * CHANNELS;
                block[X * BLOCK + e] = own[X] - left - 0.5f;
                block[Y * BLOCK + e] = own[Y] - top - 0.5f;
                for (int j = P; j <= LEAST; ++j) block[j * BLOCK + e] = own[j];
                for (int c = 0; c < CHANNELS; ++c) block[(7 + c) * BLOCK + e] = rgb[c];
            }
            for (int e = 0; e < num; ++e) {
                const float level = (block[LOG * BLOCK + e] - block[LEAST * BLOCK + e]) * 1.001f + 1e-3f;
                pixel_rows(block[X * BLOCK + e], block[Y * BLOCK + e], block[P * BLOCK + e], block[Q * BLOCK + e],
                           block[R * BLOCK + e], level, first[e], last[e]);
            }
            blend_block(num, block, first, last, ceiling, finished, tile);
        }
        tile.write(background, image, light, top, left, height, width);
    }
}
}
