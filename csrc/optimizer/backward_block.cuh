// From the screen gradients of K views to the parameters, a thread per Gaussian: what a block shares, and the loop
// over the views of one Gaussian.
//
// The radii say in which views a Gaussian is on screen, and only the records of those are read. Each lane goes through
// its own views, so a warp makes as many turns as its busiest lane has views. The harmonics of a block are copied to
// shared memory asynchronously, in quads, and the cameras are kept there.
#pragma once

#include <cuda_pipeline.h>

#include "common/approximate_math.cuh"
#include "common/warp.cuh"
#include "optimizer/gaussian_backward.cuh"

namespace turbogs {

// A block owns this many consecutive Gaussians. Their harmonics are one contiguous piece of memory, which the block
// moves in 16-byte quads; in shared memory each thread works on its own row, whose odd stride keeps the banks apart.
// Measured best: 64 were 3 to 6 % slower, 192 no better.
constexpr int kBackwardThreads = 128;

constexpr int kReciprocalBits = 20;  // enough that `BlockShared::owner` is exact for every element of a block

// Shared memory of a block.
struct BlockShared {
    float* coefficients;  // [threads, stride] the harmonics of its Gaussians
    float* work;          // [threads, work_floats]
    ViewCamera* cameras;  // [K]
    bool* wanted;         // [threads] whether anybody needs the harmonics of this Gaussian
    int row;              // 3 B
    int stride;           // of a row of `coefficients`: 3 B made odd
    uint32_t reciprocal;  // of `row` in 2^-kReciprocalBits, rounded up

    __device__ BlockShared(float4* shared, const ScreenBackwardParams& params, int work_floats)
        : coefficients(reinterpret_cast<float*>(shared)),
          row(3 * params.bands),
          stride(row_stride(params)),
          reciprocal(row > 0 ? ((1u << kReciprocalBits) + row - 1) / row : 0u) {
        work = coefficients + kBackwardThreads * stride;
        wanted = reinterpret_cast<bool*>(work + kBackwardThreads * work_floats);
        cameras = reinterpret_cast<ViewCamera*>(wanted + kBackwardThreads);
    }

    static size_t bytes(const ScreenBackwardParams& params, int work_floats) {
        const int floats = row_stride(params) + work_floats;
        return kBackwardThreads * (floats * sizeof(float) + sizeof(bool)) + params.num_views * sizeof(ViewCamera);
    }

    // The Gaussian of the block that element `index` of its harmonics belongs to.
    __device__ __forceinline__ int owner(int index) const {
        return (static_cast<uint32_t>(index) * reciprocal) >> kReciprocalBits;
    }

    __host__ __device__ static int row_stride(const ScreenBackwardParams& params) {
        return params.bands > 0 ? (3 * params.bands) | 1 : 0;
    }

    __device__ __forceinline__ void load_cameras(const ScreenBackwardParams& params) const {
        for (int view = threadIdx.x; view < params.num_views; view += kBackwardThreads) {
            const size_t row = params.camera_rows[view];
            cameras[view] = load_camera(params.viewmats + 16 * row, params.intrinsics + 9 * row, params.widths[view],
                                        params.heights[view], params.num_views);
        }
    }

    // Starts to copy the harmonics that are wanted. `wait` of every thread and a barrier make them ready.
    __device__ __forceinline__ void start(const ScreenBackwardParams& params) const {
        const int first = static_cast<int>(blockIdx.x) * kBackwardThreads;
        const int count = min(kBackwardThreads, params.num_gaussians - first) * row;
        const float* in = params.shN + static_cast<size_t>(first) * row;
        for (int i = 4 * threadIdx.x; i < count; i += 4 * kBackwardThreads) {
            const int last = min(i + 3, count - 1);
            if (!(wanted[owner(i)] | wanted[owner(last)])) continue;
            if (last == i + 3 && stride == row) {
                __pipeline_memcpy_async(coefficients + i, in + i, sizeof(float4));
            } else {
                for (int j = i; j <= last; ++j) {
                    __pipeline_memcpy_async(coefficients + j + owner(j) * (stride - row), in + j, sizeof(float));
                }
            }
        }
    }

