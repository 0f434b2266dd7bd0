"""The interchangeable parts of TurboGS: samplers, schedules, losses, density control and optimizers.

Every protocol and every strategy can be imported from here; each is loaded when it is first used::

    from turbogs_plugin.strategies import ErrorGuidedPixelSampler, PixelSampler
"""

from __future__ import annotations

from turbogs_plugin import lazy_face

_MODULES: dict[str, tuple[str, ...]] = {
    "protocols": (
        "SamplingSchedule",
        "ViewSampler",
        "PixelSampler",
        "SparseLoss",
        "DensityController",
        "GaussianOptimizer",
    ),
    "schedule": ("SinusoidalSchedule", "LinearSchedule", "ExponentialSchedule", "FixedSchedule"),
    "view_sampling": ("GeometryAwareViewSampler", "RandomViewSampler"),
    "pixel_sampling": ("ErrorGuidedPixelSampler", "RandomPixelSampler", "DensePixelSampler"),
    "losses": ("CharbonnierNccLoss", "CharbonnierLoss", "SparseSsimLoss"),
    "density.error_driven": ("ErrorDrivenDensity",),
    "density.none": ("NoDensity",),
    "density.gsplat_default": ("GsplatDefaultDensity",),
    "density.mcmc": ("GsplatMcmcDensity",),
    "density.fastgs": ("FastGsDensity",),
    "optimizers.moment_lm": ("MomentLMOptimizer",),
    "optimizers.sparse_adam": ("SparseAdam",),
    "optimizers.dense_adam": ("DenseAdam",),
    "learning_rates": ("LearningRates",),
}
"""Module -> what it has."""

_PLACES = {name: f"{__name__}.{module}" for module, names in _MODULES.items() for name in names}

__all__ = list(_PLACES)
__getattr__ = lazy_face(__name__, _PLACES)
