// Loss, its gradient and the update of the error maps, a warp per tile.
//
// A lane keeps up to 8 of its tile's samples in registers: colour and truth are read once, the tile's moments are warp
// sums in two passes about its first sample (a constant tile has variance 0 exactly), and the gradient is written in the
// third. Warps take consecutive runs of tiles, so that the loss and the sums of the views meet in few atomics; the sums
// of the views are of half-precision numbers in double, exact in any order.
#include <cfloat>

#include <cuda_fp16.h>

#include "training_params.h"

namespace turbogs {
namespace {

constexpr uint32_t kFull = 0xFFFFFFFFu;
constexpr int kLossThreads = 128;
constexpr int kLossWarps = kLossThreads / 32;
constexpr int kMaxBlocks = 2048;
constexpr int kFewSlots = 64;  // of a tile with few samples
constexpr float kBalanceEpsilon = 1e-8f;
constexpr float kLuminanceConstant = 1e-4f;  // 0.01^2
constexpr float kSsimConstant = 9e-4f;       // 0.03^2
constexpr float kErrorMax = 65504.0f;        // largest finite half

__device__ __forceinline__ float warp_sum(float value) {
#pragma unroll
    for (int step = 16; step > 0; step >>= 1) value += __shfl_xor_sync(kFull, value, step);
    return value;
}

__device__ __forceinline__ double warp_sum(double value) {
#pragma unroll
    for (int step = 16; step > 0; step >>= 1) value += __shfl_xor_sync(kFull, value, step);
    return value;
}

__device__ __forceinline__ bool is_finite(float value) { return fabsf(value) <= FLT_MAX; }

constexpr int kCountThreads = 256;

__global__ void __launch_bounds__(kCountThreads) count_filled_kernel(const CountFilledParams params) {
    int mine = 0;
    for (int i = blockIdx.x * kCountThreads + threadIdx.x; i < params.num_slots; i += gridDim.x * kCountThreads) {
        mine += params.pixel_ids[i] >= 0;
    }
    const uint32_t total = __reduce_add_sync(kFull, static_cast<uint32_t>(mine));
    if ((threadIdx.x & 31) == 0 && total != 0u) atomicAdd(params.num_filled, static_cast<int32_t>(total));
}

// What a warp adds up over its run of tiles.
struct Totals {
    double loss = 0.0;         // lane's part
    double view_delta = 0.0;   // lane's part, of the view at hand
    int nonfinite = 0;         // lane's part
};

// Similarity S of a tile in one channel, and its gradient dS/dx = share * (at_y * dy - at_x * dx + constant), with dx, dy
// the offsets of prediction and truth from their means.
struct Similarity {
    float value, at_y, at_x, constant;
};

__device__ __forceinline__ Similarity correlation(float variance_x, float variance_y, float covariance, float c) {
    const float floor = 0.5f * c;
    const float scale_x = sqrtf(variance_x + floor), scale_y = sqrtf(variance_y + floor);
    const float value = (covariance + floor) / scale_x / scale_y;
    return {value, 1.0f / scale_x / scale_y, value / scale_x / scale_x, 0.0f};
}

__device__ __forceinline__ Similarity contrast(float variance_x, float variance_y, float covariance, float c) {
    const float denominator = variance_x + variance_y + c;
    const float value = (2.0f * covariance + c) / denominator;
    return {value, 2.0f / denominator, 2.0f * value / denominator, 0.0f};
}

__device__ __forceinline__ Similarity ssim(float mean_x, float mean_y, float variance_x, float variance_y,
                                           float covariance) {
    const Similarity structure = contrast(variance_x, variance_y, covariance, kSsimConstant);
    const float denominator = mean_x * mean_x + mean_y * mean_y + kLuminanceConstant;
    const float luminance = (2.0f * mean_x * mean_y + kLuminanceConstant) / denominator;
    const float slope = 2.0f * (mean_y - luminance * mean_x) / denominator;
    return {structure.value * luminance, structure.at_y * luminance, structure.at_x * luminance,
            structure.value * slope};
}

// One tile, kSlots samples a lane: slot j of a lane is first + 32 j + lane.
template <int kSlots>
__device__ __forceinline__ void tile_loss(const SparseLossParams& params, const SampleView& view, int first, int end,
                                          float filled, bool learns, Totals& totals) {
    const int lane = threadIdx.x & 31;
    float x[kSlots][3], y[kSlots][3], weight[kSlots];
    uint32_t valid = 0;
#pragma unroll
    for (int j = 0; j < kSlots; ++j) {
        const int slot = first + 32 * j + lane;
        const int pixel = slot < end ? params.pixel_ids[slot] : -1;
        weight[j] = 0.0f;
#pragma unroll
        for (int c = 0; c < 3; ++c) x[j][c] = y[j][c] = 0.0f;
        if (pixel < 0) continue;
        bool finite = true;
#pragma unroll
        for (int c = 0; c < 3; ++c) {
            x[j][c] = params.colors[3 * static_cast<size_t>(slot) + c];
            finite = finite && is_finite(x[j][c]);
        }
        if (!finite) {
            ++totals.nonfinite;
#pragma unroll
            for (int c = 0; c < 3; ++c) x[j][c] = 0.0f;
            continue;
        }
        valid |= 1u << j;
        weight[j] = params.weights != nullptr ? params.weights[slot] : 1.0f;
        if (params.targets != nullptr) {
#pragma unroll
            for (int c = 0; c < 3; ++c) y[j][c] = params.targets[3 * static_cast<size_t>(slot) + c];
        } else {
            const uint8_t* photo = params.photos + 3 * (view.pixel_base + pixel);
#pragma unroll
            for (int c = 0; c < 3; ++c) y[j][c] = __fdiv_rn(static_cast<float>(photo[c]), 255.0f);
        }
    }

    // Charbonnier term, and the error of each pixel with its map.
    const float l1_scale = params.l1_weight / (3.0f * filled);
    const float epsilon2 = params.epsilon * params.epsilon;
    float slope_norm[kSlots];
    float l1_sum = 0.0f, total_weight = 0.0f;
#pragma unroll
    for (int j = 0; j < kSlots; ++j) {
        const int slot = first + 32 * j + lane;
        float error = 0.0f, value = 0.0f;
        slope_norm[j] = 0.0f;
#pragma unroll
        for (int c = 0; c < 3; ++c) {
            const float d = x[j][c] - y[j][c];
            const float root = sqrtf(d * d + epsilon2);
            const float slope = d / root;
            error = __fadd_rn(error, fabsf(d));
            value += d * slope * (root / (root + params.epsilon));
            slope_norm[j] += fabsf(slope);
        }
        l1_sum += weight[j] * value;
        total_weight += weight[j];
        if (slot < end) params.pixel_errors[slot] = error;
        if (learns && (valid >> j & 1u) != 0u && is_finite(error)) {
            const int64_t flat = view.pixel_base + params.pixel_ids[slot];
            __half* place = static_cast<__half*>(params.errors) + flat;
            const __half old = *place;
            const float blended =
                __fadd_rn(__fmul_rn(__half2float(old), params.ema_old), __fmul_rn(error, params.ema_new));
            const __half updated = __float2half_rn(fminf(blended, kErrorMax));
            *place = updated;
            params.stamps[flat] = params.stamp;
            totals.view_delta += static_cast<double>(__half2float(updated)) - static_cast<double>(__half2float(old));
        }
    }
    totals.loss += static_cast<double>(l1_sum) * static_cast<double>(l1_scale);

    float factor[3] = {}, at_y[3] = {}, at_x[3] = {}, constant[3] = {};
    float first_x[3] = {}, first_y[3] = {}, mean_x[3] = {}, mean_y[3] = {};  // means are about the first sample
    if (params.structure != Structure::kNone) {
        total_weight = warp_sum(total_weight);
        const float inverse_total = total_weight > 0.0f ? 1.0f / total_weight : 1.0f;
        float variance_y[3];
#pragma unroll
        for (int c = 0; c < 3; ++c) {
            first_x[c] = __shfl_sync(kFull, x[0][c], 0);
            first_y[c] = __shfl_sync(kFull, y[0][c], 0);
#pragma unroll
            for (int j = 0; j < kSlots; ++j) {
                mean_x[c] += weight[j] * inverse_total * (x[j][c] - first_x[c]);
                mean_y[c] += weight[j] * inverse_total * (y[j][c] - first_y[c]);
            }
            mean_x[c] = warp_sum(mean_x[c]);
            mean_y[c] = warp_sum(mean_y[c]);
            float xx = 0.0f, yy = 0.0f, xy = 0.0f;
#pragma unroll
            for (int j = 0; j < kSlots; ++j) {
                const float share = weight[j] * inverse_total;
                const float dx = (x[j][c] - first_x[c]) - mean_x[c], dy = (y[j][c] - first_y[c]) - mean_y[c];
                xx += share * (dx * dx);
                yy += share * (dy * dy);
                xy += share * (dx * dy);
            }
            xx = warp_sum(xx);
            yy = variance_y[c] = warp_sum(yy);
            xy = warp_sum(xy);
            Similarity similarity;
            if (params.structure == Structure::kNcc) {
                similarity = correlation(xx, yy, xy, params.variance_constant);
            } else if (params.structure == Structure::kContrast) {
                similarity = contrast(xx, yy, xy, params.variance_constant);
            } else {
                similarity = ssim(mean_x[c] + first_x[c], mean_y[c] + first_y[c], xx, yy, xy);
            }
            at_y[c] = similarity.at_y;
            at_x[c] = similarity.at_x;
            constant[c] = similarity.constant;
            factor[c] = 1.0f - similarity.value;
        }
        float balance = 1.0f;
        if (params.balance) {
            float norm_l1 = 0.0f, norm_structure = 0.0f;
#pragma unroll
            for (int j = 0; j < kSlots; ++j) {
                const float share = weight[j] * inverse_total;
                float norm = 0.0f;
#pragma unroll
                for (int c = 0; c < 3; ++c) {
                    const float dx = (x[j][c] - first_x[c]) - mean_x[c], dy = (y[j][c] - first_y[c]) - mean_y[c];
                    norm += fabsf(dy * at_y[c] - dx * at_x[c] + constant[c]);
                }
                norm_l1 += share * slope_norm[j];
                norm_structure += share * norm;
            }
            balance = fminf(warp_sum(norm_l1) / (warp_sum(norm_structure) + kBalanceEpsilon), 1.0f);
        }
        float tile_sum = 0.0f;
#pragma unroll
        for (int c = 0; c < 3; ++c) {
            float scale = balance;
            if (params.gate) scale *= variance_y[c] / (variance_y[c] + params.variance_constant);
            scale *= params.structure_weight / (3.0f * static_cast<float>(params.num_tiles));
            tile_sum += scale * factor[c];
            factor[c] = scale * inverse_total;
        }
        if (lane == 0) totals.loss += static_cast<double>(tile_sum);
    }

#pragma unroll
    for (int j = 0; j < kSlots; ++j) {
        const int slot = first + 32 * j + lane;
        if (slot >= end) continue;
#pragma unroll
        for (int c = 0; c < 3; ++c) {
            const float d = x[j][c] - y[j][c];
            const float l1 = d / sqrtf(d * d + epsilon2) * (weight[j] * l1_scale);
            const float dx = (x[j][c] - first_x[c]) - mean_x[c], dy = (y[j][c] - first_y[c]) - mean_y[c];
            const float structure = dy * at_y[c] - dx * at_x[c] + constant[c];
            params.color_gradients[3 * static_cast<size_t>(slot) + c] = l1 - factor[c] * weight[j] * structure;
        }
    }
}

// Tiles of few samples and tiles of many are two launches over the same tiles, each passing by the other's: at low rates,
// where there are most tiles, few registers leave room for twice the warps.
template <bool kMany>
__global__ void __launch_bounds__(kLossThreads) sparse_loss_kernel(const __grid_constant__ SparseLossParams params) {
    __shared__ double loss_parts[kLossWarps];
    const int lane = threadIdx.x & 31, warps = gridDim.x * kLossWarps;
    const int warp = blockIdx.x * kLossWarps + threadIdx.x / 32;
    const int run = (params.num_tiles + warps - 1) / warps;
    const int first_tile = min(warp * run, params.num_tiles), end_tile = min(first_tile + run, params.num_tiles);
    const float filled = static_cast<float>(max(*params.num_filled, 1));
    const bool learns = params.errors != nullptr && (params.overflow == nullptr || *params.overflow == 0);

    Totals totals;
    int view = -1;
    for (int tile = first_tile; tile < end_tile; ++tile) {
        const int first = params.tile_offsets[tile], end = params.tile_offsets[tile + 1];
        if ((end - first > kFewSlots) != kMany) continue;
        const int tile_id = params.tile_ids[tile];
        int tile_view = max(view, 0);
        while (tile_view + 1 < params.num_views && tile_id >= params.views[tile_view + 1].tile_base) ++tile_view;
        if (tile_view != view) {
            if (view >= 0 && params.view_sums != nullptr) {
                const double delta = warp_sum(totals.view_delta);
                if (lane == 0) atomicAdd(params.view_sums + params.views[view].view_number, delta);
                totals.view_delta = 0.0;
            }
            view = tile_view;
        }
        const SampleView& of_tile = params.views[view];
        if (kMany) {
            if (end - first <= 128) {
                tile_loss<4>(params, of_tile, first, end, filled, learns, totals);
            } else {
                tile_loss<8>(params, of_tile, first, end, filled, learns, totals);
            }
        } else if (end - first <= 32) {
            tile_loss<1>(params, of_tile, first, end, filled, learns, totals);
        } else {
            tile_loss<2>(params, of_tile, first, end, filled, learns, totals);
        }
    }
    if (view >= 0 && params.view_sums != nullptr) {
        const double delta = warp_sum(totals.view_delta);
        if (lane == 0) atomicAdd(params.view_sums + params.views[view].view_number, delta);
    }
    const uint32_t nonfinite = __reduce_add_sync(kFull, static_cast<uint32_t>(totals.nonfinite));
    if (lane == 0 && nonfinite != 0u && params.num_nonfinite != nullptr) {
        atomicAdd(params.num_nonfinite, static_cast<unsigned long long>(nonfinite));
    }
    const double loss = warp_sum(totals.loss);
    if (lane == 0) loss_parts[threadIdx.x / 32] = loss;
    __syncthreads();
    if (threadIdx.x == 0) {
        double sum = 0.0;
        for (int i = 0; i < kLossWarps; ++i) sum += loss_parts[i];
        if (sum != 0.0) atomicAdd(params.loss, sum);
    }
}

}  // namespace

cudaError_t launch_count_filled(const CountFilledParams& params, cudaStream_t stream) {
    if (params.num_slots == 0) return cudaSuccess;
    const int blocks = min((params.num_slots + 4 * kCountThreads - 1) / (4 * kCountThreads), 512);
    count_filled_kernel<<<blocks, kCountThreads, 0, stream>>>(params);
    return cudaGetLastError();
}

cudaError_t launch_sparse_loss(const SparseLossParams& params, cudaStream_t stream) {
    if (params.num_slots == 0 || params.num_tiles == 0) return cudaSuccess;
    const int blocks = min((params.num_tiles + kLossWarps - 1) / kLossWarps, kMaxBlocks);
    sparse_loss_kernel<false><<<blocks, kLossThreads, 0, stream>>>(params);
    const cudaError_t status = cudaGetLastError();
    if (status != cudaSuccess) return status;
    sparse_loss_kernel<true><<<blocks, kLossThreads, 0, stream>>>(params);
    return cudaGetLastError();
}

}  // namespace turbogs
