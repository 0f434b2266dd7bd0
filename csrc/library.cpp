// What the library says of itself, on any machine: an operator that needs no GPU.
#include <torch/csrc/stable/library.h>

#include <string>

namespace turbogs {
namespace {

// What the library was built for, such as "sm_80 sm_90".
std::string architectures() { return TURBOGS_ARCHITECTURES; }

}  // namespace
}  // namespace turbogs

STABLE_TORCH_LIBRARY_FRAGMENT(turbogs, m) { m.def("architectures() -> str"); }

STABLE_TORCH_LIBRARY_IMPL(turbogs, CompositeExplicitAutograd, m) {
    m.impl("architectures", TORCH_BOX(&turbogs::architectures));
}
