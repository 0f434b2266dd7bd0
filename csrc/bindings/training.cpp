// The kernels of sampling, loss, optimizer and exposures as torch operators; see arguments.h.
#include <algorithm>
#include <cmath>

#include "bindings/arguments.h"
#include "loss/loss_params.h"
#include "optimizer/optimizer_params.h"
#include "sampling/sampling_params.h"

namespace turbogs {

void launches::SamplePixels::run(const Arguments<SamplePixels>& in) {
    const int64_t pixels = in.tensor(Tensors::errors).numel(), slots = in.tensor(Tensors::pixel_ids).numel();
    const int64_t chosen = in.tensor(Tensors::tile_ids).numel();
    SamplePixelsParams params = {};
    read_views(in, DrawRow::kSize, pixels, params);
    const bool masked = in.has(Tensors::tiles);
    const int64_t num_live = masked ? in.tensor(Tensors::tiles).numel() : 0;
    int64_t tiles = 0;
    for (int i = 0; i < params.num_views; ++i) {
        const int64_t *row = in.row(i, DrawRow::kSize), first = row[DrawRow::kFirstLive], count = row[DrawRow::kLive];
        const int64_t all = int64_t{1} * params.views[i].tiles_x * params.views[i].tiles_y;
        STD_TORCH_CHECK(masked ? first >= 0 && count >= 0 && count <= all && first + count <= num_live : count == all,
                        "turbogs: the live tiles of view ", params.views[i].view_number, " are not those of the masks");
        params.live[i] = {to_int(tiles, "tiles"), static_cast<int>(count), to_int(first, "live tiles")};
        tiles += count;
    }
    params.num_tiles = to_int(tiles, "tiles");
    params.unit = static_cast<SampleUnit>(in.integer(Integers::unit));
    const bool of_tiles = params.unit == SampleUnit::kTile;
    STD_TORCH_CHECK(of_tiles || chosen == tiles, "turbogs: tile_ids must have an entry for each tile");
    STD_TORCH_CHECK(!of_tiles || !in.has(Tensors::weights), "turbogs: whole tiles have no importance weights");
    const bool at_origin = params.views[0].origin_x == 0 && params.views[0].origin_y == 0;
    STD_TORCH_CHECK(at_origin || (of_tiles && !masked),
                    "turbogs: another origin of the grid is for whole tiles without masks");
    params.num_chosen = to_int(chosen, "tiles");
    for (int i = 0; i < params.num_views; ++i) {
        const int64_t* row = in.row(i, DrawRow::kSize);
        params.views[i].slot_base = to_int(row[DrawRow::kFirstSlot], "first slot");
        for (int j = 0; j < 3; ++j) params.stages[i][j] = static_cast<int>(row[DrawRow::kStages + j]);
    }
    params.slots_per_tile = static_cast<int>(in.integer(Integers::slots_per_tile));
    params.mixed_uniform = in.integer(Integers::mixed_uniform) != 0;
    params.importance = in.number(Reals::importance);
    params.keys = philox_keys(in.integer(Integers::seed), in.integer(Integers::iteration));
    params.now = static_cast<int>(in.integer(Integers::now));
    in.set(params.errors, Tensors::errors, {pixels});
    in.set(params.stamps, Tensors::stamps, {pixels});
    in.set_optional(params.live_tiles, Tensors::tiles, {num_live});
    in.set_optional(params.live_rows, Tensors::rows, {num_live});
    if (masked) {
        in.set(params.live_bits, Tensors::bits, {in.tensor(Tensors::bits).size(0), kTilePixels / kWarpSize});
    }
    in.set(params.pixel_ids, Tensors::pixel_ids, {slots});
    in.set(params.tile_ids, Tensors::tile_ids, {chosen});
    in.set(params.tile_offsets, Tensors::tile_offsets, {chosen + 1});
    in.set_optional(params.weights, Tensors::weights, {slots});
    if (of_tiles) {
        in.set(params.tile_errors, Tensors::tile_errors, {tiles});
        in.set(params.tile_ages, Tensors::tile_ages, {tiles});
        in.set(params.tile_keys, Tensors::tile_keys, {tiles});
    }
    launch_sample_pixels(params, in.stream());
}

namespace {

// Throws unless each view of the batch is one of `count` training views, of which there is `what`.
template <class Params>
void check_views(const Params& params, int64_t count, const char* what) {
    for (int i = 0; i < params.num_views; ++i) {
        const int number = params.views[i].view_number;
        STD_TORCH_CHECK(number < count, "turbogs: view ", number, " lies outside the ", what);
    }
}

}  // namespace

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
    params.structure = static_cast<Structure>(in.integer(Integers::structure));
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
    read_background(in, params.background);
    if (has_maps) {
        const int64_t num_views = in.tensor(Tensors::view_sums).numel();
        in.set(params.errors, Tensors::errors, {map_pixels});
        in.set(params.stamps, Tensors::stamps, {map_pixels});
        in.set(params.view_sums, Tensors::view_sums, {num_views});
        params.ema_old = static_cast<float>(1.0 - in.real(Reals::beta));
        params.ema_new = in.number(Reals::beta);
        params.stamp = static_cast<int16_t>(in.integer(Integers::stamp));
        check_views(params, num_views, "photos or maps");
    }
    in.set_optional(params.num_filled, Tensors::num_filled, {1});
    in.set(params.loss, Tensors::loss, {});
    in.set(params.color_gradients, Tensors::color_gradients, {slots, 3});
    in.set(params.pixel_errors, Tensors::pixel_errors, {slots});
    in.set_optional(params.nonfinite_losses, Tensors::nonfinite_losses, {});
    in.set_optional(params.overflow, Tensors::overflow, {1});
    params.cell = static_cast<int>(in.integer(Integers::cell));
    params.depth_factor = in.number(Reals::depth_factor);
    if (in.has(Tensors::depths)) {
        const int64_t num_views = in.tensor(Tensors::starts).numel();
        check_views(params, num_views, "known depths");
        in.set(params.depths, Tensors::depths, {slots});
        in.set(params.depth_gradients, Tensors::depth_gradients, {slots});
        in.set(params.inverse_depths, Tensors::cells, {in.tensor(Tensors::cells).numel()});
        in.set(params.first_cells, Tensors::starts, {num_views});
    }
    launch_sparse_loss(params, in.stream());
}

