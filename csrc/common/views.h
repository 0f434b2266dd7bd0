// The Gaussians and the views of a batch, as kernels read them; filled by bindings/views.h.
#pragma once

#include <cuda_runtime.h>

#include <cstdint>

#include "common/sizes.h"

namespace turbogs {

// A view of a batch, as the kernels over the pixels of training views see it.
struct SampleView {
    int64_t pixel_base;  // first flat pixel
    int width, height;
    int tiles_x, tiles_y;
    int tile_base;    // first tile in the batch's numbering
    int origin_x, origin_y;  // pixels by which the grid of tiles begins before the image
    int view_number;  // training view
    int slot_base;    // sampler: first slot (unit pixel) or first chosen tile (unit tile)
};

// What the projection and its backward pass read alike: the parameters of both begin with it.
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
