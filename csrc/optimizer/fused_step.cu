// Projection backward and the optimizer's step in one kernel: gradients never reach memory.
//
// A thread per Gaussian. It goes through the views that have the Gaussian on screen, takes each record that a sample
// contributed to to a row of 14 gradients, keeps the row and sums the rows; the sum advances the moments, which give
// the damping. A second pass over the rows scales them by the damping, so that the systems are the identity plus
// something positive semi-definite, and solves the two blocks (moment_lm.cuh) by Cholesky in registers; a third adds
// up the harmonics' gradients, also in registers. Afterwards the block updates its Gaussians' harmonics together, in
// 16-byte quads.
//
// Rows lie in shared memory, those beyond the first few in the place of records that are done with.
//
// There are few warps, so what is read is read early and in batches, and sums are added without waiting for them.
#include "optimizer/backward_block.cuh"
#include "optimizer/moment_lm.cuh"

namespace turbogs {
namespace {

constexpr float kLargeGradient = 1e30f;  // of a colour: beyond, the sums of the harmonics may overflow
constexpr int kStepBlocks = 3;           // of an SM: up to 168 registers, so that nothing spills
constexpr int kQuadBatch = 4;            // quads of harmonics that a thread has under way; measured with the rest
constexpr int kSharedSlots = 4;          // rows of a Gaussian in shared memory; five were slower, 526 us for 485

// A slot: a row, the loss of its view, its view (bits).
constexpr int kLossPlace = ParameterRow::kSize, kViewPlace = kLossPlace + 1, kSlotFloats = kViewPlace + 1;
static_assert(kSlotFloats == ScreenRecord::kSize, "a row that is kept takes the place of a record");

// The rows of J: none (Adam), the sum of the views' rows, or each.
enum class Rows { kNone, kSummed, kPerView };

struct StepShared {
    SharedHarmonics harmonics;
    float* work;          // [threads, work_stride] slots of each thread; later the harmonics' gradients, [threads, 3 B]
    float2* corrections;  // [threads] inverses of the two bias corrections
    ViewCamera* cameras;  // [K]
    bool* updated;        // [threads]
    int work_stride;      // odd

    __host__ __device__ static int slots(const ScreenBackwardParams& params) {
        return params.num_views < kSharedSlots ? params.num_views : kSharedSlots;
    }

    __host__ __device__ static int work_row(const ScreenBackwardParams& params) {
        const int rows = kSlotFloats * slots(params), gradients = 3 * params.bands;
        return (rows > gradients ? rows : gradients) | 1;
    }

    __device__ StepShared(float* shared, const ScreenBackwardParams& params)
        : harmonics(shared, nullptr, params), work_stride(work_row(params)) {
        work = shared + kBackwardThreads * harmonics.stride;
        corrections = reinterpret_cast<float2*>(work + kBackwardThreads * work_stride);
        cameras = reinterpret_cast<ViewCamera*>(corrections + kBackwardThreads);
        updated = reinterpret_cast<bool*>(cameras + params.num_views);
        harmonics.wanted = updated;
    }

    static size_t bytes(const ScreenBackwardParams& params) {
        const int floats = SharedHarmonics::row_stride(params) + work_row(params) + 2;
        return kBackwardThreads * (floats * sizeof(float) + sizeof(bool)) + params.num_views * sizeof(ViewCamera);
    }
};

// Sums the rows of one Gaussian, and keeps them. Row s lies in slot s of shared memory, or where the record of view s
// was.
struct RowCollector {
    float* slots;
    float4* records;  // of this Gaussian in view 0
    size_t step;      // from view to view
    int num_slots;
    int count = 0;    // rows
    float sum[ParameterRow::kSize] = {};
    float loss = 0.0f;
    bool finite = true;
    bool large = false;

    __device__ __forceinline__ void add(int view, const ViewCamera&, const RowGradient& row, const float*,
                                        float view_loss) {
        float values[kSlotFloats];
        row.pack(values);
        values[kLossPlace] = view_loss;
        values[kViewPlace] = __int_as_float(view);
#pragma unroll
        for (int i = 0; i < ParameterRow::kSize; ++i) {
            finite = finite && is_finite(values[i]);
            const bool of_color = i >= ParameterRow::kSh0 && i < ParameterRow::kSh0 + 3;
            large = large || (of_color && !(fabsf(values[i]) < kLargeGradient));
            sum[i] += clip_gradient(values[i]);
        }
        loss += view_loss;
        if (count < num_slots) {
            float* slot = slots + kSlotFloats * count;
#pragma unroll
            for (int i = 0; i < kSlotFloats; ++i) slot[i] = values[i];
        } else {
            float4* record = records + count * step;  // no later than that of `view`, which is read already
#pragma unroll
            for (int i = 0; i < kSlotFloats / 4; ++i) {
                record[i] = make_float4(values[4 * i], values[4 * i + 1], values[4 * i + 2], values[4 * i + 3]);
            }
        }
        ++count;
    }

