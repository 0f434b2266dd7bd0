"""The configuration of a run: dataclasses <- YAML <- dotted overrides.

A YAML has one section a part. Sections of our own (`scene`, `train`, `maps`, `raster`, `report`, `budget`) hold the
fields of a dataclass of `turbogs_plugin.config.sections`; a section of a strategy holds its ``type`` and the fields of
that strategy's dataclass. Defaults live in those dataclasses and nowhere else. ``base: NAME_OR_FILE`` puts a YAML on
top of another; a file is looked for beside it. Some settings may be ``auto`` (`turbogs_plugin.config.auto`): the plan
of a run decides them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from pathlib import Path
from typing import Any, get_type_hints

from omegaconf import OmegaConf

from turbogs_plugin.config import registry
from turbogs_plugin.config.auto import AUTO, AUTO_SETTINGS, undecided
from turbogs_plugin.config.old_spellings import old_spelling
from turbogs_plugin.config.schema import build_dataclass, dataclass_mapping, nearest
from turbogs_plugin.config.sections import BudgetConfig, MapsConfig, ReportConfig, SceneConfig, TrainConfig
from turbogs_plugin.config.yaml_text import packaged_names, parse_yaml, read_named_yaml
from turbogs_plugin.engine.rendered import RasterSettings
from turbogs_plugin.errors import InputError

PACKAGE = "turbogs_plugin.configs"
"""Where the packaged configurations are."""

DEFAULT_CONFIG = "turbogs"
"""The packaged configuration that a run without ``--config`` takes."""

BASE_DEPTH_LIMIT = 8
"""Configurations under one another by ``base``."""


@dataclass
class Config:
    """Everything that decides a run. The strategies' sections are complete: `type` and every init field.

    Settings that are ``auto`` are decided by the plan of a run (`turbogs_plugin.plan.Plan.apply`).
    """

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
    budget: BudgetConfig = field(default_factory=BudgetConfig)

    def build(self, kind: str) -> Any:
        """A new strategy of this kind."""
        return registry.build(kind, getattr(self, kind))

    def require_decided(self) -> None:
        """RuntimeError, for it is an error of ours, where a setting is left to a plan: no run can go by that."""
        left = undecided(self.to_mapping())
        if left:
            raise RuntimeError(
                f"{', '.join(left)}: {AUTO}, but a run goes by what a plan has decided: "
                "use make_plan(config, scene, device).apply(config), or config.without_plan()"
            )

    def without_plan(self) -> Config:
        """This configuration, decided for a run that looks at neither scene nor machine, as those of benchmarks do."""
        mapping = self.to_mapping()
        for setting in undecided(mapping):
            section, key = setting.split(".")
            value = AUTO_SETTINGS[setting]
            mapping[section][key] = self.train.base_iterations if value is None else value
        return resolve(mapping)

    def changed(self, **sections: Mapping[str, Any]) -> Config:
        """This configuration with values of some sections replaced; a section with a `type` starts afresh."""
        mapping = self.to_mapping()
        for name, values in sections.items():
            mapping[name] = dict(values) if "type" in values else {**mapping[name], **values}
        return resolve(mapping)

    def to_mapping(self) -> dict[str, Any]:
        """Plain YAML values, every field written out, in sections that may be changed."""
        return dataclass_mapping(self)

    def to_yaml(self) -> str:
        """Every setting; read back, it gives this very configuration."""
        return OmegaConf.to_yaml(OmegaConf.create(self.to_mapping()))


SECTION_CLASSES = {name: hint for name, hint in get_type_hints(Config).items() if is_dataclass(hint)}
"""The sections that are no strategy's."""


def config_names() -> list[str]:
    """Names of the configurations that come with TurboGS."""
    return packaged_names(PACKAGE)


def load_config(name_or_file: str = DEFAULT_CONFIG, overrides: Sequence[str] = ()) -> Config:
    """The configuration of a packaged name or a YAML file, with overrides ``section.key=value`` on top.

    Raises:
        InputError: an unknown name, an unreadable file, an unknown key or type (naming the nearest), a wrong type of
            a value, or one out of range.
    """
    return resolve(apply_overrides(_load_mapping(name_or_file), overrides))