    __device__ __forceinline__ static void wait() {
        __pipeline_commit();
        __pipeline_wait_prior(0);
    }
};

// The parameters of one Gaussian but its harmonics, as they are stored.
struct StoredGaussian {
    float mean[3], log_scale[3], quat[4], sh0[3], logit;
};

__device__ __forceinline__ StoredGaussian load_gaussian(const ScreenBackwardParams& params, int gaussian) {
    StoredGaussian stored;
    const size_t triple = 3 * static_cast<size_t>(gaussian);
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        stored.mean[i] = params.means[triple + i];
        stored.log_scale[i] = params.scales[triple + i];
        stored.sh0[i] = params.sh0[triple + i];
    }
    const float4 quat = params.quats[gaussian];
    stored.quat[0] = quat.x, stored.quat[1] = quat.y, stored.quat[2] = quat.z, stored.quat[3] = quat.w;
    stored.logit = params.opacities[gaussian];
    return stored;
}

constexpr int kViewGroup = 32;  // views of one mask, a bit each

__device__ __forceinline__ void load_record(const ScreenBackwardParams& params, int view, int gaussian,
                                            float record[ScreenRecord::kSize]) {
    const float4* in = params.records + (static_cast<size_t>(view) * params.num_gaussians + gaussian) * kRecordQuads;
#pragma unroll
    for (int i = 0; i < kRecordQuads; ++i) {
        const float4 quad = in[i];
        record[4 * i] = quad.x, record[4 * i + 1] = quad.y, record[4 * i + 2] = quad.z, record[4 * i + 3] = quad.w;
    }
}

// Where a Gaussian is on screen.
struct Sight {
    uint32_t views = 0u;   // bit k: in view k of the first group
    int count = 0;         // views
    float largest = 0.0f;  // radius over the image's larger side
};

// Bit k: the Gaussian is on screen in view first + k.
__device__ __forceinline__ uint32_t views_on_screen(const ScreenBackwardParams& params, int gaussian, int first,
                                                    Sight* sight = nullptr) {
    const int end = min(params.num_views, first + kViewGroup);
    uint32_t mask = 0u;
#pragma unroll 5
    for (int view = first; view < end; ++view) {
        const int2 radius = params.radii[static_cast<size_t>(view) * params.num_gaussians + gaussian];
        if (radius.x <= 0 && radius.y <= 0) continue;
        mask |= 1u << (view - first);
        if (sight == nullptr) continue;
        const float side = static_cast<float>(max(params.widths[view], params.heights[view]));
        sight->largest =
            fmaxf(sight->largest, static_cast<float>(max(radius.x, radius.y)) * approximate_reciprocal(side));
    }
    return mask;
}

__device__ __forceinline__ Sight sight_of(const ScreenBackwardParams& params, int gaussian) {
    Sight sight;
    for (int first = 0; first < params.num_views; first += kViewGroup) {
        const uint32_t mask = views_on_screen(params, gaussian, first, &sight);
        if (first == 0) sight.views = mask;
        sight.count += __popc(mask);
    }
    return sight;
}

// Adds to the window of statistics; nobody waits for what is there.
__device__ __forceinline__ void add_stat(float* sums, int gaussian, float value) { atomicAdd(sums + gaussian, value); }

__device__ __forceinline__ void add_sight(const ScreenBackwardParams& params, int gaussian, const Sight& sight) {
    if (params.view_counts == nullptr || sight.count == 0) return;
    add_stat(params.view_counts, gaussian, static_cast<float>(sight.count));
    // Bits of numbers that are not negative are in the numbers' order.
    atomicMax(reinterpret_cast<int*>(params.max_radii) + gaussian, __float_as_int(sight.largest));
}

