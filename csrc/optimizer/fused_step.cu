// Projection backward and the optimizer's step in one kernel: gradients never reach memory. Defined by
// turbogs_plugin/engine/reference/projection.py (its gradients) and turbogs_plugin/engine/reference/update.py.
//
// A thread takes one Gaussian and goes through the views that have it on screen. It turns each record that a sample
// contributed to into a row of 14 gradients, keeps the row, and sums the rows. The sum advances the moments, which give
// the damping. A second pass over the rows scales them by the damping, and solves the two blocks (moment_lm.cuh) by
// Cholesky in registers. A third pass adds up the gradients of the harmonics, also in registers. At the end the block
// updates the harmonics of all its Gaussians together, in 16-byte quads. The first few rows lie in shared memory, the
// others overwrite records that have been read. There are few warps, so memory is read early and in batches, and sums
// are added without waiting for them.
#include "optimizer/backward_block.cuh"
#include "optimizer/moment_lm.cuh"

namespace turbogs {
namespace {

constexpr float kLargeGradient = 1e30f;  // of a colour: beyond, the sums of the harmonics may overflow
constexpr int kStepBlocks = 3;           // of an SM: up to 168 registers, so that nothing spills
constexpr int kQuadBatch = 4;            // quads of harmonics that a thread has under way; measured with the rest
constexpr int kSharedSlots = 4;          // rows of a Gaussian in shared memory; five were slower, 526 us for 485

// A slot: a row, its view (bits), a spare float. A row that is kept takes the place of a record.
constexpr int kViewPlace = ParameterRow::kSize, kSlotFloats = ScreenRecord::kSize;
static_assert(kViewPlace < kSlotFloats);

// Rows of a Gaussian that shared memory holds.
__host__ __device__ int shared_slots(const ScreenBackwardParams& params) {
    return params.num_views < kSharedSlots ? params.num_views : kSharedSlots;
}

// Floats of a thread's slots, which later hold the gradients of its Gaussian's harmonics; odd.
__host__ __device__ int slot_floats(const ScreenBackwardParams& params) {
    const int rows = kSlotFloats * shared_slots(params), gradients = 3 * params.bands;
    return (rows > gradients ? rows : gradients) | 1;
}

// Behind the slots lie the inverses of the two bias corrections.
__host__ __device__ int step_floats(const ScreenBackwardParams& params) { return slot_floats(params) + 2; }

// Sums the rows of one Gaussian, and keeps them. Row s lies in slot s of shared memory, or where the record of view s
// was.
struct RowCollector {
    float* slots;
    float4* records;  // of this Gaussian in view 0
    size_t step;      // from view to view
    int num_slots;
    int count = 0;    // rows
    float sum[ParameterRow::kSize] = {};
    bool finite = true;
    bool large = false;

    __device__ __forceinline__ void add(int view, const ViewCamera&, const float row[ParameterRow::kSize],
                                        const float*) {
        float values[kSlotFloats] = {};
        values[kViewPlace] = __int_as_float(view);
#pragma unroll
        for (int i = 0; i < ParameterRow::kSize; ++i) {
            values[i] = row[i];
            finite = finite && is_finite(values[i]);
            const bool of_color = i >= ParameterRow::kSh0 && i < ParameterRow::kSh0 + 3;
            large = large || (of_color && !(fabsf(values[i]) < kLargeGradient));
            sum[i] += clip_gradient(values[i]);
        }
        if (count < num_slots) {
            float* slot = slots + kSlotFloats * count;
#pragma unroll
            for (int i = 0; i < kSlotFloats; ++i) slot[i] = values[i];
        } else {
            float4* record = records + count * step;  // no later than `view`'s record, which is read already
#pragma unroll
            for (int i = 0; i < kSlotFloats / 4; ++i) {
                record[i] = make_float4(values[4 * i], values[4 * i + 1], values[4 * i + 2], values[4 * i + 3]);
            }
        }
        ++count;
    }

