// From the screen back to the parameters of one Gaussian in one view: the vector-Jacobian product of the projection
// (gsplat's, with its clamped Jacobian) and of the spherical harmonics, recomputed in registers.
//
// With T = J W (J the 2x3 Jacobian of the perspective, W the view rotation), M = R diag(s) and U = T M, the screen
// covariance is U U^T + eps2d I. Its gradient V gives Q = 2 V U, and everything else follows from Q:
// d/dM = T^T Q, d/dlog s_j = sum_i U_ij Q_ij, d/dT = Q M^T.
#pragma once

#include "training_math.cuh"
#include "training_params.h"

namespace turbogs {

constexpr float kShBand0 = 0.28209479177387814f;
constexpr float kQuaternionMin = 1e-30f;  // largest component of a quaternion that still has a direction

// What all views of a Gaussian share.
struct GaussianShape {
    float mean[3];
    float scale[3];       // standard deviations
    float quat[4];        // normalised, wxyz
    float inverse_norm;   // 1 / |unnormalised quaternion|
    float spread[9];      // M = R diag(scale), row-major
};

// A pinhole camera as the kernels keep it in shared memory.
struct ViewCamera {
    float rotation[9];  // row-major, world to camera
    float translation[3];
    float center[3];  // of the camera in the world
    float fx, fy, cx, cy;
    float limit_x_low, limit_x_high, limit_y_low, limit_y_high;  // bounds of x/z and y/z in the Jacobian
    float grad_scale_x, grad_scale_y;                            // K * width / 2, K * height / 2
};

// Gradient of the 14 parameters that a view's row holds, in the order of the blocks.
struct RowGradient {
    float mean[3];
    float scale[3];
    float quat[4];
    float sh0[3];
    float opacity;
};

__device__ __forceinline__ ViewCamera load_camera(const float* __restrict__ viewmat, const float* __restrict__ intrinsics,
                                                  int width, int height, int num_views) {
    ViewCamera camera;
#pragma unroll
    for (int i = 0; i < 3; ++i) {
#pragma unroll
        for (int j = 0; j < 3; ++j) camera.rotation[3 * i + j] = viewmat[4 * i + j];
        camera.translation[i] = viewmat[4 * i + 3];
    }
#pragma unroll
    for (int j = 0; j < 3; ++j) {
        camera.center[j] = -(camera.rotation[j] * camera.translation[0] + camera.rotation[3 + j] * camera.translation[1] +
                             camera.rotation[6 + j] * camera.translation[2]);
    }
    camera.fx = intrinsics[0];
    camera.fy = intrinsics[4];
    camera.cx = intrinsics[2];
    camera.cy = intrinsics[5];
    const float margin_x = 0.15f * width / camera.fx;
    const float margin_y = 0.15f * height / camera.fy;
    camera.limit_x_low = -(camera.cx / camera.fx + margin_x);
    camera.limit_x_high = (width - camera.cx) / camera.fx + margin_x;
    camera.limit_y_low = -(camera.cy / camera.fy + margin_y);
    camera.limit_y_high = (height - camera.cy) / camera.fy + margin_y;
    camera.grad_scale_x = 0.5f * num_views * width;
    camera.grad_scale_y = 0.5f * num_views * height;
    return camera;
}

__device__ __forceinline__ GaussianShape make_shape(const float mean[3], const float log_scale[3], const float quat[4]) {
    GaussianShape shape;
    // Divided by the largest component first, so that the squares of tiny and huge quaternions stay in range; one without a
    // direction is the identity and has no gradient.
    const float size = fmaxf(fmaxf(fabsf(quat[0]), fabsf(quat[1])), fmaxf(fabsf(quat[2]), fabsf(quat[3])));
    const bool directed = size > kQuaternionMin;
    const float inverse_size = directed ? 1.0f / size : 0.0f;
    float norm2 = 0.0f;
#pragma unroll
    for (int i = 0; i < 4; ++i) {
        shape.quat[i] = directed ? quat[i] * inverse_size : (i == 0 ? 1.0f : 0.0f);
        norm2 += shape.quat[i] * shape.quat[i];
    }
    const float inverse_norm = 1.0f / sqrtf(norm2);
    shape.inverse_norm = inverse_norm * inverse_size;
#pragma unroll
    for (int i = 0; i < 4; ++i) shape.quat[i] *= inverse_norm;
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        shape.mean[i] = mean[i];
        shape.scale[i] = expf(log_scale[i]);
    }
    const float w = shape.quat[0], x = shape.quat[1], y = shape.quat[2], z = shape.quat[3];
    const float rotation[9] = {1.0f - 2.0f * (y * y + z * z), 2.0f * (x * y - w * z),        2.0f * (x * z + w * y),
                               2.0f * (x * y + w * z),        1.0f - 2.0f * (x * x + z * z), 2.0f * (y * z - w * x),
                               2.0f * (x * z - w * y),        2.0f * (y * z + w * x),        1.0f - 2.0f * (x * x + y * y)};
#pragma unroll
    for (int i = 0; i < 3; ++i)
#pragma unroll
        for (int j = 0; j < 3; ++j) shape.spread[3 * i + j] = rotation[3 * i + j] * shape.scale[j];
    return shape;
}

