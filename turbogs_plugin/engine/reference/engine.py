"""The torch engine: every result is defined here, on any device and in float32 or float64."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from turbogs_plugin.engine import shared
from turbogs_plugin.engine.moments import GaussianMoments
from turbogs_plugin.engine.reference.draws import draw_pixels
from turbogs_plugin.engine.reference.losses import sparse_loss
from turbogs_plugin.engine.reference.raster import ReferenceRendered, ReferenceScreenGradients, rasterize_reference
from turbogs_plugin.engine.reference.update import apply_update
from turbogs_plugin.engine.rendered import DEFAULT_SETTINGS, RasterSettings
from turbogs_plugin.engine.rules import DrawRule, LossTerms, UpdateRule
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.scene.photos import PhotoSamples
from turbogs_plugin.types import Cameras, Gaussians, GaussianStats, LossOutput, PixelSamples, Step


@dataclass(frozen=True)
class ReferenceEngine:
    """`Engine` in torch. It keeps nothing between calls and never loses an iteration."""

    def draw(self, rule: DrawRule, maps: ErrorMaps, view_ids: tuple[int, ...], rate: float, step: Step) -> PixelSamples:
        return draw_pixels(**shared.draw_arguments(rule, maps, view_ids, rate, step))

    def render(
        self,
        gaussians: Gaussians,
        cameras: Cameras,
        samples: PixelSamples,
        *,
        sh_degree: int | None = None,
        settings: RasterSettings = DEFAULT_SETTINGS,
        with_depth: bool = False,
    ) -> ReferenceRendered:
        return rasterize_reference(
            gaussians, cameras, samples, sh_degree=sh_degree, settings=settings, with_depth=with_depth
        )

    def evaluate(self, terms: LossTerms, colors: Tensor, targets: Tensor, samples: PixelSamples) -> LossOutput:
        return sparse_loss(colors, targets, samples, terms)

    def supervise(
        self,
        terms: LossTerms,
        colors: Tensor,
        truth: PhotoSamples,
        maps: ErrorMaps,
        step: Step,
        nonfinite_losses: Tensor | None = None,
    ) -> LossOutput:
        output = self.evaluate(terms, colors, truth.colors(), truth.samples)
        self.learn(maps, truth.samples, colors, output, step, nonfinite_losses)
        return output

    def learn(
        self,
        maps: ErrorMaps,
        samples: PixelSamples,
        colors: Tensor,
        output: LossOutput,
        step: Step,
        nonfinite_losses: Tensor | None = None,
    ) -> None:
        shared.learn(maps, samples, colors, output, step, nonfinite_losses)

    def update(
        self,
        rule: UpdateRule,
        screen: ReferenceScreenGradients,
        gaussians: Gaussians,
        moments: GaussianMoments,
        stats: GaussianStats | None,
    ) -> None:
        apply_update(rule, gaussians, screen.parameter_gradients(rule.per_view, stats), moments)

    def settle(self, wait: bool = False) -> int:
        return 0

    @property
    def bytes_held(self) -> int:
        return 0