namespace {


// What both operators work on. `Launch` has the fields of Python's `ScreenBackward`.
template <class Launch>
ScreenBackwardParams read_screen(const Arguments<Launch>& in) {
    using T = typename Launch::Tensors;
    ScreenBackwardParams params = {};
    read_scene(in, params);
    STD_TORCH_CHECK(params.bands <= kMaxBands, "turbogs: shN holds ", params.bands, " bands, more than ", kMaxBands);
    const int64_t views = params.num_views, count = params.num_gaussians;
    in.set(params.records, T::records, {views, count, ScreenRecord::kSize});
    in.set(params.radii, T::radii, {views, count, 2});
    in.set_optional(params.overflow, T::overflow, {1});
    if (in.has(T::error_sums)) {
        in.set(params.error_sums, T::error_sums, {count});
        in.set(params.distance_sums, T::distance_sums, {count});
        in.set(params.weight_sums, T::weight_sums, {count});
        in.set(params.grad_sums, T::grad_sums, {count});
        in.set(params.absgrad_sums, T::absgrad_sums, {count});
        in.set(params.square_sums, T::square_sums, {count});
        in.set(params.view_counts, T::view_counts, {count});
        in.set(params.max_radii, T::max_radii, {count});
    }
    return params;
}

}  // namespace

void launches::ProjectionBackward::run(const Arguments<ProjectionBackward>& in) {
    const ScreenBackwardParams params = read_screen(in);
    const Tensor& row_gradients = in.tensor(Tensors::rows);
    STD_TORCH_CHECK(
        row_gradients.dim() == 3 && (row_gradients.size(0) == 1 || row_gradients.size(0) == params.num_views),
        "turbogs: rows must be [1, N, 14] or [K, N, 14]");
    const int64_t num_rows = row_gradients.size(0), count = params.num_gaussians;
    ProjectionBackwardOutputs outputs = {};
    outputs.per_view = num_rows == params.num_views;
    in.set(outputs.rows, Tensors::rows, {num_rows, count, ParameterRow::kSize});
    in.set(outputs.shN, Tensors::shN_gradients, {count, params.bands, 3});
    in.set(outputs.touched, Tensors::touched, {count});
    launch_projection_backward(params, outputs, in.stream());
}

