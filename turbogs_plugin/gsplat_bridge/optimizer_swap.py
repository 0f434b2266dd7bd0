"""`SparseAdam` and `MomentLMOptimizer` behind gsplat's dict of optimizers, one for each parameter.

A Gaussian's parameters are solved for together, but a gsplat trainer steps one optimizer after another and clears each
gradient in between. Each member of the dict is therefore a `torch.optim.Optimizer` that *hands over* its gradient when
it is stepped, and whichever member comes last, in any order, carries out the update of all. Until then no parameter
moves.

A member's ``state`` holds what is kept for its parameter, as gsplat's operations on rows expect: the moments are
tensors with one row a Gaussian; "step", which they leave as it is, is one number. The bias correction counts steps of
the host, as torch's Adam does, not updates of each Gaussian: a new Gaussian, whose moments are zero, then moves faster
than its rate (`GaussianMoments` says by how much), which hosts of few steps live on. Learning rate, betas and eps come
from the member's own parameter group.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.engine.moments import GaussianMoments, check_moments_config
from turbogs_plugin.errors import InputError, require
from turbogs_plugin.gsplat_bridge.gaussian_errors import loss_shares
from turbogs_plugin.gsplat_bridge.host import GEOMETRY, ROLES, host_gaussians, require_one_process
from turbogs_plugin.strategies.learning_rates import LearningRates
from turbogs_plugin.strategies.optimizers.sparse_adam import SparseAdam
from turbogs_plugin.types import PARAMETER_NAMES, GaussianGradients, Gaussians, Step

COUNT = "step"
"""State of the means' member alone: [] float on the host, the updates so far. Named as in torch's Adam: gsplat's
operations take every other value for one with rows."""

MOMENTS = ("exp_avg", "exp_avg_sq")

MOST_SKIPPED = 50
"""Iterations that may be skipped where fewer are made. A `GradScaler` halves its scale at each, so it needs a few dozen
at most."""

NEEDED = (*GEOMETRY, "sh0")
"""Parameters without whose optimizer there is no update: a host may have no harmonics."""


class SharedOptimizer:
    """Takes the place of an optimizer class: called once for each parameter, gives the members of one shared update.

    Example::

        optimizer_class = SharedOptimizer(MomentLMOptimizer())
        optimizers = {
            name: optimizer_class([{"params": splats[name], "lr": lr, "name": name}], eps=1e-15)
            for name, lr in rates.items()
        }

    Args:
        optimizer: a `SparseAdam`, as a `MomentLMOptimizer` is, too. Its learning rates, betas and eps are replaced by
            the values of the members' parameter groups. Autograd gives the sum of the gradients over views, so J has
            one row, whatever `MomentLMOptimizer.rows` says.
    """

    def __init__(self, optimizer: SparseAdam) -> None:
        if not isinstance(optimizer, SparseAdam):
            name = optimizer.__name__ if isinstance(optimizer, type) else type(optimizer).__name__
            raise InputError(f"SharedOptimizer takes SparseAdam() or MomentLMOptimizer(), an instance: got {name}")
        self.optimizer = copy.copy(optimizer)
        self.members: dict[str, MemberOptimizer] = {}
        self.skipped: Tensor | None = None
        self._gradients: dict[str, Tensor | None] = {}
        self._infos: list[dict[str, Any]] = []  # shown since the first gradient of this round
        self._shown: list[dict[str, Any]] = []  # shown before it
        self._told = False
        self._told_skipped = False
        self._made = self._dropped = 0

    def __call__(
        self,
        params: Iterable[dict[str, Any]],
        lr: float = 1e-3,
        betas: tuple[float, float] | None = None,
        eps: float | None = None,
        fused: bool | None = None,
    ) -> MemberOptimizer:
        """The member of one parameter.

        Args:
            params: one group with "params", "name" (of the parameter) and "lr", as gsplat's trainers make them.
            lr, betas, eps: values for a group that has none; the optimizer's where None.
            fused: taken for the sake of hosts that pass it; the update is one for all parameters in any case.
        """
        require_one_process("SharedOptimizer")
        both = (self.optimizer.beta1, self.optimizer.beta2) if betas is None else tuple(betas)
        defaults = {"lr": lr, "betas": both, "eps": self.optimizer.eps if eps is None else eps}
        member = MemberOptimizer(self, list(params), defaults)
        if member.name in self.members:
            raise InputError(f"there is a member for parameter '{member.name}' already: each name is given once")
        self.members[member.name] = member
        return member

    def observe(self, info: dict[str, Any]) -> None:
        """Show this iteration's `info`, before or after backward; of several renders, one after the other. From
        "prediction" and "ground_truth" in it follow the Gaussians' shares of the loss, which the damped system needs;
        without them the step is Adam's."""
        if all(info is not other for other in self._infos):
            self._infos.append(info)

    def hand_over(self, name: str, gradient: Tensor | None) -> None:
        """Take a member's gradient; the last one to come carries out the update of all parameters.

        Raises:
            InputError: there is one of this member already.
        """
        if name in self._gradients:
            raise InputError(
                f"the optimizer of '{name}' was stepped twice: expected, as one update is shared by all, "
                f"a step of {', '.join(self._waiting())} in between"
            )
        if not self._gradients:
            self._shown, self._infos = self._infos, []
        self._gradients[name] = gradient
        if len(self._gradients) == len(self.members):
            self._update()

    def drop_stale(self) -> None:
        """Forget the gradients of an iteration in which not all members were stepped, as soon as the next one begins.

        A `GradScaler` leaves out each optimizer whose gradient has an inf. The iteration is then skipped whole, for all
        parameters, so no update mixes two iterations. The first such iteration is printed.

        Raises:
            InputError: `MOST_SKIPPED` iterations, and more than were made, lacked a member.
        """
        if all(self.members[name].parameter.grad is None for name in self._gradients):
            return  # no backward ran since they were handed over
        waiting = self._waiting()
        self._gradients = {}
        self._dropped += 1
        if self._dropped >= max(MOST_SKIPPED, self._made):
            raise InputError(
                f"the optimizer of {', '.join(waiting)} was left out, and {self._dropped} iterations were skipped for "
                f"that, {self._made} made: step all in each iteration, with no gradient accumulated in one of them; "
                "where a GradScaler leaves one out, see why its gradient is never finite"
            )
        if not self._told_skipped:
            print(
                f"SharedOptimizer: an iteration was skipped, as in it the optimizer of {', '.join(waiting)} was not "
                "stepped. A GradScaler does that after an inf; else step all in each iteration."
            )
        self._told_skipped = True

    def _waiting(self) -> list[str]:
        """The parameters whose gradient this round lacks."""
        return [name for name in PARAMETER_NAMES if name in self.members and name not in self._gradients]

    def _update(self) -> None:
        require_one_process("SharedOptimizer")
        members, gradients = self.members, self._gradients
        missing = [name for name in NEEDED if name not in members]
        if missing:
            raise InputError(
                f"there is no optimizer of {', '.join(missing)}: make one of each parameter, as one update is shared"
            )
        self._gradients = {}
        self._made += 1
        if all(gradient is None for gradient in gradients.values()):
            return
        gaussians = host_gaussians({name: member.parameter for name, member in members.items()}, members)
        given: dict[str, Tensor] = {}
        for name, value in gaussians.items():
            gradient = gradients.get(name)
            given[name] = torch.zeros_like(value) if gradient is None else gradient.reshape(value.shape)
        self._take_options()
        moments = self._pack(gaussians)
        self.optimizer.moments = moments
        self.optimizer.step(gaussians, _one_row(given, self._shares(gaussians)), Step(0, 1, 1))
        self._shown = []
        for place, moment in self._moments(moments):
            moment.copy_(place.reshape(moment.shape))
        members["means"].checked_state()[COUNT] += 1

    def _take_options(self) -> None:
        """Learning rates, betas and eps of the members' groups.

        Raises:
            InputError: betas or eps differ between members, or are none that Adam can use.
        """
        groups = {name: member.param_groups[0] for name, member in self.members.items()}
        betas = {name: tuple(group["betas"]) for name, group in groups.items()}  # lists, where read from JSON or YAML
        epsilons = {name: group["eps"] for name, group in groups.items()}
        for option, values in (("betas", betas), ("eps", epsilons)):
            if len(set(values.values())) > 1:
                raise InputError(
                    f"{option} differ between the members of one shared update: {values}; expected one value"
                )
        rates: dict[str, Any] = {name: float(group["lr"]) for name, group in groups.items()}
        (beta1, beta2), eps = betas["means"], epsilons["means"]
        check_moments_config(beta1, beta2, eps)
        self.optimizer.learning_rates = LearningRates(**rates, means_final=rates["means"], batch_scale=1.0)
        self.optimizer.beta1, self.optimizer.beta2, self.optimizer.eps = beta1, beta2, eps

    def _pack(self, gaussians: Gaussians) -> GaussianMoments:
        """The members' state in the form that the rule takes."""
        packed = GaussianMoments.zeros(gaussians)
        if self.skipped is None:
            self.skipped = packed.skipped
        packed.skipped = self.skipped
        for place, moment in self._moments(packed):
            place.copy_(moment.reshape(place.shape))
        packed.steps.fill_(int(self.members["means"].checked_state()[COUNT]))
        return packed

    def _moments(self, packed: GaussianMoments) -> Iterator[tuple[Tensor, Tensor]]:
        """Each moment of each parameter: its place in the packed form, and the member's own tensor."""
        for name, member in self.members.items():
            state = member.checked_state()
            yield from ((packed.part(moment, name), state[moment]) for moment in MOMENTS)

    def _shares(self, gaussians: Gaussians) -> Tensor:
        """[1, N] the Gaussians' share of the loss, a mean over the renders; zero where nothing is known of it."""
        known = [loss_shares(info, len(gaussians)) for info in self._shown]
        shares = [value for value in known if value is not None]
        if not shares:
            if not self._told and self.optimizer.lm is not None:
                print(
                    f"{type(self.optimizer).__name__}: the Gaussians' shares of the loss are not known, so steps are "
                    "Adam's; put prediction and ground_truth into info before loss.backward(), and call "
                    "optimizers['means'].observe(info) after it (TurboDensityStrategy does that)."
                )
            self._told = True
            return gaussians.means.new_zeros(1, len(gaussians))
        return torch.stack(shares).mean(dim=0, keepdim=True).to(gaussians.means.dtype)


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
        """State for copies and pickles, with the part that torch's lacks. Members are copied together, as each
        knows the others."""
        return {**super().__getstate__(), "shared": self.shared, "name": self.name}

    @property
    def parameter(self) -> torch.nn.Parameter:
        """The parameter, never kept: gsplat's operations replace it. ValueError where a second group was added."""
        ((parameter,),) = (group["params"] for group in self.param_groups)
        return parameter

    def observe(self, info: dict[str, Any]) -> None:
        """See `SharedOptimizer.observe`; it is enough that one member is shown it."""
        self.shared.observe(info)

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]  # overloads
        """Hand the gradient over (``.grad`` is None afterwards); the last member to be stepped updates all.

        Where a backward ran before all members were stepped, as when a `GradScaler` left one out, what the others
        handed over before it is dropped: see `SharedOptimizer.drop_stale`.

        Raises:
            InputError: stepped twice before all the others were, a sparse gradient, or a mask in the closure's place.
        """
        if isinstance(closure, Tensor):
            raise InputError(
                "step takes no visibility mask, rows without a gradient stay anyway: set visible_adam=False"
            )
        loss = None
        if closure is None:
            self.shared.drop_stale()
        else:  # closures run a backward for each member, so a new gradient does not tell of a new iteration
            with torch.enable_grad():
                loss = closure()
        gradient, self.parameter.grad = self.parameter.grad, None
        if gradient is not None and gradient.is_sparse:
            raise InputError(f"the gradient of '{self.name}' is sparse: expected a dense one (sparse_grad=False)")
        self.shared.hand_over(self.name, gradient)
        return loss

    def checked_state(self) -> dict[str, Tensor]:
        """The state of the parameter, zeros at first.

        Raises:
            InputError: the state has another number of rows than the parameter.
        """
        parameter, state = self.parameter, self.state[self.parameter]
        if not state:
            state.update({moment: torch.zeros_like(parameter) for moment in MOMENTS})
            if self.name == "means":
                state[COUNT] = torch.zeros(())
        for moment in MOMENTS:
            if state[moment].shape != parameter.shape:
                raise InputError(
                    f"optimizer state '{moment}' of '{self.name}' has shape {tuple(state[moment].shape)}, "
                    f"expected {tuple(parameter.shape)}: rows were added or removed without the optimizer"
                )
        return state


def _one_row(gradients: dict[str, Tensor], shares: Tensor) -> GaussianGradients:
    """Autograd's gradients as one row, the sum over views.

    Args:
        gradients: name -> [N, ...].
        shares: [1, N].
    """
    touched = [(value.unsqueeze(-1).flatten(1) != 0).any(dim=1) for value in gradients.values()]
    rows = {name: value if name == "shN" else value[None] for name, value in gradients.items()}
    return GaussianGradients(**rows, touched=torch.stack(touched).any(dim=0), view_losses=shares)