// Mean, scales and quaternion from the gradients of the screen mean, the conic (a, b, c; b's counts both off-diagonal
// entries) and the depth. Sets those three of `row`; the direction's part of the mean is added by the caller.
__device__ __forceinline__ void geometry_backward(const GaussianShape& shape, const ViewCamera& camera, float eps2d,
                                                  const float grad_mean2d[2], const float grad_conic[3], float grad_depth,
                                                  RowGradient& row) {
    const float* W = camera.rotation;
    const float* M = shape.spread;
    float point[3];
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        point[i] = W[3 * i] * shape.mean[0] + W[3 * i + 1] * shape.mean[1] + W[3 * i + 2] * shape.mean[2] +
                   camera.translation[i];
    }
    const float rz = 1.0f / point[2], rz2 = rz * rz;
    const float slope_x = point[0] * rz, slope_y = point[1] * rz;
    const float clamped_x = fminf(camera.limit_x_high, fmaxf(camera.limit_x_low, slope_x));
    const float clamped_y = fminf(camera.limit_y_high, fmaxf(camera.limit_y_low, slope_y));
    const float j00 = camera.fx * rz, j11 = camera.fy * rz;
    const float j02 = -j00 * clamped_x, j12 = -j11 * clamped_y;

    float T0[3], T1[3], U0[3], U1[3];
#pragma unroll
    for (int l = 0; l < 3; ++l) {
        T0[l] = j00 * W[l] + j02 * W[6 + l];
        T1[l] = j11 * W[3 + l] + j12 * W[6 + l];
    }
#pragma unroll
    for (int j = 0; j < 3; ++j) {
        U0[j] = T0[0] * M[j] + T0[1] * M[3 + j] + T0[2] * M[6 + j];
        U1[j] = T1[0] * M[j] + T1[1] * M[3 + j] + T1[2] * M[6 + j];
    }
    const float c00 = U0[0] * U0[0] + U0[1] * U0[1] + U0[2] * U0[2];
    const float c01 = U0[0] * U1[0] + U0[1] * U1[1] + U0[2] * U1[2];
    const float c11 = U1[0] * U1[0] + U1[1] * U1[1] + U1[2] * U1[2];
    // Lagrange's identity: the determinant as a sum of squares does not cancel, however thin the splat.
    const float x12 = U0[1] * U1[2] - U0[2] * U1[1];
    const float x20 = U0[2] * U1[0] - U0[0] * U1[2];
    const float x01 = U0[0] * U1[1] - U0[1] * U1[0];
    const float inverse_det = 1.0f / (x12 * x12 + x20 * x20 + x01 * x01 + eps2d * (c00 + c11 + eps2d));
    const float a = (c11 + eps2d) * inverse_det, b = -c01 * inverse_det, c = (c00 + eps2d) * inverse_det;

    // V = -A G A with A the conic and G its symmetric gradient.
    const float g00 = grad_conic[0], g01 = 0.5f * grad_conic[1], g11 = grad_conic[2];
    const float h00 = a * g00 + b * g01, h01 = a * g01 + b * g11;  // A G
    const float h10 = b * g00 + c * g01, h11 = b * g01 + c * g11;
    const float v00 = -(h00 * a + h01 * b), v01 = -(h00 * b + h01 * c), v11 = -(h10 * b + h11 * c);

    float Q0[3], Q1[3];
