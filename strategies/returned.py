"""What a strategy returned: each check raises `InputError`, which names the strategy and the remedy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.errors import InputError
from turbogs_plugin.strategies.protocols import DensityController, PixelSampler, SparseLoss
from turbogs_plugin.types import PARAMETER_NAMES, Gaussians, LossOutput, PixelSamples, RowUpdate


def require_type(value: object, kind: type, strategy: object) -> None:
    """Raise `InputError` unless what a strategy returned is of this type."""
    if not isinstance(value, kind):
        raise InputError(f"{type(strategy).__name__} returned {type(value).__name__}, not {kind.__name__}")


def require_samples(samples: PixelSamples, view_ids: Sequence[int], sizes: np.ndarray, sampler: PixelSampler) -> None:
    """Raise `InputError` unless `samples` are of these views in this order, and of their `sizes` [K, 2]."""
    require_type(samples, PixelSamples, sampler)
    for what, found, wanted in (("view_ids", samples.view_ids, view_ids), ("sizes", samples.sizes, sizes)):
        if not np.array_equal(found, wanted):
            said = f"returned samples with {what} {np.array(found).tolist()}, not {np.array(wanted).tolist()}"
            raise InputError(f"{type(sampler).__name__} {said}: give view_ids, and masks [K, H, W], to from_mask")
    ids, weights = samples.pixel_ids, samples.weights
    if weights is not None and weights.shape != ids.shape:
        raise InputError(f"{type(sampler).__name__} returned {len(weights)} weights for {len(ids)} slots")
    if ids.device.type == "cpu" and (beyond := ids >= torch.from_numpy(sizes.prod(1))[samples.view_of_slot()]).any():
        raise InputError(f"{type(sampler).__name__} returned pixel {ids[beyond][0]} beyond a view: {sizes.tolist()}")


def require_rows(update: RowUpdate, controller: DensityController, gaussians: Gaussians) -> None:
    """Raise `InputError` unless the parts of a change of these rows fit together."""
    require_type(update, RowUpdate, controller)
    old_count, shapes = len(gaussians), {name: value.shape[1:] for name, value in gaussians.items()}
    count, kind = len(update.source), update.source.dtype
    wrong = [f"values of {name}" for name in (*update.values, *update.reset) if name not in PARAMETER_NAMES]
    for name, value in update.values.items():
        found, wanted = (value.dtype, *value.shape), (gaussians.means.dtype, count, *shapes.get(name, value.shape[1:]))
        wrong += [f"values of {name} of {found}, not {wanted}"] if found != wanted else []
    if update.fresh.shape != (count,) or update.fresh.dtype != torch.bool:
        wrong.append(f"fresh of {len(update.fresh)} rows of {update.fresh.dtype}")
    if kind != torch.int64:
        wrong.append(f"source of {kind}")
    elif count:
        least, most = torch.stack(update.source.aminmax()).tolist()  # one wait for a GPU; an event has others
        wrong += [f"source {least} .. {most} of {old_count} old rows"] if least < 0 or most >= old_count else []
    if wrong:
        said = f"{type(controller).__name__} returned a RowUpdate of {count} rows with {wrong[-1]}"
        raise InputError(f"{said}: source has old rows, as of torch.nonzero; fresh and parameters' values as many")


def require_stats(controller: DensityController, count: int) -> None:
    """Raise `InputError` unless the controller's statistics have a row for each of `count` Gaussians."""
    stats = controller.stats
    if stats is not None and (found := len(stats.weight_sums)) != count:
        remedy = "in apply(self, update), self.stats = self.stats.map(update.apply_state)"
        raise InputError(f"{type(controller).__name__}.stats has {found} rows for {count} Gaussians: {remedy}")


def require_output(output: LossOutput, colors: Tensor, loss: SparseLoss) -> None:
    """Raise `InputError` unless the shapes of a `LossOutput` fit colours [P, 3]."""
    require_type(output, LossOutput, loss)
    shapes = {"loss": (), "color_gradients": tuple(colors.shape), "pixel_errors": (len(colors),)}
    for field, shape in shapes.items():
        value = getattr(output, field)
        require_type(value, Tensor, loss)
        if (found := tuple(value.shape)) != shape:
            raise InputError(f"{type(loss).__name__} returned {field} of shape {found}, not {shape}")
