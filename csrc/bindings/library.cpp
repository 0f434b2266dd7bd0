// What the library says of itself, on any machine: operators that need no GPU.
#include <torch/csrc/stable/library.h>

#include <string>

#include "launches.h"

namespace turbogs {
namespace {

// What the library was built for, such as "sm_80 sm_90".
std::string architectures() { return TURBOGS_ARCHITECTURES; }

// The orders and sizes that it was built with. Python compares them with its own
// (turbogs_plugin/engine/cuda/library.py).
std::string interface() { return launches::kInterface; }

}  // namespace
}  // namespace turbogs

STABLE_TORCH_LIBRARY_FRAGMENT(turbogs, m) {
    m.def("architectures() -> str");
    m.def("interface() -> str");
}

STABLE_TORCH_LIBRARY_IMPL(turbogs, CompositeExplicitAutograd, m) {
    m.impl("architectures", TORCH_BOX(&turbogs::architectures));
    m.impl("interface", TORCH_BOX(&turbogs::interface));
}
