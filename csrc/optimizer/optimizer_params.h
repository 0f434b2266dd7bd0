// Parameters of the kernels that take gradients from the screen to the Gaussians. No torch here. Index spaces as in
// turbogs_plugin/types: K views of the batch, N Gaussians, P sample slots, B harmonics above band 0.
#pragma once

#include "common/batch.h"

namespace turbogs {

// The screen gradients of a batch, the parameters that they belong to, and what the backward pass adds up.
struct ScreenBackwardParams : SceneParams {
    float4* records;            // [K, N, 4]; read where on screen; the fused step leaves rows in any of them
    const int2* radii;          // [K, N]; 0 where the Gaussian is off screen
    const int32_t* overflow;    // [1], or null; where set, the launch does nothing

    // GaussianStats, added to in place; all null where not wanted.
    float* error_sums;     // [N]
    float* distance_sums;  // [N]
    float* weight_sums;    // [N]
    float* grad_sums;      // [N]
    float* absgrad_sums;   // [N]
    float* square_sums;    // [N]
    float* view_counts;    // [N]
    float* max_radii;      // [N]
};

// Outputs of the unfused backward pass. Every entry is written, zeros included.
struct ProjectionBackwardOutputs {
    bool per_view;       // rows of each view, or their sum
    float2* rows;        // [K, N, 14] or [1, N, 14]
    float* shN;          // [N, B, 3]
    bool* touched;       // [N] sum w > 0 in some view
};

// One optimizer step, fused with the backward pass of the projection; turbogs_plugin/engine/reference/update.py
// defines it.
struct OptimizerParams {
    UpdateKind kind;
    float rates[ParameterRow::kSize];  // learning rates in the order of a row
    float rate_shN;
    float beta1, beta2;
    float one_minus_beta1, one_minus_beta2;  // rounded once: the difference of the floats is off by 1.3e-5 at 0.999
    float log_beta1, log_beta2;              // natural logarithms, rounded once from double; -infinity where beta is 0
    float eps;

    // Where the new parameters go besides, maybe in other GPUs' memory: bytes behind each of them.
    int64_t copies[kMaxPeers - 1];
    int num_copies;

    // Updated in place, as are the parameters.
    float2* exp_avg;              // [N, 14]
    float2* exp_avg_sq;           // [N, 14]
    float* exp_avg_shN;           // [N, 3 B]
    float* exp_avg_sq_shN;        // [N, 3 B]
    int32_t* steps;               // [N]
    unsigned long long* skipped;  // [] Gaussians left out because of a non-finite gradient
};

void launch_projection_backward(const ScreenBackwardParams& params, const ProjectionBackwardOutputs& outputs,
                                cudaStream_t stream);
void launch_fused_step(const ScreenBackwardParams& params, const OptimizerParams& optimizer, cudaStream_t stream);

}  // namespace turbogs
