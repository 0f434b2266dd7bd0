// Real spherical harmonics up to degree 3 (Sloan, JCGT 2013), in gsplat's order and signs, and their gradient.
#pragma once

#include "common/batch.h"

namespace turbogs {

constexpr float kShBand0 = 0.28209479177387814f;  // sqrt(1 / (4 pi))
constexpr float kShBand1 = 0.48860251190292f;     // sqrt(3 / (4 pi)); the other factors are the paper's

// Calls visit(b, value) for the harmonics of the bands 1 .. degree at a unit direction; b counts from 0.
template <class Visit>
__device__ __forceinline__ void visit_harmonics(int degree, float x, float y, float z, Visit visit) {
    if (degree < 1) return;
    visit(0, -kShBand1 * y);
    visit(1, kShBand1 * z);
    visit(2, -kShBand1 * x);
    if (degree < 2) return;
    const float z2 = z * z, c1 = x * x - y * y, s1 = 2.0f * x * y;
    visit(3, 0.5462742152960395f * s1);
    visit(4, -1.092548430592079f * z * y);
    visit(5, 0.9461746957575601f * z2 - 0.3153915652525201f);
    visit(6, -1.092548430592079f * z * x);
    visit(7, 0.5462742152960395f * c1);
    if (degree < 3) return;
    const float c2 = x * c1 - y * s1, s2 = x * s1 + y * c1;
    const float ring = -2.285228997322329f * z2 + 0.4570457994644658f, axis = 1.445305721320277f * z;
    visit(8, -0.5900435899266435f * s2);
    visit(9, axis * s1);
    visit(10, ring * y);
    visit(11, z * (1.865881662950577f * z2 - 1.119528997770346f));
    visit(12, ring * x);
    visit(13, axis * c1);
    visit(14, -0.5900435899266435f * c2);
}

// d/d(unit direction) of the sum over b of harmonic b times dots[b].
__device__ __forceinline__ void harmonics_backward(int degree, float x, float y, float z, const float dots[kMaxBands],
                                                   float grad[3]) {
    grad[0] = grad[1] = grad[2] = 0.0f;
    if (degree < 1) return;
    grad[0] = -kShBand1 * dots[2];
    grad[1] = -kShBand1 * dots[0];
    grad[2] = kShBand1 * dots[1];
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

}  // namespace turbogs
