// Quaternions of any norm, wxyz, and their rotations: one version for the projection and for its backward pass. Those
// that optimizers leave may be tiny, huge or zero, and each of them is given a rotation.
#pragma once

namespace turbogs {

constexpr float kQuaternionMin = 1e-30f;  // largest component of a quaternion that still has a direction

// Normalises; returns 1 / norm. One without a direction is the identity, and 0 is returned: it has no gradient.
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

}  // namespace turbogs
