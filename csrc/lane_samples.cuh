// What a warp holds of a tile's samples in its registers: colour, truth, weight; and the moments of a window of them, which is
// the tile or a cell of it.
#pragma once

#include "training_math.cuh"
#include "training_params.h"
#include "warp.cuh"

namespace turbogs {

// byte / 255, correctly rounded.
__device__ __forceinline__ float unit_color(uint8_t byte) {
    const float value = static_cast<float>(byte), quotient = value * (1.0f / 255.0f);
    return __fmaf_rn(__fmaf_rn(-quotient, 255.0f, value), 1.0f / 255.0f, quotient);
}

// What a lane holds of a tile: slots first + 32 j + lane. An empty slot has weight 0 and pixel -1.
template <int kSlots>
struct LaneSamples {
    int pixel[kSlots];
    float x[kSlots][3], y[kSlots][3], weight[kSlots];
};

template <int kSlots>
__device__ __forceinline__ void load_samples(const SparseLossParams& params, const SampleView& view, int first, int end,
                                             LaneSamples<kSlots>& samples, int& nonfinite) {
    const int lane = threadIdx.x & 31;
#pragma unroll
    for (int j = 0; j < kSlots; ++j) {
        const int slot = first + 32 * j + lane;
        samples.pixel[j] = slot < end ? params.pixel_ids[slot] : -1;
    }
#pragma unroll
    for (int j = 0; j < kSlots; ++j) {
        const size_t slot = static_cast<size_t>(first + 32 * j + lane);
        const bool filled = samples.pixel[j] >= 0;
#pragma unroll
        for (int c = 0; c < 3; ++c) {
            samples.x[j][c] = filled ? params.colors[3 * slot + c] : 0.0f;
            samples.y[j][c] = 0.0f;
        }
        samples.weight[j] = filled ? (params.weights != nullptr ? params.weights[slot] : 1.0f) : 0.0f;
        if (!filled) continue;
        if (params.targets != nullptr) {
#pragma unroll
            for (int c = 0; c < 3; ++c) samples.y[j][c] = params.targets[3 * slot + c];
        } else {
            const uint8_t* photo = params.photos + 3 * (view.pixel_base + samples.pixel[j]);
#pragma unroll
            for (int c = 0; c < 3; ++c) samples.y[j][c] = unit_color(photo[c]);
        }
    }
#pragma unroll
    for (int j = 0; j < kSlots; ++j) {
        if (is_finite(samples.x[j][0]) && is_finite(samples.x[j][1]) && is_finite(samples.x[j][2])) continue;
        ++nonfinite;
        samples.pixel[j] = -1;
        samples.weight[j] = 0.0f;
#pragma unroll
        for (int c = 0; c < 3; ++c) samples.x[j][c] = samples.y[j][c] = 0.0f;
    }
}

// A window's means of colour and truth, as offsets from its first sample, so that a constant window has variance 0 exactly.
struct WindowMeans {
    float first_x[3] = {}, first_y[3] = {}, mean_x[3] = {}, mean_y[3] = {};

    // The first sample is slot j of `source`.
    template <int kSlots>
    __device__ __forceinline__ void start(const LaneSamples<kSlots>& samples, int j, int source) {
#pragma unroll
        for (int c = 0; c < 3; ++c) {
            first_x[c] = __shfl_sync(kFullWarp, samples.x[j][c], source);
            first_y[c] = __shfl_sync(kFullWarp, samples.y[j][c], source);
        }
    }

    // `sums`: offsets from the first sample of x 0-2 and y 3-5, weighted.
    __device__ __forceinline__ void finish(const float (&sums)[8], float inverse_total) {
#pragma unroll
        for (int c = 0; c < 3; ++c) {
            mean_x[c] = sums[c] * inverse_total;
            mean_y[c] = sums[3 + c] * inverse_total;
        }
    }

    template <int kSlots>
    __device__ __forceinline__ float offset_x(const LaneSamples<kSlots>& samples, int j, int c) const {
        return (samples.x[j][c] - first_x[c]) - mean_x[c];
    }

    template <int kSlots>
    __device__ __forceinline__ float offset_y(const LaneSamples<kSlots>& samples, int j, int c) const {
        return (samples.y[j][c] - first_y[c]) - mean_y[c];
    }
};

// Variances and covariances of a window, times its total weight until they are read.
struct SecondMoments {
    float sums[8] = {}, last = 0.0f;  // xx 0-2, yy 3-5, xy 6, 7 and `last`

    template <int kSlots>
    __device__ __forceinline__ void add(const LaneSamples<kSlots>& samples, const WindowMeans& means, int j, float weight) {
#pragma unroll
        for (int c = 0; c < 3; ++c) {
            const float dx = means.offset_x(samples, j, c), dy = means.offset_y(samples, j, c);
            sums[c] += weight * (dx * dx);
            sums[3 + c] += weight * (dy * dy);
            (c < 2 ? sums[6 + c] : last) += weight * (dx * dy);
        }
    }

    __device__ __forceinline__ void sum_over_warp() {
        warp_sums(sums);
        last = warp_sum(last);
    }

    __device__ __forceinline__ float xx(int c) const { return sums[c]; }
    __device__ __forceinline__ float yy(int c) const { return sums[3 + c]; }
    __device__ __forceinline__ float xy(int c) const { return c < 2 ? sums[6 + c] : last; }
};

}  // namespace turbogs
