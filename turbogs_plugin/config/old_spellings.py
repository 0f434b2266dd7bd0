"""Settings of earlier versions: a configuration with one of them is refused by a line that names what is there now."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from turbogs_plugin.config import registry

NOW: dict[str, str] = {
    "plan.backdrop": "is now train.backdrop",
    "plan.ncc": "is now loss.type: charbonnier_ncc or charbonnier",
    "plan.views": "is now schedule.type: sinusoidal, or fixed with schedule.views",
    "plan.sh_degree": "is now train.sh_degree",
    "plan.optimizer": "is now optimizer.type",
    "plan.iterations": "is now train.iterations, where auto leaves it to the plan and a number scales nothing",
    "plan.looks": "is now train.epochs",
    "plan.maps_on": "is now train.maps_place",
    "plan.photos_on": "is now train.photos_place",
    "budget.max_gaussians": "is now density.max_gaussians",
    "density.cap_max": "is now density.max_gaussians",
    "optimizer.solver": "is gone: each engine has its own solver",
    "density.growth": "is gone: density.max_gaussians caps the number of Gaussians",
    "density.target_gaussians": "is gone: density.max_gaussians caps the number of Gaussians",
    "loss.type: auto": "is gone: charbonnier_ncc is what it mostly chose; charbonnier is for photos without texture",
    "loss.gate": "is gone: it lost SSIM; density.max_gaussians caps the number of Gaussians",
    "loss.structure: contrast": "is gone: it gained nothing over ncc",
    "schedule.type: auto": "is gone: sinusoidal is what it mostly chose; fixed with schedule.views is for few photos",
    "optimizer.type: auto": "is gone: moment_lm is what it chose on a GPU, sparse_adam on a CPU",
    "train.sh_degree: auto": "is gone: 3 is the paper's; 1 is enough where all cameras look one way",
}
"""Setting of an earlier version, or one with a value that it may no longer have -> what became of it."""


def old_spelling(mapping: Mapping[str, Any]) -> str:
    """What became of the first setting of an earlier version in a mapping of sections; empty where there is none."""
    for spelling, now in NOW.items():
        setting, _, old = spelling.partition(": ")
        section, key = setting.split(".")
        values = mapping.get(section)
        if isinstance(values, Mapping) and key in values and old in ("", values[key]):
            # A strategy of somebody else's may have such a key.
            kind = registry.BUILT_IN.get(section)
            if kind is None or key == "type" or values.get("type", registry.default_type(section)) in kind:
                return f"{spelling} {now}"
    return ""
