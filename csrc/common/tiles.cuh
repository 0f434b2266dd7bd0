// Bisection, and which view of a batch owns a tile.
#pragma once

namespace turbogs {

// The first number of low .. high - 1 for which `before` does not hold, or `high`; it holds for all smaller ones.
template <class Before>
__device__ __forceinline__ int partition_point(int low, int high, const Before& before) {
    while (low < high) {
        const int middle = (low + high) / 2;
        if (before(middle)) low = middle + 1;
        else high = middle;
    }
    return low;
}

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
