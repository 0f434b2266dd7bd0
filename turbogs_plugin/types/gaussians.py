"""The model, the gradients and statistics of its Gaussians, and a change of their set."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

PARAMETER_NAMES = ("means", "quats", "scales", "opacities", "sh0", "shN")

ROW_SHAPES: dict[str, tuple[int, ...]] = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3)}
"""Shape of a Gaussian's row of each parameter but shN, as gsplat has it."""
SH_C0 = 0.28209479177387814
"""The harmonic of degree 0: colour = SH_C0 * sh0 + 0.5."""


@dataclass
class ParameterTensors:
    """A tensor for each parameter of the model."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh0: Tensor
    shN: Tensor


@dataclass(repr=False)
class Gaussians(ParameterTensors):
    """The model, in gsplat's parameter layout. All tensors share one device and one dtype.

    Args:
        means: [N, 3], world units.
        quats: [N, 4], wxyz, not normalised.
        scales: [N, 3], logarithms of the standard deviations.
        opacities: [N], logits.
        sh0: [N, 1, 3], spherical harmonics of band 0.
        shN: [N, B, 3], the higher bands, B = (degree + 1)^2 - 1.
    """

    def __len__(self) -> int:
        return self.means.shape[0]

    def __repr__(self) -> str:
        return f"{len(self):,} Gaussians of SH degree {self.sh_degree} on {self.device}"

    def items(self) -> Iterator[tuple[str, Tensor]]:
        """(name, tensor) of each parameter, in the order of `PARAMETER_NAMES`."""
        return ((name, getattr(self, name)) for name in PARAMETER_NAMES)

    def map(self, function) -> Gaussians:
        """A model with `function` applied to every tensor."""
        return Gaussians(**{name: function(value) for name, value in self.items()})

    def finite_rows(self) -> Tensor:
        """[N] bool: every number of the Gaussian is finite."""
        zeros = [(0.0 * value.detach())[:, None].flatten(1).sum(dim=1) for _, value in self.items()]  # or NaN
        return torch.stack(zeros).sum(dim=0) == 0.0

    @property
    def device(self) -> torch.device:
        return self.means.device

    @property
    def sh_degree(self) -> int:
        """The highest degree that `shN` can hold."""
        return round((self.shN.shape[1] + 1) ** 0.5) - 1


@dataclass
class GaussianGradients(ParameterTensors):
    """Gradients of the parameters, in the layout of `Gaussians` with a leading dimension of views or of 1.

    Args:
        means, quats, scales, opacities, sh0: [K, N, ...] one row per view, or [1, N, ...] the sum of these.
        shN: [N, B, 3], always summed.
        touched: [N] bool, the Gaussian contributed to some sampled pixel.
    """

    touched: Tensor

    def summed(self, name: str) -> Tensor:
        """[N, ...], the gradient of one parameter in its own shape, summed over views."""
        value = getattr(self, name)
        return value if name == "shN" else value.sum(dim=0)


@dataclass
class GaussianStats:
    """Per-Gaussian sums over a window of iterations, to which each backward pass adds (paper section 3.8).

    Args:
        error_sums: [N] float32, sum over views and samples of e * w, with w = T * alpha.
        distance_sums: [N] float32, sum of D * w, D the Mahalanobis distance of the pixel in the projected conic.
        weight_sums: [N] float32, sum of w.
        grad_sums: [N] float32, sum over views of the norm of the screen gradient of the mean, in gsplat's units
            (x scaled by K * width / 2, y by K * height / 2).
        absgrad_sums: [N] float32, the sum like `grad_sums` for the absolute gradients (AbsGS).
        square_sums: [N] float32, sum over views and samples of (o * d loss / d o)^2, o the opacity.
        view_counts: [N] float32, views in which the Gaussian was on screen.
        max_radii: [N] float32, largest screen radius over the larger side of the image.
    """

    error_sums: Tensor
    distance_sums: Tensor
    weight_sums: Tensor
    grad_sums: Tensor
    absgrad_sums: Tensor
    square_sums: Tensor
    view_counts: Tensor
    max_radii: Tensor

    @classmethod
    def zeros(cls, count: int, device: torch.device | str) -> GaussianStats:
        return cls(*(torch.zeros(count, device=device) for _ in fields(cls)))

    def zero_(self) -> None:
        for value in vars(self).values():
            value.zero_()

    def map(self, function) -> GaussianStats:
        """Statistics with `function` applied to every tensor."""
        return GaussianStats(*map(function, vars(self).values()))


@dataclass
class RowUpdate:
    """A change of the set of Gaussians: clone, split, prune, relocate and reorder all have this form.

    Row ``i`` of every array over Gaussians becomes a copy of old row ``source[i]``. Where ``fresh[i]``, the row's
    optimizer state and statistics start from zero instead. Then ``values`` replace whole parameters.

    Args:
        source: [M] int64, the old row of each new row.
        fresh: [M] bool.
        values: name of a parameter -> its new tensor [M, ...]; parameters not named are copies.
        reset: names of parameters whose optimizer state starts from zero in every row (a reset of opacities).
        num_cloned, num_split, num_pruned: counts for the report.
    """

    source: Tensor
    fresh: Tensor
    values: dict[str, Tensor]
    reset: tuple[str, ...] = ()
    num_cloned: int = 0
    num_split: int = 0
    num_pruned: int = 0

    def new(self, name: str, gaussians: Gaussians) -> Tensor:
        """[M, ...] a parameter after the change of `gaussians`."""
        return self.values[name] if name in self.values else getattr(gaussians, name)[self.source]

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """The model after the change."""
        return Gaussians(**{name: self.new(name, gaussians) for name, _ in gaussians.items()})

    def taking(self, rows: Tensor) -> RowUpdate:
        """The change with these of its new rows alone, in this order."""
        values = {name: value[rows] for name, value in self.values.items()}
        return replace(self, source=self.source[rows], fresh=self.fresh[rows], values=values)

    def apply_state(self, state: Tensor) -> Tensor:
        """A state tensor [N, ...] after the change: rows follow their Gaussian, fresh ones are zero."""
        rows = state[self.source]
        rows[self.fresh] = 0
        return rows
