"""The configuration of a run: dataclasses <- YAML <- dotted overrides.

A YAML has one section a part. The sections `scene`, `train`, `maps` and `budget` hold the settings
of a dataclass (`SECTION_CLASSES`); a strategy's section holds its ``type`` and the settings of that strategy's own
dataclass. Defaults live in those dataclasses and nowhere else. ``base: NAME_OR_FILE`` puts a YAML on top of another; a
file is looked for beside it. The plan of a run decides settings that are ``auto`` (`sections.AUTO_SETTINGS`).
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from pathlib import Path
from textwrap import indent
from typing import Any, get_type_hints

from turbogs_plugin.config.components import KINDS, build, default_type, foreign_code, strategy_class
from turbogs_plugin.config.sections import (
    AUTO,
    AUTO_SETTINGS,
    BudgetConfig,
    MapsConfig,
    SceneConfig,
    TrainConfig,
    undecided,
)
from turbogs_plugin.config.typed import build_dataclass, dataclass_mapping, settings_of
from turbogs_plugin.engine.render_pass import DEFAULT_SETTINGS, RasterSettings
from turbogs_plugin.errors import InputError, nearest, require
from turbogs_plugin.strategies import TYPES
from turbogs_plugin.yaml_json import packaged_names, parse_yaml, read_named_yaml, yaml_text

PACKAGE, DEFAULT_CONFIG = "turbogs_plugin.configs", "turbogs"
"""Where the packaged configurations are, and the one that a run without ``--config`` takes."""
BASE_DEPTH_LIMIT = 8
"""Most configurations under one another by ``base``."""


@dataclass
class Config:
    """Everything that decides a run. A strategy's section is complete: its `type` and every setting."""

    scene: SceneConfig
    train: TrainConfig
    schedule: dict[str, Any]
    view_sampler: dict[str, Any]
    pixel_sampler: dict[str, Any]
    loss: dict[str, Any]
    density: dict[str, Any]
    optimizer: dict[str, Any]
    maps: MapsConfig
    budget: BudgetConfig = field(default_factory=BudgetConfig)
    raster: RasterSettings = field(default=DEFAULT_SETTINGS, metadata={"setting": False})

    def build(self, kind: str) -> Any:
        """A new strategy of this kind."""
        return build(kind, getattr(self, kind))

    def require_decided(self) -> None:
        """Raise RuntimeError, an error of the caller's code, where a setting is left to a plan: no run can use it."""
        if left := undecided(self.to_mapping()):
            raise RuntimeError(
                f"{', '.join(left)}: {AUTO}, but a run goes by what a plan has decided: "
                "use make_plan(config, scene, device).apply(config), or config.without_plan()"
            )

    def without_plan(self) -> Config:
        """This configuration, decided for a run that looks at neither scene nor machine, such as a benchmark."""
        defaults = vars(TrainConfig(pixels_place="device"))
        return self.changed(train={name: defaults[name] for name in AUTO_SETTINGS if getattr(self.train, name) == AUTO})

    def changed(self, **sections: Mapping[str, Any]) -> Config:
        """This configuration with values of some sections replaced; a section with a `type` starts afresh."""
        mapping = self.to_mapping()
        for name, values in sections.items():
            mapping[name] = dict(values) if "type" in values else {**mapping[name], **values}
        return resolve(mapping)

    def to_mapping(self) -> dict[str, Any]:
        """Plain YAML values, every setting written out, in sections that the caller may change."""
        return dataclass_mapping(self)

    def to_yaml(self) -> str:
        """Every setting as YAML; read back, it gives an equal configuration."""
        return yaml_text(self.to_mapping())


SECTION_CLASSES: dict[str, type] = {
    name: get_type_hints(Config)[name] for name in settings_of(Config) if is_dataclass(get_type_hints(Config)[name])
}
"""Section that is no strategy's -> its dataclass."""


def config_names() -> list[str]:
    """Names of the configurations that come with TurboGS."""
    return packaged_names(PACKAGE)


def load_config(source: str | Mapping[str, Any] = DEFAULT_CONFIG, overrides: Sequence[str] = ()) -> Config:
    """The configuration of a packaged name, a YAML file or a mapping like that of a YAML, on top of the default where
    it names no base; with overrides ``section.key=value`` on top. Raises `InputError` for an unknown name, an
    unreadable file, an unknown key or type (naming the nearest), a wrong type of a value, or one out of range."""
    if isinstance(source, Mapping):
        own = dict(source)
        mapping = _merge(_load_mapping(str(own.pop("base", DEFAULT_CONFIG))), own)
    else:
        require(isinstance(source, str | Path), "config", source, "a packaged name or a YAML file")
        mapping = _load_mapping(source)
    return resolve(apply_overrides(mapping, overrides))


def settings_text(config: Config) -> str:
    """The configuration as YAML, with the docstrings of a section's classes above it, which say what settings mean."""
    parts = []
    for section, values in config.to_mapping().items():
        cls = SECTION_CLASSES.get(section) or strategy_class(section, values["type"])
        nested = [hint for name, hint in get_type_hints(cls).items() if name in values and is_dataclass(hint)]
        owners = [owner for owner in (*reversed(cls.__mro__), *nested) if is_dataclass(owner)]
        said = [inspect.cleandoc(owner.__doc__ or "") for owner in owners]
        if section in TYPES:
            said.append(f"Types: {', '.join(TYPES[section])}.")
        parts.append(indent("\n\n".join(said), "# ") + "\n" + yaml_text({section: values}))
    return "\n".join(parts)


