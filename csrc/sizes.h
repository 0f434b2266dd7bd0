// Sizes that the raster and the training kernels, their bindings and the Python side agree on.
#pragma once

namespace turbogs {

constexpr int kTileSize = 16;    // side of a tile, pixels (TILE_SIZE in types.py)
constexpr int kMaxViews = 128;   // views of one batch: their sizes travel as a kernel argument
constexpr int kMaxDegree = 3;    // of the spherical harmonics
constexpr int kMaxBands = (kMaxDegree + 1) * (kMaxDegree + 1) - 1;  // harmonics above band 0

// Screen-gradient record of (view, Gaussian): 0-1 d/dmean2d, 2-4 d/dconic (b's counts both off-diagonal entries), 5-7 d/dcolor
// behind the clamp at 0, 8 d/dopacity after the sigmoid, 9-10 sums of |d/dmean2d| per pixel, 11 sum e*w, 12 sum D*w, 13 sum w,
// 14 d/ddepth, 15 unused. 9, 10 and 12 are made where densification asks for them.
constexpr int kRecordFloats = 16;
constexpr int kRecordQuads = kRecordFloats / 4;

}  // namespace turbogs
