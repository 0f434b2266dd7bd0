// The Gaussians and views of a launch, checked: one version for all operators that are given them.
#pragma once

#include "bindings/arguments.h"
#include "common/views.h"

namespace turbogs {

// Reads Python's `Scene`, whose fields `Launch` has.
template <class Launch>
void read_scene(const Arguments<Launch>& in, SceneParams& scene) {
    using T = typename Launch::Tensors;
    const Tensor &means = in.tensor(T::means), &shN = in.tensor(T::shN);
    STD_TORCH_CHECK(means.dim() == 2 && shN.dim() == 3, "turbogs: means must be [N, 3], shN [N, B, 3]");
    const int64_t views = in.num_rows(ImageRow::kSize), count = means.size(0), bands = shN.size(1);
    const int64_t sh_degree = in.integer(Launch::Integers::sh_degree);
    STD_TORCH_CHECK(sh_degree >= 0 && sh_degree <= kMaxShDegree, "turbogs: sh_degree must be 0 .. ", kMaxShDegree,
                    ", got ", sh_degree);
    STD_TORCH_CHECK(bands >= (sh_degree + 1) * (sh_degree + 1) - 1, "turbogs: shN holds ", bands,
                    " bands, too few for sh_degree ", sh_degree);
    to_int(views * count, "views * Gaussians");
    scene.num_views = to_int(views, "views");
    scene.num_gaussians = to_int(count, "Gaussians");
    scene.sh_degree = static_cast<int>(sh_degree);
    scene.bands = to_int(bands, "bands");
    scene.eps2d = in.number(Launch::Reals::eps2d);
    in.set(scene.means, T::means, {count, 3});
    in.set(scene.quats, T::quats, {count, 4});
    in.set(scene.scales, T::scales, {count, 3});
    in.set(scene.opacities, T::opacities, {count});
    in.set(scene.sh0, T::sh0, {count, 1, 3});
    in.set_quads(scene.shN, T::shN, {count, bands, 3});
    const Tensor& viewmats = in.tensor(T::viewmats);
    STD_TORCH_CHECK(viewmats.dim() == 3, "turbogs: viewmats must be [C, 4, 4]");
    const int64_t cameras = viewmats.size(0);
    in.set(scene.viewmats, T::viewmats, {cameras, 4, 4});
    in.set(scene.intrinsics, T::Ks, {cameras, 3, 3});
    for (int64_t view = 0; view < views; ++view) {
        const int64_t* row = in.row(view, ImageRow::kSize);
        const int64_t width = row[ImageRow::kWidth], height = row[ImageRow::kHeight], camera = row[ImageRow::kCamera];
        check_size(view, width, height);
        STD_TORCH_CHECK(camera >= 0 && camera < cameras, "turbogs: camera ", camera, " of view ", view,
                        " is not one of ", cameras);
        scene.widths[view] = static_cast<int>(width);
        scene.heights[view] = static_cast<int>(height);
        scene.camera_rows[view] = to_int(camera, "cameras");
    }
}

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
