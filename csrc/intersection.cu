// Stages 2 and 3: which splats each active tile must look at, front to back.
//
// The projection has counted every tile's splats, as differences along the rows of tiles; their double running sum is the
// first pair of each tile. Splats then put their pairs into their tiles in any order, and each tile is sorted by itself, by
// depth and then by instance: keys differ, so the result does not depend on the order they came in. Nothing here needs the
// number of pairs on the host.
#include "common.cuh"

namespace turbogs {
namespace {

// Sum over the lanes up to and including this one.
template <class Number>
__device__ __forceinline__ Number sum_to_lane(Number value, int lane) {
#pragma unroll
    for (int step = 1; step < kWarpSize; step *= 2) {
        const Number below = __shfl_up_sync(kFullWarp, value, step);
        if (lane >= step) value += below;
    }
    return value;
}

// ---- First pairs of the tiles ----------------------------------------------------------------------------------

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
        const uint32_t count = static_cast<uint32_t>(min(all_pairs, static_cast<int64_t>(kMaxPairs)));
        params.tile_starts[params.num_active] = lost ? 0u : count;
        params.status[0] = count;
        if (lost) params.status[1] = 1u;  // other blocks may read it before or after: they find the same
        *params.num_deferred = 0u;
    }
}

// ---- Pairs to their tiles --------------------------------------------------------------------------------------

constexpr int kThreads = 256;
constexpr int kScatterWarps = kThreads / kWarpSize;
constexpr int kScatterInstances = 512;  // of a block
constexpr int kWindow = 512;            // pairs that a warp takes on, of a splat whose box has more tiles
constexpr int kUnderWay = 4;            // places that a lane waits for at a time

// What it takes to enumerate the pairs of a splat.
struct Emission {
    uint64_t key;
    const RasterCamera* camera;
    Reach reach;
    int2 rows;
};

__device__ __forceinline__ Emission make_emission(const SortPairsParams& params, uint32_t instance, int& box_tiles) {
    Emission out;
    out.camera = params.cameras + instance / static_cast<uint32_t>(params.num_gaussians);
    const float4* splat = reinterpret_cast<const float4*>(params.instances + instance);
    const float4 first = splat[0], second = splat[1];
    out.key = static_cast<uint64_t>(__float_as_uint(second.z)) << 32 | instance;
    out.reach = make_reach(first.x, first.y, first.z, first.w, second.x, second.w);
    out.rows = tile_rows(out.reach, out.camera->tiles_y);
    const int2 columns =
        tile_span(out.reach.x - out.reach.half_x, out.reach.x + out.reach.half_x, out.camera->tiles_x);
    box_tiles = (out.rows.y - out.rows.x) * (columns.y - columns.x);
    return out;
}

__device__ __forceinline__ int2 tiles_of_row(const SortPairsParams& params, const Emission& emission, int row) {
    const RasterCamera& camera = *emission.camera;
    return active_tiles(camera, params.active_prefix, row, tile_columns(emission.reach, row, camera.tiles_x));
}

// The lane whose share holds item `number`, `sum` being the sum of shares up to and including the lane's.
__device__ __forceinline__ int owner_of(int number, int sum) {
    int owner = 0;
#pragma unroll
    for (int step = kWarpSize / 2; step > 0; step /= 2) {
        if (__shfl_sync(kFullWarp, sum, owner + step - 1) <= number) owner += step;
    }
    return owner;
}

