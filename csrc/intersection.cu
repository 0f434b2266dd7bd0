// Stages 2 and 3: which splats each active tile must look at, front to back.
//
// Instances of all views are sorted by depth once (32-bit keys). Walking them in that order, every splat writes its
// (tile position, instance) pairs to its own place, and one stable radix sort by tile position, over no more bits than the
// tiles need, leaves each tile's pairs front to back; equal depths keep the order of the Gaussians. Nothing here needs the
// number of pairs on the host: unused places hold a key behind the last tile's.
#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>
#include <thrust/iterator/counting_iterator.h>
#include <thrust/iterator/transform_iterator.h>

#include "common.cuh"

namespace turbogs {
namespace {

constexpr int kThreads = 256;
constexpr uint32_t kLargeSplat = 24;  // pairs beyond which a whole warp writes a splat's pairs

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

template <typename Key>
__global__ void __launch_bounds__(kThreads) emit_pairs_kernel(const __grid_constant__ SortPairsParams params) {
    if (params.pair_ends[params.num_instances - 1] > params.capacity) {
        if (blockIdx.x == 0 && threadIdx.x == 0) params.status[1] = 1u;
        return;
    }
    if (params.status[1] != 0u) return;
    Key* tile_keys = static_cast<Key*>(params.tile_keys[0]);
    uint32_t* pair_ids = params.pair_ids[0];
    const int place = blockIdx.x * kThreads + threadIdx.x;  // in depth order
    const int lane = threadIdx.x % kWarpSize;

    uint32_t count = 0, begin = 0, instance = 0;
    int view = 0;
    Reach reach = {};
    if (place < params.num_instances && params.depth_keys[place] != kInvisible) {
        begin = place > 0 ? params.pair_ends[place - 1] : 0u;
        count = params.pair_ends[place] - begin;
        instance = params.instance_ids[place];
        view = static_cast<int>(instance / static_cast<uint32_t>(params.num_gaussians));
        const float4* splat = reinterpret_cast<const float4*>(params.instances + instance);
        const float4 first = splat[0], second = splat[1];
        reach = make_reach(first.x, first.y, first.z, first.w, second.x, second.w);
    }

    if (count > 0 && count <= kLargeSplat) {
        const RasterCamera& camera = params.cameras[view];
        const int2 rows = tile_rows(reach, camera.tiles_y);
        uint32_t out = begin;
        for (int row = rows.x; row < rows.y; ++row) {
            const int2 tiles = active_tiles(camera, params.active_prefix, row, tile_columns(reach, row, camera.tiles_x));
            for (int tile = tiles.x; tile < tiles.y; ++tile, ++out) {
                tile_keys[out] = static_cast<Key>(tile);
                pair_ids[out] = instance;
            }
        }
    }

    // Large splats one after another, their rows of tiles over the lanes.
    for (uint32_t large = __ballot_sync(kFullWarp, count > kLargeSplat); large != 0u; large &= large - 1u) {
        const int source = __ffs(large) - 1;
        Reach shared;
        shared.x = __shfl_sync(kFullWarp, reach.x, source);
        shared.y = __shfl_sync(kFullWarp, reach.y, source);
        shared.half_x = __shfl_sync(kFullWarp, reach.half_x, source);
        shared.half_y = __shfl_sync(kFullWarp, reach.half_y, source);
        shared.extreme_y = __shfl_sync(kFullWarp, reach.extreme_y, source);
        shared.slope = __shfl_sync(kFullWarp, reach.slope, source);
        shared.half_chord = __shfl_sync(kFullWarp, reach.half_chord, source);
        shared.inverse_half_y = __shfl_sync(kFullWarp, reach.inverse_half_y, source);
        const RasterCamera& camera = params.cameras[__shfl_sync(kFullWarp, view, source)];
        const uint32_t shared_instance = __shfl_sync(kFullWarp, instance, source);
        uint32_t out = __shfl_sync(kFullWarp, begin, source);
        const int2 rows = tile_rows(shared, camera.tiles_y);
        for (int row_base = rows.x; row_base < rows.y; row_base += kWarpSize) {
            int2 tiles = make_int2(0, 0);
            if (row_base + lane < rows.y) {
                const int row = row_base + lane;
                tiles = active_tiles(camera, params.active_prefix, row, tile_columns(shared, row, camera.tiles_x));
            }
            const int num_rows = min(kWarpSize, rows.y - row_base);
            for (int i = 0; i < num_rows; ++i) {
                const int first = __shfl_sync(kFullWarp, tiles.x, i), last = __shfl_sync(kFullWarp, tiles.y, i);
                for (int tile = first + lane; tile < last; tile += kWarpSize) {
                    tile_keys[out + (tile - first)] = static_cast<Key>(tile);
                    pair_ids[out + (tile - first)] = shared_instance;
                }
                out += static_cast<uint32_t>(last - first);
            }
        }
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
    const int blocks = (params.num_instances + kThreads - 1) / kThreads;
    if (params.capacity > 0) {
        const cudaError_t error = cudaMemsetAsync(params.tile_keys[0], 0xFF, sizeof(Key) * params.capacity, stream);
        if (error != cudaSuccess) return error;
    }
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
