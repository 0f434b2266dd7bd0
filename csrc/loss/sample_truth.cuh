// The true colour of a sample; and adding to a loss, which counts once a sum that is no longer finite.
#pragma once

#include "common/approximate_math.cuh"
#include "loss/loss_params.h"

namespace turbogs {

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
