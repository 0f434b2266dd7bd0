// Projection backward and the optimizer's step in one kernel: gradients never reach memory.
//
// A thread per Gaussian, in two passes over its touched views. The first takes each view's record to a row of 14
// gradients, keeps the row and sums the rows; the sum advances the moments, which give the damping. The second pass scales
// each row by the damping, so that the systems are the identity plus something positive semi-definite, and solves the 10-
// and the 4-block by Cholesky in registers. Afterwards the block updates its touched Gaussians' harmonics together, in
// 16-byte quads.
//
// There are few warps, so what is read is read early and in batches, and sums are added without waiting for them.
#include <cfloat>

#include "projection_backward.cuh"

namespace turbogs {
namespace {

constexpr float kGradientLimit = 1e18f;         // gradients are cut here, so that their squares stay finite
constexpr float kRowLimit = 100.0f;             // longest scaled row
constexpr float kLargeGradient = 1e30f;
constexpr float kTiny = FLT_MIN;

// Up to 168 registers, so that nothing spills. More blocks (8, at 128 registers) were slower: what limits the kernel is
// the latency of memory, and spilling adds to it.
constexpr int kStepBlocks = 6;

constexpr int kQuadBatch = 4;  // quads of harmonics that a thread has under way
constexpr int kFewViews = 4;

// What the step keeps of the views' rows: nothing but the sum; each of up to kFewViews in the thread's local memory; or
// each in the place of its record.
enum class Rows { kNone, kSummed, kFew, kMany };

__host__ __device__ constexpr bool per_view(Rows rows) { return rows == Rows::kFew || rows == Rows::kMany; }

__device__ __forceinline__ float clip_gradient(float value) {
    return fminf(fmaxf(value, -kGradientLimit), kGradientLimit);
}

__device__ __forceinline__ bool is_finite(float value) { return fabsf(value) <= FLT_MAX; }

__device__ __forceinline__ void unpack(const RowGradient& row, float values[kRowSize]) {
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        values[i] = row.mean[i];
        values[3 + i] = row.scale[i];
        values[10 + i] = row.sh0[i];
    }
#pragma unroll
    for (int i = 0; i < 4; ++i) values[6 + i] = row.quat[i];
    values[13] = row.opacity;
}

// Sums the rows, and keeps them where the step wants one per view.
template <Rows kRows>
struct RowCollector {
    float4* records;  // of this Gaussian in view 0
    size_t step;      // from view to view
    float few[kRows == Rows::kFew ? kFewViews : 1][kRowSize + 1];
    float sum[kRowSize] = {};
    float loss = 0.0f;
    bool finite = true;
    bool large = false;  // colour gradients that might overflow in the harmonics' sums

    __device__ __forceinline__ void add(int view, const RowGradient& row, float view_loss) {
        float values[kRowSize];
        unpack(row, values);
#pragma unroll
        for (int i = 0; i < kRowSize; ++i) {
            finite = finite && is_finite(values[i]);
            if (i >= 10 && i < 13) large = large || !(fabsf(values[i]) < kLargeGradient);
            values[i] = clip_gradient(values[i]);
            sum[i] += values[i];
        }
        if (kRows == Rows::kFew) {
#pragma unroll
            for (int i = 0; i < kRowSize; ++i) few[view][i] = values[i];
            few[view][kRowSize] = view_loss;
        } else if (kRows == Rows::kMany) {
            float4* out = records + view * step;
            out[0] = make_float4(values[0], values[1], values[2], values[3]);
            out[1] = make_float4(values[4], values[5], values[6], values[7]);
            out[2] = make_float4(values[8], values[9], values[10], values[11]);
            out[3] = make_float4(values[12], values[13], view_loss, 0.0f);
        }
        loss += view_loss;
    }

