// What the kernels of the loss share: the true colour of a sample, how alike prediction and truth are over the samples
// of a tile or a window in one channel (the structure terms of turbogs_plugin/engine/reference/losses.py with their
// gradients, as functions of the moments), and adding to a loss.
#pragma once

#include "common/approximate_math.cuh"
#include "loss/loss_params.h"

namespace turbogs {

// SSIM's, as in turbogs_plugin/engine/rules.py.
constexpr float kLuminanceConstant = 1e-4f;  // 0.01^2
constexpr float kSsimConstant = 9e-4f;       // 0.03^2
constexpr float kRounding = 0x1p-23f;        // of float32

// Similarity S in one channel, and its gradient dS/dx = share * (at_y * dy - at_x * dx + constant), with dx, dy the
// offsets of prediction and truth from their means. The constant is the slope of a luminance term.
struct Similarity {
    float value, at_y, at_x, constant;
};

__device__ __forceinline__ Similarity correlation(float variance_x, float variance_y, float covariance, float c) {
    const float floor = 0.5f * c;
    const float scale_x = sqrtf(variance_x + floor), scale_y = sqrtf(variance_y + floor);
    const float value = (covariance + floor) / scale_x / scale_y;
    return {value, 1.0f / scale_x / scale_y, value / scale_x / scale_x, 0.0f};
}

__device__ __forceinline__ Similarity printed_correlation(float variance_x, float variance_y, float covariance,
                                                          float epsilon) {
    const float scale = sqrtf(variance_x * variance_y + epsilon);
    const float value = covariance / scale;
    return {value, 1.0f / scale, value / (variance_x + epsilon), 0.0f};
}

__device__ __forceinline__ Similarity ssim(float mean_x, float mean_y, float variance_x, float variance_y,
                                           float covariance, float c) {
    const float variances = variance_x + variance_y + c;
    const float contrast = (2.0f * covariance + c) / variances;
    const float at_y = 2.0f / variances, at_x = 2.0f * contrast / variances;
    const float denominator = mean_x * mean_x + mean_y * mean_y + kLuminanceConstant;
    const float luminance = (2.0f * mean_x * mean_y + kLuminanceConstant) / denominator;
    const float slope = 2.0f * (mean_y - luminance * mean_x) / denominator;
    return {contrast * luminance, at_y * luminance, at_x * luminance, contrast * slope};
}

// byte / 255, correctly rounded.
__device__ __forceinline__ float unit_color(uint8_t byte) {
    const float value = static_cast<float>(byte), quotient = value * (1.0f / 255.0f);
    return __fmaf_rn(__fmaf_rn(-quotient, 255.0f, value), 1.0f / 255.0f, quotient);
}

// Colour of the photo at a pixel of a view, or the target of a slot; with an alpha, the background shows through.
template <bool kAlpha>
__device__ __forceinline__ void load_truth(const SparseLossParams& params, const SampleView& view, size_t slot,
                                           int pixel, float (&truth)[3]) {
    if (params.targets != nullptr) {
#pragma unroll
        for (int c = 0; c < 3; ++c) truth[c] = params.targets[3 * slot + c];
        return;
    }
    const uint8_t* photo = params.photos + (kAlpha ? 4 : 3) * (view.pixel_base + pixel);
    const float through = kAlpha ? __fsub_rn(1.0f, unit_color(photo[3])) : 0.0f;
#pragma unroll
    for (int c = 0; c < 3; ++c) {
        truth[c] = unit_color(photo[c]);
        if (kAlpha) truth[c] = __fadd_rn(truth[c], __fmul_rn(through, params.background[c]));
    }
}

// Adds to the loss. Once lost, the sum stays so: one thread sees it happen, and counts it, unless the iteration is
// skipped.
__device__ __forceinline__ void add_loss(const SparseLossParams& params, double loss) {
    if (loss == 0.0) return;
    const double before = atomicAdd(params.loss, loss);
    if (params.nonfinite_losses == nullptr || !is_finite(before) || is_finite(before + loss)) return;
    if (params.overflow == nullptr || *params.overflow == 0) atomicAdd(params.nonfinite_losses, 1ull);
}

}  // namespace turbogs
