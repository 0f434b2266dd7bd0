// The training kernels as torch operators, on the stable ABI. Tensors become checked pointers here; outputs are made by
// the caller. Every launch goes to torch's current stream of the tensors' device.
#include <cuda_runtime.h>
#include <torch/csrc/inductor/aoti_torch/c/shim.h>
#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>

#include <cmath>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "training_params.h"

// A CPU-only torch has no such symbol; the library must load there too.
#pragma weak aoti_torch_get_current_cuda_stream

namespace {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;
using namespace turbogs;

template <class T>
struct DtypeOf;
template <>
struct DtypeOf<float> {
    static constexpr ScalarType value = ScalarType::Float;
    static constexpr const char* name = "float32";
};
template <>
struct DtypeOf<double> {
    static constexpr ScalarType value = ScalarType::Double;
    static constexpr const char* name = "float64";
};
template <>
struct DtypeOf<int32_t> {
    static constexpr ScalarType value = ScalarType::Int;
    static constexpr const char* name = "int32";
};
template <>
struct DtypeOf<int64_t> {
    static constexpr ScalarType value = ScalarType::Long;
    static constexpr const char* name = "int64";
};
template <>
struct DtypeOf<int16_t> {
    static constexpr ScalarType value = ScalarType::Short;
    static constexpr const char* name = "int16";
};
template <>
struct DtypeOf<uint8_t> {
    static constexpr ScalarType value = ScalarType::Byte;
    static constexpr const char* name = "uint8";
};
template <>
struct DtypeOf<bool> {
    static constexpr ScalarType value = ScalarType::Bool;
    static constexpr const char* name = "bool";
};
struct Half {};  // storage only: kernels read it as __half
template <>
struct DtypeOf<Half> {
    static constexpr ScalarType value = ScalarType::Half;
    static constexpr const char* name = "float16";
};

// Makes a device current for the launches of one operator, and gives torch's current stream there.
class DeviceScope {
   public:
    explicit DeviceScope(const Tensor& tensor) : device_(tensor.get_device_index()) {
        STD_TORCH_CHECK(tensor.is_cuda(), "turbogs: the training kernels need tensors on a CUDA device");
        check(cudaGetDevice(&previous_));
        if (previous_ != device_) check(cudaSetDevice(device_));
        void* stream = nullptr;
        STABLE_TORCH_ERROR_CODE_CHECK(aoti_torch_get_current_cuda_stream(device_, &stream));
        stream_ = static_cast<cudaStream_t>(stream);
    }
    ~DeviceScope() {
        if (previous_ != device_) cudaSetDevice(previous_);
    }
    DeviceScope(const DeviceScope&) = delete;
    DeviceScope& operator=(const DeviceScope&) = delete;

    cudaStream_t stream() const { return stream_; }

    // The data of a contiguous tensor of this device, dtype T and `count` elements, aligned to 16 bytes.
    template <class T>
    T* data(const Tensor& tensor, const char* name, int64_t count) const {
        STD_TORCH_CHECK(tensor.is_cuda() && tensor.get_device_index() == device_, "turbogs: ", name,
                        " must be on cuda:", device_);
        STD_TORCH_CHECK(tensor.scalar_type() == DtypeOf<T>::value, "turbogs: ", name, " must be ", DtypeOf<T>::name);
        STD_TORCH_CHECK(tensor.is_contiguous(), "turbogs: ", name, " must be contiguous");
        STD_TORCH_CHECK(tensor.numel() == count, "turbogs: ", name, " must have ", count, " elements, not ",
                        tensor.numel());
        T* pointer = static_cast<T*>(tensor.data_ptr());
        STD_TORCH_CHECK(reinterpret_cast<uintptr_t>(pointer) % 16 == 0, "turbogs: ", name,
                        " must start at a multiple of 16 bytes; clone it");
        return pointer;
    }

    template <class T>
    T* data(const std::optional<Tensor>& tensor, const char* name, int64_t count) const {
        return tensor.has_value() ? data<T>(*tensor, name, count) : nullptr;
    }

    static void check(cudaError_t status) {
        STD_TORCH_CHECK(status == cudaSuccess, "turbogs: CUDA error: ", cudaGetErrorString(status));
    }

