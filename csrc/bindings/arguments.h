// What every operator needs: the arguments of its launch by name, pointers of its tensors that are checked, torch's
// current stream, and the errors of launches.
//
// Python sends the fields of a launch as four lists (turbogs_plugin/engine/cuda/launches). launches.h, which the
// build makes of the same files, has the order of the fields, so they are read by name here. It declares a function
// `run` for each launch. The other files of this folder define them: each checks its tensors, then hands raw pointers
// and torch's current stream to a launcher of the kernels. Buffers are made by Python.
#pragma once

#include <cuda_runtime.h>
#include <torch/csrc/inductor/aoti_torch/c/shim.h>
#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>

#include <algorithm>
#include <cstdint>
#include <initializer_list>
#include <optional>
#include <sstream>
#include <string>
#include <type_traits>
#include <vector>

#include "common/sizes.h"
#include "launches.h"

// Absent from a torch without CUDA; the library must load there all the same.
#pragma weak aoti_torch_get_current_cuda_stream

namespace turbogs {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

using TensorList = std::vector<std::optional<Tensor>>;
using IntegerList = std::vector<int64_t>;
using RealList = std::vector<double>;

// Kernels count in 32 bits.
inline int to_int(int64_t value, const char* what) {
    STD_TORCH_CHECK(value >= 0 && value < INT32_MAX, "turbogs: ", what, ": a launch takes fewer than 2^31 - 1, got ",
                    value);
    return static_cast<int>(value);
}

// Pixels of a view are counted in 32 bits, too.
inline void check_size(int64_t view, int64_t width, int64_t height) {
    STD_TORCH_CHECK(width > 0 && height > 0 && width <= INT32_MAX / height, "turbogs: sizes: view ", view, " is ",
                    width, " x ", height);
}

inline void check_launched(cudaError_t error, const char* what) {
    STD_TORCH_CHECK(error == cudaSuccess, "turbogs: ", what, ": ", cudaGetErrorString(error));
}

// A value of an enumeration of layout.h, whose entries are numbered from 0. `allowed` names them.
template <class Enumeration>
Enumeration to_enumeration(int64_t value, int count, const char* allowed) {
    STD_TORCH_CHECK(value >= 0 && value < count, "turbogs: ", allowed);
    return static_cast<Enumeration>(value);
}

// What a tensor holds whose memory a kernel takes as `T*`: numbers of T, or what T is made of. A uint16_t has the
// bits of a half; structs are made of floats.
template <class T>
constexpr ScalarType scalar_type() {
    if (std::is_same_v<T, bool>) return ScalarType::Bool;
    if (std::is_same_v<T, double>) return ScalarType::Double;
    if (std::is_same_v<T, uint16_t>) return ScalarType::Half;
    if (std::is_same_v<T, int2>) return ScalarType::Int;
    if (!std::is_integral_v<T>) return ScalarType::Float;
    return sizeof(T) == 1   ? ScalarType::Byte
           : sizeof(T) == 2 ? ScalarType::Short
           : sizeof(T) == 4 ? ScalarType::Int
                            : ScalarType::Long;
}

// The arguments of one call of an operator. Makes the device of its first tensor current while it lives, and gives raw
// pointers of tensors that are contiguous, on that device, of the wanted type and shape; says what was wanted where
// one is not.
//
// `Launch`: a struct of launches.h.
template <class Launch>
class Arguments {
public:
    using Tensors = typename Launch::Tensors;
    using Integers = typename Launch::Integers;
    using Reals = typename Launch::Reals;

    Arguments(const TensorList& tensors, const IntegerList& integers, const RealList& reals, const IntegerList& rows)
        : tensors_(tensors), integers_(integers), reals_(reals), rows_(rows) {
        STD_TORCH_CHECK(tensors.size() == Launch::kNumTensors && integers.size() == Launch::kNumIntegers &&
                            reals.size() == Launch::kNumReals,
                        "turbogs: ", Launch::kName, " takes ", Launch::kNumTensors, " tensors, ", Launch::kNumIntegers,
                        " integers and ", Launch::kNumReals, " reals");
        const Tensor& first = tensor(Tensors{});
        STD_TORCH_CHECK(first.is_cuda(), "turbogs: expected CUDA tensors");
        device_ = first.get_device_index();
        check_launched(cudaGetDevice(&previous_), "current device");
        if (previous_ != device_) check_launched(cudaSetDevice(device_), "setting the device");
    }
    ~Arguments() {
        if (previous_ != device_) cudaSetDevice(previous_);
    }
    Arguments(const Arguments&) = delete;
    Arguments& operator=(const Arguments&) = delete;

