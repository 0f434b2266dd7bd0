"""One pure function a decision: facts and configuration -> `Decision`, and what a decision changes in a configuration.

Every criterion is a number of the facts against a constant of this module, whose docstring says where it is from.
Measurements are those of docs/results/sweeps.md unless they say otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.config.scaling import scale_iterations
from turbogs_plugin.plan.budget import images_per_iteration
from turbogs_plugin.plan.facts import SceneFacts

ONE_SIDED = 0.95
"""Direction concentration above which a capture is seen from one side. Nadir grids of aircraft have .99; walks around
something have .68 (snowmiku) and .83 (fox)."""
FLAT_TILES = 0.5
"""Share of tiles without texture from which on NCC is left out. It gains SSIM at .09 (caliterra, .0055), at .13 (fox,
.0006) and at .42 (snowmiku, .002); above, nothing has been measured yet."""
ONE_SIDED_DEGREE = 1
"""Degree that a one-sided capture gets: on caliterra 1 ends 0.1 dB above 3, in the same time and 18 % less
memory."""
DEVICE_SHARE = 0.5
"""Share of the device's memory that photos and maps may take: the rest is for the model, its optimizer, workspaces."""
SHORTEST_SHARE = 0.4
"""Of the configured iterations: fewer leave the events of density control too little time between them, however few the
photos. fox has 44 % of them with 50 looks, and loses nothing."""

Value = bool | int | str

Verdict = tuple[Value, str]
"""What the facts say: a value, and why."""

OPTIMIZERS: dict[str, Verdict] = {
    "cpu": (
        "sparse_adam",
        "linear systems are 5 to 10 % of an iteration on a CPU, for nothing on the demo capture",
    ),
    "cuda": (
        "moment_lm",
        "sparse_adam has its errors within the spread of seeds and its time within 7 % on three scenes on an H200",
    ),
}
"""Kind of device -> which optimizer, and why (docs/results/leave_out and optimizer)."""


@dataclass(frozen=True)
class Decision:
    """One line of a plan.

    Args:
        name: a field of `PlanConfig`.
        value: what it was decided to be.
        made: ``auto`` by the facts, ``forced`` by the configuration, or ``kept`` as configured elsewhere.
        reason: with the number that decided.
    """

    name: str
    value: Value
    made: str
    reason: str

    @property
    def text(self) -> str:
        """The value as YAML has it."""
        return str(self.value).lower() if isinstance(self.value, bool) else str(self.value)


def decide_backdrop(facts: SceneFacts, config: Config) -> Decision:
    """A far sphere behind the scene, where all cameras look the same way and much of it is seen by few."""
    concentration = facts.direction_concentration
    one_sided = concentration >= ONE_SIDED
    reason = f"view directions concentrated to {concentration:.3f} {_sign(one_sided)} {ONE_SIDED}"
    return _decision("backdrop", config, config.train.backdrop, (one_sided, reason))


def decide_ncc(facts: SceneFacts, config: Config) -> Decision:
    """The loss's structure term, but where most tiles have no structure."""
    loss, flat = config.loss["type"], facts.flat_tiles >= FLAT_TILES
    compared = f"{facts.flat_tiles:.1%} of tiles without texture {_sign(flat)} {FLAT_TILES:.0%}"
    verdict: Verdict = (not flat, compared) if loss == "charbonnier_ncc" else ("keep", f"the loss is {loss}")
    return _decision("ncc", config, loss == "charbonnier_ncc", verdict)


def decide_views(facts: SceneFacts, config: Config) -> Decision:
    """Every view in every iteration, where the schedule may take as many anyway."""
    most = config.schedule.get("max_views", config.schedule.get("views"))
    if most is None:
        verdict: Verdict = ("keep", f"the schedule {config.schedule['type']} has no largest number of views")
    else:
        few = facts.train_views <= most
        compared = f"{facts.train_views} training views {'<=' if few else '>'} at most {most} an iteration"
        verdict = ("all" if few else "keep", compared)
    return _decision("views", config, "keep", verdict)


def decide_sh_degree(facts: SceneFacts, config: Config) -> Decision:
    """No more coefficients than a Gaussian can have observations, and few for views from one side."""
    degree, views, concentration = config.train.sh_degree, facts.train_views, facts.direction_concentration
    reason = f"{(degree + 1) ** 2} coefficients <= {views} training views"
    while degree > 0 and (degree + 1) ** 2 > views:
        reason = f"{(degree + 1) ** 2} coefficients of degree {degree} > {views} training views"
        degree -= 1
    if concentration >= ONE_SIDED and degree > ONE_SIDED_DEGREE:
        degree, reason = ONE_SIDED_DEGREE, f"view directions concentrated to {concentration:.3f} >= {ONE_SIDED}"
    return _decision("sh_degree", config, config.train.sh_degree, (degree, reason))


def decide_optimizer(facts: SceneFacts, config: Config) -> Decision:
    """The Levenberg-Marquardt part only where it pays."""
    present = config.optimizer["type"]
    known = present in ("moment_lm", "sparse_adam")
    verdict: Verdict = OPTIMIZERS[facts.device] if known else ("keep", f"the optimizer is {present}")
    return _decision("optimizer", config, present, verdict)


