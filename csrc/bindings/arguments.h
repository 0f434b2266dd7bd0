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

#include "common/batch.h"
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

    // The tensors of a field `list[Tensor]` in Python, which follow the others: number, and field of each.
    int64_t num_more() const { return static_cast<int64_t>(tensors_.size() - Launch::kNumTensors); }
    static Tensors more(int64_t place) { return static_cast<Tensors>(Launch::kNumTensors + place); }

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
            const int64_t* sizes = value.sizes().data();
            const int device = value.is_cuda() ? static_cast<int>(value.get_device_index()) : -1;
            STD_TORCH_CHECK(false, "turbogs: ", name(field), " must be a contiguous ",
                            describe(type, shape.begin(), shape.size(), device_), ", got a ",
                            value.is_contiguous() ? "" : "not contiguous ",
                            describe(value.scalar_type(), sizes, value.dim(), device));
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
    static const char* name(Tensors field) {
        return field < more(0) ? Launch::kTensorNames[static_cast<size_t>(field)] : "memory of a process";
    }

    static std::string describe(ScalarType type, const int64_t* sizes, int64_t count, int device) {
        std::ostringstream out;
        out << torch::headeronly::toString(type) << " tensor [";
        for (int64_t i = 0; i < count; ++i) out << (i > 0 ? ", " : "") << sizes[i];
        out << "] on " << (device < 0 ? "another kind of device" : "cuda:" + std::to_string(device));
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

// Reads Python's `Background`, whose fields `Launch` has.
template <class Launch>
void read_background(const Arguments<Launch>& in, float (&background)[3]) {
    using R = typename Launch::Reals;
    background[0] = in.number(R::background_red);
    background[1] = in.number(R::background_green);
    background[2] = in.number(R::background_blue);
}

// Reads Python's `Scene`, whose fields `Launch` has.
template <class Launch>
void read_scene(const Arguments<Launch>& in, SceneParams& scene) {
    using T = typename Launch::Tensors;
    const Tensor &means = in.tensor(T::means), &shN = in.tensor(T::shN);
    STD_TORCH_CHECK(means.dim() == 2 && shN.dim() == 3, "turbogs: means must be [N, 3], shN [N, B, 3]");
    const int64_t views = in.num_rows(ImageRow::kSize), count = means.size(0), bands = shN.size(1);
    const int64_t sh_degree = in.integer(Launch::Integers::sh_degree);
    STD_TORCH_CHECK(sh_degree >= 0 && sh_degree <= kMaxShDegree, "turbogs: sh_degree must be 0 .. ", kMaxShDegree,
                    ", got ", sh_degree);
    STD_TORCH_CHECK(bands >= (sh_degree + 1) * (sh_degree + 1) - 1, "turbogs: shN holds ", bands,
                    " bands, too few for sh_degree ", sh_degree);
    to_int(views * count, "views * Gaussians");
    scene.num_views = to_int(views, "views");
    scene.num_gaussians = to_int(count, "Gaussians");
    scene.sh_degree = static_cast<int>(sh_degree);
    scene.bands = to_int(bands, "bands");
    scene.eps2d = in.number(Launch::Reals::eps2d);
    in.set(scene.means, T::means, {count, 3});
    in.set(scene.quats, T::quats, {count, 4});
    in.set(scene.scales, T::scales, {count, 3});
    in.set(scene.opacities, T::opacities, {count});
    in.set(scene.sh0, T::sh0, {count, 1, 3});
    in.set_quads(scene.shN, T::shN, {count, bands, 3});
    const Tensor& viewmats = in.tensor(T::viewmats);
    STD_TORCH_CHECK(viewmats.dim() == 3, "turbogs: viewmats must be [C, 4, 4]");
    const int64_t cameras = viewmats.size(0);
    in.set(scene.viewmats, T::viewmats, {cameras, 4, 4});
    in.set(scene.intrinsics, T::Ks, {cameras, 3, 3});
    for (int64_t view = 0; view < views; ++view) {
        const int64_t* row = in.row(view, ImageRow::kSize);
        const int64_t width = row[ImageRow::kWidth], height = row[ImageRow::kHeight], camera = row[ImageRow::kCamera];
        check_size(view, width, height);
        STD_TORCH_CHECK(camera >= 0 && camera < cameras, "turbogs: camera ", camera, " of view ", view,
                        " is not one of ", cameras);
        scene.widths[view] = static_cast<int>(width);
        scene.heights[view] = static_cast<int>(height);
        scene.camera_rows[view] = to_int(camera, "cameras");
    }
}

// Fills `views` of a launcher's parameters, and counts them, from rows of `row_size` numbers, which begin as `ViewRow`
// does. `pixels`: of all training views, or -1 where nothing is read at flat pixels.
template <class Launch, class Params>
void read_views(const Arguments<Launch>& in, int row_size, int64_t pixels, Params& params) {
    int num_tiles = 0, origin_x = 0, origin_y = 0;
    read_origin(in, origin_x, origin_y);
    params.num_views = static_cast<int>(in.num_rows(row_size));
    for (int i = 0; i < params.num_views; ++i) {
        const int64_t* row = in.row(i, row_size);
        const int64_t width = row[ViewRow::kWidth], height = row[ViewRow::kHeight];
        check_size(i, width, height);
        SampleView& view = params.views[i];
        view.pixel_base = row[ViewRow::kFirstPixel];
        view.width = static_cast<int>(width);
        view.height = static_cast<int>(height);
        view.view_number = to_int(row[ViewRow::kNumber], "view number");
        view.origin_x = origin_x;
        view.origin_y = origin_y;
        view.tiles_x = tiles_along(origin_x + view.width);
        view.tiles_y = tiles_along(origin_y + view.height);
        view.tile_base = num_tiles;
        num_tiles += view.tiles_x * view.tiles_y;
        STD_TORCH_CHECK(pixels < 0 || (view.pixel_base >= 0 && view.pixel_base + width * height <= pixels),
                        "turbogs: view ", view.view_number, " lies outside the photos or maps");
    }
}

}  // namespace turbogs
