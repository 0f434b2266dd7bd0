"""The configuration of a run: dataclasses <- YAML <- dotted overrides.

A YAML has one section a part. Sections of our own (`scene`, `train`, `maps`, `raster`, `report`, `plan`, `budget`)
hold the fields of the dataclass below; a section of a strategy holds its ``type`` and the fields of that strategy's
dataclass. Defaults live in those dataclasses and nowhere else. ``base: NAME_OR_FILE`` puts a YAML on top of another.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from importlib import resources
from pathlib import Path
from typing import Any, Literal

from omegaconf import OmegaConf

from turbogs_plugin.config import registry
from turbogs_plugin.config.schema import build_dataclass, dataclass_mapping, nearest
from turbogs_plugin.config.units import parse_bytes, parse_seconds
from turbogs_plugin.config.yaml_text import parse_yaml, read_yaml
from turbogs_plugin.engine.rendered import RasterSettings
from turbogs_plugin.errors import InputError, require, require_not_negative

DEFAULT_CONFIG = "turbogs"
"""The packaged configuration that a run without ``--config`` takes."""

BASE_DEPTH_LIMIT = 8
LONGEST_TIME = 100 * 3600.0
"""Seconds of a time budget: the iterations that fit can be counted (less than 2^31) even where one takes 0.2 ms."""


@dataclass
class SceneConfig:
    """Which photos.

    Args:
        path: the capture's folder; the command line sets it.
        factor: photos are scaled down by this.
        test_every: every n-th image in name order tests.
    """

    path: str = ""
    factor: int = 1
    test_every: int = 8

    def __post_init__(self) -> None:
        require(self.factor >= 1, "factor", self.factor, "at least 1")
        require(self.test_every >= 2, "test_every", self.test_every, "at least 2")


@dataclass
class TrainConfig:
    """The run itself.

    Args:
        iterations: T.
        refine_until: tau_until, the last iteration of density control, which also ends the annealing of the sampling.
        seed: of all randomness.
        device: auto (CUDA where there is one), cpu, or cuda.
        sh_degree: highest degree of the spherical harmonics.
        sh_interval: iterations between two bands; the run starts with band 0.
        initial_opacity, initial_size: of the Gaussians that training starts with; the size in mean distances to the
            three nearest points. 3DGS has 0.1 and 1, gsplat's MCMC preset 0.5 and 0.1.
        backdrop: start with a far sphere of Gaussians in the photos' mean colour behind the scene.
        distant_size: largest standard deviation of a Gaussian beyond 2 scene extents, over its distance from the
            cameras (`restrain_distant`). 0: no bound.
        evaluate_at: when to evaluate, as fractions of T; the start and the end are always evaluated.
        checkpoint_every: iterations between checkpoints; the end always has one. 0: only the end.
    """

    iterations: int = 5000
    refine_until: int = 3500
    seed: int = 0
    device: str = "auto"
    sh_degree: int = 3
    sh_interval: int = 1000
    initial_opacity: float = 0.1
    initial_size: float = 1.0
    backdrop: bool = False
    distant_size: float = 0.0
    evaluate_at: tuple[float, ...] = (0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
    checkpoint_every: int = 2500

    def __post_init__(self) -> None:
        require(1 <= self.iterations < 2**31, "iterations", self.iterations, "within 1 .. 2^31 - 1")
        require(self.refine_until >= 0, "refine_until", self.refine_until, "at least 0")
        require(0 <= self.seed < 2**31, "seed", self.seed, "within 0 .. 2^31 - 1")
        require(self.device in ("auto", "cpu", "cuda"), "device", self.device, "auto, cpu or cuda")
        require(0 <= self.sh_degree <= 3, "sh_degree", self.sh_degree, "within 0 .. 3")
        require(self.sh_interval >= 1, "sh_interval", self.sh_interval, "at least 1")
        require(0 < self.initial_opacity < 1, "initial_opacity", self.initial_opacity, "more than 0 and less than 1")
        require(0 < self.initial_size <= 100, "initial_size", self.initial_size, "more than 0 and at most 100")
        require_not_negative(self, "distant_size")
        for value in self.evaluate_at:
            require(0 < value <= 1, "evaluate_at", value, "fractions within (0, 1]")
        require(self.checkpoint_every >= 0, "checkpoint_every", self.checkpoint_every, "at least 0")

    def evaluation_iterations(self) -> set[int]:
        """Counts of finished iterations after which to evaluate."""
        return {0, self.iterations, *(max(1, round(part * self.iterations)) for part in self.evaluate_at)}

    def sh_degree_at(self, iteration: int) -> int:
        """Degree of the bands in use at an iteration."""
        return min(self.sh_degree, iteration // self.sh_interval)


@dataclass
class MapsConfig:
    """The error maps. `beta`: EMA weight of a new error."""

    beta: float = 0.4

    def __post_init__(self) -> None:
        require(0 < self.beta <= 1, "beta", self.beta, "within (0, 1]")


@dataclass
class ReportConfig:
    """The report.

    Args:
        lpips_weights: a local file with the backbone's weights (torchvision's VGG16), or null: LPIPS is not computed.
        strips: test views shown as pictures, at most.
    """

    lpips_weights: str | None = None
    strips: int = 8

    def __post_init__(self) -> None:
        require(self.strips >= 0, "strips", self.strips, "at least 0")


@dataclass
class PlanConfig:
    """What the plan of a run may decide by looking at scene and machine (`turbogs_plugin.plan`).

    ``auto`` leaves it to the plan, ``keep`` leaves the settings as they are elsewhere in the configuration, and a value
    forces it. A YAML or override that gives such a setting itself turns the decision about it, made below it, to
    ``keep`` (`PLANNED_SETTINGS`): what one says, no plan changes.

    Args:
        backdrop: `train.backdrop`.
        ncc: whether the loss has its structure term (true), or is Charbonnier alone (false).
        views: ``all``: every training view in every iteration, with no schedule and no selection.
        sh_degree: `train.sh_degree`.
        optimizer: `optimizer.type`.
        iterations: `train.iterations`, with all that counts iterations. ``auto``: as many as make `looks`.
        looks: at each training pixel in the mean, which is iterations times images an iteration over views.
        maps_on: where error and age maps are: on the device, or in pinned memory of the host. It changes no result.
        photos_on: the same of the photos.
    """

    backdrop: bool | Literal["auto", "keep"] = "keep"
    ncc: bool | Literal["auto", "keep"] = "keep"
    views: Literal["auto", "keep", "all"] = "keep"
    sh_degree: int | Literal["auto", "keep"] = "keep"
    optimizer: Literal["auto", "keep", "moment_lm", "sparse_adam"] = "keep"
    iterations: int | Literal["auto", "keep"] = "keep"
    looks: float = 60.0
    maps_on: Literal["auto", "device", "host"] = "auto"
    photos_on: Literal["auto", "device", "host"] = "auto"

    def __post_init__(self) -> None:
        if self.sh_degree not in ("auto", "keep"):
            require(0 <= self.sh_degree <= 3, "sh_degree", self.sh_degree, "within 0 .. 3")
        if self.iterations not in ("auto", "keep"):
            require(1 <= self.iterations < 2**31, "iterations", self.iterations, "within 1 .. 2^31 - 1")
        require(math.isfinite(self.looks) and self.looks > 0, "looks", self.looks, "a finite number above 0")


PLANNED_SETTINGS: dict[str, tuple[str, ...]] = {
    "backdrop": ("train.backdrop",),
    "ncc": ("loss.type", "loss.ncc_weight", "loss.structure", "loss.gate"),
    "views": ("schedule.type", "schedule.min_views", "schedule.max_views", "schedule.views", "view_sampler.type"),
    "sh_degree": ("train.sh_degree",),
    "iterations": ("train.iterations",),
    "optimizer": ("optimizer.type", "optimizer.units", "optimizer.rows", "optimizer.curvature", "optimizer.max_step"),
}
"""Decision of `PlanConfig` -> the settings it is about."""


@dataclass
class BudgetConfig:
    """What the run may take (`turbogs_plugin.plan.budget`).

    Args:
        max_gaussians: never more than this; 0: no cap.
        max_memory: of the device, for instance 2GiB; empty: no limit.
        time: seconds of training to end after, for instance 20s or 2m; empty: `train.iterations` decide.
    """

    max_gaussians: int = 0
    max_memory: str = ""
    time: str = ""

    def __post_init__(self) -> None:
        require(self.max_gaussians >= 0, "max_gaussians", self.max_gaussians, "at least 0")
        self.memory_bytes()
        require((self.seconds() or 0.0) <= LONGEST_TIME, "time", self.time, "at most 100h")

    def memory_bytes(self) -> int | None:
        """`max_memory`, or None for no limit. Raises `InputError` where it is no amount."""
        return parse_bytes(self.max_memory) if self.max_memory else None

    def seconds(self) -> float | None:
        """`time`, or None for no limit. Raises `InputError` where it is no amount."""
        return parse_seconds(self.time) if self.time else None


@dataclass
class Config:
    """Everything that decides a run. The strategies' sections are complete: `type` and every init field."""

    scene: SceneConfig
    train: TrainConfig
    schedule: dict[str, Any]
    view_sampler: dict[str, Any]
    pixel_sampler: dict[str, Any]
    loss: dict[str, Any]
    density: dict[str, Any]
    optimizer: dict[str, Any]
    maps: MapsConfig
    raster: RasterSettings
    report: ReportConfig = field(default_factory=ReportConfig)
    plan: PlanConfig = field(default_factory=PlanConfig)
    budget: BudgetConfig = field(default_factory=BudgetConfig)

    def build(self, kind: str) -> Any:
        """A new strategy of this kind."""
        return registry.build(kind, getattr(self, kind))

    def to_mapping(self) -> dict[str, Any]:
        """Plain YAML values, every field written out, in sections that may be changed."""
        return {
            section.name: dict(getattr(self, section.name))
            if section.name in registry.KINDS
            else dataclass_mapping(getattr(self, section.name))
            for section in fields(self)
        }

    def to_yaml(self) -> str:
        """The resolved configuration: read back, it gives this very configuration."""
        return OmegaConf.to_yaml(OmegaConf.create(self.to_mapping()))