   private:
    int device_ = 0;
    int previous_ = 0;
    cudaStream_t stream_ = nullptr;
};

// The batch that a backward pass works on; see `BackwardInputs` in training_kernels.py.
ScreenBackwardParams screen_backward_params(const DeviceScope& device, const std::vector<Tensor>& gaussians,
                                            const Tensor& viewmats, const Tensor& Ks, const std::vector<int64_t>& sizes,
                                            const Tensor& records, const std::optional<Tensor>& radii,
                                            const std::vector<Tensor>& stats, int64_t sh_degree, double eps2d,
                                            int64_t sample_count, const std::optional<Tensor>& num_filled, const std::optional<Tensor>& overflow) {
    STD_TORCH_CHECK(gaussians.size() == 6, "turbogs: gaussians must be means, quats, scales, opacities, sh0, shN");
    STD_TORCH_CHECK(gaussians[0].dim() == 2 && gaussians[5].dim() == 3, "turbogs: means must be [N, 3], shN [N, B, 3]");
    const int64_t num_views = static_cast<int64_t>(sizes.size()) / 2;
    const int64_t num_gaussians = gaussians[0].size(0);
    const int64_t bands = gaussians[5].size(1);
    STD_TORCH_CHECK(num_views >= 1 && num_views <= kTrainingMaxViews, "turbogs: a batch has 1 to ", kTrainingMaxViews,
                    " views, not ", num_views);
    STD_TORCH_CHECK(sh_degree >= 0 && sh_degree <= 3, "turbogs: sh_degree must be 0 .. 3, not ", sh_degree);
    STD_TORCH_CHECK(bands <= kTrainingMaxBands && (sh_degree + 1) * (sh_degree + 1) - 1 <= bands,
                    "turbogs: shN holds ", bands, " bands, which does not suit degree ", sh_degree);

    ScreenBackwardParams params = {};
    params.num_views = static_cast<int>(num_views);
    params.num_gaussians = static_cast<int>(num_gaussians);
    params.sh_degree = static_cast<int>(sh_degree);
    params.bands = static_cast<int>(bands);
    params.eps2d = static_cast<float>(eps2d);
    params.means = device.data<float>(gaussians[0], "means", num_gaussians * 3);
    params.quats = device.data<float>(gaussians[1], "quats", num_gaussians * 4);
    params.scales = device.data<float>(gaussians[2], "scales", num_gaussians * 3);
    params.opacities = device.data<float>(gaussians[3], "opacities", num_gaussians);
    params.sh0 = device.data<float>(gaussians[4], "sh0", num_gaussians * 3);
    params.shN = device.data<float>(gaussians[5], "shN", num_gaussians * bands * 3);
    params.viewmats = device.data<float>(viewmats, "viewmats", num_views * 16);
    params.intrinsics = device.data<float>(Ks, "Ks", num_views * 9);
    for (int64_t view = 0; view < num_views; ++view) {
        params.widths[view] = static_cast<int>(sizes[2 * view]);
        params.heights[view] = static_cast<int>(sizes[2 * view + 1]);
    }
    params.records = reinterpret_cast<float4*>(
        device.data<float>(records, "screen gradients", num_views * num_gaussians * kRecordQuads * 4));
    params.sample_count = static_cast<int>(sample_count);
    params.num_filled = device.data<int32_t>(num_filled, "num_filled", 1);
    params.overflow = device.data<int32_t>(overflow, "overflow", 1);
    if (!stats.empty()) {
        STD_TORCH_CHECK(stats.size() == 7, "turbogs: stats must be the seven tensors of GaussianStats");
        STD_TORCH_CHECK(radii.has_value(), "turbogs: statistics need the radii");
        params.radii = reinterpret_cast<const int2*>(
            device.data<int32_t>(*radii, "radii", num_views * num_gaussians * 2));
        params.error_sums = device.data<float>(stats[0], "error_sums", num_gaussians);
        params.distance_sums = device.data<float>(stats[1], "distance_sums", num_gaussians);
        params.weight_sums = device.data<float>(stats[2], "weight_sums", num_gaussians);
        params.grad_sums = device.data<float>(stats[3], "grad_sums", num_gaussians);
        params.absgrad_sums = device.data<float>(stats[4], "absgrad_sums", num_gaussians);
        params.view_counts = device.data<float>(stats[5], "view_counts", num_gaussians);
        params.max_radii = device.data<float>(stats[6], "max_radii", num_gaussians);
    }
    return params;
}

void projection_backward(const std::vector<Tensor>& gaussians, const Tensor& viewmats, const Tensor& Ks,
                         const std::vector<int64_t>& sizes, const Tensor& records, const std::optional<Tensor>& radii,
                         const std::vector<Tensor>& stats, int64_t sh_degree, double eps2d, int64_t sample_count,
                         const std::optional<Tensor>& num_filled, const std::optional<Tensor>& overflow, const Tensor& rows, const Tensor& shN,
                         const Tensor& touched, const Tensor& view_losses) {
    const DeviceScope device(records);
    const ScreenBackwardParams params = screen_backward_params(device, gaussians, viewmats, Ks, sizes, records, radii, stats,
                                                               sh_degree, eps2d, sample_count, num_filled, overflow);
    STD_TORCH_CHECK(rows.dim() == 3 && (rows.size(0) == 1 || rows.size(0) == params.num_views),
                    "turbogs: rows must be [1, N, 14] or [K, N, 14]");
    const int64_t num_rows = rows.size(0), count = params.num_gaussians;
    ProjectionBackwardOutputs outputs = {};
    outputs.per_view = num_rows == params.num_views;
    outputs.rows = device.data<float>(rows, "rows", num_rows * count * kRowSize);
    outputs.shN = device.data<float>(shN, "shN's gradient", count * params.bands * 3);
    outputs.touched = device.data<bool>(touched, "touched", count);
    outputs.view_losses = device.data<float>(view_losses, "view_losses", num_rows * count);
    DeviceScope::check(launch_projection_backward(params, outputs, device.stream()));
}

void fused_step(const std::vector<Tensor>& gaussians, const Tensor& viewmats, const Tensor& Ks,
                const std::vector<int64_t>& sizes, const Tensor& records, const std::optional<Tensor>& radii,
                const std::vector<Tensor>& stats, int64_t sh_degree, double eps2d, int64_t sample_count,
                const std::optional<Tensor>& num_filled, const std::optional<Tensor>& overflow, const std::vector<Tensor>& moments, int64_t kind,
                bool rows_per_view, const std::vector<double>& rates, double beta1, double beta2, double eps,
                double curvature, double max_step) {
    const DeviceScope device(records);
    const ScreenBackwardParams params = screen_backward_params(device, gaussians, viewmats, Ks, sizes, records, radii, stats,
                                                               sh_degree, eps2d, sample_count, num_filled, overflow);
    STD_TORCH_CHECK(moments.size() == 6, "turbogs: moments must be the six tensors of GaussianMoments");
    STD_TORCH_CHECK(rates.size() == 6, "turbogs: rates must be of means, quats, scales, opacities, sh0, shN");
    STD_TORCH_CHECK(kind >= 0 && kind <= 2, "turbogs: kind must be 0 (Adam), 1 (balanced LM) or 2 (paper's LM)");
    const int64_t count = params.num_gaussians, harmonics = 3 * params.bands;
    OptimizerParams optimizer = {};
    optimizer.kind = static_cast<StepKind>(kind);
    optimizer.rows_per_view = rows_per_view;
    const double row_rates[kRowSize] = {rates[0], rates[0], rates[0], rates[2], rates[2], rates[2], rates[1],
                                        rates[1], rates[1], rates[1], rates[4], rates[4], rates[4], rates[3]};
    for (int i = 0; i < kRowSize; ++i) optimizer.rates[i] = static_cast<float>(row_rates[i]);
    optimizer.rate_shN = static_cast<float>(rates[5]);
    optimizer.beta1 = static_cast<float>(beta1);
    optimizer.beta2 = static_cast<float>(beta2);
    optimizer.log_beta1 = static_cast<float>(std::log(beta1));
    optimizer.log_beta2 = static_cast<float>(std::log(beta2));
    optimizer.eps = static_cast<float>(eps);
    optimizer.curvature = static_cast<float>(curvature);
    optimizer.max_step = static_cast<float>(max_step);
    optimizer.means = const_cast<float*>(params.means);
    optimizer.quats = const_cast<float*>(params.quats);
    optimizer.scales = const_cast<float*>(params.scales);
    optimizer.opacities = const_cast<float*>(params.opacities);
    optimizer.sh0 = const_cast<float*>(params.sh0);
    optimizer.shN = const_cast<float*>(params.shN);
    optimizer.exp_avg = device.data<float>(moments[0], "exp_avg", count * kRowSize);
    optimizer.exp_avg_sq = device.data<float>(moments[1], "exp_avg_sq", count * kRowSize);
    optimizer.exp_avg_shN = device.data<float>(moments[2], "exp_avg_shN", count * harmonics);
    optimizer.exp_avg_sq_shN = device.data<float>(moments[3], "exp_avg_sq_shN", count * harmonics);
    optimizer.steps = device.data<int32_t>(moments[4], "steps", count);
    optimizer.skipped = reinterpret_cast<unsigned long long*>(device.data<int64_t>(moments[5], "skipped", 1));
    DeviceScope::check(launch_fused_step(params, optimizer, device.stream()));
}

}  // namespace

#define TURBOGS_BACKWARD_INPUTS                                                                              \
    "Tensor(p!)[] gaussians, Tensor viewmats, Tensor Ks, int[] sizes, Tensor(r!) records, Tensor? radii, "           \
    "Tensor(s!)[] stats, int sh_degree, float eps2d, int sample_count, Tensor? num_filled, Tensor? overflow, "

STABLE_TORCH_LIBRARY_FRAGMENT(turbogs, m) {
    m.def("projection_backward(" TURBOGS_BACKWARD_INPUTS
          "Tensor(a!) rows, Tensor(b!) shN, Tensor(c!) touched, Tensor(d!) view_losses) -> ()");
    m.def("fused_step(" TURBOGS_BACKWARD_INPUTS
          "Tensor(m!)[] moments, int kind, bool rows_per_view, float[] rates, float beta1, float beta2, float eps, "
          "float curvature, float max_step) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(turbogs, CUDA, m) {
    m.impl("projection_backward", TORCH_BOX(&projection_backward));
    m.impl("fused_step", TORCH_BOX(&fused_step));
}