def require_one_length(name_or_file: str, overrides: Sequence[str]) -> None:
    """Raise `InputError` where overrides ask for a time budget and a number of iterations, or for one of them beside a
    file of the user's that has the other. A number of a packaged configuration is no request.

    A file that has both is no contradiction: the configuration of a run with a time budget is such a one.

    Args:
        name_or_file, overrides: which `load_config` takes.
    """
    told, filed = apply_overrides({}, overrides), _load_mapping(name_or_file, packaged=False)

    def said(mapping: Mapping[str, Any], section: str, key: str) -> Any:
        return mapping.get(section, {}).get(key)

    asked = _merge(filed, told)
    iterations, seconds = said(asked, "train", "iterations"), said(asked, "budget", "time")
    by_override = said(told, "train", "iterations") is not None or said(told, "budget", "time") is not None
    if by_override and seconds and iterations not in (None, AUTO):
        of, remedy = "", "leave one out"
        if said(told, "train", "iterations") is None:
            of, remedy = f" of '{name_or_file}'", f"add train.iterations={AUTO}, or leave the budget out"
        raise InputError(
            f"train.iterations={iterations}{of} and the time budget {seconds} exclude each other: {remedy}"
        )


def resolve(mapping: Mapping[str, Any]) -> Config:
    """The complete, checked configuration of a mapping of sections; absent sections have their defaults."""
    old = old_spelling(mapping)
    if old:
        raise InputError(old)
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


def resolve_complete(mapping: Mapping[str, Any], where: str, decided: bool = False) -> Config:
    """`resolve` of the mapping that a run has written.

    Args:
        where: the file, for messages.
        decided: whether nothing may be left to a plan.

    Raises:
        InputError: a part of it is missing or, where that is asked for, left to a plan; or an earlier version wrote it.
    """
    old = old_spelling(mapping)
    if old:
        raise InputError(f"'{where}' is of an earlier version, whose runs are not read: {old}; train anew")
    try:
        config = resolve(mapping)
    except registry.MissingStrategyError as error:
        raise InputError(f"'{where}': {error}") from None
    except InputError as error:
        raise InputError(f"'{where}': {error}; bring back what was written there") from None
    missing = _first_missing(config.to_mapping(), mapping)
    if missing:
        raise InputError(f"'{where}' lacks '{missing}', which this version writes: bring the file back, or train anew")
    left = undecided(mapping) if decided else []
    if left:
        raise InputError(f"'{where}' has {AUTO} for {', '.join(left)}, which a run decides: bring the file back")
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
    result = dict(mapping)
    for override in sorted(overrides, key=lambda text: ".type=" not in text):  # types first, the rest in order
        path, separator, text = override.partition("=")
        keys = path.strip().split(".")
        if not separator or len(keys) < 2 or not all(keys):
            hint = f", as {keys[0]}.type={text} is" if separator and keys[0] in registry.KINDS else ""
            raise InputError(f"override '{override}' is not of the form section.key=value{hint}")
        if not text.strip():
            raise InputError(f"override '{override}' lacks a value: write one behind the =, or null for none")
        # A colour as #336699 or a path as "try #2" would be a comment of YAML, or end in one.
        plain = re.search(r"(^|\s)#", text) and text.lstrip()[0] not in "'\"[{"
        parsed = {"value": text} if plain else parse_yaml(f"value: {text}", f"override '{override}'")
        if set(parsed) != {"value"}:
            raise InputError(f"override '{override}' has more than one value")
        nested = parsed["value"]
        for key in reversed(keys):
            nested = {key: nested}
        result = _merge(result, nested)
    return result


def _load_mapping(name_or_file: str, depth: int = 0, packaged: bool = True) -> dict[str, Any]:
    """The mapping of a configuration on top of its bases, or without what comes from packaged ones."""
    if not packaged and name_or_file in config_names():
        return {}
    if depth > BASE_DEPTH_LIMIT:
        raise InputError(f"config '{name_or_file}': its bases form a circle")
    mapping = read_named_yaml(name_or_file, PACKAGE, "config")
    base = mapping.pop("base", None)
    if base is None:
        return mapping
    return _merge(_load_mapping(named_beside(str(base), name_or_file), depth + 1, packaged), mapping)


def named_beside(name: str, file: str) -> str:
    """What a name in a YAML file means: a packaged configuration, or a file by its place beside that one."""
    path = Path(file).parent / name
    is_file = path.suffix in (".yaml", ".yml") or path.is_file()
    return str(path) if is_file and name not in config_names() else name


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


def _changes_type(kind: str, below: Mapping[str, Any], value: Mapping[str, Any]) -> bool:
    if kind not in registry.KINDS or "type" not in value:
        return False
    default = registry.default_type(kind)
    return value["type"] != below.get("type", default)
