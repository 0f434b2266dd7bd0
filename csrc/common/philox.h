// Random words of a place, to the bit as turbogs_plugin/engine/reference/philox.py defines them: they depend on the
// seed, the iteration, the place and the purpose alone. Their keys are made on the host. No torch here.
#pragma once

#include <cstdint>

namespace turbogs {

constexpr int kPhiloxRounds = 10;  // Philox4x32-10 (Salmon et al., SC 2011)

struct PhiloxKeys {
    uint32_t seed_high;
    uint32_t rounds[kPhiloxRounds][2];  // from the low half of the seed and the iteration
};

inline PhiloxKeys philox_keys(int64_t seed, int64_t iteration) {
    constexpr uint32_t step0 = 0x9E3779B9u, step1 = 0xBB67AE85u;  // what is added to the two keys from round to round
    PhiloxKeys keys;
    keys.seed_high = static_cast<uint32_t>(static_cast<uint64_t>(seed) >> 32);
    for (uint32_t round = 0; round < kPhiloxRounds; ++round) {
        keys.rounds[round][0] = static_cast<uint32_t>(seed) + round * step0;
        keys.rounds[round][1] = static_cast<uint32_t>(iteration) + round * step1;
    }
    return keys;
}

#ifdef __CUDACC__

// As in philox.py.
constexpr uint32_t kPurposePixels = 0, kPurposeTiles = 2, kPurposeDropout = 7;

// The multipliers of Philox4x32.
constexpr uint32_t kPhiloxMultiplier0 = 0xD2511F53u, kPhiloxMultiplier1 = 0xCD9E8D57u;

// The first three of the four words of Philox4x32-10, in the layout of philox.py.
__device__ __forceinline__ uint3 random_words(const PhiloxKeys& keys, uint32_t place, uint32_t view, uint32_t purpose) {
    uint32_t c0 = place, c1 = view, c2 = purpose, c3 = keys.seed_high;
#pragma unroll
    for (int round = 0; round < kPhiloxRounds; ++round) {
        const uint32_t high0 = __umulhi(c0, kPhiloxMultiplier0), low0 = c0 * kPhiloxMultiplier0;
        const uint32_t high1 = __umulhi(c2, kPhiloxMultiplier1), low1 = c2 * kPhiloxMultiplier1;
        c0 = high1 ^ c1 ^ keys.rounds[round][0];
        c1 = low1;
        c2 = high0 ^ c3 ^ keys.rounds[round][1];
        c3 = low0;
    }
    return make_uint3(c0, c1, c2);
}

#endif

}  // namespace turbogs