#pragma unroll
    for (int j = 0; j < 3; ++j) {
        Q0[j] = 2.0f * (v00 * U0[j] + v01 * U1[j]);
        Q1[j] = 2.0f * (v01 * U0[j] + v11 * U1[j]);
        row.scale[j] = U0[j] * Q0[j] + U1[j] * Q1[j];
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
    grad_point[0] = j00 * grad_mean2d[0];
    grad_point[1] = j11 * grad_mean2d[1];
    grad_point[2] = grad_depth - (j00 * slope_x * grad_mean2d[0] + j11 * slope_y * grad_mean2d[1]);
    // Inside the limits J's last column follows x and z; outside it depends on z alone.
    const float column_x = camera.fx * rz2 * grad_j02, column_y = camera.fy * rz2 * grad_j12;
    const bool inside_x = slope_x <= camera.limit_x_high && slope_x >= camera.limit_x_low;
    const bool inside_y = slope_y <= camera.limit_y_high && slope_y >= camera.limit_y_low;
    grad_point[0] -= inside_x ? column_x : 0.0f;
    grad_point[1] -= inside_y ? column_y : 0.0f;
    grad_point[2] += (inside_x ? 2.0f : 1.0f) * column_x * clamped_x + (inside_y ? 2.0f : 1.0f) * column_y * clamped_y -
                     rz2 * (camera.fx * grad_j00 + camera.fy * grad_j11);
#pragma unroll
    for (int l = 0; l < 3; ++l) {
        row.mean[l] = W[l] * grad_point[0] + W[3 + l] * grad_point[1] + W[6 + l] * grad_point[2];
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
    for (int i = 0; i < 4; ++i) row.quat[i] = (direct[i] - along * shape.quat[i]) * shape.inverse_norm;
}

// Values of the bands 1 .. degree at a unit direction (Sloan, JCGT 2013), in gsplat's order and signs.
__device__ __forceinline__ void sh_basis(int degree, float x, float y, float z, float basis[15]) {
    if (degree < 1) return;
    basis[0] = -0.48860251190292f * y;
    basis[1] = 0.48860251190292f * z;
    basis[2] = -0.48860251190292f * x;
    if (degree < 2) return;
    const float z2 = z * z;
    const float c1 = x * x - y * y, s1 = 2.0f * x * y;
    basis[3] = 0.5462742152960395f * s1;
    basis[4] = -1.092548430592079f * z * y;
    basis[5] = 0.9461746957575601f * z2 - 0.3153915652525201f;
    basis[6] = -1.092548430592079f * z * x;
    basis[7] = 0.5462742152960395f * c1;
    if (degree < 3) return;
    const float c2 = x * c1 - y * s1, s2 = x * s1 + y * c1;
    const float t0 = -2.285228997322329f * z2 + 0.4570457994644658f;
    const float t1 = 1.445305721320277f * z;
    basis[8] = -0.5900435899266435f * s2;
    basis[9] = t1 * s1;
    basis[10] = t0 * y;
    basis[11] = z * (1.865881662950577f * z2 - 1.119528997770346f);
    basis[12] = t0 * x;
    basis[13] = t1 * c1;
    basis[14] = -0.5900435899266435f * c2;
}

// d/d(unit direction) of sum_b basis_b * dots[b].
__device__ __forceinline__ void sh_basis_backward(int degree, float x, float y, float z, const float dots[15],
                                                  float grad[3]) {
    grad[0] = grad[1] = grad[2] = 0.0f;
    if (degree < 1) return;
    grad[0] = -0.48860251190292f * dots[2];
    grad[1] = -0.48860251190292f * dots[0];
    grad[2] = 0.48860251190292f * dots[1];
    if (degree < 2) return;
    constexpr float k2 = 1.0925484305920792f, k20 = 1.8923493915151202f;
    grad[0] += k2 * (y * dots[3] - z * dots[6] + x * dots[7]);
    grad[1] += k2 * (x * dots[3] - z * dots[4] - y * dots[7]);
    grad[2] += k20 * z * dots[5] - k2 * (y * dots[4] + x * dots[6]);
    if (degree < 3) return;
    const float z2 = z * z;
    const float c1 = x * x - y * y, s1 = 2.0f * x * y;
    const float t0 = -2.285228997322329f * z2 + 0.4570457994644658f;
    const float t0_z = -4.570457994644658f * z;
    constexpr float k3 = 1.445305721320277f, k33 = -1.7701307697799304f;  // 3 * -0.5900435899266435
    // d c2 = 3 (c1, -s1), d s2 = 3 (s1, c1) in (x, y); d c1 = 2 (x, -y), d s1 = 2 (y, x).
    grad[0] += k33 * (s1 * dots[8] + c1 * dots[14]) + 2.0f * k3 * z * (y * dots[9] + x * dots[13]) + t0 * dots[12];
    grad[1] += k33 * (c1 * dots[8] - s1 * dots[14]) + 2.0f * k3 * z * (x * dots[9] - y * dots[13]) + t0 * dots[10];
    grad[2] += k3 * (s1 * dots[9] + c1 * dots[13]) + t0_z * (y * dots[10] + x * dots[12]) +
               (5.597644988851731f * z2 - 1.119528997770346f) * dots[11];
}

// Colour of one view back to the harmonics and, through the direction, to the mean.
//
// `coefficients` and `gradients` are this Gaussian's columns of the block's shared memory ([3 * bands], stride 1);
// `gradients` is added to. `grad_color` comes in behind the clamp at 0 and leaves masked by it.
__device__ __forceinline__ void color_backward(const GaussianShape& shape, const ViewCamera& camera, const float sh0[3],
                                               int degree, const float* coefficients, float* gradients,
                                               float grad_color[3], RowGradient& row) {
    float direction[3], length2 = 0.0f;
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        direction[i] = shape.mean[i] - camera.center[i];
        length2 += direction[i] * direction[i];
    }
    const float inverse_length = length2 > 0.0f ? 1.0f / sqrtf(length2) : 0.0f;
#pragma unroll
    for (int i = 0; i < 3; ++i) direction[i] *= inverse_length;

    float basis[15], dots[15];
    sh_basis(degree, direction[0], direction[1], direction[2], basis);
    float color[3];
#pragma unroll
    for (int c = 0; c < 3; ++c) color[c] = kShBand0 * sh0[c] + 0.5f;
#pragma unroll
    for (int band = 1; band <= 3; ++band) {
        if (band > degree) break;
#pragma unroll
        for (int b = band * band - 1; b < (band + 1) * (band + 1) - 1; ++b) {
#pragma unroll
            for (int c = 0; c < 3; ++c) color[c] += basis[b] * coefficients[3 * b + c];
        }
    }
#pragma unroll
    for (int c = 0; c < 3; ++c) {
        grad_color[c] = color[c] >= 0.0f ? grad_color[c] : 0.0f;
        row.sh0[c] = kShBand0 * grad_color[c];
    }
    // A band is read whole before any of it is written: the compiler must take the two arrays for one.
#pragma unroll
    for (int band = 1; band <= 3; ++band) {
        if (band > degree) break;
        constexpr int kLargest = 7;
        const int first = band * band - 1, count = 2 * band + 1;
        float sums[3 * kLargest];
#pragma unroll
        for (int b = 0; b < count; ++b) {
            dots[first + b] = 0.0f;
#pragma unroll
            for (int c = 0; c < 3; ++c) {
                dots[first + b] += coefficients[3 * (first + b) + c] * grad_color[c];
                sums[3 * b + c] = gradients[3 * (first + b) + c] + basis[first + b] * grad_color[c];
            }
        }
#pragma unroll
        for (int i = 0; i < 3 * count; ++i) gradients[3 * first + i] = sums[i];
    }
    float grad_unit[3];
    sh_basis_backward(degree, direction[0], direction[1], direction[2], dots, grad_unit);
    const float along =
        grad_unit[0] * direction[0] + grad_unit[1] * direction[1] + grad_unit[2] * direction[2];
#pragma unroll
    for (int i = 0; i < 3; ++i) row.mean[i] += (grad_unit[i] - along * direction[i]) * inverse_length;
}

