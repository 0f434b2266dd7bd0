// Stage 2: the first pair of each tile, and whether all pairs have room.
//
// The projection has counted every tile's splats as differences along the rows of tiles: the running sum of those are the
// splats of each tile, and the running sum of these the first pairs. Two launches make both at once, a block for each
// kScanTiles tiles and eight tiles a thread. The first leaves for each block the sum of its differences, and its pairs as if
// no splat came in from the blocks before it. In the second every block sums what the blocks before it left, adds for each
// splat that comes in the tiles that it goes through, and writes its tiles' first pairs. Sums are 64 bits wide, so that a pass
// with more pairs than fit is noticed: it leaves every tile empty and raises the flag.
#include "raster_params.h"
#include "warp.cuh"

namespace turbogs {
namespace {

constexpr int kScanThreads = kScanTiles / 8;  // each takes eight tiles
constexpr int kScanWarps = kScanThreads / kWarpSize;

// Sum over the block's threads up to and including this one, and over all of them. Barriers inside.
__device__ __forceinline__ int64_t sum_to_thread(int64_t value, int64_t& total) {
    __shared__ int64_t warp_sums[kScanWarps];
    const int lane = threadIdx.x % kWarpSize, warp = threadIdx.x / kWarpSize;
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

// The running sum of a thread's eight differences, within the thread.
__device__ __forceinline__ void load_differences(const CountPairsParams& params, int first, int64_t splats[8]) {
    int64_t sum = 0;
#pragma unroll
    for (int i = 0; i < 8; ++i) {
        if (first + i < params.num_active) sum += params.tile_cursors[first + i];
        splats[i] = sum;
    }
}

// Of each block of tiles: the sum of its differences, and its pairs if no splat reached in from the tiles before it.
__global__ void __launch_bounds__(kScanThreads) sum_tiles_kernel(const __grid_constant__ CountPairsParams params) {
    const int first = blockIdx.x * kScanTiles + threadIdx.x * 8;
    int64_t splats[8], total_splats, total_pairs;
    load_differences(params, first, splats);
    const int64_t before = sum_to_thread(splats[7], total_splats) - splats[7];
    int64_t pairs = 0;
#pragma unroll
    for (int i = 0; i < 8; ++i) {
        if (first + i < params.num_active) pairs += before + splats[i];
    }
    sum_to_thread(pairs, total_pairs);
    if (threadIdx.x == 0) {
        params.block_sums[2 * blockIdx.x] = total_splats;
        params.block_sums[2 * blockIdx.x + 1] = total_pairs;
    }
}

__global__ void __launch_bounds__(kScanThreads) start_tiles_kernel(const __grid_constant__ CountPairsParams params) {
    const int block = blockIdx.x, blocks = gridDim.x;
    // A splat that enters in block i and is not left goes on through all tiles of the blocks between.
    int64_t splats_before = 0, pairs_before = 0, all_pairs = 0;
    for (int i = threadIdx.x; i < blocks; i += kScanThreads) {
        const int64_t splats = params.block_sums[2 * i], pairs = params.block_sums[2 * i + 1];
        const int last_tiles = params.num_active - (blocks - 1) * kScanTiles;
        all_pairs += pairs + (i < blocks - 1 ? splats * (static_cast<int64_t>(blocks - 2 - i) * kScanTiles + last_tiles) : 0);
        if (i < block) {
            splats_before += splats;
            pairs_before += pairs + splats * (static_cast<int64_t>(block - 1 - i) * kScanTiles);
        }
    }
    sum_to_thread(splats_before, splats_before);
    sum_to_thread(pairs_before, pairs_before);
    sum_to_thread(all_pairs, all_pairs);

    const int first = block * kScanTiles + threadIdx.x * 8;
    int64_t splats[8], total;
    load_differences(params, first, splats);
    splats_before += sum_to_thread(splats[7], total) - splats[7];
    int64_t pairs = 0;
#pragma unroll
    for (int i = 0; i < 8; ++i) {
        if (first + i < params.num_active) pairs += splats_before + splats[i];
    }
    int64_t start = pairs_before + sum_to_thread(pairs, total) - pairs;
    const bool lost = all_pairs > params.capacity || params.status[1] != 0u;
#pragma unroll
    for (int i = 0; i < 8; ++i) {
        if (first + i >= params.num_active) break;
        params.tile_starts[first + i] = lost ? 0u : static_cast<uint32_t>(start);
        params.tile_cursors[first + i] = static_cast<int32_t>(start);
        start += splats_before + splats[i];
    }
    if (block == 0 && threadIdx.x == 0) {
        params.counters->num_windows = params.counters->num_runs = 0u;
        const uint32_t count = static_cast<uint32_t>(min(all_pairs, static_cast<int64_t>(kMaxPairs)));
        params.tile_starts[params.num_active] = lost ? 0u : count;
        params.status[0] = count;
        if (lost) params.status[1] = 1u;  // other blocks may read it before or after: they find the same
    }
}

}  // namespace

cudaError_t launch_count_pairs(const CountPairsParams& params, cudaStream_t stream) {
    const int blocks = params.num_active > 0 ? (params.num_active + kScanTiles - 1) / kScanTiles : 1;
    sum_tiles_kernel<<<blocks, kScanThreads, 0, stream>>>(params);
    if (const cudaError_t error = cudaGetLastError()) return error;
    start_tiles_kernel<<<blocks, kScanThreads, 0, stream>>>(params);
    return cudaGetLastError();
}

}  // namespace turbogs