    // Row of a view, and behind it the loss.
    __device__ __forceinline__ void get(int view, float values[kRowSize + 1]) const {
        if (kRows == Rows::kFew) {
#pragma unroll
            for (int i = 0; i <= kRowSize; ++i) values[i] = few[view][i];
        } else {
            const float4* record = records + view * step;
            const float4 r0 = record[0], r1 = record[1], r2 = record[2], r3 = record[3];
            const float loaded[kRowSize + 1] = {r0.x, r0.y, r0.z, r0.w, r1.x, r1.y, r1.z, r1.w,
                                                r2.x, r2.y, r2.z, r2.w, r3.x, r3.y, r3.z};
#pragma unroll
            for (int i = 0; i <= kRowSize; ++i) values[i] = loaded[i];
        }
    }
};

// Adam's part is rounded as written, so that all forms of the kernel give the same bits.

// beta * old + (1 - beta) * gradient, from the nearer of the two.
__device__ __forceinline__ float decay(float gradient, float old, float beta, float one_minus_beta) {
    return beta < 0.5f ? __fmaf_rn(beta, __fsub_rn(old, gradient), gradient)
                       : __fmaf_rn(one_minus_beta, __fsub_rn(gradient, old), old);
}

// sqrt(v) + eps of the bias-corrected v.
__device__ __forceinline__ float denominator_of(float square, float inverse_correction2, float eps) {
    return __fadd_rn(approximate_sqrt(__fmul_rn(square, inverse_correction2)), eps);
}

// Adam's step over the rate, from the bias-corrected m.
__device__ __forceinline__ float adam_direction(float corrected, float denominator) {
    return __fmul_rn(corrected, approximate_reciprocal(fmaxf(denominator, FLT_MIN)));
}

__device__ __forceinline__ float bias_correction(float log_beta, int steps) {
    return -expm1f(static_cast<float>(steps) * log_beta);  // log_beta = -infinity gives 1
}

// (I + sum of scaled rows' outer products) x = rhs, for one block of the row.
template <int kSize>
struct DampedSystem {
    float lower[kSize * (kSize + 1) / 2] = {};
    bool has_rows = false;

    static __device__ __forceinline__ constexpr int at(int i, int j) { return i * (i + 1) / 2 + j; }

    // Adds weight * row row^T, scaled, with the row cut to `kRowLimit`.
    __device__ __forceinline__ void add(const float row[kSize], const float scale[kSize], float weight) {
        float unit[kSize], largest = 0.0f, norm2 = 0.0f;
        bool nonzero = false;
#pragma unroll
        for (int i = 0; i < kSize; ++i) {
            nonzero = nonzero || row[i] != 0.0f;
            unit[i] = row[i] * scale[i];
            largest = fmaxf(largest, fabsf(unit[i]));
        }
        has_rows = has_rows || (nonzero && weight > 0.0f);
        const float inverse = approximate_reciprocal(fmaxf(largest, kTiny));
#pragma unroll
        for (int i = 0; i < kSize; ++i) {
            unit[i] *= inverse;
            norm2 += unit[i] * unit[i];
        }
        const float norm = fmaxf(approximate_sqrt(norm2), kTiny);
        const float factor = fminf(largest * norm * approximate_sqrt(weight), kRowLimit) * approximate_reciprocal(norm);
#pragma unroll
        for (int i = 0; i < kSize; ++i) {
            unit[i] *= factor;
#pragma unroll
            for (int j = 0; j <= i; ++j) lower[at(i, j)] += unit[i] * unit[j];
        }
    }

