"""What computes: one protocol, a torch reference and its CUDA twin, and the place that picks one."""
