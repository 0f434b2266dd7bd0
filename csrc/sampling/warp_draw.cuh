// Drawing without replacement by a warp: in each of the three stages the units not yet drawn have times, and the first
// ones win. The time from which on they lose is searched with warp-wide counts.
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

// Times are bits of floats that are not negative, so they are ordered as integers too.
constexpr uint32_t kNever = 0x7F800000u;  // infinity: a unit that does not take part
constexpr uint32_t kNoAge = 0xFFFFFFFFu;  // -1, the same for ages

// How many of a warp's numbers, none below -1, reach `least`, which is not below 0.
__device__ __forceinline__ int count_reaching(const uint32_t (&numbers)[kPerLane], int least) {
    int reaching = 0;  // of this lane; one instruction tells whether a number is of them
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) reaching += __viaddmin_s32_relu(static_cast<int>(numbers[j]), 1 - least, 1);
    return static_cast<int>(__reduce_add_sync(kFullWarp, static_cast<uint32_t>(reaching)));
}

// Those of a lane's units whose time is before `end`; bit j is the j-th.
__device__ __forceinline__ uint32_t units_before(const uint32_t (&times)[kPerLane], uint32_t end) {
    uint32_t units = 0;
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) units |= static_cast<uint32_t>(times[j] < end) << j;
    return units;
}

// Where the first units end: those before `end` are in; of those at `end`, `room` more, where it is not 0.
struct Split {
    uint32_t end;
    int room;
};

// Parts the first `count` times from the others, of which some must not be `kNever`. The end is searched until it parts
// exactly `count`, or only equal times are left to part. The number of times before an end is about proportional to it,
// so ends are tried by proportion, from a guess on.
__device__ __forceinline__ Split split_first(const uint32_t (&times)[kPerLane], int count, float guess) {
    constexpr int kGuesses = 4;  // tries by the rule of the guess, while no end is known that is too late
    constexpr int kHalving = 8;  // of so many tries one halves the range, so that the search ends
    const float wanted = static_cast<float>(count);
    uint32_t low = 0u, high = kNever, end = __float_as_uint(guess);
    float before_low = 0.0f, before_high = 0.0f;  // fewer than `count` times lie before `low`, more before `high`
    for (int tries = 1;; ++tries) {
        end = min(max(end, low + 1u), high - 1u);
        const int total = kWarpSize * kPerLane - count_reaching(times, static_cast<int>(end));
        if (total == count) return {end, 0};
        const float before = static_cast<float>(total);
        (total < count ? low : high) = end;
        (total < count ? before_low : before_high) = before;
        if (high - low <= 1u) return {low, static_cast<int>(wanted - before_low)};
        if (high == kNever && tries < kGuesses) {
            const float factor = (wanted + 0.5f) * approximate_reciprocal(before + 0.5f);
            end = __float_as_uint(__uint_as_float(end) * factor);
        } else if (high == kNever || tries % kHalving == 0) {
            end = low + ((high - low) >> 1);
        } else {
            const float share = (wanted - before_low) * approximate_reciprocal(before_high - before_low);
            const float first = __uint_as_float(low), last = __uint_as_float(high);
            end = __float_as_uint(first + share * (last - first));
        }
    }
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

// The first `count` units, fewer than there are; among equals the lower rank goes first.
__device__ __forceinline__ uint32_t take_first(const uint32_t (&times)[kPerLane], int count, float guess) {
    const Split split = split_first(times, count, guess);
    uint32_t taken = units_before(times, split.end);
    if (split.room > 0) taken |= take_by_rank(units_before(times, split.end + 1u) & ~taken, split.room);
    return taken;
}

// The `count` winners of a race, fewer than take part, by approximate times where none lies within the guard of the
// end, else by keys: `exact()`, of the whole warp, gives the function of a unit. About `count` finish by `guess`.
template <class Exact>
__device__ __forceinline__ uint32_t take_race(uint32_t (&times)[kPerLane], int count, float guess, const Exact& exact) {
    const Split split = split_first(times, count, guess);
    uint32_t nearest = 0xFFFFFFFFu;
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) nearest = min(nearest, times[j] - (split.end - kTimeGuard));
    if (!__any_sync(kFullWarp, nearest <= 2u * kTimeGuard)) return units_before(times, split.end);
    const auto key_of = exact();
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) {
        if (times[j] != kNever) times[j] = race_time(key_of(j));
    }
    return take_first(times, count, __uint_as_float(split.end));
}

// The `count` oldest units, fewer than there are; among equals the first by `times`. One age goes after the other, as
// many units share the oldest ones. `ages`: above 16 bits of anything.
__device__ __forceinline__ uint32_t take_oldest(uint32_t (&ages)[kPerLane], int count, uint32_t (&times)[kPerLane]) {
    uint32_t taken = 0;
    while (true) {
        int oldest = -1;
#pragma unroll
        for (int j = 0; j < kPerLane; ++j) oldest = max(oldest, static_cast<int>(ages[j]));
        const int least = __reduce_max_sync(kFullWarp, oldest) & ~0xFFFF;
        const int present = count_reaching(ages, least);
        if (present > count) {
#pragma unroll
            for (int j = 0; j < kPerLane; ++j) times[j] = static_cast<int>(ages[j]) >= least ? times[j] : kNever;
            const float share = static_cast<float>(count) * approximate_reciprocal(static_cast<float>(present));
            return taken | take_first(times, count, share * (1 << kAgeTieBits));
        }
#pragma unroll
        for (int j = 0; j < kPerLane; ++j) {
            if (static_cast<int>(ages[j]) < least) continue;
            taken |= 1u << j;
            ages[j] = kNoAge;
        }
        count -= present;
        if (count == 0) return taken;
    }
}

