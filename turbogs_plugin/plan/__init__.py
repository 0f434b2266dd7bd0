"""What a run leaves out because its scene and machine do not need it: facts, decisions, and the plan made of them."""

from turbogs_plugin.plan.decisions import Decision
from turbogs_plugin.plan.facts import SceneFacts, gather_facts
from turbogs_plugin.plan.plan import Plan, make_plan

__all__ = ["Decision", "Plan", "SceneFacts", "gather_facts", "make_plan"]
