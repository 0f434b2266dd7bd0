// The colours of all processes of a batch, one after the other, out of memory in which each has left its own. Defined
// by turbogs_plugin/engine/reference/records.py.
//
// The sources may be other GPUs' memory, mapped here. A row of blocks copies one process's colours, number by number,
// as they begin at any multiple of three numbers in the result; a thread has several reads under way before its first
// write, because a read from another GPU takes some thousand clocks. One thread looks at the flags of all processes. It
// may set this process's own flag while another process reads it: what it sets is what the other one finds anyway.
#include "raster/raster_params.h"

namespace turbogs {
namespace {

// No record of other values: not measured yet.
constexpr int kGatherThreads = 256;
constexpr int kGatherBatch = 4;  // numbers of a thread

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

cudaError_t launch_gather_colors(const GatherParams& params, cudaStream_t stream) {
    int most = 1;  // the flags are looked at without any colours, too
    for (int i = 0; i < params.num_peers; ++i) most = params.counts[i] > most ? params.counts[i] : most;
    const dim3 blocks(blocks_for(most, kGatherThreads * kGatherBatch), params.num_peers);
    gather_kernel<<<blocks, kGatherThreads, 0, stream>>>(params);
    return cudaGetLastError();
}

}  // namespace turbogs
