// Random words and the keys of the pixel sampler, to the bit as strategies/philox.py and pixel_draws.py define them: single-
// precision operations that are rounded one by one.
//
// A unit's random words depend on the seed, the iteration and its place alone. In a race its key is weight over an exponential
// number, and the largest keys win with the probabilities of drawing one by one without replacement; by age, the key is the age
// with random bits below it. Keys are integers, so that a threshold can be searched.
#pragma once

#include "training_math.cuh"
#include "training_params.h"

namespace turbogs {

constexpr int kAgeTieBits = 24;
constexpr float kWeightFloor = 7.888609052210118e-31f;  // 2^-100
constexpr uint32_t kPurposePixels = 0, kPurposeCells = 1, kPurposeTiles = 2;

struct Words {
    uint32_t x0, x1, x2, x3;
};

// Philox4x32-10 in the layout of strategies/philox.py.
__device__ __forceinline__ Words random_words(const SamplePixelsParams& params, uint32_t place, uint32_t view,
                                              uint32_t purpose) {
    uint32_t c0 = place, c1 = view, c2 = purpose, c3 = params.seed_high;
#pragma unroll
    for (int round = 0; round < 10; ++round) {
        const uint32_t high0 = __umulhi(c0, 0xD2511F53u), low0 = c0 * 0xD2511F53u;
        const uint32_t high1 = __umulhi(c2, 0xCD9E8D57u), low1 = c2 * 0xCD9E8D57u;
        c0 = high1 ^ c1 ^ params.round_keys[round][0];
        c1 = low1;
        c2 = high0 ^ c3 ^ params.round_keys[round][1];
        c3 = low0;
    }
    return {c0, c1, c2, c3};
}

// a / b, correctly rounded: the steps of __fdiv_rn without its test for extreme exponents. What is divided here lies within
// 2^-100 .. 2^24, by 2^-24 .. 2^24.
__device__ __forceinline__ float divide(float a, float b) {
    float reciprocal = approximate_reciprocal(b);
    reciprocal = __fmaf_rn(reciprocal, __fmaf_rn(-b, reciprocal, 1.0f), reciprocal);
    float quotient = __fmul_rn(a, reciprocal);
    quotient = __fmaf_rn(reciprocal, __fmaf_rn(-b, quotient, a), quotient);
    return __fmaf_rn(reciprocal, __fmaf_rn(-b, quotient, a), quotient);
}

// -log(u) of the word's uniform number, the same bits on every device.
__device__ __forceinline__ float exponential(uint32_t word) {
    const int bits = __float_as_int(__uint2float_rn(((word >> 9) << 1) | 1u));
    const int exponent = (bits - 0x3F3504F3) >> 23;
    const float f = __int_as_float(bits - (exponent << 23));
    const float s = divide(__fsub_rn(f, 1.0f), __fadd_rn(f, 1.0f));
    const float q = __fmul_rn(s, s);
    float p = __fadd_rn(__fmul_rn(q, 2.0f / 9.0f), 2.0f / 7.0f);
    p = __fadd_rn(__fmul_rn(p, q), 2.0f / 5.0f);
    p = __fadd_rn(__fmul_rn(p, q), 2.0f / 3.0f);
    const float tail = __fmul_rn(s, __fmul_rn(q, p));
    const float log_f = __fadd_rn(__fadd_rn(s, s), tail);
    return __fsub_rn(__fmul_rn(__int2float_rn(24 - exponent), __int_as_float(0x3F317218)), log_f);
}

__device__ __forceinline__ uint32_t race_key(float weight, uint32_t word) {
    return __float_as_uint(divide(fmaxf(weight, kWeightFloor), exponential(word)));
}

// What `race_key` is to about 1e-5, so within kKeyGuard units of its last place, from a third of the instructions. The
// logarithm of the special function unit is off by 2^-22 near 1, so there the first terms of a series take its place.
constexpr uint32_t kKeyGuard = 512;

__device__ __forceinline__ uint32_t approximate_race_key(float weight, uint32_t word) {
    const float u = __uint_as_float(0x3F800000u | word >> 9) - 0.999999940395355224609375f;  // exact, as is 1 - u
    const float v = 1.0f - u;
    const float series = v * (1.0f + v * (0.5f + v * (1.0f / 3.0f)));
    const float exponential = v < 0.015625f ? series : -0.693147180559945f * approximate_log2(u);
    return __float_as_uint(fmaxf(weight, kWeightFloor) * approximate_reciprocal(exponential));
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

// Probability that a race, or the draw by age, takes a unit given the others' keys; see "rank conditioning" in the twin.
__device__ __forceinline__ float race_chance(float weight, uint32_t tau) {
    return -expm1f(-(fmaxf(weight, kWeightFloor) / __uint_as_float(tau)));
}

__device__ __forceinline__ float age_chance(int age, uint64_t tau) {
    const int64_t beaten =
        (static_cast<int64_t>(age + 1) << kAgeTieBits) - static_cast<int64_t>(tau);
    const int64_t most = int64_t{1} << kAgeTieBits;
    return static_cast<float>(beaten < 0 ? 0 : (beaten > most ? most : beaten)) * 5.9604644775390625e-8f;
}

__device__ __forceinline__ float importance_weight(float missed, float importance) {
    return powf(fmaxf(1.0f - missed, 5.9604644775390625e-8f), -importance);
}

}  // namespace turbogs
