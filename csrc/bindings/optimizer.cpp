// The kernels from the screen to the parameters as torch operators; see arguments.h.
#include <algorithm>
#include <cmath>

#include "bindings/arguments.h"
#include "bindings/scene.h"
#include "optimizer/optimizer_params.h"

namespace turbogs {
namespace {

constexpr float kRateMin = 1.0842021724855044e-19f;  // sqrt(FLT_MIN): the damping of a rate of zero stays finite

// What both operators work on. `Launch` has the fields of Python's `ScreenBackward`.
template <class Launch>
ScreenBackwardParams read_screen(const Arguments<Launch>& in) {
    using T = typename Launch::Tensors;
    ScreenBackwardParams params = {};
    read_scene(in, params);
    STD_TORCH_CHECK(params.bands <= kMaxBands, "turbogs: shN holds ", params.bands, " bands, more than ", kMaxBands);
    const int64_t views = params.num_views, count = params.num_gaussians;
    in.set(params.records, T::records, {views, count, ScreenRecord::kSize});
    in.set(params.radii, T::radii, {views, count, 2});
    in.set_optional(params.num_filled, T::num_filled, {1});
    params.num_slots = to_int(in.integer(Launch::Integers::num_slots), "samples");
    in.set_optional(params.overflow, T::overflow, {1});
    if (in.has(T::error_sums)) {
        in.set(params.error_sums, T::error_sums, {count});
        in.set(params.distance_sums, T::distance_sums, {count});
        in.set(params.weight_sums, T::weight_sums, {count});
        in.set(params.grad_sums, T::grad_sums, {count});
        in.set(params.absgrad_sums, T::absgrad_sums, {count});
        in.set(params.square_sums, T::square_sums, {count});
        in.set(params.view_counts, T::view_counts, {count});
        in.set(params.max_radii, T::max_radii, {count});
    }
    return params;
}

}  // namespace

void launches::ProjectionBackward::run(const Arguments<ProjectionBackward>& in) {
    const ScreenBackwardParams params = read_screen(in);
    const Tensor& row_gradients = in.tensor(Tensors::rows);
    STD_TORCH_CHECK(
        row_gradients.dim() == 3 && (row_gradients.size(0) == 1 || row_gradients.size(0) == params.num_views),
        "turbogs: rows must be [1, N, 14] or [K, N, 14]");
    const int64_t num_rows = row_gradients.size(0), count = params.num_gaussians;
    ProjectionBackwardOutputs outputs = {};
    outputs.per_view = num_rows == params.num_views;
    in.set(outputs.rows, Tensors::rows, {num_rows, count, ParameterRow::kSize});
    in.set(outputs.shN, Tensors::shN_gradients, {count, params.bands, 3});
    in.set(outputs.touched, Tensors::touched, {count});
    in.set(outputs.view_losses, Tensors::view_losses, {num_rows, count});
    check_launched(launch_projection_backward(params, outputs, in.stream()), "projection backward");
}

void launches::FusedStep::run(const Arguments<FusedStep>& in) {
    const ScreenBackwardParams params = read_screen(in);
    const int64_t count = params.num_gaussians, harmonics = 3 * params.bands;
    const double beta1 = in.real(Reals::beta1), beta2 = in.real(Reals::beta2);
    OptimizerParams optimizer = {};
    optimizer.kind = to_enumeration<UpdateKind>(in.integer(Integers::kind), kNumUpdateKinds,
                                                "kind must be 0 (Adam), 1 (balanced LM) or 2 (paper's LM)");
    optimizer.rows_per_view = in.integer(Integers::rows_per_view) != 0;
    const auto set_rates = [&](int first, int size, Reals rate) {
        std::fill_n(optimizer.rates + first, size, in.number(rate));
    };
    set_rates(ParameterRow::kMeans, 3, Reals::means);
    set_rates(ParameterRow::kScales, 3, Reals::scales);
    set_rates(ParameterRow::kQuats, 4, Reals::quats);
    set_rates(ParameterRow::kSh0, 3, Reals::sh0);
    set_rates(ParameterRow::kOpacities, 1, Reals::opacities);
    for (int i = 0; i < ParameterRow::kSize; ++i) {
        optimizer.inverse_rates[i] = 1.0f / std::max(optimizer.rates[i], kRateMin);
    }
    optimizer.rate_shN = in.number(Reals::shN);
    optimizer.beta1 = static_cast<float>(beta1);
    optimizer.beta2 = static_cast<float>(beta2);
    optimizer.one_minus_beta1 = static_cast<float>(1.0 - beta1);
    optimizer.one_minus_beta2 = static_cast<float>(1.0 - beta2);
    optimizer.log_beta1 = static_cast<float>(std::log(beta1));
    optimizer.log_beta2 = static_cast<float>(std::log(beta2));
    optimizer.eps = in.number(Reals::eps);
    optimizer.curvature = in.number(Reals::curvature);
    optimizer.max_step = in.number(Reals::max_step);
    constexpr Integers kCopies[kMaxPeers - 1] = {Integers::copy_0, Integers::copy_1, Integers::copy_2,
                                                 Integers::copy_3, Integers::copy_4, Integers::copy_5,
                                                 Integers::copy_6};
    for (const Integers copy : kCopies) {
        const int64_t distance = in.integer(copy);
        if (distance == 0) break;
        STD_TORCH_CHECK(distance % static_cast<int64_t>(sizeof(float4)) == 0,
                        "turbogs: a copy of a model must lie a multiple of 16 bytes behind it");
        optimizer.copies[optimizer.num_copies++] = distance;
    }
    in.set(optimizer.exp_avg, Tensors::exp_avg, {count, ParameterRow::kSize});
    in.set(optimizer.exp_avg_sq, Tensors::exp_avg_sq, {count, ParameterRow::kSize});
    in.set_quads(optimizer.exp_avg_shN, Tensors::exp_avg_shN, {count, harmonics});
    in.set_quads(optimizer.exp_avg_sq_shN, Tensors::exp_avg_sq_shN, {count, harmonics});
    in.set(optimizer.steps, Tensors::steps, {count});
    in.set(optimizer.skipped, Tensors::skipped, {});
    check_launched(launch_fused_step(params, optimizer, in.stream()), "fused step");
}

}  // namespace turbogs