SECTION_CLASSES = {
    "scene": SceneConfig,
    "train": TrainConfig,
    "maps": MapsConfig,
    "raster": RasterSettings,
    "report": ReportConfig,
    "plan": PlanConfig,
    "budget": BudgetConfig,
}


def config_names() -> list[str]:
    """Names of the configurations that come with TurboGS."""
    folder = resources.files("turbogs_plugin.configs")
    return sorted(entry.name[: -len(".yaml")] for entry in folder.iterdir() if entry.name.endswith(".yaml"))


def load_config(name_or_file: str = DEFAULT_CONFIG, overrides: Sequence[str] = ()) -> Config:
    """The configuration of a packaged name or a YAML file, with overrides ``section.key=value`` on top.

    Raises:
        InputError: an unknown name, an unreadable file, an unknown key or type (naming the nearest), a wrong type of
            a value, or one out of range.
    """
    return resolve(apply_overrides(_load_mapping(name_or_file), overrides))


def resolve(mapping: Mapping[str, Any]) -> Config:
    """The complete, checked configuration of a mapping of sections; absent sections have their defaults."""
    for section in mapping:
        if section not in SECTION_CLASSES and section not in registry.KINDS:
            raise InputError(f"unknown section '{section}': {nearest(section, [*SECTION_CLASSES, *registry.KINDS])}")
    sections: dict[str, Any] = {
        name: build_dataclass(cls, mapping.get(name, {}), name) for name, cls in SECTION_CLASSES.items()
    }
    for kind in registry.KINDS:
        section = mapping.get(kind, {})
        strategy = registry.build(kind, section)
        sections[kind] = {"type": section.get("type", registry.default_type(kind)), **dataclass_mapping(strategy)}
    return Config(**sections)


