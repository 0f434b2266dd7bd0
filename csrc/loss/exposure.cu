// Exposures: rendered colours through the affine map of their photo, the gradients of both, and a step of Adam.
// Defined by turbogs_plugin/engine/exposures.py.
//
// The samples of a tile are of one view. Forward a warp takes a tile. Backward it takes kWarpTiles tiles one after the
// other and adds up in registers, so that few atomics are left. The step is one block: a warp for each of the 12
// numbers of a map, so that the mean over all photos needs no second launch.
#include "common/approximate_math.cuh"
#include "common/warp.cuh"
#include "loss/loss_params.h"

namespace turbogs {
namespace {

constexpr int kExposureThreads = 128;  // of a block; both not measured yet
constexpr int kExposureWarps = kExposureThreads / kWarpSize;
constexpr int kWarpTiles = 8;
constexpr double kSumGrid = 1099511627776.0;  // 2^40: sums below 2^13 of such multiples are exact in any order
constexpr int kStepThreads = kExposureNumbers * kWarpSize;

// A | b of one photo, row by row.
struct ColorMap {
    float values[3][4];
};

__device__ __forceinline__ ColorMap load_map(const ExposedSamples& params, int view) {
    const float* offsets = params.offsets + kExposureNumbers * static_cast<size_t>(params.views[view].view_number);
    ColorMap map;
#pragma unroll
    for (int i = 0; i < kExposureNumbers; ++i) map.values[i / 4][i % 4] = offsets[i];
    return map;
}

__global__ void __launch_bounds__(kExposureThreads)
    expose_colors_kernel(const __grid_constant__ ExposeColorsParams params) {
    const int tile = blockIdx.x * kExposureWarps + this_warp();
    if (tile >= params.num_tiles) return;
    const ColorMap map = load_map(params, view_of_tile(params.views, params.num_views, params.tile_ids[tile]));
    const int end = params.tile_offsets[tile + 1];
    for (int slot = params.tile_offsets[tile] + this_lane(); slot < end; slot += kWarpSize) {
        const float* color = params.colors + 3 * static_cast<size_t>(slot);
        const float x[3] = {color[0], color[1], color[2]};
#pragma unroll
        for (int i = 0; i < 3; ++i) {
            const float* row = map.values[i];
            params.exposed[3 * static_cast<size_t>(slot) + i] =
                x[i] + (row[0] * x[0] + row[1] * x[1] + row[2] * x[2] + row[3]);
        }
    }
}

// Adds the sums of all lanes to the view's sums, and clears them.
__device__ __forceinline__ void flush(const ExposureBackwardParams& params, int view, float (&sums)[kExposureNumbers]) {
    float mine = 0.0f;
#pragma unroll
    for (int i = 0; i < kExposureNumbers; ++i) {
        const float total = warp_sum(sums[i]);
        if (this_lane() == i) mine = total;
        sums[i] = 0.0f;
    }
    if (this_lane() < kExposureNumbers && mine != 0.0f) {
        const double rounded = rint(static_cast<double>(mine) * kSumGrid) / kSumGrid;
        atomicAdd(params.sums + kExposureNumbers * view + this_lane(), rounded);
    }
}

__global__ void __launch_bounds__(kExposureThreads)
    exposure_backward_kernel(const __grid_constant__ ExposureBackwardParams params) {
    const int first_tile = (blockIdx.x * kExposureWarps + this_warp()) * kWarpTiles;
    const int end_tile = min(first_tile + kWarpTiles, params.num_tiles);
    if (first_tile >= end_tile) return;
    float sums[kExposureNumbers] = {};
    ColorMap map = {};
    int view = -1;
    for (int tile = first_tile; tile < end_tile; ++tile) {
        const int view_of_this = view_of_tile(params.views, params.num_views, params.tile_ids[tile]);
        if (view_of_this != view) {
            if (view >= 0) flush(params, view, sums);
            view = view_of_this;
            map = load_map(params, view);
        }
        const int end = params.tile_offsets[tile + 1];
        for (int slot = params.tile_offsets[tile] + this_lane(); slot < end; slot += kWarpSize) {
            const float* color = params.colors + 3 * static_cast<size_t>(slot);
            float* gradient = params.gradients + 3 * static_cast<size_t>(slot);
            const float x[3] = {color[0], color[1], color[2]};
            const float g[3] = {gradient[0], gradient[1], gradient[2]};
#pragma unroll
            for (int j = 0; j < 3; ++j) {
                gradient[j] = g[j] + (map.values[0][j] * g[0] + map.values[1][j] * g[1] + map.values[2][j] * g[2]);
            }
            if (!(is_finite(x[0]) && is_finite(x[1]) && is_finite(x[2]))) continue;
#pragma unroll
            for (int i = 0; i < 3; ++i) {
#pragma unroll
                for (int j = 0; j < 3; ++j) sums[4 * i + j] += g[i] * x[j];
                sums[4 * i + 3] += g[i];
            }
        }
    }
    flush(params, view, sums);
}

__global__ void __launch_bounds__(kStepThreads)
    exposure_step_kernel(const __grid_constant__ ExposureStepParams params) {
    __shared__ bool usable[kMaxViews];
    if (params.overflow != nullptr && *params.overflow != 0) return;
    const int number = this_warp(), lane = this_lane();
    bool any = false;
    for (int k = threadIdx.x; k < params.num_views; k += kStepThreads) {
        usable[k] = true;
        const size_t photo = kExposureNumbers * static_cast<size_t>(params.views[k].view_number);
        for (int i = 0; i < kExposureNumbers; ++i) {
            const float pulled = params.pull / static_cast<float>(params.num_views) * params.offsets[photo + i];
            usable[k] = usable[k] && is_finite(static_cast<float>(params.sums[kExposureNumbers * k + i]) + pulled);
        }
    }
    __syncthreads();
    for (int k = 0; k < params.num_views; ++k) any = any || usable[k];
    if (!any) return;
    for (int k = lane; k < params.num_views; k += kWarpSize) {
        if (!usable[k]) continue;
        const int photo = params.views[k].view_number;
        const size_t place = kExposureNumbers * static_cast<size_t>(photo) + number;
        // Rounded once: the difference of the floats is off by 1.3e-5 at 0.999.
        const float of_gradient = static_cast<float>(1.0 - params.beta1);
        const float of_square = static_cast<float>(1.0 - params.beta2);
        const float offset = params.offsets[place];
        const float gradient = static_cast<float>(params.sums[kExposureNumbers * k + number]) +
                               params.pull / static_cast<float>(params.num_views) * offset;
        const float first = params.exp_avg[place] + of_gradient * (gradient - params.exp_avg[place]);
        const float second =
            params.exp_avg_sq[place] + of_square * (gradient * gradient - params.exp_avg_sq[place]);
        const double steps = static_cast<double>(params.steps[photo] + 1);
        const float correction1 = static_cast<float>(1.0 - pow(params.beta1, steps));
        const float correction2 = static_cast<float>(1.0 - pow(params.beta2, steps));
        params.exp_avg[place] = first;
        params.exp_avg_sq[place] = second;
        params.offsets[place] =
            offset - params.rate * (first / correction1) / (sqrtf(second / correction2) + params.eps);
    }
    __syncthreads();  // counts have been read by all warps, and this warp's offsets written by its lanes
    for (int k = threadIdx.x; k < params.num_views; k += kStepThreads) {
        if (usable[k]) params.steps[params.views[k].view_number] += 1;
    }
    double sum = 0.0;
    for (int photo = lane; photo < params.num_photos; photo += kWarpSize) {
        sum += static_cast<double>(params.offsets[kExposureNumbers * static_cast<size_t>(photo) + number]);
    }
    const float mean = static_cast<float>(warp_sum(sum) / static_cast<double>(params.num_photos));
    for (int photo = lane; photo < params.num_photos; photo += kWarpSize) {
        params.offsets[kExposureNumbers * static_cast<size_t>(photo) + number] -= mean;
    }
}

}  // namespace

void launch_expose_colors(const ExposeColorsParams& params, cudaStream_t stream) {
    if (params.num_tiles == 0) return;
    expose_colors_kernel<<<blocks_for(params.num_tiles, kExposureWarps), kExposureThreads, 0, stream>>>(params);
}

void launch_exposure_backward(const ExposureBackwardParams& params, cudaStream_t stream) {
    if (params.num_tiles == 0) return;
    const int blocks = blocks_for(params.num_tiles, kExposureWarps * kWarpTiles);
    exposure_backward_kernel<<<blocks, kExposureThreads, 0, stream>>>(params);
}

void launch_exposure_step(const ExposureStepParams& params, cudaStream_t stream) {
    exposure_step_kernel<<<1, kStepThreads, 0, stream>>>(params);
}

}  // namespace turbogs
