// How alike prediction and truth are over the samples of a tile or a window, in one channel: the structure terms of
// turbogs_plugin/engine/reference/losses.py with their gradients, as functions of the moments.
#pragma once

#include <cuda_runtime.h>

namespace turbogs {

// SSIM's, as in turbogs_plugin/engine/rules.py.
constexpr float kLuminanceConstant = 1e-4f;  // 0.01^2
constexpr float kSsimConstant = 9e-4f;       // 0.03^2
constexpr float kRounding = 0x1p-23f;        // of float32

// Similarity S in one channel, and its gradient dS/dx = share * (at_y * dy - at_x * dx), with dx, dy the offsets of
// prediction and truth from their means.
struct Similarity {
    float value, at_y, at_x;
};

// The same with a luminance term, whose slope adds a constant: share * (at_y * dy - at_x * dx + constant).
struct LuminanceSimilarity {
    float value, at_y, at_x, constant;
};

__device__ __forceinline__ Similarity correlation(float variance_x, float variance_y, float covariance, float c) {
    const float floor = 0.5f * c;
    const float scale_x = sqrtf(variance_x + floor), scale_y = sqrtf(variance_y + floor);
    const float value = (covariance + floor) / scale_x / scale_y;
    return {value, 1.0f / scale_x / scale_y, value / scale_x / scale_x};
}

__device__ __forceinline__ Similarity printed_correlation(float variance_x, float variance_y, float covariance,
                                                          float epsilon) {
    const float scale = sqrtf(variance_x * variance_y + epsilon);
    const float value = covariance / scale;
    return {value, 1.0f / scale, value / (variance_x + epsilon)};
}

__device__ __forceinline__ Similarity contrast(float variance_x, float variance_y, float covariance, float c) {
    const float denominator = variance_x + variance_y + c;
    const float value = (2.0f * covariance + c) / denominator;
    return {value, 2.0f / denominator, 2.0f * value / denominator};
}

__device__ __forceinline__ LuminanceSimilarity ssim(float mean_x, float mean_y, float variance_x, float variance_y,
                                                    float covariance, float c) {
    const Similarity structure = contrast(variance_x, variance_y, covariance, c);
    const float denominator = mean_x * mean_x + mean_y * mean_y + kLuminanceConstant;
    const float luminance = (2.0f * mean_x * mean_y + kLuminanceConstant) / denominator;
    const float slope = 2.0f * (mean_y - luminance * mean_x) / denominator;
    return {structure.value * luminance, structure.at_y * luminance, structure.at_x * luminance,
            structure.value * slope};
}

}  // namespace turbogs
