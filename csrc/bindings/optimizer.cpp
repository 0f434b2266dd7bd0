// The kernels from the screen to the parameters as torch operators; see raster.cpp.
#include <algorithm>
#include <cmath>

#include "bindings/arguments.h"
#include "bindings/scene.h"
#include "optimizer/optimizer_params.h"

namespace turbogs {
namespace {

constexpr float kRateMin = 1.0842021724855044e-19f;  // sqrt(FLT_MIN): the damping of a rate of zero stays finite

// What both operators work on. `Launch` has the fields of launches.py's `ScreenBackward`.
template <class Launch>
ScreenBackwardParams read_screen(const Arguments<Launch>& in) {
    using T = typename Launch::Tensors;
    ScreenBackwardParams params = {};
    read_scene(in, params);
    STD_TORCH_CHECK(params.bands <= kMaxBands, "turbogs: shN holds ", params.bands, " bands, more than ", kMaxBands);
    const int64_t views = params.num_views, count = params.num_gaussians;
    params.records =
        in.template aligned_pointer<float4>(T::records, ScalarType::Float, {views, count, ScreenRecord::kSize});
    params.radii = in.template aligned_pointer<int2>(T::radii, ScalarType::Int, {views, count, 2});
    params.num_filled = in.template optional<int32_t>(T::num_filled, ScalarType::Int, {1});
    params.num_slots = to_int(in.integer(Launch::Integers::num_slots), "samples");
    params.overflow = in.template optional<int32_t>(T::overflow, ScalarType::Int, {1});
    if (in.has(T::error_sums)) {
        params.error_sums = in.template pointer<float>(T::error_sums, ScalarType::Float, {count});
        params.distance_sums = in.template pointer<float>(T::distance_sums, ScalarType::Float, {count});
        params.weight_sums = in.template pointer<float>(T::weight_sums, ScalarType::Float, {count});
        params.grad_sums = in.template pointer<float>(T::grad_sums, ScalarType::Float, {count});
        params.absgrad_sums = in.template pointer<float>(T::absgrad_sums, ScalarType::Float, {count});
        params.view_counts = in.template pointer<float>(T::view_counts, ScalarType::Float, {count});
        params.max_radii = in.template pointer<float>(T::max_radii, ScalarType::Float, {count});
    }
    return params;
}

void projection_backward(const TensorList& tensors, const IntegerList& integers, const RealList& reals,
                         const IntegerList& rows) {
    using Launch = launches::ProjectionBackward;
    using T = Launch::Tensors;
    const Arguments<Launch> in(tensors, integers, reals, rows, T::records);
    const ScreenBackwardParams params = read_screen(in);
    const Tensor& row_gradients = in.tensor(T::rows);
    STD_TORCH_CHECK(
        row_gradients.dim() == 3 && (row_gradients.size(0) == 1 || row_gradients.size(0) == params.num_views),
        "turbogs: rows must be [1, N, 14] or [K, N, 14]");
    const int64_t num_rows = row_gradients.size(0), count = params.num_gaussians;
    ProjectionBackwardOutputs outputs = {};
    outputs.per_view = num_rows == params.num_views;
    outputs.rows = in.pointer<float>(T::rows, ScalarType::Float, {num_rows, count, ParameterRow::kSize});
    outputs.shN = in.pointer<float>(T::shN_gradients, ScalarType::Float, {count, params.bands, 3});
    outputs.touched = in.pointer<bool>(T::touched, ScalarType::Bool, {count});
    outputs.view_losses = in.pointer<float>(T::view_losses, ScalarType::Float, {num_rows, count});
    check_launched(launch_projection_backward(params, outputs, in.stream()), "projection backward");
}

// The rates in the order of a row.
void set_rates(const Arguments<launches::FusedStep>& in, OptimizerParams& optimizer) {
    using R = launches::FusedStep::Reals;
    const struct {
        int first, size;
        R rate;
    } columns[] = {
        {ParameterRow::kMeans, 3, R::means},         {ParameterRow::kScales, 3, R::scales},
        {ParameterRow::kQuats, 4, R::quats},         {ParameterRow::kSh0, 3, R::sh0},
        {ParameterRow::kOpacities, 1, R::opacities},
    };
    for (const auto& column : columns) {
        for (int i = column.first; i < column.first + column.size; ++i) {
            optimizer.rates[i] = in.number(column.rate);
            optimizer.inverse_rates[i] = 1.0f / std::max(optimizer.rates[i], kRateMin);
        }
    }
    optimizer.rate_shN = in.number(R::shN);
}

void fused_step(const TensorList& tensors, const IntegerList& integers, const RealList& reals,
                const IntegerList& rows) {
    using Launch = launches::FusedStep;
    using T = Launch::Tensors;
    using I = Launch::Integers;
    using R = Launch::Reals;
    const Arguments<Launch> in(tensors, integers, reals, rows, T::records);
    const ScreenBackwardParams params = read_screen(in);
    const int64_t count = params.num_gaussians, harmonics = 3 * params.bands;
    const double beta1 = in.real(R::beta1), beta2 = in.real(R::beta2);
    OptimizerParams optimizer = {};
    optimizer.kind = to_enumeration<UpdateKind>(in.integer(I::kind), kNumUpdateKinds,
                                                "kind must be 0 (Adam), 1 (balanced LM) or 2 (paper's LM)");
    optimizer.rows_per_view = in.integer(I::rows_per_view) != 0;
    set_rates(in, optimizer);
    optimizer.beta1 = static_cast<float>(beta1);
    optimizer.beta2 = static_cast<float>(beta2);
    optimizer.one_minus_beta1 = static_cast<float>(1.0 - beta1);
    optimizer.one_minus_beta2 = static_cast<float>(1.0 - beta2);
    optimizer.log_beta1 = static_cast<float>(std::log(beta1));
    optimizer.log_beta2 = static_cast<float>(std::log(beta2));
    optimizer.eps = in.number(R::eps);
    optimizer.curvature = in.number(R::curvature);
    optimizer.max_step = in.number(R::max_step);
    optimizer.means = const_cast<float*>(params.means);
    optimizer.quats = const_cast<float*>(params.quats);
    optimizer.scales = const_cast<float*>(params.scales);
    optimizer.opacities = const_cast<float*>(params.opacities);
    optimizer.sh0 = const_cast<float*>(params.sh0);
    optimizer.shN = const_cast<float*>(params.shN);
    optimizer.exp_avg = in.aligned_pointer<float>(T::exp_avg, ScalarType::Float, {count, ParameterRow::kSize});
    optimizer.exp_avg_sq = in.aligned_pointer<float>(T::exp_avg_sq, ScalarType::Float, {count, ParameterRow::kSize});
    optimizer.exp_avg_shN = in.aligned_pointer<float>(T::exp_avg_shN, ScalarType::Float, {count, harmonics});
    optimizer.exp_avg_sq_shN = in.aligned_pointer<float>(T::exp_avg_sq_shN, ScalarType::Float, {count, harmonics});
    optimizer.steps = in.pointer<int32_t>(T::steps, ScalarType::Int, {count});
    optimizer.skipped = in.pointer<unsigned long long>(T::skipped, ScalarType::Long, {});
    check_launched(launch_fused_step(params, optimizer, in.stream()), "fused step");
}

}  // namespace
}  // namespace turbogs

STABLE_TORCH_LIBRARY_FRAGMENT(turbogs, m) {
    m.def("projection_backward" TURBOGS_LAUNCH_SCHEMA);
    m.def("fused_step" TURBOGS_LAUNCH_SCHEMA);
}

STABLE_TORCH_LIBRARY_IMPL(turbogs, CUDA, m) {
    m.impl("projection_backward", TORCH_BOX(&turbogs::projection_backward));
    m.impl("fused_step", TORCH_BOX(&turbogs::fused_step));
}
