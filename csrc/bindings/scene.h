// The Gaussians and views that the projection and its backward pass are given, checked: one version for all their
// operators.
#pragma once

#include "bindings/arguments.h"
#include "common/scene_params.h"

namespace turbogs {

// `Launch` has the fields of launches.py's `Scene`.
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
    scene.means = in.template pointer<float>(T::means, ScalarType::Float, {count, 3});
    scene.quats = in.template aligned_pointer<float>(T::quats, ScalarType::Float, {count, 4});
    scene.scales = in.template pointer<float>(T::scales, ScalarType::Float, {count, 3});
    scene.opacities = in.template pointer<float>(T::opacities, ScalarType::Float, {count});
    scene.sh0 = in.template pointer<float>(T::sh0, ScalarType::Float, {count, 1, 3});
    scene.shN = in.template aligned_pointer<float>(T::shN, ScalarType::Float, {count, bands, 3});
    scene.viewmats = in.template pointer<float>(T::viewmats, ScalarType::Float, {views, 4, 4});
    scene.intrinsics = in.template pointer<float>(T::Ks, ScalarType::Float, {views, 3, 3});
    for (int64_t view = 0; view < views; ++view) {
        const int64_t* row = in.row(view, ImageRow::kSize);
        const int64_t width = row[ImageRow::kWidth], height = row[ImageRow::kHeight];
        check_size(view, width, height);
        scene.widths[view] = static_cast<int>(width);
        scene.heights[view] = static_cast<int>(height);
    }
}

}  // namespace turbogs
