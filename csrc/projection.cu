// Stage 1: projection, colour and tile counts of every Gaussian in the K views of a batch.
//
// A block holds 64 Gaussians, each in up to four threads that share out the views, so parameters are read from memory
// once. Rows of `shN` are not 16-byte aligned, but a block's rows together are: the block copies them to shared memory
// with 16-byte loads. Active tiles are found by
// their prefix counts, so counting a row of tiles costs two loads whatever its length.
#include "common.cuh"
#include "quaternion.cuh"
#include "spherical_harmonics.cuh"

namespace turbogs {
namespace {

constexpr int kProjectionGaussians = 64;  // of a block
constexpr int kProjectionSlices = 4;      // most threads of a Gaussian: a small model alone does not fill the GPU
constexpr int kProjectionEnough = 500'000;  // threads that do
constexpr float kExtentMax = 3.33f;        // gsplat's cut of a splat's half width, standard deviations
constexpr float kCovarianceMax = 1e18f;    // beyond, the determinant would overflow
constexpr int kRadiusMax = 1 << 24;

__global__ void pack_cameras_kernel(const __grid_constant__ ProjectionParams params) {
    const int view = threadIdx.x;
    if (view >= params.num_views) return;
    RasterCamera camera;
    static_cast<Pinhole&>(camera) = load_pinhole(params.viewmats + 16 * view, params.intrinsics + 9 * view);
    camera.tile_base = 0;
    for (int i = 0; i <= view; ++i) {
        camera.width = params.widths[i];
        camera.height = params.heights[i];
        camera.tiles_x = (camera.width + kTileSize - 1) / kTileSize;
        camera.tiles_y = (camera.height + kTileSize - 1) / kTileSize;
        if (i < view) camera.tile_base += camera.tiles_x * camera.tiles_y;
    }
    camera.slopes = slope_bounds(camera, camera.width, camera.height);
    params.cameras[view] = camera;
}

// active_prefix[t] = number of active tiles with an id below t.
__global__ void active_prefix_kernel(const __grid_constant__ ProjectionParams params) {
    const int tile_id = blockIdx.x * blockDim.x + threadIdx.x;
    if (tile_id > params.num_tiles) return;
    int low = 0, high = params.num_active;
    while (low < high) {
        const int middle = (low + high) / 2;
        if (params.tile_ids[middle] < tile_id) low = middle + 1;
        else high = middle;
    }
    params.active_prefix[tile_id] = low;
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

// The geometry of one Gaussian in one view. False where the splat is off screen; comparisons are written so that NaN is.
__device__ __forceinline__ bool project(const ProjectionParams& params, const RasterCamera& camera, const float mean[3],
                                        const float axes[9], float extent, Instance& splat, int2& radius) {
    const float* W = camera.rotation;
    float point[3];
    camera_point(camera, mean, point);
    if (!(point[2] >= params.near_plane && point[2] <= params.far_plane)) return false;

    const float inverse_depth = 1.0f / point[2];
    const float slope_x = point[0] * inverse_depth, slope_y = point[1] * inverse_depth;
    const float clamped_x = fminf(camera.slopes.high_x, fmaxf(camera.slopes.low_x, slope_x));
    const float clamped_y = fminf(camera.slopes.high_y, fmaxf(camera.slopes.low_y, slope_y));
    const float j00 = camera.fx * inverse_depth, j11 = camera.fy * inverse_depth;

    float u[3], v[3];  // Jacobian * rotation * axes, row by row
    {
        float t0[3], t1[3];
#pragma unroll
        for (int l = 0; l < 3; ++l) {
            t0[l] = j00 * (W[l] - clamped_x * W[6 + l]);
            t1[l] = j11 * (W[3 + l] - clamped_y * W[6 + l]);
        }
#pragma unroll
        for (int j = 0; j < 3; ++j) {
            u[j] = t0[0] * axes[j] + t0[1] * axes[3 + j] + t0[2] * axes[6 + j];
            v[j] = t1[0] * axes[j] + t1[1] * axes[3 + j] + t1[2] * axes[6 + j];
        }
    }
    float variance_x = u[0] * u[0] + u[1] * u[1] + u[2] * u[2];
    float variance_y = v[0] * v[0] + v[1] * v[1] + v[2] * v[2];
    const float covariance = u[0] * v[0] + u[1] * v[1] + u[2] * v[2];
    if (!(variance_x <= kCovarianceMax && variance_y <= kCovarianceMax)) return false;
    // Lagrange's identity: the determinant as a sum of squares does not cancel, however thin the splat.
    const float n0 = u[1] * v[2] - u[2] * v[1], n1 = u[2] * v[0] - u[0] * v[2], n2 = u[0] * v[1] - u[1] * v[0];
    const float det = n0 * n0 + n1 * n1 + n2 * n2 + params.eps2d * (variance_x + variance_y + params.eps2d);
    if (!(det > 0.0f)) return false;
    variance_x += params.eps2d;
    variance_y += params.eps2d;
    const float inverse_det = 1.0f / det;

    splat.x = camera.fx * slope_x + camera.cx;
    splat.y = camera.fy * slope_y + camera.cy;
    splat.conic_a = variance_y * inverse_det;
    splat.conic_b = -covariance * inverse_det;
    splat.conic_c = variance_x * inverse_det;
    splat.depth = point[2];
    splat.inverse_sigma_y = 1.0f / sqrtf(variance_y);

    const float radius_x = ceilf(extent * sqrtf(variance_x)), radius_y = ceilf(extent * sqrtf(variance_y));
    if (!(radius_x > 0.0f || radius_y > 0.0f)) return false;
    if (!(splat.x + radius_x > 0.0f && splat.x - radius_x < camera.width)) return false;
    if (!(splat.y + radius_y > 0.0f && splat.y - radius_y < camera.height)) return false;
    radius = make_int2(static_cast<int>(fminf(radius_x, kRadiusMax)), static_cast<int>(fminf(radius_y, kRadiusMax)));
    return true;
}

__device__ __forceinline__ uint32_t count_tiles(const RasterCamera& camera, const int32_t* active_prefix,
                                                const Instance& splat) {
    const Reach reach = make_reach(splat.x, splat.y, splat.conic_a, splat.conic_b, splat.conic_c, splat.log_reach);
    const int2 rows = tile_rows(reach, camera.tiles_y);
    uint32_t count = 0;
    for (int row = rows.x; row < rows.y; ++row) {
        const int2 tiles = active_tiles(camera, active_prefix, row, tile_columns(reach, row, camera.tiles_x));
        count += static_cast<uint32_t>(tiles.y - tiles.x);
    }
    return count;
}

__global__ void __launch_bounds__(kProjectionGaussians* kProjectionSlices, 4)
    projection_kernel(const __grid_constant__ ProjectionParams params) {
    extern __shared__ float4 shared_quads[];
    RasterCamera* cameras = reinterpret_cast<RasterCamera*>(shared_quads);
    float* coefficients = reinterpret_cast<float*>(cameras + params.num_views);
    const int row = 3 * params.bands;

    const int thread = threadIdx.y * kProjectionGaussians + threadIdx.x;
    const int threads = blockDim.y * kProjectionGaussians;
    {
        const int words = params.num_views * static_cast<int>(sizeof(RasterCamera) / sizeof(float4));
        const float4* in = reinterpret_cast<const float4*>(params.cameras);
        for (int i = thread; i < words; i += threads) shared_quads[i] = in[i];
    }
    const int first = blockIdx.x * kProjectionGaussians;
    if (params.sh_degree > 0) {
        const int count = min(kProjectionGaussians, params.num_gaussians - first) * row;
        const float* in = params.shN + static_cast<size_t>(first) * row;  // 16-byte aligned: 64 rows
        for (int i = 4 * thread; i < count; i += 4 * threads) {
            if (i + 3 < count) {
                *reinterpret_cast<float4*>(coefficients + i) = *reinterpret_cast<const float4*>(in + i);
            } else {
                for (int j = i; j < count; ++j) coefficients[j] = in[j];
            }
        }
    }
    __syncthreads();

    const int gaussian = first + threadIdx.x;
    if (gaussian >= params.num_gaussians) return;
    coefficients += threadIdx.x * row;

    float mean[3], axes[9], sh0[3];
    {
        float log_scale[3];
#pragma unroll
        for (int i = 0; i < 3; ++i) {
            mean[i] = params.means[3 * static_cast<size_t>(gaussian) + i];
            log_scale[i] = params.scales[3 * static_cast<size_t>(gaussian) + i];
            sh0[i] = params.sh0[3 * static_cast<size_t>(gaussian) + i];
        }
        const float4 raw = reinterpret_cast<const float4*>(params.quats)[gaussian];
        const float quat[4] = {raw.x, raw.y, raw.z, raw.w};
        const float scale[3] = {expf(log_scale[0]), expf(log_scale[1]), expf(log_scale[2])};
        float unit[4];
        unit_quaternion(quat, unit);
        scaled_rotation(unit, scale, axes);
    }
    Instance splat;
    splat.opacity = 1.0f / (1.0f + expf(-params.opacities[gaussian]));
    const bool opaque = splat.opacity >= params.alpha_min;  // false for NaN
    splat.log_reach = logf(fmaxf(splat.opacity, params.alpha_min) / params.alpha_min);
    const float extent = fminf(kExtentMax, sqrtf(2.0f * splat.log_reach));

    for (int view = threadIdx.y; view < params.num_views; view += blockDim.y) {
        const RasterCamera& camera = cameras[view];
        const size_t instance = static_cast<size_t>(view) * params.num_gaussians + gaussian;
        int2 radius = make_int2(0, 0);
        uint32_t key = kInvisible;
        if (opaque && project(params, camera, mean, axes, extent, splat, radius)) {
            float dx = mean[0] - camera.center[0], dy = mean[1] - camera.center[1], dz = mean[2] - camera.center[2];
            const float length2 = dx * dx + dy * dy + dz * dz;
            const float inverse_length = length2 > 0.0f ? 1.0f / sqrtf(length2) : 0.0f;
            const float3 color = evaluate_harmonics(params.sh_degree, sh0, coefficients, dx * inverse_length,
                                                    dy * inverse_length, dz * inverse_length);
            if (isfinite(color.x) && isfinite(color.y) && isfinite(color.z)) {
                splat.red = fmaxf(color.x + 0.5f, 0.0f);
                splat.green = fmaxf(color.y + 0.5f, 0.0f);
                splat.blue = fmaxf(color.z + 0.5f, 0.0f);
                float4* out = reinterpret_cast<float4*>(params.instances + instance);
                out[0] = make_float4(splat.x, splat.y, splat.conic_a, splat.conic_b);
                out[1] = make_float4(splat.conic_c, splat.opacity, splat.depth, splat.log_reach);
                out[2] = make_float4(splat.red, splat.green, splat.blue, splat.inverse_sigma_y);
                const uint32_t count = count_tiles(camera, params.active_prefix, splat);
                if (count > 0) {
                    params.tile_counts[instance] = count;
                    key = __float_as_uint(splat.depth);
                }
            } else {
                radius = make_int2(0, 0);
            }
        }
        params.radii[instance] = radius;
        params.depth_keys[instance] = key;
        params.instance_ids[instance] = static_cast<uint32_t>(instance);
    }
}

}  // namespace

cudaError_t launch_projection(const ProjectionParams& params, cudaStream_t stream) {
    pack_cameras_kernel<<<1, kRasterMaxViews, 0, stream>>>(params);
    if (const cudaError_t error = cudaGetLastError()) return error;
    if (params.active_prefix != nullptr) {
        active_prefix_kernel<<<params.num_tiles / 256 + 1, 256, 0, stream>>>(params);
        if (const cudaError_t error = cudaGetLastError()) return error;
    }
    if (params.num_gaussians == 0) return cudaSuccess;
    const size_t shared = params.num_views * sizeof(RasterCamera) +
                          (params.sh_degree > 0 ? kProjectionGaussians * 3 * params.bands * sizeof(float) : 0);
    const int blocks = (params.num_gaussians + kProjectionGaussians - 1) / kProjectionGaussians;
    int slices = 1;
    while (slices < kProjectionSlices && slices < params.num_views && params.num_gaussians < kProjectionEnough / slices) {
        ++slices;
    }
    projection_kernel<<<blocks, dim3(kProjectionGaussians, slices), shared, stream>>>(params);
    return cudaGetLastError();
}

}  // namespace turbogs
