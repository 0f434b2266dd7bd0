// Stages 2 and 3: which splats each active tile must look at, front to back.
//
// Instances of all views are sorted by depth once (32-bit keys). In that order every splat has its own places among the
// (tile position, instance) pairs, and one stable radix sort by tile position, over no more bits than the tiles need,
// leaves each tile's pairs front to back; equal depths keep the order of the Gaussians. Nothing here needs the number of
// pairs on the host: unused places hold a key behind the last tile's.
#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>
#include <thrust/iterator/counting_iterator.h>
#include <thrust/iterator/transform_iterator.h>

#include "common.cuh"

namespace turbogs {
namespace {

constexpr int kThreads = 256;
constexpr uint32_t kWindow = 2048;    // pairs that a block writes
constexpr uint32_t kLargeSplat = 16;  // pairs beyond which a whole warp enumerates a splat's pairs

// Addition that stays at kMaxPairs: associative, so the scan may use it, and a count that would wrap reads as too large.
struct SaturatingSum {
    __device__ __forceinline__ uint32_t operator()(uint32_t a, uint32_t b) const { return min(a + b, kMaxPairs); }
};

// Pairs of the i-th instance in depth order.
struct CountInOrder {
    const uint32_t* depth_keys;
    const uint32_t* instance_ids;
    const uint32_t* tile_counts;

    __device__ __forceinline__ uint32_t operator()(int i) const {
        return depth_keys[i] == kInvisible ? 0u : min(tile_counts[instance_ids[i]], kMaxPairs);
    }
};

using CountIterator = thrust::transform_iterator<CountInOrder, thrust::counting_iterator<int>>;

CountIterator counts_in_order(const uint32_t* depth_keys, const uint32_t* instance_ids, const uint32_t* tile_counts) {
    return CountIterator(thrust::counting_iterator<int>(0), CountInOrder{depth_keys, instance_ids, tile_counts});
}

// status[0] = pairs of this pass.
__global__ void publish_count_kernel(const uint32_t* pair_ends, int num_instances, uint32_t* status) {
    status[0] = num_instances > 0 ? pair_ends[num_instances - 1] : 0u;
}

// First place whose pairs end behind `pair`, or `count`. All lanes of a warp search together, 32 shares at a step.
__device__ __forceinline__ int first_place_behind(const uint32_t* __restrict__ pair_ends, int count, uint32_t pair, int lane) {
    int low = 0, high = count;
    while (low < high) {
        const int share = (high - low + kWarpSize - 1) / kWarpSize;
        const int probe = low + (lane + 1) * share - 1;
        const bool whole = probe < high && pair_ends[probe] <= pair;  // the lane's share ends too early
        low += __popc(__ballot_sync(kFullWarp, whole)) * share;
        high = min(high, low + share - 1);
    }
    return min(low, count);
}

// The pairs that one block writes: a window of consecutive ones, gathered in shared memory, so that the work is even
// however large the splats are, and memory is written in one sweep.
template <typename Key>
struct PairWindow {
    uint32_t begin, end;  // pairs
    Key keys[kWindow];
    uint32_t ids[kWindow];
    int num_large;
    int large[kWindow / kLargeSplat + 2];  // places of the splats that a warp takes on

