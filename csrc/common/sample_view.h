// A view of a batch, as the kernels over the pixels of training views see it.
#pragma once

#include <cstdint>

namespace turbogs {

struct SampleView {
    int64_t pixel_base;  // first flat pixel
    int width, height;
    int tiles_x, tiles_y;
    int tile_base;    // first tile in the batch's numbering
    int origin_x, origin_y;  // pixels by which the grid of tiles begins before the image
    int view_number;  // training view
    int slot_base;    // sampler: first slot (unit pixel) or first chosen tile (unit tile)
};

}  // namespace turbogs
