// Stage 2: the first intersection of each tile, and whether all intersections have room. Stages 2 to 4 together are
// defined by turbogs_plugin/engine/reference/intersection.py.
//
// The projection leaves, for each tile, how many more splats reach it than the tile before. The running sum of these
// differences is the number of splats of each tile. The running sum of those numbers is each tile's first intersection.
// Two launches make both sums, with a block for kScanTiles tiles and a thread for eight. The first launch writes two
// sums for each block: its differences, and its intersections without the splats that continue from earlier blocks.
// In the second, every block adds up the sums of all earlier blocks, and counts each splat that continues into it once
// for each tile. Sums have 64 bits, so that too many intersections are noticed: then every tile is left empty and the
// flag is raised.
#include "common/warp.cuh"
#include "raster/raster_params.h"

namespace turbogs {
namespace {

constexpr int kThreadTiles = 8;  // tiles of a thread; no record of other values: the two launches are small
constexpr int kScanThreads = kScanTiles / kThreadTiles;
constexpr int kScanWarps = kScanThreads / kWarpSize;

// Sum over the block's threads up to and including this one, and over all of them. Barriers inside.
__device__ __forceinline__ int64_t sum_to_thread(int64_t value, int64_t& total) {
    __shared__ int64_t warp_sums[kScanWarps];
    const int lane = this_lane(), warp = this_warp();
    value = sum_to_lane(value, lane);
    if (lane == kWarpSize - 1) warp_sums[warp] = value;
    __syncthreads();
    total = 0;
#pragma unroll
    for (int i = 0; i < kScanWarps; ++i) {
        if (i < warp) value += warp_sums[i];
        total += warp_sums[i];
    }
    __syncthreads();
    return value;
}

// The running sum of a thread's differences, from its first tile on.
__device__ __forceinline__ void load_differences(const CountIntersectionsParams& params, int first,
                                                 int64_t splats[kThreadTiles]) {
    int64_t sum = 0;
#pragma unroll
    for (int i = 0; i < kThreadTiles; ++i) {
        if (first + i < params.num_active) sum += params.tile_cursors[first + i];
        splats[i] = sum;
    }
}

__global__ void __launch_bounds__(kScanThreads)
    sum_tiles_kernel(const __grid_constant__ CountIntersectionsParams params) {
    const int first = blockIdx.x * kScanTiles + threadIdx.x * kThreadTiles;
    int64_t splats[kThreadTiles], total_splats, total_intersections;
    load_differences(params, first, splats);
    const int64_t before = sum_to_thread(splats[kThreadTiles - 1], total_splats) - splats[kThreadTiles - 1];
    int64_t intersections = 0;
#pragma unroll
    for (int i = 0; i < kThreadTiles; ++i) {
        if (first + i < params.num_active) intersections += before + splats[i];
    }
    sum_to_thread(intersections, total_intersections);
    if (threadIdx.x == 0) {
        params.block_sums[2 * blockIdx.x] = total_splats;
        params.block_sums[2 * blockIdx.x + 1] = total_intersections;
    }
}

__global__ void __launch_bounds__(kScanThreads)
    start_tiles_kernel(const __grid_constant__ CountIntersectionsParams params) {
    const int block = blockIdx.x, blocks = gridDim.x;
    // Splats that begin in block i and do not end there count in every tile of the blocks between.
    int64_t splats_before = 0, intersections_before = 0, all_intersections = 0;
    for (int i = threadIdx.x; i < blocks; i += kScanThreads) {
        const int64_t splats = params.block_sums[2 * i], intersections = params.block_sums[2 * i + 1];
        const int last_tiles = params.num_active - (blocks - 1) * kScanTiles;
        all_intersections +=
            intersections +
            (i < blocks - 1 ? splats * (static_cast<int64_t>(blocks - 2 - i) * kScanTiles + last_tiles) : 0);
        if (i < block) {
            splats_before += splats;
            intersections_before += intersections + splats * (static_cast<int64_t>(block - 1 - i) * kScanTiles);
        }
    }
    sum_to_thread(splats_before, splats_before);
    sum_to_thread(intersections_before, intersections_before);
    sum_to_thread(all_intersections, all_intersections);

    const int first = block * kScanTiles + threadIdx.x * kThreadTiles;
    int64_t splats[kThreadTiles], total;
    load_differences(params, first, splats);
    splats_before += sum_to_thread(splats[kThreadTiles - 1], total) - splats[kThreadTiles - 1];
    int64_t intersections = 0;
#pragma unroll
    for (int i = 0; i < kThreadTiles; ++i) {
        if (first + i < params.num_active) intersections += splats_before + splats[i];
    }
    int64_t start = intersections_before + sum_to_thread(intersections, total) - intersections;
    const bool lost = all_intersections > params.capacity || params.status[1] != 0u;
#pragma unroll
    for (int i = 0; i < kThreadTiles; ++i) {
        if (first + i >= params.num_active) break;
        params.tile_starts[first + i] = lost ? 0u : static_cast<uint32_t>(start);
        params.tile_cursors[first + i] = static_cast<int32_t>(start);
        start += splats_before + splats[i];
    }
    if (block == 0 && threadIdx.x == 0) {
        params.counters->num_windows = params.counters->num_runs = 0u;
        const uint32_t count = static_cast<uint32_t>(min(all_intersections, static_cast<int64_t>(kIntersectionsMax)));
        params.tile_starts[params.num_active] = lost ? 0u : count;
        params.status[0] = count;
        if (lost) params.status[1] = 1u;  // whether other blocks read it before or after: `lost` is the same in all
    }
}

}  // namespace

void launch_count_intersections(const CountIntersectionsParams& params, cudaStream_t stream) {
    const int blocks = scan_blocks(params.num_active);
    sum_tiles_kernel<<<blocks, kScanThreads, 0, stream>>>(params);
    start_tiles_kernel<<<blocks, kScanThreads, 0, stream>>>(params);
}

}  // namespace turbogs
