// Parameters of the raster kernels: plain structs of raw pointers, one for each launcher, passed by value. No torch
// here.
//
// Index spaces: K views of the batch; N Gaussians; an instance is a Gaussian in a view, number view * N + Gaussian (K
// * N of them, not compacted). T active tiles are those that hold samples: a "tile position" is an index into them, a
// "tile id" the number of a tile in the batch's TileGrid. P sample slots. An intersection is an instance in an active
// tile that it reaches; a pass has room for M of them (its "capacity").
#pragma once

#include <cstddef>

#include "common/camera.cuh"
#include "common/philox.h"
#include "common/batch.h"

namespace turbogs {

// A tile with more than kSortRun intersections has at least kLeastOfRun for each of its runs: a bound of their number.
constexpr int kLeastOfRun = kSortRun / 2;

// One view as the kernels read it. Written by the projection's launcher.
struct alignas(16) RasterCamera : Pinhole {
    int tiles_y;
    int width, height;   // pixels
    int tiles_x;
    int tile_base;       // id of the view's first tile
    int origin_x, origin_y;  // pixels by which the grid of tiles begins before the image
    SlopeBounds slopes;  // where the Jacobian is taken
};
static_assert(sizeof(RasterCamera) == CameraRow::kSize * sizeof(float), "as layout.py has it");

// A splat on the screen: what the tile stages gather.
struct alignas(16) Instance {
    float x, y;  // pixels
    float conic_a, conic_b;
    float conic_c;
    float opacity;  // after the sigmoid
    float depth;
    float log_reach;         // log(opacity / alpha_min): sigma beyond which the splat is invisible
    float red, green, blue;  // after the clamp at 0
    float inverse_sigma_y;   // 1 / standard deviation along y
};
static_assert(offsetof(Instance, conic_a) == sizeof(float) * InstanceRow::kConic &&
                  offsetof(Instance, opacity) == sizeof(float) * InstanceRow::kOpacity &&
                  offsetof(Instance, depth) == sizeof(float) * InstanceRow::kDepth,
              "as layout.py has it");
static_assert(sizeof(Instance) == InstanceRow::kSize * sizeof(float), "as layout.py has it");

// Stage 1. K views of every Gaussian; parameters are read once.
struct ProjectionParams : SceneParams {
    int num_tiles;   // tiles of all views
    int num_active;  // T
    int origin_x, origin_y;
    float near_plane, far_plane, alpha_min;
    uint32_t dropout_threshold;  // a Gaussian is left out whose word is below this; 0: none
    PhiloxKeys dropout_keys;
    const int32_t* tile_ids;  // [T] ascending, or null where every tile is active

    RasterCamera* cameras;      // [K] out
    int32_t* active_prefix;     // [num_tiles + 1] out: active tiles with a smaller id; null where every tile is active
    Instance* instances;        // [K, N] out, where the radius is not 0
    int2* radii;                // [K, N] out, 0 where off screen
    int32_t* tile_differences;  // [T + 1] out: splats that reach each active tile, less the tile before it
    float4* records;            // [K, N, 4] set to zero where the radius is not 0, for stage 6; or null
};

// Lengths of the two lists that stage 3 makes on the way.
struct IntersectionCounters {
    uint32_t num_windows, num_runs;
};

// Blocks of stage 2.
inline int scan_blocks(int tiles) { return tiles > 0 ? blocks_for(tiles, kScanTiles) : 1; }

// Stage 2. First intersection of each tile.
struct CountIntersectionsParams {
    int num_active;                  // T
    uint32_t capacity;               // M, or kIntersectionsMax where it is not known yet
    int32_t* tile_cursors;           // [T + 1] in: the projection's differences; out: first intersection of each tile
    uint32_t* tile_starts;           // [T + 1] out: the same, and the number of intersections; zeros after an overflow
    uint32_t* status;                // [2] out: intersections of this pass; a flag that is raised where they exceed the
                                     // capacity, and stays. No intersection is made while it is up.
    IntersectionCounters* counters;  // out: zeros
    int64_t* block_sums;             // [scan_blocks(T), 2] scratch
};

// Stages 3 and 4. Intersections to their tiles, and there in order of depth, then of the instance.
struct SortIntersectionsParams {
    int num_instances;
    int num_gaussians;
    int num_active;             // T
    const Instance* instances;  // [K, N]
    const int2* radii;          // [K, N]
    const RasterCamera* cameras;
    const int32_t* active_prefix;  // or null
    const uint32_t* tile_starts;   // [T + 1]
    const uint32_t* status;        // [2]
    int32_t* tile_cursors;         // [T + 1] in: first intersection of each tile; changed
    uint64_t* intersection_keys;   // [M] scratch: depth and instance of each intersection
    uint32_t capacity;             // M
    IntersectionCounters* counters;  // in: zeros
    uint2* windows;                  // [M / 2] scratch: (instance, number) of every window of a large splat; in the
                                     // memory of `intersection_ids`, which stage 4 writes
    int2* runs;                      // [M / kLeastOfRun] scratch: (tile, number) of every run of a tile with several
    uint32_t* intersection_ids;      // [M] out: instance of each intersection
};

// Stage 5. One warp for each work item = (tile position, chunk): the 32 slots of the tile from chunk * 32 on. Further
// slots of a tile follow with a stride of `chunks` chunks, so any number of slots is rendered.
struct ForwardParams {
    int num_views;
    int num_active;  // T
    int chunks;      // C, work items of a tile
    float alpha_min, alpha_max, transmittance_min;
    float background[3];               // the colour that shows through
    const RasterCamera* cameras;
    const int32_t* tile_ids;           // [T], or null where every tile is active
    const int32_t* tile_offsets;       // [T + 1] first slot of each tile
    const int32_t* pixel_ids;          // [P], -1 empty
    const uint32_t* tile_starts;       // [T + 1]
    const uint32_t* intersection_ids;  // [M]
    const Instance* instances;         // [K, N]

