"""Checks of a gsplat trainer's parameters and `info`, with errors that name what was expected."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.errors import InputError, require
from turbogs_plugin.types import PARAMETER_NAMES, Gaussians
from turbogs_plugin.types.gaussians import ROW_SHAPES

Parameters = dict[str, torch.nn.Parameter] | torch.nn.ParameterDict
Optimizers = Mapping[str, torch.optim.Optimizer]
"""The optimizers of a host by the names of the parameters."""

PREDICTION, GROUND_TRUTH = "prediction", "ground_truth"
"""Keys of `info` under which a host puts its render and the ground truth."""

STATISTICS = "gaussian_stats"
"""Key under which `sparse_rasterization` leaves the pass's `GaussianStats`, once backward has run."""

GEOMETRY = ("means", "quats", "scales", "opacities")

ROLES = {"features_dc": "sh0", "features_rest": "shN", "colors": "sh0"}
"""Names that hosts have for gsplat's: splatfacto's, and colours where there are no harmonics."""

IN_IMAGES: dict[str, Any] = {
    **dict.fromkeys(("use_bilateral_grid", "use_fused_bilagrid", "depth_loss", "with_ut"), False),
    "post_processing": None,
    "camera_model": "pinhole",
}
"""Options of gsplat's trainer that need whole images or its own rasterizer, and the value that asks for nothing."""


def require_options(options: Any, nothing: Mapping[str, Any], swap: str) -> None:
    """Raise `InputError` where the options of a host (as gsplat's `Config`, or None) ask for what has no effect with a
    swap. nothing: name of an option -> the value that asks for nothing."""
    require(type(options) not in (dict, list, str, bool, int), "type of options", type(options), "gsplat's Config")
    for name, value in nothing.items():
        if (found := getattr(options, name, value)) != value:
            raise InputError(f"{name}={found!r} does not work with {swap}: leave it out")


def require_one_process(swap: str) -> None:
    """Raise `InputError` where the host trains in several processes.

    gsplat's distributed mode leaves ``means2d`` and its like from before the exchange between processes in `info`, and
    the tiles from after it. Copies of one model, as DDP keeps them, would be split and pruned differently in each.
    """
    distributed = torch.distributed
    if distributed.is_available() and distributed.is_initialized() and distributed.get_world_size() > 1:
        count = distributed.get_world_size()
        raise InputError(f"{swap} works in one process, this process group has {count}: train on one GPU")


def require_keys(mapping: Mapping[str, Any] | Parameters | None, keys: Iterable[str], what: str, remedy: str) -> None:
    """Raise `InputError` naming the `keys` that `mapping` (called `what`) lacks; None lacks all of them."""
    if mapping is None:
        raise InputError(f"{what} is None: {remedy}")
    missing = [key for key in keys if key not in mapping]
    if missing:
        raise InputError(f"{what} has no {', '.join(repr(key) for key in missing)}: {remedy}")


def role_of(name: str, params: Mapping[str, Any] | Parameters) -> str:
    """gsplat's name for a parameter of a host: by `ROLES`, where no other parameter has that name."""
    role = ROLES.get(name, name)
    return name if role in params else role


def host_gaussians(params: Mapping[str, Tensor] | Parameters, names: Iterable[str] = PARAMETER_NAMES) -> Gaussians:
    """A host's parameters as `Gaussians`. The tensors share memory with the parameters and have no gradient. A size
    of 1 may be there or not, as in nerfstudio's splatfacto.

    Args:
        params: name -> tensor.
        names: those that are needed; zeros stand in for another that is missing, as in a host with its own colours.

    Raises:
        InputError: a parameter is missing, or has another shape or another number of rows.
    """
    params = {role_of(name, params): value for name, value in params.items()}
    require_keys(params, names, "params", f"expected {', '.join(names)}")
    count = len(params["means"])
    values = dict.fromkeys(PARAMETER_NAMES, params["means"].new_zeros(count, 1, 3))
    for name in [name for name in PARAMETER_NAMES if name in params]:
        value = params[name].detach()
        row = ROW_SHAPES.get(name, (*value.shape[1:2], 3))
        if value.shape[:1] != (count,) or [size for size in value.shape[1:] if size != 1] != [s for s in row if s != 1]:
            expected = f"[{', '.join(map(str, ('N', *row)))}] with N = {count} as in 'means'"
            raise InputError(f"parameter '{name}' has shape {tuple(value.shape)}: expected {expected}")
        values[name] = value.view(count, *row)
    return Gaussians(**values)
