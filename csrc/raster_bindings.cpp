// The raster kernels as torch operators (turbogs::raster_*), on torch's stable ABI: one build loads on torch >= 2.10, with
// or without CUDA. Checks every tensor, then hands raw pointers and torch's current stream to the launchers in the .cu
// files. Buffers are allocated by the callers (turbogs_plugin/rendering/cuda.py).
#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>

#include <vector>

#include "binding_checks.h"
#include "raster_params.h"
#include "scene_checks.h"

namespace turbogs {
namespace {

// Slots, tiles and buffers that stages 5 and 6 have in common.
struct SampleBuffers {
    const Tensor &cameras, &tile_offsets, &pixel_ids, &tile_starts, &pair_ids, &instances;
    const std::optional<Tensor>& tile_ids;
    const Tensor &colors, &alphas, &transmittances, &last_pairs, &masks, &bucket_counts;
    const std::optional<Tensor>& depths;
    int64_t chunks;
    double alpha_min, alpha_max, transmittance_min;

    ForwardParams params(const Checker& check) const {
        ForwardParams out = {};
        const int64_t num_views = cameras.size(0), num_active = tile_offsets.numel() - 1, num_slots = pixel_ids.numel();
        STD_TORCH_CHECK(chunks > 0, "turbogs: chunks must be positive, got ", chunks);
        STD_TORCH_CHECK(pair_ids.numel() / kBucket + num_active + 1 <= masks.numel() / chunks, "turbogs: masks is too small");
        out.num_views = to_int(num_views, "views");
        out.num_active = to_int(num_active, "active tiles");
        out.chunks = to_int(chunks, "chunks");
        out.alpha_min = static_cast<float>(alpha_min);
        out.alpha_max = static_cast<float>(alpha_max);
        out.transmittance_min = static_cast<float>(transmittance_min);
        out.cameras = check.structs<RasterCamera>(cameras, "cameras", ScalarType::Float, num_views);
        out.tile_ids = check.optional<int32_t>(tile_ids, "tile_ids", ScalarType::Int, {num_active});
        out.tile_offsets = check.pointer<int32_t>(tile_offsets, "tile_offsets", ScalarType::Int, {num_active + 1});
        out.pixel_ids = check.pointer<int32_t>(pixel_ids, "pixel_ids", ScalarType::Int, {num_slots});
        out.tile_starts = check.pointer<uint32_t>(tile_starts, "tile_starts", ScalarType::Int, {num_active + 1});
        out.pair_ids = check.pointer<uint32_t>(pair_ids, "pair_ids", ScalarType::Int, {pair_ids.numel()});
        out.instances = check.structs<Instance>(instances, "instances", ScalarType::Float, instances.size(0));
        out.colors = check.pointer<float>(colors, "colors", ScalarType::Float, {num_slots, 3});
        out.alphas = check.pointer<float>(alphas, "alphas", ScalarType::Float, {num_slots});
        out.transmittances = check.pointer<float>(transmittances, "transmittances", ScalarType::Float, {num_slots});
        out.depths = check.optional<float>(depths, "depths", ScalarType::Float, {num_slots});
        out.last_pairs = check.pointer<int32_t>(last_pairs, "last_pairs", ScalarType::Int, {num_slots});
        out.masks = check.pointer<uint32_t>(masks, "masks", ScalarType::Int, {masks.numel()});
        out.bucket_counts = check.pointer<int32_t>(bucket_counts, "bucket_counts", ScalarType::Int, {num_active * chunks});
        return out;
    }
};

void raster_project(const std::vector<Tensor>& gaussians, const Tensor& viewmats, const Tensor& Ks,
                    const std::vector<int64_t>& sizes, int64_t sh_degree, double eps2d, double near_plane, double far_plane,
                    double alpha_min, const std::optional<Tensor>& tile_ids, const Tensor& cameras,
                    const std::optional<Tensor>& active_prefix, const Tensor& instances, const Tensor& radii,
                    const Tensor& tile_differences, const std::optional<Tensor>& records) {
    const Checker check(viewmats);
    ProjectionParams params = {};
    check_scene(check, gaussians, viewmats, Ks, sizes, sh_degree, eps2d, params);
    STD_TORCH_CHECK(tile_ids.has_value() == active_prefix.has_value(), "turbogs: tile_ids and active_prefix go together");
    const int64_t views = params.num_views, count = params.num_gaussians, total = views * count;
    int64_t tiles = 0;
    for (int view = 0; view < params.num_views; ++view) {
        tiles += int64_t{1} * ((params.widths[view] + kTileSize - 1) / kTileSize) *
                 ((params.heights[view] + kTileSize - 1) / kTileSize);
    }
    params.num_tiles = to_int(tiles, "tiles");
    params.num_active = to_int(tile_ids.has_value() ? tile_ids->size(0) : tiles, "active tiles");
    params.near_plane = static_cast<float>(near_plane);
    params.far_plane = static_cast<float>(far_plane);
    params.alpha_min = static_cast<float>(alpha_min);
    params.tile_ids = check.optional<int32_t>(tile_ids, "tile_ids", ScalarType::Int, {params.num_active});
    params.cameras = check.structs<RasterCamera>(cameras, "cameras", ScalarType::Float, views);
    params.active_prefix = check.optional<int32_t>(active_prefix, "active_prefix", ScalarType::Int, {tiles + 1});
    params.instances = check.structs<Instance>(instances, "instances", ScalarType::Float, total);
    params.radii = check.pointer<int2>(radii, "radii", ScalarType::Int, {views, count, 2});
    params.tile_differences =
        check.pointer<int32_t>(tile_differences, "tile_differences", ScalarType::Int, {params.num_active + 1});
    if (records.has_value()) {
        params.records = check.aligned_pointer<float4>(*records, "records", ScalarType::Float, {total, kRecordFloats});
    }
    check.launched(launch_projection(params, check.stream()), "projection");
}

void raster_count_pairs(const Tensor& tile_cursors, const Tensor& tile_starts, const Tensor& status,
                        const Tensor& counters, const Tensor& block_sums, int64_t capacity) {
    const Checker check(tile_cursors);
    const int64_t num_active = tile_starts.numel() - 1;
    STD_TORCH_CHECK(capacity >= 0 && capacity <= kMaxPairs, "turbogs: capacity must be below 2^31, got ", capacity);
    CountPairsParams params = {};
    params.num_active = to_int(num_active, "active tiles");
    params.capacity = static_cast<uint32_t>(capacity);
    params.tile_cursors = check.pointer<int32_t>(tile_cursors, "tile_cursors", ScalarType::Int, {num_active + 1});
    params.tile_starts = check.pointer<uint32_t>(tile_starts, "tile_starts", ScalarType::Int, {num_active + 1});
    params.status = check.pointer<uint32_t>(status, "status", ScalarType::Int, {2});
    params.counters = check.pointer<PairCounters>(counters, "counters", ScalarType::Int, {2});
    params.block_sums = check.pointer<int64_t>(block_sums, "block_sums", ScalarType::Long,
                                               {num_active > 0 ? (num_active + kScanTiles - 1) / kScanTiles : 1, 2});
    check.launched(launch_count_pairs(params, check.stream()), "pair count");
}

void raster_sort_pairs(const Tensor& instances, const Tensor& radii, const Tensor& cameras,
                       const std::optional<Tensor>& active_prefix, const Tensor& tile_cursors, const Tensor& tile_starts,
                       const Tensor& status, const Tensor& pair_keys, const Tensor& pair_ids, const Tensor& counters,
                       const Tensor& runs) {
    const Checker check(instances);
    const int64_t views = radii.size(0), count = radii.size(1), total = views * count, capacity = pair_ids.numel();
    const int64_t num_active = tile_starts.numel() - 1;
    ScatterPairsParams scatter = {};
    scatter.num_instances = to_int(total, "views * Gaussians");
    scatter.num_gaussians = to_int(count, "Gaussians");
    scatter.num_active = to_int(num_active, "active tiles");
    scatter.capacity = static_cast<uint32_t>(capacity);
    scatter.instances = check.structs<Instance>(instances, "instances", ScalarType::Float, total);
    scatter.radii = check.pointer<int2>(radii, "radii", ScalarType::Int, {views, count, 2});
    scatter.cameras = check.structs<RasterCamera>(cameras, "cameras", ScalarType::Float, views);
    if (active_prefix.has_value()) {
        scatter.active_prefix =
            check.pointer<int32_t>(*active_prefix, "active_prefix", ScalarType::Int, {active_prefix->numel()});
    }
    scatter.tile_cursors = check.pointer<int32_t>(tile_cursors, "tile_cursors", ScalarType::Int, {num_active + 1});
    scatter.tile_starts = check.pointer<uint32_t>(tile_starts, "tile_starts", ScalarType::Int, {num_active + 1});
    scatter.status = check.pointer<uint32_t>(status, "status", ScalarType::Int, {2});
    scatter.pair_keys = check.pointer<uint64_t>(pair_keys, "pair_keys", ScalarType::Long, {capacity});
    scatter.counters = check.pointer<PairCounters>(counters, "counters", ScalarType::Int, {2});
    scatter.runs = check.pointer<int2>(runs, "runs", ScalarType::Int, {capacity / (kRun / 2), 2});
    SortPairsParams sort = {};
    sort.num_active = scatter.num_active;
    sort.capacity = scatter.capacity;
    sort.tile_starts = scatter.tile_starts;
    sort.counters = scatter.counters;
    sort.runs = scatter.runs;
    sort.pair_keys = scatter.pair_keys;
    sort.pair_ids = check.aligned_pointer<uint32_t>(pair_ids, "pair_ids", ScalarType::Int, {capacity});
    scatter.windows = reinterpret_cast<uint2*>(sort.pair_ids);  // free until the pairs are sorted
    check.launched(launch_scatter_pairs(scatter, check.stream()), "pair scatter");
    check.launched(launch_sort_pairs(sort, check.stream()), "pair sort");
}

void raster_forward(const Tensor& cameras, const std::optional<Tensor>& tile_ids, const Tensor& tile_offsets,
                    const Tensor& pixel_ids, const Tensor& tile_starts, const Tensor& pair_ids, const Tensor& instances,
                    const Tensor& colors, const Tensor& alphas, const Tensor& transmittances,
                    const std::optional<Tensor>& depths, const Tensor& last_pairs, const Tensor& masks,
                    const Tensor& bucket_counts, int64_t chunks, double alpha_min, double alpha_max,
                    double transmittance_min) {
    const SampleBuffers buffers{cameras, tile_offsets, pixel_ids, tile_starts, pair_ids, instances, tile_ids,
                                colors, alphas, transmittances, last_pairs, masks, bucket_counts, depths,
                                chunks, alpha_min, alpha_max, transmittance_min};
    const Checker check(cameras);
    check.launched(launch_rasterize_forward(buffers.params(check), check.stream()), "forward");
}

void raster_backward(const Tensor& cameras, const std::optional<Tensor>& tile_ids, const Tensor& tile_offsets,
                     const Tensor& pixel_ids, const Tensor& tile_starts, const Tensor& pair_ids, const Tensor& instances,
                     const Tensor& colors, const Tensor& alphas, const Tensor& transmittances,
                     const std::optional<Tensor>& depths, const Tensor& last_pairs, const Tensor& masks,
                     const Tensor& bucket_counts, int64_t chunks, double alpha_min, double alpha_max,
                     double transmittance_min, const Tensor& color_gradients,
                     const std::optional<Tensor>& alpha_gradients, const std::optional<Tensor>& depth_gradients,
                     const std::optional<Tensor>& pixel_errors, const Tensor& screen_gradients, bool with_density_sums,
                     bool cleared) {
    const SampleBuffers buffers{cameras, tile_offsets, pixel_ids, tile_starts, pair_ids, instances, tile_ids,
                                colors, alphas, transmittances, last_pairs, masks, bucket_counts, depths,
                                chunks, alpha_min, alpha_max, transmittance_min};
    const Checker check(cameras);
    const int64_t num_slots = pixel_ids.numel(), total = instances.size(0);
    STD_TORCH_CHECK(!depth_gradients.has_value() || depths.has_value(), "turbogs: depth gradients without depths");
    BackwardParams params = {};
    params.forward = buffers.params(check);
    params.num_instances = to_int(total, "views * Gaussians");
    params.with_density_sums = with_density_sums;
    params.cleared = cleared;
    params.color_gradients = check.pointer<float>(color_gradients, "color_gradients", ScalarType::Float, {num_slots, 3});
    params.alpha_gradients = check.optional<float>(alpha_gradients, "alpha_gradients", ScalarType::Float, {num_slots});
    params.depth_gradients = check.optional<float>(depth_gradients, "depth_gradients", ScalarType::Float, {num_slots});
    params.pixel_errors = check.optional<float>(pixel_errors, "pixel_errors", ScalarType::Float, {num_slots});
    params.screen_gradients =
        check.aligned_pointer<float>(screen_gradients, "screen_gradients", ScalarType::Float, {total, kRecordFloats});
    check.launched(launch_rasterize_backward(params, check.stream()), "backward");
}

}  // namespace
}  // namespace turbogs

