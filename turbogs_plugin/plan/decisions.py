"""The plan of a run: one pure function a setting that may be ``auto``, facts and configuration -> what the setting
should be, and why; and the configuration that follows.

Every criterion compares a number of the facts with a constant of this module, whose docstring says where it is from.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.config.scaling import RATE_EXPONENT, with_batch_for, with_iterations
from turbogs_plugin.config.sections import AUTO, WRITTEN_FOR
from turbogs_plugin.engine.layout import MAX_VIEWS
from turbogs_plugin.model.initial import BACKDROP_COUNT
from turbogs_plugin.plan.facts import SceneFacts, gather_facts
from turbogs_plugin.plan.memory import cap_of, images_per_iteration
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.host_arrays import MEMORY_SHARE as HOST_SHARE

ONE_SIDED = 0.95
"""Direction concentration above which a capture is seen from one side. Nadir grids of aircraft have .99; walks around
something have .68 (snowmiku) and .83 (fox)."""
FAR_POINTS = 6.0
"""Scene sizes (`SceneFacts`) beyond which one point in a hundred lies where a capture sees far beyond its subject and
mostly a sky: Train has 13, four other captures 1.3 to 1.8."""
EXPOSURE_STOPS = 0.05
"""Standard deviation of the photos' exposures, in stops, from which on each photo gets one. Five captures have .16
to .62."""
EXPOSURE_SHARE = 0.25
"""Largest share of that deviation that is left against the photos before and after: with more, nothing says what
exposure a test photo has. On validation photos of five captures exposures gain .3 to 1.5 dB at shares of .12 to .24,
and less than .05 dB at .32 and .33."""
DROPOUT = 0.2
"""Share of the Gaussians left out by `auto`: .1 gains half to two thirds as much, .3 no more, with a tenth more
Gaussians."""
CAMERA_PIXELS = 0.4
"""Median reprojection error, in pixels, from which on cameras are inaccurate: a model then learns each photo's own
displacement rather than the scene. Dropout gains at .48 to .67 (fox, snowmiku) and loses at .20 to .34."""
DEVICE_SHARE = 0.5
"""Share of the device's memory for photos and maps: the rest is for the model, its optimizer, workspaces."""
LONGEST = 30_000
"""Most iterations of `auto`, 3DGS's own length: 60 epochs of 500 training views. More would take minutes or hours that
nobody has asked for; a time budget asks for them. Divided by the times that an iteration has the pixels of one
process."""
MANY_VIEWS = 100
"""Training views from which on `train.epochs` grows, with the root of their number: the more photos, the later does
training overfit."""
LARGEST_BATCH = 2
"""Most times the batch of one process. Twice costs no error; four times costs caliterra .25 to .73 dB."""
SHORTEST_SHARE = 0.4
"""Least share of `WRITTEN_FOR`: with fewer iterations, events of density control would be too close together.
Several processes, whose steps are longer by the root of their number, need fewer by that root."""

Value = bool | int | float | str
Verdict = tuple[Value, str]
"""A setting's value by the facts, and the reason, with the number that decides."""


@dataclass(frozen=True)
class Decision:
    """One line of a plan: a field of the section `train`, its value in the run, whether it is ``auto`` by the facts or
    ``set`` by the configuration, and the reason; for what is set, with the value that the facts would have led to."""

    setting: str
    value: Value
    made: str
    reason: str


def decide(setting: str, facts: SceneFacts, config: Config) -> Decision:
    """The value of `train.<setting>` in a run: by the configuration or, where that is ``auto``, by the facts."""
    present, (value, reason) = getattr(config.train, setting), RULES[setting](facts, config)
    if present == AUTO:
        return Decision(setting, value, "auto", reason)
    return Decision(setting, present, "set", f"auto: {yaml_text(value)}, {reason}")


def yaml_text(value: Value) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def wanted_background(facts: SceneFacts, config: Config) -> Verdict:
    """A background that no model can imitate, where photos say what is empty."""
    if facts.transparent:
        return "random", "photos are transparent: what is empty in them stays empty"
    return "black", "photos are opaque"


