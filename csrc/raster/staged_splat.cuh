// A splat at the pixels of a tile, for the blending kernels. The forward and the backward pass must agree to the bit
// on which splats a pixel sees, so both call the functions here, written with intrinsics, where it matters, that the
// compiler neither contracts nor reorders.
//
// sigma = 0.5 * (a dx^2 + c dy^2) + b dx dy is a sum of two squares, and with the right scale alpha is a power of
// two:
//     alpha = opacity * exp(-sigma) = 2^(level - u^2 - v^2),   u = p dx + q dy,   v = r dy,
// where p^2 = a * s, p q = b * s, r^2 = s / (variance in y) and s = log2(e) / 2. Pixels and means are taken relative
// to a point of the tile, so u and v are one and two multiply-adds of what a splat stores. sigma is never negative
// this way.
#pragma once

#include "common/approximate_math.cuh"
#include "common/warp.cuh"
#include "raster/raster_params.h"

namespace turbogs {

constexpr float kAlphaTiny = 1e-10f;  // smallest alpha by which a depth is divided, as in gsplat
constexpr float kLog2E = 1.4426950408889634f;
constexpr float kFormScale = 0.8493218002880191f;  // sqrt(log2(e) / 2)

// A splat as the blending kernels hold it in shared memory.
struct StagedSplat {
    float4 form;   // p, q, r, u at the tile's point
    float4 rest;   // v at the tile's point, level, depth, number of the intersection in its tile (bits)
    float4 color;  // red, green, blue, one bit
};

__device__ __forceinline__ StagedSplat load_splat(const Instance* __restrict__ instances, uint32_t instance) {
    const float4* in = reinterpret_cast<const float4*>(instances + instance);
    return {__ldg(in), __ldg(in + 1), __ldg(in + 2)};
}

// In place: from the quads of an `Instance` to a staged splat's. `least_level` = log2(alpha_min).
__device__ __forceinline__ void stage_splat(StagedSplat& splat, float tile_x, float tile_y, float least_level,
                                            int intersection, uint32_t bit) {
    const float dx = splat.form.x - tile_x, dy = splat.form.y - tile_y;
    const float p = kFormScale * approximate_sqrt_flushed(splat.form.z), r = kFormScale * splat.color.w;
    const float q = kFormScale * kFormScale * splat.form.w * approximate_reciprocal(p);
    splat.form = make_float4(p, q, r, fmaf(p, dx, q * dy));
    splat.rest =
        make_float4(r * dy, fmaf(splat.rest.w, kLog2E, least_level), splat.rest.z, __int_as_float(intersection));
    splat.color.w = __uint_as_float(bit);
}

__device__ __forceinline__ float infinity() { return __int_as_float(0x7F800000); }

// One that no pixel sees: its level is -infinity, and it lies behind all others.
__device__ __forceinline__ StagedSplat no_splat() {
    const float4 zero = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
    return {zero, make_float4(0.0f, -infinity(), 0.0f, __int_as_float(INT32_MAX)), zero};
}

// u and v at (x, y), relative to the tile's point.
__device__ __forceinline__ float2 splat_form(const float4& form, float v_origin, float x, float y) {
    return make_float2(__fmaf_rn(-form.x, x, __fmaf_rn(-form.y, y, form.w)), __fmaf_rn(-form.z, y, v_origin));
}

// log2 of opacity * exp(-sigma), before the clamp at alpha_max.
__device__ __forceinline__ float splat_level(const float4& form, const float4& rest, float x, float y) {
    const float2 f = splat_form(form, rest.x, x, y);
    return __fmaf_rn(-f.y, f.y, __fmaf_rn(-f.x, f.x, rest.y));
}

// The point of a tile that pixels are taken relative to, and a pixel's place there.
struct TileFrame {
    int width;   // of the view
    float x, y;  // of the tile's centre
};

__device__ __forceinline__ TileFrame tile_frame(const ForwardParams& params, int tile) {
    const int tile_id = params.tile_ids != nullptr ? params.tile_ids[tile] : tile;
    const RasterCamera& camera = params.cameras[view_of_tile(params.cameras, params.num_views, tile_id)];
    const int place = tile_id - camera.tile_base, row = place / camera.tiles_x, column = place - row * camera.tiles_x;
    const float half = 0.5f * kTileSize;
    return {camera.width, static_cast<float>(column * kTileSize - camera.origin_x) + half,
            static_cast<float>(row * kTileSize - camera.origin_y) + half};
}

// A work item's mask of the first bucket. That of the next one lies params.chunks further on.
__device__ __forceinline__ uint32_t* masks_of_item(const ForwardParams& params, uint32_t first_intersection,
                                                   int tile, int chunk) {
    return params.masks + static_cast<size_t>(first_intersection / kBucket + tile) * params.chunks + chunk;
}

// Centre of a pixel in the tile's frame.
__device__ __forceinline__ float2 pixel_in_tile(const TileFrame& frame, int pixel) {
    const int y = pixel / frame.width, x = pixel - y * frame.width;
    return make_float2(static_cast<float>(x) + 0.5f - frame.x, static_cast<float>(y) + 0.5f - frame.y);
}

}  // namespace turbogs
