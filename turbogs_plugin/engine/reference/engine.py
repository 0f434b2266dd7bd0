"""The torch engine: every result is defined here, on any device and in float32 or float64."""

from __future__ import annotations

from turbogs_plugin.engine.moments import GaussianMoments
from turbogs_plugin.engine.protocol import Engine
from turbogs_plugin.engine.reference.draws import draw_pixels
from turbogs_plugin.engine.reference.losses import sparse_loss
from turbogs_plugin.engine.reference.raster import ReferenceScreenGradients, rasterize_reference
from turbogs_plugin.engine.reference.update import apply_update
from turbogs_plugin.engine.rules import UpdateRule
from turbogs_plugin.types import Gaussians, GaussianStats


class ReferenceEngine(Engine):
    """`Engine` in torch. It keeps nothing between calls and never loses an iteration."""

    draw = staticmethod(draw_pixels)
    render = staticmethod(rasterize_reference)
    evaluate = staticmethod(sparse_loss)

    def update(
        self,
        rule: UpdateRule,
        screen: ReferenceScreenGradients,
        gaussians: Gaussians,
        moments: GaussianMoments,
        stats: GaussianStats | None,
    ) -> None:
        apply_update(rule, gaussians, screen.parameter_gradients(rule.per_view, stats), moments)