// The keys of the `open` units; 0 is no unit.
template <class Key, class KeyOf>
__device__ __forceinline__ void make_keys(Key (&keys)[kPerLane], uint32_t open, const KeyOf& key_of) {
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) keys[j] = open >> j & 1u ? key_of(j) : 0u;
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
                                         float (&missed)[kPerLane]) {
    const uint32_t exist = units.pixels.inside;
    int open = static_cast<int>(__reduce_add_sync(kFullWarp, static_cast<uint32_t>(__popc(exist))));  // not drawn yet

    // The sums of the mixed stage: of errors near here, for times; for keys halves add up exactly in double.
    float near_sum = 0.0f;
    uint32_t age_sum = 0;
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) {
        near_sum += units.error(j);
        age_sum += static_cast<uint32_t>(units.age(j));
        if (kWeighted) missed[j] = 1.0f;
    }
    near_sum = warp_sum(near_sum);
    const float age_total = __uint2float_rn(__reduce_add_sync(kFullWarp, age_sum));
    const auto exact_sum = [&] {
        double sum = 0.0;
#pragma unroll
        for (int j = 0; j < kPerLane; ++j) sum += static_cast<double>(units.error(j));
        return __double2float_rn(warp_sum(sum));
    };

    const float of_error = near_sum > 0.0f ? approximate_reciprocal(near_sum) : 0.0f;
    const float of_age = age_total > 0.0f ? approximate_reciprocal(age_total) : 0.0f;
    uint32_t hard_times[kPerLane], ages[kPerLane], tie_times[kPerLane], mixed_times[kPerLane];
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) {
        const uint3 words = random_words(params.keys, units.pixels.id(j), view, kPurposePixels);
        const float shares = units.error(j) * of_error + static_cast<float>(units.age(j)) * of_age;
        hard_times[j] = approximate_race_time(units.error(j), words.x);
        ages[j] = units.packed[j];
        tie_times[j] = __float_as_uint(__uint2float_rn(~words.y >> (32 - kAgeTieBits)));
        mixed_times[j] = approximate_race_time(params.mixed_uniform ? 1.0f : shares, words.z);
    }
    // Takes units out of the stages to come.
    const auto close = [&](uint32_t closed) {
#pragma unroll
        for (int j = 0; j < kPerLane; ++j) {
            if ((closed >> j & 1u) == 0u) continue;
            hard_times[j] = mixed_times[j] = kNever;
            ages[j] = kNoAge;
        }
    };
    if (open < kWarpSize * kPerLane) close(~exist);
    const auto miss = [&](uint32_t taken, const auto& thresholds, const auto& chance_of) {
#pragma unroll
        for (int j = 0; j < kPerLane; ++j) {
            const auto tau = (taken >> j & 1u) != 0u ? thresholds.largest_left : thresholds.smallest_taken;
            missed[j] *= thresholds.largest_left == 0 ? 0.0f : 1.0f - chance_of(j, tau);
        }
    };
    // The random words a second time, as they are rarely needed and would fill registers. `id` is hidden from the
    // compiler, which would else keep them.
    const auto words_again = [&](int j) {
        uint32_t id = units.pixels.id(j);
        asm volatile("" : "+r"(id));
        return random_words(params.keys, id, view, kPurposePixels);
    };
    uint32_t drawn = 0;
    const auto finish = [&](uint32_t taken, int count) {
        close(taken);
        drawn |= taken;
        open -= min(count, open);
    };
    // Draws the `count` winners of a race. `weights()`, of the whole warp, gives the function of a unit's weight; the
    // weights add up to about `total`.
    const auto race = [&](uint32_t (&times)[kPerLane], int count, float total, const auto& weights,
                          const auto& word_of) {
        if (count == 0) return;
        const auto exact = [&] {
            return [&, weight_of = weights()](int j) { return race_key(weight_of(j), word_of(words_again(j))); };
        };
        const uint32_t left = exist & ~drawn;
        const float guess = static_cast<float>(count) * approximate_reciprocal(total);
        const uint32_t taken = count < open ? take_race(times, count, guess, exact) : left;
        if constexpr (kWeighted) {
            uint32_t keys[kPerLane];
            make_keys(keys, left, exact());
            miss(taken, stage_thresholds(keys, taken),
                 [&, weight_of = weights()](int j, uint32_t tau) { return race_chance(weight_of(j), tau); });
        }
        finish(taken, count);
    };
    const auto errors = [&] { return [&](int j) { return units.error(j); }; };
    race(hard_times, params.stages[0][0], fmaxf(near_sum, kWarpSize * kPerLane * kWeightFloor), errors,
         [](const uint3& words) { return words.x; });
    const int stable = params.stages[0][1];
    if (stable > 0) {
        const uint32_t left = exist & ~drawn, taken = stable < open ? take_oldest(ages, stable, tie_times) : left;
        if constexpr (kWeighted) {
            uint64_t keys[kPerLane];  // plus 1, so that 0 is no unit
            make_keys(keys, left, [&](int j) { return age_key(units.age(j), words_again(j).y) + 1u; });
            miss(taken, stage_thresholds(keys, taken),
                 [&](int j, uint64_t tau) { return age_chance(units.age(j), tau - 1u); });
        }
        finish(taken, stable);
    }
    const auto mixed_weights = [&] {
        return [&, error_total = exact_sum()](int j) {
            return params.mixed_uniform ? 1.0f : mixed_weight(units.error(j), units.age(j), error_total, age_total);
        };
    };
    // The shares of all units add up to 2, of which the stages before took the larger.
    race(mixed_times, params.stages[0][2], params.mixed_uniform ? kWarpSize * kPerLane : 1.0f, mixed_weights,
         [](const uint3& words) { return words.z; });
    return drawn;
}

}  // namespace turbogs
