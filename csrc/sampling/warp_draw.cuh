// Drawing without replacement by a warp: each of the three stages gives every unit not yet drawn an integer key and
// takes the largest, found by searching the threshold with warp-wide counts.
#pragma once

#include "common/warp.cuh"
#include "sampling/race_keys.cuh"
#include "sampling/tile_pixels.cuh"

namespace turbogs {

__device__ __forceinline__ uint32_t warp_max(uint32_t value) { return __reduce_max_sync(kFullWarp, value); }
__device__ __forceinline__ uint64_t warp_max(uint64_t value) {
    const uint32_t high = warp_max(static_cast<uint32_t>(value >> 32));
    const uint32_t low = static_cast<uint32_t>(value >> 32) == high ? static_cast<uint32_t>(value) : 0u;
    return static_cast<uint64_t>(high) << 32 | warp_max(low);
}

// The largest of a warp's units: those that are taken, and of those `tied` at the threshold `room` more.
struct Split {
    uint32_t taken, tied;  // bit j: the lane's j-th unit
    int room;
    uint32_t threshold;    // keys from here on are taken; 1 where there are no more than wanted
};

// How keys are spread, and so where the next threshold is tried: halfway for ages; by proportion for uniform numbers;
// and for a race, in which as many keys as weights weigh reach a threshold, at first from a guess by that rule.
enum class Spread { kAges, kUniform, kRace };

// Divides the units with a key above 0 into the `count` largest and the rest. The threshold is searched until it parts
// exactly `count` from the rest or only equal keys are left to part. Keys are below 2^31. `guess`: of a race.
template <Spread kSpread>
__device__ __forceinline__ Split split_largest(const uint32_t (&keys)[kPerLane], int count, uint32_t guess = 0u) {
    constexpr uint32_t kEnd = 0x7F800000u;  // the bits of infinity: no race's key
    constexpr int kGuesses = 4;  // tries of a race by the rule of its guess, while one end of the range is open
    constexpr int kHalving = 3;  // of so many tries one halves the range, so that the search ends; others: no record
    uint32_t available = 0, smallest = 0xFFFFFFFFu, largest = 0;
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) {
        available += keys[j] != 0u;
        if (kSpread == Spread::kRace) continue;
        smallest = min(smallest, keys[j] - 1u);  // no unit: the largest number
        largest = max(largest, keys[j]);
    }
    int low_count = static_cast<int>(__reduce_add_sync(kFullWarp, available)), high_count = 0;
    uint32_t threshold = 1u;
    bool exact = low_count <= count;
    if (!exact) {
        uint32_t low = 1u, high = kEnd;
        if (kSpread != Spread::kRace) {
            low = __reduce_min_sync(kFullWarp, smallest) + 1u;
            high = __reduce_max_sync(kFullWarp, largest) + 1u;
        }
        const float inverse = approximate_reciprocal(static_cast<float>(count) + 0.5f);
        // low_count > count > high_count reach `low` and `high`.
        for (int pass = 0, total = 0; high - low > 1u; ++pass) {
            const bool open_ended = kSpread == Spread::kRace && pass < kGuesses && (low == 1u || high == kEnd);
            if (open_ended) {
                const float scaled = __uint_as_float(threshold) * ((static_cast<float>(total) + 0.5f) * inverse);
                threshold = pass == 0 ? guess : __float_as_uint(scaled);
                threshold = min(max(threshold, low + 1u), high - 1u);
            } else if (kSpread != Spread::kAges && pass % kHalving != kHalving - 1) {
                const float share = static_cast<float>(low_count - count) *
                                    approximate_reciprocal(static_cast<float>(low_count - high_count));
                threshold = low + static_cast<uint32_t>(share * static_cast<float>(high - low));
                threshold = min(max(threshold, low + 1u), high - 1u);
            } else {
                threshold = low + ((high - low) >> 1);
            }
            uint32_t reached = 0;
#pragma unroll
            for (int j = 0; j < kPerLane; ++j) reached += keys[j] >= threshold;
            total = static_cast<int>(__reduce_add_sync(kFullWarp, reached));
            exact = total == count;
            if (exact) break;
            if (total > count) {
                low = threshold;
                low_count = total;
            } else {
                high = threshold;
                high_count = total;
            }
        }
        if (!exact) threshold = high;
    }
    Split split = {0u, 0u, exact ? 0 : count - high_count, threshold};
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) {
        split.taken |= static_cast<uint32_t>(keys[j] >= threshold) << j;
        if (!exact) split.tied |= static_cast<uint32_t>(keys[j] == threshold - 1u && keys[j] != 0u) << j;
    }
    return split;
}

