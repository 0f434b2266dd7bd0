// The Gaussians and views that the projection and its backward pass are given, checked: one version for both bindings.
#pragma once

#include <vector>

#include "binding_checks.h"
#include "scene_params.h"

namespace turbogs {

// Fills `scene`. `gaussians`: means, quats, scales, opacities, sh0, shN; `sizes`: width and height of each view.
inline void check_scene(const Checker& check, const std::vector<Tensor>& gaussians, const Tensor& viewmats, const Tensor& Ks,
                        const std::vector<int64_t>& sizes, int64_t sh_degree, double eps2d, SceneParams& scene) {
    STD_TORCH_CHECK(gaussians.size() == 6, "turbogs: gaussians must be means, quats, scales, opacities, sh0, shN");
    STD_TORCH_CHECK(gaussians[0].dim() == 2 && gaussians[5].dim() == 3, "turbogs: means must be [N, 3], shN [N, B, 3]");
    const int64_t views = static_cast<int64_t>(sizes.size()) / 2, count = gaussians[0].size(0), bands = gaussians[5].size(1);
    STD_TORCH_CHECK(views >= 1 && views <= kMaxViews, "turbogs: a batch has 1 .. ", kMaxViews, " views, got ", views);
    STD_TORCH_CHECK(sh_degree >= 0 && sh_degree <= kMaxDegree, "turbogs: sh_degree must be 0 .. ", kMaxDegree, ", got ",
                    sh_degree);
    STD_TORCH_CHECK(bands >= (sh_degree + 1) * (sh_degree + 1) - 1, "turbogs: shN holds ", bands,
                    " bands, too few for sh_degree ", sh_degree);
    to_int(views * count, "views * Gaussians");
    scene.num_views = to_int(views, "views");
    scene.num_gaussians = to_int(count, "Gaussians");
    scene.sh_degree = static_cast<int>(sh_degree);
    scene.bands = to_int(bands, "bands");
    scene.eps2d = static_cast<float>(eps2d);
    scene.means = check.pointer<float>(gaussians[0], "means", ScalarType::Float, {count, 3});
    scene.quats = check.aligned_pointer<float>(gaussians[1], "quats", ScalarType::Float, {count, 4});
    scene.scales = check.pointer<float>(gaussians[2], "scales", ScalarType::Float, {count, 3});
    scene.opacities = check.pointer<float>(gaussians[3], "opacities", ScalarType::Float, {count});
    scene.sh0 = check.pointer<float>(gaussians[4], "sh0", ScalarType::Float, {count, 1, 3});
    scene.shN = check.aligned_pointer<float>(gaussians[5], "shN", ScalarType::Float, {count, bands, 3});
    scene.viewmats = check.pointer<float>(viewmats, "viewmats", ScalarType::Float, {views, 4, 4});
    scene.intrinsics = check.pointer<float>(Ks, "Ks", ScalarType::Float, {views, 3, 3});
    for (int64_t view = 0; view < views; ++view) {
        const int64_t width = sizes[2 * view], height = sizes[2 * view + 1];
        check_size(view, width, height);
        scene.widths[view] = static_cast<int>(width);
        scene.heights[view] = static_cast<int>(height);
    }
}

}  // namespace turbogs