def resolve(mapping: Mapping[str, Any], built: bool = True) -> Config:
    """The complete, checked configuration of a mapping of sections; absent sections have their defaults. Strategies are
    `built`, which imports and checks them; else their sections are taken as they are."""
    for section in mapping:
        if section not in SECTION_CLASSES and section not in KINDS:
            raise InputError(f"unknown section '{section}': {nearest(section, [*SECTION_CLASSES, *KINDS])}")
    sections: dict[str, Any] = {
        name: build_dataclass(cls, mapping.get(name, {}), name) for name, cls in SECTION_CLASSES.items()
    }
    for kind in KINDS:
        sections[kind] = given = mapping.get(kind, {})
        if built:
            strategy = build(kind, given)
            sections[kind] = {"type": given.get("type", default_type(kind)), **dataclass_mapping(strategy)}
    return Config(**sections)


def resolve_complete(
    mapping: Mapping[str, Any], where: str, decided: bool = False, built: bool = False, trusted: bool = False
) -> Config:
    """`resolve` of the mapping that a run has written to the file `where`.

    Args:
        decided: whether nothing may be left to a plan.
        built: as for `resolve`; only a training uses strategies.
        trusted: whether code may run that nobody installed. A line on stderr names its files.

    Raises:
        InputError: a part is missing or, unless allowed, left to a plan or code that is not installed.
    """
    foreign = foreign_code(mapping) if built else {}
    for what, file in foreign.items():
        if not trusted:
            raise InputError(f"'{where}': {what} runs code that is not installed ({file}): read it, then give --trust")
        print(f"turbogs: '{where}': {what} runs code that is not installed ({file})", file=sys.stderr)
    try:
        config = resolve(mapping, built)
    except InputError as error:
        raise InputError(f"'{where}': {error}; bring back what was written there") from None
    if mapping != config.to_mapping() or (decided and undecided(mapping)):
        raise InputError(f"'{where}' lacks settings that a run writes: bring the file back, or train anew")
    return config


def apply_overrides(mapping: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """`mapping` with ``section.key=value`` on top; a new ``section.type=name`` starts that section afresh,
    but for its learning rates."""
    result = dict(mapping)
    for override in sorted(overrides, key=lambda text: ".type=" not in text):  # types first, the rest in order
        path, separator, text = override.partition("=")
        keys = path.strip().split(".")
        if not separator or len(keys) < 2 or not all(keys):
            value = "VALUE" if text[:1] in "{[" else text
            meant = " or ".join(f"{name}={value}" for name in settings_named(path.strip()))
            meant = f"--config {path} (in Python, config='{path}')" if path in config_names() else meant
            hint = f": write {meant}" if meant else ""
            raise InputError(f"override '{override}' is not of the form section.key=value{hint}")
        if not text.strip():
            raise InputError(f"override '{override}' lacks a value: write one behind the =, or null for none")
        # A colour as #336699 or a path as "try #2" would be a comment of YAML, or end in one.
        plain = re.search(r"(^|\s)#", text) and text.lstrip()[0] not in "'\"[{"
        parsed = {"value": text} if plain else parse_yaml(f"value: {text}", f"override '{override}'")
        nested: Any = parsed["value"]
        for key in reversed(keys):
            nested = {key: nested}
        result = _merge(result, nested)
    return result


def refuse_overrides(overrides: Sequence[str], taken: Mapping[str, str]) -> None:
    """Raise `InputError` for an override of what is `taken`: settings, or whole sections, and why."""
    for name in (override.partition("=")[0].strip() for override in overrides):
        if reason := taken.get(name) or taken.get(name.partition(".")[0]):
            raise InputError(f"{name} is {reason}; leave it out")


def settings_named(word: str) -> list[str]:
    """The settings, ``section.key``, that a word may mean: a key, with its section or alone, or a kind of strategy."""
    if word in KINDS:
        return [f"{word}.type"]
    settings = [(section, key) for section, keys in load_config().to_mapping().items() for key in keys]
    return [f"{s}.{key}" for s, key in settings if word in (key, f"{s}.{key}", f"{s}_{key}", f"{key}_{s}")]


def _load_mapping(name_or_file: str, depth: int = 0) -> dict[str, Any]:
    """The mapping of a configuration on top of its bases."""
    if depth > BASE_DEPTH_LIMIT:
        raise InputError(f"config '{name_or_file}': its bases form a circle")
    mapping = read_named_yaml(name_or_file, PACKAGE, "config")
    base = mapping.pop("base", None)
    return _merge(_load_mapping(named_beside(str(base), name_or_file), depth + 1), mapping) if base else mapping


def named_beside(name: str, file: str) -> str:
    """The meaning of a name in a YAML file: a packaged configuration, or a file by its place beside `file`."""
    path = Path(file).parent / name
    is_file = path.suffix in (".yaml", ".yml") or path.is_file()
    return str(path) if is_file and name not in config_names() else name


def _merge(under: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`over` on top of `under`, mapping by mapping. Another type of a section keeps its learning rates alone."""
    result = dict(under)
    for key, value in over.items():
        below = result.get(key)
        if not (isinstance(below, Mapping) and isinstance(value, Mapping)):
            result[key] = value
        elif key in KINDS and "type" in value and value["type"] != below.get("type", default_type(key)):
            takes_rates = "learning_rates" in get_type_hints(strategy_class(key, str(value["type"])))
            kept = {name: rates for name, rates in below.items() if name == "learning_rates" and takes_rates}
            result[key] = _merge(kept, value)
        else:
            result[key] = _merge(below, value)
    return result
