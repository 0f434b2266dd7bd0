"""`SparseAdam` and `MomentLMOptimizer` behind gsplat's dict of optimizers, one for each parameter.

A Gaussian's parameters are solved for together, but a gsplat trainer steps one optimizer after another and clears each
gradient in between. Each member of the dict is therefore a `torch.optim.Optimizer` that *hands over* its gradient when
it is stepped, and whichever member comes last, in any order, carries out the update of all.

A member's ``state`` holds its parameter's moments, with one row a Gaussian, as gsplat's operations on rows expect, and
"step", which they leave as it is. The bias correction counts steps of the host, as torch's Adam does: a new Gaussian,
whose moments are zero, then moves faster than its rate (see `GaussianMoments`), which hosts of few steps live on.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.engine.moments import GaussianMoments, check_moments_config
from turbogs_plugin.errors import InputError, require
from turbogs_plugin.gsplat_bridge.host import GEOMETRY, ROLES, host_gaussians, require_keys, require_one_process
from turbogs_plugin.strategies.learning_rates import LearningRates
from turbogs_plugin.strategies.optimizers.sparse_adam import SparseAdam
from turbogs_plugin.types import PARAMETER_NAMES, GaussianGradients, Gaussians, Step

COUNT = "step"
"""State of the means' member alone: [] float on the host, the updates so far. Named as in torch's Adam."""

MOMENTS = ("exp_avg", "exp_avg_sq")

MOST_SKIPPED = 50
"""Iterations that may be skipped where fewer are made. A `GradScaler` halves its scale at each, so it needs a few dozen
at most."""


class SharedOptimizer:
    """Takes the place of an optimizer class: called once for each parameter, gives the members of one shared update.

    Args:
        optimizer: a `SparseAdam`, as a `MomentLMOptimizer` is, too. Its learning rates, betas and eps are those of the
            members' parameter groups. Autograd gives the sum of the gradients over views, so J has one row.
    """

    def __init__(self, optimizer: SparseAdam) -> None:
        if not isinstance(optimizer, SparseAdam):
            name = optimizer.__name__ if isinstance(optimizer, type) else type(optimizer).__name__
            raise InputError(f"SharedOptimizer takes SparseAdam() or MomentLMOptimizer(), an instance: got {name}")
        self.optimizer = copy.copy(optimizer)
        self.members: dict[str, MemberOptimizer] = {}
        self._gradients: dict[str, Tensor | None] = {}
        self._made = self._dropped = 0

    def __call__(
        self,
        params: Iterable[dict[str, Any]],
        lr: float = 1e-3,
        betas: tuple[float, float] | None = None,
        eps: float | None = None,
        fused: bool | None = None,
    ) -> MemberOptimizer:
        """The member of one parameter, given by one group with "params", its "name" and "lr" as in gsplat's trainers;
        the other values are for a group that has none, and `fused` has no effect."""
        require_one_process("SharedOptimizer")
        both = (self.optimizer.beta1, self.optimizer.beta2) if betas is None else tuple(betas)
        defaults = {"lr": lr, "betas": both, "eps": self.optimizer.eps if eps is None else eps}
        member = MemberOptimizer(self, list(params), defaults)
        if member.name in self.members:
            raise InputError(f"there is a member for parameter '{member.name}' already: each name is given once")
        self.members[member.name] = member
        return member

    def hand_over(self, name: str, gradient: Tensor | None) -> None:
        """Take a member's gradient [N, ...]; the last one to come carries out the update of all parameters.

        A `GradScaler` leaves out each optimizer whose gradient has an inf: an iteration that lacks a member is skipped
        whole, as soon as the next one begins. Raises `InputError` after `MOST_SKIPPED` of them, and more than were
        made, and for a member that comes twice.
        """
        waiting = ", ".join(each for each in PARAMETER_NAMES if each in self.members and each not in self._gradients)
        again = name in self._gradients and gradient is not None
        if again or any(self.members[each].parameter.grad is not None for each in self._gradients):
            self._gradients, self._dropped = {}, self._dropped + 1
            said = f"an iteration was skipped, as in it the optimizer of {waiting} was not stepped"
            if self._dropped >= max(MOST_SKIPPED, self._made):
                raise InputError(
                    f"{said}, like {self._dropped} iterations, where {self._made} were made: step all in each, with no "
                    "gradient accumulated in one; where a GradScaler leaves it out, see why it is never finite"
                )
            if self._dropped == 1:
                print(f"SharedOptimizer: {said}. A GradScaler does that after an inf; else step all in each iteration.")
        if name in self._gradients:
            raise InputError(f"the optimizer of '{name}' was stepped twice: expected a step of {waiting} in between")
        self._gradients[name] = gradient
        if len(self._gradients) == len(self.members):
            self._update()

    def _update(self) -> None:
        require_one_process("SharedOptimizer")
        members, gradients = self.members, self._gradients
        require_keys(members, (*GEOMETRY, "sh0"), "optimizers", "make one of each parameter, as one update is shared")
        self._gradients = {}
        self._made += 1
        if all(gradient is None for gradient in gradients.values()):
            return
        gaussians = host_gaussians({name: member.parameter for name, member in members.items()}, members)
        self._take_options()
        self.optimizer.moments = moments = GaussianMoments.zeros(gaussians)
        moments.steps.fill_(int(members["means"].checked_state()[COUNT]))
        for place, moment in self._moments(moments):
            place.copy_(moment.reshape(place.shape))
        self.optimizer.step(gaussians, _one_row(gaussians, gradients), Step(0, 1, 1))
        for place, moment in self._moments(moments):
            moment.copy_(place.reshape(moment.shape))
        members["means"].checked_state()[COUNT] += 1

    def _take_options(self) -> None:
        """Learning rates, betas and eps of the members' groups. Raises `InputError` for what Adam cannot use."""
        groups = {name: member.param_groups[0] for name, member in self.members.items()}
        # Betas are lists, where read from JSON or YAML.
        options = {name: (*group["betas"], group["eps"]) for name, group in groups.items()}
        if len(set(options.values())) > 1:
            raise InputError(f"betas and eps differ between the members of one shared update: {options}")
        rates: dict[str, Any] = {name: float(group["lr"]) for name, group in groups.items()}
        check_moments_config(*options["means"])
        self.optimizer.learning_rates = LearningRates(**rates, means_final=rates["means"], batch_scale=1.0)
        self.optimizer.beta1, self.optimizer.beta2, self.optimizer.eps = options["means"]

    def _moments(self, packed: GaussianMoments) -> Iterator[tuple[Tensor, Tensor]]:
        """Each moment of each parameter: its place in the packed form, and the member's own tensor."""
        for name, member in self.members.items():
            state = member.checked_state()
            yield from ((packed.part(moment, name), state[moment]) for moment in MOMENTS)


