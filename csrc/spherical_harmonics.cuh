// Real spherical harmonics up to degree 3 (Sloan, JCGT 2013), in gsplat's order and signs.
#pragma once

namespace turbogs {

constexpr float kShBand0 = 0.28209479177387814f;

// Calls visit(b, value) for the harmonics of the bands 1 .. degree at a unit direction; b counts from 0.
template <class Visit>
__device__ __forceinline__ void visit_harmonics(int degree, float x, float y, float z, Visit visit) {
    if (degree < 1) return;
    visit(0, -0.48860251190292f * y);
    visit(1, 0.48860251190292f * z);
    visit(2, -0.48860251190292f * x);
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

}  // namespace turbogs
