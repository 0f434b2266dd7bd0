"""The values that `turbogs` uses, read from its configuration: the defaults of what is swapped into a trainer."""

from __future__ import annotations

from typing import Any

from turbogs_plugin.strategies.density.error_driven import ErrorDrivenDensity
from turbogs_plugin.strategies.schedule import SinusoidalSchedule
from turbogs_plugin.yaml_json import read_named_yaml

_TURBOGS = read_named_yaml("turbogs", "turbogs_plugin.configs", "config")


def _settings(section: str) -> dict[str, Any]:
    return {name: value for name, value in _TURBOGS[section].items() if name != "type"}


GATES = {
    "choose_by": "difficulty",
    "prune_score_fraction": 0.0,
    "top_fraction": 0.9,
    "grad_threshold": 2e-4,
    "absgrad_threshold": 2e-4,
    "final_keep": 1.0,
}
"""Settings in place of turbogs' draw by squares, which gsplat's rasterization does not give, and of final pruning.
The numbers of docs/drop-in.md were measured with them."""

TUNED_DENSITY = ErrorDrivenDensity(**_settings("density") | GATES)
"""Density control with the settings of `configs/turbogs.yaml`, but for `GATES`."""

TUNED_SCHEDULE = SinusoidalSchedule(**_settings("schedule"))
"""The schedule of views and rate with the settings of `configs/turbogs.yaml`."""
