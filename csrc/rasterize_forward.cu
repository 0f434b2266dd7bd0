// Stage 4: colour, alpha and, when asked, depth at the sampled pixels.
//
// One warp renders one work item: up to 32 * samples_per_lane samples of one active tile, with the state of every pixel in
// registers, so work follows the samples and no warp waits for another. Splats are staged 32 at a time in the warp's own
// shared memory, the next 32 being fetched meanwhile, and read from there by all lanes at once. For the backward pass the
// warp leaves one bit for each staged splat that contributed to any of its samples.
#include "common.cuh"

namespace turbogs {
namespace {

constexpr int kForwardWarps = 2;  // of a block; they share nothing

struct Splat {
    float4 quads[3];
};

__device__ __forceinline__ Splat load_splat(const Instance* __restrict__ instances, uint32_t instance) {
    const float4* in = reinterpret_cast<const float4*>(instances + instance);
    return {{__ldg(in), __ldg(in + 1), __ldg(in + 2)}};
}

template <int kPerLane, bool kDepth>
__global__ void __launch_bounds__(kForwardWarps * kWarpSize) forward_kernel(const __grid_constant__ ForwardParams params) {
    __shared__ float4 staged_splats[kForwardWarps][3][kBucket];
    const int lane = threadIdx.x % kWarpSize;
    const int item = blockIdx.x * kForwardWarps + threadIdx.x / kWarpSize;
    if (item >= params.num_active * params.chunks) return;
    float4(*staged)[kBucket] = staged_splats[threadIdx.x / kWarpSize];

    const int tile = item / params.chunks, chunk = item - tile * params.chunks;
    const int tile_id = params.tile_ids != nullptr ? params.tile_ids[tile] : tile;
    const int width = params.cameras[view_of_tile(params.cameras, params.num_views, tile_id)].width;
    const uint32_t first_pair = params.tile_starts[tile];
    const int num_pairs = static_cast<int>(params.tile_starts[tile + 1] - first_pair);
    const int num_buckets = (num_pairs + kBucket - 1) / kBucket;
    const uint32_t* pair_ids = params.pair_ids + first_pair;
    uint32_t* masks = params.masks + static_cast<size_t>(first_pair / kBucket + tile) * params.chunks + chunk;
    const int slot_end = params.tile_offsets[tile + 1];
    constexpr int kChunkSlots = kPerLane * kWarpSize;

    int walked = 0;
    for (int slot_base = params.tile_offsets[tile] + chunk * kChunkSlots; slot_base < slot_end;
         slot_base += params.chunks * kChunkSlots) {
        // A pixel that has ended, or an empty slot, has x = NaN: it then fails every test below.
        const float ended_x = __int_as_float(0x7FFFFFFF);
        float x[kPerLane], y[kPerLane], transmittance[kPerLane], red[kPerLane], green[kPerLane], blue[kPerLane], depth[kPerLane];
        int last[kPerLane];
#pragma unroll
        for (int i = 0; i < kPerLane; ++i) {
            const int slot = slot_base + i * kWarpSize + lane;
            const int pixel = slot < slot_end ? params.pixel_ids[slot] : -1;
            const int pixel_y = pixel / width;
            x[i] = pixel < 0 ? ended_x : static_cast<float>(pixel - pixel_y * width) + 0.5f;
            y[i] = static_cast<float>(pixel_y) + 0.5f;
            transmittance[i] = 1.0f;
            red[i] = green[i] = blue[i] = depth[i] = 0.0f;
            last[i] = -1;
        }

        // Two steps ahead the identity of the splat to stage, one step ahead the splat.
        Splat next = {};
        uint32_t next_id = 0;
        if (lane < num_pairs) next = load_splat(params.instances, pair_ids[lane]);
        if (kBucket + lane < num_pairs) next_id = pair_ids[kBucket + lane];

        int bucket = 0;
        for (; bucket < num_buckets; ++bucket) {
            bool alive = false;
#pragma unroll
            for (int i = 0; i < kPerLane; ++i) alive |= x[i] == x[i];
            if (!__any_sync(kFullWarp, alive)) break;

            __syncwarp();
            staged[0][lane] = make_float4(next.quads[0].x, next.quads[0].y, 0.5f * next.quads[0].z, next.quads[0].w);
            staged[1][lane] = make_float4(0.5f * next.quads[1].x, next.quads[1].y, next.quads[1].z, 0.0f);
            staged[2][lane] = next.quads[2];
            __syncwarp();
            const int first = bucket * kBucket;
            if (first + kBucket + lane < num_pairs) next = load_splat(params.instances, next_id);
            if (first + 2 * kBucket + lane < num_pairs) next_id = pair_ids[first + 2 * kBucket + lane];

            uint32_t contributed = 0;
            const int count = min(kBucket, num_pairs - first);
#pragma unroll 2
            for (int t = 0; t < count; ++t) {
                const float4 shape = staged[0][t];  // x, y, a / 2, b
                const float4 rest = staged[1][t];   // c / 2, opacity, depth
                float alpha[kPerLane];
                bool seen[kPerLane];
#pragma unroll
                for (int i = 0; i < kPerLane; ++i) {
                    const float sigma = splat_sigma(shape.z, shape.w, rest.x, shape.x - x[i], shape.y - y[i]);
                    alpha[i] = fminf(params.alpha_max, splat_alpha(rest.y, sigma));
                    seen[i] = sigma >= 0.0f && alpha[i] >= params.alpha_min;
                }
#pragma unroll
                for (int i = 0; i < kPerLane; ++i) {
                    if (!seen[i]) continue;
                    const float behind = transmittance[i] * (1.0f - alpha[i]);
                    if (behind <= params.transmittance_min) {
                        x[i] = ended_x;
                        continue;
                    }
                    const float4 color = staged[2][t];
                    const float weight = alpha[i] * transmittance[i];
                    red[i] += weight * color.x;
                    green[i] += weight * color.y;
                    blue[i] += weight * color.z;
                    if (kDepth) depth[i] += weight * rest.z;
                    transmittance[i] = behind;
                    last[i] = first + t;
                    contributed |= 1u << t;
                }
            }
            contributed = __reduce_or_sync(kFullWarp, contributed);
            if (lane == 0) {
                uint32_t* mask = masks + static_cast<size_t>(bucket) * params.chunks;
                *mask = bucket < walked ? (*mask | contributed) : contributed;
            }
        }
        walked = max(walked, bucket);

#pragma unroll
        for (int i = 0; i < kPerLane; ++i) {
            const int slot = slot_base + i * kWarpSize + lane;
            if (slot >= slot_end) continue;
            const float alpha = 1.0f - transmittance[i];
            params.colors[3 * static_cast<size_t>(slot)] = red[i];
            params.colors[3 * static_cast<size_t>(slot) + 1] = green[i];
            params.colors[3 * static_cast<size_t>(slot) + 2] = blue[i];
            params.alphas[slot] = alpha;
            params.transmittances[slot] = transmittance[i];
            params.last_pairs[slot] = last[i];
            if (kDepth) params.depths[slot] = depth[i] / fmaxf(alpha, kAlphaTiny);
        }
    }
    if (lane == 0) params.bucket_counts[item] = walked;
}

template <int kPerLane>
void launch(const ForwardParams& params, int blocks, cudaStream_t stream) {
    if (params.with_depth) forward_kernel<kPerLane, true><<<blocks, kForwardWarps * kWarpSize, 0, stream>>>(params);
    else forward_kernel<kPerLane, false><<<blocks, kForwardWarps * kWarpSize, 0, stream>>>(params);
}

}  // namespace

cudaError_t launch_rasterize_forward(const ForwardParams& params, cudaStream_t stream) {
    const int items = params.num_active * params.chunks;
    if (items == 0) return cudaSuccess;
    const int blocks = (items + kForwardWarps - 1) / kForwardWarps;
    switch (params.samples_per_lane) {
        case 1: launch<1>(params, blocks, stream); break;
        case 2: launch<2>(params, blocks, stream); break;
        case 3: launch<3>(params, blocks, stream); break;
        case 4: launch<4>(params, blocks, stream); break;
        default: return cudaErrorInvalidValue;
    }
    return cudaGetLastError();
}

}  // namespace turbogs
