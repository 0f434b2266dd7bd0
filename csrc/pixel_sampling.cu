// Error-guided sampling of pixels: every tile of K views in one launch, a warp per tile.
//
// A lane holds 8 pixels of its tile in registers, pixel (j, lane) being number 32 j + lane of `cell_order`. Each of the
// three stages gives every unit not yet drawn an integer key and takes the largest, found by searching the threshold with
// warp-wide counts. Slots of a tile follow from the image's size alone, so nothing is counted on the host. Keys are made of
// single-precision operations that are rounded one by one, as strategies/philox.py prescribes: the sets equal the torch
// twin's.
//
// With whole tiles as units three small kernels take over: sums of each tile, a block per view that draws tiles, and the
// pixel ids of the chosen ones.
#include <cuda_fp16.h>

#include "training_math.cuh"
#include "training_params.h"

namespace turbogs {
namespace {

constexpr uint32_t kFull = 0xFFFFFFFFu;
constexpr int kTile = 16, kTilePixels = 256, kPerLane = kTilePixels / 32;
constexpr int kSampleThreads = 128;
constexpr int kSampleBlocks = 8;  // of an SM: 64 registers
constexpr int kChooseThreads = 1024;
constexpr int kAgeMax = 32767;
constexpr int kAgeTieBits = 24, kRankBits = 20;
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

__device__ __forceinline__ uint32_t warp_max(uint32_t value) { return __reduce_max_sync(kFull, value); }
__device__ __forceinline__ uint64_t warp_max(uint64_t value) {
    const uint32_t high = warp_max(static_cast<uint32_t>(value >> 32));
    const uint32_t low = static_cast<uint32_t>(value >> 32) == high ? static_cast<uint32_t>(value) : 0u;
    return static_cast<uint64_t>(high) << 32 | warp_max(low);
}
__device__ __forceinline__ double warp_sum(double value) {
#pragma unroll
    for (int step = 16; step > 0; step >>= 1) value += __shfl_xor_sync(kFull, value, step);
    return value;
}

// The largest of a warp's units: some that are taken, and of those `tied` at the threshold `room` more.
struct Split {
    uint32_t taken, tied;  // bit j: the lane's j-th unit
    int room;
};

// Divides the units with a key above 0 into the `count` largest and the rest. The threshold is searched between the
// smallest and the largest key, until it parts exactly so many from the rest or only equal keys are left to part. Keys are
// below 2^31. By halves suits keys whose logarithms, the bits of a float, are spread; by proportion suits uniform ones.
template <bool kUniform, int kUnits>
__device__ __forceinline__ Split split_largest(const uint32_t (&keys)[kUnits], int count) {
    uint32_t available = 0, smallest = kFull, largest = 0;
#pragma unroll
    for (int j = 0; j < kUnits; ++j) {
        available += keys[j] != 0u;
        smallest = min(smallest, keys[j] - 1u);  // no unit: the largest number
        largest = max(largest, keys[j]);
    }
    int low_count = static_cast<int>(__reduce_add_sync(kFull, available)), high_count = 0;
    uint32_t threshold = 1u;
    bool exact = low_count <= count;
    if (!exact) {
        uint32_t low = __reduce_min_sync(kFull, smallest) + 1u, high = __reduce_max_sync(kFull, largest) + 1u;
        for (int pass = 0; high - low > 1u; ++pass) {  // low_count > count > high_count reach `low` and `high`
            threshold = low + ((high - low) >> 1);
            if (kUniform && (pass & 3) != 3) {
                const float share = static_cast<float>(low_count - count) / static_cast<float>(low_count - high_count);
                threshold = low + static_cast<uint32_t>(share * static_cast<float>(high - low));
                threshold = min(max(threshold, low + 1u), high - 1u);
            }
            uint32_t reached = 0;
#pragma unroll
            for (int j = 0; j < kUnits; ++j) reached += keys[j] >= threshold;
            const int total = static_cast<int>(__reduce_add_sync(kFull, reached));
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
    Split split = {0u, 0u, exact ? 0 : count - high_count};
#pragma unroll
    for (int j = 0; j < kUnits; ++j) {
        split.taken |= static_cast<uint32_t>(keys[j] >= threshold) << j;
        split.tied |= static_cast<uint32_t>(keys[j] == threshold - 1u && keys[j] != 0u) << j;
    }
    if (exact) split.tied = 0u;
    return split;
}

// The first `room` of the tied units; unit (j, lane) has rank 32 j + lane.
template <int kUnits>
__device__ __forceinline__ uint32_t take_by_rank(uint32_t tied, int room) {
    uint32_t taken = 0;
    const uint32_t lower_lanes = (1u << (threadIdx.x & 31u)) - 1u;
#pragma unroll
    for (int j = 0; j < kUnits; ++j) {
        const bool mine = (tied >> j & 1u) != 0u;
        const uint32_t lanes = __ballot_sync(kFull, mine);
        if (mine && __popc(lanes & lower_lanes) < room) taken |= 1u << j;
        room -= __popc(lanes);
    }
    return taken;
}

// The `count` largest keys; among equals the lower rank goes first.
template <bool kUniform, int kUnits>
__device__ __forceinline__ uint32_t take_largest(const uint32_t (&keys)[kUnits], int count) {
    const Split split = split_largest<kUniform>(keys, count);
    return split.room > 0 ? split.taken | take_by_rank<kUnits>(split.tied, split.room) : split.taken;
}

// For importance weights: the largest key that a stage left, 0 where it left none, and the smallest that it took. A key
// of 0 is no unit.
template <class Key>
struct Thresholds {
    Key largest_left, smallest_taken;
};

template <class Key, int kUnits>
__device__ __forceinline__ Thresholds<Key> stage_thresholds(const Key (&keys)[kUnits], uint32_t taken) {
    Key left = 0, not_taken = 0;  // the smallest taken is the complement of the largest complement
#pragma unroll
    for (int j = 0; j < kUnits; ++j) {
        const bool mine = (taken >> j & 1u) != 0u;
        if (mine) not_taken = max(not_taken, static_cast<Key>(~keys[j]));
        else left = max(left, keys[j]);
    }
    return {warp_max(left), static_cast<Key>(~warp_max(not_taken))};
}

// The three stages over a warp's units. Returns the drawn ones; `missed` the probability of not being drawn.
template <bool kWeighted, int kUnits>
__device__ __forceinline__ uint32_t draw(const SamplePixelsParams& params, const float (&errors)[kUnits],
                                         const int (&ages)[kUnits], const uint32_t (&places)[kUnits], uint32_t exist,
                                         uint32_t view, uint32_t purpose, double error_sum, int age_sum,
                                         float (&missed)[kUnits]) {
    const int hard = params.stages[0][0], stable = params.stages[0][1], mixed = params.stages[0][2];
    uint32_t keys[kUnits], stable_words[kUnits], mixed_words[kUnits];
#pragma unroll
    for (int j = 0; j < kUnits; ++j) {
        const Words words = random_words(params, places[j], view, purpose);
        keys[j] = exist >> j & 1u ? race_key(errors[j], words.x0) : 0u;
        stable_words[j] = words.x1;
        mixed_words[j] = words.x2;
        if (kWeighted) missed[j] = 1.0f;
    }
    const auto miss = [&](uint32_t taken, const auto& thresholds, const auto& chance_of) {
#pragma unroll
        for (int j = 0; j < kUnits; ++j) {
            const auto tau = (taken >> j & 1u) != 0u ? thresholds.largest_left : thresholds.smallest_taken;
            missed[j] *= thresholds.largest_left == 0 ? 0.0f : 1.0f - chance_of(j, tau);
        }
    };
    uint32_t drawn = 0;
    if (hard > 0) {
        drawn = take_largest<false>(keys, hard);
        if (kWeighted) {
            miss(drawn, stage_thresholds(keys, drawn), [&](int j, uint32_t tau) { return race_chance(errors[j], tau); });
        }
    }
    if (stable > 0) {
        // By age first; of equal ages by the random words.
        const uint32_t open = exist & ~drawn;
#pragma unroll
        for (int j = 0; j < kUnits; ++j) keys[j] = open >> j & 1u ? static_cast<uint32_t>(ages[j]) + 1u : 0u;
        const Split oldest = split_largest<false>(keys, stable);
        uint32_t taken = oldest.taken;
        if (oldest.room > 0) {
#pragma unroll
            for (int j = 0; j < kUnits; ++j) {
                keys[j] = oldest.tied >> j & 1u ? (stable_words[j] >> (32 - kAgeTieBits)) + 1u : 0u;
            }
            taken |= take_largest<true>(keys, oldest.room);
        }
        if (kWeighted) {
            uint64_t age_keys[kUnits];  // plus 1, so that 0 is no unit
#pragma unroll
            for (int j = 0; j < kUnits; ++j) age_keys[j] = open >> j & 1u ? age_key(ages[j], stable_words[j]) + 1u : 0u;
            miss(taken, stage_thresholds(age_keys, taken),
                 [&](int j, uint64_t tau) { return age_chance(ages[j], tau - 1u); });
        }
        drawn |= taken;
    }
    if (mixed > 0) {
        const float error_total = __double2float_rn(error_sum), age_total = __int2float_rn(age_sum);
        const uint32_t open = exist & ~drawn;
        float weights[kUnits];
#pragma unroll
        for (int j = 0; j < kUnits; ++j) {
            weights[j] = params.mixed_uniform ? 1.0f : mixed_weight(errors[j], ages[j], error_total, age_total);
            keys[j] = open >> j & 1u ? race_key(weights[j], mixed_words[j]) : 0u;
        }
        const uint32_t taken = take_largest<false>(keys, mixed);
        if (kWeighted) {
            miss(taken, stage_thresholds(keys, taken), [&](int j, uint32_t tau) { return race_chance(weights[j], tau); });
        }
        drawn |= taken;
    }
    return drawn;
}

// The tile of this warp, and its 8 pixels a lane.
struct TilePixels {
    int view;                  // in the batch
    int column, row;           // of the tile
    int width, height;         // of the part inside the image
    uint32_t inside;           // bit j: pixel (j, lane) exists
    uint32_t ids[kPerLane];    // y * width + x
};

__device__ __forceinline__ TilePixels locate_tile(const SamplePixelsParams& params, int tile) {
    TilePixels pixels;
    pixels.view = 0;
    while (pixels.view + 1 < params.num_views && tile >= params.views[pixels.view + 1].tile_base) ++pixels.view;
    const SampleView& view = params.views[pixels.view];
    const int number = tile - view.tile_base;
    pixels.row = number / view.tiles_x;
    pixels.column = number - pixels.row * view.tiles_x;
    pixels.width = min(kTile, view.width - kTile * pixels.column);
    pixels.height = min(kTile, view.height - kTile * pixels.row);
    pixels.inside = 0;
    const int lane = threadIdx.x & 31, x = lane & 7, y = lane >> 3;
    const int first = (kTile * pixels.row + y) * view.width + kTile * pixels.column + x;
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) {
        const bool exists = x + (j & 1) * 8 < pixels.width && y + (j >> 1) * 4 < pixels.height;
        pixels.inside |= static_cast<uint32_t>(exists) << j;
        pixels.ids[j] = static_cast<uint32_t>(first + (j >> 1) * 4 * view.width + (j & 1) * 8);
    }
    return pixels;
}

__device__ __forceinline__ void load_maps(const SamplePixelsParams& params, const TilePixels& pixels,
                                          float (&errors)[kPerLane], int (&ages)[kPerLane]) {
    const SampleView& view = params.views[pixels.view];
    const int64_t first = view.pixel_base + pixels.ids[0];
    const __half* of_errors = static_cast<const __half*>(params.errors) + first;
    const int16_t* of_stamps = params.stamps + first;
    __half loaded_errors[kPerLane];
    int16_t loaded_stamps[kPerLane];
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) {
        const int offset = (j >> 1) * 4 * view.width + (j & 1) * 8;
        const bool exists = pixels.inside >> j & 1u;
        loaded_errors[j] = exists ? of_errors[offset] : __ushort_as_half(0);
        loaded_stamps[j] = exists ? of_stamps[offset] : static_cast<int16_t>(0);
    }
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) {
        errors[j] = __half2float(loaded_errors[j]);
        const int age = min(max(params.now - static_cast<int>(loaded_stamps[j]), 0), kAgeMax);
        ages[j] = pixels.inside >> j & 1u ? age : 0;
    }
}

// Slots of a tile whose part inside the image has this size.
template <SampleUnit kUnit>
__device__ __forceinline__ int tile_slots(const SamplePixelsParams& params, int width, int height) {
    const int cap = kUnit == SampleUnit::kPixel ? params.slots_per_tile
                                                : min(params.slots_per_tile, 16 * ((width + 3) / 4) * ((height + 3) / 4));
    return min(cap, width * height);
}

// First slot of a tile: within a view only the last column and the last row are cut.
template <SampleUnit kUnit>
__device__ __forceinline__ int first_slot(const SamplePixelsParams& params, const TilePixels& pixels) {
    const SampleView& view = params.views[pixels.view];
    const int last_width = view.width - kTile * (view.tiles_x - 1);
    const int row_slots =
        (view.tiles_x - 1) * tile_slots<kUnit>(params, kTile, kTile) + tile_slots<kUnit>(params, last_width, kTile);
    return view.slot_base + pixels.row * row_slots + pixels.column * tile_slots<kUnit>(params, kTile, pixels.height);
}

template <SampleUnit kUnit, bool kWeighted>
__global__ void __launch_bounds__(kSampleThreads, kSampleBlocks) sample_tiles_kernel(
    const __grid_constant__ SamplePixelsParams params) {
    const int tile = (blockIdx.x * kSampleThreads + threadIdx.x) / 32;
    if (tile >= params.num_tiles) return;  // a whole warp
    const int lane = threadIdx.x & 31;
    const TilePixels pixels = locate_tile(params, tile);
    const uint32_t view_number = static_cast<uint32_t>(params.views[pixels.view].view_number);
    float errors[kPerLane];
    int ages[kPerLane];
    load_maps(params, pixels, errors, ages);

    // The sums of the mixed stage: half-precision errors add up exactly in double.
    double error_sum = 0.0;
    int age_sum = 0;
    float missed[kPerLane];
    uint32_t drawn = 0;
    if (kUnit == SampleUnit::kPixel) {
        if (params.stages[0][2] > 0 && !params.mixed_uniform) {
#pragma unroll
            for (int j = 0; j < kPerLane; ++j) {
                error_sum += static_cast<double>(errors[j]);
                age_sum += ages[j];
            }
            error_sum = warp_sum(error_sum);
            age_sum = static_cast<int>(__reduce_add_sync(kFull, static_cast<uint32_t>(age_sum)));
        }
        drawn = draw<kWeighted>(params, errors, ages, pixels.ids, pixels.inside, view_number, kPurposePixels, error_sum, age_sum,
                     missed);
    } else {
        // Block j holds the 4x4 cells of its left (lane bit 2 clear) and right half; lane n < 16 takes over cell n.
        const int source = (lane & 1) * 4, block = ((lane >> 2) & 3) * 2 + ((lane >> 1) & 1);
        double cell_error = 0.0;
        int cell_age[1] = {0};
        uint32_t cell_place[1] = {0}, cell_exists = 0;
#pragma unroll
        for (int j = 0; j < kPerLane; ++j) {
            double sum = static_cast<double>(errors[j]);
            int oldest = ages[j];
#pragma unroll
            for (int bit = 0; bit < 5; ++bit) {
                if (bit == 2) continue;
                sum += __shfl_xor_sync(kFull, sum, 1 << bit);
                oldest = max(oldest, __shfl_xor_sync(kFull, oldest, 1 << bit));
            }
            const double source_sum = __shfl_sync(kFull, sum, source);
            const int source_age = __shfl_sync(kFull, oldest, source);
            const uint32_t source_place = __shfl_sync(kFull, pixels.ids[j], source);
            const uint32_t source_exists = __shfl_sync(kFull, pixels.inside >> j & 1u, source);
            if (lane < 16 && block == j) {
                cell_error = source_sum;
                cell_age[0] = source_age;
                cell_place[0] = source_place;
                cell_exists = source_exists;
            }
        }
        const float cell_errors[1] = {__double2float_rn(cell_error)};
        error_sum = warp_sum(cell_error);
        age_sum = static_cast<int>(__reduce_add_sync(kFull, static_cast<uint32_t>(cell_age[0])));
        float cell_missed[1];
        const uint32_t cell_drawn = draw<kWeighted>(params, cell_errors, cell_age, cell_place, cell_exists, view_number, kPurposeCells,
                                         error_sum, age_sum, cell_missed);
        const uint32_t cells = __ballot_sync(kFull, cell_drawn != 0u);
#pragma unroll
        for (int j = 0; j < kPerLane; ++j) {
            const int cell = (j >> 1) * 4 + (j & 1) * 2 + ((lane >> 2) & 1);
            drawn |= (cells >> cell & 1u) << j;
            if (kWeighted) missed[j] = __shfl_sync(kFull, cell_missed[0], cell);
        }
        drawn &= pixels.inside;
    }

    const int first = first_slot<kUnit>(params, pixels);
    const int end = first + tile_slots<kUnit>(params, pixels.width, pixels.height);
    const uint32_t lower_lanes = (1u << lane) - 1u;
    int next = first;
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) {
        const bool mine = drawn >> j & 1u;
        const uint32_t lanes = __ballot_sync(kFull, mine);
        if (mine) {
            const int slot = next + __popc(lanes & lower_lanes);
            params.pixel_ids[slot] = static_cast<int32_t>(pixels.ids[j]);
            if (kWeighted) params.weights[slot] = importance_weight(missed[j], params.importance);
        }
        next += __popc(lanes);
    }
    for (int slot = next + lane; slot < end; slot += 32) {
        params.pixel_ids[slot] = -1;
        if (kWeighted) params.weights[slot] = 0.0f;
    }
    if (lane == 0) {
        params.tile_ids[tile] = tile;
        params.tile_offsets[tile] = first;
        if (tile == params.num_tiles - 1) params.tile_offsets[tile + 1] = end;
    }
}