class MemberOptimizer(torch.optim.Optimizer):
    """The part of a `SharedOptimizer` that is one parameter's; made by calling that."""

    def __init__(self, shared: SharedOptimizer, groups: list[Any], defaults: dict[str, Any]) -> None:
        names = [group.get("name") if isinstance(group, dict) else None for group in groups]
        roles = [ROLES.get(str(name), name) for name in names]
        if len(roles) != 1 or roles[0] not in PARAMETER_NAMES:
            raise InputError(
                f"a member of a shared update takes one group with a 'name' among {', '.join(PARAMETER_NAMES)}, got "
                f"groups named {names}: write [{{'params': p, 'name': 'means'}}] in the place of [p]; parameters of "
                "other names keep an optimizer of their own"
            )
        super().__init__(groups, defaults)
        require(len(self.param_groups[0]["params"]) == 1, "params", self.param_groups[0]["params"], "one tensor")
        self.shared = shared
        self.name: str = roles[0]

    def __getstate__(self) -> dict[str, Any]:
        """State for copies and pickles, with the part that torch's lacks."""
        return {**super().__getstate__(), "shared": self.shared, "name": self.name}

    @property
    def parameter(self) -> torch.nn.Parameter:
        """The parameter, never kept: gsplat's operations replace it. ValueError where a second group was added."""
        ((parameter,),) = (group["params"] for group in self.param_groups)
        return parameter

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]  # closures are refused
        """Hand the gradient over (``.grad`` is None afterwards); the last member to be stepped updates all. Raises
        `InputError` for a sparse gradient, a closure or a visibility mask, and as `SharedOptimizer.hand_over`."""
        if closure is not None:
            raise InputError("step takes no closure and no mask, rows without gradients stay: set visible_adam=False")
        gradient, self.parameter.grad = self.parameter.grad, None
        if gradient is not None and gradient.is_sparse:
            raise InputError(f"the gradient of '{self.name}' is sparse: expected a dense one (sparse_grad=False)")
        self.shared.hand_over(self.name, gradient)

    def checked_state(self) -> dict[str, Tensor]:
        """The state of the parameter, zeros at first. Raises `InputError` where it is not of the parameter's shape."""
        parameter, state = self.parameter, self.state[self.parameter]
        if not state:
            state.update({moment: torch.zeros_like(parameter) for moment in MOMENTS})
            if self.name == "means":
                state[COUNT] = torch.zeros(())
        for moment in MOMENTS:
            if state[moment].shape != parameter.shape:
                found, remedy = tuple(state[moment].shape), "rows were added or removed without the optimizer"
                shapes = f"shape {found}, not {tuple(parameter.shape)}"
                raise InputError(f"state '{moment}' of '{self.name}' has {shapes}: {remedy}")
        return state


def _one_row(gaussians: Gaussians, gradients: dict[str, Tensor | None]) -> GaussianGradients:
    """Autograd's gradients, name -> [N, ...], as one row, the sum over views; a missing one is zero."""
    rows, touched = {}, torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.device)
    for name, value in gaussians.items():
        found = gradients.get(name)
        gradient = torch.zeros_like(value) if found is None else found.reshape(value.shape)
        touched |= (gradient.unsqueeze(-1).flatten(1) != 0).any(dim=1)
        rows[name] = gradient if name == "shN" else gradient[None]
    return GaussianGradients(**rows, touched=touched)
