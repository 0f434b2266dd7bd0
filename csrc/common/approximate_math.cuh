// Functions that need not be correctly rounded, from the special function unit of the GPU: the one place where
// precision is chosen. Relative errors are about 2^-22.
//
// A build with TURBOGS_EXACT_MATH=1 has correctly rounded functions in their place, to measure what they cost: 6 to
// 19 % of a forward and backward pass, at no error that shows beside float32's own (docs/performance.md).
#pragma once

#include <cfloat>

#include <cuda_runtime.h>

#ifndef TURBOGS_EXACT_MATH
#define TURBOGS_EXACT_MATH 0
#endif

namespace turbogs {

// 2^x. A denormal result is zero.
__device__ __forceinline__ float approximate_exp2(float x) {
#if TURBOGS_EXACT_MATH
    return exp2f(x);
#else
    float result;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(x));
    return result;
#endif
}

// Absolute error 2^-22 within 0.5 .. 2, else relative.
__device__ __forceinline__ float approximate_log2(float x) {
#if TURBOGS_EXACT_MATH
    return log2f(x);
#else
    float result;
    asm("lg2.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(x));
    return result;
#endif
}

// 1 / x. Denormal input is zero and gives infinity.
__device__ __forceinline__ float approximate_reciprocal(float x) {
#if TURBOGS_EXACT_MATH
    return __frcp_rn(x);
#else
    float result;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(x));
    return result;
#endif
}

// 1 / sqrt(x). Denormal input is zero and gives infinity.
__device__ __forceinline__ float approximate_rsqrt(float x) {
#if TURBOGS_EXACT_MATH
    return __frsqrt_rn(x);
#else
    float result;
    asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(x));
    return result;
#endif
}

// sqrt(x); of 0 it is 0. Denormal input counts.
__device__ __forceinline__ float approximate_sqrt(float x) {
#if TURBOGS_EXACT_MATH
    return __fsqrt_rn(x);
#else
    float result;
    asm("sqrt.approx.f32 %0, %1;" : "=f"(result) : "f"(x));
    return result;
#endif
}

// The same, faster: denormal input is zero.
__device__ __forceinline__ float approximate_sqrt_flushed(float x) {
#if TURBOGS_EXACT_MATH
    return __fsqrt_rn(x);
#else
    float result;
    asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(x));
    return result;
#endif
}

__device__ __forceinline__ bool is_finite(float value) { return fabsf(value) <= FLT_MAX; }
__device__ __forceinline__ bool is_finite(double value) { return fabs(value) <= DBL_MAX; }

}  // namespace turbogs
