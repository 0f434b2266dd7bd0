// What several raster kernels share: the arithmetic of a splat at a pixel, and which tiles a splat reaches.
//
// The forward and the backward pass must agree to the bit on which splats a pixel sees, and the projection and the
// pair sort on how many tiles a splat reaches. So both pairs call the same functions here, written with intrinsics, where
// it matters, that the compiler neither contracts nor reorders.
#pragma once

#include "params.h"
#include "warp.cuh"

namespace turbogs {

constexpr float kAlphaTiny = 1e-10f;  // smallest alpha by which a depth is divided, as in gsplat

// ---- The one place where precision is chosen -------------------------------------------------------------------
// Per (splat, pixel) the blending kernels need 2^x, a reciprocal and, for the density sums, a square root. By default
// these are the approximations of the special function unit (relative error about 2^-22, denormals flushed: alpha below
// 1/255 is dropped anyway). Build with TURBOGS_EXACT_MATH=1 for the correctly rounded ones.
#ifndef TURBOGS_EXACT_MATH
#define TURBOGS_EXACT_MATH 0
#endif

__device__ __forceinline__ float blend_exp2(float x) {
#if TURBOGS_EXACT_MATH
    return exp2f(x);
#else
    float result;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(x));
    return result;
#endif
}

__device__ __forceinline__ float blend_reciprocal(float x) {
#if TURBOGS_EXACT_MATH
    return __frcp_rn(x);
#else
    float result;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(x));
    return result;
#endif
}

__device__ __forceinline__ float blend_sqrt(float x) {
#if TURBOGS_EXACT_MATH
    return __fsqrt_rn(x);
#else
    float result;
    asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(x));
    return result;
#endif
}

// ---- A splat at a pixel ----------------------------------------------------------------------------------------
//
// sigma = 0.5 * (a dx^2 + c dy^2) + b dx dy is a sum of two squares, and with the right scale alpha is a power of two:
//     alpha = opacity * exp(-sigma) = 2^(level - u^2 - v^2),   u = p dx + q dy,   v = r dy,
// where p^2 = a * s, p q = b * s, r^2 = s / (variance in y) and s = log2(e) / 2. Pixels and means are taken relative to a
// point of the tile, so u and v are one and two multiply-adds of what a splat stores. sigma is never negative this way.

constexpr float kLog2E = 1.4426950408889634f;
constexpr float kFormScale = 0.8493218002880191f;  // sqrt(log2(e) / 2)

// A splat as the blending kernels hold it in shared memory.
struct StagedSplat {
    float4 form;   // p, q, r, u at the tile's point
    float4 rest;   // v at the tile's point, level, depth, number of the pair in its tile (bits)
    float4 color;  // red, green, blue, one bit
};

__device__ __forceinline__ StagedSplat load_splat(const Instance* __restrict__ instances, uint32_t instance) {
    const float4* in = reinterpret_cast<const float4*>(instances + instance);
    return {__ldg(in), __ldg(in + 1), __ldg(in + 2)};
}

// In place: from the quads of an `Instance` to those of a staged splat. `least_level` = log2(alpha_min).
__device__ __forceinline__ void stage_splat(StagedSplat& splat, float tile_x, float tile_y, float least_level, int pair,
                                            uint32_t bit) {
    const float dx = splat.form.x - tile_x, dy = splat.form.y - tile_y;
    const float p = kFormScale * blend_sqrt(splat.form.z), r = kFormScale * splat.color.w;
    const float q = kFormScale * kFormScale * splat.form.w * blend_reciprocal(p);
    splat.form = make_float4(p, q, r, fmaf(p, dx, q * dy));
    splat.rest = make_float4(r * dy, fmaf(splat.rest.w, kLog2E, least_level), splat.rest.z, __int_as_float(pair));
    splat.color.w = __uint_as_float(bit);
}

