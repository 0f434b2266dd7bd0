// Parameters of the samplers' kernels. No torch here. Index spaces as in turbogs_plugin/types: K views of the
// batch, P sample slots, T tiles with samples, X flat pixels of all training views.
#pragma once

#include "common/philox.h"
#include "common/batch.h"

namespace turbogs {

// The tiles of a view that are drawn from, as a list. Without masks it is all tiles of the view.
struct LiveTiles {
    int tile_base;  // place of the view's first, in the list of the batch
    int count;      // in the view
    int first;      // with masks: place of the view's first among all training views' tiles
};

// turbogs_plugin/engine/reference/draws.py defines the draw, bit for bit.
struct SamplePixelsParams {
    SampleUnit unit;
    int num_views;   // K
    int num_tiles;   // to draw from, of all views: with masks the live ones, which have a pixel left
    int num_chosen;  // unit tile: chosen tiles of all views
    SampleView views[kMaxViews];
    int stages[kMaxViews][3];  // units of the hard, stable and mixed stage: of a tile, or for unit tile of the view
    LiveTiles live[kMaxViews];
    int slots_per_tile;        // unit pixel: slots of a tile that is not cut, the most of a cut one; with masks of all
    bool mixed_uniform;
    float importance;  // unit pixel: a of the weights p^-a, 0 for none
    PhiloxKeys keys;
    int now;  // a pixel's age is now - stamp, within 0 .. 32767

    const uint16_t* errors;  // [X] halves
    const int16_t* stamps;   // [X]

    // Masks of all V training views, or null: L live tiles, view after view.
    const int32_t* live_tiles;  // [L] number within the view, ascending
    const int32_t* live_rows;   // [L] row of `live_bits`
    const int32_t* live_bits;   // [B, kPerLane] bit n of word j: pixel 32 j + n in the order of samples counts

    int32_t* pixel_ids;     // [P] out
    int32_t* tile_ids;      // [T] out
    int32_t* tile_offsets;  // [T + 1] out
    float* weights;         // [P] out, p^-a before normalisation; null where importance is 0

    // Unit tile only, scratch over all tiles of the batch.
    double* tile_errors;  // [tiles]
    int32_t* tile_ages;   // [tiles]
    int64_t* tile_keys;   // [tiles]
};

void launch_sample_pixels(const SamplePixelsParams& params, cudaStream_t stream);
void launch_sample_tiles(const SamplePixelsParams& params, cudaStream_t stream);  // unit tile

}  // namespace turbogs
