// Error-guided sampling of whole tiles, in three launches. In the first a warp sums the errors of one tile and finds
// its greatest age. In the second a block draws the tiles of one view. In the third a warp lists the pixels of one
// drawn tile.
//
// A view's tiles are too many for registers, so their keys lie in memory, and each stage of the draw finds its
// threshold bit by bit, with counts over the block. There are only a few thousand keys. The drawn sets equal those of
// the torch reference.
#include "sampling/tile_pixels.cuh"
#include "sampling/race_keys.cuh"

namespace turbogs {
namespace {

constexpr int kChooseThreads = 1024;  // the most of a block: there is one block a view
constexpr int kChooseWarps = kChooseThreads / kWarpSize;
constexpr int kRankBits = 20;  // of a key, below the age or the race: RANK_BITS of draws.py
constexpr int kAgeBits = 15;
constexpr int kTopBit = kRankBits + kAgeTieBits + kAgeBits - 1;  // highest bit of a key; a race's are shorter

template <bool kMasked>
__global__ void __launch_bounds__(kSampleThreads) tile_sums_kernel(const __grid_constant__ SamplePixelsParams params) {
    const int tile = (blockIdx.x * kSampleThreads + threadIdx.x) / kWarpSize;
    if (tile >= params.num_tiles) return;
    const TilePixels pixels = locate_tile<kMasked>(params, tile);
    const PixelUnits units = load_maps(params, pixels);
    double error_sum = 0.0;
    int oldest = 0;
#pragma unroll
    for (int j = 0; j < kPerLane; ++j) {
        error_sum += static_cast<double>(units.error(j));
        oldest = max(oldest, units.age(j));
    }
    error_sum = warp_sum(error_sum);
    oldest = static_cast<int>(__reduce_max_sync(kFullWarp, static_cast<uint32_t>(oldest)));
    if (this_lane() == 0) {
        params.tile_errors[tile] = error_sum;
        params.tile_ages[tile] = oldest;
    }
}

// A block draws the tiles of one view. Keys hold the rank in their low bits, so no two are equal; -1 marks a tile
// that is drawn already.
__global__ void __launch_bounds__(kChooseThreads) choose_tiles_kernel(
    const __grid_constant__ SamplePixelsParams params) {
    __shared__ double double_scratch[kChooseWarps];
    __shared__ long long scratch[kChooseWarps];
    const int batch_view = blockIdx.x;
    const SampleView& view = params.views[batch_view];
    const int count = params.live[batch_view].count, base = params.live[batch_view].tile_base;
    const double* errors = params.tile_errors + base;
    const int32_t* ages = params.tile_ages + base;
    int64_t* keys = params.tile_keys + base;

    double error_part = 0.0;
    long long age_part = 0;
    for (int i = threadIdx.x; i < count; i += kChooseThreads) {
        error_part += errors[i];
        age_part += ages[i];
        keys[i] = 0;
    }
    const float error_sum = __double2float_rn(block_sum(error_part, double_scratch));
    const float age_sum = __ll2float_rn(block_sum(age_part, scratch));

    for (int stage = 0; stage < 3; ++stage) {
        const int wanted = params.stages[batch_view][stage];
        if (wanted == 0) continue;
        long long open = 0;
        for (int i = threadIdx.x; i < count; i += kChooseThreads) {
            if (keys[i] < 0) continue;
            ++open;
            const uint3 words = random_words(params.keys, static_cast<uint32_t>(i),
                                             static_cast<uint32_t>(view.view_number), kPurposeTiles);
            const float error = __double2float_rn(errors[i]);
            const float mixed = params.mixed_uniform ? 1.0f : mixed_weight(error, ages[i], error_sum, age_sum);
            const uint64_t primary = stage == 1 ? age_key(ages[i], words.y)
                                                : race_key(stage == 0 ? error : mixed, stage == 0 ? words.x : words.z);
            keys[i] = static_cast<int64_t>(primary << kRankBits | ((1u << kRankBits) - 1u - static_cast<uint32_t>(i)));
        }
        int64_t threshold = 0;
        long long total = block_sum(open, scratch);
        for (int bit = kTopBit; bit >= 0 && total > wanted; --bit) {
            const int64_t candidate = threshold | int64_t{1} << bit;
            long long reached = 0;
            for (int i = threadIdx.x; i < count; i += kChooseThreads) reached += keys[i] >= candidate;
            reached = block_sum(reached, scratch);
            if (reached < wanted) continue;
            threshold = candidate;
            total = reached;
        }
        for (int i = threadIdx.x; i < count; i += kChooseThreads) {
            if (keys[i] >= threshold) keys[i] = -1;
        }
    }

    // The places of the drawn tiles, in their order.
    int next = view.slot_base;
    for (int start = 0; start < count; start += kChooseThreads) {
        const int i = start + threadIdx.x;
        const bool mine = i < count && keys[i] < 0;
        const uint32_t lanes = __ballot_sync(kFullWarp, mine);
        __syncthreads();
        if (this_lane() == 0) scratch[this_warp()] = __popc(lanes);
        __syncthreads();
        int before = 0, total = 0;
        for (int warp = 0; warp < kChooseWarps; ++warp) {
            const int size = static_cast<int>(scratch[warp]);
            before += warp < this_warp() ? size : 0;
            total += size;
        }
        if (mine) params.tile_ids[next + before + __popc(lanes & lanes_below(this_lane()))] = base + i;
        next += total;
    }
}

template <bool kMasked>
__global__ void __launch_bounds__(kSampleThreads) fill_tiles_kernel(const __grid_constant__ SamplePixelsParams params) {
    const int chosen = (blockIdx.x * kSampleThreads + threadIdx.x) / kWarpSize;
    if (chosen >= params.num_chosen) return;
    const int tile = params.tile_ids[chosen], first = chosen * kTilePixels, end = first + kTilePixels;
    const TilePixels pixels = locate_tile<kMasked>(params, tile);
    write_samples(params, pixels, pixels.inside, first, end, false, [](int) { return 0.0f; });
    __syncwarp();
    if (this_lane() == 0) {
        if (kMasked) params.tile_ids[chosen] = pixels.id_of_tile;  // in place of the place in the list
        params.tile_offsets[chosen] = first;
        if (chosen == params.num_chosen - 1) params.tile_offsets[chosen + 1] = end;
    }
}

template <bool kMasked>
void launch(const SamplePixelsParams& params, cudaStream_t stream) {
    tile_sums_kernel<kMasked><<<warp_blocks(params.num_tiles), kSampleThreads, 0, stream>>>(params);
    choose_tiles_kernel<<<params.num_views, kChooseThreads, 0, stream>>>(params);
    fill_tiles_kernel<kMasked><<<warp_blocks(params.num_chosen), kSampleThreads, 0, stream>>>(params);
}

}  // namespace

void launch_sample_tiles(const SamplePixelsParams& params, cudaStream_t stream) {
    if (params.live_tiles != nullptr) launch<true>(params, stream);
    else launch<false>(params, stream);
}

}  // namespace turbogs
