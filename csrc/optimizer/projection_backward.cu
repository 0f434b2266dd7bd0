// Backward pass of the projection alone: gradients of the parameters in memory, for optimizers without a kernel of
// their own and for torch autograd.
//
// A thread takes one Gaussian. It finds the views in which the Gaussian has gradients, turns each of those records into
// a row of 14 numbers, and writes the rows or their sum; where there is nothing it writes zeros. The gradients of the
// harmonics are summed in shared memory, and the block writes them together at the end.
#include "optimizer/backward_block.cuh"

namespace turbogs {
namespace {

// Writes the rows of one Gaussian, or adds them up, and adds up its gradients of the harmonics in shared memory.
template <bool kPerView>
struct RowWriter {
    const ProjectionBackwardOutputs& outputs;
    const float* mean;
    int degree, num_gaussians, gaussian;
    float* harmonics;
    float sum[ParameterRow::kSize] = {};  // unless kPerView

    __device__ void add(int view, const ViewCamera& camera, const float row[ParameterRow::kSize],
                        const float grad_color[3]) {
        add_harmonics_gradient(mean, camera, degree, grad_color, harmonics);
        if (kPerView) {
            write(view, row);
        } else {
#pragma unroll
            for (int i = 0; i < ParameterRow::kSize; ++i) sum[i] += row[i];
        }
    }

    __device__ void write(int view, const float row[ParameterRow::kSize]) const {
        const size_t place = static_cast<size_t>(view) * num_gaussians + gaussian;
        float2* out = outputs.rows + place * (ParameterRow::kSize / 2);
#pragma unroll
        for (int i = 0; i < ParameterRow::kSize / 2; ++i) out[i] = make_float2(row[2 * i], row[2 * i + 1]);
    }
};

// Bit k: the Gaussian is on screen in view first + k, and some gradient or sum of its is not zero there; off screen
// records hold anything. Wider than `touched`: a loss of a user may put gradients on projected means that no sample
// saw.
__device__ __forceinline__ uint32_t views_with_gradient(const ScreenBackwardParams& params, int gaussian, int first,
                                                        bool& touched) {
    uint32_t mask = 0u;
    for (uint32_t left = views_on_screen(params, gaussian, first); left != 0u; left &= left - 1u) {
        const int number = __ffs(static_cast<int>(left)) - 1;
        float record[ScreenRecord::kSize];
        load_record(params, first + number, gaussian, record);
        bool any = false;
#pragma unroll
        for (int i = 0; i < ScreenRecord::kSize - 1; ++i) any = any || record[i] != 0.0f;  // the last is of squares
        touched = touched || record[ScreenRecord::kWeightSum] > 0.0f;
        if (any) mask |= 1u << number;
    }
    return mask;
}

template <bool kPerView>
__global__ void __launch_bounds__(kBackwardThreads) projection_backward_kernel(
    const __grid_constant__ ScreenBackwardParams params, const ProjectionBackwardOutputs outputs) {
    if (params.overflow != nullptr && *params.overflow != 0) return;
    extern __shared__ float4 shared[];
    const BlockShared block(shared, params, BlockShared::row_stride(params));
    const int gaussian = blockIdx.x * kBackwardThreads + threadIdx.x;
    const bool inside = gaussian < params.num_gaussians;

    block.load_cameras(params);
    bool touched = false, any = false;
    for (int first = 0; inside && first < params.num_views; first += kViewGroup) {
        any = views_with_gradient(params, gaussian, first, touched) != 0u || any;
    }
    block.wanted[threadIdx.x] = any;
    for (int i = threadIdx.x; i < kBackwardThreads * block.stride; i += kBackwardThreads) block.work[i] = 0.0f;
    __syncthreads();
    block.start(params);
    const StoredGaussian stored = any ? load_gaussian(params, gaussian) : StoredGaussian{};
    block.wait();
    __syncthreads();

    const auto views_of = [&](int first) {
        bool unused = false;
        return any ? views_with_gradient(params, gaussian, first, unused) : 0u;
    };
    const float* coefficients = block.coefficients + threadIdx.x * block.stride;
    if (inside) {
        RowWriter<kPerView> writer{outputs, stored.mean, params.sh_degree, params.num_gaussians, gaussian,
                                   block.work + threadIdx.x * block.stride};
        if (any) backward_views<false>(params, block.cameras, coefficients, gaussian, stored, views_of, writer);
        if (kPerView) {
            const float zeros[ParameterRow::kSize] = {};
            for (int first = 0; first < params.num_views; first += kViewGroup) {
                const uint32_t mask = views_of(first);
                for (int view = first; view < min(params.num_views, first + kViewGroup); ++view) {
                    if ((mask >> (view - first) & 1u) == 0u) writer.write(view, zeros);
                }
            }
        } else {
            writer.write(0, writer.sum);
        }
        if (params.view_counts != nullptr) add_sight(params, gaussian, sight_of(params, gaussian));
        outputs.touched[gaussian] = touched;
    }
    __syncthreads();
    const int row = block.row;
    const int count =
        min(kBackwardThreads, params.num_gaussians - static_cast<int>(blockIdx.x) * kBackwardThreads) * row;
    float* out = outputs.shN + static_cast<size_t>(blockIdx.x) * kBackwardThreads * row;
    for (int i = threadIdx.x; i < count; i += kBackwardThreads) {
        out[i] = block.work[i + block.owner(i) * (block.stride - row)];
    }
}

}  // namespace

void launch_projection_backward(const ScreenBackwardParams& params, const ProjectionBackwardOutputs& outputs,
                                cudaStream_t stream) {
    if (params.num_gaussians == 0) return;
    const auto kernel = outputs.per_view ? projection_backward_kernel<true> : projection_backward_kernel<false>;
    launch_blocks(kernel, BlockShared::row_stride(params), params, outputs, stream);
}

}  // namespace turbogs