// ---- Whole tiles ---------------------------------------------------------------------------------------------------

__global__ void __launch_bounds__(kSampleThreads) tile_sums_kernel(const __grid_constant__ SamplePixelsParams params) {
    const int tile = (blockIdx.x * kSampleThreads + threadIdx.x) / 32;
    if (tile >= params.num_tiles) return;
    const TilePixels pixels = locate_tile(params, tile);
    float errors[kPerLane];
    int ages[kPerLane];
    load_maps(params, pixels, errors, ages);
    double error_sum = 0.0;
    int oldest = 0;
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) {
        error_sum += static_cast<double>(errors[j]);
        oldest = max(oldest, ages[j]);
    }
    error_sum = warp_sum(error_sum);
    oldest = static_cast<int>(__reduce_max_sync(kFull, static_cast<uint32_t>(oldest)));
    if ((threadIdx.x & 31) == 0) {
        params.tile_errors[tile] = error_sum;
        params.tile_ages[tile] = oldest;
    }
}

// Sum over the block, the same in every thread. `scratch` holds one entry a warp.
template <class T>
__device__ __forceinline__ T block_sum(T value, T* scratch) {
#pragma unroll
    for (int step = 16; step > 0; step >>= 1) value += __shfl_xor_sync(kFull, value, step);
    __syncthreads();  // the last use of `scratch` is over
    if ((threadIdx.x & 31) == 0) scratch[threadIdx.x / 32] = value;
    __syncthreads();
    T total = 0;
    for (int warp = 0; warp < kChooseThreads / 32; ++warp) total += scratch[warp];
    return total;
}

