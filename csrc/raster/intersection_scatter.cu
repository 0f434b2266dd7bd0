// Stage 3: intersections to their tiles, in any order. See stage 2 for its definition.
//
// A block takes kScatterInstances instances and keeps those on screen, so that its warps are full. A warp works on 32
// splats together, first with a lane for each row of tiles that they reach, then with a lane for each intersection of
// those rows. Lanes of the same tile reserve their places with one addition to its cursor, and write their keys there.
// A splat of many tiles would hold its warp up. It goes into a list, in windows of kWindow intersections, and a second
// launch shares the windows among all warps. Splats that the list has no room for are done by their block. The second
// launch also lists the runs of tiles with many intersections for stage 4. The order of arrival does not matter,
// because stage 4 sorts keys of which no two are equal. The host does not need to know the number of intersections,
// and a pass that overflows does nothing.
#include "common/warp.cuh"
#include "raster/tile_reach.cuh"

namespace turbogs {
namespace {

// Measured together, as one design; there is no record of other values of any of them.
constexpr int kScatterThreads = 256;
constexpr int kScatterWarps = kScatterThreads / kWarpSize;
constexpr int kScatterInstances = 2 * kScatterThreads;  // of a block: somewhat less than half of them are on screen
constexpr int kLargeBox = 3 * kWarpSize;  // a splat with more tiles in its box is cut into windows
constexpr int kWindow = 256;              // intersections of such a splat that one warp takes
constexpr int kWindowBlocks = 4 * 132;    // four for each SM of an H100 or H200; other GPUs share the work less evenly
constexpr int kUnderWay = 4;              // places that a lane waits for at a time

constexpr uint32_t kNoInstance = 0xFFFFFFFFu;

// A splat whose intersections are listed.
struct Emission {
    uint64_t key;
    const RasterCamera* camera;
    Reach reach;
    int2 rows;
};

// `box_tiles`: of the splat's box. It may reach a few more, as the ends of a row may round to a tile beyond the box.
__device__ __forceinline__ Emission make_emission(const SortIntersectionsParams& params, uint32_t instance,
                                                  int& box_tiles) {
    Emission out;
    out.camera = params.cameras + instance / static_cast<uint32_t>(params.num_gaussians);
    const float4* splat = reinterpret_cast<const float4*>(params.instances + instance);
    const float4 first = splat[0], second = splat[1];
    out.key = static_cast<uint64_t>(__float_as_uint(second.z)) << 32 | instance;
    out.reach = make_reach(first.x, first.y, first.z, first.w, second.x, second.w);
    out.rows = tile_rows(out.reach, *out.camera);
    const int2 columns =
        tile_span(__fsub_rn(out.reach.x, out.reach.half_x), __fadd_rn(out.reach.x, out.reach.half_x),
                  out.camera->origin_x, out.camera->tiles_x);
    box_tiles = (out.rows.y - out.rows.x) * (columns.y - columns.x);
    return out;
}

__device__ __forceinline__ int2 tiles_of_row(const SortIntersectionsParams& params, const Emission& emission,
                                             int row) {
    const RasterCamera& camera = *emission.camera;
    return active_tiles(camera, params.active_prefix, row, tile_columns(emission.reach, row, camera));
}

// The lane that item `number` belongs to, if each lane has some items; `sum`: those of the lanes up to this one.
__device__ __forceinline__ int owner_of(int number, int sum) {
    int owner = 0;
#pragma unroll
    for (int step = kWarpSize / 2; step > 0; step /= 2) {
        if (__shfl_sync(kFullWarp, sum, owner + step - 1) <= number) owner += step;
    }
    return owner;
}

// Each lane brings a row of tiles and the key of its splat. Of all these intersections, numbers begin .. end - 1 are
// written, a lane each. Returns how many there are in all.
__device__ __forceinline__ int emit_rows(const SortIntersectionsParams& params, int2 tiles, uint64_t key, int begin,
                                         int end, int lane) {
    const int count = tiles.y - tiles.x;
    const int sum = sum_to_lane(count, lane);
    const int total = __shfl_sync(kFullWarp, sum, kWarpSize - 1);
    const int shift = tiles.x - (sum - count);  // from the number of an intersection to its tile
    end = min(end, total);
    for (int base = begin; base < end; base += kUnderWay * kWarpSize) {
        uint64_t keys[kUnderWay];
        uint32_t places[kUnderWay], peers[kUnderWay];
#pragma unroll
        for (int i = 0; i < kUnderWay; ++i) {
            if (base + i * kWarpSize >= end) break;
            const int number = base + i * kWarpSize + lane;
            const int owner = owner_of(number, sum);
            const int tile = number + __shfl_sync(kFullWarp, shift, owner);
            keys[i] = __shfl_sync(kFullWarp, key, owner);
            peers[i] = __match_any_sync(kFullWarp, number < end ? tile : -1 - lane);
            if (number < end && (peers[i] & lanes_below(lane)) == 0u) {
                places[i] = atomicAdd(reinterpret_cast<unsigned*>(params.tile_cursors) + tile, __popc(peers[i]));
            }
        }
#pragma unroll
        for (int i = 0; i < kUnderWay; ++i) {
            if (base + i * kWarpSize >= end) break;
            const uint32_t place = __shfl_sync(kFullWarp, places[i], __ffs(peers[i]) - 1) +
                                   __popc(peers[i] & lanes_below(lane));
            if (base + i * kWarpSize + lane < end) params.intersection_keys[place] = keys[i];
        }
    }
    return total;
}

// A warp puts intersections begin .. end - 1 of one splat into their tiles. Returns `end` or more where there may be
// others behind them.
__device__ __forceinline__ int emit_window(const SortIntersectionsParams& params, const Emission& emission, int begin,
                                           int end, int lane) {
    int first = 0;  // number of the first intersection of the rows at hand
    for (int base = emission.rows.x; base < emission.rows.y && first < end; base += kWarpSize) {
        const int row = base + lane;
        const int2 tiles = row < emission.rows.y ? tiles_of_row(params, emission, row) : make_int2(0, 0);
        first += emit_rows(params, tiles, emission.key, max(begin - first, 0), end - first, lane);
    }
    return first;
}

// Lists the windows of a large splat for the next kernel. False where the list has no room: places of it that are
// left then hold no instance.
__device__ __forceinline__ bool list_windows(const SortIntersectionsParams& params, uint32_t instance,
                                             int box_tiles) {
    const uint32_t room = params.capacity / 2, windows = static_cast<uint32_t>((box_tiles + kWindow - 1) / kWindow);
    const uint32_t place = atomicAdd(&params.counters->num_windows, windows);
    const bool fits = place < room && windows <= room - place;
    for (uint32_t i = 0; i < windows && place < room - min(i, room); ++i) {
        params.windows[place + i] = make_uint2(fits ? instance : kNoInstance, i);
    }
    return fits;
}

__global__ void __launch_bounds__(kScatterThreads)
    scatter_kernel(const __grid_constant__ SortIntersectionsParams params) {
    __shared__ uint32_t visible[kScatterInstances], large[kScatterInstances];
    __shared__ Emission emissions[kScatterThreads];
    __shared__ int num_visible, num_large;
    if (params.status[1] != 0u) return;
    const int lane = this_lane(), warp = this_warp();
    if (threadIdx.x == 0) num_visible = num_large = 0;
    __syncthreads();
#pragma unroll
    for (int i = 0; i < kScatterInstances; i += kScatterThreads) {
        const int instance = blockIdx.x * kScatterInstances + i + threadIdx.x;
        const int2 radius = instance < params.num_instances ? params.radii[instance] : make_int2(0, 0);
        const bool seen = radius.x > 0 || radius.y > 0;
        const uint32_t lanes = __ballot_sync(kFullWarp, seen);
        int place = 0;
        if (lane == 0) place = atomicAdd(&num_visible, __popc(lanes));
        place = __shfl_sync(kFullWarp, place, 0) + __popc(lanes & lanes_below(lane));
        if (seen) visible[place] = static_cast<uint32_t>(instance);
    }
    __syncthreads();

    Emission* splats = emissions + warp * kWarpSize;
    for (int base = warp * kWarpSize; base < num_visible; base += kScatterThreads) {
        int rows = 0;
        if (base + lane < num_visible) {
            const uint32_t instance = visible[base + lane];
            int box_tiles;
            splats[lane] = make_emission(params, instance, box_tiles);
            if (box_tiles <= kLargeBox) rows = splats[lane].rows.y - splats[lane].rows.x;
            else if (!list_windows(params, instance, box_tiles)) large[atomicAdd(&num_large, 1)] = instance;
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
            emit_rows(params, tiles, emission.key, 0, INT32_MAX, lane);
        }
        __syncwarp();
    }
    __syncthreads();

    // Large splats that the list has no room for.
    for (int i = 0; i < num_large; ++i) {
        int box_tiles;
        const Emission emission = make_emission(params, large[i], box_tiles);
        int begin = warp * kWindow;
        while (emit_window(params, emission, begin, begin + kWindow, lane) >= begin + kWindow) {
            begin += kScatterWarps * kWindow;
        }
    }
}

// The windows of the list; and lists the runs of tiles with more than kSortRun intersections.
__global__ void __launch_bounds__(kScatterThreads)
    scatter_windows_kernel(const __grid_constant__ SortIntersectionsParams params) {
    if (params.status[1] != 0u) return;
    const int lane = this_lane(), thread = blockIdx.x * kScatterThreads + threadIdx.x;
    const uint32_t num_windows = min(params.counters->num_windows, params.capacity / 2);
    for (uint32_t i = thread / kWarpSize; i < num_windows; i += gridDim.x * kScatterWarps) {
        const uint2 window = params.windows[i];
        if (window.x == kNoInstance) continue;
        int box_tiles;
        const Emission emission = make_emission(params, window.x, box_tiles);
        // The last window takes whatever is left, as its tiles have counted it.
        const int begin = static_cast<int>(window.y) * kWindow;
        emit_window(params, emission, begin, begin + kWindow < box_tiles ? begin + kWindow : INT32_MAX, lane);
    }
    for (int tile = thread; tile < params.num_active; tile += gridDim.x * kScatterThreads) {
        const int count = static_cast<int>(params.tile_starts[tile + 1] - params.tile_starts[tile]);
        if (count <= kSortRun) continue;
        const int runs = (count + kSortRun - 1) / kSortRun;
        const uint32_t place = atomicAdd(&params.counters->num_runs, static_cast<unsigned>(runs));
        for (int run = 0; run < runs; ++run) params.runs[place + run] = make_int2(tile, run);
    }
}

}  // namespace

void launch_scatter_intersections(const SortIntersectionsParams& params, cudaStream_t stream) {
    if (params.num_instances == 0 || params.num_active == 0) return;
    const int blocks = blocks_for(params.num_instances, kScatterInstances);
    scatter_kernel<<<blocks, kScatterThreads, 0, stream>>>(params);
    scatter_windows_kernel<<<kWindowBlocks, kScatterThreads, 0, stream>>>(params);
}

}  // namespace turbogs
