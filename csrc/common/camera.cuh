// A pinhole camera as the kernels read it, and where the perspective is linearised: one version for the projection
// and for its backward pass.
#pragma once

#include <cuda_runtime.h>

namespace turbogs {

struct Pinhole {
    float rotation[9];     // row-major, world to camera
    float translation[3];
    float center[3];       // of the camera in the world
    float fx, fy, cx, cy;  // pixels
};

// Bounds of x/z and y/z where the Jacobian is taken: within 15 % of the image's edge, as in gsplat. Far outside, the
// linear approximation would blow a splat up.
struct SlopeBounds {
    float low_x, high_x, low_y, high_y;
};

// `viewmat`: [4, 4], `intrinsics`: [3, 3], row-major.
__device__ __forceinline__ Pinhole load_pinhole(const float* __restrict__ viewmat,
                                                const float* __restrict__ intrinsics) {
    Pinhole camera;
#pragma unroll
    for (int i = 0; i < 3; ++i) {
#pragma unroll
        for (int j = 0; j < 3; ++j) camera.rotation[3 * i + j] = viewmat[4 * i + j];
        camera.translation[i] = viewmat[4 * i + 3];
    }
#pragma unroll
    for (int j = 0; j < 3; ++j) {
        camera.center[j] =
            -(camera.rotation[j] * camera.translation[0] + camera.rotation[3 + j] * camera.translation[1] +
              camera.rotation[6 + j] * camera.translation[2]);
    }
    camera.fx = intrinsics[0];
    camera.fy = intrinsics[4];
    camera.cx = intrinsics[2];
    camera.cy = intrinsics[5];
    return camera;
}

__device__ __forceinline__ SlopeBounds slope_bounds(const Pinhole& camera, int width, int height) {
    const float margin_x = 0.15f * width / camera.fx, margin_y = 0.15f * height / camera.fy;
    return {-(camera.cx / camera.fx + margin_x), (width - camera.cx) / camera.fx + margin_x,
            -(camera.cy / camera.fy + margin_y), (height - camera.cy) / camera.fy + margin_y};
}

// From the world to the camera.
__device__ __forceinline__ void camera_point(const Pinhole& camera, const float mean[3], float point[3]) {
    const float* W = camera.rotation;
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        point[i] = W[3 * i] * mean[0] + W[3 * i + 1] * mean[1] + W[3 * i + 2] * mean[2] + camera.translation[i];
    }
}

}  // namespace turbogs
