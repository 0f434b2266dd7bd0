// The functions of the raster kernels that are approximated or correctly rounded, as the build chooses: the one place where
// precision is chosen.
//
// Per (splat, pixel) the blending kernels need 2^x, a reciprocal and, for the density sums, a square root. By default
// these are the approximations of the special function unit (relative error about 2^-22, denormals flushed: alpha below
// 1/255 is dropped anyway). Build with TURBOGS_EXACT_MATH=1 for the correctly rounded ones.
#pragma once

#include <cuda_runtime.h>

#ifndef TURBOGS_EXACT_MATH
#define TURBOGS_EXACT_MATH 0
#endif

namespace turbogs {

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

}  // namespace turbogs
