// Parameters of the training kernels: plain structs of raw pointers, one per launch, passed by value. No torch here.
//
// Index spaces as in turbogs_plugin/types.py: K views of the batch, N Gaussians, P sample slots, T tiles with samples,
// X flat pixels of all training views.
#pragma once

#include <cuda_runtime.h>

#include <cstdint>

#include "scene_params.h"
#include "sizes.h"

namespace turbogs {

constexpr float kRateMin = 1.0842021724855044e-19f;  // sqrt(FLT_MIN)
constexpr int kRowSize = 14;                         // mean 3, scale 3, quaternion 4, sh0 3, opacity 1

// The screen gradients of a batch, the parameters that they belong to, and what the backward pass adds up.
struct ScreenBackwardParams : SceneParams {
    float4* records;             // [K, N, 4]; read where on screen; the fused step leaves rows in any of them
    const int2* radii;           // [K, N]; 0 where the Gaussian is off screen
    const int32_t* num_filled;   // [1] filled slots of the batch; null where all are
    int num_slots;               // P
    const int32_t* overflow;     // [1], or null; where set, the launch does nothing

    // GaussianStats, added to in place; all null where not wanted.
    float* error_sums;     // [N]
    float* distance_sums;  // [N]
    float* weight_sums;    // [N]
    float* grad_sums;      // [N]
    float* absgrad_sums;   // [N]
    float* view_counts;    // [N]
    float* max_radii;      // [N]
};

// Outputs of the unfused backward pass. Every entry is written, zeros included.
struct ProjectionBackwardOutputs {
    bool per_view;       // rows of each view, or their sum
    float* rows;         // [K, N, 14] or [1, N, 14]
    float* shN;          // [N, B, 3]
    bool* touched;       // [N] sum w > 0 in some view
    float* view_losses;  // [K, N] or [1, N]
};

enum class StepKind : int { kAdam = 0, kBalancedLm = 1, kPaperLm = 2 };

// One optimizer step, fused with the backward pass of the projection; the rule is strategies/update_rule.py's.
struct OptimizerParams {
    StepKind kind;
    bool rows_per_view;      // LM: a row of J for each view, or one of their sum
    float rates[kRowSize];   // learning rates in the order of a row
    float inverse_rates[kRowSize];  // at most 2^63: the damping of a rate of zero
    float rate_shN;
    float beta1, beta2;
    float one_minus_beta1, one_minus_beta2;  // rounded once: the difference of the floats is off by 1.3e-5 at 0.999
    float log_beta1, log_beta2;  // natural logarithms, rounded once from double; -infinity where beta is 0
    float eps;
    float curvature;         // balanced LM
    float max_step;          // balanced LM, 0 for no bound

    float* means;            // [N, 3] updated in place, as are the rest; the same memory as ScreenBackwardParams'
    float* quats;
    float* scales;
    float* opacities;
    float* sh0;
    float* shN;
    float* exp_avg;          // [N, 14]
    float* exp_avg_sq;       // [N, 14]
    float* exp_avg_shN;      // [N, 3 B]
    float* exp_avg_sq_shN;   // [N, 3 B]
    int32_t* steps;          // [N]
    unsigned long long* skipped;  // [1] Gaussians left out because of a non-finite gradient
};

// One view of a batch, as the kernels over pixels see it.
struct SampleView {
    int64_t pixel_base;  // first flat pixel
    int width, height;
    int tiles_x, tiles_y;
    int tile_base;       // first tile in the batch's numbering
    int view_number;     // training view
    int slot_base;       // first slot (units pixel and cell); first chosen tile (unit tile)
    int wanted;          // unit tile: tiles to choose
};

enum class SampleUnit : int { kPixel = 0, kCell = 1, kTile = 2 };

// The pixel sampler; strategies/pixel_draws.py defines the draw, bit for bit.
struct SamplePixelsParams {
    SampleUnit unit;
    int num_views;             // K
    int num_tiles;             // of all views
    int num_chosen;            // unit tile: chosen tiles of all views
    SampleView views[kMaxViews];
    int stages[kMaxViews][3];  // units of the hard, stable and mixed stage: [0] holds for all tiles, or one a view
    int slots_per_tile;        // units pixel and cell: slots of a tile that is not cut; also the cap of a cut one
    bool mixed_uniform;
    float importance;          // a of the weights p^-a, 0 for none
    uint32_t seed_high;
    uint32_t round_keys[10][2];  // of Philox, from the low half of the seed and the iteration
    int now;                   // a pixel's age is now - stamp, within 0 .. 32767