    bool has(Tensors field) const { return tensors_[static_cast<size_t>(field)].has_value(); }

    const Tensor& tensor(Tensors field) const {
        STD_TORCH_CHECK(has(field), "turbogs: ", Launch::kName, " needs ", name(field));
        return *tensors_[static_cast<size_t>(field)];
    }

    int64_t integer(Integers field) const { return integers_[static_cast<size_t>(field)]; }
    double real(Reals field) const { return reals_[static_cast<size_t>(field)]; }
    float number(Reals field) const { return static_cast<float>(real(field)); }

    // Number of rows of `size` numbers each, one for each view of a batch.
    int64_t num_rows(int size) const {
        const int64_t count = static_cast<int64_t>(rows_.size()) / size;
        STD_TORCH_CHECK(count >= 1 && count <= kMaxViews && count * size == static_cast<int64_t>(rows_.size()),
                        "turbogs: a batch has 1 .. ", kMaxViews, " views of ", size, " numbers each, got ",
                        rows_.size());
        return count;
    }
    const int64_t* row(int64_t view, int size) const { return rows_.data() + view * size; }

    // Sets a pointer of a launcher's parameters to the memory of a tensor.
    template <class T>
    void set(T*& pointer, Tensors field, std::initializer_list<int64_t> shape,
             ScalarType type = scalar_type<std::remove_const_t<T>>(), size_t alignment = alignof(T)) const {
        const Tensor& value = tensor(field);
        const bool fits = value.is_cuda() && value.get_device_index() == device_ && value.scalar_type() == type &&
                          value.is_contiguous() && value.dim() == static_cast<int64_t>(shape.size()) &&
                          std::equal(shape.begin(), shape.end(), value.sizes().begin());
        if (!fits) {
            STD_TORCH_CHECK(false, "turbogs: ", name(field), " must be a contiguous ",
                            torch::headeronly::toString(type), " ", text(shape),
                            " tensor on cuda:", static_cast<int>(device_), ", got ", describe(value));
        }
        pointer = static_cast<T*>(value.data_ptr());
        STD_TORCH_CHECK(reinterpret_cast<uintptr_t>(pointer) % alignment == 0, "turbogs: ", name(field),
                        " must start at a multiple of ", alignment, " bytes");
    }

    // As `set`, for memory that kernels read or write 16 bytes at a time.
    template <class T>
    void set_quads(T*& pointer, Tensors field, std::initializer_list<int64_t> shape) const {
        set(pointer, field, shape, scalar_type<std::remove_const_t<T>>(), sizeof(float4));
    }

    // As `set`, where there is a tensor; else the pointer stays as it is.
    template <class T>
    void set_optional(T*& pointer, Tensors field, std::initializer_list<int64_t> shape) const {
        if (has(field)) set(pointer, field, shape);
    }

    // Rows of one struct each.
    template <class T>
    void set_structs(T*& pointer, Tensors field, int64_t rows) const {
        set(pointer, field, {rows, static_cast<int64_t>(sizeof(T) / sizeof(float))});
    }

    cudaStream_t stream() const {
        void* stream = nullptr;
        STD_TORCH_CHECK(aoti_torch_get_current_cuda_stream(device_, &stream) == 0,
                        "turbogs: no current stream on cuda:", static_cast<int>(device_));
        return static_cast<cudaStream_t>(stream);
    }

private:
    static const char* name(Tensors field) { return Launch::kTensorNames[static_cast<size_t>(field)]; }

    template <class Sizes>
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

    const TensorList& tensors_;
    const IntegerList& integers_;
    const RealList& reals_;
    const IntegerList& rows_;
    int32_t device_ = 0;
    int previous_ = 0;
};

// Pixels by which the grid of tiles begins before the images of a batch. `Launch` has the fields of Python's
// `GridOrigin`.
template <class Launch>
void read_origin(const Arguments<Launch>& in, int& x, int& y) {
    const int64_t origin_x = in.integer(Launch::Integers::origin_x), origin_y = in.integer(Launch::Integers::origin_y);
    STD_TORCH_CHECK(origin_x >= 0 && origin_x < kTileSize && origin_y >= 0 && origin_y < kTileSize,
                    "turbogs: the grid's origin must be 0 .. ", kTileSize - 1, ", got ", origin_x, ", ", origin_y);
    x = static_cast<int>(origin_x);
    y = static_cast<int>(origin_y);
}

}  // namespace turbogs
