// Stage 1: projection and colour of every Gaussian in the K views of a batch, and how many splats reach each active
// tile. Defined by turbogs_plugin/engine/reference/projection.py.
//
// A block holds 64 Gaussians, each in up to four threads that share out the views, so parameters are read from memory
// once. Rows of `shN` are not 16-byte aligned, but a block's rows together are: the block copies them to shared
// memory with 16-byte loads. Most Gaussians are off screen in most views. Those that are on screen go through a
// queue, from which all threads together take them to find their colours and tiles, and to clear their records where
// a backward pass will add to them: what is off screen has no record. Active tiles of a row of tiles have consecutive
// positions, found by their prefix counts, so a splat is counted by two additions a row, whatever its length.
#include "common/philox.h"
#include "common/spherical_harmonics.cuh"
#include "common/splat_geometry.cuh"
#include "common/warp.cuh"
#include "raster/tile_reach.cuh"

namespace turbogs {
namespace {

constexpr int kPrepareThreads = 256;      // no record of other values; the launch is small
constexpr int kProjectionGaussians = 64;  // of a block; their harmonics of 180 bytes each lie in shared memory
constexpr int kProjectionSlices = 4;      // most threads of a Gaussian: a small model alone does not fill the GPU
// Threads that do fill it. Measured on an H200: from about 500,000 Gaussians on one thread each is best.
constexpr int kEnoughThreads = 500'000;
constexpr int kProjectionBlocks = 4;   // of an SM: up to 64 registers, so that nothing spills
constexpr float kExtentMax = 3.33f;    // gsplat's cut of a splat's half width, standard deviations
constexpr float kSpanMax = 1e7f;       // pixels of the longest axis, seen face on, beyond which a splat is not drawn
constexpr float kDistanceMax = 1e18f;  // of a coordinate, beyond which squared distances would overflow

// Packs the cameras, counts active_prefix[t] = active tiles with an id below t, and clears the tiles' counts.
__global__ void prepare_kernel(const __grid_constant__ ProjectionParams params) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < params.num_views) {
        RasterCamera camera;
        const size_t row = params.camera_rows[i];
        static_cast<Pinhole&>(camera) = load_pinhole(params.viewmats + 16 * row, params.intrinsics + 9 * row);
        camera.tile_base = 0;
        camera.origin_x = params.origin_x;
        camera.origin_y = params.origin_y;
        for (int view = 0; view <= i; ++view) {
            camera.width = params.widths[view];
            camera.height = params.heights[view];
            camera.tiles_x = tiles_along(camera.origin_x + camera.width);
            camera.tiles_y = tiles_along(camera.origin_y + camera.height);
            if (view < i) camera.tile_base += camera.tiles_x * camera.tiles_y;
        }
        camera.slopes = slope_bounds(camera, camera.width, camera.height);
        params.cameras[i] = camera;
    }
    if (i <= params.num_active) params.tile_differences[i] = 0;
    if (i > params.num_tiles || params.active_prefix == nullptr) return;
    params.active_prefix[i] = partition_point(0, params.num_active, [&](int t) { return params.tile_ids[t] < i; });
}

// Colour in a unit direction, without offset and clamp. `coefficients`: [bands, 3].
__device__ __forceinline__ float3 evaluate_harmonics(int degree, const float sh0[3], const float* coefficients, float x,
                                                     float y, float z) {
    float3 color = make_float3(kShBand0 * sh0[0], kShBand0 * sh0[1], kShBand0 * sh0[2]);
    visit_harmonics(degree, x, y, z, [&](int harmonic, float value) {
        color.x += value * coefficients[3 * harmonic];
        color.y += value * coefficients[3 * harmonic + 1];
        color.z += value * coefficients[3 * harmonic + 2];
    });
    return color;
}

