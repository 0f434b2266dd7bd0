// Backward pass of the projection alone: gradients of the parameters in memory, for optimizers without a kernel of
// their own and for torch autograd.
#include "projection_backward.cuh"

namespace turbogs {
namespace {

// Where the rows of one Gaussian go: to memory, view by view.
struct RowWriter {
    float* rows;         // [K, N, 14]
    float* view_losses;  // [K, N]
    int num_gaussians;
    int gaussian;

    __device__ void add(int view, const RowGradient& row, float loss) { write(view, row, loss); }

    __device__ void write(int view, const RowGradient& row, float loss) {
        const size_t place = static_cast<size_t>(view) * num_gaussians + gaussian;
        float2* out = reinterpret_cast<float2*>(rows + place * kRowSize);
        out[0] = make_float2(row.mean[0], row.mean[1]);
        out[1] = make_float2(row.mean[2], row.scale[0]);
        out[2] = make_float2(row.scale[1], row.scale[2]);
        out[3] = make_float2(row.quat[0], row.quat[1]);
        out[4] = make_float2(row.quat[2], row.quat[3]);
        out[5] = make_float2(row.sh0[0], row.sh0[1]);
        out[6] = make_float2(row.sh0[2], row.opacity);
        view_losses[place] = loss;
    }
};

// The sum of the rows, in registers.
struct RowSum {
    RowGradient sum = {};
    float loss = 0.0f;

    __device__ void add(int, const RowGradient& row, float view_loss) {
        add_row(sum, row);
        loss += view_loss;
    }
};

// Bit k: some gradient or sum of view k is not zero. Wider than `Sight::touched`: a loss of a user may put gradients on
// projected means that no sample saw.
__device__ __forceinline__ uint32_t views_with_gradient(const ScreenBackwardParams& params, int gaussian) {
    uint32_t mask = 0u;
    for (int view = 0; view < params.num_views; ++view) {
        const float4* record =
            params.records + (static_cast<size_t>(view) * params.num_gaussians + gaussian) * kRecordQuads;
        bool any = false;
#pragma unroll
        for (int i = 0; i < kRecordQuads; ++i) {
            const float4 quad = record[i];
            any = any || quad.x != 0.0f || quad.y != 0.0f || quad.z != 0.0f || (i < 3 && quad.w != 0.0f);
        }
        if (any) mask |= 1u << view;
    }
    return mask;
}

template <bool kPerView>
__global__ void __launch_bounds__(kBackwardThreads) projection_backward_kernel(
    const __grid_constant__ ScreenBackwardParams params, const ProjectionBackwardOutputs outputs) {
    if (params.overflow != nullptr && *params.overflow != 0) return;
    extern __shared__ float shared[];
    const BackwardShared block(shared, params);
    const int gaussian = blockIdx.x * kBackwardThreads + threadIdx.x;
    const bool inside = gaussian < params.num_gaussians;

    load_cameras(params, block);
    const uint32_t mask = inside ? views_with_gradient(params, gaussian) : 0u;
    const Sight sight = inside ? sight_of(params, gaussian) : Sight{};
    start_harmonics(params, block, mask != 0u);
    const StoredGaussian stored = mask != 0u ? load_gaussian(params, gaussian) : StoredGaussian{};
    wait_for_copies();
    __syncthreads();

    if (inside) {
        RowWriter writer{outputs.rows, outputs.view_losses, params.num_gaussians, gaussian};
        if (kPerView) {
            backward_views(params, block, gaussian, mask, sight, stored, writer);
            const RowGradient zero = {};
            for (int view = 0; view < params.num_views; ++view) {
                if ((mask >> view & 1u) == 0u) writer.write(view, zero, 0.0f);
            }
        } else {
            RowSum total;
            backward_views(params, block, gaussian, mask, sight, stored, total);
            writer.write(0, total.sum, total.loss);
        }
        outputs.touched[gaussian] = sight.touched != 0u;
    }
    __syncthreads();
    const int row = 3 * params.bands;
    const int count = min(kBackwardThreads, params.num_gaussians - static_cast<int>(blockIdx.x) * kBackwardThreads) * row;
    float* out = outputs.shN + static_cast<size_t>(blockIdx.x) * kBackwardThreads * row;
    for (int i = threadIdx.x; i < count; i += kBackwardThreads) {
        const int owner = block.owner(i);
        out[i] = block.gradients[owner * block.stride + (i - owner * row)];
    }
}

template <bool kPerView>
cudaError_t launch(const ScreenBackwardParams& params, const ProjectionBackwardOutputs& outputs, cudaStream_t stream) {
    const size_t bytes = BackwardShared::bytes(params);
    auto kernel = projection_backward_kernel<kPerView>;
    const cudaError_t status =
        cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, static_cast<int>(bytes));
    if (status != cudaSuccess) return status;
    const int blocks = (params.num_gaussians + kBackwardThreads - 1) / kBackwardThreads;
    kernel<<<blocks, kBackwardThreads, bytes, stream>>>(params, outputs);
    return cudaGetLastError();
}

}  // namespace

cudaError_t launch_projection_backward(const ScreenBackwardParams& params, const ProjectionBackwardOutputs& outputs,
                                       cudaStream_t stream) {
    if (params.num_gaussians == 0) return cudaSuccess;
    return outputs.per_view ? launch<true>(params, outputs, stream) : launch<false>(params, outputs, stream);
}

}  // namespace turbogs
