"""Where Gaussians are added and removed."""