// The geometry of one Gaussian in one view. False where the splat is off screen; comparisons are written so that NaN
// is.
__device__ __forceinline__ bool project(const ProjectionParams& params, const RasterCamera& camera, const float mean[3],
                                        const float axes[9], float span, float extent, Instance& splat, int2& radius) {
    float point[3];
    camera_point(camera, mean, point);
    if (!(point[2] >= params.near_plane && point[2] <= params.far_plane)) return false;
    if (!(span * fmaxf(camera.fx, camera.fy) <= kSpanMax * point[2])) return false;

    const Perspective view = perspective_at(camera, camera.slopes, point);
    const ScreenCovariance shape = screen_covariance(camera, view, axes, params.eps2d);
    if (!(shape.determinant > 0.0f)) return false;
    const float inverse_determinant = 1.0f / shape.determinant;

    splat.x = camera.fx * view.slope_x + camera.cx;
    splat.y = camera.fy * view.slope_y + camera.cy;
    splat.conic_a = shape.variance_y * inverse_determinant;
    splat.conic_b = -shape.covariance * inverse_determinant;
    splat.conic_c = shape.variance_x * inverse_determinant;
    splat.depth = point[2];
    splat.inverse_sigma_y = rsqrtf(shape.variance_y);

    const float radius_x = ceilf(extent * sqrtf(shape.variance_x));
    const float radius_y = ceilf(extent * sqrtf(shape.variance_y));
    if (!(radius_x > 0.0f || radius_y > 0.0f)) return false;
    if (!(splat.x + radius_x > 0.0f && splat.x - radius_x < camera.width)) return false;
    if (!(splat.y + radius_y > 0.0f && splat.y - radius_y < camera.height)) return false;
    radius = make_int2(static_cast<int>(radius_x), static_cast<int>(radius_y));
    return true;
}

// A splat on its way from the geometry to its colour and tiles.
struct alignas(16) Queued {
    float x, y, conic_a, conic_b;
    float conic_c, log_reach, inverse_sigma_y;
    int source;  // view * kProjectionGaussians + Gaussian of the block
};

__device__ __forceinline__ void count_tiles(const RasterCamera& camera, const int32_t* active_prefix,
                                            const Queued& splat, int32_t* tile_differences) {
    const Reach reach = make_reach(splat.x, splat.y, splat.conic_a, splat.conic_b, splat.conic_c, splat.log_reach);
    const int2 rows = tile_rows(reach, camera);
    for (int row = rows.x; row < rows.y; ++row) {
        const int2 tiles = active_tiles(camera, active_prefix, row, tile_columns(reach, row, camera));
        if (tiles.x == tiles.y) continue;
        atomicAdd(tile_differences + tiles.x, 1);
        atomicAdd(tile_differences + tiles.y, -1);
    }
}

// Whether four numbers are finite: 0 times any other is not 0.
__device__ __forceinline__ bool all_finite(const float4& v) {
    return fmaf(0.0f, v.x, fmaf(0.0f, v.y, fmaf(0.0f, v.z, 0.0f * v.w))) == 0.0f;
}

// A block's shared memory. Dynamic: the queue, the cameras, the harmonics.
struct ProjectionShared {
    float means[kProjectionGaussians][3];
    float sh0[kProjectionGaussians][3];
    bool broken[kProjectionGaussians];  // has harmonics that are not finite
    int num_queued;                     // so far
};

__device__ __forceinline__ bool left_out(const ProjectionParams& params, int gaussian) {
    if (params.dropout_threshold == 0) return false;
    return random_words(params.dropout_keys, gaussian, 0, kPurposeDropout).x < params.dropout_threshold;
}

__device__ __forceinline__ size_t instance_of(const ProjectionParams& params, int first, int source) {
    return static_cast<size_t>(source / kProjectionGaussians) * params.num_gaussians + first +
           source % kProjectionGaussians;
}

// Clears the records of queued splats, four threads each, so that they write whole sectors.
__device__ __forceinline__ void clear_records(const ProjectionParams& params, int first, const Queued* queue, int count,
                                              int thread, int threads) {
    for (int i = thread; i < kRecordQuads * count; i += threads) {
        params.records[instance_of(params, first, queue[i / kRecordQuads].source) * kRecordQuads + i % kRecordQuads] =
            make_float4(0.0f, 0.0f, 0.0f, 0.0f);
    }
}

