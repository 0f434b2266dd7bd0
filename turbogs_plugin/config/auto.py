"""Settings whose value may be ``auto``, on the plain mapping of a configuration: a run's plan decides them
(`turbogs_plugin.plan`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

AUTO = "auto"

AUTO_SETTINGS: dict[str, Any] = {
    "train.backdrop": False,
    "train.background": "black",
    "train.exposure": False,
    "train.dropout": 0.0,
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