// A block draws the tiles of one view. Keys hold the rank in their low bits, so no two are equal; -1 marks a tile that is
// drawn already.
__global__ void __launch_bounds__(kChooseThreads) choose_tiles_kernel(
    const __grid_constant__ SamplePixelsParams params) {
    __shared__ double double_scratch[kChooseThreads / 32];
    __shared__ long long scratch[kChooseThreads / 32];
    const int batch_view = blockIdx.x;
    const SampleView& view = params.views[batch_view];
    const int count = view.tiles_x * view.tiles_y;
    const double* errors = params.tile_errors + view.tile_base;
    const int32_t* ages = params.tile_ages + view.tile_base;
    int64_t* keys = params.tile_keys + view.tile_base;
    float* missed = params.tile_missed + view.tile_base;
    const bool weighted = params.weights != nullptr;

    double error_part = 0.0;
    long long age_part = 0;
    for (int i = threadIdx.x; i < count; i += kChooseThreads) {
        error_part += errors[i];
        age_part += ages[i];
        keys[i] = 0;
        missed[i] = 1.0f;
    }
    const float error_sum = __double2float_rn(block_sum(error_part, double_scratch));
    const float age_sum = __ll2float_rn(block_sum(age_part, scratch));

    for (int stage = 0; stage < 3; ++stage) {
        const int wanted = params.stages[batch_view][stage];
        if (wanted == 0) continue;
        const auto weight_of = [&](int i) {
            const float error = __double2float_rn(errors[i]);
            if (stage == 0) return error;
            return params.mixed_uniform ? 1.0f : mixed_weight(error, ages[i], error_sum, age_sum);
        };
        long long open = 0;
        for (int i = threadIdx.x; i < count; i += kChooseThreads) {
            if (keys[i] < 0) continue;
            ++open;
            const Words words = random_words(params, static_cast<uint32_t>(i), static_cast<uint32_t>(view.view_number),
                                             kPurposeTiles);
            const uint64_t primary = stage == 1 ? age_key(ages[i], words.x1)
                                                : race_key(weight_of(i), stage == 0 ? words.x0 : words.x2);
            keys[i] = static_cast<int64_t>(primary << kRankBits | ((1u << kRankBits) - 1u - static_cast<uint32_t>(i)));
        }
        const bool exhausted = block_sum(open, scratch) <= wanted;
        int64_t threshold = 0;
        if (!exhausted) {
            for (int bit = 58; bit >= 0; --bit) {
                const int64_t candidate = threshold | int64_t{1} << bit;
                long long reached = 0;
                for (int i = threadIdx.x; i < count; i += kChooseThreads) reached += keys[i] >= candidate;
                const long long total = block_sum(reached, scratch);
                if (total >= wanted) threshold = candidate;
                if (total == wanted && !weighted) break;  // to the last bit, `threshold` is the smallest key taken
            }
        }
        // The largest key left, found the same way: the largest number that some remaining key reaches.
        int64_t largest_left = 0;
        if (weighted && !exhausted) {
            for (int bit = 58; bit >= 0; --bit) {
                const int64_t candidate = largest_left | int64_t{1} << bit;
                long long reached = 0;
                for (int i = threadIdx.x; i < count; i += kChooseThreads) {
                    reached += keys[i] < threshold && keys[i] >= candidate;
                }
                if (block_sum(reached, scratch) > 0) largest_left = candidate;
            }
        }
        for (int i = threadIdx.x; i < count; i += kChooseThreads) {
            if (weighted) {
                const int64_t tau = (keys[i] >= threshold ? largest_left : threshold) >> kRankBits;
                const float chance = stage == 1 ? age_chance(ages[i], static_cast<uint64_t>(tau))
                                                : race_chance(weight_of(i), static_cast<uint32_t>(tau));
                missed[i] *= exhausted ? 0.0f : 1.0f - chance;
            }
            if (keys[i] >= threshold) keys[i] = -1;
        }
    }

    // The drawn tiles in their order.
    int next = view.slot_base;
    for (int start = 0; start < count; start += kChooseThreads) {
        const int i = start + threadIdx.x;
        const bool mine = i < count && keys[i] < 0;
        const uint32_t lanes = __ballot_sync(kFull, mine);
        __syncthreads();
        if ((threadIdx.x & 31) == 0) scratch[threadIdx.x / 32] = __popc(lanes);
        __syncthreads();
        int before = 0, total = 0;
        for (int warp = 0; warp < kChooseThreads / 32; ++warp) {
            const int size = static_cast<int>(scratch[warp]);
            before += warp < static_cast<int>(threadIdx.x / 32) ? size : 0;
            total += size;
        }
        if (mine) params.tile_ids[next + before + __popc(lanes & ((1u << (threadIdx.x & 31u)) - 1u))] = view.tile_base + i;
        next += total;
    }
}

