// The kernels of the loss as torch operators; see arguments.h.
#include "bindings/arguments.h"
#include "bindings/sample_views.h"
#include "loss/loss_params.h"

namespace turbogs {

void launches::CountFilled::run(const Arguments<CountFilled>& in) {
    CountFilledParams params = {};
    params.num_slots = to_int(in.tensor(Tensors::pixel_ids).numel(), "samples");
    in.set(params.pixel_ids, Tensors::pixel_ids, {params.num_slots});
    in.set(params.num_filled, Tensors::num_filled, {1});
    check_launched(launch_count_filled(params, in.stream()), "count of samples");
}

void launches::SparseLoss::run(const Arguments<SparseLoss>& in) {
    const int64_t slots = in.tensor(Tensors::pixel_ids).numel(), tiles = in.tensor(Tensors::tile_ids).numel();
    const bool has_photos = in.has(Tensors::photos), has_maps = in.has(Tensors::errors);
    STD_TORCH_CHECK(in.has(Tensors::targets) != has_photos, "turbogs: give either targets or photos");
    const bool has_channels = has_photos && in.tensor(Tensors::photos).dim() == 2;
    const int64_t channels = has_channels ? in.tensor(Tensors::photos).size(1) : 3;
    STD_TORCH_CHECK(channels == 3 || channels == 4, "turbogs: photos must have 3 or 4 channels, got ", channels);
    const int64_t photo_pixels = has_photos ? in.tensor(Tensors::photos).numel() / channels : -1;
    const int64_t map_pixels = has_maps ? in.tensor(Tensors::errors).numel() : -1;
    STD_TORCH_CHECK(!has_photos || !has_maps || photo_pixels == map_pixels,
                    "turbogs: photos and maps must be of the same pixels");

    SparseLossParams params = {};
    read_views(in, ViewRow::kSize, has_maps ? map_pixels : photo_pixels, params);
    params.num_tiles = to_int(tiles, "tiles");
    params.num_slots = to_int(slots, "samples");
    params.structure = to_enumeration<Structure>(in.integer(Integers::structure), kNumStructures,
                                                 "structure must be 0 .. 3: none, ncc, ssim or printed_ncc");
    params.epsilon = in.number(Reals::epsilon);
    params.l1_weight = in.number(Reals::l1_weight);
    params.structure_weight = in.number(Reals::structure_weight);
    params.variance_constant = in.number(Reals::variance_constant);
    params.balance = in.integer(Integers::balance) != 0;
    in.set(params.tile_ids, Tensors::tile_ids, {tiles});
    in.set(params.tile_offsets, Tensors::tile_offsets, {tiles + 1});
    in.set(params.pixel_ids, Tensors::pixel_ids, {slots});
    in.set_optional(params.weights, Tensors::weights, {slots});
    in.set(params.colors, Tensors::colors, {slots, 3});
    in.set_optional(params.targets, Tensors::targets, {slots, 3});
    in.set_optional(params.photos, Tensors::photos, {photo_pixels, channels});
    params.channels = static_cast<int>(channels);
    params.background[0] = in.number(Reals::background_red);
    params.background[1] = in.number(Reals::background_green);
    params.background[2] = in.number(Reals::background_blue);
    if (has_maps) {
        const int64_t num_views = in.tensor(Tensors::view_sums).numel();
        in.set(params.errors, Tensors::errors, {map_pixels});
        in.set(params.stamps, Tensors::stamps, {map_pixels});
        in.set(params.view_sums, Tensors::view_sums, {num_views});
        params.ema_old = static_cast<float>(1.0 - in.real(Reals::beta));
        params.ema_new = in.number(Reals::beta);
        params.stamp = static_cast<int16_t>(in.integer(Integers::stamp));
        for (int i = 0; i < params.num_views; ++i) {
            STD_TORCH_CHECK(params.views[i].view_number < num_views, "turbogs: view ", params.views[i].view_number,
                            " lies outside the photos or maps");
        }
    }
    in.set_optional(params.num_filled, Tensors::num_filled, {1});
    in.set(params.loss, Tensors::loss, {});
    in.set(params.color_gradients, Tensors::color_gradients, {slots, 3});
    in.set(params.pixel_errors, Tensors::pixel_errors, {slots});
    in.set_optional(params.nonfinite_losses, Tensors::nonfinite_losses, {});
    in.set_optional(params.overflow, Tensors::overflow, {1});
    check_launched(launch_sparse_loss(params, in.stream()), "sparse loss");
}

}  // namespace turbogs
