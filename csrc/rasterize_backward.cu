// Stage 5: from the gradients at the samples to a record for every splat on the screen, with the density sums.
//
// One warp takes one work item of the forward pass and walks back to front the splats that contributed to it (and no
// others: the forward pass left their bits), 32 at a time. For every 32 samples it works in two phases that meet in shared
// memory: first lane = sample, splat after splat, which recovers the transmittance and needs what lies behind as one number
// a sample; this leaves (w, d loss / d sigma) of 32 x 32. Then lane = splat, sample after sample, which sums all
// moments in the lane's own registers. So no value is ever reduced across lanes, and each splat ends in four 16-byte
// atomic additions an item.
#include "common.cuh"

namespace turbogs {
namespace {

constexpr int kExchangeStride = kWarpSize + 1;  // float2: rows and columns are both read without bank conflicts

// Samples of one group of 32.
struct SampleGroup {
    float4 position[kWarpSize];  // x, y, gradients of red and green
    float4 rest[kWarpSize];      // gradient of blue, error, gradient of the depth sum, last pair (bits)
    float2 state[kWarpSize];     // transmittance behind the splats walked so far; sum of w * (gradient . feature) behind
};

struct BackwardShared {
    float2 exchange[kWarpSize * kExchangeStride];  // [splat][sample]: w, d loss / d sigma
    float4 splats[3][kWarpSize];                   // x, y, a/2, b | c/2, opacity, depth, pair (bits) | red, green, blue
    int pending[2 * kWarpSize];                    // pairs to walk, back to front
};

__device__ __forceinline__ void add_quad(float* target, float x, float y, float z, float w) {
#if __CUDA_ARCH__ >= 900
    // A reduction, not atomicAdd(float4*): that one asks for the old value back.
    asm volatile("red.relaxed.gpu.global.add.v4.f32 [%0], {%1, %2, %3, %4};"
                 ::"l"(__cvta_generic_to_global(target)), "f"(x), "f"(y), "f"(z), "f"(w)
                 : "memory");
#else
    atomicAdd(target, x);
    atomicAdd(target + 1, y);
    atomicAdd(target + 2, z);
    atomicAdd(target + 3, w);
#endif
}

// What a lane sums for its splat over the samples of the item.
struct SplatSums {
    float sigma = 0.0f;                       // d loss / d sigma
    float mean_x = 0.0f, mean_y = 0.0f;       // d loss / d mean
    float absolute_x = 0.0f, absolute_y = 0.0f;
    float xx = 0.0f, xy = 0.0f, yy = 0.0f;    // second moments of d loss / d sigma
    float red = 0.0f, green = 0.0f, blue = 0.0f;
    float error = 0.0f, distance = 0.0f, weight = 0.0f;
    float depth = 0.0f;
};

// Reads the samples of a group: their upstream gradients and where the forward pass ended.
template <bool kDepth>
__device__ __forceinline__ void load_samples(const BackwardParams& params, int slot, int slot_end, int width,
                                             SampleGroup& group, int lane) {
    const ForwardParams& forward = params.forward;
    const int pixel = slot < slot_end ? forward.pixel_ids[slot] : -1;
    float4 position = make_float4(0.0f, 0.0f, 0.0f, 0.0f), rest = make_float4(0.0f, 0.0f, 0.0f, __int_as_float(-1));
    float2 state = make_float2(1.0f, 0.0f);
    if (pixel >= 0) {
        const int pixel_y = pixel / width;
        position.x = static_cast<float>(pixel - pixel_y * width) + 0.5f;
        position.y = static_cast<float>(pixel_y) + 0.5f;
        position.z = params.color_gradients[3 * static_cast<size_t>(slot)];
        position.w = params.color_gradients[3 * static_cast<size_t>(slot) + 1];
        rest.x = params.color_gradients[3 * static_cast<size_t>(slot) + 2];
        if (params.pixel_errors != nullptr) rest.y = params.pixel_errors[slot];
        rest.w = __int_as_float(forward.last_pairs[slot]);
        state.x = forward.transmittances[slot];
        float alpha_gradient = params.alpha_gradients != nullptr ? params.alpha_gradients[slot] : 0.0f;
        if (kDepth) {
            // depth = sum / max(alpha, tiny)
            const float alpha = forward.alphas[slot];
            rest.z = params.depth_gradients[slot] / fmaxf(alpha, kAlphaTiny);
            if (alpha > kAlphaTiny) alpha_gradient -= rest.z * forward.depths[slot];
        }
        // alpha = 1 - transmittance: a background of value -1 per unit of its gradient.
        state.y = -state.x * alpha_gradient;
    }
    group.position[lane] = position;
    group.rest[lane] = rest;
    group.state[lane] = state;
}

// Phase 1, lane = sample: (w, d loss / d sigma) of each staged splat. True where any of them contributed.
template <bool kDepth>
__device__ __forceinline__ bool exchange_splats(const ForwardParams& forward, BackwardShared& shared, SampleGroup& group,
                                                int count, int lane) {
    const float4 position = group.position[lane], rest = group.rest[lane];
    const int last = __float_as_int(rest.w);
    float2 state = group.state[lane];
    bool any = false;
#pragma unroll 2
    for (int t = 0; t < count; ++t) {
        const float4 shape = shared.splats[0][t], more = shared.splats[1][t];
        const float sigma = splat_sigma(shape.z, shape.w, more.x, shape.x - position.x, shape.y - position.y);
        const float raw = splat_alpha(more.y, sigma);
        const float alpha = fminf(forward.alpha_max, raw);
        float2 out = make_float2(0.0f, 0.0f);
        if (sigma >= 0.0f && alpha >= forward.alpha_min && __float_as_int(more.w) <= last) {
            const float4 color = shared.splats[2][t];
            const float inverse = blend_reciprocal(1.0f - alpha);
            state.x *= inverse;
            out.x = alpha * state.x;
            float feature = color.x * position.z + color.y * position.w + color.z * rest.x;
            if (kDepth) feature += more.z * rest.z;
            const float alpha_gradient = state.x * feature - state.y * inverse;
            state.y += out.x * feature;
            if (raw <= forward.alpha_max) out.y = -raw * alpha_gradient;
            any = true;
        }
        shared.exchange[t * kExchangeStride + lane] = out;
    }
    group.state[lane] = state;
    return any;
}

// Phase 2, lane = splat: adds the samples of a group to the lane's sums.
template <bool kDepth, bool kDistance>
__device__ __forceinline__ void sum_samples(const BackwardShared& shared, const SampleGroup& group, int count, int lane,
                                            const float4& first, const float4& second, SplatSums& sums) {
    const float a = first.z, b = first.w, c = second.x;
#pragma unroll 4
    for (int s = 0; s < count; ++s) {
        const float2 pair = shared.exchange[lane * kExchangeStride + s];
        const float4 position = group.position[s], rest = group.rest[s];
        const float weight = pair.x, slope = pair.y;
        const float dx = first.x - position.x, dy = first.y - position.y;
        const float u = a * dx + b * dy, v = b * dx + c * dy;
        const float slope_x = slope * dx, slope_y = slope * dy;
        sums.sigma += slope;
        sums.mean_x += slope * u;
        sums.mean_y += slope * v;
        sums.absolute_x += fabsf(slope) * fabsf(u);
        sums.absolute_y += fabsf(slope) * fabsf(v);
        sums.xx += slope_x * dx;
        sums.xy += slope_x * dy;
        sums.yy += slope_y * dy;
        sums.red += weight * position.z;
        sums.green += weight * position.w;
        sums.blue += weight * rest.x;
        sums.error += weight * rest.y;
        sums.weight += weight;
        if (kDepth) sums.depth += weight * rest.z;
        if (kDistance) sums.distance += weight * blend_sqrt(fmaxf(0.0f, dx * u + dy * v));
    }
}

template <bool kDepth, bool kDistance>
__global__ void __launch_bounds__(kWarpSize) backward_kernel(const __grid_constant__ BackwardParams params) {
    extern __shared__ float4 shared_memory[];
    BackwardShared& shared = *reinterpret_cast<BackwardShared*>(shared_memory);
    SampleGroup* groups = reinterpret_cast<SampleGroup*>(&shared + 1);
    const ForwardParams& forward = params.forward;
    const int lane = threadIdx.x;
    const int item = blockIdx.x;
    const int num_buckets = forward.bucket_counts[item];
    if (num_buckets == 0) return;

    const int tile = item / forward.chunks, chunk = item - tile * forward.chunks;
    const int tile_id = forward.tile_ids != nullptr ? forward.tile_ids[tile] : tile;
    const int width = forward.cameras[view_of_tile(forward.cameras, forward.num_views, tile_id)].width;
    const uint32_t first_pair = forward.tile_starts[tile];
    const uint32_t* masks = forward.masks + static_cast<size_t>(first_pair / kBucket + tile) * forward.chunks + chunk;
    const int slot_end = forward.tile_offsets[tile + 1];
    const int chunk_slots = forward.samples_per_lane * kWarpSize;

    for (int slot_base = forward.tile_offsets[tile] + chunk * chunk_slots; slot_base < slot_end;
         slot_base += forward.chunks * chunk_slots) {
        const int num_slots = min(chunk_slots, slot_end - slot_base);
        const int num_groups = (num_slots + kWarpSize - 1) / kWarpSize;
        __syncwarp();
        for (int g = 0; g < num_groups; ++g) {
            load_samples<kDepth>(params, slot_base + g * kWarpSize + lane, slot_end, width, groups[g], lane);
        }

        int filled = 0;
        uint32_t words = 0;  // lane i: the mask of the i-th bucket from the one where the words were last read
        for (int step = 0; step <= num_buckets; ++step) {
            // Collect the contributing splats of one more bucket, back to front; the last step flushes.
            if (step % kWarpSize == 0) {
                const int bucket = num_buckets - 1 - step - lane;
                words = bucket >= 0 ? masks[static_cast<size_t>(bucket) * forward.chunks] : 0u;
            }
            const uint32_t mask = __shfl_sync(kFullWarp, words, step % kWarpSize);
            if (mask >> lane & 1u) {
                shared.pending[filled + __popc(mask >> lane) - 1] = (num_buckets - 1 - step) * kBucket + lane;
            }
            filled += __popc(mask);
            const int count = min(filled, kWarpSize);
            if (count < (step < num_buckets ? kWarpSize : 1)) continue;
            __syncwarp();

            // Stage them; each lane also keeps its own.
            uint32_t instance = 0;
            int pair = 0;
            float4 first = make_float4(0.0f, 0.0f, 0.0f, 0.0f), second = first, third = first;
            if (lane < count) {
                pair = shared.pending[lane];
                instance = forward.pair_ids[first_pair + static_cast<uint32_t>(pair)];
                const float4* splat = reinterpret_cast<const float4*>(forward.instances + instance);
                first = __ldg(splat);
                second = __ldg(splat + 1);
                third = __ldg(splat + 2);
            }
            const int left = filled - count;
            const int moved = lane < left ? shared.pending[kWarpSize + lane] : 0;
            shared.splats[0][lane] = make_float4(first.x, first.y, 0.5f * first.z, first.w);
            shared.splats[1][lane] = make_float4(0.5f * second.x, second.y, second.z, __int_as_float(pair));
            shared.splats[2][lane] = third;
            __syncwarp();
            if (lane < left) shared.pending[lane] = moved;
            filled = left;

            const int front = __shfl_sync(kFullWarp, pair, count - 1);  // the pair nearest to the camera
            SplatSums sums;
            for (int g = 0; g < num_groups; ++g) {
                const int last = __float_as_int(groups[g].rest[lane].w);
                if (!__any_sync(kFullWarp, last >= front)) continue;
                const bool any = exchange_splats<kDepth>(forward, shared, groups[g], count, lane);
                if (__any_sync(kFullWarp, any)) {
                    __syncwarp();
                    sum_samples<kDepth, kDistance>(shared, groups[g], min(kWarpSize, num_slots - g * kWarpSize), lane, first,
                                                   second, sums);
                }
                __syncwarp();
            }

            if (lane < count && sums.weight > 0.0f) {
                float* record = params.screen_gradients + static_cast<size_t>(instance) * kGradientFloats;
                add_quad(record, sums.mean_x, sums.mean_y, 0.5f * sums.xx, sums.xy);
                add_quad(record + 4, 0.5f * sums.yy, sums.red, sums.green, sums.blue);
                add_quad(record + 8, -sums.sigma / second.y, sums.absolute_x, sums.absolute_y, sums.error);
                add_quad(record + 12, sums.distance, sums.weight, sums.depth, 0.0f);
            }
        }
    }
}

template <bool kDepth, bool kDistance>
cudaError_t launch(const BackwardParams& params, cudaStream_t stream) {
    const size_t bytes = sizeof(BackwardShared) + params.forward.samples_per_lane * sizeof(SampleGroup);
    backward_kernel<kDepth, kDistance>
        <<<params.forward.num_active * params.forward.chunks, kWarpSize, bytes, stream>>>(params);
    return cudaGetLastError();
}

}  // namespace

cudaError_t launch_rasterize_backward(const BackwardParams& params, cudaStream_t stream) {
    if (params.num_instances == 0) return cudaSuccess;
    const size_t bytes = sizeof(float) * kGradientFloats * static_cast<size_t>(params.num_instances);
    if (const cudaError_t error = cudaMemsetAsync(params.screen_gradients, 0, bytes, stream)) return error;
    if (params.forward.num_active * params.forward.chunks == 0) return cudaSuccess;
    const bool depth = params.depth_gradients != nullptr;
    if (params.with_distances) return depth ? launch<true, true>(params, stream) : launch<false, true>(params, stream);
    return depth ? launch<true, false>(params, stream) : launch<false, false>(params, stream);
}

}  // namespace turbogs