// One that no pixel sees.
__device__ __forceinline__ StagedSplat no_splat() {
    const float4 zero = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
    return {zero, make_float4(0.0f, -__int_as_float(0x7F800000), 0.0f, __int_as_float(0x7FFFFFFF)), zero};
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

// ---- The tiles that a splat reaches ----------------------------------------------------------------------------

// The ellipse sigma <= log_reach, a little enlarged: by 0.001 for the rounding of exp, sigma, pixel coordinates and what is
// approximated here, and by the cancellation of a thin splat's conic, so that no pixel is lost. A pair too many costs time
// only.
struct Reach {
    float x, y;
    float half_x, half_y;    // half width and height of the ellipse's box
    float extreme_y;         // y - mean.y of the rightmost point; its negative for the leftmost
    float slope;             // of the axis of horizontal chords, dx / dy
    float half_chord;        // half length of the chord through the mean
    float inverse_half_y;
};

__device__ __forceinline__ Reach make_reach(float x, float y, float a, float b, float c, float log_reach) {
    // a c - b^2 by Kahan's difference of products: one rounding.
    const float bb = __fmul_rn(b, b);
    const float bb_error = __fmaf_rn(-b, b, bb);
    const float ac = __fmul_rn(a, c);
    const float det = fmaxf(__fadd_rn(__fmaf_rn(a, c, -bb), bb_error), __fmul_rn(ac, 1e-7f));
    const float inverse_det = blend_reciprocal(det), inverse_a = blend_reciprocal(a);
    const float thinness = __fmul_rn(ac, inverse_det);  // 1 / (1 - correlation^2)
    const float slack = __fmaf_rn(4e-7f, thinness, 1.001f);
    const float bound = __fmaf_rn(__fmul_rn(2.0f, log_reach), slack, 2e-3f);  // dx' conic dx <= bound

    Reach reach;
    reach.x = x;
    reach.y = y;
    reach.half_x = blend_sqrt(__fmul_rn(bound, __fmul_rn(c, inverse_det)));
    reach.half_y = blend_sqrt(__fmul_rn(bound, __fmul_rn(a, inverse_det)));
    reach.extreme_y = __fmul_rn(__fmul_rn(-b, blend_reciprocal(c)), reach.half_x);
    reach.slope = __fmul_rn(-b, inverse_a);
    reach.half_chord = blend_sqrt(__fmul_rn(bound, inverse_a));
    reach.inverse_half_y = blend_reciprocal(reach.half_y);
    return reach;
}

// First and last + 1 of the tiles whose pixel centres an interval of pixel coordinates reaches, within [0, count).
__device__ __forceinline__ int2 tile_span(float low, float high, int count) {
    const float inverse = 1.0f / kTileSize;  // a power of two: exact
    const float first = ceilf(__fmul_rn(__fadd_rn(low, 0.5f - kTileSize), inverse));
    const float last = floorf(__fmul_rn(__fadd_rn(high, -0.5f), inverse));
    const int begin = static_cast<int>(fminf(fmaxf(first, 0.0f), static_cast<float>(count)));
    const int end = static_cast<int>(fminf(fmaxf(last, -1.0f), static_cast<float>(count - 1))) + 1;
    return make_int2(begin, max(begin, end));
}

// Tile rows that the splat reaches.
__device__ __forceinline__ int2 tile_rows(const Reach& reach, int tiles_y) {
    return tile_span(__fsub_rn(reach.y, reach.half_y), __fadd_rn(reach.y, reach.half_y), tiles_y);
}

// Tile columns that the splat reaches within a tile row. The ellipse cut by the row's band of pixel centres is convex, so
// the columns that it reaches are those between its leftmost and its rightmost point.
__device__ __forceinline__ int2 tile_columns(const Reach& reach, int row, int tiles_x) {
    const float top = __fsub_rn(static_cast<float>(row * kTileSize) + 0.5f, reach.y);
    const float bottom = __fadd_rn(top, static_cast<float>(kTileSize - 1));
    const float dy_right = fminf(fmaxf(reach.extreme_y, top), bottom);
    const float dy_left = fminf(fmaxf(-reach.extreme_y, top), bottom);
    const float v_right = __fmul_rn(dy_right, reach.inverse_half_y), v_left = __fmul_rn(dy_left, reach.inverse_half_y);
    const float chord_right = blend_sqrt(fmaxf(0.0f, __fmaf_rn(-v_right, v_right, 1.0f)));
    const float chord_left = blend_sqrt(fmaxf(0.0f, __fmaf_rn(-v_left, v_left, 1.0f)));
    const float right = __fmaf_rn(reach.slope, dy_right, __fmul_rn(reach.half_chord, chord_right));
    const float left = __fmaf_rn(reach.slope, dy_left, -__fmul_rn(reach.half_chord, chord_left));
    return tile_span(__fadd_rn(reach.x, left), __fadd_rn(reach.x, right), tiles_x);
}

// Positions of the active tiles among the columns of a row: they are consecutive, as active tiles are numbered by id.
__device__ __forceinline__ int2 active_tiles(const RasterCamera& camera, const int32_t* __restrict__ active_prefix, int row,
                                             int2 columns) {
    const int base = camera.tile_base + row * camera.tiles_x;
    if (active_prefix == nullptr) return make_int2(base + columns.x, base + columns.y);
    return make_int2(active_prefix[base + columns.x], active_prefix[base + columns.y]);
}

// The view that a tile belongs to.
__device__ __forceinline__ int view_of_tile(const RasterCamera* __restrict__ cameras, int num_views, int tile_id) {
    int low = 0, high = num_views;  // the last view whose first tile is not beyond `tile_id`
    while (high - low > 1) {
        const int middle = (low + high) / 2;
        if (cameras[middle].tile_base <= tile_id) low = middle;
        else high = middle;
    }
    return low;
}

__device__ __forceinline__ TileFrame tile_frame(const RasterCamera* __restrict__ cameras, int num_views, int tile_id) {
    const RasterCamera& camera = cameras[view_of_tile(cameras, num_views, tile_id)];
    const int place = tile_id - camera.tile_base, row = place / camera.tiles_x, column = place - row * camera.tiles_x;
    const float half = 0.5f * kTileSize;
    return {camera.width, static_cast<float>(column * kTileSize) + half, static_cast<float>(row * kTileSize) + half};
}

// Centre of a pixel in the tile's frame.
__device__ __forceinline__ float2 pixel_in_tile(const TileFrame& frame, int pixel) {
    const int y = pixel / frame.width, x = pixel - y * frame.width;
    return make_float2(static_cast<float>(x) + 0.5f - frame.x, static_cast<float>(y) + 0.5f - frame.y);
}

}  // namespace turbogs
