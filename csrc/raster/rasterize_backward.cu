// Stage 6: from the gradients at the samples to a record for every splat on the screen, with the density sums. Defined
// by turbogs_plugin/engine/reference/compositing.py.
//
// One warp takes one work item of the forward pass, 32 samples. It walks back to front the splats that contributed to
// it, and no others: the forward pass left their bits. It takes `kSplats` at a time, in two phases that exchange their
// results in shared memory. In the first phase a lane stands for a sample and goes from splat to splat. It recovers the
// transmittance, and needs one number for all that lies behind. It writes (w, d loss / d sigma) of each splat. In the
// second phase a lane stands for a splat and a share of the samples. It goes from sample to sample, up to the last that
// is filled, and keeps all sums in its registers. So lanes exchange next to nothing, and a splat costs four 16-byte
// atomic additions for each item.
#include <type_traits>

#include "raster/staged_splat.cuh"

namespace turbogs {
namespace {

constexpr int kSplats = 16;                         // walked at once; 32 need 13 KB a warp and were 5 to 8 % slower
constexpr int kShares = kWarpSize / kSplats;        // lanes that sum for one splat
constexpr int kTurn = 4;                            // samples of a turn of such a lane: one float4 of a row
constexpr int kExchangeStride = kWarpSize + 4;      // words: rows of float4 and columns are read without bank conflicts
constexpr int kAhead = 4;                           // splats whose arithmetic overlaps; 8 were no faster
constexpr int kBucketLanes = 4;                     // lanes that list the splats of one bucket
constexpr int kLaneBits = kBucket / kBucketLanes;   // bits of its mask that each of them takes
constexpr int kListBuckets = kWarpSize / kBucketLanes;  // buckets whose bits become a list at once
constexpr float kTwoLn2 = 1.3862943611198906f;          // d sigma = 2 ln(2) (u du + v dv)
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900 && __CUDA_ARCH__ < 1200
constexpr int kWarpsPerSm = 28;  // as many as shared memory holds: 72 registers at most
#else
constexpr int kWarpsPerSm = 1;  // no bound
#endif

template <bool kDepth, bool kErrors>
struct BackwardShared {
    // Two samples' float2 or four samples' float1 are one load of 16 bytes.
    using Others = std::conditional_t<kDepth, float4, std::conditional_t<kErrors, float2, float1>>;
    float4 weights[kSplats * kExchangeStride / 4];  // [splat][sample]
    float4 slopes[kSplats * kExchangeStride / 4];   // [splat][sample]: d loss / d sigma
    float4 positions[kWarpSize];                    // of the samples: x, y, gradients of red and green
    Others others[kWarpSize];                       // gradient of blue; if asked for error, gradient of the depth sum
    StagedSplat splats[kSplats];
    int pending[kListBuckets * kBucket + kSplats];  // intersections to walk, back to front
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

// One sample while its splats are walked back to front.
struct Sample {
    float x, y;                            // in the tile's frame
    float red, green, blue, depth;         // gradients; depth: of the sum
    float transmittance = 1.0f;            // behind the splats walked so far
    float behind = 0.0f;                   // sum of w * (gradient . feature) behind
    int last = -1;                         // intersection
    int filled = 0;                        // samples of the warp up to the last that is not empty; same in all lanes
};

// Reads a lane's sample: upstream gradients, and where the forward pass ended. Leaves in shared memory what phase 2
// needs.
template <bool kDepth, bool kErrors>
__device__ __forceinline__ Sample load_sample(const BackwardParams& params, int slot, int slot_end,
                                              const TileFrame& frame, BackwardShared<kDepth, kErrors>& shared,
                                              int lane) {
    const ForwardParams& forward = params.forward;
    const int pixel = slot < slot_end ? forward.pixel_ids[slot] : -1;
    Sample sample = {};
    float error = 0.0f;
    if (pixel >= 0) {
        const float2 at = pixel_in_tile(frame, pixel);
        sample.x = at.x;
        sample.y = at.y;
        const float* color = params.color_gradients + 3 * static_cast<size_t>(slot);
        sample.red = color[0];
        sample.green = color[1];
        sample.blue = color[2];
        if (kErrors) error = params.pixel_errors[slot];
        sample.last = forward.last_intersections[slot];
        sample.transmittance = forward.transmittances[slot];
        float alpha_gradient = params.alpha_gradients != nullptr ? params.alpha_gradients[slot] : 0.0f;
        if (kDepth) {
            // depth = sum / max(alpha, tiny)
            const float alpha = forward.alphas[slot];
            sample.depth = params.depth_gradients[slot] / fmaxf(alpha, kAlphaTiny);
            if (alpha > kAlphaTiny) alpha_gradient -= sample.depth * forward.depths[slot];
        }
        // Behind all splats lies the background; alpha = 1 - transmittance is one of value -1 per unit of its gradient.
        const float background = forward.background[0] * sample.red + forward.background[1] * sample.green +
                                 forward.background[2] * sample.blue;
        sample.behind = sample.transmittance * (background - alpha_gradient);
    }
    sample.filled = kWarpSize - __clz(static_cast<int>(__ballot_sync(kFullWarp, pixel >= 0)));
    shared.positions[lane] = make_float4(sample.x, sample.y, sample.red, sample.green);
    if constexpr (kDepth) shared.others[lane] = make_float4(sample.blue, error, sample.depth, 0.0f);
    else if constexpr (kErrors) shared.others[lane] = make_float2(sample.blue, error);
    else shared.others[lane] = make_float1(sample.blue);
    return sample;
}

// Appends to the list the contributing splats of the buckets below `end`, at most kListBuckets of them, back to front.
// Returns the new length.
__device__ __forceinline__ int list_intersections(const uint32_t* masks, int chunks, int end, int length, int* pending,
                                                  int lane) {
    const int bucket = end - 1 - lane / kBucketLanes, part = kBucketLanes - 1 - lane % kBucketLanes;
    constexpr uint32_t kMask = (1u << kLaneBits) - 1u;
    uint32_t bits = bucket >= 0 ? masks[static_cast<size_t>(bucket) * chunks] >> (kLaneBits * part) & kMask : 0u;
    const int count = __popc(bits);
    const int sum = sum_to_lane(count, lane);
    int place = length + sum - count;
    while (bits != 0u) {
        const int bit = 31 - __clz(bits);
        pending[place++] = bucket * kBucket + kLaneBits * part + bit;
        bits ^= 1u << bit;
    }
    return length + __shfl_sync(kFullWarp, sum, kWarpSize - 1);
}

// Phase 1, lane = sample: (w, d loss / d sigma) of each staged splat. No branches, so that several splats overlap; the
// power is taken even where it is not needed, as the compiler may branch about it otherwise.
template <bool kDepth, bool kErrors>
__device__ __forceinline__ void exchange_splats(const ForwardParams& forward, float least_level,
                                                BackwardShared<kDepth, kErrors>& shared, Sample& sample, int count,
                                                int lane) {
    float* weights = reinterpret_cast<float*>(shared.weights) + lane;
    float* slopes = reinterpret_cast<float*>(shared.slopes) + lane;
    for (int base = 0; base < count; base += kAhead) {
#pragma unroll
        for (int i = 0; i < kAhead; ++i) {
            const float4 form = shared.splats[base + i].form, rest = shared.splats[base + i].rest;
            const float4 color = shared.splats[base + i].color;
            const float level = splat_level(form, rest, sample.x, sample.y);
            const bool seen = (level >= least_level) & (__float_as_int(rest.w) <= sample.last);
            const float power = approximate_exp2(level), raw = seen ? power : 0.0f;
            const float alpha = fminf(forward.alpha_max, raw);
            const float inverse = approximate_reciprocal(1.0f - alpha);
            sample.transmittance *= inverse;
            const float weight = alpha * sample.transmittance;
            float feature = color.x * sample.red + color.y * sample.green + color.z * sample.blue;
            if (kDepth) feature += rest.z * sample.depth;
            const float alpha_gradient = sample.transmittance * feature - sample.behind * inverse;
            sample.behind += weight * feature;
            weights[(base + i) * kExchangeStride] = weight;
            slopes[(base + i) * kExchangeStride] = raw <= forward.alpha_max ? -raw * alpha_gradient : 0.0f;
        }
    }
}

// What a lane sums for its splat over samples; g is d loss / d sigma.
struct SplatSums {
    float slope = 0.0f;                        // g
    float u = 0.0f, v = 0.0f;                  // g u, g v
    float uu = 0.0f, uv = 0.0f, vv = 0.0f;     // g u^2, ...
    float absolute_x = 0.0f, absolute_y = 0.0f;  // |g u|, |g (q u + r v)|
    float red = 0.0f, green = 0.0f, blue = 0.0f, depth = 0.0f;
    float error = 0.0f, distance = 0.0f, weight = 0.0f;
    float square = 0.0f;  // g^2
};

// Phase 2, lane = splat and share: adds the samples of the share to the lane's sums. The shares take turns, so that
// both are done with the last of the `filled` samples; all lanes leave after the same turn. What a turn reads behind
// the last sample adds zeros, as every empty sample does.
template <bool kDensity, bool kDepth, bool kErrors>
__device__ __forceinline__ void sum_samples(const BackwardShared<kDepth, kErrors>& shared, int filled, int row,
                                            int share, const StagedSplat& own, SplatSums& sums) {
    static_assert(kWarpSize % (kShares * kTurn) == 0, "shares of the same size");
    const float4* weights = shared.weights + (row * kExchangeStride + share * kTurn) / 4;
    const float4* slopes = shared.slopes + (row * kExchangeStride + share * kTurn) / 4;
    const float4* positions = shared.positions + share * kTurn;
    const auto* others = shared.others + share * kTurn;
    const auto add = [&](float weight, float slope, int s) {
        const auto other = others[s];
        const float4 position = positions[s];
        // Colours come first: 72 registers with nvcc 13.0, where they were 75 to 77 behind the rest.
        sums.red += weight * position.z;
        sums.green += weight * position.w;
        sums.blue += weight * other.x;
        if constexpr (kErrors) sums.error += weight * other.y;
        sums.weight += weight;
        const float2 f = splat_form(own.form, own.rest.x, position.x, position.y);
        const float slope_u = slope * f.x, slope_v = slope * f.y;
        sums.slope += slope;
        sums.u += slope_u;
        sums.v += slope_v;
        sums.uu += slope_u * f.x;
        sums.uv += slope_u * f.y;
        sums.vv += slope_v * f.y;
        if constexpr (kDepth) sums.depth += weight * other.z;
        if (kDensity && kErrors) sums.distance += weight * approximate_sqrt_flushed(f.x * f.x + f.y * f.y);
        if (kDensity) {
            sums.absolute_x += fabsf(slope_u);
            sums.absolute_y += fabsf(own.form.y * slope_u + own.form.z * slope_v);
            sums.square += slope * slope;
        }
    };
#pragma unroll
    for (int s = 0; s < kWarpSize; s += kShares * kTurn) {
        if (s >= filled) break;
        const float4 weight = weights[s / 4], slope = slopes[s / 4];
        add(weight.x, slope.x, s);
        add(weight.y, slope.y, s + 1);
        add(weight.z, slope.z, s + 2);
        add(weight.w, slope.w, s + 3);
    }
}

// From sums over u and v to the record's sums over x and y, and of the conic.
__device__ __forceinline__ void make_record(const StagedSplat& own, const SplatSums& sums,
                                            float record[ScreenRecord::kSize]) {
    const float p = own.form.x, q = own.form.y, r = own.form.z;
    const float inverse_p = 1.0f / p, inverse_r = 1.0f / r, skew = q * inverse_r;  // dy = v / r, dx = (u - skew v) / p
    using Place = ScreenRecord;
    record[Place::kMean] = kTwoLn2 * p * sums.u;
    record[Place::kMean + 1] = kTwoLn2 * (q * sums.u + r * sums.v);
    record[Place::kConic] = 0.5f * (sums.uu - 2.0f * skew * sums.uv + skew * skew * sums.vv) * inverse_p * inverse_p;
    record[Place::kConic + 1] = (sums.uv - skew * sums.vv) * inverse_p * inverse_r;
    record[Place::kConic + 2] = 0.5f * sums.vv * inverse_r * inverse_r;
    record[Place::kColor] = sums.red;
    record[Place::kColor + 1] = sums.green;
    record[Place::kColor + 2] = sums.blue;
    record[Place::kOpacity] = -sums.slope * exp2f(-own.rest.y);  // the level is log2 of the opacity
    record[Place::kAbsolute] = kTwoLn2 * p * sums.absolute_x;
    record[Place::kAbsolute + 1] = kTwoLn2 * sums.absolute_y;
    record[Place::kErrorSum] = sums.error;
    record[Place::kDistanceSum] = sqrtf(kTwoLn2) * sums.distance;
    record[Place::kWeightSum] = sums.weight;
    record[Place::kDepth] = sums.depth;
    record[Place::kSquareSum] = sums.square;
}

// Adds the records of the two lanes that share a splat, and sends them to memory: each lane takes over half of the
// record.
__device__ __forceinline__ void send_record(float* target, const float record[ScreenRecord::kSize], bool live,
                                            int share) {
    static_assert(kShares == 2, "two lanes share a splat");
    constexpr int kHalf = ScreenRecord::kSize / 2;
    float sum[kHalf];
#pragma unroll
    for (int i = 0; i < kHalf; ++i) {
        const float kept = share ? record[kHalf + i] : record[i], sent = share ? record[i] : record[kHalf + i];
        sum[i] = kept + __shfl_xor_sync(kFullWarp, sent, kSplats);
    }
    if (!live) return;
    target += share * kHalf;
    add_quad(target, sum[0], sum[1], sum[2], sum[3]);
    add_quad(target + 4, sum[4], sum[5], sum[6], sum[7]);
}

template <bool kDepth, bool kErrors, bool kDensity>
__global__ void __launch_bounds__(kWarpSize, kWarpsPerSm)
    backward_kernel(const __grid_constant__ BackwardParams params) {
    __shared__ BackwardShared<kDepth, kErrors> shared;
    const ForwardParams& forward = params.forward;
    const int lane = threadIdx.x, row = lane % kSplats, share = lane / kSplats;
    const int item = blockIdx.x;
    const int num_buckets = forward.bucket_counts[item];
    if (num_buckets == 0) return;

    const int tile = item / forward.chunks, chunk = item - tile * forward.chunks;
    const TileFrame frame = tile_frame(forward, tile);
    const uint32_t first_intersection = forward.tile_starts[tile];
    const uint32_t* masks = masks_of_item(forward, first_intersection, tile, chunk);
    const int slot_end = forward.tile_offsets[tile + 1];
    const float least_level = log2f(forward.alpha_min);

    for (int slot_base = forward.tile_offsets[tile] + chunk * kWarpSize; slot_base < slot_end;
         slot_base += forward.chunks * kWarpSize) {
        Sample sample = load_sample(params, slot_base + lane, slot_end, frame, shared, lane);
        int buckets_left = num_buckets, begin = 0, end = 0;  // of the list
        while (true) {
            if (end - begin < kSplats && buckets_left > 0) {
                const int left = end - begin;
                const int moved = lane < left ? shared.pending[begin + lane] : 0;
                __syncwarp();
                if (lane < left) shared.pending[lane] = moved;
                begin = 0;
                end = list_intersections(masks, forward.chunks, buckets_left, left, shared.pending, lane);
                buckets_left -= kListBuckets;
                __syncwarp();
                continue;
            }
            const int count = min(end - begin, kSplats);
            if (count == 0) break;

            // Stage them; each lane also keeps its own.
            uint32_t instance = 0;
            StagedSplat own = no_splat();
            if (row < count) {
                const int intersection = shared.pending[begin + row];
                instance = forward.intersection_ids[first_intersection + static_cast<uint32_t>(intersection)];
                own = load_splat(forward.instances, instance);
                stage_splat(own, frame.x, frame.y, least_level, intersection, 0u);
            }
            if (share == 0) shared.splats[row] = own;
            begin += count;
            __syncwarp();
            exchange_splats(forward, least_level, shared, sample, count, lane);
            __syncwarp();
            SplatSums sums;
            sum_samples<kDensity>(shared, sample.filled, row, share, own, sums);
            float record[ScreenRecord::kSize];
            make_record(own, sums, record);
            float* target = params.records + static_cast<size_t>(instance) * ScreenRecord::kSize;
            send_record(target, record, row < count, share);
        }
        __syncwarp();
    }
}

template <bool kDepth>
auto kernel_of(const BackwardParams& params) {
    const bool density = params.with_density_sums;
    return params.pixel_errors != nullptr
               ? (density ? backward_kernel<kDepth, true, true> : backward_kernel<kDepth, true, false>)
               : (density ? backward_kernel<kDepth, false, true> : backward_kernel<kDepth, false, false>);
}

}  // namespace

void launch_rasterize_backward(const BackwardParams& params, cudaStream_t stream) {
    const int items = params.forward.num_active * params.forward.chunks;
    if (items == 0) return;
    const auto kernel = params.depth_gradients != nullptr ? kernel_of<true>(params) : kernel_of<false>(params);
    kernel<<<items, kWarpSize, 0, stream>>>(params);
}

}  // namespace turbogs
