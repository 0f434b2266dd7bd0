"""The interchangeable parts of TurboGS: samplers, schedules, losses, density control and optimizers.

Every protocol, every strategy and the data that their methods take can be imported from here; each is loaded when it
is first used::

    from turbogs_plugin.strategies import ErrorGuidedPixelSampler, ErrorMaps, PixelSampler, PixelSamples, Step
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from turbogs_plugin import lazy_face

if TYPE_CHECKING:  # what editors and type checkers see
    from turbogs_plugin.engine.rules import LossTerms as LossTerms
    from turbogs_plugin.engine.rules import UpdateRule as UpdateRule
    from turbogs_plugin.error_maps import ErrorMaps as ErrorMaps
    from turbogs_plugin.strategies.density.error_driven import ErrorDrivenDensity as ErrorDrivenDensity
    from turbogs_plugin.strategies.density.gsplat_default import GsplatDefaultDensity as GsplatDefaultDensity
    from turbogs_plugin.strategies.density.mcmc import GsplatMcmcDensity as GsplatMcmcDensity
    from turbogs_plugin.strategies.density.rows import NoDensity as NoDensity
    from turbogs_plugin.strategies.learning_rates import LearningRates as LearningRates
    from turbogs_plugin.strategies.losses import CharbonnierLoss as CharbonnierLoss
    from turbogs_plugin.strategies.losses import CharbonnierNccLoss as CharbonnierNccLoss
    from turbogs_plugin.strategies.losses import SparseSsimLoss as SparseSsimLoss
    from turbogs_plugin.strategies.optimizers.dense_adam import DenseAdam as DenseAdam
    from turbogs_plugin.strategies.optimizers.moment_lm import MomentLMOptimizer as MomentLMOptimizer
    from turbogs_plugin.strategies.optimizers.sparse_adam import SparseAdam as SparseAdam
    from turbogs_plugin.strategies.pixel_sampling import DensePixelSampler as DensePixelSampler
    from turbogs_plugin.strategies.pixel_sampling import ErrorGuidedPixelSampler as ErrorGuidedPixelSampler
    from turbogs_plugin.strategies.pixel_sampling import RandomPixelSampler as RandomPixelSampler
    from turbogs_plugin.strategies.protocols import DensityController as DensityController
    from turbogs_plugin.strategies.protocols import GaussianOptimizer as GaussianOptimizer
    from turbogs_plugin.strategies.protocols import PixelSampler as PixelSampler
    from turbogs_plugin.strategies.protocols import SamplingSchedule as SamplingSchedule
    from turbogs_plugin.strategies.protocols import SparseLoss as SparseLoss
    from turbogs_plugin.strategies.protocols import ViewSampler as ViewSampler
    from turbogs_plugin.strategies.schedule import ExponentialSchedule as ExponentialSchedule
    from turbogs_plugin.strategies.schedule import FixedSchedule as FixedSchedule
    from turbogs_plugin.strategies.schedule import LinearSchedule as LinearSchedule
    from turbogs_plugin.strategies.schedule import SinusoidalSchedule as SinusoidalSchedule
    from turbogs_plugin.strategies.view_sampling import GeometryAwareViewSampler as GeometryAwareViewSampler
    from turbogs_plugin.strategies.view_sampling import RandomViewSampler as RandomViewSampler
    from turbogs_plugin.types import Cameras as Cameras
    from turbogs_plugin.types import GaussianGradients as GaussianGradients
    from turbogs_plugin.types import Gaussians as Gaussians
    from turbogs_plugin.types import GaussianStats as GaussianStats
    from turbogs_plugin.types import LossOutput as LossOutput
    from turbogs_plugin.types import PixelSamples as PixelSamples
    from turbogs_plugin.types import RowUpdate as RowUpdate
    from turbogs_plugin.types import SamplingBudget as SamplingBudget
    from turbogs_plugin.types import Step as Step

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
        "sparse_adam": "optimizers.sparse_adam:SparseAdam",
        "moment_lm": "optimizers.moment_lm:MomentLMOptimizer",
        "adam": "optimizers.dense_adam:DenseAdam",
    },
}
"""Kind -> `type` in a configuration -> "module:Class". The first type of a kind is what a configuration without that
section gets."""

_OWNERS = [*(place for types in TYPES.values() for place in types.values()), "learning_rates:LearningRates"]
_PLACES = {name: f"{__name__}.protocols" for name in PROTOCOLS.values()}
_PLACES |= {name: f"{__name__}.{module}" for module, _, name in (place.partition(":") for place in _OWNERS)}
_PLACES |= dict.fromkeys(("LossTerms", "UpdateRule"), "turbogs_plugin.engine.rules")
_DATA = "Cameras GaussianGradients Gaussians GaussianStats LossOutput PixelSamples RowUpdate SamplingBudget Step"
_PLACES |= dict.fromkeys(_DATA.split(), "turbogs_plugin.types") | {"ErrorMaps": "turbogs_plugin.error_maps"}

__all__ = list(_PLACES)
if not TYPE_CHECKING:  # or a checker takes any name for there
    __getattr__, __dir__ = lazy_face(__name__, _PLACES)
