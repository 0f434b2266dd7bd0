// Sizes that all kernels and their bindings know, and a batch as kernels read it: its Gaussians and its views, which
// bindings/arguments.h fills, and the view of a tile. What Python knows too comes from the header that the build makes
// of turbogs_plugin/engine/layout.py. No torch here. A launcher (`launch_...`, of the headers `..._params.h`) only
// enqueues work on its stream; `call` in bindings/library.cpp looks for its errors.
#pragma once

#include <cuda_runtime.h>

#include <cstdint>

#include "layout.h"

namespace turbogs {

constexpr int kTilePixels = kTileSize * kTileSize;
constexpr int kMaxBands = (kMaxShDegree + 1) * (kMaxShDegree + 1) - 1;  // spherical harmonics above band 0
constexpr int kRecordQuads = ScreenRecord::kSize / 4;                   // of 16 bytes

// Blocks of a launch with one thread an item. For the host.
inline int blocks_for(int items, int threads) { return (items + threads - 1) / threads; }

// Tiles along a side of an image.
__host__ __device__ inline int tiles_along(int pixels) { return (pixels + kTileSize - 1) / kTileSize; }

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

// The first number of low .. high - 1 for which `before` does not hold, or `high`; it holds for all smaller ones.
template <class Before>
__device__ __forceinline__ int partition_point(int low, int high, const Before& before) {
    while (low < high) {
        const int middle = (low + high) / 2;
        if (before(middle)) low = middle + 1;
        else high = middle;
    }
    return low;
}

// Tiles are numbered view after view: the view is the last one whose first tile, `tile_base`, is not beyond the tile.
template <class View>
__device__ __forceinline__ int view_of_tile(const View* __restrict__ views, int num_views, int tile) {
    return partition_point(1, num_views, [&](int view) { return views[view].tile_base <= tile; }) - 1;
}

}  // namespace turbogs
