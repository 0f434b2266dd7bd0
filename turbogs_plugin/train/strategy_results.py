"""Checks of what a strategy returned, where a mistake can still be named: a class of one's own may return anything."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from turbogs_plugin.errors import InputError
from turbogs_plugin.types import LossOutput, PixelSamples


def require_samples(samples: Any, view_ids: Sequence[int], name: str) -> None:
    """Raise `InputError` unless `samples` are `PixelSamples` of these views, in this order: photos and error maps of
    other views would be compared with the renders of these.

    Args:
        view_ids: [K] training views that were asked for.
        name: type of the pixel sampler.
    """
    if not isinstance(samples, PixelSamples):
        raise InputError(f"pixel_sampler.type '{name}' returned {_described(samples)}, not PixelSamples")
    if samples.view_ids != tuple(view_ids):
        raise InputError(
            f"pixel_sampler.type '{name}' returned samples of views {samples.view_ids}, asked for {tuple(view_ids)}: "
            "give view_ids to PixelSamples, or to from_mask and from_coordinates"
        )


def require_output(output: Any, colors: Tensor, name: str) -> None:
    """Raise `InputError` unless `output` is a `LossOutput` for these colours [P, 3], with tensors of its shapes.

    Args:
        name: type of the loss.
    """
    if not isinstance(output, LossOutput):
        raise InputError(f"loss.type '{name}' returned {_described(output)}, not a LossOutput")
    shapes = {"loss": (), "color_gradients": tuple(colors.shape), "pixel_errors": (len(colors),)}
    for field, shape in shapes.items():
        value = getattr(output, field)
        if not isinstance(value, Tensor) or value.shape != shape:
            raise InputError(
                f"loss.type '{name}' returned {_described(value)} as {field}, not a tensor of shape {shape}"
            )


def _described(value: Any) -> str:
    return f"a tensor of shape {tuple(value.shape)}" if isinstance(value, Tensor) else f"'{type(value).__name__}'"
