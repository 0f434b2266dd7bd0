// Copies to shared memory that nobody waits for until told to.
#pragma once

#include <cuda_pipeline.h>
#include <cuda_runtime.h>

namespace turbogs {

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
