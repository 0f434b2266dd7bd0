// Stage 4: every tile's intersections in order of depth, then of the instance. See stage 2 for its definition.
//
// One warp sorts a tile of up to kSortRun intersections in registers, with a bitonic network over 32-bit numbers: the
// leading bits of the depth, and behind them the place among the intersections. Few depths agree in those bits, and a
// few swaps of neighbours put them right. A tile with more intersections is cut into runs of kSortRun, each sorted by a
// warp of its own. A second launch merges the runs with a thread for each key, which finds its place in the other runs
// by bisection. No two keys are equal, so the order does not depend on the order of arrival.
#include "common/warp.cuh"
#include "raster/raster_params.h"

namespace turbogs {
namespace {

constexpr int kSortWarps = 4;   // of a block; they share nothing
constexpr int kSortBlocks = 9;  // of an SM: the most that do not spill (56 registers)
constexpr int kRepairs = 8;     // rounds of swaps before a whole network by whole keys; no record of other values

struct SortShared {
    uint64_t keys[kSortRun];
    uint16_t order[kSortRun];
};

// Sorts 32 * kPer numbers, lane * kPer + i being the place of a lane's i-th: a bitonic network whose comparators all
// point the same way.
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
__device__ __forceinline__ bool write_sorted(const SortShared& shared, int count, uint64_t* keys, uint32_t* ids,
                                             int lane) {
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
        else keys[place] = key;
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
        for (int low = 2 * lane + parity; low + 1 < count; low += 2 * kWarpSize) order_places(shared, low, low + 1);
        __syncwarp();
    }
}

// The whole network by whole keys, where depths are too alike for a few repairs. Behind the last key there are none
// smaller.
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

// One warp sorts the keys of up to 32 * kPer intersections, as 32-bit numbers: the depth less the nearest one, of which
// the leading bits are kept, then the place among the keys. Depths that agree in all these bits may be out of order;
// they are neighbours, and swapped.
template <int kPer>
__device__ __forceinline__ void sort_some(uint64_t* keys, int count, uint32_t* ids, SortShared& shared, int lane) {
    constexpr int kPlaceBits = kPer == 1 ? 5 : kPer == 2 ? 6 : kPer == 4 ? 7 : kPer == 8 ? 8 : 9;  // log2(32 * kPer)
    constexpr uint32_t kPlaceMask = (1u << kPlaceBits) - 1u;
    static_assert(kWarpSize * kPer == 1 << kPlaceBits && kWarpSize * kPer <= kSortRun, "places have their bits");
    uint32_t numbers[kPer];
    uint32_t nearest = 0xFFFFFFFFu, farthest = 0u;
#pragma unroll
    for (int i = 0; i < kPer; ++i) {
        const int place = i * kWarpSize + lane;
        if (place < count) {
            const uint64_t key = keys[place];
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
    for (int round = 0; !write_sorted(shared, count, keys, ids, lane); ++round) {
        if (round < kRepairs) repair(shared, count, lane);
        else sort_places(shared, count, lane);
    }
}

__global__ void __launch_bounds__(kSortWarps* kWarpSize, kSortBlocks)
    sort_tiles_kernel(const __grid_constant__ SortIntersectionsParams params, int run_warps) {
    __shared__ SortShared shareds[kSortWarps];
    const int lane = this_lane(), warp = blockIdx.x * kSortWarps + this_warp();
    SortShared& shared = shareds[this_warp()];
    // The first `run_warps` warps take a run each, the others a tile each. A loop over several would need more
    // registers than there are.
    const bool takes_run = warp < run_warps;
    if (takes_run && static_cast<uint32_t>(warp) >= params.counters->num_runs) return;
    if (!takes_run && warp - run_warps >= params.num_active) return;
    const int2 run = takes_run ? params.runs[warp] : make_int2(warp - run_warps, 0);
    const uint32_t first = params.tile_starts[run.x];
    const int all = static_cast<int>(params.tile_starts[run.x + 1] - first);
    if (all == 0 || (!takes_run && all > kSortRun)) return;
    const int count = min(all - run.y * kSortRun, kSortRun);
    uint64_t* keys = params.intersection_keys + first + run.y * kSortRun;
    uint32_t* ids = takes_run ? nullptr : params.intersection_ids + first;
    if (count <= kWarpSize) sort_some<1>(keys, count, ids, shared, lane);
    else if (count <= 2 * kWarpSize) sort_some<2>(keys, count, ids, shared, lane);
    else if (count <= 4 * kWarpSize) sort_some<4>(keys, count, ids, shared, lane);
    else if (count <= 8 * kWarpSize) sort_some<8>(keys, count, ids, shared, lane);
    else sort_some<16>(keys, count, ids, shared, lane);
}

constexpr int kMergeBlocks = 4 * 132;  // four for each SM of an H100 or H200; other GPUs share the work less evenly
constexpr int kMergeThreads = 256;     // two keys of a run each; no record of other values

// A key's place in its tile is the number of smaller keys: its place in its own run, and bisection in the others.
__global__ void __launch_bounds__(kMergeThreads)
    merge_runs_kernel(const __grid_constant__ SortIntersectionsParams params) {
    const int num_runs = static_cast<int>(params.counters->num_runs);
    for (int item = blockIdx.x; item < num_runs; item += gridDim.x) {
        const int2 run = params.runs[item];
        const uint32_t first = params.tile_starts[run.x];
        const int count = static_cast<int>(params.tile_starts[run.x + 1] - first);
        const uint64_t* keys = params.intersection_keys + first;
        for (int place = run.y * kSortRun + threadIdx.x; place < min(count, (run.y + 1) * kSortRun);
             place += kMergeThreads) {
            const uint64_t key = keys[place];
            int smaller = place - run.y * kSortRun;
            for (int begin = 0; begin < count; begin += kSortRun) {
                if (begin == run.y * kSortRun) continue;
                smaller += partition_point(begin, min(begin + kSortRun, count),
                                           [&](int other) { return keys[other] < key; }) - begin;
            }
            params.intersection_ids[first + smaller] = static_cast<uint32_t>(key);
        }
    }
}

}  // namespace

void launch_sort_intersections(const SortIntersectionsParams& params, cudaStream_t stream) {
    if (params.num_active == 0) return;
    const int run_warps = static_cast<int>(params.capacity / kLeastOfRun);  // no more runs than that
    const int blocks = blocks_for(run_warps + params.num_active, kSortWarps);
    sort_tiles_kernel<<<blocks, kSortWarps * kWarpSize, 0, stream>>>(params, run_warps);
    merge_runs_kernel<<<kMergeBlocks, kMergeThreads, 0, stream>>>(params);
}

}  // namespace turbogs
