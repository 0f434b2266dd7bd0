"""The interchangeable parts of TurboGS: samplers, schedules, losses, density control and optimizers."""