def resolve_complete(mapping: Mapping[str, Any], where: str) -> Config:
    """`resolve` of a mapping that `Config.to_mapping` made. Raises `InputError` where a part of it is missing."""
    config = resolve(mapping)
    missing = _first_missing(config.to_mapping(), mapping)
    if missing:
        raise InputError(f"'{where}' lacks '{missing}', which this version writes: bring the file back, or train anew")
    return config


def _first_missing(complete: Mapping[str, Any], given: Mapping[str, Any]) -> str:
    """Dotted place of the first key that is not given; empty where all are."""
    for key, value in complete.items():
        if key not in given:
            return key
        below = _first_missing(value, given[key]) if isinstance(value, Mapping) else ""
        if below:
            return f"{key}.{below}"
    return ""


def apply_overrides(mapping: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """`mapping` with ``section.key=value`` on top; a new ``section.type=name`` starts that section afresh."""
    result, named = dict(mapping), set()
    for override in sorted(overrides, key=lambda text: ".type=" not in text):  # types first, the rest in order
        path, separator, text = override.partition("=")
        keys = path.strip().split(".")
        if not separator or len(keys) < 2 or not all(keys):
            raise InputError(f"override '{override}' is not of the form section.key=value")
        parsed = parse_yaml(f"value: {text}", override)
        if set(parsed) != {"value"}:
            raise InputError(f"override '{override}' has more than one value")
        nested = parsed["value"]
        for key in reversed(keys):
            nested = {key: nested}
        result = _merge(result, nested)
        named.add(".".join(keys[:2]))
    return _yield_plan(result, named)


def _load_mapping(name_or_file: str, depth: int = 0) -> dict[str, Any]:
    if depth > BASE_DEPTH_LIMIT:
        raise InputError(f"config '{name_or_file}': its bases form a circle")
    if name_or_file in config_names():
        text = (resources.files("turbogs_plugin.configs") / f"{name_or_file}.yaml").read_text(encoding="utf-8")
        mapping = parse_yaml(text, name_or_file)
    elif Path(name_or_file).suffix in (".yaml", ".yml") or Path(name_or_file).is_file():
        mapping = read_yaml(Path(name_or_file))
    else:
        raise InputError(f"unknown config '{name_or_file}': {nearest(name_or_file, config_names())}, or a .yaml file")
    base = mapping.pop("base", None)
    if base is None:
        return mapping
    named = {f"{section}.{key}" for section, value in mapping.items() if isinstance(value, Mapping) for key in value}
    return _yield_plan(_merge(_load_mapping(str(base), depth + 1), mapping), named)


def _yield_plan(merged: dict[str, Any], named: set[str]) -> dict[str, Any]:
    """`merged`, with no plan for what its uppermost layer says itself.

    Args:
        named: ``section.key`` of everything in that layer.
    """
    plan = merged.get("plan")
    if not isinstance(plan, Mapping):
        return merged
    kept = {
        decision: "keep"
        for decision, settings in PLANNED_SETTINGS.items()
        if decision in plan and f"plan.{decision}" not in named and not named.isdisjoint(settings)
    }
    return {**merged, "plan": {**plan, **kept}}


def _merge(under: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`over` on top of `under`, mapping by mapping. Options of another type do not carry over."""
    result = dict(under)
    for key, value in over.items():
        below = result.get(key)
        if isinstance(below, Mapping) and isinstance(value, Mapping):
            result[key] = dict(value) if _changes_type(key, below, value) else _merge(below, value)
        else:
            result[key] = value
    return result


def _changes_type(section: str, below: Mapping[str, Any], value: Mapping[str, Any]) -> bool:
    if section not in registry.KINDS or "type" not in value:
        return False
    return value["type"] != below.get("type", registry.default_type(section))
