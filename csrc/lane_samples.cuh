// What a warp holds of a tile's samples in its registers: colour, truth, weight.
#pragma once

#include "training_math.cuh"
#include "training_params.h"

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

}  // namespace turbogs
