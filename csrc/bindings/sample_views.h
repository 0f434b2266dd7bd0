// The views of a batch that the sampler and the loss are given, checked.
#pragma once

#include "bindings/arguments.h"
#include "common/sample_view.h"

namespace turbogs {

// Fills `views` of a launcher's parameters, and counts them, from rows of `row_size` numbers, which begin as `ViewRow`
// does. `pixels`: of all training views, or -1 where nothing is read at flat pixels.
template <class Launch, class Params>
void read_views(const Arguments<Launch>& in, int row_size, int64_t pixels, Params& params) {
    int num_tiles = 0, origin_x = 0, origin_y = 0;
    read_origin(in, origin_x, origin_y);
    params.num_views = static_cast<int>(in.num_rows(row_size));
    for (int i = 0; i < params.num_views; ++i) {
        const int64_t* row = in.row(i, row_size);
        const int64_t width = row[ViewRow::kWidth], height = row[ViewRow::kHeight];
        check_size(i, width, height);
        SampleView& view = params.views[i];
        view.pixel_base = row[ViewRow::kFirstPixel];
        view.width = static_cast<int>(width);
        view.height = static_cast<int>(height);
        view.view_number = to_int(row[ViewRow::kNumber], "view number");
        view.origin_x = origin_x;
        view.origin_y = origin_y;
        view.tiles_x = tiles_along(origin_x + view.width);
        view.tiles_y = tiles_along(origin_y + view.height);
        view.tile_base = num_tiles;
        num_tiles += view.tiles_x * view.tiles_y;
        STD_TORCH_CHECK(pixels < 0 || (view.pixel_base >= 0 && view.pixel_base + width * height <= pixels),
                        "turbogs: view ", view.view_number, " lies outside the photos or maps");
    }
}

}  // namespace turbogs