__global__ void __launch_bounds__(kSampleThreads) fill_tiles_kernel(const __grid_constant__ SamplePixelsParams params) {
    const int chosen = (blockIdx.x * kSampleThreads + threadIdx.x) / 32;
    if (chosen >= params.num_chosen) return;
    const int lane = threadIdx.x & 31;
    const int tile = params.tile_ids[chosen];
    const TilePixels pixels = locate_tile(params, tile);
    const float weight = params.weights != nullptr ? importance_weight(params.tile_missed[tile], params.importance) : 0.0f;
    int next = chosen * kTilePixels;
    const int end = next + kTilePixels;
    const uint32_t lower_lanes = (1u << lane) - 1u;
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) {
        const bool mine = pixels.inside >> j & 1u;
        const uint32_t lanes = __ballot_sync(kFull, mine);
        if (mine) {
            const int slot = next + __popc(lanes & lower_lanes);
            params.pixel_ids[slot] = static_cast<int32_t>(pixels.ids[j]);
            if (params.weights != nullptr) params.weights[slot] = weight;
        }
        next += __popc(lanes);
    }
    for (int slot = next + lane; slot < end; slot += 32) {
        params.pixel_ids[slot] = -1;
        if (params.weights != nullptr) params.weights[slot] = 0.0f;
    }
    if (lane == 0) {
        params.tile_offsets[chosen] = chosen * kTilePixels;
        if (chosen == params.num_chosen - 1) params.tile_offsets[chosen + 1] = end;
    }
}

