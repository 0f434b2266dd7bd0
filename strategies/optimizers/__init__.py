"""Optimizers: gradients become steps of the parameters."""
