// What every binding needs: checked pointers of stable-ABI tensors, torch's current stream, errors of launches.
#pragma once

#include <cuda_runtime.h>
#include <torch/csrc/inductor/aoti_torch/c/shim.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>

#include <cstdint>
#include <initializer_list>
#include <optional>
#include <sstream>
#include <string>

// Absent from a torch without CUDA; the library must load there all the same.
#pragma weak aoti_torch_get_current_cuda_stream

namespace turbogs {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

inline void check_cuda(cudaError_t error, const char* what) {
    STD_TORCH_CHECK(error == cudaSuccess, "turbogs: ", what, ": ", cudaGetErrorString(error));
}

// Kernels count in 32 bits.
inline int to_int(int64_t value, const char* what) {
    STD_TORCH_CHECK(value >= 0 && value < INT32_MAX, "turbogs: ", what, ": a launch takes fewer than 2^31 - 1, got ", value);
    return static_cast<int>(value);
}

// Pixels of a view are counted in 32 bits, too.
inline void check_size(int64_t view, int64_t width, int64_t height) {
    STD_TORCH_CHECK(width > 0 && height > 0 && width <= INT32_MAX / height, "turbogs: sizes: view ", view, " is ", width,
                    " x ", height);
}

// One call of an operator: makes the device of its tensors current while it lives, and gives raw pointers of tensors that
// are contiguous, on that device, of the wanted type and shape; says what was wanted where one is not.
class Checker {
public:
    // `first` decides the device.
    explicit Checker(const Tensor& first) : device_(first.get_device_index()) {
        STD_TORCH_CHECK(first.is_cuda(), "turbogs: expected CUDA tensors");
        check_cuda(cudaGetDevice(&previous_), "current device");
        if (previous_ != device_) check_cuda(cudaSetDevice(device_), "setting the device");
    }
    ~Checker() {
        if (previous_ != device_) cudaSetDevice(previous_);
    }
    Checker(const Checker&) = delete;
    Checker& operator=(const Checker&) = delete;

    template <typename T>
    T* pointer(const Tensor& tensor, const char* name, ScalarType type, std::initializer_list<int64_t> shape) const {
        bool fits = tensor.is_cuda() && tensor.get_device_index() == device_ && tensor.scalar_type() == type &&
                    tensor.is_contiguous() && tensor.dim() == static_cast<int64_t>(shape.size());
        int64_t axis = 0;
        for (const int64_t size : shape) {
            fits = fits && tensor.size(axis) == size;
            ++axis;
        }
        if (!fits) {
            STD_TORCH_CHECK(false, "turbogs: ", name, " must be a contiguous ", torch::headeronly::toString(type), " ",
                            text(shape), " tensor on cuda:", static_cast<int>(device_), ", got ", describe(tensor));
        }
        return static_cast<T*>(tensor.data_ptr());
    }

    // The same, of memory that kernels read or write 16 bytes at a time.
    template <typename T>
    T* aligned_pointer(const Tensor& tensor, const char* name, ScalarType type, std::initializer_list<int64_t> shape) const {
        T* out = pointer<T>(tensor, name, type, shape);
        STD_TORCH_CHECK(reinterpret_cast<uintptr_t>(out) % 16 == 0, "turbogs: ", name,
                        " must start at a multiple of 16 bytes");
        return out;
    }

    template <typename T>
    T* optional(const std::optional<Tensor>& tensor, const char* name, ScalarType type,
                std::initializer_list<int64_t> shape) const {
        return tensor.has_value() ? pointer<T>(*tensor, name, type, shape) : nullptr;
    }

    // Rows of one struct each.
    template <typename T>
    T* structs(const Tensor& tensor, const char* name, ScalarType type, int64_t rows) const {
        return aligned_pointer<T>(tensor, name, type, {rows, static_cast<int64_t>(sizeof(T) / sizeof(float))});
    }

    cudaStream_t stream() const {
        void* stream = nullptr;
        STD_TORCH_CHECK(aoti_torch_get_current_cuda_stream(device_, &stream) == 0, "turbogs: no current stream on cuda:",
                        static_cast<int>(device_));
        return static_cast<cudaStream_t>(stream);
    }

    void launched(cudaError_t error, const char* what) const { check_cuda(error, what); }

private:
    template <typename Sizes>
    static std::string text(const Sizes& sizes) {
        std::ostringstream out;
        out << "[";
        bool first = true;
        for (const int64_t size : sizes) {
            out << (first ? "" : ", ") << size;
            first = false;
        }
        out << "]";
        return out.str();
    }

    static std::string describe(const Tensor& tensor) {
        std::ostringstream out;
        out << torch::headeronly::toString(tensor.scalar_type()) << " " << text(tensor.sizes()) << " on "
            << (tensor.is_cuda() ? "cuda:" + std::to_string(static_cast<int>(tensor.get_device_index()))
                                 : "another kind of device")
            << (tensor.is_contiguous() ? "" : ", not contiguous");
        return out.str();
    }

    int32_t device_;
    int previous_ = 0;
};

}  // namespace turbogs