    // Cholesky in place. Exact pivots are 1 or more, so computed ones are held there. `x` is the right side first.
    __device__ __forceinline__ void solve(float x[kSize]) {
        float inverse_diagonal[kSize];
#pragma unroll
        for (int i = 0; i < kSize; ++i) {
#pragma unroll
            for (int j = 0; j < i; ++j) {
                float value = lower[at(i, j)];
#pragma unroll
                for (int k = 0; k < j; ++k) value -= lower[at(i, k)] * lower[at(j, k)];
                lower[at(i, j)] = value * inverse_diagonal[j];
            }
            float pivot = lower[at(i, i)] + 1.0f;
#pragma unroll
            for (int k = 0; k < i; ++k) {
                pivot -= lower[at(i, k)] * lower[at(i, k)];
                x[i] -= lower[at(i, k)] * x[k];
            }
            inverse_diagonal[i] = approximate_rsqrt(fmaxf(pivot, 1.0f));
            x[i] *= inverse_diagonal[i];
        }
#pragma unroll
        for (int i = kSize - 1; i >= 0; --i) {
#pragma unroll
            for (int k = i + 1; k < kSize; ++k) x[i] -= lower[at(k, i)] * x[k];
            x[i] *= inverse_diagonal[i];
        }
    }
};

// What the moments say of one Gaussian's 14 parameters after this step's gradient.
struct Terms {
    float mean[kRowSize];   // right side: m, bias-corrected unless the step is the paper's
    float scale[kRowSize];  // damping^(-1/2)
    float adam[kRowSize];   // Adam's change
};

// Solves one block and turns `terms.adam` into the change to make.
template <int kFirst, int kSize, Rows kRows>
__device__ __forceinline__ void solve_block(const OptimizerParams& optimizer, uint32_t mask,
                                            const RowCollector<kRows>& collected, Terms& terms) {
    DampedSystem<kSize> system;
    const bool balanced = optimizer.kind == StepKind::kBalancedLm;
    const auto weight_of = [&](float loss) {
        if (!balanced) return 1.0f;
        return loss > 0.0f && is_finite(loss) ? fminf(optimizer.curvature / loss, FLT_MAX) : 0.0f;
    };
    if (per_view(kRows)) {
        for (uint32_t left = mask; left != 0u; left &= left - 1u) {
            float values[kRowSize + 1];
            collected.get(__ffs(static_cast<int>(left)) - 1, values);
            system.add(values + kFirst, terms.scale + kFirst, weight_of(values[kRowSize]));
        }
    } else {
        system.add(collected.sum + kFirst, terms.scale + kFirst, weight_of(collected.loss));
    }
    float x[kSize];
#pragma unroll
    for (int i = 0; i < kSize; ++i) x[i] = terms.mean[kFirst + i] * terms.scale[kFirst + i];
    system.solve(x);
#pragma unroll
    for (int i = 0; i < kSize; ++i) {
        const int c = kFirst + i;
        float delta = -terms.scale[c] * x[i];
        if (balanced) {
            if (optimizer.max_step > 0.0f) {
                const float bound = fmaxf(optimizer.max_step * optimizer.rates[c], fabsf(terms.adam[c]));
                delta = fmaxf(fminf(delta, bound), -bound);
            }
            // Without rows the solution is Adam's step: that one is taken as it is.
            if (!system.has_rows || !(optimizer.rates[c] > 0.0f)) delta = terms.adam[c];
        }
        terms.adam[c] = delta;
    }
}

// Moments, solution and new values of one Gaussian's 14 parameters.
template <Rows kRows>
__device__ __forceinline__ void update_row(const ScreenBackwardParams& params, const OptimizerParams& optimizer,
                                           int gaussian, uint32_t mask,
                                           const RowCollector<kRows>& collected, float inverse_correction1,
                                           float inverse_correction2) {
    float2* first = reinterpret_cast<float2*>(optimizer.exp_avg + static_cast<size_t>(gaussian) * kRowSize);
    float2* second = reinterpret_cast<float2*>(optimizer.exp_avg_sq + static_cast<size_t>(gaussian) * kRowSize);
    const bool paper = optimizer.kind == StepKind::kPaperLm;
    // All of it is read before anything is written: the compiler must take the arrays for one.
    float2 old_means[kRowSize / 2], old_squares[kRowSize / 2];
#pragma unroll
    for (int pair = 0; pair < kRowSize / 2; ++pair) {
        old_means[pair] = first[pair];
        old_squares[pair] = second[pair];
    }
    Terms terms;
#pragma unroll
    for (int pair = 0; pair < kRowSize / 2; ++pair) {
        const float2 old_mean = old_means[pair], old_square = old_squares[pair];
        float mean[2] = {old_mean.x, old_mean.y}, square[2] = {old_square.x, old_square.y};
#pragma unroll
        for (int i = 0; i < 2; ++i) {
            const int c = 2 * pair + i;
            const float gradient = collected.sum[c];
            mean[i] = decay(gradient, mean[i], optimizer.beta1, optimizer.one_minus_beta1);
            square[i] = decay(__fmul_rn(gradient, gradient), square[i], optimizer.beta2, optimizer.one_minus_beta2);
            const float corrected = __fmul_rn(mean[i], inverse_correction1);
            const float denominator = denominator_of(square[i], inverse_correction2, optimizer.eps);
            terms.adam[c] = -__fmul_rn(optimizer.rates[c], adam_direction(corrected, denominator));
            const float damping =
                paper ? approximate_sqrt(square[i]) + optimizer.eps : denominator * optimizer.inverse_rates[c];
            terms.mean[c] = paper ? mean[i] : corrected;
            terms.scale[c] = approximate_rsqrt(damping);
        }
        first[pair] = make_float2(mean[0], mean[1]);
        second[pair] = make_float2(square[0], square[1]);
    }
    if (kRows != Rows::kNone) {
        solve_block<0, 10, kRows>(optimizer, mask, collected, terms);
        solve_block<10, 4, kRows>(optimizer, mask, collected, terms);
    }
    const StoredGaussian old = load_gaussian(params, gaussian);
    const size_t triple = 3 * static_cast<size_t>(gaussian);
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        optimizer.means[triple + i] = __fadd_rn(old.mean[i], terms.adam[i]);
        optimizer.scales[triple + i] = __fadd_rn(old.log_scale[i], terms.adam[3 + i]);
        optimizer.sh0[triple + i] = __fadd_rn(old.sh0[i], terms.adam[10 + i]);
    }
    reinterpret_cast<float4*>(optimizer.quats)[gaussian] =
        make_float4(__fadd_rn(old.quat[0], terms.adam[6]), __fadd_rn(old.quat[1], terms.adam[7]),
                    __fadd_rn(old.quat[2], terms.adam[8]), __fadd_rn(old.quat[3], terms.adam[9]));
    optimizer.opacities[gaussian] = __fadd_rn(old.logit, terms.adam[13]);
}

