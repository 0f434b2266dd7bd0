"""How gradients become steps of the parameters."""
