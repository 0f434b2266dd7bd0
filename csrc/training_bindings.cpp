// The training kernels as torch operators, on the stable ABI. Tensors become checked pointers here; outputs are made by
// the caller. Every launch goes to torch's current stream of the tensors' device.
#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <optional>
#include <vector>

#include "binding_checks.h"
#include "scene_checks.h"
#include "training_params.h"

namespace turbogs {
namespace {

// The batch that a backward pass works on: what `CudaScreenGradients` of rendering/cuda.py holds.
ScreenBackwardParams screen_backward_params(const Checker& check, const std::vector<Tensor>& gaussians,
                                            const Tensor& viewmats, const Tensor& Ks, const std::vector<int64_t>& sizes,
                                            const Tensor& records, const Tensor& radii,
                                            const std::vector<Tensor>& stats, int64_t sh_degree, double eps2d,
                                            const std::optional<Tensor>& num_filled, int64_t num_slots,
                                            const std::optional<Tensor>& overflow) {
    ScreenBackwardParams params = {};
    check_scene(check, gaussians, viewmats, Ks, sizes, sh_degree, eps2d, params);
    STD_TORCH_CHECK(params.bands <= kMaxBands, "turbogs: shN holds ", params.bands, " bands, more than ", kMaxBands);
    const int64_t num_views = params.num_views, num_gaussians = params.num_gaussians;
    params.records = check.aligned_pointer<float4>(records, "screen gradients", ScalarType::Float,
                                                   {num_views, num_gaussians, kRecordFloats});
    params.radii = check.aligned_pointer<int2>(radii, "radii", ScalarType::Int, {num_views, num_gaussians, 2});
    params.num_filled = check.optional<int32_t>(num_filled, "num_filled", ScalarType::Int, {1});
    params.num_slots = to_int(num_slots, "samples");
    params.overflow = check.optional<int32_t>(overflow, "overflow", ScalarType::Int, {1});
    if (!stats.empty()) {
        STD_TORCH_CHECK(stats.size() == 7, "turbogs: stats must be the seven tensors of GaussianStats");
        params.error_sums = check.pointer<float>(stats[0], "error_sums", ScalarType::Float, {num_gaussians});
        params.distance_sums = check.pointer<float>(stats[1], "distance_sums", ScalarType::Float, {num_gaussians});
        params.weight_sums = check.pointer<float>(stats[2], "weight_sums", ScalarType::Float, {num_gaussians});
        params.grad_sums = check.pointer<float>(stats[3], "grad_sums", ScalarType::Float, {num_gaussians});
        params.absgrad_sums = check.pointer<float>(stats[4], "absgrad_sums", ScalarType::Float, {num_gaussians});
        params.view_counts = check.pointer<float>(stats[5], "view_counts", ScalarType::Float, {num_gaussians});
        params.max_radii = check.pointer<float>(stats[6], "max_radii", ScalarType::Float, {num_gaussians});
    }
    return params;
}

void projection_backward(const std::vector<Tensor>& gaussians, const Tensor& viewmats, const Tensor& Ks,
                         const std::vector<int64_t>& sizes, const Tensor& records, const Tensor& radii,
                         const std::vector<Tensor>& stats, int64_t sh_degree, double eps2d,
                         const std::optional<Tensor>& num_filled, int64_t num_slots, const std::optional<Tensor>& overflow,
                         const Tensor& rows, const Tensor& shN, const Tensor& touched, const Tensor& view_losses) {
    const Checker check(records);
    const ScreenBackwardParams params = screen_backward_params(check, gaussians, viewmats, Ks, sizes, records, radii, stats,
                                                               sh_degree, eps2d, num_filled, num_slots, overflow);
    STD_TORCH_CHECK(rows.dim() == 3 && (rows.size(0) == 1 || rows.size(0) == params.num_views),
                    "turbogs: rows must be [1, N, 14] or [K, N, 14]");
    const int64_t num_rows = rows.size(0), count = params.num_gaussians;
    ProjectionBackwardOutputs outputs = {};
    outputs.per_view = num_rows == params.num_views;
    outputs.rows = check.pointer<float>(rows, "rows", ScalarType::Float, {num_rows, count, kRowSize});
    outputs.shN = check.pointer<float>(shN, "shN's gradient", ScalarType::Float, {count, params.bands, 3});
    outputs.touched = check.pointer<bool>(touched, "touched", ScalarType::Bool, {count});
    outputs.view_losses = check.pointer<float>(view_losses, "view_losses", ScalarType::Float, {num_rows, count});
    check.launched(launch_projection_backward(params, outputs, check.stream()), "projection backward");
}

void fused_step(const std::vector<Tensor>& gaussians, const Tensor& viewmats, const Tensor& Ks,
                const std::vector<int64_t>& sizes, const Tensor& records, const Tensor& radii,
                const std::vector<Tensor>& stats, int64_t sh_degree, double eps2d,
                const std::optional<Tensor>& num_filled, int64_t num_slots, const std::optional<Tensor>& overflow,
                const std::vector<Tensor>& moments, int64_t kind, bool rows_per_view,
                const std::vector<double>& rates, double beta1, double beta2, double eps,
                double curvature, double max_step) {
    const Checker check(records);
    const ScreenBackwardParams params = screen_backward_params(check, gaussians, viewmats, Ks, sizes, records, radii, stats,
                                                               sh_degree, eps2d, num_filled, num_slots, overflow);
    STD_TORCH_CHECK(moments.size() == 6, "turbogs: moments must be the six tensors of GaussianMoments");
    STD_TORCH_CHECK(rates.size() == 6, "turbogs: rates must be of means, quats, scales, opacities, sh0, shN");
    STD_TORCH_CHECK(kind >= 0 && kind <= 2, "turbogs: kind must be 0 (Adam), 1 (balanced LM) or 2 (paper's LM)");
    const int64_t count = params.num_gaussians, harmonics = 3 * params.bands;
    OptimizerParams optimizer = {};
    optimizer.kind = static_cast<StepKind>(kind);
    optimizer.rows_per_view = rows_per_view;
    const double row_rates[kRowSize] = {rates[0], rates[0], rates[0], rates[2], rates[2], rates[2], rates[1],
                                        rates[1], rates[1], rates[1], rates[4], rates[4], rates[4], rates[3]};
    for (int i = 0; i < kRowSize; ++i) {
        optimizer.rates[i] = static_cast<float>(row_rates[i]);
        optimizer.inverse_rates[i] = 1.0f / std::max(optimizer.rates[i], kRateMin);
    }
    optimizer.rate_shN = static_cast<float>(rates[5]);
    optimizer.beta1 = static_cast<float>(beta1);
    optimizer.beta2 = static_cast<float>(beta2);
    optimizer.one_minus_beta1 = static_cast<float>(1.0 - beta1);
    optimizer.one_minus_beta2 = static_cast<float>(1.0 - beta2);
    optimizer.log_beta1 = static_cast<float>(std::log(beta1));
    optimizer.log_beta2 = static_cast<float>(std::log(beta2));
    optimizer.eps = static_cast<float>(eps);
    optimizer.curvature = static_cast<float>(curvature);
    optimizer.max_step = static_cast<float>(max_step);
    optimizer.means = const_cast<float*>(params.means);
    optimizer.quats = const_cast<float*>(params.quats);
    optimizer.scales = const_cast<float*>(params.scales);
    optimizer.opacities = const_cast<float*>(params.opacities);
    optimizer.sh0 = const_cast<float*>(params.sh0);
    optimizer.shN = const_cast<float*>(params.shN);
    optimizer.exp_avg = check.aligned_pointer<float>(moments[0], "exp_avg", ScalarType::Float, {count, kRowSize});
    optimizer.exp_avg_sq = check.aligned_pointer<float>(moments[1], "exp_avg_sq", ScalarType::Float, {count, kRowSize});
    optimizer.exp_avg_shN = check.aligned_pointer<float>(moments[2], "exp_avg_shN", ScalarType::Float, {count, harmonics});
    optimizer.exp_avg_sq_shN =
        check.aligned_pointer<float>(moments[3], "exp_avg_sq_shN", ScalarType::Float, {count, harmonics});
    optimizer.steps = check.pointer<int32_t>(moments[4], "steps", ScalarType::Int, {count});
    optimizer.skipped =
        check.pointer<unsigned long long>(moments[5], "skipped", ScalarType::Long, {});
    check.launched(launch_fused_step(params, optimizer, check.stream()), "fused step");
}

// `views` holds six numbers for each view: first flat pixel, width, height, number of the training view, first slot (or
// chosen tile), tiles to choose; see `_view_table` in training_kernels.py.
constexpr int64_t kViewFields = 6;

struct ViewTable {
    SampleView views[kMaxViews] = {};
    int num_views = 0;
    int num_tiles = 0;
};

ViewTable view_table(const std::vector<int64_t>& fields) {
    ViewTable table;
    const int64_t count = static_cast<int64_t>(fields.size()) / kViewFields;
    STD_TORCH_CHECK(count >= 1 && count <= kMaxViews, "turbogs: a batch has 1 to ", kMaxViews,
                    " views, not ", count);
    table.num_views = static_cast<int>(count);
    for (int i = 0; i < table.num_views; ++i) {
        const int64_t* field = fields.data() + i * kViewFields;
        SampleView& view = table.views[i];
        const int64_t width = field[1], height = field[2];
        check_size(i, width, height);
        view.pixel_base = field[0];
        view.width = static_cast<int>(width);
        view.height = static_cast<int>(height);
        view.view_number = to_int(field[3], "view number");
        view.slot_base = to_int(field[4], "first slot");
        view.wanted = to_int(field[5], "tiles to choose");
        view.tiles_x = (view.width + kTileSize - 1) / kTileSize;
        view.tiles_y = (view.height + kTileSize - 1) / kTileSize;
        view.tile_base = table.num_tiles;
        table.num_tiles += view.tiles_x * view.tiles_y;
    }
    return table;
}

void sample_pixels(const Tensor& errors, const Tensor& stamps, const std::vector<int64_t>& views, int64_t unit,
                   const std::vector<int64_t>& stages, int64_t slots_per_tile, bool mixed_uniform, double importance,
                   int64_t seed, int64_t iteration, int64_t now, const Tensor& pixel_ids, const Tensor& tile_ids,
                   const Tensor& tile_offsets, const std::optional<Tensor>& weights, const std::vector<Tensor>& scratch) {
    const Checker check(errors);
    const ViewTable table = view_table(views);
    const int64_t pixels = errors.numel(), slots = pixel_ids.numel(), tiles = tile_ids.numel();
    SamplePixelsParams params = {};
    STD_TORCH_CHECK(unit >= 0 && unit <= 2, "turbogs: unit must be 0 (pixel), 1 (cell) or 2 (tile)");
    params.unit = static_cast<SampleUnit>(unit);
    const bool by_tile = params.unit == SampleUnit::kTile;
    const size_t stage_rows = by_tile ? static_cast<size_t>(table.num_views) : 1;
    STD_TORCH_CHECK(stages.size() == 3 * stage_rows, "turbogs: stages must hold ", 3 * stage_rows, " numbers");
    STD_TORCH_CHECK(by_tile || tiles == table.num_tiles, "turbogs: tile_ids must have an entry for each tile");
    params.num_views = table.num_views;
    params.num_tiles = table.num_tiles;
    params.num_chosen = to_int(tiles, "tiles");
    for (int i = 0; i < table.num_views; ++i) {
        params.views[i] = table.views[i];
        const SampleView& view = table.views[i];
        STD_TORCH_CHECK(view.pixel_base >= 0 && view.pixel_base + int64_t{1} * view.width * view.height <= pixels,
                        "turbogs: view ", view.view_number, " lies outside the maps");
    }
    for (size_t i = 0; i < stages.size(); ++i) params.stages[i / 3][i % 3] = static_cast<int>(stages[i]);
    params.slots_per_tile = static_cast<int>(slots_per_tile);
    params.mixed_uniform = mixed_uniform;
    params.importance = static_cast<float>(importance);
    params.seed_high = static_cast<uint32_t>(static_cast<uint64_t>(seed) >> 32);
    for (uint32_t round = 0; round < 10; ++round) {
        params.round_keys[round][0] = static_cast<uint32_t>(seed) + round * 0x9E3779B9u;
        params.round_keys[round][1] = static_cast<uint32_t>(iteration) + round * 0xBB67AE85u;
    }
    params.now = static_cast<int>(now);
    params.errors = check.pointer<void>(errors, "errors", ScalarType::Half, {pixels});
    params.stamps = check.pointer<int16_t>(stamps, "stamps", ScalarType::Short, {pixels});
    params.pixel_ids = check.pointer<int32_t>(pixel_ids, "pixel_ids", ScalarType::Int, {slots});
    params.tile_ids = check.pointer<int32_t>(tile_ids, "tile_ids", ScalarType::Int, {tiles});
    params.tile_offsets = check.pointer<int32_t>(tile_offsets, "tile_offsets", ScalarType::Int, {tiles + 1});
    params.weights = check.optional<float>(weights, "weights", ScalarType::Float, {slots});
    if (by_tile) {
        STD_TORCH_CHECK(scratch.size() == 4, "turbogs: unit tile needs four scratch tensors");
        params.tile_errors = check.pointer<double>(scratch[0], "tile_errors", ScalarType::Double, {table.num_tiles});
        params.tile_ages = check.pointer<int32_t>(scratch[1], "tile_ages", ScalarType::Int, {table.num_tiles});
        params.tile_keys = check.pointer<int64_t>(scratch[2], "tile_keys", ScalarType::Long, {table.num_tiles});
        params.tile_missed = check.pointer<float>(scratch[3], "tile_missed", ScalarType::Float, {table.num_tiles});
    }
    check.launched(launch_sample_pixels(params, check.stream()), "pixel sampler");
}

void count_filled(const Tensor& pixel_ids, const Tensor& num_filled) {
    const Checker check(pixel_ids);
    CountFilledParams params = {};
    params.num_slots = to_int(pixel_ids.numel(), "samples");
    params.pixel_ids = check.pointer<int32_t>(pixel_ids, "pixel_ids", ScalarType::Int, {params.num_slots});
    params.num_filled = check.pointer<int32_t>(num_filled, "num_filled", ScalarType::Int, {1});
    check.launched(launch_count_filled(params, check.stream()), "count of samples");
}

void sparse_loss(const Tensor& colors, const std::optional<Tensor>& targets, const std::optional<Tensor>& photos,
                 const Tensor& pixel_ids, const Tensor& tile_ids, const Tensor& tile_offsets,
                 const std::optional<Tensor>& weights, const std::vector<int64_t>& views, int64_t structure, double epsilon,
                 double l1_weight, double structure_weight, double variance_constant, bool balance, bool gate,
                 const std::vector<Tensor>& maps, double beta, int64_t stamp, const std::optional<Tensor>& num_filled,
                 const Tensor& loss, const Tensor& color_gradients, const Tensor& pixel_errors,
                 const std::optional<Tensor>& num_nonfinite,
                 const std::optional<Tensor>& nonfinite_losses, const std::optional<Tensor>& overflow) {
    const Checker check(colors);
    const ViewTable table = view_table(views);
    const int64_t slots = pixel_ids.numel(), tiles = tile_ids.numel();
    SparseLossParams params = {};
    STD_TORCH_CHECK(structure >= 0 && structure <= 3,
                    "turbogs: structure must be 0 (none), 1 (ncc), 2 (contrast) or 3 (ssim)");
    STD_TORCH_CHECK(targets.has_value() != photos.has_value(), "turbogs: give either targets or photos");
    params.num_views = table.num_views;
    for (int i = 0; i < table.num_views; ++i) params.views[i] = table.views[i];
    params.num_tiles = to_int(tiles, "tiles");
    params.num_slots = to_int(slots, "samples");
    params.structure = static_cast<Structure>(structure);
    params.epsilon = static_cast<float>(epsilon);
    params.l1_weight = static_cast<float>(l1_weight);
    params.structure_weight = static_cast<float>(structure_weight);
    params.variance_constant = static_cast<float>(variance_constant);
    params.balance = balance;
    params.gate = gate;
    params.tile_ids = check.pointer<int32_t>(tile_ids, "tile_ids", ScalarType::Int, {tiles});
    params.tile_offsets = check.pointer<int32_t>(tile_offsets, "tile_offsets", ScalarType::Int, {tiles + 1});
    params.pixel_ids = check.pointer<int32_t>(pixel_ids, "pixel_ids", ScalarType::Int, {slots});
    params.weights = check.optional<float>(weights, "weights", ScalarType::Float, {slots});
    params.colors = check.pointer<float>(colors, "colors", ScalarType::Float, {slots, 3});
    params.targets = check.optional<float>(targets, "targets", ScalarType::Float, {slots, 3});
    int64_t pixels = -1;
    if (photos.has_value()) {
        pixels = photos->numel() / 3;
        params.photos = check.pointer<uint8_t>(*photos, "photos", ScalarType::Byte, {pixels, 3});
    }
    if (!maps.empty()) {
        STD_TORCH_CHECK(maps.size() == 3, "turbogs: maps must be errors, stamps, view_sums");
        const int64_t map_pixels = maps[0].numel();
        STD_TORCH_CHECK(pixels < 0 || pixels == map_pixels, "turbogs: photos and maps must be of the same pixels");
        pixels = map_pixels;
        params.errors = check.pointer<void>(maps[0], "errors", ScalarType::Half, {pixels});
        params.stamps = check.pointer<int16_t>(maps[1], "stamps", ScalarType::Short, {pixels});
        params.view_sums = check.pointer<double>(maps[2], "view_sums", ScalarType::Double, {maps[2].numel()});
        params.ema_old = static_cast<float>(1.0 - beta);
        params.ema_new = static_cast<float>(beta);
        params.stamp = static_cast<int16_t>(stamp);
    }
    for (int i = 0; pixels >= 0 && i < table.num_views; ++i) {
        const SampleView& view = table.views[i];
        STD_TORCH_CHECK(view.pixel_base >= 0 && view.pixel_base + int64_t{1} * view.width * view.height <= pixels &&
                            (maps.empty() || view.view_number < maps[2].numel()),
                        "turbogs: view ", view.view_number, " lies outside the photos or maps");
    }
    params.num_filled = check.optional<int32_t>(num_filled, "num_filled", ScalarType::Int, {1});
    params.loss = check.pointer<double>(loss, "loss", ScalarType::Double, {});
    params.color_gradients = check.pointer<float>(color_gradients, "color_gradients", ScalarType::Float, {slots, 3});
    params.pixel_errors = check.pointer<float>(pixel_errors, "pixel_errors", ScalarType::Float, {slots});
    params.num_nonfinite =
        check.optional<unsigned long long>(num_nonfinite, "num_nonfinite", ScalarType::Long, {});
    params.nonfinite_losses = check.optional<unsigned long long>(nonfinite_losses, "nonfinite_losses", ScalarType::Long, {});
    params.overflow = check.optional<int32_t>(overflow, "overflow", ScalarType::Int, {1});
    check.launched(launch_sparse_loss(params, check.stream()), "sparse loss");
}

}  // namespace
}  // namespace turbogs

