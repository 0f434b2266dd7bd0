"""Checks of a gsplat trainer's parameters and `info`, with errors that name what was expected."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.errors import InputError
from turbogs_plugin.types import PARAMETER_NAMES, Gaussians

Parameters = dict[str, torch.nn.Parameter] | torch.nn.ParameterDict
Optimizers = Mapping[str, torch.optim.Optimizer]
"""The optimizers of a host by the names of the parameters."""

PREDICTION, GROUND_TRUTH = "prediction", "ground_truth"
"""Keys of `info` under which a host puts its render and the ground truth."""

STATISTICS = "gaussian_stats"
"""Key under which `sparse_rasterization` leaves the pass's `GaussianStats` once backward has run."""

LOSS_SHARES = "loss_shares"
"""Key under which `sparse_rasterization` leaves [N] the Gaussians' shares of the loss once backward has run."""

LAYOUTS: dict[str, list[tuple[str | int, ...]]] = {
    "means": [("N", 3)],
    "quats": [("N", 4)],
    "scales": [("N", 3)],
    "opacities": [("N",), ("N", 1)],
    "sh0": [("N", 1, 3), ("N", 3)],
    "shN": [("N", "B", 3)],
}
"""Shapes of each parameter, N Gaussians with B harmonics above band 0: gsplat's, then nerfstudio's splatfacto's, which
is taken too."""

ROLES = {"features_dc": "sh0", "features_rest": "shN", "colors": "sh0"}
"""Names that hosts have for gsplat's: splatfacto's, and colours where there are no harmonics."""

GEOMETRY = ("means", "quats", "scales", "opacities")


IN_IMAGES: dict[str, Any] = {
    **dict.fromkeys(("use_bilateral_grid", "use_fused_bilagrid", "depth_loss", "with_ut"), False),
    "post_processing": None,
    "camera_model": "pinhole",
}
"""Options of gsplat's trainer that need whole images or its own rasterizer, and the value that asks for nothing."""


def require_options(options: Any, nothing: Mapping[str, Any], swap: str) -> None:
    """Raise `InputError` where the options of a host ask for something that has no effect with a swap.

    Args:
        options: with attributes, as gsplat's `Config`; None: there are none.
        nothing: name of an option -> the value that asks for nothing.
    """
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
        raise InputError(
            f"{swap} works in one process, this process group has {distributed.get_world_size()}: train on one GPU, or "
            "keep gsplat's own part there"
        )


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
    """A host's parameters as `Gaussians`. The tensors share memory with the parameters and have no gradient.

    Args:
        params: name -> tensor.
        names: those that are needed; where one of the others is missing, as in a host with its own colour model,
            zeros stand in for it.

    Raises:
        InputError: a parameter is missing, or has another shape than in gsplat's layout (opacities [N, 1] and sh0
            [N, 3] are taken, too), or another number of rows.
    """
    params = {role_of(name, params): value for name, value in params.items()}
    require_keys(params, names, "params", f"expected {', '.join(names)}")
    count = params["means"].shape[0]
    for name in [name for name in PARAMETER_NAMES if name in params]:
        shape = tuple(params[name].shape)
        sizes: dict[Any, int | None] = {"N": count, "B": shape[1] if len(shape) > 1 else None}
        if shape not in [tuple(sizes.get(size, size) for size in layout) for layout in LAYOUTS[name]]:
            expected = ", ".join(map(str, LAYOUTS[name][0]))
            raise InputError(
                f"parameter '{name}' has shape {shape}: expected [{expected}] with N = {count} as in 'means'"
            )
    absent = params["means"].new_zeros(count, 1, 3)
    values = {name: params[name].detach() if name in params else absent for name in PARAMETER_NAMES}
    values["opacities"], values["sh0"] = values["opacities"].view(count), values["sh0"].view(count, 1, 3)
    return Gaussians(**values)
