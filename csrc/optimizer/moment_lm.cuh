// The rule of a step for one Gaussian (turbogs_plugin/engine/reference/update.py and lm_solvers.py): Adam's
// terms, and the damped systems: the 10x10 block of the geometry and the 4x4 block of the appearance.
//
// With S the damping's inverse root, (J^T J + damping) x = m becomes (I + S J^T J S) y = S m with x = S y: its pivots
// are 1 or more, whatever the scales of the parameters, so Cholesky in single precision holds. Everything of a
// Gaussian stays in the registers of its thread.
#pragma once

#include "common/approximate_math.cuh"
#include "optimizer/optimizer_params.h"

namespace turbogs {

// The two blocks of a row that are solved by themselves.
constexpr int kGeometryFirst = ParameterRow::kMeans, kGeometrySize = ParameterRow::kSh0 - kGeometryFirst;
constexpr int kAppearanceFirst = ParameterRow::kSh0, kAppearanceSize = ParameterRow::kSize - kAppearanceFirst;

constexpr float kGradientLimit = 1e17f;  // gradients are cut here, so that the squares of their sums stay finite
constexpr float kRowLimit = 100.0f;      // longest scaled row: ROW_LIMIT of lm_solvers.py

__device__ __forceinline__ float clip_gradient(float value) {
    return fminf(fmaxf(value, -kGradientLimit), kGradientLimit);
}

// ---- Adam: rounded as written, so that all forms of the kernel give the same bits ----------------------------------

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

// `corrections`: inverses of the two bias corrections.
__device__ __forceinline__ void adam(const OptimizerParams& optimizer, float gradient, float2 corrections, float& value,
                                     float& mean, float& square) {
    gradient = clip_gradient(gradient);
    mean = decay(gradient, mean, optimizer.beta1, optimizer.one_minus_beta1);
    square = decay(__fmul_rn(gradient, gradient), square, optimizer.beta2, optimizer.one_minus_beta2);
    const float direction =
        adam_direction(__fmul_rn(mean, corrections.x), denominator_of(square, corrections.y, optimizer.eps));
    value = __fmaf_rn(-optimizer.rate_shN, direction, value);
}

// ---- Moment-damped LM ----------------------------------------------------------------------------------------------

// (I + sum of scaled rows' outer products) x = rhs, for one block of the row.
template <int kSize>
struct DampedSystem {
    float lower[kSize * (kSize + 1) / 2] = {};

    static __device__ __forceinline__ constexpr int at(int i, int j) { return i * (i + 1) / 2 + j; }

    // Adds row row^T, scaled, with the row cut to `kRowLimit`.
    __device__ __forceinline__ void add(const float row[kSize], const float scale[kSize]) {
        float unit[kSize], largest = 0.0f, norm2 = 0.0f;
#pragma unroll
        for (int i = 0; i < kSize; ++i) {
            unit[i] = row[i] * scale[i];
            largest = fmaxf(largest, fabsf(unit[i]));
        }
        const float inverse = approximate_reciprocal(fmaxf(largest, FLT_MIN));
#pragma unroll
        for (int i = 0; i < kSize; ++i) {
            unit[i] *= inverse;
            norm2 += unit[i] * unit[i];
        }
        const float norm = fmaxf(approximate_sqrt(norm2), FLT_MIN);
        const float factor = fminf(largest * norm, kRowLimit) * approximate_reciprocal(norm);
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
    float mean[ParameterRow::kSize];    // right side: m
    float scale[ParameterRow::kSize];   // damping^(-1/2)
    float change[ParameterRow::kSize];  // Adam's, until a block is solved
};

// Advances the moments, in place, by the gradient.
__device__ __forceinline__ Terms advance(const OptimizerParams& optimizer, const float gradient[ParameterRow::kSize],
                                         float2 corrections, float2* exp_avg, float2* exp_avg_sq) {
    constexpr int kPairs = ParameterRow::kSize / 2;
    // All of it is read before anything is written: the compiler must take the arrays for one.
    float2 means[kPairs], squares[kPairs];
#pragma unroll
    for (int pair = 0; pair < kPairs; ++pair) {
        means[pair] = exp_avg[pair];
        squares[pair] = exp_avg_sq[pair];
    }
    Terms terms;
#pragma unroll
    for (int c = 0; c < ParameterRow::kSize; ++c) {
        float& mean = c % 2 == 0 ? means[c / 2].x : means[c / 2].y;
        float& square = c % 2 == 0 ? squares[c / 2].x : squares[c / 2].y;
        mean = decay(gradient[c], mean, optimizer.beta1, optimizer.one_minus_beta1);
        square = decay(__fmul_rn(gradient[c], gradient[c]), square, optimizer.beta2, optimizer.one_minus_beta2);
        const float denominator = denominator_of(square, corrections.y, optimizer.eps);
        terms.change[c] =
            -__fmul_rn(optimizer.rates[c], adam_direction(__fmul_rn(mean, corrections.x), denominator));
        terms.mean[c] = mean;
        terms.scale[c] = approximate_rsqrt(approximate_sqrt(square) + optimizer.eps);
    }
#pragma unroll
    for (int pair = 0; pair < kPairs; ++pair) {
        exp_avg[pair] = means[pair];
        exp_avg_sq[pair] = squares[pair];
    }
    return terms;
}

// Solves the block of kSize parameters from kFirst on: `terms.change`. `add_rows(system)` adds the rows.
template <int kFirst, int kSize, class AddRows>
__device__ __forceinline__ void solve_block(const OptimizerParams& optimizer, const AddRows& add_rows, Terms& terms) {
    DampedSystem<kSize> system;
    add_rows(system);
    float x[kSize];
#pragma unroll
    for (int i = 0; i < kSize; ++i) x[i] = terms.mean[kFirst + i] * terms.scale[kFirst + i];
    system.solve(x);
#pragma unroll
    for (int i = 0; i < kSize; ++i) {
        const int c = kFirst + i;
        const float rate = optimizer.kind == UpdateKind::kUnscaledLm ? 1.0f : optimizer.rates[c];
        terms.change[c] = -rate * (terms.scale[c] * x[i]);
    }
}

}  // namespace turbogs