// Each lane brings the tiles of a row and their key. Of the pairs of all lanes, begin .. end - 1 go to their tiles, each by a
// lane of its own. Returns the number of pairs of all lanes.
__device__ __forceinline__ int emit_rows(const SortPairsParams& params, int2 tiles, uint64_t key, int begin, int end, int lane) {
    const int count = tiles.y - tiles.x;
    const int sum = sum_to_lane(count, lane);
    const int total = __shfl_sync(kFullWarp, sum, kWarpSize - 1);
    const int shift = tiles.x - (sum - count);  // from the number of a pair to its tile
    end = min(end, total);
    for (int base = begin; base < end; base += kUnderWay * kWarpSize) {
        uint64_t keys[kUnderWay];
        uint32_t places[kUnderWay];
#pragma unroll
        for (int i = 0; i < kUnderWay; ++i) {
            if (base + i * kWarpSize >= end) break;
            const int number = base + i * kWarpSize + lane;
            const int owner = owner_of(number, sum);
            const int tile = number + __shfl_sync(kFullWarp, shift, owner);
            keys[i] = __shfl_sync(kFullWarp, key, owner);
            if (number < end) places[i] = atomicAdd(reinterpret_cast<unsigned*>(params.tile_cursors) + tile, 1u);
        }
#pragma unroll
        for (int i = 0; i < kUnderWay; ++i) {
            if (base + i * kWarpSize + lane < end) params.pair_keys[places[i]] = keys[i];
        }
    }
    return total;
}

// A warp puts pairs begin .. begin + kWindow - 1 of one splat into their tiles.
__device__ __forceinline__ void emit_window(const SortPairsParams& params, const Emission& emission, int begin, int lane) {
    int first = 0;  // pair of the rows at hand
    for (int base = emission.rows.x; base < emission.rows.y && first < begin + kWindow; base += kWarpSize) {
        const int row = base + lane;
        const int2 tiles = row < emission.rows.y ? tiles_of_row(params, emission, row) : make_int2(0, 0);
        first += emit_rows(params, tiles, emission.key, max(begin - first, 0), begin + kWindow - first, lane);
    }
}

__global__ void __launch_bounds__(kThreads) scatter_kernel(const __grid_constant__ SortPairsParams params) {
    __shared__ uint32_t visible[kScatterInstances], large[kScatterInstances];
    __shared__ Emission emissions[kThreads];
    __shared__ int num_visible, num_large;
    if (params.status[1] != 0u) return;
    const int lane = threadIdx.x % kWarpSize, warp = threadIdx.x / kWarpSize;
    if (threadIdx.x == 0) num_visible = num_large = 0;
    __syncthreads();
#pragma unroll
    for (int i = 0; i < kScatterInstances; i += kThreads) {
        const int instance = blockIdx.x * kScatterInstances + i + threadIdx.x;
        const int2 radius = instance < params.num_instances ? params.radii[instance] : make_int2(0, 0);
        const bool seen = radius.x > 0 || radius.y > 0;
        const uint32_t lanes = __ballot_sync(kFullWarp, seen);
        int place = 0;
        if (lane == 0) place = atomicAdd(&num_visible, __popc(lanes));
        place = __shfl_sync(kFullWarp, place, 0) + __popc(lanes & ((1u << lane) - 1u));
        if (seen) visible[place] = static_cast<uint32_t>(instance);
    }
    __syncthreads();

    // A warp takes splats together, a lane for each of their rows, then a lane for each pair of those rows.
    Emission* splats = emissions + warp * kWarpSize;
    for (int base = warp * kWarpSize; base < num_visible; base += kThreads) {
        int rows = 0;
        if (base + lane < num_visible) {
            int box_tiles;
            splats[lane] = make_emission(params, visible[base + lane], box_tiles);
            if (box_tiles <= kWindow) rows = splats[lane].rows.y - splats[lane].rows.x;
            else large[atomicAdd(&num_large, 1)] = visible[base + lane];
        }
        __syncwarp();
        const int sum = sum_to_lane(rows, lane);
        const int total = __shfl_sync(kFullWarp, sum, kWarpSize - 1);
        for (int first = 0; first < total; first += kWarpSize) {
            const int number = first + lane;
            const int owner = owner_of(number, sum);
            const int before = __shfl_sync(kFullWarp, sum - rows, owner);
            const Emission& emission = splats[owner];
            const int2 tiles = number < total ? tiles_of_row(params, emission, emission.rows.x + number - before)
                                              : make_int2(0, 0);
            emit_rows(params, tiles, emission.key, 0, kWarpSize * kWindow, lane);
        }
        __syncwarp();
    }
    __syncthreads();

    // Windows of large splats go round the warps.
    int window = warp;
    for (int i = 0; i < num_large; ++i) {
        int box_tiles;
        const Emission emission = make_emission(params, large[i], box_tiles);
        const int windows = (box_tiles + kWindow - 1) / kWindow;
        for (; window < windows; window += kScatterWarps) emit_window(params, emission, window * kWindow, lane);
        window -= windows;
    }
}

