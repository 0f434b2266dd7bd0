"""Sparse pixels in a trainer of any model: views and pixels a step, error maps, true colours, and the loss."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from turbogs_plugin.engine import engine_of
from turbogs_plugin.engine.protocol import MapUpdate
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.errors import InputError, require
from turbogs_plugin.gsplat_bridge.host import IN_IMAGES, require_options
from turbogs_plugin.gsplat_bridge.host_views import read_items
from turbogs_plugin.strategies.checks import check_colors, check_samples
from turbogs_plugin.strategies.protocols import SparseLoss
from turbogs_plugin.types import LossOutput, PixelSamples, SamplingBudget, Step

DEFAULT_VIEWS, MOST_VIEWS = 4, 10
"""Views a step where a trainer leaves it open, between the 3 and 10 of turbogs' schedule (a quarter of one view's
pixels alone is less than stock sees); and views beyond which a step sees more pixels than one image has."""


def sparse_budget(num_views: int, batch_size: int | None = None, options: Any = None) -> SamplingBudget:
    """Views and rate of every step of a gsplat trainer with sparse pixels; prints in one line what it chose.

    A step sees as many pixels as one whole image has, as a stock trainer does at batch 1, spread over its K views:
    ``rate = 1 / K``, but no less than ``1 / MOST_VIEWS``.

    Args:
        num_views: V, training views.
        batch_size: K, where the trainer has settled it; None takes `DEFAULT_VIEWS`, or V if that is less.
        options: of the trainer, as gsplat's `Config`. Raises `InputError` for those that need whole images.
    """
    require_options(options, IN_IMAGES, "sparse pixels, which are no images")
    require(isinstance(num_views, Integral) and num_views >= 1, "num_views", num_views, "a whole number, 1 or more")
    views = min(DEFAULT_VIEWS, num_views) if batch_size is None else batch_size
    allowed = f"a whole number, 1 or more and at most num_views ({num_views})"
    require(isinstance(views, Integral) and 1 <= views <= num_views, "batch_size", views, allowed)
    rate = 1.0 / min(views, MOST_VIEWS)
    reason = "no batch_size is given" if batch_size is None else f"batch_size is {batch_size}"
    print(f"sparse_budget: {views} views a step, {rate:.0%} of the pixels of each ({reason}).")
    return SamplingBudget(int(views), rate)  # loaders refuse numpy's integers


def maps_of_photos(
    trainset: Sequence[dict[str, Any]], device: torch.device | str = "cpu", white: float = 255.0
) -> ErrorMaps:
    """Error maps of V training views, which start from the errors of a black prediction.

    Args:
        trainset: as `read_items` takes it, numbered as the trainer's image_id. Where items have a "mask", samplers draw
            no other pixel.
    """
    items, masks = read_items(trainset, "trainset", white, lambda image: torch.from_numpy(image).to(device))
    return ErrorMaps.from_images([item["image"].sum(dim=-1) / 255.0 for item in items], masks)


def gather_pixels(images: Tensor, samples: PixelSamples) -> Tensor:
    """[P, D] the pixels of images [C, H, W, D], one for each of the samples' views in their order; zero in empty slots.
    Differentiable. Raises `InputError` for images of another shape."""
    check_samples(samples)
    shape = tuple(images.shape) if isinstance(images, Tensor) else type(images).__name__
    expected = [(int(height), int(width)) for width, height in samples.sizes]
    if len(shape) != 4 or [shape[1:3]] * len(images) != expected:
        raise InputError(
            f"images have shape {shape}: expected a tensor [C, H, W, D] with H, W = {expected}, the images of the "
            "samples' views alone: images[view_ids] of those of all views"
        )
    flat = images.flatten(0, 2)  # [C * H * W, D]
    pixels = samples.view_of_slot() * (images.shape[1] * images.shape[2]) + samples.pixel_ids.long().clamp(min=0)
    return torch.where(samples.filled[:, None], flat[pixels], 0)


def sparse_loss(
    loss: SparseLoss,
    colors: Tensor,
    targets: Tensor,
    samples: PixelSamples,
    maps: ErrorMaps | None = None,
    step: Step | None = None,
) -> Tensor:
    """A `SparseLoss` as a scalar that `backward` can be called on: its own gradient is handed to autograd.

    Args:
        loss: an instance, such as ``CharbonnierNccLoss()``, or any function of colours, targets and samples that gives
            a `LossOutput`.
        colors, targets: [P, 3] float.
        maps, step: given both, `maps` takes in the samples' errors as visited at `step`, in the same launch where a
            kernel computes the loss. A sample whose colour or error is not finite changes nothing there.

    Raises:
        InputError: `loss` is something else, as torch's are; or an argument does not fit the samples.
    """
    check_colors(colors, targets, samples)
    given, engine = (colors.detach(), targets.detach(), samples), engine_of(colors.device)
    if maps is None and step is None:
        return _Loss.apply(colors, _called(loss, *given))
    if not isinstance(maps, ErrorMaps) or not isinstance(step, Step):
        found = f"{type(maps).__name__} and {type(step).__name__}"
        raise InputError(f"maps and step are {found}: expected ErrorMaps and a Step, both or neither")
    if maps.errors.device != colors.device:
        raise InputError(f"maps are on {maps.errors.device}: expected {colors.device} as colors")
    update = MapUpdate(maps, step)
    terms = loss.terms if "terms" in dir(loss) and not isinstance(loss, type) else None
    if terms is not None:
        return _Loss.apply(colors, engine.evaluate_and_learn(terms, *given, update))
    output = _called(loss, *given)
    engine.learn(samples, given[0], output, update)
    return _Loss.apply(colors, output)


def _called(loss: Any, colors: Tensor, targets: Tensor, samples: PixelSamples) -> LossOutput:
    """The output of a loss on samples. Raises `InputError` where `loss` is a class, or gives no `LossOutput`."""
    found = f"the class {loss.__name__}" if isinstance(loss, type) else f"a {type(loss).__name__}"
    try:
        output = None if isinstance(loss, type) else loss(colors, targets, samples)
    except TypeError as error:  # a loss of whole images takes two
        raise InputError(f"loss takes no (colors, targets, samples), as CharbonnierNccLoss() does: {error}") from error
    if not isinstance(output, LossOutput):
        raise InputError(f"loss is {found}: expected an instance like CharbonnierNccLoss(), which gives a LossOutput")
    return output


class _Loss(torch.autograd.Function):
    @staticmethod
    def forward(ctx, colors: Tensor, output: LossOutput) -> Tensor:
        ctx.save_for_backward(output.color_gradients)
        return output.loss.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream: Tensor):
        (gradients,) = ctx.saved_tensors
        return upstream * gradients, None
