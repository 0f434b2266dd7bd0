// From the screen back to the parameters of one Gaussian in one view: the vector-Jacobian product of the projection
// (gsplat's, with its clamped Jacobian) and of the spherical harmonics, recomputed in registers.
//
// With T, M and U as in splat_geometry.cuh, the gradient V of the covariance on the screen gives Q = 2 V U, and
// everything else follows from Q: d/dM = T^T Q, d/dlog s_j = sum_i U_ij Q_ij, d/dT = Q M^T.
#pragma once

#include "common/spherical_harmonics.cuh"
#include "common/splat_geometry.cuh"
#include "optimizer/optimizer_params.h"

namespace turbogs {

// What all views of a Gaussian share.
struct GaussianShape {
    float mean[3];
    float scale[3];       // standard deviations
    float quat[4];        // normalised, wxyz
    float inverse_norm;   // 1 / |unnormalised quaternion|
    float spread[9];      // M = R diag(scale), row-major
};

// A view as the kernels keep it in shared memory: 25 words, so that lanes may read different ones at once.
struct ViewCamera : Pinhole {
    SlopeBounds slopes;
    float grad_scale_x, grad_scale_y;  // K * width / 2, K * height / 2
};

__device__ __forceinline__ ViewCamera load_camera(const float* __restrict__ viewmat,
                                                  const float* __restrict__ intrinsics, int width, int height,
                                                  int num_views) {
    ViewCamera camera;
    static_cast<Pinhole&>(camera) = load_pinhole(viewmat, intrinsics);
    camera.slopes = slope_bounds(camera, width, height);
    camera.grad_scale_x = 0.5f * num_views * width;
    camera.grad_scale_y = 0.5f * num_views * height;
    return camera;
}

__device__ __forceinline__ GaussianShape make_shape(const float mean[3], const float log_scale[3],
                                                    const float quat[4]) {
    GaussianShape shape;
    shape.inverse_norm = unit_quaternion(quat, shape.quat);
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        shape.mean[i] = mean[i];
        shape.scale[i] = expf(log_scale[i]);
    }
    scaled_rotation(shape.quat, shape.scale, shape.spread);
    return shape;
}

// Mean, scales and quaternion from the gradients of the screen mean, the conic (a, b, c; b's counts both off-diagonal
// entries) and the depth. Sets those three of `row`; `color_backward` adds the direction's part of the mean.
__device__ __forceinline__ void geometry_backward(const GaussianShape& shape, const ViewCamera& camera, float eps2d,
                                                  const float grad_mean2d[2], const float grad_conic[3],
                                                  float grad_depth, float row[ParameterRow::kSize]) {
    const float* W = camera.rotation;
    const float* M = shape.spread;
    float point[3];
    camera_point(camera, shape.mean, point);
    const Perspective view = perspective_at(camera, camera.slopes, point);
    const ScreenCovariance screen = screen_covariance(camera, view, M, eps2d);
    const float *T0 = screen.t0, *T1 = screen.t1, *U0 = screen.u, *U1 = screen.v, *cross = screen.cross;
    const float inverse_det = 1.0f / screen.determinant;
    const float a = screen.variance_y * inverse_det, b = -screen.covariance * inverse_det;
    const float c = screen.variance_x * inverse_det;

    // With A the conic, G its symmetric gradient and y_j = A u_j, the covariance's gradient -A G A gives Q_j = -2 A G
    // y_j and d/dlog s_j = -2 y_j . G y_j. In y_j = adj(C) u_j / det the part of u_j itself is exactly zero, so it is
    // left out: for a needle it would be all of the sum, and what remains its rounding.
    const float g00 = grad_conic[0], g01 = 0.5f * grad_conic[1], g11 = grad_conic[2];
    float Q0[3], Q1[3];
#pragma unroll
    for (int j = 0; j < 3; ++j) {
        const int k = (j + 1) % 3, l = (j + 2) % 3;
        const float y0 = (eps2d * U0[j] + U1[k] * cross[l] - U1[l] * cross[k]) * inverse_det;
        const float y1 = (eps2d * U1[j] - U0[k] * cross[l] + U0[l] * cross[k]) * inverse_det;
        const float w0 = g00 * y0 + g01 * y1, w1 = g01 * y0 + g11 * y1;
        Q0[j] = -2.0f * (a * w0 + b * w1);
        Q1[j] = -2.0f * (b * w0 + c * w1);
        row[ParameterRow::kScales + j] = -2.0f * (y0 * w0 + y1 * w1);
    }

    // d/dT = Q M^T, and d/dJ = d/dT W^T at J's four entries.
    float grad_j00 = 0.0f, grad_j02 = 0.0f, grad_j11 = 0.0f, grad_j12 = 0.0f;
#pragma unroll
    for (int l = 0; l < 3; ++l) {
        const float grad_t0 = Q0[0] * M[3 * l] + Q0[1] * M[3 * l + 1] + Q0[2] * M[3 * l + 2];
        const float grad_t1 = Q1[0] * M[3 * l] + Q1[1] * M[3 * l + 1] + Q1[2] * M[3 * l + 2];
        grad_j00 += grad_t0 * W[l];
        grad_j02 += grad_t0 * W[6 + l];
        grad_j11 += grad_t1 * W[3 + l];
        grad_j12 += grad_t1 * W[6 + l];
    }

    float grad_point[3];
    grad_point[0] = view.j00 * grad_mean2d[0];
    grad_point[1] = view.j11 * grad_mean2d[1];
    grad_point[2] =
        grad_depth - (view.j00 * view.slope_x * grad_mean2d[0] + view.j11 * view.slope_y * grad_mean2d[1]);
    // Inside the limits J's last column follows x and z; outside it depends on z alone.
    const float rz2 = view.inverse_depth * view.inverse_depth;
    const float column_x = camera.fx * rz2 * grad_j02, column_y = camera.fy * rz2 * grad_j12;
    const bool inside_x = view.slope_x <= camera.slopes.high_x && view.slope_x >= camera.slopes.low_x;
    const bool inside_y = view.slope_y <= camera.slopes.high_y && view.slope_y >= camera.slopes.low_y;
    grad_point[0] -= inside_x ? column_x : 0.0f;
    grad_point[1] -= inside_y ? column_y : 0.0f;
    grad_point[2] += (inside_x ? 2.0f : 1.0f) * column_x * view.clamped_x +
                     (inside_y ? 2.0f : 1.0f) * column_y * view.clamped_y -
                     rz2 * (camera.fx * grad_j00 + camera.fy * grad_j11);
#pragma unroll
    for (int l = 0; l < 3; ++l) {
        row[ParameterRow::kMeans + l] =
            W[l] * grad_point[0] + W[3 + l] * grad_point[1] + W[6 + l] * grad_point[2];
    }

    // d/dR_ij = T_0i Q_0j s_j + T_1i Q_1j s_j, then the quaternion's own derivative and its normalisation.
    float G[9];
#pragma unroll
    for (int j = 0; j < 3; ++j) {
        const float q0 = Q0[j] * shape.scale[j], q1 = Q1[j] * shape.scale[j];
#pragma unroll
        for (int i = 0; i < 3; ++i) G[3 * i + j] = T0[i] * q0 + T1[i] * q1;
    }
    const float w = shape.quat[0], x = shape.quat[1], y = shape.quat[2], z = shape.quat[3];
    const float d21 = G[7] - G[5], d02 = G[2] - G[6], d10 = G[3] - G[1];
    const float s10 = G[3] + G[1], s20 = G[6] + G[2], s21 = G[7] + G[5];
    float direct[4];
    direct[0] = 2.0f * (x * d21 + y * d02 + z * d10);
    direct[1] = 2.0f * (w * d21 + y * s10 + z * s20 - 2.0f * x * (G[4] + G[8]));
    direct[2] = 2.0f * (w * d02 + x * s10 + z * s21 - 2.0f * y * (G[0] + G[8]));
    direct[3] = 2.0f * (w * d10 + x * s20 + y * s21 - 2.0f * z * (G[0] + G[4]));
    const float along = direct[0] * w + direct[1] * x + direct[2] * y + direct[3] * z;
#pragma unroll
    for (int i = 0; i < 4; ++i) {
        row[ParameterRow::kQuats + i] = (direct[i] - along * shape.quat[i]) * shape.inverse_norm;
    }
}