// One Gaussian in the views that its masks name: gives each view's row and colour gradient to `sink.add(view, camera,
// row, color)`, and the sums to the statistics. `views_of(first)` is the mask of a group of views. With kSampledOnly,
// views in which no sample met the Gaussian are left out. Lanes go through their own views.
template <bool kSampledOnly, class ViewsOf, class Sink>
__device__ __forceinline__ void backward_views(const ScreenBackwardParams& params, const ViewCamera* cameras,
                                               const float* coefficients, int gaussian, const StoredGaussian& stored,
                                               const ViewsOf& views_of, Sink& sink) {
    float error_sum = 0.0f, distance_sum = 0.0f, weight_sum = 0.0f, grad_sum = 0.0f, absgrad_sum = 0.0f;
    float square_sum = 0.0f;
    const GaussianShape shape = make_shape(stored.mean, stored.log_scale, stored.quat);
    const float opacity = 1.0f / (1.0f + expf(-stored.logit));

    for (int first = 0; first < params.num_views; first += kViewGroup) {
        for (uint32_t left = views_of(first); left != 0u; left &= left - 1u) {
            const int view = first + __ffs(static_cast<int>(left)) - 1;
            float record[ScreenRecord::kSize];
            load_record(params, view, gaussian, record);
            using Place = ScreenRecord;
            if (kSampledOnly && !(record[Place::kWeightSum] > 0.0f)) continue;
            const ViewCamera& camera = cameras[view];
            const float* grad_mean2d = record + Place::kMean;
            float grad_color[3];
#pragma unroll
            for (int c = 0; c < 3; ++c) grad_color[c] = record[Place::kColor + c];
            float row[ParameterRow::kSize];
            geometry_backward(shape, camera, params.eps2d, grad_mean2d, record + Place::kConic,
                              record[Place::kDepth], row);
            color_backward(shape, camera, stored.sh0, params.sh_degree, coefficients, grad_color, row);
            row[ParameterRow::kOpacities] = record[Place::kOpacity] * opacity * (1.0f - opacity);
            sink.add(view, camera, row, grad_color);

            error_sum += record[Place::kErrorSum];
            distance_sum += record[Place::kDistanceSum];
            weight_sum += record[Place::kWeightSum];
            square_sum += record[Place::kSquareSum];
            const float gx = grad_mean2d[0] * camera.grad_scale_x, gy = grad_mean2d[1] * camera.grad_scale_y;
            const float ax = record[Place::kAbsolute] * camera.grad_scale_x;
            const float ay = record[Place::kAbsolute + 1] * camera.grad_scale_y;
            grad_sum += approximate_sqrt(gx * gx + gy * gy);
            absgrad_sum += approximate_sqrt(ax * ax + ay * ay);
        }
    }
    if (params.error_sums != nullptr) {
        add_stat(params.error_sums, gaussian, error_sum);
        add_stat(params.distance_sums, gaussian, distance_sum);
        add_stat(params.weight_sums, gaussian, weight_sum);
        add_stat(params.grad_sums, gaussian, grad_sum);
        add_stat(params.absgrad_sums, gaussian, absgrad_sum);
        add_stat(params.square_sums, gaussian, square_sum);
    }
}

// Launches a kernel whose threads have `work_floats` each in `BlockShared::work`.
template <class Second>
void launch_blocks(void (*kernel)(ScreenBackwardParams, Second), int work_floats, const ScreenBackwardParams& params,
                   const Second& second, cudaStream_t stream) {
    const size_t bytes = BlockShared::bytes(params, work_floats);
    cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, static_cast<int>(bytes));
    const int blocks = blocks_for(params.num_gaussians, kBackwardThreads);
    kernel<<<blocks, kBackwardThreads, bytes, stream>>>(params, second);
}

}  // namespace turbogs
