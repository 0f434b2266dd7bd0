"""The plan of a run: what was decided by which numbers, and the configuration that follows from it."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from turbogs_plugin.config.configuration import Config, resolve
from turbogs_plugin.config.scaling import with_batch_for, with_iterations
from turbogs_plugin.config.sections import AUTO
from turbogs_plugin.plan.decisions import RULES, Decision, decide
from turbogs_plugin.plan.facts import SceneFacts, gather_facts
from turbogs_plugin.scene import Scene


@dataclass(frozen=True)
class Plan:
    """Facts and decisions, in the order in which they are printed."""

    facts: SceneFacts
    decisions: tuple[Decision, ...]

    def apply(self, config: Config) -> Config:
        """The configuration with everything decided: a plan of it changes nothing."""
        made = {decision.setting: decision.value for decision in self.decisions if decision.made == "auto"}
        if (batch := made.pop("train.batch_for", None)) is not None:
            config = with_batch_for(config, int(batch))
        if (iterations := made.pop("train.iterations", None)) is not None:
            config = with_iterations(config, int(iterations))
        mapping = config.to_mapping()
        for setting, decided in made.items():
            section, key = setting.split(".")
            mapping[section][key] = decided
        return resolve(mapping)

    def text(self) -> str:
        """For a terminal, and ``plan.txt`` of a run: a line a decision."""
        name = max(len(decision.setting) for decision in self.decisions)
        value = max(len(decision.text) for decision in self.decisions)
        lines = [
            f"  {decision.setting:<{name}} {decision.text:<{value}}  {decision.made:<4}  {decision.reason}"
            for decision in self.decisions
        ]
        return "\n".join([f"plan for {self.facts.train_views} training views", *lines])


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
