// Stages 2 and 3: which splats each active tile must look at, front to back.
//
// The projection has counted every tile's splats, as differences along the rows of tiles; their double running sum is the
// first pair of each tile. Splats then put their pairs into their tiles in any order, and each tile is sorted by itself, by
// depth and then by instance: keys differ, so the result does not depend on the order they came in. Large splats are put into
// their tiles by several warps, window by window, and tiles with many pairs sorted by several, run by run. Nothing here needs
// the number of pairs on the host.
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
        params.counters->num_windows = params.counters->num_runs = 0u;
        const uint32_t count = static_cast<uint32_t>(min(all_pairs, static_cast<int64_t>(kMaxPairs)));
        params.tile_starts[params.num_active] = lost ? 0u : count;
        params.status[0] = count;
        if (lost) params.status[1] = 1u;  // other blocks may read it before or after: they find the same
    }
}

// ---- Pairs to their tiles --------------------------------------------------------------------------------------

constexpr int kThreads = 256;
constexpr int kScatterWarps = kThreads / kWarpSize;
constexpr int kScatterInstances = 512;  // of a block
constexpr int kLargeBox = 96;           // tiles of a splat's box beyond which several warps share its pairs
constexpr int kWindow = 256;            // pairs of such a splat that a warp takes on
constexpr int kWindowBlocks = 528;
constexpr int kUnderWay = 4;            // places that a lane waits for at a time

constexpr uint32_t kNoInstance = 0xFFFFFFFFu;

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

// Lists the windows of a large splat for the next kernel. False where the list has no room: places of it that are left then
// hold no instance.
__device__ __forceinline__ bool list_windows(const SortPairsParams& params, uint32_t instance, int box_tiles) {
    const uint32_t room = params.capacity / 2, windows = static_cast<uint32_t>((box_tiles + kWindow - 1) / kWindow);
    uint2* list = reinterpret_cast<uint2*>(params.pair_ids);  // free until the pairs are sorted
    const uint32_t place = atomicAdd(&params.counters->num_windows, windows);
    const bool fits = place < room && windows <= room - place;
    for (uint32_t i = 0; i < windows && place < room - min(i, room); ++i) {
        list[place + i] = make_uint2(fits ? instance : kNoInstance, i);
    }
    return fits;
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
            if (box_tiles <= kLargeBox) rows = splats[lane].rows.y - splats[lane].rows.x;
            else if (!list_windows(params, visible[base + lane], box_tiles)) large[atomicAdd(&num_large, 1)] = visible[base + lane];
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
            emit_rows(params, tiles, emission.key, 0, kWarpSize * kLargeBox, lane);
        }
        __syncwarp();
    }
    __syncthreads();

    // What has found no room in the list.
    for (int i = 0; i < num_large; ++i) {
        int box_tiles;
        const Emission emission = make_emission(params, large[i], box_tiles);
        for (int begin = warp * kWindow; begin < box_tiles; begin += kScatterWarps * kWindow) {
            emit_window(params, emission, begin, lane);
        }
    }
}

// The windows of the list; and lists the runs of tiles with more than kRun pairs.
__global__ void __launch_bounds__(kThreads) scatter_windows_kernel(const __grid_constant__ SortPairsParams params) {
    if (params.status[1] != 0u) return;
    const int lane = threadIdx.x % kWarpSize, thread = blockIdx.x * kThreads + threadIdx.x;
    const uint2* list = reinterpret_cast<const uint2*>(params.pair_ids);
    const uint32_t num_windows = min(params.counters->num_windows, params.capacity / 2);
    for (uint32_t i = thread / kWarpSize; i < num_windows; i += gridDim.x * kScatterWarps) {
        const uint2 window = list[i];
        if (window.x == kNoInstance) continue;
        int box_tiles;
        const Emission emission = make_emission(params, window.x, box_tiles);
        emit_window(params, emission, static_cast<int>(window.y) * kWindow, lane);
    }
    for (int tile = thread; tile < params.num_active; tile += gridDim.x * kThreads) {
        const int count = static_cast<int>(params.tile_starts[tile + 1] - params.tile_starts[tile]);
        if (count <= kRun) continue;
        const int runs = (count + kRun - 1) / kRun;
        const uint32_t place = atomicAdd(&params.counters->num_runs, static_cast<unsigned>(runs));
        for (int run = 0; run < runs; ++run) params.runs[place + run] = make_int2(tile, run);
    }
}