__device__ __forceinline__ void adam(const OptimizerParams& optimizer, float gradient, float inverse_correction1,
                                     float inverse_correction2, float& value, float& mean, float& square) {
    gradient = clip_gradient(gradient);
    mean = decay(gradient, mean, optimizer.beta1, optimizer.one_minus_beta1);
    square = decay(__fmul_rn(gradient, gradient), square, optimizer.beta2, optimizer.one_minus_beta2);
    const float direction = adam_direction(__fmul_rn(mean, inverse_correction1),
                                           denominator_of(square, inverse_correction2, optimizer.eps));
    value = __fmaf_rn(-optimizer.rate_shN, direction, value);
}

// Adam on the harmonics of the block's updated Gaussians. Values come from shared memory; a quad that two Gaussians
// share is written back whole, with what belongs to the one that is not updated left as it was.
__device__ __forceinline__ void update_harmonics(const ScreenBackwardParams& params, const OptimizerParams& optimizer,
                                                 const BackwardShared& block) {
    const int first = static_cast<int>(blockIdx.x) * kBackwardThreads;
    const int count = min(kBackwardThreads, params.num_gaussians - first) * block.row;
    const size_t base = static_cast<size_t>(first) * block.row;
    for (int start = 4 * threadIdx.x; start < count; start += kQuadBatch * 4 * kBackwardThreads) {
        float means[kQuadBatch][4] = {}, squares[kQuadBatch][4] = {};
        bool wanted[kQuadBatch];
#pragma unroll
        for (int q = 0; q < kQuadBatch; ++q) {
            const int i = start + q * 4 * kBackwardThreads, last = min(i + 3, count - 1);
            wanted[q] = i < count && (block.touched[block.owner(i)] | block.touched[block.owner(last)]);
            if (wanted[q] && last == i + 3) {
                const float4 m = *reinterpret_cast<const float4*>(optimizer.exp_avg_shN + base + i);
                const float4 v = *reinterpret_cast<const float4*>(optimizer.exp_avg_sq_shN + base + i);
                means[q][0] = m.x, means[q][1] = m.y, means[q][2] = m.z, means[q][3] = m.w;
                squares[q][0] = v.x, squares[q][1] = v.y, squares[q][2] = v.z, squares[q][3] = v.w;
            } else if (wanted[q]) {
#pragma unroll
                for (int j = 0; j < 4; ++j) {
                    if (i + j > last) break;
                    means[q][j] = optimizer.exp_avg_shN[base + i + j];
                    squares[q][j] = optimizer.exp_avg_sq_shN[base + i + j];
                }
            }
        }
#pragma unroll
        for (int q = 0; q < kQuadBatch; ++q) {
            if (!wanted[q]) continue;
            const int i = start + q * 4 * kBackwardThreads, size = min(4, count - i);
            float(&mean)[4] = means[q], (&square)[4] = squares[q], value[4] = {};
#pragma unroll
            for (int j = 0; j < 4; ++j) {
                if (j >= size) break;
                const int owner = block.owner(i + j);
                const int place = i + j + owner * (block.stride - block.row);
                value[j] = block.coefficients[place];
                if (block.touched[owner]) {
                    adam(optimizer, block.gradients[place], block.corrections[owner],
                         block.corrections[kBackwardThreads + owner], value[j], mean[j], square[j]);
                }
            }
            if (size == 4) {
                *reinterpret_cast<float4*>(optimizer.exp_avg_shN + base + i) = make_float4(mean[0], mean[1], mean[2], mean[3]);
                *reinterpret_cast<float4*>(optimizer.exp_avg_sq_shN + base + i) =
                    make_float4(square[0], square[1], square[2], square[3]);
                *reinterpret_cast<float4*>(optimizer.shN + base + i) = make_float4(value[0], value[1], value[2], value[3]);
            } else {
#pragma unroll
                for (int j = 0; j < 4; ++j) {
                    if (j >= size) break;
                    optimizer.exp_avg_shN[base + i + j] = mean[j];
                    optimizer.exp_avg_sq_shN[base + i + j] = square[j];
                    optimizer.shN[base + i + j] = value[j];
                }
            }
        }
    }
}