    // kSize numbers of row `s` from kFirst on, and behind them its loss and its view.
    template <int kFirst, int kSize>
    __device__ __forceinline__ void get(int s, float (&values)[kSize + 2]) const {
        if (s < num_slots) {
            const float* slot = slots + kSlotFloats * s;
#pragma unroll
            for (int i = 0; i < kSize; ++i) values[i] = slot[kFirst + i];
            values[kSize] = slot[kLossPlace];
            values[kSize + 1] = slot[kViewPlace];
        } else {
            const float* record = reinterpret_cast<const float*>(records + s * step);
#pragma unroll
            for (int i = 0; i < kSize; ++i) values[i] = record[kFirst + i];
            values[kSize] = record[kLossPlace];
            values[kSize + 1] = record[kViewPlace];
        }
    }

    template <int kFirst, int kSize, class Weight>
    __device__ __forceinline__ void add_to(DampedSystem<kSize>& system, const float* scale,
                                           const Weight& weight_of) const {
        for (int s = 0; s < count; ++s) {
            float row[kSize + 2];
            get<kFirst, kSize>(s, row);
#pragma unroll
            for (int i = 0; i < kSize; ++i) row[i] = clip_gradient(row[i]);
            system.add(row, scale + kFirst, weight_of(row[kSize]));
        }
    }

    // Gradients of the harmonics above band 0.
    __device__ __forceinline__ void harmonics(const float mean[3], const ViewCamera* cameras, int degree,
                                              float (&gradients)[3 * kMaxBands]) const {
        for (int s = 0; s < count; ++s) {
            float row[3 + 2];
            get<ParameterRow::kSh0, 3>(s, row);
            float grad_color[3];
#pragma unroll
            for (int c = 0; c < 3; ++c) grad_color[c] = row[c] * (1.0f / kShBand0);
            add_harmonics_gradient(mean, cameras[__float_as_int(row[4])], degree, grad_color, gradients);
        }
    }

