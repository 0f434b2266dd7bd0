"""Settings whose value may be ``auto``, on the plain mapping of a configuration.

A run's plan decides them (`turbogs_plugin.plan`). A strategy's section with ``type: auto`` holds the fields of its
kind's default type, and the plan names the type.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from turbogs_plugin.config import registry
from turbogs_plugin.config.schema import dataclass_mapping

AUTO = "auto"

AUTO_SETTINGS: dict[str, Any] = {
    "train.backdrop": False,
    "train.background": "black",
    "train.exposure": False,
    "loss.type": registry.default_type("loss"),
    "schedule.type": registry.default_type("schedule"),
    "train.sh_degree": 3,
    "optimizer.type": registry.default_type("optimizer"),
    "train.batch_for": 1,
    "train.iterations": None,
    "train.maps_place": "device",
    "train.photos_place": "device",
}
"""Setting -> its value if no plan is made; None: `train.base_iterations`. What a plan makes of `auto` is decided in
`turbogs_plugin.plan.decisions`. `train.device` is not among them, as a plan is made for a given device."""


def undecided(mapping: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The settings of a complete configuration that are left to a plan."""
    return [setting for setting in AUTO_SETTINGS if value_of(mapping, setting) == AUTO]


def value_of(mapping: Mapping[str, Mapping[str, Any]], setting: str) -> Any:
    """The value of ``section.key``."""
    section, key = setting.split(".")
    return mapping[section][key]


def concrete(kind: str, section: Any) -> Any:
    """A strategy's section with its kind's default type instead of ``auto``; anything else is returned unchanged."""
    if isinstance(section, Mapping) and section.get("type") == AUTO and f"{kind}.type" in AUTO_SETTINGS:
        return {**section, "type": registry.default_type(kind)}
    return section


def of_type(kind: str, section: Mapping[str, Any], name: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """A section of ``type: auto`` whose type is now decided: `name`, with the values of `options`.

    If that is not the kind's default type, it takes over the values that were changed from the default type's defaults,
    where it has fields of the same names.
    """
    default = registry.default_type(kind)
    if name == default:
        return {**section, "type": name, **options}
    unchanged = dataclass_mapping(registry.build(kind, {"type": default}))
    known = {field.name for field in fields(registry.strategy_class(kind, name)) if field.init}
    changed = {key: section[key] for key, value in unchanged.items() if key in known and section[key] != value}
    return {"type": name, **changed, **options}
