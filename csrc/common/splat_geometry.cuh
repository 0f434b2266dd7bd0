// The geometry of a Gaussian in a view: its rotation, where its mean lies on the screen, and the covariance of its
// splat. The projection draws with it, and the backward pass computes it again in registers instead of keeping it in
// memory.
//
// With J the 2x3 Jacobian of the perspective, W the rotation of the view and M = R diag(s) the Gaussian's scaled
// axes: T = J W, U = T M, and the covariance on the screen is U U^T + eps2d I.
#pragma once

#include "common/camera.cuh"

namespace turbogs {

constexpr float kQuaternionMin = 1e-30f;  // largest component of a quaternion that still has a direction

// Normalises a quaternion wxyz, whose norm may be tiny or huge; returns 1 / norm. One without a direction is the
// identity, and 0 is returned: it has no gradient.
__device__ __forceinline__ float unit_quaternion(const float raw[4], float unit[4]) {
    // Divided by the largest component first, so that the squares of tiny and huge quaternions stay in range.
    const float size = fmaxf(fmaxf(fabsf(raw[0]), fabsf(raw[1])), fmaxf(fabsf(raw[2]), fabsf(raw[3])));
    const bool directed = size > kQuaternionMin;
    const float inverse_size = directed ? 1.0f / size : 0.0f;
    float norm2 = 0.0f;
#pragma unroll
    for (int i = 0; i < 4; ++i) {
        unit[i] = directed ? raw[i] * inverse_size : (i == 0 ? 1.0f : 0.0f);
        norm2 += unit[i] * unit[i];
    }
    const float inverse_norm = 1.0f / sqrtf(norm2);
#pragma unroll
    for (int i = 0; i < 4; ++i) unit[i] *= inverse_norm;
    return inverse_norm * inverse_size;
}

// Rotation times diag(scale), row-major.
__device__ __forceinline__ void scaled_rotation(const float unit[4], const float scale[3], float axes[9]) {
    const float w = unit[0], x = unit[1], y = unit[2], z = unit[3];
    const float rotation[9] = {
        1.0f - 2.0f * (y * y + z * z), 2.0f * (x * y - w * z),        2.0f * (x * z + w * y),
        2.0f * (x * y + w * z),        1.0f - 2.0f * (x * x + z * z), 2.0f * (y * z - w * x),
        2.0f * (x * z - w * y),        2.0f * (y * z + w * x),        1.0f - 2.0f * (x * x + y * y)};
#pragma unroll
    for (int i = 0; i < 3; ++i) {
#pragma unroll
        for (int j = 0; j < 3; ++j) axes[3 * i + j] = rotation[3 * i + j] * scale[j];
    }
}

// The perspective at a point of the camera's space, [x, y, z].
struct Perspective {
    float inverse_depth;         // 1 / z
    float slope_x, slope_y;      // x / z, y / z
    float clamped_x, clamped_y;  // slopes at which the Jacobian is taken
    float j00, j11;              // J's diagonal; its last column is -j00 * clamped_x, -j11 * clamped_y
};

__device__ __forceinline__ Perspective perspective_at(const Pinhole& camera, const SlopeBounds& bounds,
                                                      const float point[3]) {
    Perspective view;
    view.inverse_depth = 1.0f / point[2];
    view.slope_x = point[0] * view.inverse_depth;
    view.slope_y = point[1] * view.inverse_depth;
    view.clamped_x = fminf(bounds.high_x, fmaxf(bounds.low_x, view.slope_x));
    view.clamped_y = fminf(bounds.high_y, fmaxf(bounds.low_y, view.slope_y));
    view.j00 = camera.fx * view.inverse_depth;
    view.j11 = camera.fy * view.inverse_depth;
    return view;
}

// The covariance on the screen, and what it is made of.
struct ScreenCovariance {
    float t0[3], t1[3];  // rows of T
    float u[3], v[3];    // rows of U
    float cross[3];      // u x v
    float variance_x, variance_y, covariance;
    float determinant;
};

__device__ __forceinline__ ScreenCovariance screen_covariance(const Pinhole& camera, const Perspective& view,
                                                              const float axes[9], float eps2d) {
    const float* W = camera.rotation;
    ScreenCovariance out;
    float *t0 = out.t0, *t1 = out.t1, *u = out.u, *v = out.v;
#pragma unroll
    for (int l = 0; l < 3; ++l) {
        t0[l] = view.j00 * (W[l] - view.clamped_x * W[6 + l]);
        t1[l] = view.j11 * (W[3 + l] - view.clamped_y * W[6 + l]);
    }
#pragma unroll
    for (int j = 0; j < 3; ++j) {
        u[j] = t0[0] * axes[j] + t0[1] * axes[3 + j] + t0[2] * axes[6 + j];
        v[j] = t1[0] * axes[j] + t1[1] * axes[3 + j] + t1[2] * axes[6 + j];
    }
    const float uu = u[0] * u[0] + u[1] * u[1] + u[2] * u[2];
    const float vv = v[0] * v[0] + v[1] * v[1] + v[2] * v[2];
    out.covariance = u[0] * v[0] + u[1] * v[1] + u[2] * v[2];
    // Lagrange's identity: the determinant as a sum of squares does not cancel, however thin the splat.
    out.cross[0] = u[1] * v[2] - u[2] * v[1];
    out.cross[1] = u[2] * v[0] - u[0] * v[2];
    out.cross[2] = u[0] * v[1] - u[1] * v[0];
    out.determinant = out.cross[0] * out.cross[0] + out.cross[1] * out.cross[1] + out.cross[2] * out.cross[2] +
                      eps2d * (uu + vv + eps2d);
    out.variance_x = uu + eps2d;
    out.variance_y = vv + eps2d;
    return out;
}

// Unit vector from a camera to a point, zero where they coincide. Returns the inverse of their distance.
__device__ __forceinline__ float view_direction(const Pinhole& camera, const float point[3], float direction[3]) {
#pragma unroll
    for (int i = 0; i < 3; ++i) direction[i] = point[i] - camera.center[i];
    const float length2 = direction[0] * direction[0] + direction[1] * direction[1] + direction[2] * direction[2];
    const float inverse_length = length2 > 0.0f ? rsqrtf(length2) : 0.0f;
#pragma unroll
    for (int i = 0; i < 3; ++i) direction[i] *= inverse_length;
    return inverse_length;
}

}  // namespace turbogs
