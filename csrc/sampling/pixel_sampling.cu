// Error-guided sampling of pixels and cells: every tile of K views in one launch, a warp per tile.
//
// A lane holds eight of the tile's 256 pixels. To draw cells, the warp sums their pixels first, and a lane holds one of
// the 16 cells. The warp draws (warp_draw.cuh) and writes the drawn pixels in the order of samples. The slots of a tile
// follow from the image's size alone, so nothing is counted on the host, and no warp waits for another. The drawn sets
// equal those of the torch reference (draws.py).
#include "sampling/tile_pixels.cuh"
#include "sampling/warp_draw.cuh"

namespace turbogs {
namespace {

constexpr int kSampleBlocks = 8;  // of an SM: 64 registers. 72 and 80, with less spilling, were no faster
constexpr int kCellPixels = kCellSide * kCellSide;
constexpr int kCellColumn = 2;  // bit of a lane that says in which of a patch's two cells its pixels lie

// The cell of a lane.
struct CellUnit {
    float error_sum;
    int oldest;
    uint32_t first_pixel;

    __device__ __forceinline__ float error(int) const { return error_sum; }
    __device__ __forceinline__ int age(int) const { return oldest; }
    __device__ __forceinline__ uint32_t place(int) const { return first_pixel; }
};

__device__ __forceinline__ int cells_along(int pixels) { return (pixels + kCellSide - 1) / kCellSide; }

// Slots of a tile whose part inside the image has this size.
template <SampleUnit kUnit>
__device__ __forceinline__ int tile_slots(const SamplePixelsParams& params, int width, int height) {
    const int cap = kUnit == SampleUnit::kPixel
                        ? params.slots_per_tile
                        : min(params.slots_per_tile, kCellPixels * cells_along(width) * cells_along(height));
    return min(cap, width * height);
}

// First slot of a tile: within a view only the last column and the last row are cut.
template <SampleUnit kUnit>
__device__ __forceinline__ int first_slot(const SamplePixelsParams& params, const TilePixels& pixels) {
    const SampleView& view = params.views[pixels.view];
    const int last_width = view.width - kTileSize * (view.tiles_x - 1);
    const int row_slots = (view.tiles_x - 1) * tile_slots<kUnit>(params, kTileSize, kTileSize) +
                          tile_slots<kUnit>(params, last_width, kTileSize);
    return view.slot_base + pixels.row * row_slots +
           pixels.column * tile_slots<kUnit>(params, kTileSize, pixels.height);
}

template <SampleUnit kUnit, bool kWeighted, bool kMasked>
__global__ void __launch_bounds__(kSampleThreads, kSampleBlocks) sample_tiles_kernel(
    const __grid_constant__ SamplePixelsParams params) {
    const int tile = (blockIdx.x * kSampleThreads + threadIdx.x) / kWarpSize;
    if (tile >= params.num_tiles) return;  // a whole warp
    const int lane = this_lane();
    const TilePixels pixels = locate_tile<kMasked>(params, tile);
    const uint32_t view_number = static_cast<uint32_t>(params.views[pixels.view].view_number);
    const PixelUnits units = load_maps(params, pixels);

    // The sums of the mixed stage: half-precision errors add up exactly in double.
    double error_sum = 0.0;
    int age_sum = 0;
    float missed[kPerLane];
    uint32_t drawn = 0;
    if (kUnit == SampleUnit::kPixel) {
#pragma unroll
        for (int j = 0; j < kPerLane; ++j) {
            error_sum += static_cast<double>(units.error(j));
            age_sum += units.age(j);
        }
        error_sum = warp_sum(error_sum);
        age_sum = static_cast<int>(__reduce_add_sync(kFullWarp, static_cast<uint32_t>(age_sum)));
        drawn = draw<kWeighted>(params, units, pixels.inside, view_number, kPurposePixels, error_sum, age_sum, missed);
    } else {
        // Patch j holds two 4x4 cells, left (bit kCellColumn of a lane clear) and right. Lane n < 16 takes over cell
        // n: it lies in patch `patch`, and lane `source` has its sums.
        const int source = lane % 2 << kCellColumn, patch = lane / 4 % 4 * kRowPatches + lane / 2 % 2;
        double cell_error = 0.0;
        CellUnit cell = {};
        uint32_t cell_exists = 0;
#pragma unroll
        for (int j = 0; j < kPerLane; ++j) {
            double sum = static_cast<double>(units.error(j));
            int oldest = units.age(j);
#pragma unroll
            for (int bit = 0; 1 << bit < kWarpSize; ++bit) {
                if (bit == kCellColumn) continue;
                sum += __shfl_xor_sync(kFullWarp, sum, 1 << bit);
                oldest = max(oldest, __shfl_xor_sync(kFullWarp, oldest, 1 << bit));
            }
            const double source_sum = __shfl_sync(kFullWarp, sum, source);
            const int source_age = __shfl_sync(kFullWarp, oldest, source);
            const uint32_t source_place = __shfl_sync(kFullWarp, pixels.id(j), source);
            const uint32_t left_cell = 0x0F0F0F0Fu;  // lanes of the left one
            const uint32_t exist = __ballot_sync(kFullWarp, (pixels.inside >> j & 1u) != 0u);
            if (lane < kTileCells && patch == j) {
                cell_error = source_sum;
                cell.oldest = source_age;
                cell.first_pixel = source_place;
                cell_exists = (exist & (lane % 2 == 0 ? left_cell : ~left_cell)) != 0u ? 1u : 0u;
            }
        }
        error_sum = warp_sum(cell_error);
        age_sum = static_cast<int>(__reduce_add_sync(kFullWarp, static_cast<uint32_t>(cell.oldest)));
        cell.error_sum = __double2float_rn(cell_error);
        float cell_missed[1];
        const uint32_t cell_drawn =
            draw<kWeighted>(params, cell, cell_exists, view_number, kPurposeCells, error_sum, age_sum, cell_missed);
        const uint32_t cells = __ballot_sync(kFullWarp, cell_drawn != 0u);
#pragma unroll
        for (int j = 0; j < kPerLane; ++j) {
            const int number = j / kRowPatches * 4 + j % kRowPatches * 2 + (lane >> kCellColumn) % 2;
            drawn |= (cells >> number & 1u) << j;
            if (kWeighted) missed[j] = __shfl_sync(kFullWarp, cell_missed[0], number);
        }
        drawn &= pixels.inside;
    }

    const int first = kMasked ? tile * params.slots_per_tile : first_slot<kUnit>(params, pixels);
    const int end =
        first + (kMasked ? params.slots_per_tile : tile_slots<kUnit>(params, pixels.width, pixels.height));
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
    const bool weighted = params.weights != nullptr;
    const auto kernel = params.unit == SampleUnit::kPixel
                            ? (weighted ? sample_tiles_kernel<SampleUnit::kPixel, true, kMasked>
                                        : sample_tiles_kernel<SampleUnit::kPixel, false, kMasked>)
                            : (weighted ? sample_tiles_kernel<SampleUnit::kCell, true, kMasked>
                                        : sample_tiles_kernel<SampleUnit::kCell, false, kMasked>);
    kernel<<<warp_blocks(params.num_tiles), kSampleThreads, 0, stream>>>(params);
}

}  // namespace

cudaError_t launch_sample_pixels(const SamplePixelsParams& params, cudaStream_t stream) {
    if (params.num_tiles == 0) return cudaSuccess;
    if (params.unit == SampleUnit::kTile) return launch_sample_tiles(params, stream);
    if (params.live_tiles != nullptr) launch<true>(params, stream);
    else launch<false>(params, stream);
    return cudaGetLastError();
}

}  // namespace turbogs