    float* colors;                // [P, 3] out
    float* alphas;                // [P] out
    float* transmittances;        // [P] out, 1 - alpha without the cancellation
    float* depths;                // [P] out, or null
    int32_t* last_intersections;  // [P] out, the last that contributed, counted from the tile's first; -1 none
    uint32_t* masks;              // [(M / 32 + T + 1) * C] out: of a bucket a bit for each splat that contributed to
                                  // the item. Bucket j of item (t, c) is word ((tile_starts[t] / 32 + t) + j) * C + c.
    int32_t* bucket_counts;       // [T, C] out, buckets that the item walked
};

// Stage 6. Same work items; gradients on the screen.
struct BackwardParams {
    ForwardParams forward;         // as given to stage 5; its outputs are inputs here
    bool with_density_sums;        // fill what density control asks for: absolute, distance and square sums; else zeros
    const float* color_gradients;  // [P, 3]
    const float* alpha_gradients;  // [P] or null
    const float* depth_gradients;  // [P] or null
    const float* pixel_errors;     // [P], or null: error and distance sums are zero
    float* records;                // [K, N, 16] added to, ScreenRecord
};

// What a process has rendered of a batch: V views of N Gaussians.
struct CollectSource {
    const float4* records;  // [V, N, 4], ScreenRecord
    const int2* radii;      // [V, N]
    int num_views;          // V
    int first_view;         // of the batch
};

// The records of all processes in all K views, for M rows of Gaussians that one of them makes the step of.
struct CollectParams {
    int num_sources;                   // processes with views, in their order
    CollectSource sources[kMaxPeers];  // each begins with the last view of the one before, or the next
    int num_views;                     // K
    int num_gaussians;                 // N
    int num_rows;                      // M
    int first_row;                     // of N
    float4* target_records;            // [K, M, 4] out, where the radius is not 0
    int2* target_radii;                // [K, M] out
};

struct GatherParams {
    int num_peers;                   // processes
    const float* peers[kMaxPeers];   // memory of each; begins with a PassStatus
    int first;                       // number at which colours begin, in each
    int counts[kMaxPeers];           // numbers of each, three a sample
    int starts[kMaxPeers];           // where they go in `colors`
    float* colors;                   // [P, 3] out
    int32_t* seen;                   // [2] out: the largest kOverflow and kStop
    int32_t* overflow;               // [1] out, or null: kOverflow of any
};

void launch_projection(const ProjectionParams& params, cudaStream_t stream);
void launch_count_intersections(const CountIntersectionsParams& params, cudaStream_t stream);
void launch_scatter_intersections(const SortIntersectionsParams& params, cudaStream_t stream);
void launch_sort_intersections(const SortIntersectionsParams& params, cudaStream_t stream);
void launch_rasterize_forward(const ForwardParams& params, cudaStream_t stream);
void launch_rasterize_backward(const BackwardParams& params, cudaStream_t stream);
void launch_collect_records(const CollectParams& params, cudaStream_t stream);
void launch_gather_colors(const GatherParams& params, cudaStream_t stream);

}  // namespace turbogs
