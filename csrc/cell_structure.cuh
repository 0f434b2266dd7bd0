// SSIM with each 4x4 cell of a tile as a window of its own. The warp goes through the cells that have samples, one after the
// other, in the three passes of a tile: there are few, as a sampler that draws whole cells takes as many of a tile as it takes
// 16 pixels.
#pragma once

#include "lane_samples.cuh"
#include "tile_similarity.cuh"
#include "warp.cuh"

namespace turbogs {

constexpr int kCellSide = 4;

// The cell of its tile that a pixel lies in, 0 .. 15.
__device__ __forceinline__ int cell_of(const SampleView& view, int pixel) {
    const int y = pixel / view.width, x = pixel - y * view.width;
    return (y & (kTileSize - 1)) / kCellSide * (kTileSize / kCellSide) + (x & (kTileSize - 1)) / kCellSide;
}

// The structure term with each cell as a window, added to the gradients of a tile: their first part is in memory. Returns
// what the tile adds to the loss. As below, more than 32 kSlots samples are loaded again in each pass.
template <int kSlots>
__device__ __forceinline__ float cell_structure(const SparseLossParams& params, const SampleView& view, int first, int end,
                                                LaneSamples<kSlots>& samples) {
    constexpr int kRound = 32 * kSlots;
    const int lane = threadIdx.x & 31;
    const bool resident = end - first <= kRound;
    int cells[kSlots];
    const auto load_again = [&](int start) {
        int counted = 0;
        if (!resident) load_samples(params, view, start, end, samples, counted);
#pragma unroll
        for (int j = 0; j < kSlots; ++j) cells[j] = samples.weight[j] > 0.0f ? cell_of(view, samples.pixel[j]) : -1;
    };
    uint32_t present = 0u;
    for (int start = first; start < end; start += kRound) {
        load_again(start);
#pragma unroll
        for (int j = 0; j < kSlots; ++j) present |= cells[j] >= 0 ? 1u << cells[j] : 0u;
    }
    present = __reduce_or_sync(kFullWarp, present);
    const float scale =
        params.structure_weight / (3.0f * static_cast<float>(params.num_tiles) * static_cast<float>(max(__popc(present), 1)));

    float tile_sum = 0.0f;
    for (; present != 0u; present &= present - 1u) {
        const int cell = __ffs(static_cast<int>(present)) - 1;
        WindowMeans means;
        float inverse_total;
        {
            bool found = false;
            float sums[8] = {};  // offsets of x 0-2 and y 3-5, weights
            for (int start = first; start < end; start += kRound) {
                if (!resident) load_again(start);
#pragma unroll
                for (int j = 0; j < kSlots; ++j) {
                    const bool mine = cells[j] == cell;
                    const uint32_t lanes = __ballot_sync(kFullWarp, mine);
                    if (!found && lanes != 0u) {
                        found = true;
                        means.start(samples, j, __ffs(static_cast<int>(lanes)) - 1);
                    }
                    const float weight = mine ? samples.weight[j] : 0.0f;
#pragma unroll
                    for (int c = 0; c < 3; ++c) {
                        sums[c] += weight * (samples.x[j][c] - means.first_x[c]);
                        sums[3 + c] += weight * (samples.y[j][c] - means.first_y[c]);
                    }
                    sums[6] += weight;
                }
            }
            warp_sums(sums);
            inverse_total = 1.0f / sums[6];
            means.finish(sums, inverse_total);
        }
        SecondMoments moments;
        for (int start = first; start < end; start += kRound) {
            if (!resident) load_again(start);
#pragma unroll
            for (int j = 0; j < kSlots; ++j) moments.add(samples, means, j, cells[j] == cell ? samples.weight[j] : 0.0f);
        }
        moments.sum_over_warp();
        Similarity similarity[3];
#pragma unroll
        for (int c = 0; c < 3; ++c) {
            similarity[c] = ssim(means.mean_x[c] + means.first_x[c], means.mean_y[c] + means.first_y[c],
                                 moments.xx(c) * inverse_total, moments.yy(c) * inverse_total, moments.xy(c) * inverse_total);
            tile_sum += scale * (1.0f - similarity[c].value);
        }
        for (int start = first; start < end; start += kRound) {
            if (!resident) load_again(start);
#pragma unroll
            for (int j = 0; j < kSlots; ++j) {
                if (cells[j] != cell) continue;
                float* gradient = params.color_gradients + 3 * static_cast<size_t>(start + 32 * j + lane);
#pragma unroll
                for (int c = 0; c < 3; ++c) {
                    gradient[c] -= samples.weight[j] * (scale * inverse_total) *
                                   slope(similarity[c], means.offset_x(samples, j, c), means.offset_y(samples, j, c));
                }
            }
        }
    }
    return tile_sum;
}

}  // namespace turbogs
