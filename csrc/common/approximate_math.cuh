// Functions that need not be correctly rounded, from the special function unit of the GPU. Precision is chosen here and
// nowhere else. Relative errors are about 2^-22.
// Correctly rounded functions would cost 6 to 19 % of a forward and backward pass, at no error that shows beside
// float32's own.
#pragma once

#include <cfloat>

#include <cuda_runtime.h>

namespace turbogs {

// The body of each. A macro, as the instruction of inline PTX is a literal.
#define TURBOGS_APPROXIMATE(instruction)                 \
    float result;                                        \
    asm(instruction " %0, %1;" : "=f"(result) : "f"(x)); \
    return result

// 2^x. A denormal result is zero.
__device__ __forceinline__ float approximate_exp2(float x) { TURBOGS_APPROXIMATE("ex2.approx.ftz.f32"); }

// Absolute error 2^-22 within 0.5 .. 2, else relative.
__device__ __forceinline__ float approximate_log2(float x) { TURBOGS_APPROXIMATE("lg2.approx.ftz.f32"); }

// 1 / x. Denormal input is zero and gives infinity.
__device__ __forceinline__ float approximate_reciprocal(float x) { TURBOGS_APPROXIMATE("rcp.approx.ftz.f32"); }

// 1 / sqrt(x). Denormal input is zero and gives infinity.
__device__ __forceinline__ float approximate_rsqrt(float x) { TURBOGS_APPROXIMATE("rsqrt.approx.ftz.f32"); }

// sqrt(x); of 0 it is 0. Denormal input counts.
__device__ __forceinline__ float approximate_sqrt(float x) { TURBOGS_APPROXIMATE("sqrt.approx.f32"); }

// sqrt(x), faster: denormal input is zero.
__device__ __forceinline__ float approximate_sqrt_flushed(float x) { TURBOGS_APPROXIMATE("sqrt.approx.ftz.f32"); }

#undef TURBOGS_APPROXIMATE

__device__ __forceinline__ bool is_finite(float value) { return fabsf(value) <= FLT_MAX; }
__device__ __forceinline__ bool is_finite(double value) { return fabs(value) <= DBL_MAX; }

}  // namespace turbogs
