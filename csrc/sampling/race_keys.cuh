// The keys of the pixel sampler, to the bit as turbogs_plugin/engine/reference/philox.py and draws.py define them:
// single-precision operations that are rounded one by one.
//
// In a race the key of a unit is its weight over an exponential number, and the largest keys win with the
// probabilities of drawing one by one without replacement. By age, the key is the age with random bits below it. Keys
// are integers, so that a threshold can be searched.
#pragma once

#include "common/approximate_math.cuh"
#include "common/philox.h"
#include "sampling/sampling_params.h"

namespace turbogs {

// As in draws.py.
constexpr int kAgeTieBits = 24;                         // random bits below an age
constexpr float kWeightFloor = 7.888609052210118e-31f;  // 2^-100, the least weight of a race
constexpr float kRandomUnit = 5.9604644775390625e-8f;  // 2^-24, the least chance

// a / b, correctly rounded: the steps of __fdiv_rn without its test for extreme exponents. What is divided here lies
// within 2^-100 .. 2^24, by 2^-24 .. 2^24.
__device__ __forceinline__ float divide(float a, float b) {
    float reciprocal = approximate_reciprocal(b);
    reciprocal = __fmaf_rn(reciprocal, __fmaf_rn(-b, reciprocal, 1.0f), reciprocal);
    float quotient = __fmul_rn(a, reciprocal);
    quotient = __fmaf_rn(reciprocal, __fmaf_rn(-b, quotient, a), quotient);
    return __fmaf_rn(reciprocal, __fmaf_rn(-b, quotient, a), quotient);
}

// -log(u) of the word's uniform number, the same bits on every device: u = f * 2^n with f within sqrt(1/2) ..
// sqrt(2), and log f by a series in (f - 1) / (f + 1).
constexpr int kHalfRootBits = 0x3F3504F3;  // of sqrt(1/2)
constexpr int kLn2Bits = 0x3F317218;       // of ln 2

__device__ __forceinline__ float exponential(uint32_t word) {
    const int bits = __float_as_int(__uint2float_rn(((word >> 9) << 1) | 1u));
    const int exponent = (bits - kHalfRootBits) >> 23;
    const float f = __int_as_float(bits - (exponent << 23));
    const float s = divide(__fsub_rn(f, 1.0f), __fadd_rn(f, 1.0f));
    const float q = __fmul_rn(s, s);
    float p = __fadd_rn(__fmul_rn(q, 2.0f / 9.0f), 2.0f / 7.0f);
    p = __fadd_rn(__fmul_rn(p, q), 2.0f / 5.0f);
    p = __fadd_rn(__fmul_rn(p, q), 2.0f / 3.0f);
    const float tail = __fmul_rn(s, __fmul_rn(q, p));
    const float log_f = __fadd_rn(__fadd_rn(s, s), tail);
    return __fsub_rn(__fmul_rn(__int2float_rn(24 - exponent), __int_as_float(kLn2Bits)), log_f);
}

__device__ __forceinline__ uint32_t race_key(float weight, uint32_t word) {
    return __float_as_uint(divide(fmaxf(weight, kWeightFloor), exponential(word)));
}

// The time of a key, the largest key's first: bits of a float near its reciprocal. Finite, as keys are below 2^41.
__device__ __forceinline__ uint32_t race_time(uint32_t key) { return 0x7F000000u - key; }

// The reciprocal of what `race_key` is, to about 1e-5, from a third of the instructions. The logarithm of the special
// function unit is off by 2^-22 near 1, so there the first terms of a series take its place.
constexpr uint32_t kTimeGuard = 512;  // units of the last place, 3.0e-5 or more; the two differ by 1.3e-5 at most
constexpr float kSeriesBelow = 0.015625f;  // 2^-6, of 1 - u
constexpr float kLn2 = 0.693147180559945f;
constexpr float kUniformOffset = 0.999999940395355224609375f;  // 1 - 2^-24: u is an odd multiple of 2^-24

__device__ __forceinline__ uint32_t approximate_race_time(float weight, uint32_t word) {
    const float u = __uint_as_float(0x3F800000u | word >> 9) - kUniformOffset;  // exact, as is 1 - u
    const float v = 1.0f - u;
    const float series = v * (1.0f + v * (0.5f + v * (1.0f / 3.0f)));
    const float exponential = v < kSeriesBelow ? series : -kLn2 * approximate_log2(u);
    return __float_as_uint(exponential * approximate_reciprocal(fmaxf(weight, kWeightFloor)));
}

__device__ __forceinline__ uint64_t age_key(int age, uint32_t word) {
    return static_cast<uint64_t>(age) << kAgeTieBits | word >> (32 - kAgeTieBits);
}

// Error and age shares of a unit, for the mixed stage.
__device__ __forceinline__ float mixed_weight(float error, int age, float error_sum, float age_sum) {
    const float error_share = error_sum > 0.0f ? divide(error, error_sum) : 0.0f;
    const float age_share = age_sum > 0.0f ? divide(__int2float_rn(age), age_sum) : 0.0f;
    return __fadd_rn(error_share, age_share);
}

// Probability that a race, or the draw by age, takes a unit given the others' keys; see "rank conditioning" in
// draws.py.
__device__ __forceinline__ float race_chance(float weight, uint32_t tau) {
    return -expm1f(-(fmaxf(weight, kWeightFloor) / __uint_as_float(tau)));
}

__device__ __forceinline__ float age_chance(int age, uint64_t tau) {
    const int64_t beaten = (static_cast<int64_t>(age + 1) << kAgeTieBits) - static_cast<int64_t>(tau);
    const int64_t most = int64_t{1} << kAgeTieBits;
    return static_cast<float>(beaten < 0 ? 0 : (beaten > most ? most : beaten)) * kRandomUnit;
}

__device__ __forceinline__ float importance_weight(float missed, float importance) {
    return powf(fmaxf(1.0f - missed, kRandomUnit), -importance);
}

}  // namespace turbogs