def wanted_backdrop(facts: SceneFacts, config: Config) -> Verdict:
    """A far sphere behind the scene, where all cameras look the same way and much of it is seen by few, or where points
    lie so far away that there is a sky."""
    if config.train.starts_from_model:
        return False, "train.init names a model, which is taken as it is"
    cap, one_sided = cap_of(config), facts.direction_concentration >= ONE_SIDED
    if 0 < cap <= BACKDROP_COUNT:
        return False, f"its {BACKDROP_COUNT} Gaussians leave no room within density.max_gaussians {cap}"
    far_away = facts.far_points >= FAR_POINTS
    why = f"view directions concentrated to {facts.direction_concentration:.3f} {_sign(one_sided)} {ONE_SIDED}"
    if facts.far_points:  # 0: points are random
        why += f", one point in 100 lies {facts.far_points:.1f} scene sizes away {_sign(far_away)} {FAR_POINTS:g}"
    return one_sided or far_away, why


def wanted_exposure(facts: SceneFacts, config: Config) -> Verdict:
    """A colour map for each photo, where photos show the same points differently bright, but much as those before and
    after them."""
    if facts.transparent:
        return False, "photos are transparent: their background has no exposure"
    if facts.gains is None:
        return False, "unless the photos' exposures say otherwise, which only auto compares"
    spread, rest, compared = facts.gains.spread, facts.gains.rest, int(facts.gains.compared.sum())
    if 2 * compared < facts.train_views:
        return False, f"only {compared} of {facts.train_views} photos could be compared"
    if spread < EXPOSURE_STOPS:
        return False, f"photos {spread:.2f} stops apart < {EXPOSURE_STOPS}"
    told = rest <= EXPOSURE_SHARE * spread
    near = f"{rest:.2f} from those before and after {'<=' if told else '>'} {EXPOSURE_SHARE} of that"
    return told, f"photos {spread:.2f} stops apart >= {EXPOSURE_STOPS}, and {near}"


def wanted_dropout(facts: SceneFacts, config: Config) -> Verdict:
    """Some of the Gaussians left out, where cameras are so inaccurate that a model learns the photos by heart."""
    error = facts.reprojection_error
    if error is None:
        return 0.0, "no reconstruction says how accurate the cameras are"
    inaccurate = error >= CAMERA_PIXELS
    reason = f"points {error:.2f} pixels from where photos show them {_sign(inaccurate)} {CAMERA_PIXELS}"
    return DROPOUT if inaccurate else 0.0, reason