__device__ __forceinline__ void add_row(RowGradient& sum, const RowGradient& row) {
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        sum.mean[i] += row.mean[i];
        sum.scale[i] += row.scale[i];
        sum.sh0[i] += row.sh0[i];
    }
#pragma unroll
    for (int i = 0; i < 4; ++i) sum.quat[i] += row.quat[i];
    sum.opacity += row.opacity;
}

// A block owns this many consecutive Gaussians, a thread each. Their harmonics are one contiguous piece of memory, which
// the block moves in 16-byte quads; in shared memory each thread works on its own row, whose odd stride keeps the banks
// apart.
constexpr int kBackwardThreads = 64;

struct BackwardShared {
    float* coefficients;   // [threads, stride]
    float* gradients;      // [threads, stride]
    ViewCamera* cameras;   // [K]
    float* corrections;    // [2, threads], for the optimizer: bias corrections of the two moments
    uint8_t* touched;      // [threads]
    int row;               // 3 B
    int stride;            // of a row: 3 B made odd
    uint32_t reciprocal;   // of `row` in 2^-20, exact for every element of a block

    __device__ BackwardShared(float* shared, const ScreenBackwardParams& params)
        : row(3 * params.bands), stride(row_stride(params)), reciprocal(row > 0 ? ((1u << 20) + row - 1) / row : 0u) {
        coefficients = shared;
        gradients = coefficients + kBackwardThreads * stride;
        cameras = reinterpret_cast<ViewCamera*>(gradients + kBackwardThreads * stride);
        corrections = reinterpret_cast<float*>(cameras + params.num_views);
        touched = reinterpret_cast<uint8_t*>(corrections + 2 * kBackwardThreads);
    }