template <SampleUnit kUnit>
cudaError_t launch_tiles(const SamplePixelsParams& params, int blocks, cudaStream_t stream) {
    if (params.weights != nullptr) {
        sample_tiles_kernel<kUnit, true><<<blocks, kSampleThreads, 0, stream>>>(params);
    } else {
        sample_tiles_kernel<kUnit, false><<<blocks, kSampleThreads, 0, stream>>>(params);
    }
    return cudaGetLastError();
}

int warp_blocks(int warps) { return (warps * 32 + kSampleThreads - 1) / kSampleThreads; }

}  // namespace

cudaError_t launch_sample_pixels(const SamplePixelsParams& params, cudaStream_t stream) {
    if (params.num_tiles == 0) return cudaSuccess;
    const int blocks = warp_blocks(params.num_tiles);
    if (params.unit == SampleUnit::kPixel) return launch_tiles<SampleUnit::kPixel>(params, blocks, stream);
    if (params.unit == SampleUnit::kCell) return launch_tiles<SampleUnit::kCell>(params, blocks, stream);
    tile_sums_kernel<<<blocks, kSampleThreads, 0, stream>>>(params);
    cudaError_t status = cudaGetLastError();
    if (status != cudaSuccess) return status;
    choose_tiles_kernel<<<params.num_views, kChooseThreads, 0, stream>>>(params);
    status = cudaGetLastError();
    if (status != cudaSuccess) return status;
    fill_tiles_kernel<<<warp_blocks(params.num_chosen), kSampleThreads, 0, stream>>>(params);
    return cudaGetLastError();
}

}  // namespace turbogs