    const void* errors;        // [X] half
    const int16_t* stamps;     // [X]

    int32_t* pixel_ids;        // [P] out
    int32_t* tile_ids;         // [T] out
    int32_t* tile_offsets;     // [T + 1] out
    float* weights;            // [P] out, p^-a before normalisation; null where importance is 0

    // Unit tile only, scratch over all tiles of the batch.
    double* tile_errors;       // [tiles]
    int32_t* tile_ages;        // [tiles]
    int64_t* tile_keys;        // [tiles]
    float* tile_missed;        // [tiles]
};

enum class Structure : int { kNone = 0, kNcc = 1, kContrast = 2, kSsim = 3 };

// Loss on the samples with its gradient, and where maps are given their update; strategies/loss.py and error_maps.py
// define both. A sample whose colour is not finite counts as an empty slot: no gradient, no error, no visit.
struct SparseLossParams {
    int num_views;             // K
    int num_tiles;             // T, tiles with samples
    int num_slots;             // P
    SampleView views[kMaxViews];
    Structure structure;
    float epsilon;             // of the Charbonnier term
    float l1_weight;
    float structure_weight;    // factor of the mean over tiles and channels of 1 - S
    float variance_constant;   // ncc, contrast
    bool balance;              // lambda of the paper: structure gradients no larger than those of l1
    bool gate;                 // by the truth's variance

    const int32_t* tile_ids;      // [T]
    const int32_t* tile_offsets;  // [T + 1]
    const int32_t* pixel_ids;     // [P]
    const float* weights;         // [P] or null
    const float* colors;          // [P, 3]
    const float* targets;         // [P, 3], or null: then `photos` are gathered
    const uint8_t* photos;        // [X, 3]

    const int32_t* num_filled;    // [1] filled slots; null where all are
    double* loss;                 // [1], zero before the launch
    float* color_gradients;       // [P, 3] out
    float* pixel_errors;          // [P] out
    unsigned long long* num_nonfinite;  // [1] samples whose colour was not finite are added; or null
    unsigned long long* nonfinite_losses;  // [1] 1 is added if the loss is not finite; or null

    // Maps of all views; all null where they are not to be updated.
    void* errors;                 // [X] half
    int16_t* stamps;              // [X]
    double* view_sums;            // [V]
    const int32_t* overflow;      // [1] where not 0, the maps are left alone; or null
    float ema_old, ema_new;       // 1 - beta and beta, each rounded from double
    int16_t stamp;
};

// Adds the filled slots (id >= 0) to `num_filled`.
struct CountFilledParams {
    const int32_t* pixel_ids;  // [P]
    int num_slots;
    int32_t* num_filled;       // [1]
};

cudaError_t launch_count_filled(const CountFilledParams& params, cudaStream_t stream);
cudaError_t launch_sparse_loss(const SparseLossParams& params, cudaStream_t stream);
cudaError_t launch_sample_pixels(const SamplePixelsParams& params, cudaStream_t stream);
cudaError_t launch_sample_tiles(const SamplePixelsParams& params, cudaStream_t stream);  // unit tile

cudaError_t launch_projection_backward(const ScreenBackwardParams& params, const ProjectionBackwardOutputs& outputs,
                                       cudaStream_t stream);
cudaError_t launch_fused_step(const ScreenBackwardParams& params, const OptimizerParams& optimizer,
                              cudaStream_t stream);

}  // namespace turbogs
