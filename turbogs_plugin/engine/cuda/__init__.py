"""The CUDA engine: the reference's twin on the kernels of csrc/."""
