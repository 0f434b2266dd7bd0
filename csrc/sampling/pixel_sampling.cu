// Error-guided sampling of pixels: every tile of K views in one launch, a warp per tile.
//
// A lane holds eight of the tile's 256 pixels. The warp draws (warp_draw.cuh) and writes the drawn pixels in the order
// of samples. The slots of a tile follow from the image's size alone, so nothing is counted on the host, and no warp
// waits for another. The drawn sets equal the torch reference's (draws.py).
#include "sampling/tile_pixels.cuh"
#include "sampling/warp_draw.cuh"

namespace turbogs {
namespace {

constexpr int kSampleBlocks = 8;  // of an SM: 64 registers. 72 and 80, with less spilling, were no faster

// Slots of a tile whose part inside the image has this size.
__device__ __forceinline__ int tile_slots(const SamplePixelsParams& params, int width, int height) {
    return min(params.slots_per_tile, width * height);
}

// First slot of a tile: within a view only the last column and the last row are cut.
__device__ __forceinline__ int first_slot(const SamplePixelsParams& params, const TilePixels& pixels) {
    const SampleView& view = params.views[pixels.view];
    const int last_width = view.width - kTileSize * (view.tiles_x - 1);
    const int row_slots = (view.tiles_x - 1) * tile_slots(params, kTileSize, kTileSize) +
                          tile_slots(params, last_width, kTileSize);
    return view.slot_base + pixels.row * row_slots + pixels.column * tile_slots(params, kTileSize, pixels.height);
}

template <bool kWeighted, bool kMasked>
__global__ void __launch_bounds__(kSampleThreads, kSampleBlocks) sample_pixels_kernel(
    const __grid_constant__ SamplePixelsParams params) {
    const int tile = (blockIdx.x * kSampleThreads + threadIdx.x) / kWarpSize;
    if (tile >= params.num_tiles) return;  // a whole warp
    const int lane = this_lane();
    const TilePixels pixels = locate_tile<kMasked>(params, tile);
    const uint32_t view_number = static_cast<uint32_t>(params.views[pixels.view].view_number);
    const PixelUnits units = load_maps(params, pixels);

    float missed[kPerLane];
    const uint32_t drawn = draw<kWeighted>(params, units, view_number, missed);

    const int first = kMasked ? tile * params.slots_per_tile : first_slot(params, pixels);
    const int end = first + (kMasked ? params.slots_per_tile : tile_slots(params, pixels.width, pixels.height));
    write_samples(params, pixels, drawn, first, end, kWeighted,
                  [&](int j) { return importance_weight(missed[j], params.importance); });
    if (lane == 0) {
        params.tile_ids[tile] = kMasked ? pixels.id_of_tile : tile;
        params.tile_offsets[tile] = first;
        if (tile == params.num_tiles - 1) params.tile_offsets[tile + 1] = end;
    }
}

template <bool kMasked>
void launch(const SamplePixelsParams& params, cudaStream_t stream) {
    const auto kernel =
        params.weights != nullptr ? sample_pixels_kernel<true, kMasked> : sample_pixels_kernel<false, kMasked>;
    kernel<<<warp_blocks(params.num_tiles), kSampleThreads, 0, stream>>>(params);
}

}  // namespace

void launch_sample_pixels(const SamplePixelsParams& params, cudaStream_t stream) {
    if (params.num_tiles == 0) return;
    if (params.unit == SampleUnit::kTile) return launch_sample_tiles(params, stream);
    if (params.live_tiles != nullptr) launch<true>(params, stream);
    else launch<false>(params, stream);
}

}  // namespace turbogs
