// The depth term of the loss, with its gradient by the rendered depths. Defined by `depth_loss` of
// turbogs_plugin/engine/reference/losses.py. A warp takes a tile, a lane every kWarpSize-th of its samples.
#include "common/warp.cuh"
#include "loss/sample_loss.cuh"

namespace turbogs {
namespace {

constexpr int kDepthThreads = 128;  // of a block
constexpr int kDepthWarps = kDepthThreads / kWarpSize;
constexpr float kInverseDepthMax = 1000.0f;  // INVERSE_DEPTH_MAX of reference/losses.py

__global__ void __launch_bounds__(kDepthThreads) depth_loss_kernel(const __grid_constant__ SparseLossParams params) {
    __shared__ double losses[kDepthWarps];
    const int tile = blockIdx.x * kDepthWarps + this_warp();
    const int filled = params.num_filled != nullptr ? max(*params.num_filled, 1) : params.num_slots;
    const float scale = params.depth_factor / static_cast<float>(filled);
    float sum = 0.0f;
    if (tile < params.num_tiles) {
        const SampleView& view = params.views[view_of_tile(params.views, params.num_views, params.tile_ids[tile])];
        const float* known = params.inverse_depths + params.first_cells[view.view_number];
        const int cells_x = (view.width + params.cell - 1) / params.cell, end = params.tile_offsets[tile + 1];
        for (int slot = params.tile_offsets[tile] + this_lane(); slot < end; slot += kWarpSize) {
            const int pixel = params.pixel_ids[slot];
            float gradient = 0.0f;
            if (pixel >= 0) {
                const int y = pixel / view.width, x = pixel - y * view.width;
                const float truth = known[static_cast<size_t>(y / params.cell) * cells_x + x / params.cell];
                const float depth = params.depths[slot], inverse = 1.0f / depth;
                if (depth > 0.0f && inverse <= kInverseDepthMax && truth > 0.0f && truth <= kInverseDepthMax) {
                    const float weight = params.weights != nullptr ? params.weights[slot] * scale : scale;
                    const float difference = inverse - truth;
                    const float root = sqrtf(difference * difference + params.epsilon * params.epsilon);
                    sum += weight * (difference * (difference / (root + params.epsilon)));
                    gradient = -weight * (difference / root) * inverse * inverse;
                }
            }
            params.depth_gradients[slot] = gradient;
        }
    }
    sum = warp_sum(sum);
    if (this_lane() == 0) losses[this_warp()] = static_cast<double>(sum);
    __syncthreads();
    if (threadIdx.x == 0) {
        double loss = 0.0;
        for (int i = 0; i < kDepthWarps; ++i) loss += losses[i];
        add_loss(params, loss);
    }
}

}  // namespace

void launch_depth_loss(const SparseLossParams& params, cudaStream_t stream) {
    depth_loss_kernel<<<blocks_for(params.num_tiles, kDepthWarps), kDepthThreads, 0, stream>>>(params);
}

}  // namespace turbogs
