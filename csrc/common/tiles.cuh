// Which view of a batch owns a tile.
#pragma once

namespace turbogs {

// Tiles are numbered view after view: the view is the last one whose first tile, `tile_base`, is not beyond the tile.
template <class View>
__device__ __forceinline__ int view_of_tile(const View* __restrict__ views, int num_views, int tile) {
    int low = 0, high = num_views;
    while (high - low > 1) {
        const int middle = (low + high) / 2;
        if (views[middle].tile_base <= tile) low = middle;
        else high = middle;
    }
    return low;
}

}  // namespace turbogs
