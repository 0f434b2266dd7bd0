"""The model: the initial Gaussians, their order and limits, and their files."""
