// Which tiles a splat reaches. The projection counts them and intersection_scatter.cu lists them, and the two must
// agree to the bit: so both call the functions here, written with intrinsics that the compiler neither contracts nor
// reorders.
#pragma once

#include "common/approximate_math.cuh"
#include "raster/raster_params.h"

namespace turbogs {

// The ellipse sigma <= log_reach, a little enlarged, so that no pixel is lost: by kSlack for the rounding of exp,
// sigma, pixel coordinates and what is approximated here, and by kThinSlack for the cancellation of a thin splat's
// conic. An intersection too many only costs time.
constexpr float kSlack = 1e-3f;        // of sigma, relative and absolute
constexpr float kThinSlack = 4e-7f;    // times 1 / (1 - correlation^2): a few units of float32's last place
constexpr float kThinnestDet = 1e-7f;  // smallest determinant of a conic, as a share of a * c: float32 knows no less

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
    const float det = fmaxf(__fadd_rn(__fmaf_rn(a, c, -bb), bb_error), __fmul_rn(ac, kThinnestDet));
    const float inverse_det = approximate_reciprocal(det), inverse_a = approximate_reciprocal(a);
    const float thinness = __fmul_rn(ac, inverse_det);  // 1 / (1 - correlation^2)
    const float slack = __fmaf_rn(kThinSlack, thinness, 1.0f + kSlack);
    const float bound = __fmaf_rn(__fmul_rn(2.0f, log_reach), slack, 2.0f * kSlack);  // dx' conic dx <= bound

    Reach reach;
    reach.x = x;
    reach.y = y;
    reach.half_x = approximate_sqrt_flushed(__fmul_rn(bound, __fmul_rn(c, inverse_det)));
    reach.half_y = approximate_sqrt_flushed(__fmul_rn(bound, __fmul_rn(a, inverse_det)));
    reach.extreme_y = __fmul_rn(__fmul_rn(-b, approximate_reciprocal(c)), reach.half_x);
    reach.slope = __fmul_rn(-b, inverse_a);
    reach.half_chord = approximate_sqrt_flushed(__fmul_rn(bound, inverse_a));
    reach.inverse_half_y = approximate_reciprocal(reach.half_y);
    return reach;
}

// First and last + 1 of the tiles whose pixel centres an interval of pixel coordinates reaches, within [0, count), if
// the first tile begins `origin` pixels before the image.
__device__ __forceinline__ int2 tile_span(float low, float high, int origin, int count) {
    const float inverse = 1.0f / kTileSize;  // a power of two: exact
    const float start = static_cast<float>(origin);
    const float first = ceilf(__fmul_rn(__fadd_rn(low, start + 0.5f - kTileSize), inverse));
    const float last = floorf(__fmul_rn(__fadd_rn(high, start - 0.5f), inverse));
    const int begin = static_cast<int>(fminf(fmaxf(first, 0.0f), static_cast<float>(count)));
    const int end = static_cast<int>(fminf(fmaxf(last, -1.0f), static_cast<float>(count - 1))) + 1;
    return make_int2(begin, max(begin, end));
}

// Tile rows that the splat reaches.
__device__ __forceinline__ int2 tile_rows(const Reach& reach, const RasterCamera& camera) {
    return tile_span(__fsub_rn(reach.y, reach.half_y), __fadd_rn(reach.y, reach.half_y), camera.origin_y,
                     camera.tiles_y);
}

// Tile columns that the splat reaches within a tile row. The ellipse cut by the row's band of pixel centres is
// convex, so the columns that it reaches are those between its leftmost and its rightmost point.
__device__ __forceinline__ int2 tile_columns(const Reach& reach, int row, const RasterCamera& camera) {
    const float top = __fsub_rn(static_cast<float>(row * kTileSize - camera.origin_y) + 0.5f, reach.y);
    const float bottom = __fadd_rn(top, static_cast<float>(kTileSize - 1));
    const float dy_right = fminf(fmaxf(reach.extreme_y, top), bottom);
    const float dy_left = fminf(fmaxf(-reach.extreme_y, top), bottom);
    const float v_right = __fmul_rn(dy_right, reach.inverse_half_y), v_left = __fmul_rn(dy_left, reach.inverse_half_y);
    const float chord_right = approximate_sqrt_flushed(fmaxf(0.0f, __fmaf_rn(-v_right, v_right, 1.0f)));
    const float chord_left = approximate_sqrt_flushed(fmaxf(0.0f, __fmaf_rn(-v_left, v_left, 1.0f)));
    const float right = __fmaf_rn(reach.slope, dy_right, __fmul_rn(reach.half_chord, chord_right));
    const float left = __fmaf_rn(reach.slope, dy_left, -__fmul_rn(reach.half_chord, chord_left));
    return tile_span(__fadd_rn(reach.x, left), __fadd_rn(reach.x, right), camera.origin_x, camera.tiles_x);
}

// Positions of the active tiles among the columns of a row: they are consecutive, as active tiles are numbered by id.
__device__ __forceinline__ int2 active_tiles(const RasterCamera& camera, const int32_t* __restrict__ active_prefix,
                                             int row, int2 columns) {
    const int base = camera.tile_base + row * camera.tiles_x;
    if (active_prefix == nullptr) return make_int2(base + columns.x, base + columns.y);
    return make_int2(active_prefix[base + columns.x], active_prefix[base + columns.y]);
}

}  // namespace turbogs
