"""Names of strategies to classes: our own, and those that others register by entry point.

A third party adds to its ``pyproject.toml``::

    [project.entry-points."turbogs.pixel_sampler"]
    my_sampler = "my_package.samplers:MySampler"

and a YAML names it by ``pixel_sampler: {type: my_sampler, ...}``. Without a package, a YAML names the class itself,
``pixel_sampler: {type: my_samplers:MySampler, ...}``; the module may be a file in the current folder. Nothing is
imported before it is named.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from turbogs_plugin.config.schema import build_dataclass, nearest
from turbogs_plugin.errors import InputError
from turbogs_plugin.strategies import protocols

BUILT_IN: dict[str, dict[str, str]] = {
    "schedule": {
        "sinusoidal": "SinusoidalSchedule",
        "linear": "LinearSchedule",
        "exponential": "ExponentialSchedule",
        "fixed": "FixedSchedule",
    },
    "view_sampler": {"geometry_aware": "GeometryAwareViewSampler", "random": "RandomViewSampler"},
    "pixel_sampler": {
        "error_guided": "ErrorGuidedPixelSampler",
        "random": "RandomPixelSampler",
        "dense": "DensePixelSampler",
    },
    "loss": {
        "charbonnier_ncc": "CharbonnierNccLoss",
        "charbonnier": "CharbonnierLoss",
        "sparse_ssim": "SparseSsimLoss",
    },
    "density": {
        "error_driven": "ErrorDrivenDensity",
        "none": "NoDensity",
        "gsplat_default": "GsplatDefaultDensity",
        "mcmc": "GsplatMcmcDensity",
        "fastgs": "FastGsDensity",
    },
    "optimizer": {"moment_lm": "MomentLMOptimizer", "sparse_adam": "SparseAdam", "adam": "DenseAdam"},
}
"""Kind -> name -> class of `turbogs_plugin.strategies`. The first of a kind is the one that a config without that
section gets."""

KINDS = tuple(BUILT_IN)


class MissingStrategyError(InputError):
    """A strategy's class cannot be imported here."""


PROTOCOLS: dict[str, type] = {
    "schedule": protocols.SamplingSchedule,
    "view_sampler": protocols.ViewSampler,
    "pixel_sampler": protocols.PixelSampler,
    "loss": protocols.SparseLoss,
    "density": protocols.DensityController,
    "optimizer": protocols.GaussianOptimizer,
}


def known_types(kind: str) -> dict[str, str]:
    """Every name of a kind -> "module:class". A name of ours cannot be taken over by an entry point."""
    return {point.name: point.value for point in entry_points(group=f"turbogs.{kind}")} | _own_types(kind)


def _own_types(kind: str) -> dict[str, str]:
    return {name: f"turbogs_plugin.strategies:{found}" for name, found in BUILT_IN[kind].items()}


def default_type(kind: str) -> str:
    """The name that a config without a section of this kind gets."""
    return next(iter(BUILT_IN[kind]))


def strategy_class(kind: str, name: str) -> type:
    """The class behind a name, or the class ``module:Class`` itself.

    Raises:
        InputError: an unknown name (naming the nearest and all that are known), one whose module cannot be imported,
            or one of something else than a dataclass.
    """
    known = _own_types(kind)
    if isinstance(name, str) and ":" in name:
        known = {name: name}
        if not {"", os.getcwd()} & {*sys.path}:
            sys.path.append(os.getcwd())  # last, so that a file here hides no installed module
    elif isinstance(name, str) and name not in known:
        known = known_types(kind)  # which reads the files of every installed package
    if not isinstance(name, str) or name not in known:
        raise InputError(f"unknown {kind}.type '{name}': {nearest(name, known)}")
    place = f"{kind}.type '{name}' ({known[name]})"
    try:
        found = EntryPoint(name, known[name], f"turbogs.{kind}").load()
    except (Exception, SystemExit) as error:  # another's module can do anything as it is imported
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        if isinstance(error, ModuleNotFoundError):
            reason += "; call this in the folder that the module lies in, name that in PYTHONPATH, or install it"
        raise MissingStrategyError(f"{place} cannot be imported: {reason}") from error
    if not (isinstance(found, type) and is_dataclass(found)):
        raise InputError(f"{place} is not a dataclass, whose init fields would be its configuration")
    return found


def build(kind: str, mapping: Mapping[str, Any]) -> Any:
    """A new strategy from ``{"type": name, **its init fields}``.

    Raises:
        InputError: an unknown kind, type or key, a wrong type of a value, one out of range, or a class without what
            its kind's protocol has.
    """
    if kind not in BUILT_IN:
        raise InputError(f"unknown kind of strategy '{kind}': {nearest(kind, KINDS)}")
    if not isinstance(mapping, Mapping):
        raise InputError(f"{kind}: expected a mapping with a 'type', got {mapping!r}")
    options = dict(mapping)
    chosen = options.pop("type", default_type(kind))
    strategy = build_dataclass(strategy_class(kind, chosen), options, kind)
    # An attribute is there, or will be as a field of run-time state. Nothing is read: that may need `setup`.
    present = {*dir(strategy), *(field.name for field in fields(strategy))}
    members = {name: value for name, value in vars(PROTOCOLS[kind]).items() if name[0] != "_" or name == "__call__"}
    missing = []
    for name, default in members.items():
        if name not in present and not callable(default) and not isinstance(default, property):
            object.__setattr__(strategy, name, default)  # of a class that does not inherit from the protocol
        elif name not in present:
            missing.append(name)
    if missing:
        raise InputError(
            f"{kind}.type '{chosen}' ({known_types(kind).get(chosen, chosen)}) is no {PROTOCOLS[kind].__name__}: "
            f"it lacks {', '.join(missing)}"
        )
    return strategy
