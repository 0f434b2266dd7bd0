// Backward pass of the projection alone: gradients of the parameters in memory, for optimizers without a kernel of
// their own and for torch autograd.
//
// A thread per Gaussian. It looks for the views in which the Gaussian has gradients, takes each of those records to a
// row of 14 numbers, and writes the rows or their sum; where there is nothing it writes zeros. Gradients of the
// harmonics add up in shared memory and leave it at the end, all of a block's together.
#include "optimizer/backward_block.cuh"

namespace turbogs {
namespace {

struct BackwardShared {
    SharedHarmonics harmonics;
    float* gradients;  // [threads, stride] of the harmonics
    ViewCamera* cameras;

    __device__ BackwardShared(float* shared, const ScreenBackwardParams& params)
        : harmonics(shared, nullptr, params) {
        gradients = shared + kBackwardThreads * harmonics.stride;
        cameras = reinterpret_cast<ViewCamera*>(gradients + kBackwardThreads * harmonics.stride);
        harmonics.wanted = reinterpret_cast<bool*>(cameras + params.num_views);
    }

    static size_t bytes(const ScreenBackwardParams& params) {
        return 2 * kBackwardThreads * SharedHarmonics::row_stride(params) * sizeof(float) +
               params.num_views * sizeof(ViewCamera) + kBackwardThreads;
    }
};

// Gradients of the harmonics of one Gaussian, added up in its row of shared memory.
struct HarmonicsSum {
    const float* mean;
    int degree;
    float* gradients;

    __device__ void add(const ViewCamera& camera, const float grad_color[3]) {
        add_harmonics_gradient(mean, camera, degree, grad_color, gradients);
    }
};

// Where the rows of one Gaussian go: to memory, view by view.
struct RowWriter {
    HarmonicsSum harmonics;
    float2* rows;        // [K, N, 14]
    float* view_losses;  // [K, N]
    int num_gaussians;
    int gaussian;

    __device__ void add(int view, const ViewCamera& camera, const RowGradient& row, const float grad_color[3],
                        float loss) {
        harmonics.add(camera, grad_color);
        write(view, row, loss);
    }

    __device__ void write(int view, const RowGradient& row, float loss) {
        const size_t place = static_cast<size_t>(view) * num_gaussians + gaussian;
        float values[ParameterRow::kSize];
        row.pack(values);
        float2* out = rows + place * (ParameterRow::kSize / 2);
#pragma unroll
        for (int i = 0; i < ParameterRow::kSize / 2; ++i) out[i] = make_float2(values[2 * i], values[2 * i + 1]);
        view_losses[place] = loss;
    }
};

// The sum of the rows, in registers.
struct RowSum {
    HarmonicsSum harmonics;
    RowGradient sum = {};
    float loss = 0.0f;

    __device__ void add(int, const ViewCamera& camera, const RowGradient& row, const float grad_color[3],
                        float view_loss) {
        harmonics.add(camera, grad_color);
#pragma unroll
        for (int i = 0; i < 3; ++i) {
            sum.mean[i] += row.mean[i];
            sum.scale[i] += row.scale[i];
            sum.sh0[i] += row.sh0[i];
        }
#pragma unroll
        for (int i = 0; i < 4; ++i) sum.quat[i] += row.quat[i];
        sum.opacity += row.opacity;
        loss += view_loss;
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
        const LoadedRecord record(record_of(params, first + number, gaussian));
        bool any = false;
#pragma unroll
        for (int i = 0; i < ScreenRecord::kSize - 1; ++i) any = any || record[i] != 0.0f;  // the last is unused
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
    const BackwardShared block(reinterpret_cast<float*>(shared), params);
    const SharedHarmonics& harmonics = block.harmonics;
    const int gaussian = blockIdx.x * kBackwardThreads + threadIdx.x;
    const bool inside = gaussian < params.num_gaussians;

    load_cameras(params, block.cameras);
    bool touched = false, any = false;
    for (int first = 0; inside && first < params.num_views; first += kViewGroup) {
        any = views_with_gradient(params, gaussian, first, touched) != 0u || any;
    }
    harmonics.wanted[threadIdx.x] = any;
    for (int i = threadIdx.x; i < kBackwardThreads * harmonics.stride; i += kBackwardThreads) block.gradients[i] = 0.0f;
    __syncthreads();
    harmonics.start(params);
    const StoredGaussian stored = any ? load_gaussian(params, gaussian) : StoredGaussian{};
    wait_for_copies();
    __syncthreads();

    const auto views_of = [&](int first) {
        bool unused = false;
        return any ? views_with_gradient(params, gaussian, first, unused) : 0u;
    };
    const float* coefficients = harmonics.coefficients + threadIdx.x * harmonics.stride;
    const HarmonicsSum sum{stored.mean, params.sh_degree, block.gradients + threadIdx.x * harmonics.stride};
    if (inside) {
        RowWriter writer{sum, outputs.rows, outputs.view_losses, params.num_gaussians, gaussian};
        if (kPerView) {
            if (any) backward_views<false>(params, block.cameras, coefficients, gaussian, stored, views_of, writer);
            const RowGradient zero = {};
            for (int first = 0; first < params.num_views; first += kViewGroup) {
                const uint32_t mask = views_of(first);
                for (int view = first; view < min(params.num_views, first + kViewGroup); ++view) {
                    if ((mask >> (view - first) & 1u) == 0u) writer.write(view, zero, 0.0f);
                }
            }
        } else {
            RowSum total{sum};
            if (any) backward_views<false>(params, block.cameras, coefficients, gaussian, stored, views_of, total);
            writer.write(0, total.sum, total.loss);
        }
        if (params.view_counts != nullptr) add_sight(params, gaussian, sight_of(params, gaussian));
        outputs.touched[gaussian] = touched;
    }
    __syncthreads();
    const int row = harmonics.row;
    const int count =
        min(kBackwardThreads, params.num_gaussians - static_cast<int>(blockIdx.x) * kBackwardThreads) * row;
    float* out = outputs.shN + static_cast<size_t>(blockIdx.x) * kBackwardThreads * row;
    for (int i = threadIdx.x; i < count; i += kBackwardThreads) {
        out[i] = block.gradients[i + harmonics.owner(i) * (harmonics.stride - row)];
    }
}

template <bool kPerView>
cudaError_t launch(const ScreenBackwardParams& params, const ProjectionBackwardOutputs& outputs, cudaStream_t stream) {
    const size_t bytes = BackwardShared::bytes(params);
    auto kernel = projection_backward_kernel<kPerView>;
    const cudaError_t status =
        cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, static_cast<int>(bytes));
    if (status != cudaSuccess) return status;
    const int blocks = blocks_for(params.num_gaussians, kBackwardThreads);
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
