// Gradients on the screen of some rows of Gaussians, out of the records of one process that rendered some of the views.
// Defined by turbogs_plugin/engine/reference/records.py.
//
// The source may be another GPU's memory, mapped here: what is not read does not travel. A thread takes one Gaussian
// in one view and reads its radii, 8 bytes. Those of a warp that are on screen, two fifths or so, make a list in shared
// memory, and four threads copy each record, so that they read whole sectors. A thread has all of its reads under way
// before the first write, because a read from another GPU takes some thousand clocks. Plain loads: what another GPU
// has written lies in no cache of this one when a kernel begins.
#include "common/warp.cuh"
#include "raster/raster_params.h"

namespace turbogs {
namespace {

// No record of other values: not measured yet.
constexpr int kCollectThreads = 256;

__global__ void __launch_bounds__(kCollectThreads) collect_kernel(const __grid_constant__ CollectParams params) {
    __shared__ int rows[kCollectThreads];  // of each warp: its rows on screen, counted from its first
    const int view = blockIdx.y, lane = this_lane();
    const int warp_row = blockIdx.x * kCollectThreads + kWarpSize * this_warp(), row = warp_row + lane;
    const size_t source = static_cast<size_t>(view) * params.source_gaussians + params.first_row;
    const size_t target = static_cast<size_t>(params.first_view + view) * params.target_gaussians;
    const bool adds = params.adds && view == 0;

    int2 radius = make_int2(0, 0);
    if (row < params.target_gaussians) {
        // An earlier process has written the radii of a view that is shared; they are those of all of its processes.
        if (adds) {
            radius = params.target_radii[target + row];
        } else {
            radius = params.source_radii[source + row];
            params.target_radii[target + row] = radius;
        }
    }
    const bool seen = radius.x > 0 || radius.y > 0;
    const uint32_t lanes = __ballot_sync(kFullWarp, seen);
    int* list = rows + kWarpSize * this_warp();
    if (seen) list[__popc(lanes & lanes_below(lane))] = lane;
    __syncwarp();

    const int quads = kRecordQuads * __popc(lanes);
    float4 values[kRecordQuads];
#pragma unroll
    for (int step = 0; step < kRecordQuads; ++step) {
        const int i = lane + kWarpSize * step;
        if (i >= quads) continue;
        const size_t place = static_cast<size_t>(warp_row + list[i / kRecordQuads]);
        values[step] = params.source_records[(source + place) * kRecordQuads + i % kRecordQuads];
    }
#pragma unroll
    for (int step = 0; step < kRecordQuads; ++step) {
        const int i = lane + kWarpSize * step;
        if (i >= quads) continue;
        const size_t place = static_cast<size_t>(warp_row + list[i / kRecordQuads]);
        float4& out = params.target_records[(target + place) * kRecordQuads + i % kRecordQuads];
        float4 value = values[step];
        if (adds) {
            const float4 before = out;
            value = make_float4(before.x + value.x, before.y + value.y, before.z + value.z, before.w + value.w);
        }
        out = value;
    }
}

}  // namespace

cudaError_t launch_collect_records(const CollectParams& params, cudaStream_t stream) {
    if (params.num_views == 0 || params.target_gaussians == 0) return cudaSuccess;
    const dim3 blocks(blocks_for(params.target_gaussians, kCollectThreads), params.num_views);
    collect_kernel<<<blocks, kCollectThreads, 0, stream>>>(params);
    return cudaGetLastError();
}

}  // namespace turbogs