    __device__ __forceinline__ void put(uint32_t pair, int tile, uint32_t instance) {
        if (pair < begin || pair >= end) return;
        keys[pair - begin] = static_cast<Key>(tile);
        ids[pair - begin] = instance;
    }
};

// What it takes to enumerate the pairs of one place.
struct Emission {
    uint32_t instance;
    const RasterCamera* camera;
    Reach reach;
};

__device__ __forceinline__ Emission make_emission(const SortPairsParams& params, int place) {
    Emission out;
    out.instance = params.instance_ids[place];
    out.camera = params.cameras + out.instance / static_cast<uint32_t>(params.num_gaussians);
    const float4* splat = reinterpret_cast<const float4*>(params.instances + out.instance);
    const float4 first = splat[0], second = splat[1];
    out.reach = make_reach(first.x, first.y, first.z, first.w, second.x, second.w);
    return out;
}

__device__ __forceinline__ int2 tiles_of_row(const SortPairsParams& params, const Emission& emission, int row) {
    const RasterCamera& camera = *emission.camera;
    return active_tiles(camera, params.active_prefix, row, tile_columns(emission.reach, row, camera.tiles_x));
}

// One thread enumerates a splat of few pairs.
template <typename Key>
__device__ __forceinline__ void emit_small(const SortPairsParams& params, int place, uint32_t pair, PairWindow<Key>& window) {
    const Emission emission = make_emission(params, place);
    const int2 rows = tile_rows(emission.reach, emission.camera->tiles_y);
    for (int row = rows.x; row < rows.y; ++row) {
        const int2 tiles = tiles_of_row(params, emission, row);
        for (int tile = tiles.x; tile < tiles.y; ++tile) window.put(pair++, tile, emission.instance);
    }
}

// A warp enumerates a splat: a lane for each row of tiles, then a lane for each pair of those rows.
template <typename Key>
__device__ __forceinline__ void emit_large(const SortPairsParams& params, int place, uint32_t pair, PairWindow<Key>& window,
                                           int lane) {
    const Emission emission = make_emission(params, place);
    const int2 rows = tile_rows(emission.reach, emission.camera->tiles_y);
    for (int row_base = rows.x; row_base < rows.y && pair < window.end; row_base += kWarpSize) {
        const int row = row_base + lane;
        const int2 tiles = row < rows.y ? tiles_of_row(params, emission, row) : make_int2(0, 0);
        const int count = tiles.y - tiles.x;
        int sum = count;  // of the rows up to and including the lane's
#pragma unroll
        for (int step = 1; step < kWarpSize; step *= 2) {
            const int below = __shfl_up_sync(kFullWarp, sum, step);
            if (lane >= step) sum += below;
        }
        const int total = __shfl_sync(kFullWarp, sum, kWarpSize - 1);
        const int shift = tiles.x - (sum - count);  // from the number of a pair to its tile
        const int begin = pair < window.begin ? static_cast<int>(min(window.begin - pair, static_cast<uint32_t>(total))) : 0;
        for (int base = begin; base < total && pair + base < window.end; base += kWarpSize) {
            const int number = base + lane;
            int owner = 0;  // the lane whose row holds this pair
#pragma unroll
            for (int step = kWarpSize / 2; step > 0; step /= 2) {
                if (__shfl_sync(kFullWarp, sum, owner + step - 1) <= number) owner += step;
            }
            const int tile = number + __shfl_sync(kFullWarp, shift, owner);
            if (number < total) window.put(pair + number, tile, emission.instance);
        }
        pair += static_cast<uint32_t>(total);
    }
}

template <typename Key>
__global__ void __launch_bounds__(kThreads) emit_pairs_kernel(const __grid_constant__ SortPairsParams params) {
    __shared__ PairWindow<Key> window;
    const int lane = threadIdx.x % kWarpSize, warp = threadIdx.x / kWarpSize;
    const uint32_t begin = blockIdx.x * kWindow;
    uint32_t total = params.num_instances > 0 ? params.pair_ends[params.num_instances - 1] : 0u;
    if (total > params.capacity) {
        if (blockIdx.x == 0 && threadIdx.x == 0) params.status[1] = 1u;
        total = 0;
    } else if (params.status[1] != 0u) {
        total = 0;
    }
    const uint32_t end = min(begin + kWindow, total);
    if (threadIdx.x == 0) {
        window.begin = begin;
        window.end = end;
        window.num_large = 0;
    }
    __syncthreads();

    if (begin < end) {
        const auto first_pair = [&](int place) { return place > 0 ? params.pair_ends[place - 1] : 0u; };
        int base = first_place_behind(params.pair_ends, params.num_instances, begin, lane);
        do {
            const int place = base + threadIdx.x;
            const uint32_t pair = place < params.num_instances ? first_pair(place) : end;
            if (pair < end) {
                if (params.pair_ends[place] - pair <= kLargeSplat) emit_small(params, place, pair, window);
                else window.large[atomicAdd(&window.num_large, 1)] = place;
            }
            base += kThreads;
        } while (base < params.num_instances && first_pair(base) < end);
        __syncthreads();
        for (int i = warp; i < window.num_large; i += kThreads / kWarpSize) {
            emit_large(params, window.large[i], first_pair(window.large[i]), window, lane);
        }
        __syncthreads();
    }

    Key* tile_keys = static_cast<Key*>(params.tile_keys[0]);
    for (uint32_t i = threadIdx.x; i < kWindow && begin + i < params.capacity; i += kThreads) {
        const bool filled = begin + i < end;
        tile_keys[begin + i] = filled ? window.keys[i] : static_cast<Key>(~Key{0});
        if (filled) params.pair_ids[0][begin + i] = window.ids[i];
    }
}

// tile_starts[t] = first place whose key is not below t. Places without a pair hold keys of all ones.
template <typename Key>
__global__ void tile_starts_kernel(const Key* __restrict__ keys, uint32_t capacity, int num_active, uint32_t* tile_starts) {
    const int tile = blockIdx.x * blockDim.x + threadIdx.x;
    if (tile > num_active) return;
    uint32_t low = 0, high = capacity;
    while (low < high) {
        const uint32_t middle = low + (high - low) / 2;
        if (static_cast<uint32_t>(keys[middle]) < static_cast<uint32_t>(tile)) low = middle + 1;
        else high = middle;
    }
    tile_starts[tile] = low;
}

// Bits that tell the keys 0 .. num_active - 1 and a key of all ones apart.
int key_bits(int num_active) {
    int bits = 1;
    while (bits < 31 && (1u << bits) <= static_cast<uint32_t>(num_active)) ++bits;
    return bits;
}

template <typename Key>
cudaError_t sort_pairs_bytes(uint32_t capacity, int num_active, size_t* bytes) {
    cub::DoubleBuffer<Key> keys(nullptr, nullptr);
    cub::DoubleBuffer<uint32_t> values(nullptr, nullptr);
    return cub::DeviceRadixSort::SortPairs(nullptr, *bytes, keys, values, static_cast<int>(capacity), 0, key_bits(num_active));
}

template <typename Key>
cudaError_t sort_pairs(SortPairsParams& params, cudaStream_t stream) {
    const int blocks = static_cast<int>((params.capacity + kWindow - 1) / kWindow);
    if (blocks > 0) {
        emit_pairs_kernel<Key><<<blocks, kThreads, 0, stream>>>(params);
        if (const cudaError_t error = cudaGetLastError()) return error;
    }
    cub::DoubleBuffer<Key> keys(static_cast<Key*>(params.tile_keys[0]), static_cast<Key*>(params.tile_keys[1]));
    cub::DoubleBuffer<uint32_t> values(params.pair_ids[0], params.pair_ids[1]);
    if (params.capacity > 0) {
        const cudaError_t error =
            cub::DeviceRadixSort::SortPairs(params.scratch, params.scratch_bytes, keys, values,
                                            static_cast<int>(params.capacity), 0, key_bits(params.num_active), stream);
        if (error != cudaSuccess) return error;
    }
    params.current = values.selector;
    tile_starts_kernel<Key><<<params.num_active / kThreads + 1, kThreads, 0, stream>>>(keys.Current(), params.capacity,
                                                                                      params.num_active, params.tile_starts);
    return cudaGetLastError();
}

}  // namespace

cudaError_t sort_instances_scratch(int num_instances, size_t* bytes) {
    cub::DoubleBuffer<uint32_t> keys(nullptr, nullptr), values(nullptr, nullptr);
    size_t sort_bytes = 0, scan_bytes = 0;
    if (const cudaError_t error = cub::DeviceRadixSort::SortPairs(nullptr, sort_bytes, keys, values, num_instances)) return error;
    if (const cudaError_t error = cub::DeviceScan::InclusiveScan(nullptr, scan_bytes, counts_in_order(nullptr, nullptr, nullptr),
                                                                 static_cast<uint32_t*>(nullptr), SaturatingSum{}, num_instances))
        return error;
    *bytes = sort_bytes > scan_bytes ? sort_bytes : scan_bytes;
    return cudaSuccess;
}

cudaError_t launch_sort_instances(SortInstancesParams& params, cudaStream_t stream) {
    params.current = 0;
    if (params.num_instances > 0) {
        cub::DoubleBuffer<uint32_t> keys(params.depth_keys[0], params.depth_keys[1]);
        cub::DoubleBuffer<uint32_t> values(params.instance_ids[0], params.instance_ids[1]);
        size_t bytes = params.scratch_bytes;
        if (const cudaError_t error = cub::DeviceRadixSort::SortPairs(params.scratch, bytes, keys, values, params.num_instances, 0,
                                                                      32, stream))
            return error;
        params.current = values.selector;
        bytes = params.scratch_bytes;
        if (const cudaError_t error = cub::DeviceScan::InclusiveScan(
                params.scratch, bytes, counts_in_order(keys.Current(), values.Current(), params.tile_counts), params.pair_ends,
                SaturatingSum{}, params.num_instances, stream))
            return error;
    }
    publish_count_kernel<<<1, 1, 0, stream>>>(params.pair_ends, params.num_instances, params.status);
    return cudaGetLastError();
}

cudaError_t sort_pairs_scratch(uint32_t capacity, int num_active, bool narrow_keys, size_t* bytes) {
    return narrow_keys ? sort_pairs_bytes<uint16_t>(capacity, num_active, bytes)
                       : sort_pairs_bytes<uint32_t>(capacity, num_active, bytes);
}

cudaError_t launch_sort_pairs(SortPairsParams& params, cudaStream_t stream) {
    return params.narrow_keys ? sort_pairs<uint16_t>(params, stream) : sort_pairs<uint32_t>(params, stream);
}

}  // namespace turbogs