    __device__ __forceinline__ bool all_finite(const float mean[3], const ViewCamera* cameras, int degree) const {
        bool result = finite;
        if (large && degree > 0) {
            float gradients[3 * kMaxBands] = {};
            harmonics(mean, cameras, degree, gradients);
            for (float gradient : gradients) result = result && is_finite(gradient);
        }
        return result;
    }
};

// Moments, solution and new values of one Gaussian's 14 parameters.
template <Rows kRows>
__device__ __forceinline__ void update_row(const ScreenBackwardParams& params, const OptimizerParams& optimizer, int gaussian, const RowCollector& rows,
                                           const StoredGaussian& old, float2 corrections) {
    const size_t first_pair = static_cast<size_t>(gaussian) * (ParameterRow::kSize / 2);
    Terms terms = advance(optimizer, rows.sum, corrections, optimizer.exp_avg + first_pair,
                          optimizer.exp_avg_sq + first_pair);
    if (kRows == Rows::kPerView) {
        const auto geometry = [&](auto& system, const auto& weight_of) {
            rows.add_to<kGeometryFirst>(system, terms.scale, weight_of);
        };
        const auto appearance = [&](auto& system, const auto& weight_of) {
            rows.add_to<kAppearanceFirst>(system, terms.scale, weight_of);
        };
        solve_block<kGeometryFirst, kGeometrySize>(optimizer, geometry, terms);
        solve_block<kAppearanceFirst, kAppearanceSize>(optimizer, appearance, terms);
    } else if (kRows == Rows::kSummed) {
        const auto geometry = [&](auto& system, const auto& weight_of) {
            system.add(rows.sum, terms.scale, weight_of(rows.loss));
        };
        const auto appearance = [&](auto& system, const auto& weight_of) {
            system.add(rows.sum + kAppearanceFirst, terms.scale + kAppearanceFirst, weight_of(rows.loss));
        };
        solve_block<kGeometryFirst, kGeometrySize>(optimizer, geometry, terms);
        solve_block<kAppearanceFirst, kAppearanceSize>(optimizer, appearance, terms);
    }
    const size_t triple = 3 * static_cast<size_t>(gaussian);
    using Place = ParameterRow;
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        params.means[triple + i] = __fadd_rn(old.mean[i], terms.adam[Place::kMeans + i]);
        params.scales[triple + i] = __fadd_rn(old.log_scale[i], terms.adam[Place::kScales + i]);
        params.sh0[triple + i] = __fadd_rn(old.sh0[i], terms.adam[Place::kSh0 + i]);
    }
    const float* turn = terms.adam + Place::kQuats;
    params.quats[gaussian] =
        make_float4(__fadd_rn(old.quat[0], turn[0]), __fadd_rn(old.quat[1], turn[1]), __fadd_rn(old.quat[2], turn[2]),
                    __fadd_rn(old.quat[3], turn[3]));
    params.opacities[gaussian] = __fadd_rn(old.logit, terms.adam[Place::kOpacities]);
}

// Adam on the harmonics of the block's updated Gaussians. Values and gradients come from shared memory.
__device__ __forceinline__ void update_harmonics(const ScreenBackwardParams& params, const OptimizerParams& optimizer,
                                                 const StepShared& block) {
    const SharedHarmonics& harmonics = block.harmonics;
    const int first = static_cast<int>(blockIdx.x) * kBackwardThreads;
    const int count = min(kBackwardThreads, params.num_gaussians - first) * harmonics.row;
    const size_t base = static_cast<size_t>(first) * harmonics.row;
    for (int start = 4 * threadIdx.x; start < count; start += kQuadBatch * 4 * kBackwardThreads) {
        float4 means[kQuadBatch], squares[kQuadBatch];
        bool wanted[kQuadBatch];
#pragma unroll
        for (int q = 0; q < kQuadBatch; ++q) {
            const int i = start + q * 4 * kBackwardThreads;
            wanted[q] = i + 3 < count && (block.updated[harmonics.owner(i)] | block.updated[harmonics.owner(i + 3)]);
            if (!wanted[q]) continue;
            means[q] = *reinterpret_cast<const float4*>(optimizer.exp_avg_shN + base + i);
            squares[q] = *reinterpret_cast<const float4*>(optimizer.exp_avg_sq_shN + base + i);
        }
#pragma unroll
        for (int q = 0; q < kQuadBatch; ++q) {
            if (!wanted[q]) continue;
            const int i = start + q * 4 * kBackwardThreads;
            const int owners[2] = {harmonics.owner(i), harmonics.owner(i + 3)};
            const int boundary = owners[1] * harmonics.row - i;  // elements from here on are the second owner's
            const float2 corrections[2] = {block.corrections[owners[0]], block.corrections[owners[1]]};
            const float4 gradient = *reinterpret_cast<const float4*>(block.work + i);
            float4 value;
            if (harmonics.stride == harmonics.row) {
                value = *reinterpret_cast<const float4*>(harmonics.coefficients + i);
            } else {
                const auto coefficient = [&](int j) {
                    return harmonics.coefficients[i + j + (j >= boundary ? owners[1] : owners[0])];
                };
                value = make_float4(coefficient(0), coefficient(1), coefficient(2), coefficient(3));
            }
            const auto step = [&](int j, float of_gradient, float& of_value, float& mean, float& square) {
                adam(optimizer, of_gradient, j >= boundary ? corrections[1] : corrections[0], of_value, mean, square);
            };
            float4 &mean = means[q], &square = squares[q];
            step(0, gradient.x, value.x, mean.x, square.x);
            step(1, gradient.y, value.y, mean.y, square.y);
            step(2, gradient.z, value.z, mean.z, square.z);
            step(3, gradient.w, value.w, mean.w, square.w);
            if (block.updated[owners[0]] && block.updated[owners[1]]) {
                *reinterpret_cast<float4*>(optimizer.exp_avg_shN + base + i) = mean;
                *reinterpret_cast<float4*>(optimizer.exp_avg_sq_shN + base + i) = square;
                *reinterpret_cast<float4*>(params.shN + base + i) = value;
            } else {
                const auto write = [&](int j, float of_value, float of_mean, float of_square) {
                    if (!block.updated[j >= boundary ? owners[1] : owners[0]]) return;
                    optimizer.exp_avg_shN[base + i + j] = of_mean;
                    optimizer.exp_avg_sq_shN[base + i + j] = of_square;
                    params.shN[base + i + j] = of_value;
                };
                write(0, value.x, mean.x, square.x);
                write(1, value.y, mean.y, square.y);
                write(2, value.z, mean.z, square.z);
                write(3, value.w, mean.w, square.w);
            }
        }
    }
    // What is left of the last block's last quad.
    for (int i = (count & ~3) + threadIdx.x; i < count; i += kBackwardThreads) {
        const int owner = harmonics.owner(i);
        if (!block.updated[owner]) continue;
        float value = harmonics.coefficients[i + owner * (harmonics.stride - harmonics.row)];
        adam(optimizer, block.work[i], block.corrections[owner], value, optimizer.exp_avg_shN[base + i],
             optimizer.exp_avg_sq_shN[base + i]);
        params.shN[base + i] = value;
    }
}

template <Rows kRows>
__global__ void __launch_bounds__(kBackwardThreads, kStepBlocks) fused_step_kernel(
    const __grid_constant__ ScreenBackwardParams params, const __grid_constant__ OptimizerParams optimizer) {
    extern __shared__ float4 shared[];
    const StepShared block(reinterpret_cast<float*>(shared), params);
    const SharedHarmonics& harmonics = block.harmonics;
    const int gaussian = blockIdx.x * kBackwardThreads + threadIdx.x;

    const int32_t overflow = params.overflow != nullptr ? *params.overflow : 0;
    load_cameras(params, block.cameras);
    const Sight sight = gaussian < params.num_gaussians ? sight_of(params, gaussian) : Sight{};
    if (overflow != 0) return;  // here, so that no load waits for another
    const bool seen = sight.count > 0;
    block.updated[threadIdx.x] = seen;
    __syncthreads();
    harmonics.start(params);
    const StoredGaussian stored = seen ? load_gaussian(params, gaussian) : StoredGaussian{};
    const int steps = seen ? optimizer.steps[gaussian] + 1 : 1;
    wait_for_copies();
    __syncthreads();

    float gradients[3 * kMaxBands] = {};
    bool updated = false;
    if (seen) {
        RowCollector rows;
        rows.slots = block.work + threadIdx.x * block.work_stride;
        rows.records = params.records + static_cast<size_t>(gaussian) * kRecordQuads;
        rows.step = static_cast<size_t>(params.num_gaussians) * kRecordQuads;
        rows.num_slots = StepShared::slots(params);
        const auto views_of = [&](int first) {
            return first == 0 ? sight.views : views_on_screen(params, gaussian, first);
        };
        backward_views<true>(params, block.cameras, harmonics.coefficients + threadIdx.x * harmonics.stride, gaussian,
                             stored, views_of, rows);
        add_sight(params, gaussian, sight);
        updated = rows.count > 0 && rows.all_finite(stored.mean, block.cameras, params.sh_degree);
        if (updated) {
            const float2 corrections = make_float2(1.0f / bias_correction(optimizer.log_beta1, steps),
                                                   1.0f / bias_correction(optimizer.log_beta2, steps));
            optimizer.steps[gaussian] = steps;
            block.corrections[threadIdx.x] = corrections;
            update_row<kRows>(params, optimizer, gaussian, rows, load_gaussian(params, gaussian), corrections);
            if (params.sh_degree > 0) rows.harmonics(stored.mean, block.cameras, params.sh_degree, gradients);
        } else if (rows.count > 0) {
            atomicAdd(optimizer.skipped, 1ull);
        }
    }
    __syncthreads();  // all rows are done with
    block.updated[threadIdx.x] = updated;
#pragma unroll
    for (int i = 0; i < 3 * kMaxBands; ++i) {
        if (i < harmonics.row) block.work[threadIdx.x * harmonics.row + i] = gradients[i];
    }
    __syncthreads();
    update_harmonics(params, optimizer, block);
}

template <Rows kRows>
cudaError_t launch(const ScreenBackwardParams& params, const OptimizerParams& optimizer, cudaStream_t stream) {
    const size_t bytes = StepShared::bytes(params);
    auto kernel = fused_step_kernel<kRows>;
    const cudaError_t status =
        cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, static_cast<int>(bytes));
    if (status != cudaSuccess) return status;
    const int blocks = blocks_for(params.num_gaussians, kBackwardThreads);
    kernel<<<blocks, kBackwardThreads, bytes, stream>>>(params, optimizer);
    return cudaGetLastError();
}

}  // namespace

cudaError_t launch_fused_step(const ScreenBackwardParams& params, const OptimizerParams& optimizer,
                              cudaStream_t stream) {
    if (params.num_gaussians == 0) return cudaSuccess;
    if (optimizer.kind == UpdateKind::kAdam) return launch<Rows::kNone>(params, optimizer, stream);
    return optimizer.rows_per_view ? launch<Rows::kPerView>(params, optimizer, stream)
                                   : launch<Rows::kSummed>(params, optimizer, stream);
}

}  // namespace turbogs
