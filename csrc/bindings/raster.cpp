// The kernels of the rasterizer as torch operators; see arguments.h.
#include "bindings/arguments.h"
#include "raster/raster_params.h"

namespace turbogs {
namespace {

// What stages 5 and 6 have in common. `Launch` has the fields of Python's `RasterForward`.
template <class Launch>
ForwardParams read_forward(const Arguments<Launch>& in) {
    using T = typename Launch::Tensors;
    using R = typename Launch::Reals;
    ForwardParams params = {};
    const int64_t num_views = in.tensor(T::cameras).size(0), num_active = in.tensor(T::tile_offsets).numel() - 1;
    const int64_t num_slots = in.tensor(T::pixel_ids).numel(), capacity = in.tensor(T::intersection_ids).numel();
    const int64_t num_masks = in.tensor(T::masks).numel(), chunks = in.integer(Launch::Integers::chunks);
    STD_TORCH_CHECK(chunks > 0, "turbogs: chunks must be positive, got ", chunks);
    STD_TORCH_CHECK(capacity / kBucket + num_active + 1 <= num_masks / chunks, "turbogs: masks is too small");
    params.num_views = to_int(num_views, "views");
    params.num_active = to_int(num_active, "active tiles");
    params.chunks = to_int(chunks, "chunks");
    params.alpha_min = in.number(R::alpha_min);
    params.alpha_max = in.number(R::alpha_max);
    params.transmittance_min = in.number(R::transmittance_min);
    read_background(in, params.background);
    in.set_structs(params.cameras, T::cameras, num_views);
    in.set_optional(params.tile_ids, T::tile_ids, {num_active});
    in.set(params.tile_offsets, T::tile_offsets, {num_active + 1});
    in.set(params.pixel_ids, T::pixel_ids, {num_slots});
    in.set(params.tile_starts, T::tile_starts, {num_active + 1});
    in.set(params.intersection_ids, T::intersection_ids, {capacity});
    in.set_structs(params.instances, T::instances, in.tensor(T::instances).size(0));
    in.set(params.colors, T::colors, {num_slots, 3});
    in.set(params.alphas, T::alphas, {num_slots});
    in.set(params.transmittances, T::transmittances, {num_slots});
    in.set_optional(params.depths, T::depths, {num_slots});
    in.set(params.last_intersections, T::last_intersections, {num_slots});
    in.set(params.masks, T::masks, {num_masks});
    in.set(params.bucket_counts, T::bucket_counts, {num_active * chunks});
    return params;
}

}  // namespace

void launches::RasterProject::run(const Arguments<RasterProject>& in) {
    ProjectionParams params = {};
    read_scene(in, params);
    const bool everywhere = !in.has(Tensors::tile_ids);
    STD_TORCH_CHECK(everywhere == !in.has(Tensors::active_prefix), "turbogs: tile_ids and active_prefix go together");
    const int64_t views = params.num_views, count = params.num_gaussians, total = views * count;
    read_origin(in, params.origin_x, params.origin_y);
    int64_t tiles = 0;
    for (int view = 0; view < params.num_views; ++view) {
        tiles += int64_t{1} * tiles_along(params.origin_x + params.widths[view]) *
                 tiles_along(params.origin_y + params.heights[view]);
    }
    params.num_tiles = to_int(tiles, "tiles");
    params.num_active = to_int(everywhere ? tiles : in.tensor(Tensors::tile_ids).size(0), "active tiles");
    params.near_plane = in.number(Reals::near_plane);
    params.far_plane = in.number(Reals::far_plane);
    params.alpha_min = in.number(Reals::alpha_min);
    const int64_t threshold = in.integer(Integers::threshold);
    STD_TORCH_CHECK(threshold >= 0 && threshold < int64_t{1} << 32, "turbogs: dropout must be below 1");
    params.dropout_threshold = static_cast<uint32_t>(threshold);
    params.dropout_keys = philox_keys(in.integer(Integers::seed), in.integer(Integers::iteration));
    in.set_optional(params.tile_ids, Tensors::tile_ids, {params.num_active});
    in.set_structs(params.cameras, Tensors::cameras, views);
    in.set_optional(params.active_prefix, Tensors::active_prefix, {tiles + 1});
    in.set_structs(params.instances, Tensors::instances, total);
    in.set(params.radii, Tensors::radii, {views, count, 2});
    in.set(params.tile_differences, Tensors::tile_cursors, {params.num_active + 1});
    in.set_optional(params.records, Tensors::records, {total, ScreenRecord::kSize});
    launch_projection(params, in.stream());
}

void launches::RasterCountIntersections::run(const Arguments<RasterCountIntersections>& in) {
    const int64_t num_active = in.tensor(Tensors::tile_starts).numel() - 1, capacity = in.integer(Integers::capacity);
    STD_TORCH_CHECK(capacity >= 0 && capacity <= kIntersectionsMax, "turbogs: capacity must be below 2^31, got ",
                    capacity);
    CountIntersectionsParams params = {};
    params.num_active = to_int(num_active, "active tiles");
    params.capacity = static_cast<uint32_t>(capacity);
    in.set(params.tile_cursors, Tensors::tile_cursors, {num_active + 1});
    in.set(params.tile_starts, Tensors::tile_starts, {num_active + 1});
    in.set(params.status, Tensors::status, {2});
    in.set(params.counters, Tensors::counters, {2}, ScalarType::Int);
    in.set(params.block_sums, Tensors::block_sums, {scan_blocks(params.num_active), 2});
    launch_count_intersections(params, in.stream());
}

void launches::RasterSortIntersections::run(const Arguments<RasterSortIntersections>& in) {
    const Tensor& radii = in.tensor(Tensors::radii);
    const int64_t views = radii.size(0), count = radii.size(1), total = views * count;
    const int64_t capacity = in.tensor(Tensors::intersection_ids).numel();
    const int64_t num_active = in.tensor(Tensors::tile_starts).numel() - 1;
    SortIntersectionsParams params = {};
    params.num_instances = to_int(total, "views * Gaussians");
    params.num_gaussians = to_int(count, "Gaussians");
    params.num_active = to_int(num_active, "active tiles");
    params.capacity = static_cast<uint32_t>(capacity);
    in.set_structs(params.instances, Tensors::instances, total);
    in.set(params.radii, Tensors::radii, {views, count, 2});
    in.set_structs(params.cameras, Tensors::cameras, views);
    if (in.has(Tensors::active_prefix)) {
        in.set(params.active_prefix, Tensors::active_prefix, {in.tensor(Tensors::active_prefix).numel()});
    }
    in.set(params.tile_cursors, Tensors::tile_cursors, {num_active + 1});
    in.set(params.tile_starts, Tensors::tile_starts, {num_active + 1});
    in.set(params.status, Tensors::status, {2});
    in.set(params.intersection_keys, Tensors::intersection_keys, {capacity});
    in.set(params.counters, Tensors::counters, {2}, ScalarType::Int);
    in.set(params.runs, Tensors::runs, {capacity / kLeastOfRun, 2});
    in.set_quads(params.intersection_ids, Tensors::intersection_ids, {capacity});
    params.windows = reinterpret_cast<uint2*>(params.intersection_ids);
    launch_scatter_intersections(params, in.stream());
    launch_sort_intersections(params, in.stream());
}

void launches::RasterForward::run(const Arguments<RasterForward>& in) {
    launch_rasterize_forward(read_forward(in), in.stream());
}

void launches::RasterBackward::run(const Arguments<RasterBackward>& in) {
    const int64_t num_slots = in.tensor(Tensors::pixel_ids).numel(), total = in.tensor(Tensors::instances).size(0);
    STD_TORCH_CHECK(!in.has(Tensors::depth_gradients) || in.has(Tensors::depths),
                    "turbogs: depth gradients without depths");
    BackwardParams params = {};
    params.forward = read_forward(in);
    params.with_density_sums = in.integer(Integers::with_density_sums) != 0;
    in.set(params.color_gradients, Tensors::color_gradients, {num_slots, 3});
    in.set_optional(params.alpha_gradients, Tensors::alpha_gradients, {num_slots});
    in.set_optional(params.depth_gradients, Tensors::depth_gradients, {num_slots});
    in.set_optional(params.pixel_errors, Tensors::pixel_errors, {num_slots});
    in.set_quads(params.records, Tensors::records, {total, ScreenRecord::kSize});
    launch_rasterize_backward(params, in.stream());
}

void launches::CollectRecords::run(const Arguments<CollectRecords>& in) {
    const int64_t num_sources = in.num_rows(1);
    STD_TORCH_CHECK(num_sources <= kMaxPeers && in.num_more() == 2 * num_sources,
                    "turbogs: records and radii of up to ", kMaxPeers, " processes are collected");
    const Tensor &source = in.tensor(in.more(1)), &target = in.tensor(Tensors::target_radii);
    STD_TORCH_CHECK(source.dim() == 3 && target.dim() == 3, "turbogs: radii must be [views, Gaussians, 2]");
    const int64_t count = source.size(1), all = target.size(0), rows = target.size(1);
    const int64_t first_row = in.integer(Integers::first_row);
    STD_TORCH_CHECK(first_row >= 0 && first_row + rows <= count, "turbogs: rows ", first_row, " .. ", first_row + rows,
                    " of ", count);
    CollectParams params = {};
    params.num_sources = static_cast<int>(num_sources);
    params.num_views = to_int(all, "views");
    params.num_gaussians = to_int(count, "Gaussians");
    params.num_rows = to_int(rows, "Gaussians");
    params.first_row = to_int(first_row, "Gaussians");
    const auto whole = ScreenRecord::kSize;
    int64_t end = 0;  // of the views so far
    for (int i = 0; i < params.num_sources; ++i) {
        const int64_t views = in.tensor(in.more(2 * i + 1)).size(0), first = *in.row(i, 1);
        STD_TORCH_CHECK(views > 0 && (first == end || (i > 0 && first == end - 1)),
                        "turbogs: the views of a process begin with the last one of the process before, or the next");
        end = first + views;
        params.sources[i].num_views = to_int(views, "views");
        params.sources[i].first_view = to_int(first, "views");
        in.set(params.sources[i].records, in.more(2 * i), {views, count, whole});
        in.set(params.sources[i].radii, in.more(2 * i + 1), {views, count, 2});
    }
    STD_TORCH_CHECK(end == all && all <= kMaxViews, "turbogs: records of ", end, " views of ", all);
    in.set(params.target_records, Tensors::target_records, {all, rows, whole});
    in.set(params.target_radii, Tensors::target_radii, {all, rows, 2});
    launch_collect_records(params, in.stream());
}

void launches::GatherColors::run(const Arguments<GatherColors>& in) {
    GatherParams params = {};
    const int64_t num_peers = in.num_rows(1), first = in.integer(Integers::first);
    STD_TORCH_CHECK(num_peers <= kMaxPeers && in.num_more() == num_peers && first >= PassStatus::kSize,
                    "turbogs: up to ", kMaxPeers, " processes gather colours, which begin behind their status");
    params.num_peers = static_cast<int>(num_peers);
    params.first = to_int(first, "numbers of a memory");
    int64_t numbers = 0;
    for (int i = 0; i < params.num_peers; ++i) {
        const Tensors peer = in.more(i);
        const int64_t size = in.tensor(peer).numel(), samples = *in.row(i, 1);
        STD_TORCH_CHECK(samples >= 0 && samples <= (size - first) / 3, "turbogs: process ", i, " has no ", samples,
                        " colours in memory for ", size, " numbers");
        in.set(params.peers[i], peer, {size});
        params.counts[i] = to_int(3 * samples, "numbers of colours");
        params.starts[i] = to_int(numbers, "numbers of colours");
        numbers += 3 * samples;
    }
    in.set(params.colors, Tensors::colors, {numbers / 3, 3});
    in.set(params.seen, Tensors::seen, {2});
    in.set_optional(params.overflow, Tensors::overflow, {1});
    launch_gather_colors(params, in.stream());
}

}  // namespace turbogs