    // The Gaussian of the block that element `index` of its harmonics belongs to.
    __device__ __forceinline__ int owner(int index) const { return (static_cast<uint32_t>(index) * reciprocal) >> 20; }

    __host__ __device__ static int row_stride(const ScreenBackwardParams& params) {
        return params.bands > 0 ? (3 * params.bands) | 1 : 0;
    }

    static size_t bytes(const ScreenBackwardParams& params) {
        return 2 * kBackwardThreads * row_stride(params) * sizeof(float) + params.num_views * sizeof(ViewCamera) +
               2 * kBackwardThreads * sizeof(float) + kBackwardThreads;
    }
};

__device__ __forceinline__ void load_cameras(const ScreenBackwardParams& params, const BackwardShared& block) {
    for (int view = threadIdx.x; view < params.num_views; view += kBackwardThreads) {
        block.cameras[view] = load_camera(params.viewmats + 16 * view, params.intrinsics + 9 * view, params.widths[view],
                                          params.heights[view], params.num_views);
    }
}

// How the views of a batch see one Gaussian.
struct Sight {
    uint32_t touched = 0u;  // bit k: some sampled pixel of view k had a contribution
    int visible = 0;        // views in which it is on screen; where statistics are wanted
    float largest = 0.0f;   // radius over the image's larger side
};

__device__ __forceinline__ Sight sight_of(const ScreenBackwardParams& params, int gaussian) {
    const float* weight = reinterpret_cast<const float*>(params.records + static_cast<size_t>(gaussian) * kRecordQuads) + 13;
    const size_t step = static_cast<size_t>(params.num_gaussians) * kRecordQuads * 4;
    Sight sight;
#pragma unroll 4
    for (int view = 0; view < params.num_views; ++view) {
        if (weight[view * step] > 0.0f) sight.touched |= 1u << view;
        if (params.error_sums == nullptr) continue;
        const int2 radius = params.radii[static_cast<size_t>(view) * params.num_gaussians + gaussian];
        if (radius.x > 0 || radius.y > 0) {
            const float side = static_cast<float>(max(params.widths[view], params.heights[view]));
            ++sight.visible;
            sight.largest = fmaxf(sight.largest, static_cast<float>(max(radius.x, radius.y)) / side);
        }
    }
    return sight;
}

// Starts to copy the harmonics of the block's touched Gaussians to shared memory, and clears their gradients. A barrier
// inside; `wait_for_copies` and a barrier make them, and the cameras, ready.
__device__ __forceinline__ void start_harmonics(const ScreenBackwardParams& params, const BackwardShared& block,
                                                bool touched) {
    block.touched[threadIdx.x] = touched;
    for (int i = threadIdx.x; i < kBackwardThreads * block.stride; i += kBackwardThreads) block.gradients[i] = 0.0f;
    __syncthreads();
    const int first = static_cast<int>(blockIdx.x) * kBackwardThreads;
    const int count = min(kBackwardThreads, params.num_gaussians - first) * block.row;
    const float* in = params.shN + static_cast<size_t>(first) * block.row;
    for (int i = 4 * threadIdx.x; i < count; i += 4 * kBackwardThreads) {
        const int last = min(i + 3, count - 1);
        if (!(block.touched[block.owner(i)] | block.touched[block.owner(last)])) continue;
        if (last == i + 3 && block.stride == block.row) {
            copy_async<4>(block.coefficients + i, in + i);
        } else {
            for (int j = i; j <= last; ++j) {
                copy_async<1>(block.coefficients + j + block.owner(j) * (block.stride - block.row), in + j);
            }
        }
    }
}