template <Rows kRows>
__global__ void __launch_bounds__(kBackwardThreads, kStepBlocks) fused_step_kernel(
    const __grid_constant__ ScreenBackwardParams params, const __grid_constant__ OptimizerParams optimizer) {
    extern __shared__ float shared[];
    const BackwardShared block(shared, params);
    const int gaussian = blockIdx.x * kBackwardThreads + threadIdx.x;
    const bool inside = gaussian < params.num_gaussians;

    const int32_t overflow = params.overflow != nullptr ? *params.overflow : 0;
    load_cameras(params, block);
    const Sight sight = inside ? sight_of(params, gaussian) : Sight{};
    const uint32_t mask = sight.touched;
    if (overflow != 0) return;  // here, so that no load waits for another
    start_harmonics(params, block, mask != 0u);
    const StoredGaussian stored = mask != 0u ? load_gaussian(params, gaussian) : StoredGaussian{};
    wait_for_copies();
    __syncthreads();

    if (inside) {
        RowCollector<kRows> collected;
        collected.records = params.records + static_cast<size_t>(gaussian) * kRecordQuads;
        collected.step = static_cast<size_t>(params.num_gaussians) * kRecordQuads;
        backward_views(params, block, gaussian, mask, sight, stored, collected);
        if (mask != 0u) {
            const float* gradients = block.gradients + threadIdx.x * block.stride;
            for (int i = 0; collected.large && i < block.row; ++i) {
                collected.finite = collected.finite && is_finite(gradients[i]);
            }
            if (collected.finite) {
                const int steps = optimizer.steps[gaussian] + 1;
                optimizer.steps[gaussian] = steps;
                const float inverse_correction1 = 1.0f / bias_correction(optimizer.log_beta1, steps);
                const float inverse_correction2 = 1.0f / bias_correction(optimizer.log_beta2, steps);
                block.corrections[threadIdx.x] = inverse_correction1;
                block.corrections[kBackwardThreads + threadIdx.x] = inverse_correction2;
                update_row(params, optimizer, gaussian, mask, collected, inverse_correction1, inverse_correction2);
            } else {
                block.touched[threadIdx.x] = 0;
                atomicAdd(optimizer.skipped, 1ull);
            }
        }
    }
    __syncthreads();
    update_harmonics(params, optimizer, block);
}

template <Rows kRows>
cudaError_t launch(const ScreenBackwardParams& params, const OptimizerParams& optimizer, cudaStream_t stream) {
    const size_t bytes = BackwardShared::bytes(params);
    auto kernel = fused_step_kernel<kRows>;
    const cudaError_t status =
        cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, static_cast<int>(bytes));
    if (status != cudaSuccess) return status;
    const int blocks = (params.num_gaussians + kBackwardThreads - 1) / kBackwardThreads;
    kernel<<<blocks, kBackwardThreads, bytes, stream>>>(params, optimizer);
    return cudaGetLastError();
}

}  // namespace

cudaError_t launch_fused_step(const ScreenBackwardParams& params, const OptimizerParams& optimizer,
                              cudaStream_t stream) {
    if (params.num_gaussians == 0) return cudaSuccess;
    if (optimizer.kind == StepKind::kAdam) return launch<Rows::kNone>(params, optimizer, stream);
    if (!optimizer.rows_per_view) return launch<Rows::kSummed>(params, optimizer, stream);
    return params.num_views <= kFewViews ? launch<Rows::kFew>(params, optimizer, stream)
                                         : launch<Rows::kMany>(params, optimizer, stream);
}

}  // namespace turbogs
