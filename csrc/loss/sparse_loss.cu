// Loss on sampled pixels with its gradient, and the update of the error maps (EMA and stamp): one pass over the samples
// in memory, a warp per tile. Defined by turbogs_plugin/engine/reference/losses.py and turbogs_plugin/error_maps.py.
//
// A lane keeps up to 4 of its tile's samples in registers, so that colour and truth are read once; larger tiles are
// read again in each pass. The first pass makes the means, relative to the tile's first sample, so that a constant tile
// has variance 0 exactly. The second makes the variances, a third the norms that the balance needs, and the last writes
// the gradient. The sums of the views add half-precision numbers in double, which is exact in any order. SSIM has many
// windows in a tile, and a kernel of its own after this one, window_similarity.cu.
#include <cfloat>

#include <cuda_fp16.h>

#include "common/approximate_math.cuh"
#include "common/warp.cuh"
#include "loss/sample_loss.cuh"

namespace turbogs {
namespace {

constexpr int kLossThreads = 128;  // of a block: four tiles, which mostly share a view's sum; no record of other values
constexpr int kLossBlocks = 7;     // of an SM: 72 registers. With 64 it spills, and with 80 it is no faster
constexpr int kLossWarps = kLossThreads / kWarpSize;
constexpr float kBalanceEpsilon = 1e-8f;  // BALANCE_EPSILON of reference/losses.py
constexpr float kErrorMax = 65504.0f;     // largest finite half
constexpr float kInverseDepthMax = 1000.0f;  // INVERSE_DEPTH_MAX of reference/losses.py

__device__ __forceinline__ float filled_slots(const SparseLossParams& params) {
    return static_cast<float>(params.num_filled != nullptr ? max(*params.num_filled, 1) : params.num_slots);
}

// What a lane holds of a tile: of each kWarpSize slots one. An empty slot has weight 0 and pixel -1.
template <int kSlots>
struct LaneSamples {
    int pixel[kSlots];
    float x[kSlots][3], y[kSlots][3], weight[kSlots];
};

template <int kSlots, bool kAlpha>
__device__ __forceinline__ void load_samples(const SparseLossParams& params, const SampleView& view, int first, int end,
                                             LaneSamples<kSlots>& samples) {
    const int lane = this_lane();
#pragma unroll
    for (int j = 0; j < kSlots; ++j) {
        const int slot = first + kWarpSize * j + lane;
        samples.pixel[j] = slot < end ? params.pixel_ids[slot] : -1;
    }
#pragma unroll
    for (int j = 0; j < kSlots; ++j) {
        const size_t slot = static_cast<size_t>(first + kWarpSize * j + lane);
        const bool filled = samples.pixel[j] >= 0;
#pragma unroll
        for (int c = 0; c < 3; ++c) {
            samples.x[j][c] = filled ? params.colors[3 * slot + c] : 0.0f;
            samples.y[j][c] = 0.0f;
        }
        samples.weight[j] = filled ? (params.weights != nullptr ? params.weights[slot] : 1.0f) : 0.0f;
        if (!filled) continue;
        load_truth<kAlpha>(params, view, slot, samples.pixel[j], samples.y[j]);
    }
#pragma unroll
    for (int j = 0; j < kSlots; ++j) {
        if (is_finite(samples.x[j][0]) && is_finite(samples.x[j][1]) && is_finite(samples.x[j][2])) continue;
        samples.pixel[j] = -1;
        samples.weight[j] = 0.0f;
#pragma unroll
        for (int c = 0; c < 3; ++c) samples.x[j][c] = samples.y[j][c] = 0.0f;
    }
}

// What a tile adds to the loss and to the sum of its view; the lane's part of the latter.
struct TileTotals {
    double loss = 0.0, view_delta = 0.0;
};

// One tile. Up to kWarpSize * kSlots samples stay in registers; of more, each pass loads them again, in as many rounds.
template <int kSlots, bool kAlpha>
__device__ __forceinline__ TileTotals tile_loss(const SparseLossParams& params, const SampleView& view, int first,
                                                int end, float filled, bool learns) {
    constexpr int kRound = kWarpSize * kSlots;
    const int lane = this_lane();
    const bool resident = end - first <= kRound;
    const bool structured = params.structure != Structure::kNone && params.structure != Structure::kSsim;
    const float l1_scale = params.l1_weight / (3.0f * filled), epsilon2 = params.epsilon * params.epsilon;
    TileTotals totals;
    LaneSamples<kSlots> samples;

    // Pass 1: Charbonnier term, errors and maps; means, about the first sample.
    float first_x[3] = {}, first_y[3] = {}, mean_x[3] = {}, mean_y[3] = {};
    float l1_sum = 0.0f, norm_l1 = 0.0f, inverse_total = 1.0f;
    {
        float sums[8] = {};  // offsets of x 0-2 and y 3-5, weights, norms of the Charbonnier gradients
        for (int start = first; start < end; start += kRound) {
            load_samples<kSlots, kAlpha>(params, view, start, end, samples);
            if (start == first) {
#pragma unroll
                for (int c = 0; c < 3; ++c) {
                    first_x[c] = __shfl_sync(kFullWarp, samples.x[0][c], 0);
                    first_y[c] = __shfl_sync(kFullWarp, samples.y[0][c], 0);
                }
            }
            __half old[kSlots];
            int64_t flat[kSlots];
            if (learns) {
#pragma unroll
                for (int j = 0; j < kSlots; ++j) {
                    flat[j] = view.pixel_base + samples.pixel[j];
                    if (samples.pixel[j] >= 0) old[j] = __ushort_as_half(params.errors[flat[j]]);
                }
            }
#pragma unroll
            for (int j = 0; j < kSlots; ++j) {
                const int slot = start + kWarpSize * j + lane;
                float error = 0.0f, value = 0.0f, slope_norm = 0.0f;
#pragma unroll
                for (int c = 0; c < 3; ++c) {
                    const float d = samples.x[j][c] - samples.y[j][c];
                    const float square = fmaxf(d * d + epsilon2, FLT_MIN);
                    const float inverse_root = approximate_rsqrt(square), root = square * inverse_root;
                    const float slope = d * inverse_root;
                    error = __fadd_rn(error, fabsf(d));
                    value += d * slope * (root * approximate_reciprocal(root + params.epsilon));
                    slope_norm += fabsf(slope);
                    sums[c] += samples.weight[j] * (samples.x[j][c] - first_x[c]);
                    sums[3 + c] += samples.weight[j] * (samples.y[j][c] - first_y[c]);
                }
                l1_sum += samples.weight[j] * value;
                sums[6] += samples.weight[j];
                sums[7] += samples.weight[j] * slope_norm;
                if (slot < end) params.pixel_errors[slot] = error;
                if (learns && samples.pixel[j] >= 0 && is_finite(error)) {
                    const float blended =
                        __fadd_rn(__fmul_rn(__half2float(old[j]), params.ema_old), __fmul_rn(error, params.ema_new));
                    const __half updated = __float2half_rn(fminf(blended, kErrorMax));
                    params.errors[flat[j]] = __half_as_ushort(updated);
                    params.stamps[flat[j]] = params.stamp;
                    totals.view_delta +=
                        static_cast<double>(__half2float(updated)) - static_cast<double>(__half2float(old[j]));
                }
            }
        }
        l1_sum = warp_sum(l1_sum);
        if (structured) {
            warp_sums(sums);
            inverse_total = sums[6] > 0.0f ? 1.0f / sums[6] : 1.0f;
            norm_l1 = sums[7] * inverse_total;
#pragma unroll
            for (int c = 0; c < 3; ++c) {
                mean_x[c] = sums[c] * inverse_total;
                mean_y[c] = sums[3 + c] * inverse_total;
            }
        }
    }
    totals.loss = static_cast<double>(l1_sum) * static_cast<double>(l1_scale);

    float factor[3] = {}, at_y[3] = {}, at_x[3] = {};
    const auto offset_x = [&](int j, int c) { return (samples.x[j][c] - first_x[c]) - mean_x[c]; };
    const auto offset_y = [&](int j, int c) { return (samples.y[j][c] - first_y[c]) - mean_y[c]; };
    // Each sample once more, the lane's j-th of a round.
    const auto visit_samples = [&](const auto& visit) {
        for (int start = first; start < end; start += kRound) {
            if (!resident) load_samples<kSlots, kAlpha>(params, view, start, end, samples);
#pragma unroll
            for (int j = 0; j < kSlots; ++j) visit(j, start + kWarpSize * j + lane);
        }
    };
    const auto structure_slope = [&](int j, int c) { return offset_y(j, c) * at_y[c] - offset_x(j, c) * at_x[c]; };
    if (structured) {
        // Pass 2: variances and covariances.
        float sums[8] = {}, last = 0.0f;  // xx 0-2, yy 3-5, xy 6, 7 and `last`
        visit_samples([&](int j, int) {
#pragma unroll
            for (int c = 0; c < 3; ++c) {
                const float dx = offset_x(j, c), dy = offset_y(j, c);
                sums[c] += samples.weight[j] * (dx * dx);
                sums[3 + c] += samples.weight[j] * (dy * dy);
                (c < 2 ? sums[6 + c] : last) += samples.weight[j] * (dx * dy);
            }
        });
        warp_sums(sums);
        last = warp_sum(last);
#pragma unroll
        for (int c = 0; c < 3; ++c) {
            const float xx = sums[c] * inverse_total, yy = sums[3 + c] * inverse_total;
            const float xy = (c < 2 ? sums[6 + c] : last) * inverse_total;
            const Similarity similarity = params.structure == Structure::kNcc
                                              ? correlation(xx, yy, xy, params.variance_constant)
                                              : printed_correlation(xx, yy, xy, params.variance_constant);
            at_y[c] = similarity.at_y;
            at_x[c] = similarity.at_x;
            factor[c] = 1.0f - similarity.value;
        }
        float balance = 1.0f;
        if (params.balance) {
            // Pass 3: norms of the structure term's gradients.
            float norm = 0.0f;
            visit_samples([&](int j, int) {
                float norm_of_sample = 0.0f;
#pragma unroll
                for (int c = 0; c < 3; ++c) norm_of_sample += fabsf(structure_slope(j, c));
                norm += samples.weight[j] * norm_of_sample;
            });
            balance = fminf(norm_l1 / (warp_sum(norm) * inverse_total + kBalanceEpsilon), 1.0f);
        }
        float tile_sum = 0.0f;
#pragma unroll
        for (int c = 0; c < 3; ++c) {
            const float scale = balance * (params.structure_weight / (3.0f * static_cast<float>(params.num_tiles)));
            tile_sum += scale * factor[c];
            factor[c] = scale * inverse_total;
        }
        totals.loss += static_cast<double>(tile_sum);
    }

    // Last pass: gradients.
    visit_samples([&](int j, int slot) {
        if (slot >= end) return;
#pragma unroll
        for (int c = 0; c < 3; ++c) {
            const float d = samples.x[j][c] - samples.y[j][c];
            const float l1 = d * approximate_rsqrt(fmaxf(d * d + epsilon2, FLT_MIN)) * l1_scale;
            params.color_gradients[3 * static_cast<size_t>(slot) + c] =
                samples.weight[j] * (l1 - factor[c] * structure_slope(j, c));
        }
    });
    return totals;
}

// A warp per tile; its block adds up what belongs together. Up to kWarpSize * kSlots samples of a tile are held in
// registers.
template <int kSlots, bool kAlpha>
__global__ void __launch_bounds__(kLossThreads, kLossBlocks)
    sparse_loss_kernel(const __grid_constant__ SparseLossParams params) {
    __shared__ double losses[kLossWarps], view_deltas[kLossWarps];
    __shared__ int views[kLossWarps];
    const int lane = this_lane(), warp = this_warp();
    const int tile = blockIdx.x * kLossWarps + warp;
    const float filled = filled_slots(params);
    const bool learns = params.errors != nullptr && (params.overflow == nullptr || *params.overflow == 0);

    TileTotals totals;
    int view = -1;
    if (tile < params.num_tiles) {
        const int first = params.tile_offsets[tile], end = params.tile_offsets[tile + 1];
        view = view_of_tile(params.views, params.num_views, params.tile_ids[tile]);
        totals = tile_loss<kSlots, kAlpha>(params, params.views[view], first, end, filled, learns);
        totals.view_delta = warp_sum(totals.view_delta);
    }
    if (lane == 0) {
        losses[warp] = totals.loss;
        view_deltas[warp] = totals.view_delta;
        views[warp] = view;
    }
    __syncthreads();
    if (threadIdx.x == 0) {
        double loss = 0.0, delta = 0.0;
        for (int i = 0; i < kLossWarps; ++i) {
            loss += losses[i];
            delta += view_deltas[i];
            const bool last_of_view = i + 1 == kLossWarps || views[i + 1] != views[i];
            if (last_of_view && delta != 0.0) {
                atomicAdd(params.view_sums + params.views[views[i]].view_number, delta);
                delta = 0.0;
            }
        }
        add_loss(params, loss);
    }
}

// The depth term: `depth_loss` of reference/losses.py. A warp per tile.
__global__ void __launch_bounds__(kLossThreads) depth_loss_kernel(const __grid_constant__ SparseLossParams params) {
    __shared__ double losses[kLossWarps];
    const int tile = blockIdx.x * kLossWarps + this_warp();
    const float scale = params.depth_factor / filled_slots(params);
    float sum = 0.0f;
    if (tile < params.num_tiles) {
        const SampleView& view = params.views[view_of_tile(params.views, params.num_views, params.tile_ids[tile])];
        const float* known = params.inverse_depths + params.first_cells[view.view_number];
        const int cells_x = (view.width + params.cell - 1) / params.cell, end = params.tile_offsets[tile + 1];
        for (int slot = params.tile_offsets[tile] + this_lane(); slot < end; slot += kWarpSize) {
            const int pixel = params.pixel_ids[slot], y = pixel / view.width, x = pixel - y * view.width;
            const int cell = y / params.cell * cells_x + x / params.cell;
            const float truth = pixel >= 0 ? known[cell] : 0.0f;
            const float depth = params.depths[slot], inverse = 1.0f / depth;
            float gradient = 0.0f;
            if (depth > 0.0f && inverse <= kInverseDepthMax && truth > 0.0f && truth <= kInverseDepthMax) {
                const float weight = params.weights != nullptr ? params.weights[slot] * scale : scale;
                const float difference = inverse - truth;
                const float root = sqrtf(difference * difference + params.epsilon * params.epsilon);
                sum += weight * (difference * (difference / (root + params.epsilon)));
                gradient = -weight * (difference / root) * inverse * inverse;
            }
            params.depth_gradients[slot] = gradient;
        }
    }
    const double loss = block_sum(static_cast<double>(sum), losses);
    if (threadIdx.x == 0) add_loss(params, loss);
}

template <bool kAlpha>
void launch(const SparseLossParams& params, cudaStream_t stream) {
    // Slots of a lane, by the average tile: most samplers give every tile as many.
    const int64_t of_all_lanes = int64_t{kWarpSize} * params.num_tiles;
    const int64_t slots = (params.num_slots + of_all_lanes - 1) / of_all_lanes;
    const auto kernel = slots <= 1   ? sparse_loss_kernel<1, kAlpha>
                        : slots == 2 ? sparse_loss_kernel<2, kAlpha>
                        : slots == 3 ? sparse_loss_kernel<3, kAlpha>
                                     : sparse_loss_kernel<4, kAlpha>;
    kernel<<<blocks_for(params.num_tiles, kLossWarps), kLossThreads, 0, stream>>>(params);
}

}  // namespace

void launch_sparse_loss(const SparseLossParams& params, cudaStream_t stream) {
    if (params.num_slots == 0 || params.num_tiles == 0) return;
    if (params.photos != nullptr && params.channels == 4) launch<true>(params, stream);
    else launch<false>(params, stream);
    if (params.structure == Structure::kSsim) launch_window_similarity(params, stream);
    if (params.depths == nullptr) return;
    depth_loss_kernel<<<blocks_for(params.num_tiles, kLossWarps), kLossThreads, 0, stream>>>(params);
}

}  // namespace turbogs