// ---- A tile's pairs in order -----------------------------------------------------------------------------------

constexpr int kSortWarps = 4;        // of a block, a tile each
constexpr int kStagedPairs = 512;    // that a warp keeps in shared memory
constexpr int kWarpPairs = 1024;     // of a tile at most; a block sorts those with more
constexpr int kRepairs = 8;

struct SortShared {
    uint64_t keys[kStagedPairs];
    uint16_t order[kWarpPairs];
};

// Sorts 32 * kPer numbers, lane * kPer + i being the place of a lane's i-th: a bitonic network whose comparators all point
// the same way.
template <int kPer>
__device__ __forceinline__ void sort_numbers(uint32_t numbers[kPer], int lane) {
    const auto order = [&](int a, int b) {
        const uint32_t low = min(numbers[a], numbers[b]), high = max(numbers[a], numbers[b]);
        numbers[a] = low;
        numbers[b] = high;
    };
#pragma unroll
    for (int size = 2; size <= kWarpSize * kPer; size *= 2) {
        // Halves face each other, first with last.
        if (size <= kPer) {
#pragma unroll
            for (int i = 0; i < kPer; ++i) {
                if ((i ^ (size - 1)) > i) order(i, i ^ (size - 1));
            }
        } else {
            const int lanes = size / kPer;
            const bool lower = (lane & (lanes / 2)) == 0;
#pragma unroll
            for (int i = 0; i < (kPer + 1) / 2; ++i) {
                const int j = kPer - 1 - i;
                const uint32_t other_i = __shfl_xor_sync(kFullWarp, numbers[j], lanes - 1);
                const uint32_t other_j = __shfl_xor_sync(kFullWarp, numbers[i], lanes - 1);
                numbers[i] = lower ? min(numbers[i], other_i) : max(numbers[i], other_i);
                if (j > i) numbers[j] = lower ? min(numbers[j], other_j) : max(numbers[j], other_j);
            }
        }
#pragma unroll
        for (int distance = size / 4; distance > 0; distance /= 2) {
            if (distance < kPer) {
#pragma unroll
                for (int i = 0; i < kPer; ++i) {
                    if ((i & distance) == 0) order(i, i + distance);
                }
            } else {
                const bool lower = (lane & (distance / kPer)) == 0;
#pragma unroll
                for (int i = 0; i < kPer; ++i) {
                    const uint32_t other = __shfl_xor_sync(kFullWarp, numbers[i], distance / kPer);
                    numbers[i] = lower ? min(numbers[i], other) : max(numbers[i], other);
                }
            }
        }
    }
}

// Writes the ids in order. Returns whether the order is right.
__device__ __forceinline__ bool write_ids(const uint64_t* keys, const uint16_t* order, int count, uint32_t* ids, int lane) {
    bool right = true;
    uint32_t last_depth = 0, last_id = 0;  // of the lane below; of the last lane for the next step
    for (int base = 0; base < count; base += kWarpSize) {
        const int place = base + lane;
        const uint64_t key = place < count ? keys[order[place]] : ~uint64_t{0};
        const uint32_t depth = static_cast<uint32_t>(key >> 32), id = static_cast<uint32_t>(key);
        const uint32_t depth_below = __shfl_up_sync(kFullWarp, depth, 1), id_below = __shfl_up_sync(kFullWarp, id, 1);
        if (lane > 0) last_depth = depth_below, last_id = id_below;
        if (depth < last_depth || (depth == last_depth && id < last_id)) right = false;
        last_depth = __shfl_sync(kFullWarp, depth, kWarpSize - 1);
        last_id = __shfl_sync(kFullWarp, id, kWarpSize - 1);
        if (place < count) ids[place] = id;
    }
    return !__any_sync(kFullWarp, !right);
}

