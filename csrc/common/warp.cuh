// Lanes of a warp and sums over them.
#pragma once

#include "common/batch.h"

namespace turbogs {

constexpr uint32_t kFullWarp = 0xFFFFFFFFu;  // mask of all lanes

// Lane and warp of this thread, in a block of one dimension.
__device__ __forceinline__ int this_lane() { return threadIdx.x % kWarpSize; }
__device__ __forceinline__ int this_warp() { return threadIdx.x / kWarpSize; }

// Mask of the lanes below one.
__device__ __forceinline__ uint32_t lanes_below(int lane) { return (1u << lane) - 1u; }

// Sum over all lanes, the same in each.
template <class Number>
__device__ __forceinline__ Number warp_sum(Number value) {
#pragma unroll
    for (int step = kWarpSize / 2; step > 0; step /= 2) value += __shfl_xor_sync(kFullWarp, value, step);
    return value;
}

// Sum over a block of kWarps warps, the same in each thread. Barriers inside, so `scratch` may be used again.
template <int kWarps, class Number>
__device__ __forceinline__ Number block_sum(Number value, Number (&scratch)[kWarps]) {
    value = warp_sum(value);
    __syncthreads();  // the last use of `scratch` is over
    if (this_lane() == 0) scratch[this_warp()] = value;
    __syncthreads();
    Number total = 0;
#pragma unroll
    for (int warp = 0; warp < kWarps; ++warp) total += scratch[warp];
    return total;
}

// Sums of 8 values over the warp, the same in every lane: the lanes first divide the values among themselves.
__device__ __forceinline__ void warp_sums(float (&values)[8]) {
    const int lane = this_lane();
#pragma unroll
    for (int half = 4; half > 0; half >>= 1) {
        const bool upper = (lane & (4 * half)) != 0;
#pragma unroll
        for (int i = 0; i < half; ++i) {
            const float given = upper ? values[i] : values[i + half], kept = upper ? values[i + half] : values[i];
            values[i] = kept + __shfl_xor_sync(kFullWarp, given, 4 * half);
        }
    }
    const float of_two = values[0] + __shfl_xor_sync(kFullWarp, values[0], 2);
    const float sum = of_two + __shfl_xor_sync(kFullWarp, of_two, 1);  // of value lane / 4
#pragma unroll
    for (int i = 0; i < 8; ++i) values[i] = __shfl_sync(kFullWarp, sum, 4 * i);
}

// Sum over the lanes up to and including this one.
template <class Number>
__device__ __forceinline__ Number sum_to_lane(Number value, int lane) {
#pragma unroll
    for (int step = 1; step < kWarpSize; step *= 2) {
        const Number below = __shfl_up_sync(kFullWarp, value, step);
        if (lane >= step) value += below;
    }
    return value;
}

}  // namespace turbogs
