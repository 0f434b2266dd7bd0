// The raster kernels as torch operators (turbogs::raster_*), on torch's stable ABI: one build loads on torch 2.10 and
// later, with or without CUDA. Each operator checks its tensors, then hands raw pointers and torch's current stream
// to the launchers in csrc/raster. Buffers are made by the caller (turbogs_plugin/engine/cuda/raster.py).
#include "bindings/arguments.h"
#include "bindings/scene.h"
#include "raster/raster_params.h"

namespace turbogs {
namespace {

void raster_project(const TensorList& tensors, const IntegerList& integers, const RealList& reals,
                    const IntegerList& rows) {
    using Launch = launches::RasterProject;
    using T = Launch::Tensors;
    const Arguments<Launch> in(tensors, integers, reals, rows, T::viewmats);
    ProjectionParams params = {};
    read_scene(in, params);
    const bool everywhere = !in.has(T::tile_ids);
    STD_TORCH_CHECK(everywhere == !in.has(T::active_prefix), "turbogs: tile_ids and active_prefix go together");
    const int64_t views = params.num_views, count = params.num_gaussians, total = views * count;
    int64_t tiles = 0;
    for (int view = 0; view < params.num_views; ++view) {
        tiles += int64_t{1} * tiles_along(params.widths[view]) * tiles_along(params.heights[view]);
    }
    params.num_tiles = to_int(tiles, "tiles");
    params.num_active = to_int(everywhere ? tiles : in.tensor(T::tile_ids).size(0), "active tiles");
    params.near_plane = in.number(Launch::Reals::near_plane);
    params.far_plane = in.number(Launch::Reals::far_plane);
    params.alpha_min = in.number(Launch::Reals::alpha_min);
    params.tile_ids = in.optional<int32_t>(T::tile_ids, ScalarType::Int, {params.num_active});
    params.cameras = in.structs<RasterCamera>(T::cameras, views);
    params.active_prefix = in.optional<int32_t>(T::active_prefix, ScalarType::Int, {tiles + 1});
    params.instances = in.structs<Instance>(T::instances, total);
    params.radii = in.pointer<int2>(T::radii, ScalarType::Int, {views, count, 2});
    params.tile_differences = in.pointer<int32_t>(T::tile_cursors, ScalarType::Int, {params.num_active + 1});
    params.records = in.optional_aligned<float4>(T::records, ScalarType::Float, {total, ScreenRecord::kSize});
    check_launched(launch_projection(params, in.stream()), "projection");
}

void raster_count_intersections(const TensorList& tensors, const IntegerList& integers, const RealList& reals,
                                const IntegerList& rows) {
    using Launch = launches::RasterCountIntersections;
    using T = Launch::Tensors;
    const Arguments<Launch> in(tensors, integers, reals, rows, T::tile_cursors);
    const int64_t num_active = in.tensor(T::tile_starts).numel() - 1, capacity = in.integer(Launch::Integers::capacity);
    STD_TORCH_CHECK(capacity >= 0 && capacity <= kIntersectionsMax, "turbogs: capacity must be below 2^31, got ",
                    capacity);
    CountIntersectionsParams params = {};
    params.num_active = to_int(num_active, "active tiles");
    params.capacity = static_cast<uint32_t>(capacity);
    params.tile_cursors = in.pointer<int32_t>(T::tile_cursors, ScalarType::Int, {num_active + 1});
    params.tile_starts = in.pointer<uint32_t>(T::tile_starts, ScalarType::Int, {num_active + 1});
    params.status = in.pointer<uint32_t>(T::status, ScalarType::Int, {2});
    params.counters = in.pointer<IntersectionCounters>(T::counters, ScalarType::Int, {2});
    const int64_t blocks = num_active > 0 ? blocks_for(params.num_active, kScanTiles) : 1;
    params.block_sums = in.pointer<int64_t>(T::block_sums, ScalarType::Long, {blocks, 2});
    check_launched(launch_count_intersections(params, in.stream()), "count of intersections");
}

void raster_sort_intersections(const TensorList& tensors, const IntegerList& integers, const RealList& reals,
                               const IntegerList& rows) {
    using Launch = launches::RasterSortIntersections;
    using T = Launch::Tensors;
    const Arguments<Launch> in(tensors, integers, reals, rows, T::instances);
    const int64_t views = in.tensor(T::radii).size(0), count = in.tensor(T::radii).size(1), total = views * count;
    const int64_t capacity = in.tensor(T::intersection_ids).numel(), num_active = in.tensor(T::tile_starts).numel() - 1;
    ScatterIntersectionsParams scatter = {};
    scatter.num_instances = to_int(total, "views * Gaussians");
    scatter.num_gaussians = to_int(count, "Gaussians");
    scatter.num_active = to_int(num_active, "active tiles");
    scatter.capacity = static_cast<uint32_t>(capacity);
    scatter.instances = in.structs<Instance>(T::instances, total);
    scatter.radii = in.pointer<int2>(T::radii, ScalarType::Int, {views, count, 2});
    scatter.cameras = in.structs<RasterCamera>(T::cameras, views);
    if (in.has(T::active_prefix)) {
        const int64_t length = in.tensor(T::active_prefix).numel();
        scatter.active_prefix = in.pointer<int32_t>(T::active_prefix, ScalarType::Int, {length});
    }
    scatter.tile_cursors = in.pointer<int32_t>(T::tile_cursors, ScalarType::Int, {num_active + 1});
    scatter.tile_starts = in.pointer<uint32_t>(T::tile_starts, ScalarType::Int, {num_active + 1});
    scatter.status = in.pointer<uint32_t>(T::status, ScalarType::Int, {2});
    scatter.intersection_keys = in.pointer<uint64_t>(T::intersection_keys, ScalarType::Long, {capacity});
    scatter.counters = in.pointer<IntersectionCounters>(T::counters, ScalarType::Int, {2});
    scatter.runs = in.pointer<int2>(T::runs, ScalarType::Int, {capacity / kLeastOfRun, 2});
    SortIntersectionsParams sort = {};
    sort.num_active = scatter.num_active;
    sort.capacity = scatter.capacity;
    sort.tile_starts = scatter.tile_starts;
    sort.counters = scatter.counters;
    sort.runs = scatter.runs;
    sort.intersection_keys = scatter.intersection_keys;
    sort.intersection_ids = in.aligned_pointer<uint32_t>(T::intersection_ids, ScalarType::Int, {capacity});
    scatter.windows = reinterpret_cast<uint2*>(sort.intersection_ids);  // free until the keys are sorted
    check_launched(launch_scatter_intersections(scatter, in.stream()), "scatter of intersections");
    check_launched(launch_sort_intersections(sort, in.stream()), "sort of intersections");
}

// What stages 5 and 6 have in common. `Launch` has the fields of launches.py's `RasterForward`.
template <class Launch>
ForwardParams read_forward(const Arguments<Launch>& in) {
    using T = typename Launch::Tensors;
    using R = typename Launch::Reals;
    ForwardParams out = {};
    const int64_t num_views = in.tensor(T::cameras).size(0), num_active = in.tensor(T::tile_offsets).numel() - 1;
    const int64_t num_slots = in.tensor(T::pixel_ids).numel(), capacity = in.tensor(T::intersection_ids).numel();
    const int64_t num_masks = in.tensor(T::masks).numel(), chunks = in.integer(Launch::Integers::chunks);
    STD_TORCH_CHECK(chunks > 0, "turbogs: chunks must be positive, got ", chunks);
    STD_TORCH_CHECK(capacity / kBucket + num_active + 1 <= num_masks / chunks, "turbogs: masks is too small");
    out.num_views = to_int(num_views, "views");
    out.num_active = to_int(num_active, "active tiles");
    out.chunks = to_int(chunks, "chunks");
    out.alpha_min = in.number(R::alpha_min);
    out.alpha_max = in.number(R::alpha_max);
    out.transmittance_min = in.number(R::transmittance_min);
    out.cameras = in.template structs<RasterCamera>(T::cameras, num_views);
    out.tile_ids = in.template optional<int32_t>(T::tile_ids, ScalarType::Int, {num_active});
    out.tile_offsets = in.template pointer<int32_t>(T::tile_offsets, ScalarType::Int, {num_active + 1});
    out.pixel_ids = in.template pointer<int32_t>(T::pixel_ids, ScalarType::Int, {num_slots});
    out.tile_starts = in.template pointer<uint32_t>(T::tile_starts, ScalarType::Int, {num_active + 1});
    out.intersection_ids = in.template pointer<uint32_t>(T::intersection_ids, ScalarType::Int, {capacity});
    out.instances = in.template structs<Instance>(T::instances, in.tensor(T::instances).size(0));
    out.colors = in.template pointer<float>(T::colors, ScalarType::Float, {num_slots, 3});
    out.alphas = in.template pointer<float>(T::alphas, ScalarType::Float, {num_slots});
    out.transmittances = in.template pointer<float>(T::transmittances, ScalarType::Float, {num_slots});
    out.depths = in.template optional<float>(T::depths, ScalarType::Float, {num_slots});
    out.last_intersections = in.template pointer<int32_t>(T::last_intersections, ScalarType::Int, {num_slots});
    out.masks = in.template pointer<uint32_t>(T::masks, ScalarType::Int, {num_masks});
    out.bucket_counts = in.template pointer<int32_t>(T::bucket_counts, ScalarType::Int, {num_active * chunks});
    return out;
}

void raster_forward(const TensorList& tensors, const IntegerList& integers, const RealList& reals,
                    const IntegerList& rows) {
    using Launch = launches::RasterForward;
    const Arguments<Launch> in(tensors, integers, reals, rows, Launch::Tensors::cameras);
    check_launched(launch_rasterize_forward(read_forward(in), in.stream()), "forward");
}

void raster_backward(const TensorList& tensors, const IntegerList& integers, const RealList& reals,
                     const IntegerList& rows) {
    using Launch = launches::RasterBackward;
    using T = Launch::Tensors;
    const Arguments<Launch> in(tensors, integers, reals, rows, T::cameras);
    const int64_t num_slots = in.tensor(T::pixel_ids).numel(), total = in.tensor(T::instances).size(0);
    STD_TORCH_CHECK(!in.has(T::depth_gradients) || in.has(T::depths), "turbogs: depth gradients without depths");
    BackwardParams params = {};
    params.forward = read_forward(in);
    params.num_instances = to_int(total, "views * Gaussians");
    params.with_density_sums = in.integer(Launch::Integers::with_density_sums) != 0;
    params.cleared = in.integer(Launch::Integers::cleared) != 0;
    params.color_gradients = in.pointer<float>(T::color_gradients, ScalarType::Float, {num_slots, 3});
    params.alpha_gradients = in.optional<float>(T::alpha_gradients, ScalarType::Float, {num_slots});
    params.depth_gradients = in.optional<float>(T::depth_gradients, ScalarType::Float, {num_slots});
    params.pixel_errors = in.optional<float>(T::pixel_errors, ScalarType::Float, {num_slots});
    params.records = in.aligned_pointer<float>(T::records, ScalarType::Float, {total, ScreenRecord::kSize});
    check_launched(launch_rasterize_backward(params, in.stream()), "backward");
}

}  // namespace
}  // namespace turbogs

STABLE_TORCH_LIBRARY_FRAGMENT(turbogs, m) {
    m.def("raster_project" TURBOGS_LAUNCH_SCHEMA);
    m.def("raster_count_intersections" TURBOGS_LAUNCH_SCHEMA);
    m.def("raster_sort_intersections" TURBOGS_LAUNCH_SCHEMA);
    m.def("raster_forward" TURBOGS_LAUNCH_SCHEMA);
    m.def("raster_backward" TURBOGS_LAUNCH_SCHEMA);
}

STABLE_TORCH_LIBRARY_IMPL(turbogs, CUDA, m) {
    m.impl("raster_project", TORCH_BOX(&turbogs::raster_project));
    m.impl("raster_count_intersections", TORCH_BOX(&turbogs::raster_count_intersections));
    m.impl("raster_sort_intersections", TORCH_BOX(&turbogs::raster_sort_intersections));
    m.impl("raster_forward", TORCH_BOX(&turbogs::raster_forward));
    m.impl("raster_backward", TORCH_BOX(&turbogs::raster_backward));
}
