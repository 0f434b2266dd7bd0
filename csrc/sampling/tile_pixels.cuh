// A warp's tile in the maps, where masks are with them. A lane holds 8 of its pixels: pixel (j, lane) is number
// 32 j + lane in the order of samples (turbogs_plugin/types). That order goes through the tile in patches of 8x4
// pixels, two beside each other and four such rows, so lane and j say where a pixel lies.
#pragma once

#include <cuda_fp16.h>

#include "common/warp.cuh"
#include "sampling/sampling_params.h"

namespace turbogs {

constexpr int kPerLane = kTilePixels / kWarpSize;     // pixels of a lane, one of each patch
constexpr int kPatchWidth = 8, kPatchHeight = 4;      // pixels
constexpr int kRowPatches = kTileSize / kPatchWidth;  // patches beside each other
static_assert(kPatchWidth * kPatchHeight == kWarpSize, "a lane has one pixel of each patch");

constexpr int kSampleThreads = 128;  // of a block; its warps share nothing. No record of other values
constexpr int kAgeMax = INT16_MAX;   // AGE_MAX of turbogs_plugin/error_maps.py

// The tile of this warp, and its 8 pixels a lane.
struct TilePixels {
    int view;                  // in the batch
    int id_of_tile;            // in the numbering of the batch
    int column, row;           // of the tile
    int width, height;         // of the part inside the image, where the grid begins with it
    uint32_t inside;           // bit j: pixel (j, lane) exists and is not masked
    int first;                 // id of pixel (0, lane), y * width + x, also where that lies before the image
    int image_width;

    // From pixel (0, lane) to pixel (j, lane).
    __device__ __forceinline__ int offset(int j) const {
        return j / kRowPatches * kPatchHeight * image_width + j % kRowPatches * kPatchWidth;
    }
    __device__ __forceinline__ uint32_t id(int j) const { return static_cast<uint32_t>(first + offset(j)); }
};

// The tile at a place of the list of tiles to draw from.
template <bool kMasked>
__device__ __forceinline__ TilePixels locate_tile(const SamplePixelsParams& params, int place) {
    TilePixels pixels;
    pixels.view = view_of_tile(params.live, params.num_views, place);
    const SampleView& view = params.views[pixels.view];
    int number = place - params.live[pixels.view].tile_base, live = 0;
    if (kMasked) {
        live = params.live[pixels.view].first + number;
        number = params.live_tiles[live];
    }
    pixels.id_of_tile = view.tile_base + number;
    pixels.row = number / view.tiles_x;
    pixels.column = number - pixels.row * view.tiles_x;
    pixels.width = min(kTileSize, view.width - kTileSize * pixels.column);
    pixels.height = min(kTileSize, view.height - kTileSize * pixels.row);
    pixels.inside = 0;
    const int lane = this_lane(), x = lane % kPatchWidth, y = lane / kPatchWidth;
    pixels.image_width = view.width;
    const int first_x = kTileSize * pixels.column - view.origin_x + x;
    const int first_y = kTileSize * pixels.row - view.origin_y + y;
    pixels.first = first_y * view.width + first_x;
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) {
        const int image_x = first_x + j % kRowPatches * kPatchWidth, image_y = first_y + j / kRowPatches * kPatchHeight;
        const bool in_row = static_cast<uint32_t>(image_x) < static_cast<uint32_t>(view.width);
        const bool exists = in_row && static_cast<uint32_t>(image_y) < static_cast<uint32_t>(view.height);
        pixels.inside |= static_cast<uint32_t>(exists) << j;
    }
    if (kMasked) {
        const int32_t* words = params.live_bits + static_cast<size_t>(kPerLane) * params.live_rows[live];
#pragma unroll
        for (int j = 0; j < kPerLane; ++j) {
            if ((static_cast<uint32_t>(words[j]) >> lane & 1u) == 0u) pixels.inside &= ~(1u << j);
        }
    }
    return pixels;
}

// What the maps say of a lane's pixels: errors, halves, and above them the ages.
struct PixelUnits {
    const TilePixels& pixels;
    uint32_t packed[kPerLane];

    __device__ __forceinline__ float error(int j) const {
        return __half2float(__ushort_as_half(static_cast<unsigned short>(packed[j])));
    }
    __device__ __forceinline__ int age(int j) const { return static_cast<int>(packed[j] >> 16); }
};

__device__ __forceinline__ PixelUnits load_maps(const SamplePixelsParams& params, const TilePixels& pixels) {
    const SampleView& view = params.views[pixels.view];
    const int64_t first = view.pixel_base + pixels.first;
    const uint16_t* of_errors = params.errors + first;
    const int16_t* of_stamps = params.stamps + first;
    uint32_t errors[kPerLane];
    int stamps[kPerLane];
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) {
        const bool exists = (pixels.inside & 1u << j) != 0u;
        errors[j] = exists ? of_errors[pixels.offset(j)] : 0u;
        stamps[j] = exists ? of_stamps[pixels.offset(j)] : params.now;
    }
    PixelUnits units{pixels, {}};
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) {
        const int negative_age = min(max(stamps[j] - params.now, -kAgeMax), 0);
        units.packed[j] = errors[j] + static_cast<uint32_t>(negative_age * -0x10000);
    }
    return units;
}

// Writes the drawn pixels (bit j of `drawn`: pixel (j, lane)) to the slots first .. end - 1, in the order of samples.
// The slots that are left are made empty. `weight_of(j)` is the weight of pixel (j, lane), needed only if `weighted`.
template <class WeightOf>
__device__ __forceinline__ void write_samples(const SamplePixelsParams& params, const TilePixels& pixels,
                                              uint32_t drawn, int first, int end, bool weighted,
                                              const WeightOf& weight_of) {
    const int lane = this_lane();
    const uint32_t lower_lanes = lanes_below(lane);
    int next = first;
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) {
        const bool mine = (drawn & 1u << j) != 0u;
        const uint32_t lanes = __ballot_sync(kFullWarp, mine);
        if (mine) {
            const int slot = next + __popc(lanes & lower_lanes);
            params.pixel_ids[slot] = static_cast<int32_t>(pixels.id(j));
            if (weighted) params.weights[slot] = weight_of(j);
        }
        next += __popc(lanes);
    }
    for (int slot = next + lane; slot < end; slot += kWarpSize) {
        params.pixel_ids[slot] = -1;
        if (weighted) params.weights[slot] = 0.0f;
    }
}

// Blocks of a launch with one warp an item. For the host.
inline int warp_blocks(int warps) { return blocks_for(warps, kSampleThreads / kWarpSize); }

}  // namespace turbogs
