"""Density control: Gaussians are added and removed."""
