// The kernels of exposures as torch operators; see arguments.h.
#include "bindings/arguments.h"
#include "bindings/sample_views.h"
#include "exposure/exposure_params.h"

namespace turbogs {

template <class Params>
void check_photos(const Params& params, int64_t photos) {
    for (int i = 0; i < params.num_views; ++i) {
        STD_TORCH_CHECK(params.views[i].view_number < photos, "turbogs: view ", params.views[i].view_number,
                        " has no exposure");
    }
}

// What both directions read. Returns P.
template <class Launch>
int64_t read_exposed(const Arguments<Launch>& in, ExposedSamples& params) {
    using Tensors = typename Launch::Tensors;
    const int64_t slots = in.tensor(Tensors::colors).numel() / 3, tiles = in.tensor(Tensors::tile_ids).numel();
    const int64_t photos = in.tensor(Tensors::offsets).numel() / kExposureNumbers;
    read_views(in, ViewRow::kSize, -1, params);
    check_photos(params, photos);
    params.num_tiles = to_int(tiles, "tiles");
    to_int(slots, "samples");
    in.set(params.tile_ids, Tensors::tile_ids, {tiles});
    in.set(params.tile_offsets, Tensors::tile_offsets, {tiles + 1});
    in.set(params.colors, Tensors::colors, {slots, 3});
    in.set(params.offsets, Tensors::offsets, {photos, 3, 4});
    return slots;
}

void launches::ExposeColors::run(const Arguments<ExposeColors>& in) {
    ExposeColorsParams params = {};
    const int64_t slots = read_exposed(in, params);
    in.set(params.exposed, Tensors::exposed, {slots, 3});
    check_launched(launch_expose_colors(params, in.stream()), "exposures");
}

void launches::ExposureBackward::run(const Arguments<ExposureBackward>& in) {
    ExposureBackwardParams params = {};
    const int64_t slots = read_exposed(in, params);
    in.set(params.gradients, Tensors::gradients, {slots, 3});
    in.set(params.sums, Tensors::sums, {params.num_views, 3, 4});
    check_launched(launch_exposure_backward(params, in.stream()), "gradients of exposures");
}

void launches::ExposureStep::run(const Arguments<ExposureStep>& in) {
    ExposureStepParams params = {};
    const int64_t photos = in.tensor(Tensors::steps).numel();
    read_views(in, ViewRow::kSize, -1, params);
    check_photos(params, photos);
    params.num_photos = to_int(photos, "photos");
    in.set(params.sums, Tensors::sums, {params.num_views, 3, 4});
    in.set(params.offsets, Tensors::offsets, {photos, 3, 4});
    in.set(params.exp_avg, Tensors::exp_avg, {photos, 3, 4});
    in.set(params.exp_avg_sq, Tensors::exp_avg_sq, {photos, 3, 4});
    in.set(params.steps, Tensors::steps, {photos});
    in.set_optional(params.overflow, Tensors::overflow, {1});
    params.beta1 = in.real(Reals::beta1);
    params.beta2 = in.real(Reals::beta2);
    params.rate = in.number(Reals::rate);
    params.eps = in.number(Reals::eps);
    params.pull = in.number(Reals::pull);
    check_launched(launch_exposure_step(params, in.stream()), "step of exposures");
}

}  // namespace turbogs
