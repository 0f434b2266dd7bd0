"""The model: Gaussians made from points, and to and from files."""
