"""The data that the parts of TurboGS pass on: small dataclasses of tensors, in the order in which they are used.

Every shape below is written with these letters:

- ``V`` training views, ``K`` views of one iteration (a batch; ``k`` is the position in the batch);
- ``N`` Gaussians;
- ``P`` sample slots, ordered by (view of the batch, tile), ``T`` tiles that hold samples;
- ``X`` pixels of all training views laid end to end ("flat pixels").

This file imports nothing of the project but its exception, so strategies and framework can both import it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.errors import InputError

TILE_SIZE = 16
"""Side of a square tile in pixels (S in the paper). The kernels are built for this value."""

PATCH_WIDTH, PATCH_HEIGHT = 8, 4
"""Samples of a tile are ordered by patches of this size, so that in a dense tile a warp gets 32 neighbours."""


def sample_order(x: Tensor, y: Tensor) -> Tensor:
    """Rank of a pixel within its tile: row-major over patches of 8x4, then row-major within the patch.

    Args:
        x, y: integer tensors of one shape, coordinates within the tile, 0 .. TILE_SIZE - 1.

    Returns:
        Integers 0 .. TILE_SIZE^2 - 1 of the same shape.
    """
    patch = (y // PATCH_HEIGHT) * (TILE_SIZE // PATCH_WIDTH) + x // PATCH_WIDTH
    return patch * (PATCH_WIDTH * PATCH_HEIGHT) + (y % PATCH_HEIGHT) * PATCH_WIDTH + x % PATCH_WIDTH


Color = tuple[float, float, float]
"""Red, green and blue, 0 .. 1."""

BLACK: Color = (0.0, 0.0, 0.0)
WHITE: Color = (1.0, 1.0, 1.0)

PARAMETER_NAMES = ("means", "quats", "scales", "opacities", "sh0", "shN")

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


@dataclass
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

    def items(self) -> Iterator[tuple[str, Tensor]]:
        """(name, tensor) of each parameter, in the order of `PARAMETER_NAMES`."""
        return ((name, getattr(self, name)) for name in PARAMETER_NAMES)

    def map(self, function) -> Gaussians:
        """A model with `function` applied to every tensor."""
        return Gaussians(**{name: function(value) for name, value in self.items()})

    @property
    def device(self) -> torch.device:
        return self.means.device

    @property
    def sh_degree(self) -> int:
        """The highest degree that `shN` can hold."""
        return round((self.shN.shape[1] + 1) ** 0.5) - 1


@dataclass
class Cameras:
    """C pinhole cameras; their images may differ in size.

    Args:
        viewmats: [C, 4, 4] float, world to camera (x right, y down, z forward).
        Ks: [C, 3, 3] float, intrinsics in pixels; the centre of the first pixel is (0.5, 0.5).
        sizes: [C, 2] int64 numpy array (width, height), on the host so that shapes cost no synchronisation.
    """

    viewmats: Tensor
    Ks: Tensor
    sizes: np.ndarray

    def __len__(self) -> int:
        return self.viewmats.shape[0]

    def select(self, view_ids: Sequence[int]) -> Cameras:
        """The cameras of these views, in this order."""
        # Stacked, not indexed: so no index has to be copied to the device.
        viewmats, Ks = (torch.stack([of_all[view] for view in view_ids]) for of_all in (self.viewmats, self.Ks))
        return Cameras(viewmats, Ks, self.sizes[np.asarray(view_ids, dtype=np.int64)])

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Cameras:
        return Cameras(self.viewmats.to(device, dtype), self.Ks.to(device, dtype), self.sizes)

    @property
    def centers(self) -> Tensor:
        """[C, 3] camera centres in the world."""
        rotations, translations = self.viewmats[:, :3, :3], self.viewmats[:, :3, 3]
        return -(rotations.transpose(1, 2) @ translations[:, :, None])[:, :, 0]

    @property
    def directions(self) -> Tensor:
        """[C, 3] unit viewing directions in the world."""
        return torch.nn.functional.normalize(self.viewmats[:, 2, :3], dim=-1)


@dataclass
class TileGrid:
    """The tiles of a batch of K images, numbered without gaps: view after view, row after row.

    Args:
        sizes: [K, 2] int64 numpy array (width, height).
    """

    sizes: np.ndarray

    @property
    def shapes(self) -> np.ndarray:
        """[K, 2] int64: tiles in x and in y of each image."""
        return -(-self.sizes // TILE_SIZE)

    @property
    def offsets(self) -> np.ndarray:
        """[K + 1] int64: number of the first tile of each image; the last entry is the count of all tiles."""
        return np.concatenate([[0], np.cumsum(self.shapes.prod(axis=1))])

    def __len__(self) -> int:
        return sum(-(-width // TILE_SIZE) * -(-height // TILE_SIZE) for width, height in self.sizes.tolist())


@dataclass
class PixelSamples:
    """The pixels of one iteration, grouped by tile.

    A slot whose pixel id is -1 is empty: it renders nothing, adds nothing to a loss and changes no map. Tiles cut by
    the image's edge get empty slots, so that the host knows the number of slots.

    Args:
        view_ids: K numbers of training views, on the host.
        sizes: [K, 2] int64 numpy array (width, height) of those views.
        pixel_ids: [P] int32, ``y * width + x`` in its own view, or -1 for an empty slot. Within a tile, ascending
            in `sample_order`, empty slots last.
        tile_ids: [T] int32, ascending, in the numbering of ``TileGrid(sizes)``.
        tile_offsets: [T + 1] int32, the first slot of each tile; the last entry is P.
        weights: [P] float32 importance weights with mean 1 over the filled slots, or None where all are 1.
        has_empty_slots: False promises that every slot is filled, so that none has to be counted.
        host_ends: gives ([K], [T]) int64 numpy arrays, the end of each view's tiles (in `tile_ids`) and of each tile's
            slots, where the host knows them without asking the device; None: it has to ask.
    """

    view_ids: tuple[int, ...]
    sizes: np.ndarray
    pixel_ids: Tensor
    tile_ids: Tensor
    tile_offsets: Tensor
    weights: Tensor | None = None
    has_empty_slots: bool = True
    host_ends: Callable[[], tuple[np.ndarray, np.ndarray]] | None = None

    @classmethod
    def from_mask(cls, mask: Tensor, view_ids: Sequence[int] | None = None) -> PixelSamples:
        """The pixels of a mask. On a GPU the host waits once, to count them.

        Args:
            mask: [H, W] bool of one view, or [K, H, W] of a batch. The samples live on its device.
            view_ids: K training views, for error maps; 0 .. K - 1 where None.

        Raises:
            InputError: no such mask, one that is False everywhere, or not one view number for each image.
        """
        if not isinstance(mask, Tensor) or mask.dtype != torch.bool or mask.dim() not in (2, 3):
            found = f"{mask.dtype} {tuple(mask.shape)}" if isinstance(mask, Tensor) else type(mask).__name__
            raise InputError(f"mask is {found}: expected a tensor of bool [H, W] or [K, H, W]")
        mask = mask[None] if mask.dim() == 2 else mask
        views, y, x = torch.nonzero(mask, as_tuple=True)
        return cls.from_coordinates(views, x, y, [(mask.shape[2], mask.shape[1])] * len(mask), view_ids)

    @classmethod
    def from_coordinates(
        cls,
        views: Tensor,
        x: Tensor,
        y: Tensor,
        sizes: np.ndarray | Sequence[tuple[int, int]],
        view_ids: Sequence[int] | None = None,
    ) -> PixelSamples:
        """Given pixels, in the order of samples, which is not that in which they are given: `coordinates` and
        `view_of_slot` tell it. On a GPU the host waits for the checks.

        Args:
            views: [P] integers, position in the batch (0 .. K - 1) of each pixel's view.
            x, y: [P] integers, column and row of each pixel. The samples live on their device.
            sizes: [K, 2] (width, height) of the batch's images.
            view_ids: K training views, for error maps; 0 .. K - 1 where None.

        Raises:
            InputError: other shapes or types, no pixel, one outside its image, one pixel twice, or not one view number
                for each image.
        """
        sizes = np.asarray(sizes, dtype=np.int64)
        if sizes.ndim != 2 or sizes.shape[1] != 2 or len(sizes) == 0:
            raise InputError(f"sizes have shape {sizes.shape}: expected [K, 2], the (width, height) of each image")
        view_ids = tuple(range(len(sizes)) if view_ids is None else map(int, view_ids))
        if len(view_ids) != len(sizes) or len(set(view_ids)) < len(view_ids):
            raise InputError(f"view_ids = {view_ids} is not valid: expected {len(sizes)} different numbers of views")
        for name, value in (("views", views), ("x", x), ("y", y)):
            if not isinstance(value, Tensor) or value.dtype.is_floating_point or value.dtype == torch.bool:
                found = value.dtype if isinstance(value, Tensor) else type(value).__name__
                raise InputError(f"{name} is {found}: expected a tensor of integers [P]")
            if value.dim() != 1 or value.shape != x.shape or len(value) == 0:
                raise InputError(f"{name} has shape {tuple(value.shape)}: expected [P] as x and y, P at least 1")
        views, x, y = views.long(), x.long(), y.long()
        inside = (views >= 0) & (views < len(sizes))
        widths, heights = torch.as_tensor(sizes, device=x.device)[views.clamp(0, len(sizes) - 1)].unbind(dim=-1)  # [P]
        inside &= (x >= 0) & (x < widths) & (y >= 0) & (y < heights)

        def place(pixel: Tensor) -> str:
            return f"view {int(views[pixel])}, x {int(x[pixel])}, y {int(y[pixel])}"

        if not bool(inside.all()):
            outside = place((~inside).nonzero()[0])
            raise InputError(f"a pixel is outside its image ({outside}): sizes (width, height) are {sizes.tolist()}")
        grid = TileGrid(sizes)
        columns, starts = (
            torch.as_tensor(of_view, device=x.device)[views] for of_view in (grid.shapes[:, 0], grid.offsets[:-1])
        )
        tiles = starts + y // TILE_SIZE * columns + x // TILE_SIZE  # [P]
        keys = tiles * TILE_SIZE**2 + sample_order(x % TILE_SIZE, y % TILE_SIZE)  # unique for each pixel
        keys, order = keys.sort()
        again = order[1:][keys[1:] == keys[:-1]]
        if len(again):
            raise InputError(f"a pixel is given twice ({place(again[0])}): expected each once")
        tile_ids, counts = torch.unique_consecutive(keys // TILE_SIZE**2, return_counts=True)  # [T] each
        return cls(
            view_ids=view_ids,
            sizes=sizes,
            pixel_ids=(y * widths + x)[order].int(),
            tile_ids=tile_ids.int(),
            tile_offsets=torch.nn.functional.pad(counts.cumsum(dim=0), (1, 0)).int(),
            has_empty_slots=False,
        )

    def __len__(self) -> int:
        return self.pixel_ids.shape[0]

    @property
    def grid(self) -> TileGrid:
        return TileGrid(self.sizes)

    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """([K], [T]) int64: the end of each view's tiles (in `tile_ids`) and of each tile's slots. Without `host_ends`
        the host waits for the device."""
        if self.host_ends is not None:
            return self.host_ends()
        views = np.searchsorted(self.tile_ids.cpu().numpy(), self.grid.offsets[1:])
        return views, self.tile_offsets[1:].cpu().numpy().astype(np.int64)

    def of_tiles(self, tiles: slice, views: slice, slots: slice) -> PixelSamples:
        """A run of tiles as a batch of its own, of the views that they lie in. Tensors are views of these ones.

        Args:
            tiles: positions in `tile_ids`.
            views: positions in the batch of their views.
            slots: of these tiles.
        """
        return replace(
            self,
            view_ids=self.view_ids[views],
            sizes=self.sizes[views],
            pixel_ids=self.pixel_ids[slots],
            tile_ids=self.tile_ids[tiles] - int(self.grid.offsets[views.start]),
            tile_offsets=self.tile_offsets[tiles.start : tiles.stop + 1] - slots.start,
            weights=None if self.weights is None else self.weights[slots],
            host_ends=None,
        )

    @property
    def filled(self) -> Tensor:
        """[P] bool: the slot holds a pixel."""
        return self.pixel_ids >= 0

    def tile_of_slot(self) -> Tensor:
        """[P] int64: position in `tile_ids` of the tile of each slot."""
        counts = (self.tile_offsets[1:] - self.tile_offsets[:-1]).long()
        return torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts, output_size=len(self))

    def view_of_slot(self) -> Tensor:
        """[P] int64: position in the batch (0 .. K-1) of the view of each slot."""
        ends = torch.as_tensor(self.grid.offsets[1:], device=self.tile_ids.device)
        return torch.searchsorted(ends, self.tile_ids.long(), right=True)[self.tile_of_slot()]

    def flat_pixels(self, offsets: np.ndarray) -> Tensor:
        """[P] int64: flat pixel of each slot; an empty slot gets the first pixel of its view.

        Args:
            offsets: [V + 1] int64, first flat pixel of each training view.
        """
        starts = torch.as_tensor(offsets[list(self.view_ids)], device=self.pixel_ids.device)
        return starts[self.view_of_slot()] + self.pixel_ids.long().clamp(min=0)

    def coordinates(self) -> Tensor:
        """[P, 2] int64 (x, y) of each slot in its view; (0, 0) for an empty slot."""
        widths = torch.as_tensor(self.sizes[:, 0], device=self.pixel_ids.device)[self.view_of_slot()]
        pixels = self.pixel_ids.long().clamp(min=0)
        return torch.stack([pixels % widths, pixels // widths], dim=-1)


@dataclass
class LossOutput:
    """The result of a loss on the samples.

    Args:
        loss: scalar.
        color_gradients: [P, 3], d loss / d rendered colour.
        pixel_errors: [P] float32, L1 norm over RGB of the residual (0 .. 3); zero in empty slots.
    """

    loss: Tensor
    color_gradients: Tensor
    pixel_errors: Tensor


@dataclass
class GaussianGradients(ParameterTensors):
    """Gradients of the parameters, in the layout of `Gaussians` with a leading dimension of views or of 1.

    Args:
        means, quats, scales, opacities, sh0: [K, N, ...] one row per view, or [1, N, ...] the sum of these.
        shN: [N, B, 3], always summed.
        touched: [N] bool, the Gaussian contributed to some sampled pixel.
        view_losses: [K, N] (or [1, N]), the Gaussian's share of the loss in each view, ``sum over pixels of
            e * w / P``; zero where the Gaussian contributed nothing.
    """

    touched: Tensor
    view_losses: Tensor

    def summed(self, name: str) -> Tensor:
        """The gradient of one parameter in its own shape, summed over views."""
        value = getattr(self, name)
        return value if name == "shN" else value.sum(dim=0)

    def over_views(self) -> GaussianGradients:
        """The gradients with one row, the sum over views; itself if it has one row already."""
        if len(self.view_losses) == 1:
            return self
        sums = {name: value.sum(dim=0, keepdim=True) for name, value in vars(self).items()}
        return replace(self, **(sums | {"shN": self.shN, "touched": self.touched}))


@dataclass
class GaussianStats:
    """Per-Gaussian sums over a window of iterations, to which each backward pass adds (paper section 3.8).

    Args:
        error_sums: [N] float32, sum over views and samples of e * w, with w = T * alpha.
        distance_sums: [N] float32, sum of D * w, D the Mahalanobis distance of the pixel in the projected conic.
        weight_sums: [N] float32, sum of w.
        grad_sums: [N] float32, sum over views of the norm of the screen gradient of the mean, in gsplat's units
            (x scaled by K * width / 2, y by K * height / 2).
        absgrad_sums: [N] float32, the same for the absolute gradients (AbsGS).
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

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """The model after the change."""
        copies = {name: value[self.source] for name, value in gaussians.items() if name not in self.values}
        return Gaussians(**copies, **self.values)

    def reordered(self, order: Tensor) -> RowUpdate:
        """The same change with its new rows in another order [M], a permutation."""
        values = {name: value[order] for name, value in self.values.items()}
        return replace(self, source=self.source[order], fresh=self.fresh[order], values=values)

    def apply_state(self, state: Tensor) -> Tensor:
        """A state tensor [N, ...] after the change: rows follow their Gaussian, fresh ones are zero."""
        rows = state[self.source]
        rows[self.fresh] = 0
        return rows


@dataclass(frozen=True)
class Step:
    """Where training stands. Algorithm 1's rho is `progress`; the scheduling appendix's rho is `anneal`.

    Args:
        iteration: t, from 0.
        total: T, iterations of the whole run.
        refine_until: tau_until, the last iteration of density control.
        seed: of the run; all randomness is a function of (seed, iteration, place).
        scene_extent: radius of the camera centres about their mean, world units.
    """

    iteration: int
    total: int
    refine_until: int
    seed: int = 0
    scene_extent: float = 1.0

    @property
    def progress(self) -> float:
        """clip(t / tau_until, 0, 1): 0 at the start, 1 once density control is over."""
        return min(1.0, self.iteration / max(1, self.refine_until))

    @property
    def anneal(self) -> float:
        """1 - progress."""
        return 1.0 - self.progress


@dataclass(frozen=True)
class SamplingBudget:
    """How much one iteration samples: `views` (K) views, and the fraction `rate` (r) of each tile's pixels."""

    views: int
    rate: float