// The keys of the `open` units; 0 is no unit.
template <class Key, class KeyOf>
__device__ __forceinline__ void make_keys(Key (&keys)[kPerLane], uint32_t open, const KeyOf& key_of) {
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) keys[j] = open >> j & 1u ? key_of(j) : 0u;
}

// The first `room` of the tied units. Unit (j, lane) has rank 32 j + lane.
__device__ __forceinline__ uint32_t take_by_rank(uint32_t tied, int room) {
    uint32_t taken = 0;
    const uint32_t lower_lanes = lanes_below(this_lane());
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) {
        const bool mine = (tied >> j & 1u) != 0u;
        const uint32_t lanes = __ballot_sync(kFullWarp, mine);
        if (mine && __popc(lanes & lower_lanes) < room) taken |= 1u << j;
        room -= __popc(lanes);
    }
    return taken;
}

// The `count` largest keys; among equals the lower rank goes first.
template <Spread kSpread>
__device__ __forceinline__ uint32_t take_largest(const uint32_t (&keys)[kPerLane], int count, uint32_t guess = 0u) {
    const Split split = split_largest<kSpread>(keys, count, guess);
    return split.room > 0 ? split.taken | take_by_rank(split.tied, split.room) : split.taken;
}

// A threshold that about `count` keys of a race reach: of those that do, each does with a probability near weight /
// threshold.
__device__ __forceinline__ uint32_t race_guess(float total_weight, int count) {
    const float total = fmaxf(total_weight, kWarpSize * kPerLane * kWeightFloor);
    return __float_as_uint(total * approximate_reciprocal(static_cast<float>(count)));
}

// The `count` winners of a race among the `open` units, by approximate keys where those leave no doubt: no key within
// the guard of the threshold. `exact_key(j)` has the last word otherwise.
template <class ExactKey>
__device__ __forceinline__ uint32_t take_race(uint32_t (&keys)[kPerLane], uint32_t open, int count, uint32_t guess,
                                              const ExactKey& exact_key) {
    const Split split = split_largest<Spread::kRace>(keys, count, guess);
    if (split.threshold == 1u) return split.taken;
    bool doubt = false;
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) doubt = doubt || keys[j] - (split.threshold - kKeyGuard) <= 2u * kKeyGuard;
    if (!__any_sync(kFullWarp, doubt)) return split.taken;
    make_keys(keys, open, exact_key);
    return take_largest<Spread::kRace>(keys, count, split.threshold);
}

// For importance weights: the largest key that a stage left, 0 where it left none, and the smallest that it took. A key
// of 0 is no unit.
template <class Key>
struct Thresholds {
    Key largest_left, smallest_taken;
};

template <class Key>
__device__ __forceinline__ Thresholds<Key> stage_thresholds(const Key (&keys)[kPerLane], uint32_t taken) {
    Key left = 0, not_taken = 0;  // the smallest taken is the complement of the largest complement
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) {
        const bool mine = (taken >> j & 1u) != 0u;
        if (mine) not_taken = max(not_taken, static_cast<Key>(~keys[j]));
        else left = max(left, keys[j]);
    }
    return {warp_max(left), static_cast<Key>(~warp_max(not_taken))};
}

