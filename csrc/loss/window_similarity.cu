// SSIM of the samples in Gaussian windows that end at the edge of the tile, with its gradient: a second pass of the
// loss, which adds to what sparse_loss.cu has written. Defined by turbogs_plugin/engine/reference/losses.py.
//
// A block has a tile, a thread a pixel of it. Slots are first put in their places, so that the sums under all
// windows are two passes of eleven products, along the rows and along the columns. Five moments of each channel go
// through them, and from these three terms of the gradient, which a window gives to its pixels as it took theirs: the
// Gaussian is symmetric. Means are relative to the tile's first sample. A place without a sample has weight 0. All of a
// tile stays in shared memory: a sample's colour and truth are read once, its gradient is read and written once.
#include "common/warp.cuh"
#include "loss/sample_loss.cuh"

namespace turbogs {
namespace {

constexpr int kWindowThreads = kTilePixels;
constexpr int kWindowWarps = kWindowThreads / kWarpSize;
constexpr int kPlaneMargin = kWindowRadius;  // along a row, a window may read so far beyond the plane
constexpr int kMoments = 5;                  // x, y, xx, yy, xy
constexpr int kTerms = 3;                    // of the gradient

// exp(-d^2 / (2 * 1.5^2)), d = 0 .. kWindowRadius; WINDOW_SIGMA of turbogs_plugin/engine/rules.py.
__device__ constexpr float kGaussian[kWindowRadius + 1] = {1.0f,         0.800737403f, 0.411112291f,
                                                           0.135335283f, 0.0285655008f, 0.00386592014f};

struct WindowMemory {
    int slots[kTilePixels];  // -1: none
    float inputs[3][kTilePixels + 2 * kPlaneMargin];  // weight, x and y, each between margins
    float rest[kTilePixels + 2 * kPlaneMargin];
    float sums[kMoments][kTilePixels];
    float shares[kWindowWarps];
    float first[6];  // the first sample's x and y
};

// Sums over the window's rows of what the passes along the rows have left in `planes`.
template <int kPlanes>
__device__ __forceinline__ void sum_columns(const float (&planes)[kMoments][kTilePixels], float (&sums)[kPlanes]) {
    const int row = threadIdx.x / kTileSize;
#pragma unroll
    for (int i = 0; i < kPlanes; ++i) sums[i] = 0.0f;
#pragma unroll
    for (int d = -kWindowRadius; d <= kWindowRadius; ++d) {
        if (row + d < 0 || row + d >= kTileSize) continue;
        const float weight = kGaussian[d < 0 ? -d : d];
#pragma unroll
        for (int i = 0; i < kPlanes; ++i) sums[i] += weight * planes[i][threadIdx.x + kTileSize * d];
    }
}

// Calls visit(weight, place in a plane with a margin) for each pixel of the window that is in this thread's row.
template <class Visit>
__device__ __forceinline__ void visit_row(const Visit& visit) {
    const int column = threadIdx.x % kTileSize;
#pragma unroll
    for (int d = -kWindowRadius; d <= kWindowRadius; ++d) {
        const bool inside = column + d >= 0 && column + d < kTileSize;
        visit(inside ? kGaussian[d < 0 ? -d : d] : 0.0f, kPlaneMargin + static_cast<int>(threadIdx.x) + d);
    }
}

template <bool kAlpha>
__global__ void __launch_bounds__(kWindowThreads)
    window_similarity_kernel(const __grid_constant__ SparseLossParams params) {
    __shared__ WindowMemory memory;
    const int place = threadIdx.x, tile = blockIdx.x;
    const int begin = params.tile_offsets[tile], end = params.tile_offsets[tile + 1];
    const SampleView& view = params.views[view_of_tile(params.views, params.num_views, params.tile_ids[tile])];

    // Each slot to its place.
    memory.slots[place] = -1;
    if (place < 6) memory.first[place] = 0.0f;
    if (place < 2 * kPlaneMargin) {
        const int margin = place < kPlaneMargin ? place : kTilePixels + place;
#pragma unroll
        for (int i = 0; i < 3; ++i) memory.inputs[i][margin] = 0.0f;
        memory.rest[margin] = 0.0f;
    }
    __syncthreads();
    for (int slot = begin + place; slot < end; slot += kWindowThreads) {
        const int pixel = params.pixel_ids[slot];
        if (pixel < 0) continue;
        const int y = pixel / view.width, x = pixel - y * view.width;
        const int row = (y + view.origin_y) % kTileSize, column = (x + view.origin_x) % kTileSize;
        memory.slots[row * kTileSize + column] = slot;
    }
    __syncthreads();
    const int slot = memory.slots[place];
    float x[3] = {}, y[3] = {}, weight = 0.0f;
    if (slot >= 0) {
#pragma unroll
        for (int c = 0; c < 3; ++c) x[c] = params.colors[3 * static_cast<size_t>(slot) + c];
        if (is_finite(x[0]) && is_finite(x[1]) && is_finite(x[2])) {
            weight = params.weights != nullptr ? params.weights[slot] : 1.0f;
            load_truth<kAlpha>(params, view, slot, params.pixel_ids[slot], y);
        } else {
            x[0] = x[1] = x[2] = 0.0f;
        }
        if (slot == begin) {
#pragma unroll
            for (int c = 0; c < 3; ++c) {
                memory.first[c] = x[c];
                memory.first[3 + c] = y[c];
            }
        }
    }
    float* const weights = memory.inputs[0];
    weights[kPlaneMargin + place] = weight;
    const float total = block_sum(weight, memory.shares);
    if (!(total > 0.0f)) return;  // the whole block: no sample

    float window[1];
    {
        float sum = 0.0f;
        visit_row([&](float of, int at) { sum += of * weights[at]; });
        memory.sums[0][place] = sum;
        __syncthreads();
        sum_columns(memory.sums, window);
    }
    const float inverse_window = weight > 0.0f ? 1.0f / window[0] : 0.0f;
    const float inverse_total = 1.0f / total;
    const float scale = params.structure_weight / (3.0f * static_cast<float>(params.num_tiles));
    float missing = 0.0f;  // of this sample, 1 - S over the channels
#pragma unroll
    for (int c = 0; c < 3; ++c) {
        const float first_x = memory.first[c], first_y = memory.first[3 + c];
        const float offset_x = x[c] - first_x, offset_y = y[c] - first_y;
        memory.inputs[1][kPlaneMargin + place] = offset_x;
        memory.inputs[2][kPlaneMargin + place] = offset_y;
        __syncthreads();  // and all have read the sums of what came before
        float moments[kMoments] = {};
        visit_row([&](float of, int at) {
            const float of_weight = of * weights[at], in_x = memory.inputs[1][at], in_y = memory.inputs[2][at];
            const float of_x = of_weight * in_x, of_y = of_weight * in_y;
            moments[0] += of_x;
            moments[1] += of_y;
            moments[2] += of_x * in_x;
            moments[3] += of_y * in_y;
            moments[4] += of_x * in_y;
        });
#pragma unroll
        for (int i = 0; i < kMoments; ++i) memory.sums[i][place] = moments[i];
        __syncthreads();
        sum_columns(memory.sums, moments);
#pragma unroll
        for (int i = 0; i < kMoments; ++i) moments[i] *= inverse_window;
        const float mean_x = moments[0], mean_y = moments[1];
        const float variance_x = fmaxf(moments[2] - mean_x * mean_x, 0.0f);
        const float variance_y = fmaxf(moments[3] - mean_y * mean_y, 0.0f);
        const float largest = sqrtf(variance_x) * sqrtf(variance_y);
        const float covariance = fminf(fmaxf(moments[4] - mean_x * mean_y, -largest), largest);
        // So that a window which seems to have no variance beside colours of thousands has no slope of rounding.
        const float steady = kSsimConstant + kRounding * (moments[2] + moments[3]);
        const Similarity similarity =
            ssim(mean_x + first_x, mean_y + first_y, variance_x, variance_y, covariance, steady);
        if (weight > 0.0f) missing += 1.0f - similarity.value;

        // What the window gives to its pixels.
        const float rest = similarity.constant - similarity.at_y * mean_y + similarity.at_x * mean_x;
        memory.inputs[1][kPlaneMargin + place] = similarity.at_y * inverse_window;  // read by none since the barrier
        memory.inputs[2][kPlaneMargin + place] = similarity.at_x * inverse_window;
        memory.rest[kPlaneMargin + place] = rest * inverse_window;
        __syncthreads();
        float terms[kTerms] = {};
        visit_row([&](float of, int at) {
            const float of_weight = of * weights[at];
            terms[0] += of_weight * memory.inputs[1][at];
            terms[1] += of_weight * memory.inputs[2][at];
            terms[2] += of_weight * memory.rest[at];
        });
#pragma unroll
        for (int i = 0; i < kTerms; ++i) memory.sums[i][place] = terms[i];
        __syncthreads();
        sum_columns(memory.sums, terms);
        if (weight > 0.0f) {
            const float slope = offset_y * terms[0] - offset_x * terms[1] + terms[2];
            params.color_gradients[3 * static_cast<size_t>(slot) + c] -= scale * inverse_total * weight * slope;
        }
    }
    const float tile_missing = block_sum(weight * missing, memory.shares);
    if (place == 0) add_loss(params, static_cast<double>(scale * inverse_total * tile_missing));
}

}  // namespace

void launch_window_similarity(const SparseLossParams& params, cudaStream_t stream) {
    const bool alpha = params.photos != nullptr && params.channels == 4;
    const auto kernel = alpha ? window_similarity_kernel<true> : window_similarity_kernel<false>;
    kernel<<<params.num_tiles, kWindowThreads, 0, stream>>>(params);
}

}  // namespace turbogs
