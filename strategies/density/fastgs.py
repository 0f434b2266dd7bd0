"""Density control by multi-view consistency, after the idea of FastGS (Ren et al. 2025, arXiv 2511.04283)."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.strategies.checks import require_settings
from turbogs_plugin.strategies.density.error_driven import ErrorDrivenDensity
from turbogs_plugin.strategies.density.rows import add_stats, finite_rows, keep_one, load_rows, removal
from turbogs_plugin.strategies.protocols import DensityController
from turbogs_plugin.types import Gaussians, GaussianStats, RowUpdate, Step

ABSGRAD_THRESHOLD, PERCENT_DENSE = 1.2e-3, 0.001
"""`absgrad_threshold` and `percent_dense` of `ErrorDrivenDensity`; FastGS's values."""

ERROR_THRESHOLD = 1.0
"""Least mean error of a marked Gaussian in a batch, in units of the batch's mean error."""

CONSISTENCY = 0.5
"""Least share of the batches that mark a Gaussian, of those that saw it, for it to be densified."""

PRUNE_EVERY = 6
"""Interval of the pruning after densification, in intervals of densification: 3000 iterations for 500."""

BLAME_THRESHOLD = 0.9
"""Share of the largest blame above which a Gaussian is pruned."""


@dataclass
class ViewVotes:
    """Votes of a window's batches about each Gaussian, [N] float32 each. A batch is the views of one iteration.

    Args:
        seen: number of batches in which the Gaussian had weight.
        marked: number of batches in which its error stood out.
        blame: sum of the mean errors of the batches that marked it.
    """

    seen: Tensor
    marked: Tensor
    blame: Tensor

    @classmethod
    def zeros(cls, count: int, device: torch.device | str) -> ViewVotes:
        return cls(*(torch.zeros(count, device=device) for _ in fields(cls)))

    def add(self, batch: GaussianStats) -> None:
        """Count one batch, given the statistics of its iteration. A Gaussian with non-finite sums was not seen."""
        seen = (batch.weight_sums > 0) & torch.isfinite(batch.weight_sums + batch.error_sums)
        errors, weights = (torch.where(seen, sums, 0.0) for sums in (batch.error_sums, batch.weight_sums))
        mean_error = errors.sum() / weights.sum().clamp(min=1e-12)
        marked = seen & (errors > ERROR_THRESHOLD * mean_error * weights)
        self.seen += seen
        self.marked += marked
        self.blame += marked * mean_error


@dataclass
class FastGsDensity(DensityController):
    """Densify Gaussians that many views find badly rendered; prune those with the largest *blame*, the sum of the mean
    errors of the batches that marked them.

    FastGS renders some training views in full at each event, marks the pixels of large (normalised) error, and scores
    each Gaussian by the marked pixels in its footprint. For densification the score is their mean number over the
    views; for pruning it is their number times each view's photometric error, normalised. `FastGsDensity` keeps these
    two ideas without the extra renders: an event uses the batches of the iterations since the last event. In a batch, a
    Gaussian is *marked* if its mean error, sum of e * w over sum of w, exceeds `ERROR_THRESHOLD` times the batch's mean
    error. In ``configs/fastgs.yaml`` a batch is one view.

    Until `Step.refine_until`, every `refine_every` iterations from `refine_from` on, a Gaussian is cloned or split
    where its screen gradient, or its absolute one, passes the threshold *and* at least `CONSISTENCY` of the batches
    that saw it marked it. Transparent and huge ones are pruned. Afterwards, every `PRUNE_EVERY` intervals, transparent
    ones are pruned. Gaussians are pruned, too, whose blame exceeds `BLAME_THRESHOLD` of the largest, unless all have
    that much. Both kinds of event prune Gaussians that are not finite. One Gaussian is always left.

    Args:
        refine_from: first iteration of densification.
        refine_every: interval of densification. The interval of the pruning afterwards is `PRUNE_EVERY` times as long.
    """

    refine_from: int = 500
    refine_every: int = 500
    watched = ("statistics",)  # an iteration's batch votes by its mean error, over all Gaussians
    _events: ErrorDrivenDensity = field(init=False, repr=False)
    _batch: GaussianStats = field(init=False, repr=False)
    _votes: ViewVotes = field(init=False, repr=False)

    def __post_init__(self) -> None:
        require_settings(self)
        # Another controller has the window, and the events. Its gradients decide which Gaussians may be densified.
        self._events = ErrorDrivenDensity(
            refine_from=self.refine_from,
            refine_every=self.refine_every,
            absgrad_threshold=ABSGRAD_THRESHOLD,
            percent_dense=PERCENT_DENSE,
            score="raw",
            lambda_base=0.0,
            top_fraction=1.0,
            final_keep=1.0,
        )

    @property
    def stats(self) -> GaussianStats:
        return self._batch

    def setup(self, gaussians: Gaussians) -> None:
        self._restart(len(gaussians), gaussians.device)

    def event_due(self, step: Step) -> bool:
        return self._events.due(step)[0] or self._prune_due(step)

    def _prune_due(self, step: Step) -> bool:
        after = step.iteration - step.refine_until
        return after > 0 and after % (PRUNE_EVERY * self.refine_every) == 0

    @torch.no_grad()
    def update(self, gaussians: Gaussians, step: Step) -> RowUpdate | None:
        self._votes.add(self._batch)
        add_stats(self._events.window, self._batch)
        self._batch.zero_()
        if not self.event_due(step):
            return None
        update = self._densify(gaussians, step) if self._events.due(step)[0] else self._prune(gaussians)
        self._restart(len(gaussians), gaussians.device)
        return update

    def apply(self, update: RowUpdate) -> None:
        self._restart(len(update.source), update.source.device)  # a window starts anew at each event

    def state_dict(self) -> dict[str, Any]:
        return {name: dict(vars(part)) for name, part in self._parts().items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name, part in self._parts().items():
            load_rows(name, part, state[name])

    def _parts(self) -> dict[str, GaussianStats | ViewVotes]:
        return {"batch": self._batch, "window": self._events.window, "votes": self._votes}

    def _restart(self, count: int, device: torch.device) -> None:
        self._batch, self._events.stats = (GaussianStats.zeros(count, device) for _ in range(2))
        self._votes = ViewVotes.zeros(count, device)

    def _densify(self, gaussians: Gaussians, step: Step) -> RowUpdate | None:
        window, votes = self._events.window, self._votes
        agreed = (votes.marked >= CONSISTENCY * votes.seen) & (votes.seen > 0)
        window.grad_sums *= agreed
        window.absgrad_sums *= agreed
        return self._events.update(gaussians, step)

    def _prune(self, gaussians: Gaussians) -> RowUpdate | None:
        if len(gaussians) == 0:
            return None
        blame = self._votes.blame
        blamed = blame > BLAME_THRESHOLD * blame.max()
        blamed &= ~blamed.all()  # all alike: nothing distinguishes them
        transparent = torch.sigmoid(gaussians.opacities) < self._events.prune_opacity
        return removal(~keep_one(finite_rows(gaussians) & ~(blamed | transparent), gaussians)[0])