// The three stages over a tile's pixels. Returns the drawn ones; `missed` the probability of not being drawn.
template <bool kWeighted>
__device__ __forceinline__ uint32_t draw(const SamplePixelsParams& params, const PixelUnits& units, uint32_t view,
                                         double error_sum, int age_sum, float (&missed)[kPerLane]) {
    const uint32_t exist = units.pixels.inside;
    const int hard = params.stages[0][0], stable = params.stages[0][1], mixed = params.stages[0][2];
    uint32_t keys[kPerLane], hard_words[kPerLane], stable_words[kPerLane], mixed_words[kPerLane];
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) {
        const uint3 words = random_words(params.keys, units.pixels.id(j), view, kPurposePixels);
        hard_words[j] = words.x;
        stable_words[j] = words.y;
        mixed_words[j] = words.z;
        if (kWeighted) missed[j] = 1.0f;
    }
    const auto miss = [&](uint32_t taken, const auto& thresholds, const auto& chance_of) {
#pragma unroll
        for (int j = 0; j < kPerLane; ++j) {
            const auto tau = (taken >> j & 1u) != 0u ? thresholds.largest_left : thresholds.smallest_taken;
            missed[j] *= thresholds.largest_left == 0 ? 0.0f : 1.0f - chance_of(j, tau);
        }
    };
    // The winners of a race among the `open` units; `near_weight` is the weight but for rounding.
    const auto race = [&](uint32_t open, int count, float total, const uint32_t (&words)[kPerLane],
                          const auto& weight_of, const auto& near_weight_of) {
        const uint32_t guess = race_guess(total, count);
        const auto exact_key = [&](int j) { return race_key(weight_of(j), words[j]); };
        if constexpr (!kWeighted) {
            make_keys(keys, open, [&](int j) { return approximate_race_key(near_weight_of(j), words[j]); });
            return take_race(keys, open, count, guess, exact_key);
        } else {
            make_keys(keys, open, exact_key);
            const uint32_t taken = take_largest<Spread::kRace>(keys, count, guess);
            miss(taken, stage_thresholds(keys, taken),
                 [&](int j, uint32_t tau) { return race_chance(weight_of(j), tau); });
            return taken;
        }
    };
    uint32_t drawn = 0;
    if (hard > 0) {
        const auto weight_of = [&](int j) { return units.error(j); };
        drawn = race(exist, hard, __double2float_rn(error_sum), hard_words, weight_of, weight_of);
    }
    if (stable > 0) {
        // By age first; of equal ages by the random words.
        const uint32_t open = exist & ~drawn;
        make_keys(keys, open, [&](int j) { return static_cast<uint32_t>(units.age(j)) + 1u; });
        const Split oldest = split_largest<Spread::kAges>(keys, stable);
        uint32_t taken = oldest.taken;
        if (oldest.room > 0) {
            make_keys(keys, oldest.tied, [&](int j) { return (stable_words[j] >> (32 - kAgeTieBits)) + 1u; });
            taken |= take_largest<Spread::kUniform>(keys, oldest.room);
        }
        if (kWeighted) {
            uint64_t age_keys[kPerLane];  // plus 1, so that 0 is no unit
            make_keys(age_keys, open, [&](int j) { return age_key(units.age(j), stable_words[j]) + 1u; });
            miss(taken, stage_thresholds(age_keys, taken),
                 [&](int j, uint64_t tau) { return age_chance(units.age(j), tau - 1u); });
        }
        drawn |= taken;
    }
    if (mixed > 0) {
        const float error_total = __double2float_rn(error_sum), age_total = __int2float_rn(age_sum);
        const float of_error = error_total > 0.0f ? approximate_reciprocal(error_total) : 0.0f;
        const float of_age = age_total > 0.0f ? approximate_reciprocal(age_total) : 0.0f;
        const auto weight_of = [&](int j) {
            return params.mixed_uniform ? 1.0f : mixed_weight(units.error(j), units.age(j), error_total, age_total);
        };
        const auto near_weight_of = [&](int j) {
            return params.mixed_uniform ? 1.0f : units.error(j) * of_error + static_cast<float>(units.age(j)) * of_age;
        };
        // The shares of all units add up to 2, of which the stages before took the larger.
        const float total = params.mixed_uniform ? static_cast<float>(kWarpSize * kPerLane) : 1.0f;
        drawn |= race(exist & ~drawn, mixed, total, mixed_words, weight_of, near_weight_of);
    }
    return drawn;
}

}  // namespace turbogs
