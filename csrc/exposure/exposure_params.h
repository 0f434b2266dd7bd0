// Parameters of the kernels of exposures. No torch here. Index spaces as in turbogs_plugin/types: K views of the
// batch, P sample slots, T tiles with samples, V training views. turbogs_plugin/engine/reference/exposed_colors.py defines
// all results.
#pragma once

#include <cuda_runtime.h>

#include <cstdint>

#include "common/sizes.h"
#include "common/views.h"

namespace turbogs {

constexpr int kExposureNumbers = 12;  // of a photo's map less the identity: rows of A | b

// Samples with their views, and the maps.
struct ExposedSamples {
    int num_views;  // K
    int num_tiles;  // T
    SampleView views[kMaxViews];
    const int32_t* tile_ids;      // [T]
    const int32_t* tile_offsets;  // [T + 1]
    const float* colors;          // [P, 3]
    const float* offsets;         // [V, 3, 4]
};

struct ExposeColorsParams : ExposedSamples {
    float* exposed;  // [P, 3] out
};

struct ExposureBackwardParams : ExposedSamples {
    float* gradients;  // [P, 3] in: of the exposed colours; out: of the colours
    double* sums;      // [K, 3, 4] added to
};

struct ExposureStepParams {
    int num_views;   // K
    int num_photos;  // V
    SampleView views[kMaxViews];
    const double* sums;       // [K, 3, 4]
    float* offsets;           // [V, 3, 4], as are the moments
    float* exp_avg;           // changed in place, all four
    float* exp_avg_sq;
    int32_t* steps;           // [V]
    const int32_t* overflow;  // [1] where not 0, nothing changes; or null
    double beta1, beta2;
    float rate, eps, pull;
};

// Every launcher returns the first CUDA error, and only enqueues work on `stream`.
cudaError_t launch_expose_colors(const ExposeColorsParams& params, cudaStream_t stream);
cudaError_t launch_exposure_backward(const ExposureBackwardParams& params, cudaStream_t stream);
cudaError_t launch_exposure_step(const ExposureStepParams& params, cudaStream_t stream);

}  // namespace turbogs
