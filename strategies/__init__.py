"""The interchangeable parts of TurboGS: samplers, schedules, losses, density control and optimizers.

Every protocol and every strategy can be imported from here; each is loaded when it is first used::

    from turbogs_plugin.strategies.pixel_sampling import ErrorGuidedPixelSampler
    from turbogs_plugin.strategies.protocols import PixelSampler
"""

from __future__ import annotations

from turbogs_plugin import lazy_face

PROTOCOLS = {
    "schedule": "SamplingSchedule",
    "view_sampler": "ViewSampler",
    "pixel_sampler": "PixelSampler",
    "loss": "SparseLoss",
    "density": "DensityController",
    "optimizer": "GaussianOptimizer",
}
"""Kind of strategy, which is its section of a configuration -> its protocol."""

TYPES = {
    "schedule": {
        "sinusoidal": "schedule:SinusoidalSchedule",
        "linear": "schedule:LinearSchedule",
        "exponential": "schedule:ExponentialSchedule",
        "fixed": "schedule:FixedSchedule",
    },
    "view_sampler": {
        "geometry_aware": "view_sampling:GeometryAwareViewSampler",
        "random": "view_sampling:RandomViewSampler",
    },
    "pixel_sampler": {
        "error_guided": "pixel_sampling:ErrorGuidedPixelSampler",
        "random": "pixel_sampling:RandomPixelSampler",
        "dense": "pixel_sampling:DensePixelSampler",
    },
    "loss": {
        "charbonnier_ncc": "losses:CharbonnierNccLoss",
        "charbonnier": "losses:CharbonnierLoss",
        "sparse_ssim": "losses:SparseSsimLoss",
    },
    "density": {
        "error_driven": "density.error_driven:ErrorDrivenDensity",
        "none": "density.rows:NoDensity",
        "gsplat_default": "density.gsplat_default:GsplatDefaultDensity",
        "mcmc": "density.mcmc:GsplatMcmcDensity",
    },
    "optimizer": {
        "moment_lm": "optimizers.moment_lm:MomentLMOptimizer",
        "sparse_adam": "optimizers.sparse_adam:SparseAdam",
        "adam": "optimizers.dense_adam:DenseAdam",
    },
}
"""Kind -> `type` in a configuration -> "module:Class". The first type of a kind is what a configuration without that
section gets."""

_OWNERS = [*(place for types in TYPES.values() for place in types.values()), "learning_rates:LearningRates"]
_PLACES = {name: f"{__name__}.protocols" for name in PROTOCOLS.values()}
_PLACES |= {name: f"{__name__}.{module}" for module, _, name in (place.partition(":") for place in _OWNERS)}

__all__ = list(_PLACES)
__getattr__ = lazy_face(__name__, _PLACES)
