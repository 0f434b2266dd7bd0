// Stage 5: colour, alpha and, when asked, depth at the sampled pixels. Defined by
// turbogs_plugin/engine/reference/compositing.py.
//
// One warp renders one work item of an active tile, or two where a tile has an even number of them. A work item is 32
// samples, whose state lies in registers, one sample to a lane. So work grows with the samples, and no warp waits for
// another. Splats come 32 at a time, one to a lane, while the next 32 are fetched. Each lane drops its splat if it
// reaches none of the warp's samples. All lanes then read the others, one after another, from the warp's own shared
// memory. For the backward pass the warp leaves one bit for each splat that contributed to any sample of the item.
#include "raster/staged_splat.cuh"

namespace turbogs {
namespace {

constexpr int kForwardWarps = 4;  // of a block; they share nothing but the first-level cache. 2 were no faster at 600k
constexpr int kAhead = 2;         // splats whose arithmetic overlaps; no record of other values

// Blocks of an SM, so 72 registers for one work item a warp and 80 for two. Left to itself the compiler took 72 for
// two as well, and the pass 292 us in place of 251.
constexpr int forward_blocks(int items) { return items == 1 ? 7 : 6; }

constexpr float kLevelSlack = 0.01f;  // of a level (log2 of an alpha), for the rounding of the least one of a box

// Smallest box around the samples of a warp, in the tile's frame.
struct SampleBox {
    float x0, x1, y0, y1;
};

constexpr SampleBox kNoBox = {1e9f, -1e9f, 1e9f, -1e9f};  // beyond all pixels

__device__ __forceinline__ void enlarge(SampleBox& box, float2 pixel) {
    box = {fminf(box.x0, pixel.x), fmaxf(box.x1, pixel.x), fminf(box.y0, pixel.y), fmaxf(box.y1, pixel.y)};
}

// The box around all lanes' boxes.
__device__ __forceinline__ SampleBox box_of_warp(SampleBox box) {
#pragma unroll
    for (int step = kWarpSize / 2; step > 0; step /= 2) {
        box.x0 = fminf(box.x0, __shfl_xor_sync(kFullWarp, box.x0, step));
        box.x1 = fmaxf(box.x1, __shfl_xor_sync(kFullWarp, box.x1, step));
        box.y0 = fminf(box.y0, __shfl_xor_sync(kFullWarp, box.y0, step));
        box.y1 = fmaxf(box.y1, __shfl_xor_sync(kFullWarp, box.y1, step));
    }
    return box;
}

// Whether a splat may be seen within the box. The least u^2 + v^2 of a box lies at the mean, or on an edge that faces
// it: on the line of the y nearest to the mean's or of the x nearest to it.
__device__ __forceinline__ bool reaches_box(const StagedSplat& splat, float mean_x, float mean_y, const SampleBox& box,
                                            float least_level) {
    const float p = splat.form.x, q = splat.form.y, r = splat.form.z, u = splat.form.w, v = splat.rest.x;
    const float near_x = fminf(fmaxf(mean_x, box.x0), box.x1), near_y = fminf(fmaxf(mean_y, box.y0), box.y1);
    const float best_x = fminf(fmaxf(fmaf(-q, near_y, u) * approximate_reciprocal(p), box.x0), box.x1);
    const float partial = fmaf(-p, near_x, u);
    const float best_y =
        fminf(fmaxf(fmaf(q, partial, r * v) * approximate_reciprocal(fmaf(q, q, r * r)), box.y0), box.y1);
    const float level = fmaxf(splat_level(splat.form, splat.rest, best_x, near_y),
                              splat_level(splat.form, splat.rest, near_x, best_y));
    return !(level < least_level - kLevelSlack);  // NaN stays
}

template <int kItems, bool kDepth>
__global__ void __launch_bounds__(kForwardWarps* kWarpSize, forward_blocks(kItems))
    forward_kernel(const __grid_constant__ ForwardParams params) {
    __shared__ StagedSplat staged_splats[kForwardWarps][kBucket];
    const int lane = this_lane();
    const int warps_per_tile = params.chunks / kItems;
    const int warp = blockIdx.x * kForwardWarps + this_warp();
    if (warp >= params.num_active * warps_per_tile) return;
    StagedSplat* staged = staged_splats[this_warp()];

    const int tile = warp / warps_per_tile, first_chunk = (warp - tile * warps_per_tile) * kItems;
    const TileFrame frame = tile_frame(params, tile);
    const uint32_t first_intersection = params.tile_starts[tile];
    const int num_intersections = static_cast<int>(params.tile_starts[tile + 1] - first_intersection);
    const int num_buckets = (num_intersections + kBucket - 1) / kBucket;
    const uint32_t* intersection_ids = params.intersection_ids + first_intersection;
    uint32_t* masks = masks_of_item(params, first_intersection, tile, first_chunk);
    const int slot_end = params.tile_offsets[tile + 1];
    const float least_level = log2f(params.alpha_min);
    const float never = infinity();

    int walked = 0;
    for (int slot_base = params.tile_offsets[tile] + first_chunk * kWarpSize; slot_base < slot_end;
         slot_base += params.chunks * kWarpSize) {
        // Level from which a splat is seen: never at a pixel that has ended, or at an empty slot.
        float x[kItems], y[kItems], threshold[kItems];
        float transmittance[kItems], red[kItems], green[kItems], blue[kItems], depth[kItems];
        int last[kItems];
        SampleBox box = kNoBox;
#pragma unroll
        for (int item = 0; item < kItems; ++item) {
            const int slot = slot_base + item * kWarpSize + lane;
            const int pixel = slot < slot_end ? params.pixel_ids[slot] : -1;
            const float2 at = pixel_in_tile(frame, max(pixel, 0));
            x[item] = at.x;
            y[item] = at.y;
            threshold[item] = pixel >= 0 ? least_level : never;
            if (pixel >= 0) enlarge(box, at);
            transmittance[item] = 1.0f;
            red[item] = green[item] = blue[item] = depth[item] = 0.0f;
            last[item] = -1;
        }
        box = box_of_warp(box);

        // Two steps ahead the identity of the splat to stage, one step ahead the splat.
        StagedSplat next = {};
        uint32_t next_id = 0;
        if (lane < num_intersections) next = load_splat(params.instances, intersection_ids[lane]);
        if (kBucket + lane < num_intersections) next_id = intersection_ids[kBucket + lane];

        int bucket = 0;
        for (; bucket < num_buckets; ++bucket) {
            bool alive = false;
#pragma unroll
            for (int item = 0; item < kItems; ++item) alive = alive || threshold[item] < never;
            if (!__any_sync(kFullWarp, alive)) break;

            const int own = bucket * kBucket + lane;
            StagedSplat splat = next;
            bool kept = own < num_intersections;
            if (own + kBucket < num_intersections) next = load_splat(params.instances, next_id);
            if (own + 2 * kBucket < num_intersections) next_id = intersection_ids[own + 2 * kBucket];
            if (kept) {
                const float mean_x = splat.form.x - frame.x, mean_y = splat.form.y - frame.y;
                stage_splat(splat, frame.x, frame.y, least_level, own, 1u << lane);
                kept = reaches_box(splat, mean_x, mean_y, box, least_level);
            }
            const uint32_t keepers = __ballot_sync(kFullWarp, kept);
            const int count = __popc(keepers);
            __syncwarp();
            const uint32_t below = lanes_below(lane);
            if (kept) staged[__popc(keepers & below)] = splat;
            else staged[count + __popc(~keepers & below)] = no_splat();
            __syncwarp();

            // No branches: most splats left are seen by some lane, and several overlap this way.
            uint32_t contributed[kItems] = {};
            for (int base = 0; base < count; base += kAhead) {
#pragma unroll
                for (int i = 0; i < kAhead; ++i) {
                    const float4 form = staged[base + i].form, rest = staged[base + i].rest;
                    const float4 color = staged[base + i].color;
#pragma unroll
                    for (int item = 0; item < kItems; ++item) {
                        const float level = splat_level(form, rest, x[item], y[item]);
                        const bool seen = level >= threshold[item];
                        const float full = fminf(params.alpha_max, approximate_exp2(level)) * transmittance[item];
                        const bool ends = seen && transmittance[item] - full <= params.transmittance_min;
                        const bool taken = seen && !ends;
                        const float weight = taken ? full : 0.0f;
                        if (ends) threshold[item] = never;
                        transmittance[item] -= weight;
                        red[item] += weight * color.x;
                        green[item] += weight * color.y;
                        blue[item] += weight * color.z;
                        if (kDepth) depth[item] += weight * rest.z;
                        if (taken) last[item] = __float_as_int(rest.w);
                        if (taken) contributed[item] |= __float_as_uint(color.w);
                    }
                }
            }
#pragma unroll
            for (int item = 0; item < kItems; ++item) {
                const uint32_t any = __reduce_or_sync(kFullWarp, contributed[item]);
                if (lane == item) {
                    uint32_t* mask = masks + static_cast<size_t>(bucket) * params.chunks + item;
                    *mask = bucket < walked ? (*mask | any) : any;
                }
            }
        }
        walked = max(walked, bucket);

#pragma unroll
        for (int item = 0; item < kItems; ++item) {
            const int slot = slot_base + item * kWarpSize + lane;
            if (slot >= slot_end) continue;
            const float alpha = 1.0f - transmittance[item];
            params.colors[3 * static_cast<size_t>(slot)] = red[item] + transmittance[item] * params.background[0];
            params.colors[3 * static_cast<size_t>(slot) + 1] = green[item] + transmittance[item] * params.background[1];
            params.colors[3 * static_cast<size_t>(slot) + 2] = blue[item] + transmittance[item] * params.background[2];
            params.alphas[slot] = alpha;
            params.transmittances[slot] = transmittance[item];
            params.last_intersections[slot] = last[item];
            if (kDepth) params.depths[slot] = depth[item] / fmaxf(alpha, kAlphaTiny);
        }
    }
    if (lane < kItems) params.bucket_counts[tile * params.chunks + first_chunk + lane] = walked;
}

}  // namespace

void launch_rasterize_forward(const ForwardParams& params, cudaStream_t stream) {
    if (params.num_active * params.chunks == 0) return;
    const bool even = params.chunks % 2 == 0;
    const auto kernel = params.depths != nullptr ? (even ? forward_kernel<2, true> : forward_kernel<1, true>)
                                                 : (even ? forward_kernel<2, false> : forward_kernel<1, false>);
    const int warps = params.num_active * (even ? params.chunks / 2 : params.chunks);
    kernel<<<blocks_for(warps, kForwardWarps), kForwardWarps * kWarpSize, 0, stream>>>(params);
}

}  // namespace turbogs
