"""Error-driven density control (paper section 3.8)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from turbogs_plugin.strategies.checks import require_at_least_one, require_each, require_settings
from turbogs_plugin.strategies.density.growth import drawn_by_squares, split_in_two, squares_of
from turbogs_plugin.strategies.density.rows import WindowedDensity, finite_rows, keep_one, removal
from turbogs_plugin.types import Gaussians, RowUpdate, Step

EPS = 1e-12
"""Keeps divisions defined; the least weight a drawn splat can have in a pixel is 1e-4 / 255."""
FINAL_PRUNINGS = 3
"""Final prunings at most. The paper's runs of 5000 and 8000 iterations have two and three. A run that was made longer
without what counts iterations would have dozens, and lose most of its model to them."""
MOST_ROOM = 2.0
"""Largest size of a growing model in times of its cap, however much the final prunings remove."""


@dataclass
class ErrorDrivenDensity(WindowedDensity):
    """Densify where the screen gradient is high and the sampled pixels say the Gaussian is difficult; prune where a
    Gaussian is transparent, huge or easy. There is no reset of opacities.

    The difficulty score s of a Gaussian comes from its `GaussianStats` since the last event, the sums of error E,
    distance D and weight W::

        e = E / (W + eps),  d = D / (W + eps),  s = e + lambda_base * anneal * d

    A Gaussian with W = 0, or with non-finite sums, was not seen: it has no score, and is neither densified nor pruned
    by score. Equal scores are treated alike, except where a cap must choose between them: then the lower row is
    chosen, be it to grow or to be removed.

    Until `Step.refine_until`, every `refine_every` iterations from `refine_from` on, one event clones, splits and
    prunes. A Gaussian that is due for pruning is not densified. A Gaussian that is too large is pruned unless it is
    split, also where the cap leaves no room to split it. Afterwards, every `final_every` iterations, an event only
    prunes. At least one Gaussian is always left.

    Args:
        lambda_base: weight of the distance term in the score; 0.8 in the paper.
        score: difficulty as in the equation (`raw`), or with e and d each divided by its mean over the seen Gaussians
            (`balanced`), so that both count: d is about 1, e about 0.1.
        refine_from: first iteration of densification, tau_from; 200 in the paper.
        refine_every: interval of densification, Delta_dens; 100 .. 350 in the paper.
        grad_threshold: least screen gradient of what is densified, a mean over views in gsplat's units, tau_grad;
            1e-4 .. 2e-4 in the paper. Passing this or the next suffices.
        absgrad_threshold: least absolute screen gradient of what is densified, in the units of `grad_threshold`,
            tau_grad_abs; 2e-4 .. 4e-4 in the paper.
        top_fraction: share of the seen Gaussians, the most difficult, which may be densified, eta_topk; 0.5 .. 0.95 in
            the paper.
        percent_dense: largest standard deviation of what is cloned, in scene extents, rho_dense; larger ones are split.
            0.001 .. 0.02 in the paper.
        split: two draws from the Gaussian, all axes divided by 1.6 as in 3DGS (`sample`); or two halves along its
            longest axis, which is divided by 1.6, placed so that the pair has the parent's mean and covariance
            (`long_axis`).
        max_gaussians: most Gaussians once the last event is over; before, as many more as the final prunings that are
            to come take away (`bound`). A model that has more is reduced at the next event: Gaussians of least worth
            (`choose_by`) are removed first, those beyond `spare_beyond` last. 0: no cap.
        prune_world_reference: length that bounds the size of a Gaussian (`prune_world_size`): the scene extent, as in
            3DGS (`extent`). With `distance`, a Gaussian farther than that from the cameras' centre is compared with its
            distance from there, so it may be larger.
        prune_score_fraction: turnover: share of the Gaussians (seen, and not spared by `spare_beyond`) that each
            densification event removes before it adds any: those with the least score or squares, by `choose_by`. 0:
            off; the paper gives no value.
        opacity_decay: share of its opacity that every Gaussian loses at each densification event. If the photos need
            it, it grows back; if not, it falls below `prune_opacity`. A gentle substitute for 3DGS's reset.
        spare_beyond: distance from the cameras' centre, in scene extents, beyond which Gaussians are neither decayed
            nor pruned (unless they are not finite, or `max_gaussians` leaves no other choice). The distance protects a
            backdrop behind the scene, which few photos see. 0: none.
        choose_by: rule by which Gaussians grow and are removed. `difficulty`, the paper's: all grow that pass the
            thresholds, or the most difficult of them where `max_gaussians` has no room for all; the easiest are removed
            first. `squares` (see `growth`): as many grow as pass the threshold of the absolute gradient; which ones is
            drawn at random among those seen, in proportion to their squares. Gaussians with the least squares are
            removed first. `grad_threshold`, `top_fraction`, `score` and `lambda_base` then mean nothing.
        final_every: interval of the final pruning, Delta_prune; 500 in the paper. There are `FINAL_PRUNINGS` at most,
            the last one half an interval or more before the end.
        final_keep: share of the Gaussians, seen and not spared, that a final pruning keeps, eta_final; 0.8 .. 0.95 in
            the paper. 1 keeps all.
        prune_opacity: opacity below which Gaussians are pruned. The value and the following ones are 3DGS's, no
            settings.
        prune_world_size: largest standard deviation of a Gaussian over `prune_world_reference`. 0: off.
        prune_screen_size: largest screen radius of a Gaussian over the larger side of the image. 0: off; 3DGS has such
            a rule, which never takes effect there.
        prune_size_from: share of `refine_until` at which both size rules begin; 3DGS: iteration 3000 of 15,000.
    """

    lambda_base: float = 0.8
    score: Literal["balanced", "raw"] = "balanced"
    refine_from: int = 200
    refine_every: int = 100
    grad_threshold: float = 2e-4
    absgrad_threshold: float = 4e-4
    top_fraction: float = 0.5
    percent_dense: float = 0.01
    split: Literal["sample", "long_axis"] = "sample"
    max_gaussians: int = 0
    prune_world_reference: Literal["extent", "distance"] = "extent"
    prune_score_fraction: float = 0.0
    opacity_decay: float = 0.0
    spare_beyond: float = 0.0
    choose_by: Literal["difficulty", "squares"] = "difficulty"
    final_every: int = 500
    final_keep: float = 0.95
    prune_opacity: float = field(default=0.005, metadata={"setting": False})
    prune_world_size: float = field(default=0.1, metadata={"setting": False})
    prune_screen_size: float = field(default=0.0, metadata={"setting": False})
    prune_size_from: float = field(default=0.2, metadata={"setting": False})

    def __post_init__(self) -> None:
        require_at_least_one(self, "refine_every", "final_every")
        require_each(self, lambda value: 0 < value <= 1, "more than 0 and at most 1", "top_fraction", "final_keep")
        shares = ("prune_opacity", "prune_score_fraction", "opacity_decay")
        require_each(self, lambda value: 0 <= value < 1, "at least 0 and less than 1", *shares)
        require_settings(self)

    @torch.no_grad()
    def update(self, gaussians: Gaussians, step: Step) -> RowUpdate | None:
        if self.stats is None or len(gaussians) == 0:
            return None
        densify, final = self.due(step)
        over = self.max_gaussians > 0 and len(gaussians) > self.bound(step)
        reduce = over and self._reduction_due(step)
        update = None
        if densify:
            update = self._refine(gaussians, step)
        elif final or reduce:
            update = self._prune(gaussians, step, 1 - self.final_keep if final else 0.0)
        if densify or final or reduce:
            self.stats.zero_()
        if step.iteration >= self._last_event(step) and (reduce or not over):
            self.stats = None
        return update

    @property
    def uses_errors(self) -> bool:
        return self.stats is not None and self.choose_by == "difficulty"

    def scores(self, step: Step) -> tuple[Tensor, Tensor]:
        """([N] difficulty score, [N] bool seen) of the present window. The score 0 of an unseen one has no meaning."""
        stats, seen = self.window, self._seen()
        errors, distances = (
            torch.where(seen, sums / (stats.weight_sums + EPS), 0.0) for sums in (stats.error_sums, stats.distance_sums)
        )
        if self.score == "balanced":
            count = seen.sum().clamp(min=1)
            errors, distances = (value / (value.sum() / count + EPS) for value in (errors, distances))
        return errors + self.lambda_base * step.anneal * distances, seen

    def due(self, step: Step) -> tuple[bool, bool]:
        """(densifies, prunes finally): the two kinds of event at this iteration."""
        iteration, after = step.iteration, step.iteration - step.refine_until
        densify = after <= 0 and iteration >= self.refine_from and iteration % self.refine_every == 0
        final = 0 < after <= self._final_prunings(step) * self.final_every and after % self.final_every == 0
        return densify, final

    def event_due(self, step: Step) -> bool:
        return any(self.due(step)) or self._reduction_due(step)

    def growth_room(self, step: Step) -> float:
        return 1 / max(1 / MOST_ROOM, self.final_keep ** self._final_prunings_left(step))

    def bound(self, step: Step) -> int:
        """Most Gaussians after an event at this iteration; 0: any number. A model that grew beyond its cap and was then
        reduced by worth is better than one of its size that never was beyond (docs/lab/tried.md)."""
        return math.floor(self.max_gaussians * self.growth_room(step) + 1e-6)

    def _reduction_due(self, step: Step) -> bool:
        """A model beyond its bound is reduced at this iteration: after densification, where a time budget has made the
        run too short for a final pruning that was counted on."""
        after = step.iteration > step.refine_until and step.iteration % self.refine_every == 0
        return after and self.max_gaussians > 0 and self.stats is not None

    def _last_event(self, step: Step) -> int:
        """Iteration after which no statistics are needed: the last event's, or the end of densification, not its last
        event: a time budget may still move `refine_until` and make room for another one."""
        return step.refine_until + self._final_prunings(step) * self.final_every

    def _final_prunings(self, step: Step) -> int:
        """Number of final prunings of the run."""
        # Half an interval at least is left after the last, so that a length which is off by a few has as many.
        fitting = math.floor((step.total - step.refine_until) / self.final_every - 0.5)
        return min(FINAL_PRUNINGS, max(0, fitting)) if self.final_keep < 1 else 0

    def _final_prunings_left(self, step: Step) -> int:
        """Number of final prunings after this iteration."""
        over = max(0, step.iteration - step.refine_until) // self.final_every
        return max(0, self._final_prunings(step) - over)

    def _seen(self) -> Tensor:
        """[N] bool: with a weight in the present window, and finite sums."""
        stats = self.window
        weights = stats.weight_sums
        return (weights > 0) & torch.isfinite(weights + stats.error_sums + stats.distance_sums)

    def _refine(self, gaussians: Gaussians, step: Step) -> RowUpdate | None:
        worth, known, seen = self._worth(step)
        finite = finite_rows(gaussians)
        spared = self._spared(gaussians, finite, step)
        sound = finite & (torch.sigmoid(gaussians.opacities) >= self.prune_opacity)
        if self.prune_score_fraction > 0:
            sound &= ~_lowest(worth, known & seen & ~spared, self.prune_score_fraction)
        keys = drawn_by_squares(self.window, step) if self.choose_by == "squares" else worth
        order = keys.argsort(descending=True, stable=True)  # who grows first; of equal keys the lower rows
        candidates = self._passing(worth, seen) & sound
        if self.choose_by == "squares":
            candidates = _first(order, seen & sound, candidates.sum())
        largest = gaussians.scales.amax(dim=-1).exp()  # [N]
        large = largest > self.percent_dense * step.scene_extent
        fitting = ~self._oversized(gaussians, largest, step)
        kept, count = keep_one(spared | (sound & (fitting | (candidates & large))), gaussians)
        candidates &= kept
        if self.max_gaussians > 0:
            candidates = _first(order, candidates, max(0, self.bound(step) - count))
            # Those that are too large leave where there is no room to split them.
            kept, count = keep_one(kept & (fitting | spared | candidates), gaussians)
            kept = self._within_bound(kept, count, worth, known, spared, step)  # if it removes any, nothing was chosen
        return self._compose(gaussians, candidates & ~large, candidates & large, kept, spared, step)

    def _passing(self, worth: Tensor, seen: Tensor) -> Tensor:
        """[N] bool, which pass the gates: a high screen gradient and, by difficulty, a high score."""
        stats = self.window
        views = stats.view_counts.clamp(min=1)
        absolute = seen & (stats.absgrad_sums / views > self.absgrad_threshold)
        if self.choose_by == "squares":
            return absolute
        passes = absolute | (stats.grad_sums / views > self.grad_threshold)
        return passes & seen & (worth >= _quantile(worth, seen, 1 - self.top_fraction))

    def _oversized(self, gaussians: Gaussians, largest: Tensor, step: Step) -> Tensor:
        """[N] bool, which are too large by the size rules, if those have begun; `largest`: standard deviations [N]."""
        oversized = torch.zeros_like(largest, dtype=torch.bool)
        if step.progress < self.prune_size_from:
            return oversized
        if self.prune_world_size > 0:
            reference = step.scene_extent
            if self.prune_world_reference == "distance":
                reference = gaussians.means.norm(dim=-1).clamp(min=reference)
            oversized = largest > self.prune_world_size * reference
        if self.prune_screen_size > 0:
            oversized |= self.window.max_radii > self.prune_screen_size
        return oversized

    def _worth(self, step: Step) -> tuple[Tensor, Tensor, Tensor]:
        """([N] worth, [N] bool where it is known, [N] bool seen). Gaussians that are worth less are removed sooner.

        Worth is the score, or the squares. A Gaussian that was not seen has no known score; its squares are 0, so by
        squares it is worth least.
        """
        if self.choose_by == "squares":
            return *squares_of(self.window), self._seen()
        score, seen = self.scores(step)
        return score, seen, seen

    def _spared(self, gaussians: Gaussians, finite: Tensor, step: Step) -> Tensor:
        """[N] bool: the finite ones that lie beyond `spare_beyond`."""
        beyond = self.spare_beyond * step.scene_extent if self.spare_beyond > 0 else math.inf
        return finite & (gaussians.means.norm(dim=-1) > beyond)

    def _prune(self, gaussians: Gaussians, step: Step, share: float) -> RowUpdate | None:
        """Remove the `share` of least worth, and what is beyond the bound."""
        finite = finite_rows(gaussians)
        worth, known, seen = self._worth(step)
        spared = self._spared(gaussians, finite, step)
        kept = finite & ~_lowest(worth, known & seen & ~spared, share)
        kept, count = keep_one(kept, gaussians)
        return removal(~self._within_bound(kept, count, worth, known, spared, step))

    def _within_bound(
        self, kept: Tensor, count: int, worth: Tensor, known: Tensor, spared: Tensor, step: Step
    ) -> Tensor:
        """[N] bool: the `count` Gaussians of `kept`, without the ones of least worth where the cap allows fewer."""
        excess = count - self.bound(step) if self.max_gaussians > 0 else 0
        return kept & ~_least(worth, known, kept, spared, excess) if excess > 0 else kept

    def _compose(
        self, gaussians: Gaussians, cloned: Tensor, split: Tensor, kept: Tensor, spared: Tensor, step: Step
    ) -> RowUpdate | None:
        """One change from masks [N]; whoever is cloned or split is kept.

        New rows: the Gaussians that stay, the clones, then both halves of the split.
        """
        rest, copies, halves = (torch.nonzero(mask).squeeze(-1) for mask in (kept & ~split, cloned, split))
        if len(rest) == len(gaussians) and len(copies) == 0 and self.opacity_decay == 0:
            return None
        source = torch.cat([rest, copies, halves, halves])
        fresh = torch.arange(len(source), device=source.device) >= len(rest)
        values = {}
        if len(halves):
            values = {"means": gaussians.means[source], "scales": gaussians.scales[source]}
            means, scales = split_in_two(gaussians, halves, self.split, step)
            values["means"][-2 * len(halves) :], values["scales"][-2 * len(halves) :] = means, scales
        if self.opacity_decay > 0:
            opacities = torch.where(spared, gaussians.opacities, _decayed(gaussians.opacities, self.opacity_decay))
            values["opacities"] = opacities[source]
        num_pruned = len(gaussians) - len(rest) - len(halves)
        return RowUpdate(source, fresh, values, num_cloned=len(copies), num_split=len(halves), num_pruned=num_pruned)


def _quantile(values: Tensor, mask: Tensor, fraction: float) -> Tensor:
    """The value at rank ``floor(fraction * n)`` of the n masked values [N] in ascending order; 0 if there are none.

    At most ``floor(fraction * n)`` values are less than it, fewer in case of ties.
    """
    chosen = values[mask]
    if len(chosen) == 0:
        return values.new_zeros(())
    rank = min(len(chosen) - 1, math.floor(fraction * len(chosen) + 1e-6))  # 1 - 0.9 of 10 is 1
    return chosen.sort().values[rank]


def _lowest(values: Tensor, mask: Tensor, share: float) -> Tensor:
    """[N] bool: this share of the masked rows, those with the least values; fewer in case of ties."""
    return mask & (values < _quantile(values, mask, share))


def _first(order: Tensor, mask: Tensor, count: int | Tensor) -> Tensor:
    """[N] bool: the `count` rows of the mask (or all, if fewer) that come first in an order of all rows [N].

    The count may lie on the GPU, which nothing here waits for.
    """
    ordered = mask[order]
    return torch.empty_like(mask).scatter_(0, order, ordered & (ordered.cumsum(0) <= count))


def _least(worth: Tensor, known: Tensor, present: Tensor, spared: Tensor, count: int) -> Tensor:
    """[N] bool: the `count` of those `present` that are worth the least; spared ones only if the others do not suffice.

    A Gaussian whose worth is not known counts as average, as nothing says that it is worth little.
    """
    average = torch.where(known, worth, 0.0).double().sum() / known.sum().clamp(min=1)  # the sum may overflow float32
    order = torch.where(known, worth, average.to(worth)).argsort(stable=True)
    taken = _first(order, present & ~spared, count)
    return taken | _first(order, present & spared, count - taken.sum())


def _decayed(logits: Tensor, decay: float) -> Tensor:
    """Logits of the opacities times (1 - decay). Computed by logarithms, so that no opacity rounds to 0 or 1."""
    log_opacity = logsigmoid(logits) + math.log1p(-decay)
    return log_opacity - torch.log(-torch.expm1(log_opacity))
