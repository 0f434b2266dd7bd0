"""Persistent error and age of every pixel of every training view (paper section 3.3).

The maps of all views lie end to end in one array ("flat pixels"), so views may differ in size. For each pixel the
iteration of its last visit is stored, its "stamp". Stamps give the ages of the paper's counters, plus one, and only the
sampled pixels have to be written. The sum of a view's errors is updated incrementally. Errors are stored in half
precision and their sums in double, so the sums are exact (below 2^29 a view) and do not drift.

With masks, a masked pixel has no error, is never drawn, and does not count in any mean. docs/drop-in.md has an example
without Gaussians, from plain error images.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.errors import InputError, require
from turbogs_plugin.masks import PixelMasks
from turbogs_plugin.types import PixelSamples, Step

AGE_MAX = 32767
"""Ages saturate here, in iterations."""

MAP_BYTES = 4
"""Bytes per pixel: an error in half precision and a stamp of 16 bits."""

ERROR_MAX = 65504.0
"""Errors saturate here: the largest finite number in half precision."""


@dataclass
class ErrorMaps:
    """Error and age of X flat pixels in V views.

    The age of a pixel at iteration t is ``min(t - stamp, AGE_MAX)``, where the stamp of a pixel never sampled is -1.
    Stamps are stored relative to `stamp_base`, which moves on (one sweep of the map) every `AGE_MAX` iterations.

    Args:
        sizes: [V, 2] int64 numpy array (width, height).
        device: where the maps live.
        beta: EMA weight of a new error.
        refresh: on a device other than the CPU, every `refresh`-th call of `view_means` updates the means.
        masks: which pixels count, on any device; None for all.
    """

    sizes: np.ndarray
    device: torch.device | str = "cpu"
    beta: float = 0.4
    refresh: int = 16
    masks: PixelMasks | None = None
    view_sums: Tensor = field(init=False)  # [V] float64, sum of `errors` in each view
    stamp_base: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        require(0 < self.beta <= 1, "beta", self.beta, "above 0, at most 1")
        require(self.refresh >= 1, "refresh", self.refresh, "1 or more")
        self.sizes = np.asarray(self.sizes, dtype=np.int64)
        self._pixel_counts = self.sizes.prod(axis=1)  # [V]
        if self.masks is not None:
            if not np.array_equal(self.masks.sizes, self.sizes):
                raise InputError("masks and error maps differ in the number of their views or in the views' sizes")
            self.masks = self.masks.to(self.device)
            self._pixel_counts = self.masks.pixel_counts.clip(min=1)
        self._allocate()
        self.view_sums = torch.zeros(len(self.sizes), dtype=torch.float64, device=self.device)
        self._means = LaggedCopy(self.view_sums, self.refresh)

    def _allocate(self) -> None:
        self.offsets = np.concatenate([[0], np.cumsum(self.sizes.prod(axis=1))])  # [V + 1]
        pixels = int(self.offsets[-1])
        # One pixel more than the maps: empty slots write there, so they need not be filtered out first.
        errors = torch.zeros(pixels + 1, dtype=torch.float16, device=self.device)
        self._arrays: tuple[Tensor, ...] = errors, torch.full_like(errors, -1, dtype=torch.int16)

    @property
    def errors(self) -> Tensor:
        """[X] float16."""
        return self._arrays[0][:-1]

    @property
    def stamps(self) -> Tensor:
        """[X] int16, iteration of the last visit minus `stamp_base`."""
        return self._arrays[1][:-1]

    @classmethod
    def from_images(
        cls, errors: Tensor | Sequence[Tensor], masks: Tensor | Sequence[Tensor] | None = None, **options: Any
    ) -> ErrorMaps:
        """Maps that start from given error images; `options` are further arguments of `ErrorMaps`.

        Args:
            errors: [V, H, W] float, or V tensors [H, W] whose sizes may differ; the maps live on their device.
            masks: of the same shapes, True (nonzero) where a pixel counts; None: all do.

        Raises:
            InputError: there is no image, one is not a finite tensor [H, W], or a mask has another shape.
        """
        if len(errors) == 0 or not all(isinstance(e, Tensor) and e.dim() == 2 and e.isfinite().all() for e in errors):
            raise InputError("error images: give a finite tensor [H, W] for each view, by torch.from_numpy of an array")
        sizes = np.array([(image.shape[1], image.shape[0]) for image in errors], dtype=np.int64)
        of_pixels = None if masks is None else PixelMasks.from_images(masks)
        maps = cls(sizes, device=errors[0].device, masks=of_pixels, **options)
        for view_id, image in enumerate(errors):
            maps.initialise(view_id, image.reshape(-1))
        return maps

    def fetch(self, view_ids: Sequence[int]) -> None:
        """Make the maps of these views available in `errors` and `stamps`, from `offsets` on. To be called before these
        arrays are read or written. Here all views are always there; see `scene/offload.py`."""

    def initialise(self, view_id: int, errors: Tensor) -> None:
        """Set the errors of one whole view: [H * W] float, detached here. An error that is not finite, is below 0 or is
        a masked pixel's counts as zero. Raises `InputError` for another shape."""
        width, height = self.sizes[view_id]
        if errors.shape != (width * height,):
            raise InputError(f"errors of view {view_id} have shape {tuple(errors.shape)}, expected ({width * height},)")
        self.fetch([view_id])
        place = self._extent(view_id)
        errors = torch.nan_to_num(errors.detach().float(), nan=0.0, posinf=0.0, neginf=0.0).clamp(0.0, ERROR_MAX)
        if self.masks is not None:
            errors = torch.where(self.masks.image(view_id).reshape(-1), errors, 0.0)
        self.errors[place] = errors.to(torch.float16)
        self.view_sums[view_id] = self.errors[place].sum(dtype=torch.float64)
        self._means.restart()

    def update(self, samples: PixelSamples, pixel_errors: Tensor, step: Step) -> None:
        """EMA of the errors, stamps and view sums at the samples.

        A non-finite error changes nothing: not its pixel's error or stamp, nor its view's sum. Finite errors saturate
        at `ERROR_MAX`. The new error is ``half(min((1 - beta) * old + beta * new, ERROR_MAX))`` with
        both factors and every operation rounded to single precision.

        Args:
            pixel_errors: [P] float, 0 or more, detached here; empty slots are ignored. The sign is not checked, as that
                would wait for the device: negative errors are stored, and make means and draws wrong.
            step: gives the stamp.

        Raises:
            InputError: another shape, or samples of views of other sizes; nothing is changed.
        """
        if pixel_errors.shape != (len(samples),):
            expected = f"expected ({len(samples)},): one for each sample"
            raise InputError(f"pixel errors have shape {tuple(pixel_errors.shape)}, {expected}")
        if not np.array_equal(samples.sizes, known := self.sizes[list(samples.view_ids)]):
            raise InputError(f"samples are of views of sizes {samples.sizes.tolist()}, maps {known.tolist()}")
        self.fetch(samples.view_ids)
        stamp = self.stamp(step)
        maps, stamps = self._arrays
        tiles, views = samples.tile_of_slot(), samples.view_of_tile()
        errors = pixel_errors.detach().float()
        starts = torch.as_tensor(self.offsets[list(samples.view_ids)], device=errors.device)
        changed = samples.filled & torch.isfinite(errors)
        flat = torch.where(changed, starts[views][tiles] + samples.pixel_ids, len(maps) - 1)
        old = maps[flat]
        new = (old.float() * (1.0 - self.beta) + errors * self.beta).clamp(max=ERROR_MAX).to(torch.float16)
        maps[flat], stamps[flat] = new, stamp
        deltas = torch.where(changed, new.double() - old.double(), 0.0)
        # Tile by tile first: on a GPU, additions to one number wait for each other.
        tile_sums = deltas.new_zeros(len(views)).index_add_(0, tiles, deltas)
        batch_sums = deltas.new_zeros(len(samples.view_ids)).index_add_(0, views, tile_sums)
        self.view_sums.index_add_(0, torch.as_tensor(samples.view_ids, device=errors.device), batch_sums)

    def view_errors(self, view_id: int) -> Tensor:
        """[H * W] float32: error of each pixel of a view, 0 or more; a copy."""
        self.fetch([view_id])
        return self.errors[self._extent(view_id)].float()

    def ages(self, view_id: int, step: Step) -> Tensor:
        """[H * W] int32: iterations since each pixel of a view was last sampled, saturated at `AGE_MAX`."""
        self.fetch([view_id])
        return (self.now(step) - self.stamps[self._extent(view_id)].int()).clamp(0, AGE_MAX)

    def now(self, step: Step) -> int:
        """The number from which a pixel's stamp is subtracted to get its age."""
        return step.iteration - self.stamp_base

    def stamp(self, step: Step) -> int:
        """The stamp of the pixels visited now. Beyond its range, all stamps are shifted, and old ones saturate."""
        shift = self.now(step)
        if shift > AGE_MAX:
            self._change_stamps(lambda stamps: (stamps.int() - shift).clamp(min=-AGE_MAX))
            self.stamp_base = step.iteration
        return self.now(step)

    def view_means(self) -> np.ndarray:
        """[V] float64 on the host: mean error of each view, over its pixels that are not masked; 0 if all are.

        On the CPU they are exact. Elsewhere reading them at every call would stall the device, so a copy is started at
        every `refresh`-th call and read at the next such call: means are at most ``2 * refresh - 1`` calls old, and
        depend on the number of calls alone, never on timing. The first call, also after `initialise`, waits.
        """
        return np.maximum(self._means.read(), 0.0) / self._pixel_counts

    def state_dict(self, pixels: bool = True) -> dict[str, Any]:
        """Plain tensors and numbers; a resume from them gives the same bits. Without `pixels`: `view_means` alone."""
        errors, stamps = self._copies() if pixels else (array[:0].clone() for array in self._arrays)
        state = {"errors": errors, "stamps": stamps, "stamp_base": self.stamp_base}
        return {**state, "view_sums": self.view_sums.clone(), **self._means.state_dict()}

    def load_state_dict(self, state: dict[str, Any], pixels: bool = True) -> None:
        """Load a saved state. Raises `ValueError` where its numbers are none of maps."""
        names = ("view_sums", "mean_values", *(["errors"] if pixels else []))
        if min(state["stamp_base"], *(state[name].min() for name in names)) < 0:
            raise ValueError("an error of the maps, or the iteration of their stamps, is negative")
        if pixels:
            self._load(state["errors"], state["stamps"])
        self.stamp_base = int(state["stamp_base"])
        self.view_sums.copy_(state["view_sums"])
        self._means.load_state_dict(state)

    def _extent(self, view_id: int) -> slice:
        """The flat pixels of a view."""
        start = int(self.offsets[view_id])
        return slice(start, start + int(self.sizes[view_id].prod()))

    def _copies(self) -> tuple[Tensor, Tensor]:
        """([X] errors, [X] stamps) of all views, end to end."""
        return self.errors.clone(), self.stamps.clone()

    def _load(self, errors: Tensor, stamps: Tensor) -> None:
        """Load [X] errors and [X] stamps of all views."""
        self.errors.copy_(errors)
        self.stamps.copy_(stamps)

    def _change_stamps(self, function: Callable[[Tensor], Tensor]) -> None:
        """Apply a function to the stamps of all views."""
        self._arrays[1].copy_(function(self._arrays[1]))


