// The kernels of the sampler as a torch operator; see arguments.h.
#include "bindings/arguments.h"
#include "bindings/sample_views.h"
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
    params.unit = to_enumeration<SampleUnit>(in.integer(Integers::unit), kNumSampleUnits,
                                             "unit must be 0 (pixel) or 1 (tile)");
    STD_TORCH_CHECK(params.unit == SampleUnit::kTile || chosen == tiles,
                    "turbogs: tile_ids must have an entry for each tile");
    const bool at_origin = params.views[0].origin_x == 0 && params.views[0].origin_y == 0;
    STD_TORCH_CHECK(at_origin || (params.unit == SampleUnit::kTile && !masked),
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
    if (params.unit == SampleUnit::kTile) {
        in.set(params.tile_errors, Tensors::tile_errors, {tiles});
        in.set(params.tile_ages, Tensors::tile_ages, {tiles});
        in.set(params.tile_keys, Tensors::tile_keys, {tiles});
        in.set(params.tile_missed, Tensors::tile_missed, {tiles});
    }
    check_launched(launch_sample_pixels(params, in.stream()), "pixel sampler");
}

}  // namespace turbogs
