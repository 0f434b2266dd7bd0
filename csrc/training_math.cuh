// What the training kernels take from the hardware by name: approximations of the special function unit, where no correctly
// rounded result is needed, and copies to shared memory that nobody waits for until told to.
#pragma once

#include <cfloat>

#include <cuda_pipeline.h>
#include <cuda_runtime.h>

namespace turbogs {

// Relative errors about 2^-22. To these two, denormal input is zero and gives infinity.
__device__ __forceinline__ float approximate_reciprocal(float x) {
    float result;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(x));
    return result;
}

__device__ __forceinline__ float approximate_rsqrt(float x) {
    float result;
    asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(x));
    return result;
}

// Of 0 it is 0; denormal input counts.
__device__ __forceinline__ float approximate_sqrt(float x) {
    float result;
    asm("sqrt.approx.f32 %0, %1;" : "=f"(result) : "f"(x));
    return result;
}

// Absolute error 2^-22 within 0.5 .. 2, else relative.
__device__ __forceinline__ float approximate_log2(float x) {
    float result;
    asm("lg2.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(x));
    return result;
}

__device__ __forceinline__ bool is_finite(float value) { return fabsf(value) <= FLT_MAX; }
__device__ __forceinline__ bool is_finite(double value) { return fabs(value) <= DBL_MAX; }

template <int kFloats>
__device__ __forceinline__ void copy_async(float* shared, const float* global) {
    __pipeline_memcpy_async(shared, global, kFloats * sizeof(float));
}

// Of this thread's copies; what others copied needs a barrier after it.
__device__ __forceinline__ void wait_for_copies() {
    __pipeline_commit();
    __pipeline_wait_prior(0);
}

}  // namespace turbogs
