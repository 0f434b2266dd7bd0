// Parameters of the kernels of the loss and the exposures. No torch here. Index spaces as in turbogs_plugin/types: K
// views of the batch, P sample slots, T tiles with samples, X flat pixels of all V training views.
#pragma once

#include "common/batch.h"

namespace turbogs {

// Loss on the samples with its gradient, and where maps are given their update;
// turbogs_plugin/engine/reference/losses.py and turbogs_plugin/error_maps.py define both. A sample whose colour is
// not finite counts as an empty slot: no gradient, no error, no visit.
struct SparseLossParams {
    int num_views;  // K
    int num_tiles;  // T
    int num_slots;  // P
    SampleView views[kMaxViews];
    Structure structure;
    float epsilon;  // of the Charbonnier term
    float l1_weight;
    float structure_weight;   // factor of the mean over tiles and channels of 1 - S
    float variance_constant;  // ncc, printed_ncc
    bool balance;             // lambda of the paper: structure gradients no larger than l1's

    const int32_t* tile_ids;      // [T]
    const int32_t* tile_offsets;  // [T + 1]
    const int32_t* pixel_ids;     // [P]
    const float* weights;         // [P] or null
    const float* colors;          // [P, 3]
    const float* targets;         // [P, 3], or null: then `photos` are gathered
    const uint8_t* photos;        // [X, 3], or [X, 4]: colours times alpha, and alpha
    int channels;                 // of `photos`
    float background[3];          // shows through photos with an alpha

    const int32_t* num_filled;             // [1] filled slots; null where all are
    double* loss;                          // [], zero before the launch
    float* color_gradients;                // [P, 3] out
    float* pixel_errors;                   // [P] out
    unsigned long long* nonfinite_losses;  // [] 1 is added if the loss is not finite; or null

    // Maps of all views; all null where they are not to be updated.
    uint16_t* errors;         // [X] halves
    int16_t* stamps;          // [X]
    double* view_sums;        // [V]
    const int32_t* overflow;  // [1] where not 0, the maps are left alone; or null
    float ema_old, ema_new;   // 1 - beta and beta, each rounded from double
    int16_t stamp;

    // The depth term; all null without.
    const float* depths;          // [P] rendered; 0: none
    const float* inverse_depths;  // [Y] of cells of all views, row by row; 0: not known
    const int64_t* first_cells;   // [V]
    float* depth_gradients;       // [P] out
    int cell;                     // side of a cell, pixels
    float depth_factor;           // of the mean over the samples
};

// ---- Exposures, which turbogs_plugin/engine/exposures.py defines ----------------------------------

constexpr int kExposureNumbers = 12;  // of a photo's map less the identity: rows of A | b

// Samples with their views, and the maps.
struct ExposedSamples {
    int num_views;  // K
    int num_tiles;  // T
    SampleView views[kMaxViews];
    const int32_t* tile_ids;      // [T]
    const int32_t* tile_offsets;  // [T + 1]
    const float* colors;          // [P, 3]
    const float* offsets;         // [V, 3, 4]
};

struct ExposeColorsParams : ExposedSamples {
    float* exposed;  // [P, 3] out
};

struct ExposureBackwardParams : ExposedSamples {
    float* gradients;  // [P, 3] in: of the exposed colours; out: of the colours
    double* sums;      // [K, 3, 4] added to
};

struct ExposureStepParams {
    int num_views;   // K
    int num_photos;  // V
    SampleView views[kMaxViews];
    const double* sums;       // [K, 3, 4]
    float* offsets;           // [V, 3, 4], as are the moments
    float* exp_avg;           // changed in place, all four
    float* exp_avg_sq;
    int32_t* steps;           // [V]
    const int32_t* overflow;  // [1] where not 0, nothing changes; or null
    double beta1, beta2;
    float rate, eps, pull;
};

void launch_sparse_loss(const SparseLossParams& params, cudaStream_t stream);
void launch_expose_colors(const ExposeColorsParams& params, cudaStream_t stream);
void launch_exposure_backward(const ExposureBackwardParams& params, cudaStream_t stream);
void launch_exposure_step(const ExposureStepParams& params, cudaStream_t stream);

// For launch_sparse_loss: SSIM's part, where T is not 0, after the rest is enqueued.
void launch_window_similarity(const SparseLossParams& params, cudaStream_t stream);

}  // namespace turbogs