def decide_iterations(facts: SceneFacts, config: Config) -> Decision:
    """As many as look at each training pixel so often: error stops falling after looks, not after iterations."""
    present = config.train.iterations
    wanted = config.plan.looks * facts.train_views / images_per_iteration(config, facts.train_views)
    fewest = SHORTEST_SHARE * present
    reason = f"{config.plan.looks:g} looks at each of {facts.train_views} training views"
    if wanted < fewest:
        reason += f" take fewer than {SHORTEST_SHARE:.0%} of {present}"
    needed = math.ceil(max(wanted, fewest) / 100) * 100
    return _decision("iterations", config, present, (needed, reason))


def decide_maps_on(facts: SceneFacts, config: Config) -> Decision:
    """Maps on the device, unless they do not fit even without the photos.

    Photos are the first to go: of a pixel, 3 bytes travel in, of the maps 4 in and 4 out.
    """
    photos = facts.photo_bytes if config.plan.photos_on == "device" else 0
    return _decision("maps_on", config, "device", _place(facts, facts.map_bytes, photos, "photos"))


def decide_photos_on(facts: SceneFacts, config: Config) -> Decision:
    """Photos on the device, where they fit beside the maps that are there."""
    maps = facts.map_bytes if decide_maps_on(facts, config).value == "device" else 0
    return _decision("photos_on", config, "device", _place(facts, facts.photo_bytes, maps, "maps"))


def _decision(name: str, config: Config, present: Value, verdict: Verdict) -> Decision:
    """A forced value if there is one, else what is configured or what the facts say, as the configuration wants it.

    Args:
        name: a field of `PlanConfig`.
        present: what the rest of the configuration comes to.
        verdict: of the facts.
    """
    choice = getattr(config.plan, name)
    auto = Decision(name, verdict[0], "auto", verdict[1])
    if choice == "auto":
        return auto
    advice = f"auto: {auto.text}, {auto.reason}"
    if choice == "keep":
        return Decision(name, present, "kept", advice)
    return Decision(name, choice, "forced", advice)


def _place(facts: SceneFacts, size: int, others: int, name_of_others: str) -> Verdict:
    if facts.device == "cpu":
        return "device", "the device is the CPU, whose memory is the host's"
    limit = facts.device_free_bytes if facts.memory_limit is None else min(facts.device_free_bytes, facts.memory_limit)
    fits = size + others <= DEVICE_SHARE * limit
    beside = f" beside {mebibytes(others)} of {name_of_others}" if others else ""
    which = "free" if limit == facts.device_free_bytes else "allowed"
    reason = f"{mebibytes(size)}{beside} {'<=' if fits else '>'} {DEVICE_SHARE:.0%} of {mebibytes(limit)} {which}"
    return "device" if fits else "host", reason


def mebibytes(size: int) -> str:
    """Bytes for a reader."""
    return f"{size / 2**20:,.0f} MiB"


def _sign(reached: bool) -> str:
    return ">=" if reached else "<"


def apply_backdrop(mapping: dict[str, dict[str, Any]], value: Value, facts: SceneFacts) -> None:
    mapping["train"]["backdrop"] = value


def apply_ncc(mapping: dict[str, dict[str, Any]], value: Value, facts: SceneFacts) -> None:
    name = {True: "charbonnier_ncc", False: "charbonnier", "keep": mapping["loss"]["type"]}[value]
    if mapping["loss"]["type"] != name:
        mapping["loss"] = _carried("loss", mapping, name, ("epsilon",))


def apply_views(mapping: dict[str, dict[str, Any]], value: Value, facts: SceneFacts) -> None:
    if value == "all":
        fixed = _carried("schedule", mapping, "fixed", ("pixel_budget",))
        mapping["schedule"] = {**fixed, "views": facts.train_views}
        mapping["view_sampler"] = {"type": "random"}


def apply_sh_degree(mapping: dict[str, dict[str, Any]], value: Value, facts: SceneFacts) -> None:
    mapping["train"]["sh_degree"] = value


def apply_iterations(mapping: dict[str, dict[str, Any]], value: Value, facts: SceneFacts) -> None:
    scale_iterations(mapping, int(value))


def apply_optimizer(mapping: dict[str, dict[str, Any]], value: Value, facts: SceneFacts) -> None:
    if value not in ("keep", mapping["optimizer"]["type"]):
        mapping["optimizer"] = _carried("optimizer", mapping, str(value), ("learning_rates",))


def apply_nothing(mapping: dict[str, dict[str, Any]], value: Value, facts: SceneFacts) -> None:
    """Where things are is read from the plan's own section."""


def _carried(section: str, mapping: Mapping[str, dict[str, Any]], name: str, keys: tuple[str, ...]) -> dict[str, Any]:
    """A section of another type, with these of the present one's options."""
    return {"type": name, **{key: mapping[section][key] for key in keys if key in mapping[section]}}


@dataclass(frozen=True)
class Rule:
    """A decision: how it is made, and what it changes."""

    decide: Callable[[SceneFacts, Config], Decision]
    apply: Callable[[dict[str, dict[str, Any]], Value, SceneFacts], None]


RULES: dict[str, Rule] = {
    "backdrop": Rule(decide_backdrop, apply_backdrop),
    "ncc": Rule(decide_ncc, apply_ncc),
    "views": Rule(decide_views, apply_views),
    "sh_degree": Rule(decide_sh_degree, apply_sh_degree),
    "optimizer": Rule(decide_optimizer, apply_optimizer),
    "iterations": Rule(decide_iterations, apply_iterations),
    "maps_on": Rule(decide_maps_on, apply_nothing),
    "photos_on": Rule(decide_photos_on, apply_nothing),
}
"""Field of `PlanConfig` -> its rule."""
