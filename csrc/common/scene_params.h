// What the projection and its backward pass read alike: the Gaussians, and the views of a batch. The parameters of both
// begin with it, and one function of the bindings fills it (bindings/scene.h).
#pragma once

#include <cuda_runtime.h>

#include "common/sizes.h"

namespace turbogs {

struct SceneParams {
    int num_views;      // K
    int num_gaussians;  // N
    int sh_degree;      // degree to evaluate
    int bands;          // B, harmonics above band 0 that `shN` stores; B >= (sh_degree + 1)^2 - 1
    float eps2d;        // added to the diagonal of the screen covariance

    // The fused step changes them in place.
    float* means;      // [N, 3]
    float4* quats;     // [N], not normalised
    float* scales;     // [N, 3], logarithms
    float* opacities;  // [N], logits
    float* sh0;        // [N, 3]
    float* shN;        // [N, B, 3]

    const float* viewmats;    // [C, 4, 4], of cameras of which each view has one
    const float* intrinsics;  // [C, 3, 3]
    int widths[kMaxViews];
    int heights[kMaxViews];
    int camera_rows[kMaxViews];  // of each view, in `viewmats` and `intrinsics`
};

}  // namespace turbogs
