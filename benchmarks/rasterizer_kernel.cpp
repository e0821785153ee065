// The CPU engine's loops in C++, serial: what a compiler makes of the same work. `benchmarks/rasterizer.py` compiles it
// on the spot and calls it through ctypes. Tiles are 16x16; everything is float. As in the engine, cells of 4x4 pixels are
// one vector each; only those are visited that a splat reaches and that have light left, and a tile is left once dark.
//
// Columns of `geometry` and of the blocks are those of `foldgauss/render/_cpu_kernels.py`:
// alpha = 2^(LOG - (P dx + Q dy)^2 - (R dy)^2), drawn where the exponent is at least LEAST.

#include <algorithm>
#include <cmath>
#include <cstdint>

namespace {

constexpr int TILE = 16, CELL = 4, CELLS = 4, BLOCK = 64, COLUMNS = 8, CHANNELS = 3;
enum { X, Y, P, Q, R, LOG, LEAST, TURN };

typedef float Row __attribute__((vector_size(64)));  // 16 pixels; g++ splits it where registers are narrower
typedef int32_t Whole __attribute__((vector_size(64)));
const Row CELL_X = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
const Row CELL_Y = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};

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

    // From cells to rows of pixels.
    void turn() {
        for (int plane = 0; plane <= CHANNELS; ++plane) {
            Row *own = plane ? color[plane - 1] : light, cells[TILE];
            std::copy_n(own, TILE, cells);
            for (int y = 0; y < TILE; ++y)
                for (int x = 0; x < TILE; ++x) own[y][x] = cells[y / CELL * CELLS + x / CELL][y % CELL * CELL + x % CELL];
        }
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

// One vector of pixels of one splat: its share of the light, and its colours.
inline void blend_pixels(Row power, float least, const float *own, float ceiling, float finished, Row &light, Row *color) {
    Row alpha = power_of_two(power);
    alpha = alpha < ceiling ? alpha : Row{} + ceiling;
    alpha = power >= least ? alpha : Row{};
    const Row weight = alpha * (light > finished ? light : Row{});
    light -= weight;
    for (int c = 0; c < CHANNELS; ++c) color[c] += weight * own[c * BLOCK];
}

// Right edge of the ellipse (p dx + q dy)^2 + (r dy)^2 = level on the line dy.
inline float edge(float p, float q, float r, float level, float dy) {
    return (std::sqrt(std::max(level - r * dy * r * dy, 0.0f)) - q * dy) / p;
}

// Cells first <= k < end of every band of cells that the ellipses reach; see `_cells_of` of the engine.
void cells_of(int num, const float *block, int *first, int *end) {
    for (int band = 0; band < CELLS; ++band) {
        const float upper = band * CELL, lower = upper + CELL - 1;
        for (int e = 0; e < num; ++e) {
            const float x = block[X * BLOCK + e], y = block[Y * BLOCK + e], turn = block[TURN * BLOCK + e];
            const float p = block[P * BLOCK + e], q = block[Q * BLOCK + e], r = block[R * BLOCK + e];
            const float level = (block[LOG * BLOCK + e] - block[LEAST * BLOCK + e]) * 1.001f + 1e-3f;
            const float on_right = std::min(std::max(turn, upper - y), lower - y);
            const float on_left = std::min(std::max(-turn, upper - y), lower - y);
            const float left = x - edge(p, -q, r, level, on_left), right = x + edge(p, q, r, level, on_right);
            const float low = std::min(std::max(left, 0.0f), float(TILE));
            const float high = std::min(std::max(right, -1.0f), float(TILE - 1));
            int column = static_cast<int>(low);
            column += column < low;
            const int stop = static_cast<int>(high + 1.0f);
            const bool reached = (stop > column) & (r * on_right * r * on_right <= level);
            first[band * BLOCK + e] = column / CELL;
            end[band * BLOCK + e] = reached ? (stop + CELL - 1) / CELL : 0;
        }
    }
}

// As the engine: a cell after another, its light and colours in registers, the splats that reach it in turn.
void blend_block(int num, const float *block, const int *first, const int *end, float ceiling, float finished,
                 Tile &tile) {
    for (int cell = 0; cell < CELLS * CELLS; ++cell) {
        alignas(64) float shear[BLOCK], rise[BLOCK];
        const int band = cell / CELLS, column = cell % CELLS;
        uint64_t left = 0;
        for (int e = 0; e < num; ++e)
            left |= uint64_t((first[band * BLOCK + e] <= column) & (column < end[band * BLOCK + e])) << e;
        if (!left || all_dark(tile.light[cell], finished)) continue;
        for (int e = 0; e < num; ++e) {
            const float dx = column * CELL - block[X * BLOCK + e], dy = band * CELL - block[Y * BLOCK + e];
            shear[e] = block[P * BLOCK + e] * dx + block[Q * BLOCK + e] * dy;
            rise[e] = block[R * BLOCK + e] * dy;
        }
        Row light = tile.light[cell], color[CHANNELS];
        for (int c = 0; c < CHANNELS; ++c) color[c] = tile.color[c][cell];
        for (; left; left &= left - 1) {
            const int e = __builtin_ctzll(left);
            const Row across = block[P * BLOCK + e] * CELL_X + (block[Q * BLOCK + e] * CELL_Y + shear[e]);
            const Row along = block[R * BLOCK + e] * CELL_Y + rise[e];
            const Row power = block[LOG * BLOCK + e] - along * along - across * across;
            blend_pixels(power, block[LEAST * BLOCK + e], block + COLUMNS * BLOCK + e, ceiling, finished, light, color);
        }
        tile.light[cell] = light;
        for (int c = 0; c < CHANNELS; ++c) tile.color[c][cell] = color[c];
    }
}

}  // namespace

extern "C" {

// Tiles row by row; tile t lists splats listed[start[t]] .. listed[start[t + 1]], front to back.
void exact(int height, int width, const int64_t *start, const int32_t *listed, const float *geometry,
           const float *colors, const float *background, float ceiling, float finished, float *image, float *light) {
    const int across = (width + TILE - 1) / TILE, down = (height + TILE - 1) / TILE;
    Tile tile;
    alignas(64) float block[(COLUMNS + CHANNELS) * BLOCK];
    alignas(64) int first[CELLS * BLOCK], end[CELLS * BLOCK];
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
                for (int j = P; j < COLUMNS; ++j) block[j * BLOCK + e] = own[j];
                for (int c = 0; c < CHANNELS; ++c) block[(COLUMNS + c) * BLOCK + e] = rgb[c];
            }
            cells_of(num, block, first, end);
            blend_block(num, block, first, end, ceiling, finished, tile);
        }
        tile.turn();
        tile.write(background, image, light, top, left, height, width);
    }
}
}