STABLE_TORCH_LIBRARY_FRAGMENT(turbogs, m) {
    m.def(
        "raster_project(Tensor[] gaussians, Tensor viewmats, Tensor Ks, int[] sizes, int sh_degree, float eps2d, "
        "float near_plane, float far_plane, float alpha_min, Tensor? tile_ids, Tensor(a!) cameras, "
        "Tensor(b!)? active_prefix, Tensor(c!) instances, Tensor(d!) radii, Tensor(e!) tile_differences, "
        "Tensor(f!)? records) -> ()");
    m.def(
        "raster_count_pairs(Tensor(a!) tile_cursors, Tensor(b!) tile_starts, Tensor(c!) status, Tensor(d!) counters, "
        "Tensor(e!) block_sums, int capacity) -> ()");
    m.def(
        "raster_sort_pairs(Tensor instances, Tensor radii, Tensor cameras, Tensor? active_prefix, Tensor(a!) tile_cursors, "
        "Tensor tile_starts, Tensor status, Tensor(b!) pair_keys, Tensor(c!) pair_ids, Tensor(d!) counters, "
        "Tensor(e!) runs) -> ()");
    m.def(
        "raster_forward(Tensor cameras, Tensor? tile_ids, Tensor tile_offsets, Tensor pixel_ids, Tensor tile_starts, "
        "Tensor pair_ids, Tensor instances, Tensor(a!) colors, Tensor(b!) alphas, Tensor(c!) transmittances, "
        "Tensor(d!)? depths, Tensor(e!) last_pairs, Tensor(f!) masks, Tensor(g!) bucket_counts, int chunks, "
        "float alpha_min, float alpha_max, float transmittance_min) -> ()");
    m.def(
        "raster_backward(Tensor cameras, Tensor? tile_ids, Tensor tile_offsets, Tensor pixel_ids, Tensor tile_starts, "
        "Tensor pair_ids, Tensor instances, Tensor colors, Tensor alphas, Tensor transmittances, Tensor? depths, "
        "Tensor last_pairs, Tensor masks, Tensor bucket_counts, int chunks, float alpha_min, "
        "float alpha_max, float transmittance_min, Tensor color_gradients, Tensor? alpha_gradients, "
        "Tensor? depth_gradients, Tensor? pixel_errors, Tensor(a!) screen_gradients, bool with_density_sums, "
        "bool cleared) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(turbogs, CUDA, m) {
    m.impl("raster_project", TORCH_BOX(&turbogs::raster_project));
    m.impl("raster_count_pairs", TORCH_BOX(&turbogs::raster_count_pairs));
    m.impl("raster_sort_pairs", TORCH_BOX(&turbogs::raster_sort_pairs));
    m.impl("raster_forward", TORCH_BOX(&turbogs::raster_forward));
    m.impl("raster_backward", TORCH_BOX(&turbogs::raster_backward));
}