// Colour and tiles of a queued splat.
__device__ __forceinline__ void finish_splat(const ProjectionParams& params, const ProjectionShared& shared,
                                             const RasterCamera* cameras, const float* coefficients, int first,
                                             const Queued& splat) {
    const int local = splat.source % kProjectionGaussians, view = splat.source / kProjectionGaussians;
    const RasterCamera& camera = cameras[view];
    const float* mean = shared.means[local];
    float direction[3];
    view_direction(camera, mean, direction);
    const float3 color =
        evaluate_harmonics(params.sh_degree, shared.sh0[local], coefficients + local * 3 * params.bands, direction[0],
                           direction[1], direction[2]);
    Instance* instance = params.instances + instance_of(params, first, splat.source);
    reinterpret_cast<float4*>(instance)[2] = make_float4(fmaxf(color.x + 0.5f, 0.0f), fmaxf(color.y + 0.5f, 0.0f),
                                                         fmaxf(color.z + 0.5f, 0.0f), splat.inverse_sigma_y);
    count_tiles(camera, params.active_prefix, splat, params.tile_differences);
}

__global__ void __launch_bounds__(kProjectionGaussians* kProjectionSlices, kProjectionBlocks)
    projection_kernel(const __grid_constant__ ProjectionParams params) {
    extern __shared__ float4 shared_quads[];
    __shared__ ProjectionShared shared;
    const int thread = threadIdx.y * kProjectionGaussians + threadIdx.x;
    const int threads = blockDim.y * kProjectionGaussians;
    Queued* queue = reinterpret_cast<Queued*>(shared_quads);
    RasterCamera* cameras = reinterpret_cast<RasterCamera*>(queue + 2 * threads);
    float* coefficients = reinterpret_cast<float*>(cameras + params.num_views);
    const int row = 3 * params.bands;

    if (thread < kProjectionGaussians) shared.broken[thread] = false;
    if (thread == 0) shared.num_queued = 0;
    __syncthreads();
    {
        const int words = params.num_views * static_cast<int>(sizeof(RasterCamera) / sizeof(float4));
        const float4* in = reinterpret_cast<const float4*>(params.cameras);
        for (int i = thread; i < words; i += threads) reinterpret_cast<float4*>(cameras)[i] = in[i];
    }
    const int first = blockIdx.x * kProjectionGaussians;
    const int block_gaussians = min(kProjectionGaussians, params.num_gaussians - first);
    for (int i = thread; i < 3 * block_gaussians; i += threads) {
        (&shared.means[0][0])[i] = params.means[3 * static_cast<size_t>(first) + i];
        (&shared.sh0[0][0])[i] = params.sh0[3 * static_cast<size_t>(first) + i];
    }
    {
        const int count = block_gaussians * row;
        const float* in = params.shN + static_cast<size_t>(first) * row;  // 16-byte aligned: 64 rows
        for (int i = 4 * thread; i < count; i += 4 * threads) {
            float4 quad = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
            const int length = min(4, count - i);
            if (length == 4) {
                quad = *reinterpret_cast<const float4*>(in + i);
                *reinterpret_cast<float4*>(coefficients + i) = quad;
            } else {
                float* values = &quad.x;
                for (int j = 0; j < length; ++j) coefficients[i + j] = values[j] = in[i + j];
            }
            if (all_finite(quad)) continue;
            for (int j = i; j < i + length; ++j) {
                if (!isfinite(coefficients[j])) shared.broken[j / row] = true;
            }
        }
    }
    __syncthreads();

    const int local = threadIdx.x, gaussian = first + local;
    bool usable = local < block_gaussians && !shared.broken[local] && !left_out(params, gaussian);
    float mean[3], axes[9], span = 0.0f, extent = 0.0f;
    Instance splat = {};
    if (usable) {
        float scale[3];
#pragma unroll
        for (int i = 0; i < 3; ++i) {
            const float log_scale = params.scales[3 * static_cast<size_t>(gaussian) + i];
            mean[i] = shared.means[local][i];
            usable = usable && fabsf(mean[i]) <= kDistanceMax && isfinite(log_scale) && isfinite(shared.sh0[local][i]);
            scale[i] = expf(log_scale);
        }
        const float4 raw = params.quats[gaussian];
        usable = usable && all_finite(raw);
        const float quat[4] = {raw.x, raw.y, raw.z, raw.w};
        float unit[4];
        unit_quaternion(quat, unit);
        scaled_rotation(unit, scale, axes);
        span = fmaxf(scale[0], fmaxf(scale[1], scale[2]));
        splat.opacity = 1.0f / (1.0f + expf(-params.opacities[gaussian]));
        usable = usable && splat.opacity >= params.alpha_min;  // false for NaN
        splat.log_reach = logf(fmaxf(splat.opacity, params.alpha_min) / params.alpha_min);
        extent = fminf(kExtentMax, sqrtf(2.0f * splat.log_reach));
    }

    int finished = 0;  // splats that have left the queue
    for (int base = 0; base < params.num_views; base += blockDim.y) {
        const int view = base + threadIdx.y;
        int2 radius = make_int2(0, 0);
        const bool seen = usable && view < params.num_views &&
                          project(params, cameras[view], mean, axes, span, extent, splat, radius);
        const size_t instance = static_cast<size_t>(view) * params.num_gaussians + gaussian;
        if (local < block_gaussians && view < params.num_views) params.radii[instance] = radius;
        const uint32_t lanes = __ballot_sync(kFullWarp, seen);
        const int lane = thread % kWarpSize;
        int place = 0;
        if (lane == 0 && lanes != 0u) place = atomicAdd(&shared.num_queued, __popc(lanes)) - finished;
        place = __shfl_sync(kFullWarp, place, 0) + __popc(lanes & lanes_below(lane));
        if (seen) {
            float4* out = reinterpret_cast<float4*>(params.instances + instance);
            out[0] = make_float4(splat.x, splat.y, splat.conic_a, splat.conic_b);
            out[1] = make_float4(splat.conic_c, splat.opacity, splat.depth, splat.log_reach);
            queue[place] = {splat.x,       splat.y,         splat.conic_a,         splat.conic_b,
                            splat.conic_c, splat.log_reach, splat.inverse_sigma_y, view * kProjectionGaussians + local};
        }
        __syncthreads();
        // As many as there are threads leave the queue's end; in the last round, all.
        const int queued = shared.num_queued - finished;
        const bool last = base + static_cast<int>(blockDim.y) >= params.num_views;
        const int left = last ? 0 : queued < threads ? queued : queued - threads;
        if (params.records != nullptr) clear_records(params, first, queue + left, queued - left, thread, threads);
        for (int i = left + thread; i < queued; i += threads) {
            finish_splat(params, shared, cameras, coefficients, first, queue[i]);
        }
        finished += queued - left;
        __syncthreads();
    }
}

}  // namespace

void launch_projection(const ProjectionParams& params, cudaStream_t stream) {
    const int entries = params.num_tiles + 1 > kMaxViews ? params.num_tiles + 1 : kMaxViews;
    prepare_kernel<<<blocks_for(entries, kPrepareThreads), kPrepareThreads, 0, stream>>>(params);
    if (params.num_gaussians == 0) return;
    const int blocks = blocks_for(params.num_gaussians, kProjectionGaussians);
    int slices = 1;
    while (slices < kProjectionSlices && slices < params.num_views && params.num_gaussians < kEnoughThreads / slices) {
        ++slices;
    }
    const size_t shared = 2 * slices * kProjectionGaussians * sizeof(Queued) + params.num_views * sizeof(RasterCamera) +
                          kProjectionGaussians * 3 * params.bands * sizeof(float);
    projection_kernel<<<blocks, dim3(kProjectionGaussians, slices), shared, stream>>>(params);
}

}  // namespace turbogs
