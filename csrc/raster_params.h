// Parameters of the raster kernels: plain structs of raw pointers, one per launcher, passed by value. No torch here.
//
// Index spaces: K views of the batch, N Gaussians, instance = view * N + Gaussian (K * N of them, not compacted);
// T active tiles (those that hold samples), "tile position" = index into them, "tile id" = number in the batch's
// TileGrid; P sample slots; pair = (tile position, instance), M of them at most ("capacity").
#pragma once

#include <cuda_runtime.h>

#include <cstddef>
#include <cstdint>

#include "camera.cuh"
#include "scene_params.h"
#include "sizes.h"

namespace turbogs {

constexpr int kBucket = 32;                  // splats staged at once; one contribution mask holds one bucket
constexpr int kScanTiles = 1024;             // of a block that finds the first pairs of tiles
constexpr int kRun = 512;                    // pairs of a tile that a warp sorts
constexpr uint32_t kMaxPairs = 0x7FFFFFFFu;  // the pair count saturates here instead of wrapping

// One view as the kernels read it, 112 bytes. Written by the projection launcher.
struct alignas(16) RasterCamera : Pinhole {
    int tiles_y;
    int width, height;   // pixels
    int tiles_x;
    int tile_base;       // id of the view's first tile
    SlopeBounds slopes;  // where the Jacobian is taken
};

// A splat on the screen, 48 bytes: what the tile stages gather.
struct alignas(16) Instance {
    float x, y;          // pixels
    float conic_a, conic_b;
    float conic_c;
    float opacity;       // after the sigmoid
    float depth;
    float log_reach;     // log(opacity / alpha_min): sigma beyond which the splat is invisible
    float red, green, blue;  // after the clamp at 0
    float inverse_sigma_y;  // 1 / standard deviation along y
};

// Stage 1. K views of every Gaussian; parameters are read once.
struct ProjectionParams : SceneParams {
    int num_tiles;   // tiles of all views
    int num_active;  // T
    float near_plane, far_plane, alpha_min;
    const int32_t* tile_ids;  // [T] ascending, or null where every tile is active

    RasterCamera* cameras;    // [K] out
    int32_t* active_prefix;   // [num_tiles + 1] out: active tiles with a smaller id; null where every tile is active
    Instance* instances;      // [K, N] out, where the radius is not 0
    int2* radii;              // [K, N] out, 0 where off screen
    int32_t* tile_differences;  // [T + 1] out: splats that reach each active tile, less those of the tile before it
    float4* records;          // [K, N, 4] set to zero where the radius is not 0, for stage 6; or null
};

// Lengths of the two lists that stage 3 makes on the way.
struct PairCounters {
    uint32_t num_windows, num_runs;
};

// Stage 2. First pair of each tile.
struct CountPairsParams {
    int num_active;         // T
    uint32_t capacity;      // M, or kMaxPairs where it is not known yet
    int32_t* tile_cursors;  // [T + 1] in: the projection's differences; out: first pair of each tile
    uint32_t* tile_starts;  // [T + 1] out: the same, and the number of pairs; all 0 in a pass that overflows
    uint32_t* status;       // [2]: [0] out: pairs of this pass; [1] sticky flag, raised where they exceed the capacity.
                            // No pair is made while it is up.
    PairCounters* counters; // out: zeros
    int64_t* block_sums;    // [ceil(T / kScanTiles), 2] scratch
};

// Stage 3. Pairs to their tiles.
struct ScatterPairsParams {
    int num_instances;
    int num_gaussians;
    int num_active;               // T
    const Instance* instances;    // [K, N]
    const int2* radii;            // [K, N]
    const RasterCamera* cameras;
    const int32_t* active_prefix; // or null
    const uint32_t* tile_starts;  // [T + 1]
    const uint32_t* status;       // [2]
    int32_t* tile_cursors;        // [T + 1] in: first pair of each tile; changed
    uint64_t* pair_keys;          // [M] out: depth and instance of each pair
    uint32_t capacity;            // M
    PairCounters* counters;       // in: zeros
    uint2* windows;               // [M / 2] scratch: (instance, number) of every window of a large splat
    int2* runs;                   // [M / (kRun / 2)] out: (tile, number) of every run of kRun pairs, of tiles with more
                                  // pairs than that: those have kRun / 2 pairs or more for each run
};

// Stage 4. Every tile's pairs in order of depth, then of the instance.
struct SortPairsParams {
    int num_active;               // T
    uint32_t capacity;            // M
    const uint32_t* tile_starts;  // [T + 1]
    const PairCounters* counters;
    const int2* runs;             // [M / (kRun / 2)]
    uint64_t* pair_keys;          // [M] changed
    uint32_t* pair_ids;           // [M] out: instance of each pair
};

// Stage 5. One warp for each work item = (tile position, chunk): slots chunk * 32 ... chunk * 32 + 31 of the tile. Further
// slots of a tile follow with a stride of `chunks` chunks, so any number of slots is rendered.
struct ForwardParams {
    int num_views;
    int num_active;         // T
    int chunks;             // C, work items of a tile
    float alpha_min, alpha_max, transmittance_min;
    const RasterCamera* cameras;
    const int32_t* tile_ids;      // [T], or null where every tile is active
    const int32_t* tile_offsets;  // [T + 1] first slot of each tile
    const int32_t* pixel_ids;     // [P], -1 empty
    const uint32_t* tile_starts;  // [T + 1]
    const uint32_t* pair_ids;     // [M]
    const Instance* instances;    // [K, N]

    float* colors;          // [P, 3] out
    float* alphas;          // [P] out
    float* transmittances;  // [P] out, 1 - alpha without the cancellation
    float* depths;          // [P] out, or null
    int32_t* last_pairs;    // [P] out, the last pair that contributed, counted from the tile's first; -1 none
    uint32_t* masks;        // [(M / 32 + T + 1) * C] out: bit of each splat of a bucket that contributed to the item.
                            // Bucket j of item (t, c) is word ((tile_starts[t] / 32 + t) + j) * C + c.
    int32_t* bucket_counts; // [T, C] out, buckets that the item walked
};

// Stage 6. Same work items; gradients on the screen.
struct BackwardParams {
    ForwardParams forward;            // as given to stage 5; its outputs are inputs here
    int num_instances;
    bool with_density_sums;           // fill what only densification asks for: sum D * w and the absolute sums; else zeros
    bool cleared;                     // `screen_gradients` is zero where the radius is not 0
    const float* color_gradients;     // [P, 3]
    const float* alpha_gradients;     // [P] or null
    const float* depth_gradients;     // [P] or null
    const float* pixel_errors;        // [P] or null
    float* screen_gradients;          // [K, N, 16] out; off screen zero, or where `cleared`, left alone
};

// Every launcher returns the first CUDA error, and only enqueues work on `stream`.
cudaError_t launch_projection(const ProjectionParams& params, cudaStream_t stream);
cudaError_t launch_count_pairs(const CountPairsParams& params, cudaStream_t stream);
cudaError_t launch_scatter_pairs(const ScatterPairsParams& params, cudaStream_t stream);
cudaError_t launch_sort_pairs(const SortPairsParams& params, cudaStream_t stream);
cudaError_t launch_rasterize_forward(const ForwardParams& params, cudaStream_t stream);
cudaError_t launch_rasterize_backward(const BackwardParams& params, cudaStream_t stream);

}  // namespace turbogs