// Swaps neighbours that are out of order.
__device__ __forceinline__ void repair(const uint64_t* keys, uint16_t* order, int count, int lane) {
#pragma unroll
    for (int parity = 0; parity < 2; ++parity) {
        for (int place = 2 * lane + parity; place + 1 < count; place += 2 * kWarpSize) {
            const uint16_t a = order[place], b = order[place + 1];
            if (keys[a] > keys[b]) {
                order[place] = b;
                order[place + 1] = a;
            }
        }
        __syncwarp();
    }
}

// One warp sorts up to 32 * kPer pairs. It sorts 32-bit numbers: as many bits of the depth, less the tile's nearest, as the
// place in the tile leaves room for, then that place. Depths that agree in all these bits may be out of order; they are
// neighbours, and swapped. Returns whether that has sufficed.
template <int kPer>
__device__ __forceinline__ bool sort_tile(const uint64_t* __restrict__ pairs, int count, uint32_t* ids, SortShared& shared,
                                          int lane) {
    constexpr int kPlaceBits = kPer == 1 ? 5 : kPer == 2 ? 6 : kPer == 4 ? 7 : kPer == 8 ? 8 : kPer == 16 ? 9 : 10;
    constexpr bool kStaged = kWarpSize * kPer <= kStagedPairs;
    uint32_t numbers[kPer];
    uint32_t nearest = 0xFFFFFFFFu, farthest = 0u;
#pragma unroll
    for (int i = 0; i < kPer; ++i) {
        const int place = i * kWarpSize + lane;
        if (place < count) {
            const uint64_t key = pairs[place];
            if (kStaged) shared.keys[place] = key;
            numbers[i] = static_cast<uint32_t>(key >> 32);
            nearest = min(nearest, numbers[i]);
            farthest = max(farthest, numbers[i]);
        }
    }
    nearest = __reduce_min_sync(kFullWarp, nearest);
    farthest = __reduce_max_sync(kFullWarp, farthest);
    const int shift = max(0, kPlaceBits - __clz(farthest - nearest));
#pragma unroll
    for (int i = 0; i < kPer; ++i) {
        const int place = i * kWarpSize + lane;
        numbers[i] = place < count ? (numbers[i] - nearest) >> shift << kPlaceBits | place : 0xFFFFFFFFu;
    }
    sort_numbers<kPer>(numbers, lane);
    constexpr uint32_t kPlaceMask = (1u << kPlaceBits) - 1u;
    if (kPer == 1) {
        shared.order[lane] = static_cast<uint16_t>(numbers[0] & kPlaceMask);
    } else {
#pragma unroll
        for (int i = 0; i + 1 < kPer; i += 2) {
            reinterpret_cast<uint32_t*>(shared.order)[(lane * kPer + i) / 2] =
                (numbers[i] & kPlaceMask) | (numbers[i + 1] & kPlaceMask) << 16;
        }
    }
    __syncwarp();
    const uint64_t* keys = kStaged ? shared.keys : pairs;
    for (int round = 0; !write_ids(keys, shared.order, count, ids, lane); ++round) {
        if (round == kRepairs) return false;
        repair(keys, shared.order, count, lane);
    }
    return true;
}

__global__ void __launch_bounds__(kSortWarps* kWarpSize, 8)
    sort_tiles_kernel(const __grid_constant__ SortPairsParams params) {
    __shared__ SortShared shareds[kSortWarps];
    const int lane = threadIdx.x % kWarpSize;
    const int tile = blockIdx.x * kSortWarps + threadIdx.x / kWarpSize;
    if (tile >= params.num_active) return;
    SortShared& shared = shareds[threadIdx.x / kWarpSize];
    const uint32_t first = params.tile_starts[tile];
    const int count = static_cast<int>(params.tile_starts[tile + 1] - first);
    const uint64_t* pairs = params.pair_keys + first;
    uint32_t* ids = params.pair_ids + first;
    bool done = true;
    if (count == 0) return;
    if (count <= kWarpSize) done = sort_tile<1>(pairs, count, ids, shared, lane);
    else if (count <= 2 * kWarpSize) done = sort_tile<2>(pairs, count, ids, shared, lane);
    else if (count <= 4 * kWarpSize) done = sort_tile<4>(pairs, count, ids, shared, lane);
    else if (count <= 8 * kWarpSize) done = sort_tile<8>(pairs, count, ids, shared, lane);
    else if (count <= 16 * kWarpSize) done = sort_tile<16>(pairs, count, ids, shared, lane);
    else if (count <= kWarpPairs) done = sort_tile<32>(pairs, count, ids, shared, lane);
    else done = false;
    if (!done && lane == 0) params.deferred[atomicAdd(params.num_deferred, 1u)] = tile;
}

