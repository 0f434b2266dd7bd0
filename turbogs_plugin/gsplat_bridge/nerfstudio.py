"""Members of a `SharedOptimizer` as nerfstudio's configurations of optimizers: a run's config.yml holds and reads them.

Nerfstudio is not imported: a configuration of an optimizer is to it what has `setup`, `lr` and `max_norm`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch

from turbogs_plugin.errors import require
from turbogs_plugin.gsplat_bridge.optimizer_swap import MemberOptimizer, SharedOptimizer
from turbogs_plugin.strategies.optimizers.moment_lm import MomentLMOptimizer
from turbogs_plugin.strategies.optimizers.sparse_adam import SparseAdam

RULES = {"moment_lm": MomentLMOptimizer, "sparse_adam": SparseAdam}


@dataclass
class SharedOptimizerConfig:
    """One parameter group of splatfacto. The groups of a model that are set up one after the other share one update.

    Args:
        name: of the group, as "features_dc".
        lr, eps: as in Adam. max_norm: nerfstudio's bound of the gradient's norm, or None.
        rule: the optimizer.
    """

    name: str
    lr: float
    eps: float = 1e-15
    max_norm: float | None = None
    rule: Literal["moment_lm", "sparse_adam"] = "moment_lm"

    latest: ClassVar[SharedOptimizer | None] = None

    def setup(self, params: list[torch.nn.Parameter]) -> MemberOptimizer:
        """The optimizer of the group's one parameter; of a name that there is already, it begins another update."""
        require(self.rule in RULES, "rule", self.rule, f"among {', '.join(RULES)}")
        shared, cls = SharedOptimizerConfig.latest, RULES[self.rule]
        known = {} if shared is None else {member.param_groups[0]["name"] for member in shared.members.values()}
        if shared is None or self.name in known or type(shared.optimizer) is not cls:
            shared = SharedOptimizerConfig.latest = SharedOptimizer(cls())
        return shared([{"params": params, "lr": self.lr, "name": self.name}], eps=self.eps)
