// How many slots of a batch are filled, where a sampler leaves some empty: losses are means over those. A thread takes
// kThreadSlots slots or more, and warps add up what their lanes found.
#include <algorithm>

#include "common/warp.cuh"
#include "loss/loss_params.h"

namespace turbogs {
namespace {

// No record of other values: the launch is small.
constexpr int kCountThreads = 256;
constexpr int kThreadSlots = 4;
constexpr int kCountBlocks = 512;  // at most; of larger batches a thread takes more slots

__global__ void __launch_bounds__(kCountThreads) count_filled_kernel(const __grid_constant__ CountFilledParams params) {
    int mine = 0;
    for (int i = blockIdx.x * kCountThreads + threadIdx.x; i < params.num_slots; i += gridDim.x * kCountThreads) {
        mine += params.pixel_ids[i] >= 0;
    }
    const uint32_t total = __reduce_add_sync(kFullWarp, static_cast<uint32_t>(mine));
    if (this_lane() == 0 && total != 0u) atomicAdd(params.num_filled, static_cast<int32_t>(total));
}

}  // namespace

cudaError_t launch_count_filled(const CountFilledParams& params, cudaStream_t stream) {
    if (params.num_slots == 0) return cudaSuccess;
    const int blocks = std::min(blocks_for(params.num_slots, kThreadSlots * kCountThreads), kCountBlocks);
    count_filled_kernel<<<blocks, kCountThreads, 0, stream>>>(params);
    return cudaGetLastError();
}

}  // namespace turbogs
