"""Decisions of a run by its scene and machine: facts, the settings that are ``auto``, and the plan made of both.

Beside it the limits of a run: the cap on Gaussians, and memory.
"""

from turbogs_plugin.plan.decisions import Decision, Plan, make_plan
from turbogs_plugin.plan.facts import SceneFacts, gather_facts

__all__ = ["Decision", "Plan", "SceneFacts", "gather_facts", "make_plan"]