// ---- A tile's pairs in order -----------------------------------------------------------------------------------

constexpr int kSortWarps = 4;  // of a block
constexpr int kRepairs = 8;

struct SortShared {
    uint64_t keys[kRun];
    uint16_t order[kRun];
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

// Writes in order the ids, or the keys where `ids` is null. Returns whether the order is right.
__device__ __forceinline__ bool write_sorted(const SortShared& shared, int count, uint64_t* pairs, uint32_t* ids, int lane) {
    bool right = true;
    uint32_t last_depth = 0, last_id = 0;  // of the lane below; of the last lane for the next step
    for (int base = 0; base < count; base += kWarpSize) {
        const int place = base + lane;
        const uint64_t key = place < count ? shared.keys[shared.order[place]] : ~uint64_t{0};
        const uint32_t depth = static_cast<uint32_t>(key >> 32), id = static_cast<uint32_t>(key);
        const uint32_t depth_below = __shfl_up_sync(kFullWarp, depth, 1), id_below = __shfl_up_sync(kFullWarp, id, 1);
        if (lane > 0) last_depth = depth_below, last_id = id_below;
        if (depth < last_depth || (depth == last_depth && id < last_id)) right = false;
        last_depth = __shfl_sync(kFullWarp, depth, kWarpSize - 1);
        last_id = __shfl_sync(kFullWarp, id, kWarpSize - 1);
        if (place >= count) break;
        if (ids != nullptr) ids[place] = id;
        else pairs[place] = key;
    }
    return !__any_sync(kFullWarp, !right);
}

__device__ __forceinline__ void order_places(SortShared& shared, int low, int high) {
    const uint16_t a = shared.order[low], b = shared.order[high];
    if (shared.keys[a] > shared.keys[b]) {
        shared.order[low] = b;
        shared.order[high] = a;
    }
}

// Swaps neighbours that are out of order.
__device__ __forceinline__ void repair(SortShared& shared, int count, int lane) {
#pragma unroll
    for (int parity = 0; parity < 2; ++parity) {
        for (int place = 2 * lane + parity; place + 1 < count; place += 2 * kWarpSize) order_places(shared, place, place + 1);
        __syncwarp();
    }
}

// The whole network by whole keys, where depths are too alike for a few repairs. Behind the last key there are none smaller.
__device__ __forceinline__ void sort_places(SortShared& shared, int count, int lane) {
    for (int size = 2; size / 2 < count; size *= 2) {
        for (int part = size; part > 1; part /= 2) {
            const int half = part / 2;
            for (int i = lane;; i += kWarpSize) {
                const int low = 2 * (i & -half) | (i & (half - 1)), high = part == size ? low ^ (part - 1) : low + half;
                if (low >= count) break;
                if (high < count) order_places(shared, low, high);
            }
            __syncwarp();
        }
    }
}

// One warp sorts up to 32 * kPer pairs. It sorts 32-bit numbers: as many bits of the depth, less the nearest, as the place
// among the pairs leaves room for, then that place. Depths that agree in all these bits may be out of order; they are
// neighbours, and swapped.
template <int kPer>
__device__ __forceinline__ void sort_some(uint64_t* pairs, int count, uint32_t* ids, SortShared& shared, int lane) {
    constexpr int kPlaceBits = kPer == 1 ? 5 : kPer == 2 ? 6 : kPer == 4 ? 7 : kPer == 8 ? 8 : 9;
    constexpr uint32_t kPlaceMask = (1u << kPlaceBits) - 1u;
    static_assert(kWarpSize * kPer == 1 << kPlaceBits && kWarpSize * kPer <= kRun, "places have their bits");
    uint32_t numbers[kPer];
    uint32_t nearest = 0xFFFFFFFFu, farthest = 0u;
#pragma unroll
    for (int i = 0; i < kPer; ++i) {
        const int place = i * kWarpSize + lane;
        if (place < count) {
            const uint64_t key = pairs[place];
            shared.keys[place] = key;
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
#pragma unroll
    for (int i = 0; i < kPer; ++i) shared.order[lane * kPer + i] = static_cast<uint16_t>(numbers[i] & kPlaceMask);
    __syncwarp();
    for (int round = 0; !write_sorted(shared, count, pairs, ids, lane); ++round) {
        if (round < kRepairs) repair(shared, count, lane);
        else sort_places(shared, count, lane);
    }
}

__global__ void __launch_bounds__(kSortWarps* kWarpSize, 9)
    sort_tiles_kernel(const __grid_constant__ SortPairsParams params, int run_warps) {
    __shared__ SortShared shareds[kSortWarps];
    const int lane = threadIdx.x % kWarpSize, warp = blockIdx.x * kSortWarps + threadIdx.x / kWarpSize;
    SortShared& shared = shareds[threadIdx.x / kWarpSize];
    // The first warps take a run each, where there are so many, the others a tile. No warp takes two: what the compiler would
    // keep in registers from one to the next is more than there are.
    const bool takes_run = warp < run_warps;
    if (takes_run && static_cast<uint32_t>(warp) >= params.counters->num_runs) return;
    if (!takes_run && warp - run_warps >= params.num_active) return;
    const int2 run = takes_run ? params.runs[warp] : make_int2(warp - run_warps, 0);
    const uint32_t first = params.tile_starts[run.x];
    const int all = static_cast<int>(params.tile_starts[run.x + 1] - first);
    if (all == 0 || (!takes_run && all > kRun)) return;
    const int count = min(all - run.y * kRun, kRun);
    uint64_t* pairs = params.pair_keys + first + run.y * kRun;
    uint32_t* ids = takes_run ? nullptr : params.pair_ids + first;
    if (count <= kWarpSize) sort_some<1>(pairs, count, ids, shared, lane);
    else if (count <= 2 * kWarpSize) sort_some<2>(pairs, count, ids, shared, lane);
    else if (count <= 4 * kWarpSize) sort_some<4>(pairs, count, ids, shared, lane);
    else if (count <= 8 * kWarpSize) sort_some<8>(pairs, count, ids, shared, lane);
    else sort_some<16>(pairs, count, ids, shared, lane);
}

// ---- Tiles of several runs -------------------------------------------------------------------------------------

constexpr int kMergeBlocks = 528;

// Every key's place among all runs of its tile is the number of smaller keys: its place in its own run, and those found by
// bisection in the others.
__global__ void __launch_bounds__(kThreads) merge_runs_kernel(const __grid_constant__ SortPairsParams params) {
    const int num_runs = static_cast<int>(params.counters->num_runs);
    for (int item = blockIdx.x; item < num_runs; item += gridDim.x) {
        const int2 run = params.runs[item];
        const uint32_t first = params.tile_starts[run.x];
        const int count = static_cast<int>(params.tile_starts[run.x + 1] - first);
        const uint64_t* pairs = params.pair_keys + first;
        for (int place = run.y * kRun + threadIdx.x; place < min(count, (run.y + 1) * kRun); place += kThreads) {
            const uint64_t key = pairs[place];
            int smaller = place - run.y * kRun;
            for (int begin = 0; begin < count; begin += kRun) {
                if (begin == run.y * kRun) continue;
                int low = begin, high = min(begin + kRun, count);
                while (low < high) {
                    const int middle = (low + high) / 2;
                    if (pairs[middle] < key) low = middle + 1;
                    else high = middle;
                }
                smaller += low - begin;
            }
            params.pair_ids[first + smaller] = static_cast<uint32_t>(key);
        }
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
    scatter_windows_kernel<<<kWindowBlocks, kThreads, 0, stream>>>(params);
    if (const cudaError_t error = cudaGetLastError()) return error;
    const int run_warps = static_cast<int>(params.capacity / (kRun / 2));  // no more runs than that, see params.h
    const int blocks = (run_warps + params.num_active + kSortWarps - 1) / kSortWarps;
    sort_tiles_kernel<<<blocks, kSortWarps * kWarpSize, 0, stream>>>(params, run_warps);
    if (const cudaError_t error = cudaGetLastError()) return error;
    merge_runs_kernel<<<kMergeBlocks, kThreads, 0, stream>>>(params);
    return cudaGetLastError();
}

}  // namespace turbogs
