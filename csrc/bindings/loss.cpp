// The kernels of the loss as torch operators; see raster.cpp.
#include "bindings/arguments.h"
#include "bindings/sample_views.h"
#include "loss/loss_params.h"

namespace turbogs {
namespace {

void count_filled(const TensorList& tensors, const IntegerList& integers, const RealList& reals,
                  const IntegerList& rows) {
    using Launch = launches::CountFilled;
    using T = Launch::Tensors;
    const Arguments<Launch> in(tensors, integers, reals, rows, T::pixel_ids);
    CountFilledParams params = {};
    params.num_slots = to_int(in.tensor(T::pixel_ids).numel(), "samples");
    params.pixel_ids = in.pointer<int32_t>(T::pixel_ids, ScalarType::Int, {params.num_slots});
    params.num_filled = in.pointer<int32_t>(T::num_filled, ScalarType::Int, {1});
    check_launched(launch_count_filled(params, in.stream()), "count of samples");
}

void sparse_loss(const TensorList& tensors, const IntegerList& integers, const RealList& reals,
                 const IntegerList& rows) {
    using Launch = launches::SparseLoss;
    using T = Launch::Tensors;
    using I = Launch::Integers;
    using R = Launch::Reals;
    const Arguments<Launch> in(tensors, integers, reals, rows, T::colors);
    const int64_t slots = in.tensor(T::pixel_ids).numel(), tiles = in.tensor(T::tile_ids).numel();
    const bool has_photos = in.has(T::photos), has_maps = in.has(T::errors);
    STD_TORCH_CHECK(in.has(T::targets) != has_photos, "turbogs: give either targets or photos");
    const int64_t photo_pixels = has_photos ? in.tensor(T::photos).numel() / 3 : -1;
    const int64_t map_pixels = has_maps ? in.tensor(T::errors).numel() : -1;
    STD_TORCH_CHECK(!has_photos || !has_maps || photo_pixels == map_pixels,
                    "turbogs: photos and maps must be of the same pixels");

    SparseLossParams params = {};
    params.num_views = read_views(in, ViewRow::kSize, has_maps ? map_pixels : photo_pixels, params.views).num_views;
    params.num_tiles = to_int(tiles, "tiles");
    params.num_slots = to_int(slots, "samples");
    params.structure = to_enumeration<Structure>(in.integer(I::structure), kNumStructures,
                                                 "structure must be 0 (none), 1 (ncc), 2 (contrast), 3 (ssim) or 4 (printed_ncc)");
    params.epsilon = in.number(R::epsilon);
    params.l1_weight = in.number(R::l1_weight);
    params.structure_weight = in.number(R::structure_weight);
    params.variance_constant = in.number(R::variance_constant);
    params.balance = in.integer(I::balance) != 0;
    params.gate = in.integer(I::gate) != 0;
    params.tile_ids = in.pointer<int32_t>(T::tile_ids, ScalarType::Int, {tiles});
    params.tile_offsets = in.pointer<int32_t>(T::tile_offsets, ScalarType::Int, {tiles + 1});
    params.pixel_ids = in.pointer<int32_t>(T::pixel_ids, ScalarType::Int, {slots});
    params.weights = in.optional<float>(T::weights, ScalarType::Float, {slots});
    params.colors = in.pointer<float>(T::colors, ScalarType::Float, {slots, 3});
    params.targets = in.optional<float>(T::targets, ScalarType::Float, {slots, 3});
    params.photos = in.optional<uint8_t>(T::photos, ScalarType::Byte, {photo_pixels, 3});
    if (has_maps) {
        const int64_t num_views = in.tensor(T::view_sums).numel();
        params.errors = in.pointer<void>(T::errors, ScalarType::Half, {map_pixels});
        params.stamps = in.pointer<int16_t>(T::stamps, ScalarType::Short, {map_pixels});
        params.view_sums = in.pointer<double>(T::view_sums, ScalarType::Double, {num_views});
        params.ema_old = static_cast<float>(1.0 - in.real(R::beta));
        params.ema_new = in.number(R::beta);
        params.stamp = static_cast<int16_t>(in.integer(I::stamp));
        for (int i = 0; i < params.num_views; ++i) {
            STD_TORCH_CHECK(params.views[i].view_number < num_views, "turbogs: view ", params.views[i].view_number,
                            " lies outside the photos or maps");
        }
    }
    params.num_filled = in.optional<int32_t>(T::num_filled, ScalarType::Int, {1});
    params.loss = in.pointer<double>(T::loss, ScalarType::Double, {});
    params.color_gradients = in.pointer<float>(T::color_gradients, ScalarType::Float, {slots, 3});
    params.pixel_errors = in.pointer<float>(T::pixel_errors, ScalarType::Float, {slots});
    params.nonfinite_losses = in.optional<unsigned long long>(T::nonfinite_losses, ScalarType::Long, {});
    params.overflow = in.optional<int32_t>(T::overflow, ScalarType::Int, {1});
    check_launched(launch_sparse_loss(params, in.stream()), "sparse loss");
}

}  // namespace
}  // namespace turbogs

STABLE_TORCH_LIBRARY_FRAGMENT(turbogs, m) {
    m.def("count_filled" TURBOGS_LAUNCH_SCHEMA);
    m.def("sparse_loss" TURBOGS_LAUNCH_SCHEMA);
}

STABLE_TORCH_LIBRARY_IMPL(turbogs, CUDA, m) {
    m.impl("count_filled", TORCH_BOX(&turbogs::count_filled));
    m.impl("sparse_loss", TORCH_BOX(&turbogs::sparse_loss));
}
