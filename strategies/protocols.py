"""The protocols that strategies implement. A strategy gets tensors and small dataclasses, never a trainer.

Every strategy is a dataclass whose init fields are its configuration: ``Strategy(**mapping)`` builds it from YAML, and
the fields' defaults are the only defaults. Run-time state is kept in fields with ``init=False``. ``state_dict`` gives
it as plain tensors and numbers.
"""

from __future__ import annotations

from typing import Any, Protocol, TypedDict, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.engine.moments import GaussianMoments
from turbogs_plugin.engine.rules import LossTerms, UpdateRule
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.types import (
    Cameras,
    GaussianGradients,
    Gaussians,
    GaussianStats,
    LossOutput,
    PixelSamples,
    RowUpdate,
    SamplingBudget,
    Step,
)


@runtime_checkable
class SamplingSchedule(Protocol):
    """Chooses the number of views of an iteration, and the share of their pixels (appendix, adaptive scheduling)."""

    def query(self, step: Step, mean_error: float, initial_error: float, num_views: int) -> SamplingBudget:
        """The budget of this iteration; `views` never exceeds `num_views`."""


@runtime_checkable
class ViewSampler(Protocol):
    """Chooses the training views of an iteration (section 3.4)."""

    def setup(self, cameras: Cameras, scene_extent: float) -> None:
        """Take the geometry of the V training cameras; called once before training."""

    def select(self, count: int, view_errors: np.ndarray, step: Step) -> tuple[int, ...]:
        """`count` distinct view numbers. `view_errors`: [V] float64, mean error of each view."""

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint keeps: tensors and plain values."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what `state_dict` gave, after `setup`; `ValueError` where it does not fit."""


@runtime_checkable
class PixelSampler(Protocol):
    """Chooses the pixels of these views that are rendered (section 3.5).

    Attributes:
        heeds_masks: `sample` draws no masked pixel (``maps.masks``). Where it is False, the trainer takes masked pixels
            out of the result (`PixelMasks.strip`).
    """

    heeds_masks: bool = False

    def sample(self, maps: ErrorMaps, view_ids: tuple[int, ...], rate: float, step: Step) -> PixelSamples:
        """Draw the samples of an iteration from the maps of these views, on the maps' device.

        The samples lie in these views, in this order: give `view_ids` to `PixelSamples`, or to its `from_mask`.
        ``maps.masks`` says which pixels count.
        """


@runtime_checkable
class SparseLoss(Protocol):
    """A loss on sampled pixels with its own gradient (section 3.7).

    Attributes:
        terms: the loss as a rule, which an engine evaluates in one step with the update of the error maps. None: the
            trainer calls the loss, and the maps get its `LossOutput.pixel_errors`.
    """

    terms: LossTerms | None = None

    def __call__(self, colors: Tensor, targets: Tensor, samples: PixelSamples) -> LossOutput:
        """The loss, its gradient by each colour, and the error of each pixel (`LossOutput`).

        Args:
            colors, targets: [P, 3] rendered and true colours. Photos are within 0 .. 1; `colors` may exceed 1.
            samples: the pixels; where ``samples.filled`` is False there is none, and gradient and error are zero.
        """


@runtime_checkable
class DensityController(Protocol):
    """Density control adds and removes Gaussians (section 3.8).

    A class that inherits from this one and keeps no state per Gaussian needs only `update`.

    Attributes:
        moves_model: `update` changes the model between events (`event_due`), too.
    """

    # By "return" type checkers know that a method may be left out.

    moves_model: bool = False

    @property
    def stats(self) -> GaussianStats | None:
        """The statistics that backward passes add to, or None while none are needed."""
        return None

    @property
    def uses_errors(self) -> bool:
        """True where `update` looks at error or distance sums. Elsewhere they cost no time, and mean nothing."""
        return self.stats is not None

    def setup(self, gaussians: Gaussians) -> None:
        """Called once before training, and after a resume, before `load_state_dict`."""
        return

    def update(self, gaussians: Gaussians, step: Step) -> RowUpdate | None:
        """Propose a change of the set of Gaussians, or None. Called after every optimizer step."""

    def event_due(self, step: Step) -> bool:
        """True where `update` may return a change or looks at the statistics; on every process alike.

        Where several processes train one model, each adds to the statistics of its own rows. Only at such an iteration
        are all complete when `update` is called, and the hosts of all processes wait for each other. True where nothing
        is known, which is never wrong.
        """
        return True

    def growth_room(self, step: Step) -> float:
        """Times its cap that a model may have after an event at this iteration, since later events remove the rest; for
        a memory budget, which limits the largest number of a run."""
        return 1.0

    def apply(self, update: RowUpdate) -> None:
        """Apply the change to the controller's own state, row by row. Called after model and optimizer have followed;
        the rows may be in another order than `update` proposed."""
        return

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint keeps: tensors and plain values."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what `state_dict` gave, after `setup`; `ValueError` where it does not fit."""
        return


@runtime_checkable
class GaussianOptimizer(Protocol):
    """Turns gradients into a step of the parameters, in place (section 3.9).

    An optimizer whose `rule` is None makes the step in its own code, and its `moments` are None. Any other has both,
    and an engine makes the step together with the backward pass that gives the gradients. A class that inherits from
    this one and keeps no state per Gaussian needs only `step`.
    """

    @property
    def moments(self) -> GaussianMoments | None:
        """The state that a rule's step changes."""
        return None

    @property
    def per_view(self) -> bool:
        """True where `step` takes the gradients of each view, not only their sum."""
        return False

    @property
    def skipped(self) -> Tensor:
        """[] int64 on the device: updates skipped so far because a gradient was not finite. Read at evaluations."""
        return torch.zeros((), dtype=torch.int64)

    def setup(self, gaussians: Gaussians) -> None:
        """Allocate state for these Gaussians; called once before training, and after a resume."""
        return

    def rule(self, step: Step) -> UpdateRule | None:
        """The step of this iteration as a rule, or None."""
        return None

    def step(self, gaussians: Gaussians, gradients: GaussianGradients, step: Step) -> None:
        """Update `gaussians` in place by gradients of each view or their sum."""

    def apply(self, update: RowUpdate) -> None:
        """Apply a change of the set of Gaussians to the state, row by row."""
        return

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint keeps: tensors and plain values."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what `state_dict` gave, after `setup`; `ValueError` where it does not fit."""
        return


class Strategies(TypedDict, total=False):
    """Objects by their kind, some or none."""

    schedule: SamplingSchedule
    view_sampler: ViewSampler
    pixel_sampler: PixelSampler
    loss: SparseLoss
    density: DensityController
    optimizer: GaussianOptimizer
