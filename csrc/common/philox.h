// Keys of the random words that turbogs_plugin/engine/reference/philox.py defines, made on the host. No torch here.
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

}  // namespace turbogs
