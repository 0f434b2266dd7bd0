// Collection of what all processes of a batch have rendered, out of memory that may be other GPUs', mapped here.
// Defined by turbogs_plugin/engine/shared.py. What is not read does not travel, and a read from another GPU takes
// some thousand clocks, so a thread has all its reads of a process under way before it adds or writes. Loads are plain:
// what another GPU has written lies in no cache of this one when a kernel begins.
#include "common/warp.cuh"
#include "raster/raster_params.h"

namespace turbogs {
namespace {

// No record of other values: not measured yet.
constexpr int kCollectThreads = 256, kGatherThreads = 256;
constexpr int kGatherBatch = 4;  // numbers of a thread

// Whether a process has rendered a part of this view; then which of its own it is.
__device__ __forceinline__ bool has_view(const CollectSource& source, int view, int& own) {
    own = view - source.first_view;
    return own >= 0 && own < source.num_views;
}

// Gradients on the screen of some rows of Gaussians, out of the records of all processes, each of which rendered some
// of the views, or a part of one. A thread takes one Gaussian in one view and reads its radii, 8 bytes. Those of a warp
// that are on screen, two fifths or so, make a list in shared memory, and four threads copy each record, so that they
// read whole sectors. A view of several processes is added up in their order.
__global__ void __launch_bounds__(kCollectThreads) collect_kernel(const __grid_constant__ CollectParams params) {
    __shared__ int rows[kCollectThreads];  // of each warp: its rows on screen, counted from its first
    const int view = blockIdx.y, lane = this_lane();
    const int warp_row = blockIdx.x * kCollectThreads + kWarpSize * this_warp(), row = warp_row + lane;
    const size_t target = static_cast<size_t>(view) * params.num_rows;
    int first = 0, own = 0;
    while (!has_view(params.sources[first], view, own)) ++first;  // every view has a process

    // The radii of a view that is shared are those of all of its processes.
    int2 radius = make_int2(0, 0);
    if (row < params.num_rows) {
        radius = params.sources[first].radii[static_cast<size_t>(own) * params.num_gaussians + params.first_row + row];
        params.target_radii[target + row] = radius;
    }
    const bool seen = radius.x > 0 || radius.y > 0;
    const uint32_t lanes = __ballot_sync(kFullWarp, seen);
    int* list = rows + kWarpSize * this_warp();
    if (seen) list[__popc(lanes & lanes_below(lane))] = lane;
    __syncwarp();

    const int quads = kRecordQuads * __popc(lanes);
    float4 values[kRecordQuads];
    for (int i = first; i < params.num_sources; ++i) {
        const CollectSource& source = params.sources[i];
        if (!has_view(source, view, own)) break;  // those of a view follow each other
        const size_t place = static_cast<size_t>(own) * params.num_gaussians + params.first_row + warp_row;
        const float4* records = source.records + place * kRecordQuads;
        float4 read[kRecordQuads];
#pragma unroll
        for (int step = 0; step < kRecordQuads; ++step) {
            const int quad = lane + kWarpSize * step;
            if (quad < quads) read[step] = records[list[quad / kRecordQuads] * kRecordQuads + quad % kRecordQuads];
        }
#pragma unroll
        for (int step = 0; step < kRecordQuads; ++step) {
            float4& sum = values[step];
            const float4 value = read[step];
            sum = i == first ? value
                             : make_float4(sum.x + value.x, sum.y + value.y, sum.z + value.z, sum.w + value.w);
        }
    }
    float4* out = params.target_records + (target + warp_row) * kRecordQuads;
#pragma unroll
    for (int step = 0; step < kRecordQuads; ++step) {
        const int quad = lane + kWarpSize * step;
        if (quad < quads) out[list[quad / kRecordQuads] * kRecordQuads + quad % kRecordQuads] = values[step];
    }
}

// The colours of all processes, one after the other. A row of blocks copies one process's colours, number by number, as
// they begin at any multiple of three numbers in the result. One thread looks at the flags of all processes. It may set
// this process's own flag while another process reads it: what it sets is what the other one finds anyway.
__global__ void __launch_bounds__(kGatherThreads) gather_kernel(const __grid_constant__ GatherParams params) {
    const int process = blockIdx.y, count = params.counts[process];
    const float* source = params.peers[process] + params.first;
    float* target = params.colors + params.starts[process];
    const int begin = blockIdx.x * (kGatherThreads * kGatherBatch) + threadIdx.x;
    float values[kGatherBatch];
#pragma unroll
    for (int i = 0; i < kGatherBatch; ++i) {
        const int place = begin + i * kGatherThreads;
        if (place < count) values[i] = source[place];
    }
#pragma unroll
    for (int i = 0; i < kGatherBatch; ++i) {
        const int place = begin + i * kGatherThreads;
        if (place < count) target[place] = values[i];
    }
    if (blockIdx.x == 0 && process == 0 && threadIdx.x == 0) {
        int32_t overflow = 0, stop = 0;
        for (int i = 0; i < params.num_peers; ++i) {
            const int32_t* status = reinterpret_cast<const int32_t*>(params.peers[i]);
            overflow = max(overflow, status[PassStatus::kOverflow]);
            stop = max(stop, status[PassStatus::kStop]);
        }
        params.seen[0] = overflow;
        params.seen[1] = stop;
        if (params.overflow != nullptr) *params.overflow = overflow;
    }
}

}  // namespace

void launch_collect_records(const CollectParams& params, cudaStream_t stream) {
    if (params.num_views == 0 || params.num_rows == 0) return;
    const dim3 blocks(blocks_for(params.num_rows, kCollectThreads), params.num_views);
    collect_kernel<<<blocks, kCollectThreads, 0, stream>>>(params);
}

void launch_gather_colors(const GatherParams& params, cudaStream_t stream) {
    int most = 1;  // the flags are looked at without any colours, too
    for (int i = 0; i < params.num_peers; ++i) most = params.counts[i] > most ? params.counts[i] : most;
    const dim3 blocks(blocks_for(most, kGatherThreads * kGatherBatch), params.num_peers);
    gather_kernel<<<blocks, kGatherThreads, 0, stream>>>(params);
}

}  // namespace turbogs