// ---- Tiles with many pairs, or with many of one depth ----------------------------------------------------------

constexpr int kChunk = 4096;           // keys in shared memory
constexpr int kDeferredThreads = 1024;
constexpr int kDeferredBlocks = 264;

// A stage of the bitonic network over keys 0 .. count - 1, behind which there are none smaller: within blocks of `size`, first
// with last where `facing`, else each with the one half a block on.
__device__ __forceinline__ void order_stage(uint64_t* keys, int count, int size, bool facing) {
    const int half = size / 2;
    for (int i = threadIdx.x;; i += kDeferredThreads) {
        const int low = 2 * (i & -half) | (i & (half - 1)), high = facing ? low ^ (size - 1) : low + half;
        if (low >= count) break;
        if (high >= count) continue;
        const uint64_t a = keys[low], b = keys[high];
        if (a > b) {
            keys[low] = b;
            keys[high] = a;
        }
    }
    __syncthreads();
}

// The stages of sizes `size` and below, of each chunk in shared memory; from nothing where `whole`.
__device__ __forceinline__ void order_chunks(uint64_t* pairs, int count, bool whole, uint64_t* shared) {
    for (int first = 0; first < count; first += kChunk) {
        const int length = min(kChunk, count - first);
        for (int i = threadIdx.x; i < length; i += kDeferredThreads) shared[i] = pairs[first + i];
        __syncthreads();
        for (int size = whole ? 2 : kChunk; size <= kChunk && !(whole && size / 2 >= length); size *= 2) {
            for (int part = size; part > 1; part /= 2) order_stage(shared, length, part, whole && part == size);
        }
        for (int i = threadIdx.x; i < length; i += kDeferredThreads) pairs[first + i] = shared[i];
        __syncthreads();
    }
}

__global__ void __launch_bounds__(kDeferredThreads) sort_deferred_kernel(const __grid_constant__ SortPairsParams params) {
    __shared__ uint64_t shared[kChunk];
    const int deferred = static_cast<int>(*params.num_deferred);
    for (int i = blockIdx.x; i < deferred; i += gridDim.x) {
        const int tile = params.deferred[i];
        const uint32_t first = params.tile_starts[tile];
        const int count = static_cast<int>(params.tile_starts[tile + 1] - first);
        uint64_t* pairs = params.pair_keys + first;
        order_chunks(pairs, count, true, shared);
        for (int size = 2 * kChunk; size / 2 < count; size *= 2) {
            for (int part = size; part > kChunk; part /= 2) order_stage(pairs, count, part, part == size);
            order_chunks(pairs, count, false, shared);
        }
        for (int j = threadIdx.x; j < count; j += kDeferredThreads) params.pair_ids[first + j] = static_cast<uint32_t>(pairs[j]);
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

cudaError_t launch_sort_pairs(const SortPairsParams& params, cudaStream_t stream) {
    if (params.num_instances == 0 || params.num_active == 0) return cudaSuccess;
    scatter_kernel<<<(params.num_instances + kScatterInstances - 1) / kScatterInstances, kThreads, 0, stream>>>(params);
    if (const cudaError_t error = cudaGetLastError()) return error;
    sort_tiles_kernel<<<(params.num_active + kSortWarps - 1) / kSortWarps, kSortWarps * kWarpSize, 0, stream>>>(params);
    if (const cudaError_t error = cudaGetLastError()) return error;
    const int blocks = params.num_active < kDeferredBlocks ? params.num_active : kDeferredBlocks;
    sort_deferred_kernel<<<blocks, kDeferredThreads, 0, stream>>>(params);
    return cudaGetLastError();
}

}  // namespace turbogs
