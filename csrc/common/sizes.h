// Sizes that all kernels and their bindings know. What Python knows too comes from the header that the build makes of
// turbogs_plugin/engine/layout.py.
#pragma once

#include "layout.h"

namespace turbogs {

constexpr int kTilePixels = kTileSize * kTileSize;
constexpr int kMaxBands = (kMaxShDegree + 1) * (kMaxShDegree + 1) - 1;  // spherical harmonics above band 0
constexpr int kRecordQuads = ScreenRecord::kSize / 4;                   // of 16 bytes

// Blocks of a launch with one thread an item. For the host.
inline int blocks_for(int items, int threads) { return (items + threads - 1) / threads; }

// Tiles along a side of an image.
#ifdef __CUDACC__
__host__ __device__
#endif
inline int tiles_along(int pixels) { return (pixels + kTileSize - 1) / kTileSize; }

}  // namespace turbogs
