// The operators of the library, on torch's stable ABI: one build loads on torch 2.10 and later, with or without CUDA.
#include "bindings/arguments.h"

namespace turbogs {
namespace {

// What the library was built for, such as "sm_80 sm_90".
std::string architectures() { return TURBOGS_ARCHITECTURES; }

// The orders and sizes that it was built with. Python compares them with its own
// (turbogs_plugin/engine/cuda/library.py).
std::string interface() { return launches::kInterface; }

// Runs a launch. An error of any kernel or call of CUDA in it stays until it is looked for here.
template <class Launch>
void call(const TensorList& tensors, const IntegerList& integers, const RealList& reals, const IntegerList& rows) {
    Launch::run({tensors, integers, reals, rows});
    check_launched(cudaGetLastError(), Launch::kName);
}

// Defines an operator for each launch. Any of its tensors may be written to.
template <class Library, class... Launches>
void define(Library& m, launches::List<Launches...>) {
    const std::string schema = "(Tensor(a!)?[] tensors, int[] integers, float[] reals, int[] rows) -> ()";
    (m.def((Launches::kName + schema).c_str()), ...);
}

template <class Library, class... Launches>
void implement(Library& m, launches::List<Launches...>) {
    (m.impl(Launches::kName, TORCH_BOX(&call<Launches>)), ...);
}

}  // namespace
}  // namespace turbogs

STABLE_TORCH_LIBRARY_FRAGMENT(turbogs, m) {
    m.def("architectures() -> str");
    m.def("interface() -> str");
    turbogs::define(m, turbogs::launches::All{});
}

STABLE_TORCH_LIBRARY_IMPL(turbogs, CompositeExplicitAutograd, m) {
    m.impl("architectures", TORCH_BOX(&turbogs::architectures));
    m.impl("interface", TORCH_BOX(&turbogs::interface));
}

STABLE_TORCH_LIBRARY_IMPL(turbogs, CUDA, m) { turbogs::implement(m, turbogs::launches::All{}); }