void launches::FusedStep::run(const Arguments<FusedStep>& in) {
    const ScreenBackwardParams params = read_screen(in);
    const int64_t count = params.num_gaussians, harmonics = 3 * params.bands;
    const double beta1 = in.real(Reals::beta1), beta2 = in.real(Reals::beta2);
    OptimizerParams optimizer = {};
    optimizer.kind = static_cast<UpdateKind>(in.integer(Integers::kind));
    const auto set_rates = [&](int first, int size, Reals rate) {
        std::fill_n(optimizer.rates + first, size, in.number(rate));
    };
    set_rates(ParameterRow::kMeans, 3, Reals::means);
    set_rates(ParameterRow::kScales, 3, Reals::scales);
    set_rates(ParameterRow::kQuats, 4, Reals::quats);
    set_rates(ParameterRow::kSh0, 3, Reals::sh0);
    set_rates(ParameterRow::kOpacities, 1, Reals::opacities);
    optimizer.rate_shN = in.number(Reals::shN);
    optimizer.beta1 = static_cast<float>(beta1);
    optimizer.beta2 = static_cast<float>(beta2);
    optimizer.one_minus_beta1 = static_cast<float>(1.0 - beta1);
    optimizer.one_minus_beta2 = static_cast<float>(1.0 - beta2);
    optimizer.log_beta1 = static_cast<float>(std::log(beta1));
    optimizer.log_beta2 = static_cast<float>(std::log(beta2));
    optimizer.eps = in.number(Reals::eps);
    constexpr Integers kCopies[kMaxPeers - 1] = {Integers::copy_0, Integers::copy_1, Integers::copy_2,
                                                 Integers::copy_3, Integers::copy_4, Integers::copy_5,
                                                 Integers::copy_6};
    for (const Integers copy : kCopies) {
        const int64_t distance = in.integer(copy);
        if (distance == 0) break;
        STD_TORCH_CHECK(distance % static_cast<int64_t>(sizeof(float4)) == 0,
                        "turbogs: a copy of a model must lie a multiple of 16 bytes behind it");
        optimizer.copies[optimizer.num_copies++] = distance;
    }
    in.set(optimizer.exp_avg, Tensors::exp_avg, {count, ParameterRow::kSize});
    in.set(optimizer.exp_avg_sq, Tensors::exp_avg_sq, {count, ParameterRow::kSize});
    in.set_quads(optimizer.exp_avg_shN, Tensors::exp_avg_shN, {count, harmonics});
    in.set_quads(optimizer.exp_avg_sq_shN, Tensors::exp_avg_sq_shN, {count, harmonics});
    in.set(optimizer.steps, Tensors::steps, {count});
    in.set(optimizer.skipped, Tensors::skipped, {});
    launch_fused_step(params, optimizer, in.stream());
}

// What both directions read. Returns P.
template <class Launch>
int64_t read_exposed(const Arguments<Launch>& in, ExposedSamples& params) {
    using Tensors = typename Launch::Tensors;
    const int64_t slots = in.tensor(Tensors::colors).numel() / 3, tiles = in.tensor(Tensors::tile_ids).numel();
    const int64_t photos = in.tensor(Tensors::offsets).numel() / kExposureNumbers;
    read_views(in, ViewRow::kSize, -1, params);
    check_views(params, photos, "exposures");
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
    launch_expose_colors(params, in.stream());
}

void launches::ExposureBackward::run(const Arguments<ExposureBackward>& in) {
    ExposureBackwardParams params = {};
    const int64_t slots = read_exposed(in, params);
    in.set(params.gradients, Tensors::gradients, {slots, 3});
    in.set(params.sums, Tensors::sums, {params.num_views, 3, 4});
    launch_exposure_backward(params, in.stream());
}

void launches::ExposureStep::run(const Arguments<ExposureStep>& in) {
    ExposureStepParams params = {};
    const int64_t photos = in.tensor(Tensors::steps).numel();
    read_views(in, ViewRow::kSize, -1, params);
    check_views(params, photos, "exposures");
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
    launch_exposure_step(params, in.stream());
}

}  // namespace turbogs
