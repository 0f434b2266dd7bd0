"""The torch engine, the definition of every result, on any device and in float32 or float64."""

from __future__ import annotations

from turbogs_plugin.engine.reference.draws import draw_pixels
from turbogs_plugin.engine.reference.losses import sparse_loss
from turbogs_plugin.engine.reference.raster import rasterize_reference, screen_gradients
from turbogs_plugin.engine.shared import SharedEngine


class ReferenceEngine(SharedEngine):
    """`Engine` in torch. It keeps nothing between calls and never loses an iteration."""

    draw = staticmethod(draw_pixels)
    render = staticmethod(rasterize_reference)
    screen_gradients = staticmethod(screen_gradients)
    evaluate = staticmethod(sparse_loss)