def wanted_batch_for(facts: SceneFacts, config: Config) -> tuple[int, str]:
    """The batch of all processes, as far as that costs no error and an iteration can have as many different views."""
    count, there = facts.processes, min(facts.train_views, MAX_VIEWS)
    most = config.schedule.get("max_views", config.schedule.get("views", 0))
    if count == 1 or not most:
        return 1, "one process" if count == 1 else "the schedule has no number of views"
    wanted = min(count, LARGEST_BATCH)
    fitting = max(1, min(wanted, there // most))
    if fitting < wanted:
        return fitting, f"{count} processes, but {fitting + 1} times {most} views > {there}"
    return fitting, f"{count} processes; a batch for {LARGEST_BATCH} costs no error"


def wanted_iterations(facts: SceneFacts, config: Config) -> Verdict:
    """As many iterations as `train.epochs` take: error stops falling after epochs, not after iterations."""
    views = facts.train_views
    # A batch that is set is in the schedule already.
    factor = wanted_batch_for(facts, config)[0] if config.train.batch_for == AUTO else 1
    epochs = config.train.epochs * max(1.0, views / MANY_VIEWS) ** 0.5
    wanted = epochs * views / (factor * images_per_iteration(config, views))
    fewest = SHORTEST_SHARE * WRITTEN_FOR / factor**RATE_EXPONENT
    longest = max(LONGEST / factor, fewest)
    reason = f"{epochs:.3g} epochs of {views} training views"
    reason += f", {factor} times the pixels an iteration" if factor > 1 else ""
    if wanted < fewest:
        reason += f" take fewer than {fewest:.0f}, the least"
    elif wanted > longest:
        looks = epochs * longest / wanted
        reason += f" take {wanted:.0f}; at most {longest:.0f}, where a pixel is sampled {looks:.1f} times"
    return math.ceil(min(max(wanted, fewest), longest) / 100) * 100, reason


def wanted_pixels_place(facts: SceneFacts, config: Config) -> Verdict:
    """Photos and maps on the device where they fit into a share of its memory; of a pixel, 3 bytes of photos and 4 of
    maps travel to the device each iteration otherwise, and 4 back."""
    in_file = ""
    if facts.map_bytes > HOST_SHARE * facts.host_bytes:
        in_file = f" > {HOST_SHARE:.0%} of {mebibytes(facts.host_bytes)} free on the host: maps in a file"
    if facts.device == "cpu":
        if in_file:
            return "host", mebibytes(facts.map_bytes) + in_file
        return "device", "the device is the CPU, whose memory is the host's"
    size = facts.photo_bytes + facts.map_bytes
    share = f"{DEVICE_SHARE:.0%} of {mebibytes(facts.device_bytes)}"
    if size <= DEVICE_SHARE * facts.device_bytes:
        return "device", f"{mebibytes(size)} <= {share}"
    return "host", f"{mebibytes(size)} > {share}" + (f",{in_file}" if in_file else "")


def mebibytes(size: int) -> str:
    """Bytes for a reader."""
    return f"{size / 2**20:,.0f} MiB"


def _sign(reached: bool) -> str:
    return ">=" if reached else "<"


RULES: dict[str, Callable[[SceneFacts, Config], Verdict]] = {
    "backdrop": wanted_backdrop,
    "background": wanted_background,
    "exposure": wanted_exposure,
    "dropout": wanted_dropout,
    "batch_for": wanted_batch_for,
    "iterations": wanted_iterations,
    "pixels_place": wanted_pixels_place,
}
"""Setting of the section `train` that may be ``auto`` (`AUTO_SETTINGS`) -> its rule."""


@dataclass(frozen=True)
class Plan:
    """Facts and decisions, in the order in which they are printed."""

    facts: SceneFacts
    decisions: tuple[Decision, ...]

    def apply(self, config: Config) -> Config:
        """The configuration with everything decided: a plan of it changes nothing."""
        made = {decision.setting: decision.value for decision in self.decisions if decision.made == "auto"}
        if (batch := made.pop("batch_for", None)) is not None:
            config = with_batch_for(config, int(batch))
        if (iterations := made.pop("iterations", None)) is not None:
            config = with_iterations(config, int(iterations))
        return config.changed(train=made)

    def text(self) -> str:
        """For a terminal, and ``plan.txt`` of a run: a line a decision."""
        rows = [(each.setting, yaml_text(each.value), each.made, each.reason) for each in self.decisions]
        names, values = (max(len(row[column]) for row in rows) for column in (0, 1))
        lines = [f"  train.{name:<{names}} {value:<{values}}  {made:<4}  {why}" for name, value, made, why in rows]
        return "\n".join([f"plan for {self.facts.train_views} training views", *lines])


def make_plan(config: Config, scene: Scene, device: torch.device, processes: int = 1) -> Plan:
    """Look at a loaded scene and the machine, and decide what is ``auto`` in the configuration, within its budgets, for
    this number of processes that train one model together on `device`."""
    limit, asked = config.budget.memory_bytes(), config.train.exposure == AUTO
    return plan_from_facts(gather_facts(scene, device, limit, processes, asked), config)


def plan_from_facts(facts: SceneFacts, config: Config) -> Plan:
    """The plan that these facts lead to."""
    return Plan(facts, tuple(decide(setting, facts, config) for setting in RULES))