    // kSize numbers of row `s` from kFirst on, and behind them its view.
    template <int kFirst, int kSize>
    __device__ __forceinline__ void get(int s, float (&values)[kSize + 1]) const {
        const auto read = [&](const float* slot) {
#pragma unroll
            for (int i = 0; i < kSize; ++i) values[i] = slot[kFirst + i];
            values[kSize] = slot[kViewPlace];
        };
        if (s < num_slots) read(slots + kSlotFloats * s);
        else read(reinterpret_cast<const float*>(records + s * step));
    }

    // Adds to the system of a block of the parameters what the rows say of it.
    template <int kFirst, int kSize>
    __device__ __forceinline__ void add_to(DampedSystem<kSize>& system, const float* scale) const {
        for (int s = 0; s < count; ++s) {
            float row[kSize + 1];
            get<kFirst, kSize>(s, row);
#pragma unroll
            for (int i = 0; i < kSize; ++i) row[i] = clip_gradient(row[i]);
            system.add(row, scale + kFirst);
        }
    }

    // Gradients of the harmonics above band 0.
    __device__ __forceinline__ void harmonics(const float mean[3], const ViewCamera* cameras, int degree,
                                              float (&gradients)[3 * kMaxBands]) const {
        for (int s = 0; s < count; ++s) {
            float row[3 + 1];
            get<ParameterRow::kSh0, 3>(s, row);
            float grad_color[3];
#pragma unroll
            for (int c = 0; c < 3; ++c) grad_color[c] = row[c] * (1.0f / kShBand0);
            add_harmonics_gradient(mean, cameras[__float_as_int(row[3])], degree, grad_color, gradients);
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

// Writes a parameter, and with kCopied its copies: a loop that might be empty takes a tenth of the kernel's time.
template <bool kCopied, class T>
__device__ __forceinline__ void put(const OptimizerParams& optimizer, T* place, const T& value) {
    *place = value;
    if constexpr (kCopied) {
        for (int i = 0; i < optimizer.num_copies; ++i) {
            *reinterpret_cast<T*>(reinterpret_cast<char*>(place) + optimizer.copies[i]) = value;
        }
    }
}

// Moments, solution and new values of one Gaussian's 14 parameters.
template <bool kSolve, bool kCopied>
__device__ __forceinline__ void update_row(const ScreenBackwardParams& params, const OptimizerParams& optimizer,
                                           int gaussian, const RowCollector& rows, const StoredGaussian& old,
                                           float2 corrections) {
    const size_t first_pair = static_cast<size_t>(gaussian) * (ParameterRow::kSize / 2);
    Terms terms = advance(optimizer, rows.sum, corrections, optimizer.exp_avg + first_pair,
                          optimizer.exp_avg_sq + first_pair);
    if (kSolve) {
        const auto geometry = [&](auto& system) { rows.add_to<kGeometryFirst>(system, terms.scale); };
        const auto appearance = [&](auto& system) { rows.add_to<kAppearanceFirst>(system, terms.scale); };
        solve_block<kGeometryFirst, kGeometrySize>(optimizer, geometry, terms);
        solve_block<kAppearanceFirst, kAppearanceSize>(optimizer, appearance, terms);
    }
    const size_t triple = 3 * static_cast<size_t>(gaussian);
    using Place = ParameterRow;
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        put<kCopied>(optimizer, params.means + triple + i, __fadd_rn(old.mean[i], terms.change[Place::kMeans + i]));
        put<kCopied>(optimizer, params.scales + triple + i,
                     __fadd_rn(old.log_scale[i], terms.change[Place::kScales + i]));
        put<kCopied>(optimizer, params.sh0 + triple + i, __fadd_rn(old.sh0[i], terms.change[Place::kSh0 + i]));
    }
    const float* turn = terms.change + Place::kQuats;
    put<kCopied>(optimizer, params.quats + gaussian,
        make_float4(__fadd_rn(old.quat[0], turn[0]), __fadd_rn(old.quat[1], turn[1]), __fadd_rn(old.quat[2], turn[2]),
                    __fadd_rn(old.quat[3], turn[3])));
    put<kCopied>(optimizer, params.opacities + gaussian, __fadd_rn(old.logit, terms.change[Place::kOpacities]));
}

// Adam on the harmonics of the block's updated Gaussians. Values and gradients come from shared memory.
template <bool kCopied>
__device__ __forceinline__ void update_harmonics(const ScreenBackwardParams& params, const OptimizerParams& optimizer,
                                                 const BlockShared& block, const float2* block_corrections) {
    const int first = static_cast<int>(blockIdx.x) * kBackwardThreads;
    const int count = min(kBackwardThreads, params.num_gaussians - first) * block.row;
    const size_t base = static_cast<size_t>(first) * block.row;
    for (int start = 4 * threadIdx.x; start < count; start += kQuadBatch * 4 * kBackwardThreads) {
        float4 means[kQuadBatch], squares[kQuadBatch];
        bool wanted[kQuadBatch];
#pragma unroll
        for (int q = 0; q < kQuadBatch; ++q) {
            const int i = start + q * 4 * kBackwardThreads;
            wanted[q] = i + 3 < count && (block.wanted[block.owner(i)] | block.wanted[block.owner(i + 3)]);
            if (!wanted[q]) continue;
            means[q] = *reinterpret_cast<const float4*>(optimizer.exp_avg_shN + base + i);
            squares[q] = *reinterpret_cast<const float4*>(optimizer.exp_avg_sq_shN + base + i);
        }
#pragma unroll
        for (int q = 0; q < kQuadBatch; ++q) {
            if (!wanted[q]) continue;
            const int i = start + q * 4 * kBackwardThreads;
            const int owners[2] = {block.owner(i), block.owner(i + 3)};
            const int boundary = owners[1] * block.row - i;  // elements from here on are the second owner's
            const float2 corrections[2] = {block_corrections[owners[0]], block_corrections[owners[1]]};
            const float4 gradient = *reinterpret_cast<const float4*>(block.work + i);
            float4 &mean = means[q], &square = squares[q], value;
            if (block.stride == block.row) {
                value = *reinterpret_cast<const float4*>(block.coefficients + i);
            } else {
#pragma unroll
                for (int j = 0; j < 4; ++j) {
                    (&value.x)[j] = block.coefficients[i + j + (j >= boundary ? owners[1] : owners[0])];
                }
            }
#pragma unroll
            for (int j = 0; j < 4; ++j) {
                adam(optimizer, (&gradient.x)[j], j >= boundary ? corrections[1] : corrections[0], (&value.x)[j],
                     (&mean.x)[j], (&square.x)[j]);
            }
            if (block.wanted[owners[0]] && block.wanted[owners[1]]) {
                *reinterpret_cast<float4*>(optimizer.exp_avg_shN + base + i) = mean;
                *reinterpret_cast<float4*>(optimizer.exp_avg_sq_shN + base + i) = square;
                put<kCopied>(optimizer, reinterpret_cast<float4*>(params.shN + base + i), value);
            } else {
#pragma unroll
                for (int j = 0; j < 4; ++j) {
                    if (!block.wanted[j >= boundary ? owners[1] : owners[0]]) continue;
                    optimizer.exp_avg_shN[base + i + j] = (&mean.x)[j];
                    optimizer.exp_avg_sq_shN[base + i + j] = (&square.x)[j];
                    put<kCopied>(optimizer, params.shN + base + i + j, (&value.x)[j]);
                }
            }
        }
    }
    // What is left of the last block's last quad.
    for (int i = (count & ~3) + threadIdx.x; i < count; i += kBackwardThreads) {
        const int owner = block.owner(i);
        if (!block.wanted[owner]) continue;
        float value = block.coefficients[i + owner * (block.stride - block.row)];
        adam(optimizer, block.work[i], block_corrections[owner], value, optimizer.exp_avg_shN[base + i],
             optimizer.exp_avg_sq_shN[base + i]);
        put<kCopied>(optimizer, params.shN + base + i, value);
    }
}

template <bool kSolve, bool kCopied>
__global__ void __launch_bounds__(kBackwardThreads, kStepBlocks) fused_step_kernel(
    const __grid_constant__ ScreenBackwardParams params, const __grid_constant__ OptimizerParams optimizer) {
    extern __shared__ float4 shared[];
    const BlockShared block(shared, params, step_floats(params));
    const int work_stride = slot_floats(params);
    float2* block_corrections = reinterpret_cast<float2*>(block.work + kBackwardThreads * work_stride);
    const int gaussian = blockIdx.x * kBackwardThreads + threadIdx.x;

    const int32_t overflow = params.overflow != nullptr ? *params.overflow : 0;
    block.load_cameras(params);
    const Sight sight = gaussian < params.num_gaussians ? sight_of(params, gaussian) : Sight{};
    if (overflow != 0) return;  // here, so that no load waits for another
    const bool seen = sight.count > 0;
    block.wanted[threadIdx.x] = seen;
    __syncthreads();
    block.start(params);
    const StoredGaussian stored = seen ? load_gaussian(params, gaussian) : StoredGaussian{};
    const int steps = seen ? optimizer.steps[gaussian] + 1 : 1;
    block.wait();
    __syncthreads();

    float gradients[3 * kMaxBands] = {};
    bool updated = false;
    if (seen) {
        RowCollector rows;
        rows.slots = block.work + threadIdx.x * work_stride;
        rows.records = params.records + static_cast<size_t>(gaussian) * kRecordQuads;
        rows.step = static_cast<size_t>(params.num_gaussians) * kRecordQuads;
        rows.num_slots = shared_slots(params);
        const auto views_of = [&](int first) {
            return first == 0 ? sight.views : views_on_screen(params, gaussian, first);
        };
        backward_views<true>(params, block.cameras, block.coefficients + threadIdx.x * block.stride, gaussian,
                             stored, views_of, rows);
        add_sight(params, gaussian, sight);
        updated = rows.count > 0 && rows.all_finite(stored.mean, block.cameras, params.sh_degree);
        if (updated) {
            const float2 corrections = make_float2(1.0f / bias_correction(optimizer.log_beta1, steps),
                                                   1.0f / bias_correction(optimizer.log_beta2, steps));
            optimizer.steps[gaussian] = steps;
            block_corrections[threadIdx.x] = corrections;
            update_row<kSolve, kCopied>(
                params, optimizer, gaussian, rows, load_gaussian(params, gaussian), corrections);
            if (params.sh_degree > 0) rows.harmonics(stored.mean, block.cameras, params.sh_degree, gradients);
        } else if (rows.count > 0) {
            atomicAdd(optimizer.skipped, 1ull);
        }
    }
    __syncthreads();  // all rows are done with
    block.wanted[threadIdx.x] = updated;
#pragma unroll
    for (int i = 0; i < 3 * kMaxBands; ++i) {
        if (i < block.row) block.work[threadIdx.x * block.row + i] = gradients[i];
    }
    __syncthreads();
    update_harmonics<kCopied>(params, optimizer, block, block_corrections);
}

template <bool kCopied>
void launch(const ScreenBackwardParams& params, const OptimizerParams& optimizer, cudaStream_t stream) {
    const bool solve = optimizer.kind != UpdateKind::kAdam;
    const auto kernel = solve ? fused_step_kernel<true, kCopied> : fused_step_kernel<false, kCopied>;
    launch_blocks(kernel, step_floats(params), params, optimizer, stream);
}

}  // namespace

void launch_fused_step(const ScreenBackwardParams& params, const OptimizerParams& optimizer, cudaStream_t stream) {
    if (params.num_gaussians == 0) return;
    if (optimizer.num_copies > 0) launch<true>(params, optimizer, stream);
    else launch<false>(params, optimizer, stream);
}

}  // namespace turbogs
