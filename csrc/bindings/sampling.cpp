// The samplers' kernels as a torch operator; see raster.cpp.
#include "bindings/arguments.h"
#include "bindings/sample_views.h"
#include "sampling/sampling_params.h"

namespace turbogs {
namespace {

// What Philox adds to its two keys from round to round (Salmon et al., SC 2011).
constexpr uint32_t kPhiloxStep0 = 0x9E3779B9u, kPhiloxStep1 = 0xBB67AE85u;

void sample_pixels(const TensorList& tensors, const IntegerList& integers, const RealList& reals,
                   const IntegerList& rows) {
    using Launch = launches::SamplePixels;
    using T = Launch::Tensors;
    using I = Launch::Integers;
    const Arguments<Launch> in(tensors, integers, reals, rows, T::errors);
    const int64_t pixels = in.tensor(T::errors).numel(), slots = in.tensor(T::pixel_ids).numel();
    const int64_t chosen = in.tensor(T::tile_ids).numel();
    SamplePixelsParams params = {};
    const SampleViews views = read_views(in, DrawRow::kSize, pixels, params.views);
    const int64_t tiles = views.num_tiles;
    params.unit = to_enumeration<SampleUnit>(in.integer(I::unit), kNumSampleUnits,
                                             "unit must be 0 (pixel), 1 (cell) or 2 (tile)");
    STD_TORCH_CHECK(params.unit == SampleUnit::kTile || chosen == tiles,
                    "turbogs: tile_ids must have an entry for each tile");
    params.num_views = views.num_views;
    params.num_tiles = views.num_tiles;
    params.num_chosen = to_int(chosen, "tiles");
    for (int i = 0; i < params.num_views; ++i) {
        const int64_t* row = in.row(i, DrawRow::kSize);
        params.views[i].slot_base = to_int(row[DrawRow::kFirstSlot], "first slot");
        params.views[i].wanted = to_int(row[DrawRow::kWanted], "tiles to choose");
        for (int j = 0; j < 3; ++j) params.stages[i][j] = static_cast<int>(row[DrawRow::kStages + j]);
    }
    params.slots_per_tile = static_cast<int>(in.integer(I::slots_per_tile));
    params.mixed_uniform = in.integer(I::mixed_uniform) != 0;
    params.importance = in.number(Launch::Reals::importance);
    const int64_t seed = in.integer(I::seed), iteration = in.integer(I::iteration);
    params.seed_high = static_cast<uint32_t>(static_cast<uint64_t>(seed) >> 32);
    for (uint32_t round = 0; round < kPhiloxRounds; ++round) {
        params.round_keys[round][0] = static_cast<uint32_t>(seed) + round * kPhiloxStep0;
        params.round_keys[round][1] = static_cast<uint32_t>(iteration) + round * kPhiloxStep1;
    }
    params.now = static_cast<int>(in.integer(I::now));
    params.errors = in.pointer<void>(T::errors, ScalarType::Half, {pixels});
    params.stamps = in.pointer<int16_t>(T::stamps, ScalarType::Short, {pixels});
    params.pixel_ids = in.pointer<int32_t>(T::pixel_ids, ScalarType::Int, {slots});
    params.tile_ids = in.pointer<int32_t>(T::tile_ids, ScalarType::Int, {chosen});
    params.tile_offsets = in.pointer<int32_t>(T::tile_offsets, ScalarType::Int, {chosen + 1});
    params.weights = in.optional<float>(T::weights, ScalarType::Float, {slots});
    if (params.unit == SampleUnit::kTile) {
        params.tile_errors = in.pointer<double>(T::tile_errors, ScalarType::Double, {tiles});
        params.tile_ages = in.pointer<int32_t>(T::tile_ages, ScalarType::Int, {tiles});
        params.tile_keys = in.pointer<int64_t>(T::tile_keys, ScalarType::Long, {tiles});
        params.tile_missed = in.pointer<float>(T::tile_missed, ScalarType::Float, {tiles});
    }
    check_launched(launch_sample_pixels(params, in.stream()), "pixel sampler");
}

}  // namespace
}  // namespace turbogs

STABLE_TORCH_LIBRARY_FRAGMENT(turbogs, m) { m.def("sample_pixels" TURBOGS_LAUNCH_SCHEMA); }

STABLE_TORCH_LIBRARY_IMPL(turbogs, CUDA, m) { m.impl("sample_pixels", TORCH_BOX(&turbogs::sample_pixels)); }