// The parameters of one Gaussian but its harmonics, as they are stored.
struct StoredGaussian {
    float mean[3], log_scale[3], quat[4], sh0[3], logit;
};

__device__ __forceinline__ StoredGaussian load_gaussian(const ScreenBackwardParams& params, int gaussian) {
    StoredGaussian stored;
    const size_t triple = 3 * static_cast<size_t>(gaussian);
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        stored.mean[i] = params.means[triple + i];
        stored.log_scale[i] = params.scales[triple + i];
        stored.sh0[i] = params.sh0[triple + i];
    }
    const float4 quat = reinterpret_cast<const float4*>(params.quats)[gaussian];
    stored.quat[0] = quat.x, stored.quat[1] = quat.y, stored.quat[2] = quat.z, stored.quat[3] = quat.w;
    stored.logit = params.opacities[gaussian];
    return stored;
}

// Adds to the window of statistics; nobody waits for what is there.
__device__ __forceinline__ void add_stat(float* sums, int gaussian, float value) { atomicAdd(sums + gaussian, value); }

// All views of one Gaussian: gives each touched view's row and loss to `sink.add`, adds the harmonics' gradients to the
// block's shared memory, and the statistics to their window.
template <class Sink>
__device__ __forceinline__ void backward_views(const ScreenBackwardParams& params, const BackwardShared& block,
                                               int gaussian, uint32_t mask, const Sight& sight,
                                               const StoredGaussian& stored, Sink& sink) {
    const bool with_stats = params.error_sums != nullptr;
    if (mask != 0u) {
        float error_sum = 0.0f, distance_sum = 0.0f, weight_sum = 0.0f, grad_sum = 0.0f, absgrad_sum = 0.0f;
        const int filled = params.num_filled != nullptr ? *params.num_filled : params.num_slots;
        const float inverse_filled = 1.0f / static_cast<float>(max(filled, 1));
        const GaussianShape shape = make_shape(stored.mean, stored.log_scale, stored.quat);
        const float opacity = 1.0f / (1.0f + expf(-stored.logit));
        const float* coefficients = block.coefficients + threadIdx.x * block.stride;
        float* gradients = block.gradients + threadIdx.x * block.stride;

        for (int view = 0; view < params.num_views; ++view) {
            if ((mask >> view & 1u) == 0u) continue;
            const float4* record =
                params.records + (static_cast<size_t>(view) * params.num_gaussians + gaussian) * kRecordQuads;
            const float4 r0 = record[0], r1 = record[1], r2 = record[2], r3 = record[3];
            const ViewCamera& camera = block.cameras[view];
            const float grad_mean2d[2] = {r0.x, r0.y};
            const float grad_conic[3] = {r0.z, r0.w, r1.x};
            float grad_color[3] = {r1.y, r1.z, r1.w};
            RowGradient row;
            geometry_backward(shape, camera, params.eps2d, grad_mean2d, grad_conic, r3.z, row);
            color_backward(shape, camera, stored.sh0, params.sh_degree, coefficients, gradients, grad_color, row);
            row.opacity = r2.x * opacity * (1.0f - opacity);
            sink.add(view, row, r2.w * inverse_filled);

            error_sum += r2.w;
            distance_sum += r3.x;
            weight_sum += r3.y;
            const float gx = r0.x * camera.grad_scale_x, gy = r0.y * camera.grad_scale_y;
            const float ax = r2.y * camera.grad_scale_x, ay = r2.z * camera.grad_scale_y;
            grad_sum += approximate_sqrt(gx * gx + gy * gy);
            absgrad_sum += approximate_sqrt(ax * ax + ay * ay);
        }
        if (with_stats) {
            add_stat(params.error_sums, gaussian, error_sum);
            add_stat(params.distance_sums, gaussian, distance_sum);
            add_stat(params.weight_sums, gaussian, weight_sum);
            add_stat(params.grad_sums, gaussian, grad_sum);
            add_stat(params.absgrad_sums, gaussian, absgrad_sum);
        }
    }
    if (sight.visible > 0) {
        add_stat(params.view_counts, gaussian, static_cast<float>(sight.visible));
        // Of numbers that are not negative, the bits are in order.
        atomicMax(reinterpret_cast<int*>(params.max_radii) + gaussian, __float_as_int(sight.largest));
    }
}

}  // namespace turbogs
