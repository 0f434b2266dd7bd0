"""The plan of a run: what was decided by which numbers, and the configuration that follows from it."""

from __future__ import annotations

import json
import textwrap
from dataclasses import asdict, dataclass

import torch

from turbogs_plugin.config.configuration import Config, resolve
from turbogs_plugin.config.scaling import with_batch_for, with_iterations
from turbogs_plugin.config.sections import AUTO
from turbogs_plugin.config.typed import build_dataclass
from turbogs_plugin.plan.decisions import RULES, Decision, decide, mebibytes
from turbogs_plugin.plan.facts import SceneFacts, gather_facts
from turbogs_plugin.scene import Scene
from turbogs_plugin.yaml_json import parse_json


@dataclass(frozen=True)
class Plan:
    """Facts and decisions, in the order in which they are printed."""

    facts: SceneFacts
    decisions: tuple[Decision, ...]

    def apply(self, config: Config) -> Config:
        """The configuration with everything decided: a plan of it changes nothing."""
        mapping = config.to_mapping()
        for decision in self.decisions:
            section, key = decision.setting.split(".")
            if decision.made == "set":
                continue
            if decision.setting == "train.batch_for":
                mapping = with_batch_for(resolve(mapping), decision.value).to_mapping()
            elif decision.setting == "train.iterations":
                mapping = with_iterations(resolve(mapping), decision.value).to_mapping()
            else:
                mapping[section][key] = decision.value
        return resolve(mapping)

    def text(self) -> str:
        """For a terminal: the facts, and a line a decision."""
        name = max(len(decision.setting) for decision in self.decisions)
        value = max(len(decision.text) for decision in self.decisions)
        lines = [
            f"  {decision.setting:<{name}} {decision.text:<{value}}  {decision.made:<4}  {decision.reason}"
            for decision in self.decisions
        ]
        facts = textwrap.fill(self.facts_text(), 118, initial_indent="plan for ", subsequent_indent="  ")
        return "\n".join([facts, *lines])

    def facts_text(self) -> str:
        """The facts in a sentence."""
        facts = self.facts
        width, height = facts.largest_photo
        parts = [
            f"{facts.train_views} + {facts.test_views} views of at most {width}x{height} pixels",
            f"{facts.points} points",
            f"view directions concentrated to {facts.direction_concentration:.3f}",
            f"{mebibytes(facts.photo_bytes)} of photos",
            f"{mebibytes(facts.map_bytes)} of maps",
            f"{mebibytes(facts.device_free_bytes)} free on the {facts.device.upper()}",
        ]
        if facts.memory_limit is not None:
            parts[-1] += f", of which {mebibytes(facts.memory_limit)} may be used"
        if facts.device != "cpu":
            parts.append(f"{mebibytes(facts.host_free_bytes)} on the host")
        if facts.processes > 1:
            parts.append(f"{facts.processes} processes")
        return f"{facts.scene}: {', '.join(parts)}"

    def to_json(self) -> str:
        """Read back by `from_json`."""
        return json.dumps(asdict(self), indent=1) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Plan:
        """Raises `InputError` where the text is not a plan's."""
        return build_dataclass(cls, parse_json(text, "the plan"), "plan")


def make_plan(config: Config, scene: Scene, device: torch.device, processes: int = 1) -> Plan:
    """Look at scene and machine, and decide what the configuration leaves to decide, within its budgets.

    Args:
        config: what is ``auto`` in it is decided.
        scene: loaded.
        device: where training is to be.
        processes: that will train one model together.
    """
    asked = config.train.exposure == AUTO
    limit = config.budget.memory_bytes()
    facts = gather_facts(scene, device, memory_limit=limit, processes=processes, with_exposures=asked)
    return plan_from_facts(facts, config)


def plan_from_facts(facts: SceneFacts, config: Config) -> Plan:
    """The plan that these facts lead to."""
    return Plan(facts, tuple(decide(setting, facts, config) for setting in RULES))