#define TURBOGS_BACKWARD_INPUTS                                                                                     \
    "Tensor(p!)[] gaussians, Tensor viewmats, Tensor Ks, int[] sizes, Tensor(r!) records, Tensor radii, "           \
    "Tensor(s!)[] stats, int sh_degree, float eps2d, Tensor? num_filled, int num_slots, Tensor? overflow, "

STABLE_TORCH_LIBRARY_FRAGMENT(turbogs, m) {
    m.def("projection_backward(" TURBOGS_BACKWARD_INPUTS
          "Tensor(a!) rows, Tensor(b!) shN, Tensor(c!) touched, Tensor(d!) view_losses) -> ()");
    m.def("fused_step(" TURBOGS_BACKWARD_INPUTS
          "Tensor(m!)[] moments, int kind, bool rows_per_view, float[] rates, float beta1, float beta2, float eps, "
          "float curvature, float max_step) -> ()");
    m.def(
        "sample_pixels(Tensor errors, Tensor stamps, int[] views, int unit, int[] stages, int slots_per_tile, "
        "bool mixed_uniform, float importance, int seed, int iteration, int now, Tensor(a!) pixel_ids, "
        "Tensor(b!) tile_ids, Tensor(c!) tile_offsets, Tensor(d!)? weights, Tensor(e!)[] scratch) -> ()");
    m.def("count_filled(Tensor pixel_ids, Tensor(a!) num_filled) -> ()");
    m.def(
        "sparse_loss(Tensor colors, Tensor? targets, Tensor? photos, Tensor pixel_ids, Tensor tile_ids, "
        "Tensor tile_offsets, Tensor? weights, int[] views, int structure, float epsilon, float l1_weight, "
        "float structure_weight, float variance_constant, bool balance, bool gate, Tensor(a!)[] maps, float beta, "
        "int stamp, Tensor? num_filled, Tensor(c!) loss, Tensor(d!) color_gradients, Tensor(e!) pixel_errors, "
        "Tensor(f!)? num_nonfinite, Tensor(g!)? nonfinite_losses, Tensor? overflow) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(turbogs, CUDA, m) {
    m.impl("projection_backward", TORCH_BOX(&turbogs::projection_backward));
    m.impl("fused_step", TORCH_BOX(&turbogs::fused_step));
    m.impl("sample_pixels", TORCH_BOX(&turbogs::sample_pixels));
    m.impl("count_filled", TORCH_BOX(&turbogs::count_filled));
    m.impl("sparse_loss", TORCH_BOX(&turbogs::sparse_loss));
}
