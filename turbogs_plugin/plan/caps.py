"""The cap on the number of Gaussians, which is the `max_gaussians` of the density control and nowhere else."""

from __future__ import annotations

import numpy as np

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.errors import InputError
from turbogs_plugin.types import Step

FEWEST_GAUSSIANS = 1000
"""Smallest number of Gaussians that can be a model of a capture."""


def cap_of(config: Config) -> int:
    """Most Gaussians of the finished model; 0: no cap."""
    return config.density.get("max_gaussians", 0)


def with_cap(config: Config, cap: int) -> Config:
    """The configuration with this cap.

    Raises:
        InputError: its density control keeps no cap.
    """
    if "max_gaussians" not in config.density:
        kind = config.density["type"]
        raise InputError(f"density.type {kind} keeps no cap on Gaussians: use one of error_driven, mcmc, none")
    return config.changed(density={"max_gaussians": cap})


def growth_room(config: Config) -> float:
    """How many times its cap a run may have while it grows.

    Args:
        config: with the run's iterations decided.
    """
    return config.build("density").growth_room(Step(0, config.train.written_iterations, config.train.refine_until))


def without_growth(config: Config) -> Config:
    """The configuration with the initial model, cut to the cap, in the place of one that grows to it."""
    return config.changed(density={"type": "none", "max_gaussians": cap_of(config)})


def require_room(model: str, count: int, cap: int, others: int) -> None:
    """Raise `InputError` where `count` Gaussians of a model's file and `others` are more than a cap (0: none)."""
    if cap and count + others > cap:
        raise InputError(
            f"'{model}' has {count} Gaussians, more than density.max_gaussians {cap} allows beside {others} of a "
            "backdrop: allow more, or start from points"
        )


def chosen_points(count: int, cap: int, others: int) -> slice | np.ndarray:
    """Which of `count` points a model begins with: all, or as many as leave room for `others` under a cap, evenly.

    Args:
        cap: most Gaussians; 0: no cap.
        others: Gaussians that are no points of the capture.

    Raises:
        InputError: there is no room.
    """
    if not cap or count + others <= cap:
        return slice(None)
    if cap <= others:
        raise InputError(
            f"density.max_gaussians {cap} leaves no room beside the {others} of the backdrop: allow more, or leave the "
            "backdrop out by train.backdrop=false"
        )
    return np.linspace(0, count - 1, cap - others).round().astype(np.int64)