// Colour of one view back to band 0 and, through the direction, to the mean, which is added to. `coefficients`: [3 *
// bands] of this Gaussian. `grad_color` comes in behind the clamp at 0 and leaves masked by it.
__device__ __forceinline__ void color_backward(const GaussianShape& shape, const ViewCamera& camera, const float sh0[3],
                                               int degree, const float* coefficients, float grad_color[3],
                                               float row[ParameterRow::kSize]) {
    float direction[3];
    const float inverse_length = view_direction(camera, shape.mean, direction);
    float color[3];
#pragma unroll
    for (int c = 0; c < 3; ++c) color[c] = kShBand0 * sh0[c] + 0.5f;
    visit_harmonics(degree, direction[0], direction[1], direction[2], [&](int b, float value) {
#pragma unroll
        for (int c = 0; c < 3; ++c) color[c] += value * coefficients[3 * b + c];
    });
#pragma unroll
    for (int c = 0; c < 3; ++c) {
        grad_color[c] = color[c] >= 0.0f ? grad_color[c] : 0.0f;
        row[ParameterRow::kSh0 + c] = kShBand0 * grad_color[c];
    }
    float dots[kMaxBands];
#pragma unroll
    for (int band = 1; band <= kMaxShDegree; ++band) {
        if (band > degree) break;
#pragma unroll
        for (int b = band * band - 1; b < (band + 1) * (band + 1) - 1; ++b) {
            dots[b] = coefficients[3 * b] * grad_color[0] + coefficients[3 * b + 1] * grad_color[1] +
                      coefficients[3 * b + 2] * grad_color[2];
        }
    }
    float grad_unit[3];
    harmonics_backward(degree, direction[0], direction[1], direction[2], dots, grad_unit);
    const float along =
        grad_unit[0] * direction[0] + grad_unit[1] * direction[1] + grad_unit[2] * direction[2];
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        row[ParameterRow::kMeans + i] += (grad_unit[i] - along * direction[i]) * inverse_length;
    }
}

// Adds one view's gradient of the harmonics, [3 * bands]. `grad_color`: masked by the clamp.
__device__ __forceinline__ void add_harmonics_gradient(const float mean[3], const ViewCamera& camera, int degree,
                                                       const float grad_color[3], float* gradients) {
    float direction[3];
    view_direction(camera, mean, direction);
    visit_harmonics(degree, direction[0], direction[1], direction[2], [&](int b, float value) {
#pragma unroll
        for (int c = 0; c < 3; ++c) gradients[3 * b + c] += value * grad_color[c];
    });
}

}  // namespace turbogs