class LaggedCopy:
    """The values of a small device tensor on the host, a fixed number of reads late; see `ErrorMaps.view_means`."""

    def __init__(self, source: Tensor, refresh: int) -> None:
        self.source, self.refresh = source, refresh
        self.restart()

    def restart(self) -> None:
        """The next read waits for the device and is exact."""
        self.reads = 0
        self.values = self.pending = torch.zeros(len(self.source), dtype=torch.float64)
        self.arrival: torch.cuda.Event | None = None  # of `pending`

    def read(self) -> np.ndarray:
        """[V] float64, not to be written to."""
        if not self.source.is_cuda:
            return self.source.numpy()
        if self.reads % self.refresh == 0:
            self.values = self.source.cpu() if self.reads == 0 else self.arrived()
            self.pending = self.source.to("cpu", non_blocking=True, copy=True)  # into pinned memory
            self.arrival = torch.cuda.current_stream(self.source.device).record_event()
        self.reads += 1
        return self.values.numpy()

    def arrived(self) -> Tensor:
        """The copy that was started, [V] float64; by now it has long arrived."""
        if self.arrival is not None:
            self.arrival.synchronize()
        return self.pending

    def state_dict(self) -> dict[str, Any]:
        values, pending = self.values.clone(), self.arrived().clone()
        return {"mean_reads": self.reads, "mean_values": values, "mean_pending": pending}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.reads, self.arrival = int(state["mean_reads"]), None
        self.values, self.pending = (state[name].cpu().clone() for name in ("mean_values", "mean_pending"))
