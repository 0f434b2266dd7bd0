"""The rasterizer in CUDA (csrc/), twin of `reference.py`: projection, sort by tile, forward and backward pass.

Everything is float32. Without a `Workspace` a pass waits once for the GPU, to learn the number of (tile, splat) pairs;
with one it never waits (see `workspace.py`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.engine.cuda import library
from turbogs_plugin.engine.cuda.workspace import COUNT_MAX, Workspace, require_possible, round_capacity
from turbogs_plugin.engine.moments import COLUMNS, ROW_WIDTH
from turbogs_plugin.engine.rendered import DEFAULT_SETTINGS, Projected, RasterSettings, require_statistics
from turbogs_plugin.engine.shared import used_degree
from turbogs_plugin.errors import InputError
from turbogs_plugin.types import PARAMETER_NAMES, Cameras, GaussianGradients, Gaussians, GaussianStats, PixelSamples

MAX_VIEWS = 128
INSTANCE_FLOATS = 12
CAMERA_FLOATS = 28
RECORD_FLOATS = 16
WARP = 32
SCAN_TILES = 1024
RUN = 512


class _FreshBuffers:
    """Buffers of a pass without a workspace."""

    def __init__(self, device: torch.device) -> None:
        self.device = device

    def buffer(self, name: str, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        return torch.empty(shape, dtype=dtype, device=self.device)


def _prepared(tensor: Tensor) -> Tensor:
    """Detached, contiguous and aligned for 16-byte loads; itself where it already is."""
    tensor = tensor.detach().contiguous()
    return tensor if tensor.data_ptr() % 16 == 0 else tensor.clone()


def _check(gaussians: Gaussians, cameras: Cameras, samples: PixelSamples) -> None:
    device = gaussians.device
    if device.type != "cuda":
        raise InputError(f"rasterize_cuda: the Gaussians are on {device}; move them to a CUDA device")
    floats = [*gaussians.items(), ("cameras.viewmats", cameras.viewmats), ("cameras.Ks", cameras.Ks)]
    integers = [(f"samples.{name}", getattr(samples, name)) for name in ("pixel_ids", "tile_ids", "tile_offsets")]
    for dtype, tensors in ((torch.float32, floats), (torch.int32, integers)):
        for name, tensor in tensors:
            if tensor.dtype != dtype or tensor.device != device:
                raise InputError(f"{name} must be {dtype} on {device}, got {tensor.dtype} on {tensor.device}")
    require_views(len(cameras))
    if not np.array_equal(cameras.sizes, samples.sizes):
        raise InputError("cameras and samples differ in their image sizes: select the cameras of samples.view_ids")


def warps_per_tile(slots: int, tiles: int) -> int:
    """Work items of a tile, 32 slots each, for tiles of this many slots on average; fuller ones take several rounds."""
    return max(1, -(-slots // (max(1, tiles) * WARP)))


class ForwardArguments(NamedTuple):
    """Arguments of the forward operator, which the backward operator takes first; see csrc/raster_params.h."""

    cameras: Tensor  # [K, 28]
    tile_ids: Tensor | None  # [T], None where every tile is active
    tile_offsets: Tensor  # [T + 1]
    pixel_ids: Tensor  # [P]
    tile_starts: Tensor  # [T + 1]
    pair_ids: Tensor  # [M]
    instances: Tensor  # [K * N, 12]
    colors: Tensor  # [P, 3]
    alphas: Tensor  # [P]
    transmittances: Tensor  # [P]
    depths: Tensor | None  # [P]
    last_pairs: Tensor  # [P]
    masks: Tensor  # [(M / 32 + T + 1) * chunks]
    bucket_counts: Tensor  # [T * chunks]
    chunks: int
    alpha_min: float
    alpha_max: float
    transmittance_min: float


@dataclass
class CudaScreenGradients:
    """Gradients on the screen (see `ScreenGradients`), and what takes them to the parameters.

    Args:
        gaussians: the model that was drawn, raw parameters: contiguous, and the caller's own tensors where those were.
        cameras: the K views.
        samples: of the pass.
        sh_degree: bands that were used.
        settings: of the pass.
        records: [K, N, 16] float32: 0-1 d/dmean2d, 2-4 d/dconic (b's entry counts both off-diagonal ones), 5-7 d/dcolor
            after the clamp at 0, 8 d/dopacity after the sigmoid, 9-10 sums of |d/dmean2d| per pixel, 11 sum e * w,
            12 sum D * w, 13 sum w, 14 d/ddepth; 9, 10 and 12 are 0 without `with_statistics`. Where a Gaussian is off
            screen, a record may hold anything.
        radii: [K, N, 2] int32, zero where off screen.
        with_statistics: whether 9, 10 and 12 were summed up.
        overflow: [1] int32 on the device, or None; where not 0 the pass drew nothing and nothing may change.
    """

    gaussians: Gaussians
    cameras: Cameras
    samples: PixelSamples
    sh_degree: int
    settings: RasterSettings
    records: Tensor
    radii: Tensor
    with_statistics: bool = False
    overflow: Tensor | None = None

    def full_records(self) -> Tensor:
        """[K, N, 16] the records, zero where a Gaussian is off screen."""
        return torch.where((self.radii > 0).any(dim=-1, keepdim=True), self.records, 0.0)

    def parameter_gradients(self, rows: bool, stats: GaussianStats | None = None) -> GaussianGradients:
        """The gradients of the parameters: one row per view (`rows`), or their sum. May be called once.

        The fields that have rows are views of one packed [K, N, 14] tensor. After an overflow they are zero.
        """
        library.require()
        count, bands = len(self.gaussians), self.gaussians.shN.shape[1]
        num_rows = len(self.cameras) if rows else 1
        # The kernel writes every entry, unless an overflow keeps it from running.
        new = torch.empty if self.overflow is None else torch.zeros
        device = self.records.device
        packed = new(num_rows, count, ROW_WIDTH, device=device)
        shN = new(count, bands, 3, device=device)
        touched = new(count, dtype=torch.bool, device=device)
        view_losses = new(num_rows, count, device=device)
        torch.ops.turbogs.projection_backward(*self.operator_arguments(stats), packed, shN, touched, view_losses)
        return GaussianGradients(
            means=packed[..., COLUMNS["means"]],
            scales=packed[..., COLUMNS["scales"]],
            quats=packed[..., COLUMNS["quats"]],
            sh0=packed[..., COLUMNS["sh0"]].unsqueeze(-2),
            opacities=packed[..., COLUMNS["opacities"]].squeeze(-1),
            shN=shN,
            touched=touched,
            view_losses=view_losses,
        )

    def operator_arguments(self, stats: GaussianStats | None) -> tuple:
        """What the operators that take these gradients to the parameters have in common."""
        require_views(len(self.cameras))
        require_statistics(self.with_statistics, stats)
        return (
            [getattr(self.gaussians, name).detach() for name in PARAMETER_NAMES],
            self.cameras.viewmats.contiguous(),
            self.cameras.Ks.contiguous(),
            self.cameras.sizes.reshape(-1).tolist(),
            self.records,
            self.radii,
            [] if stats is None else [getattr(stats, field.name) for field in fields(stats)],
            self.sh_degree,
            self.settings.eps2d,
            count_filled(self.samples),
            len(self.samples),
            self.overflow,
        )


def count_filled(samples: PixelSamples) -> Tensor | None:
    """[1] int32 on the device: the filled slots; None where all are."""
    if not samples.has_empty_slots:
        return None
    count = torch.zeros(1, dtype=torch.int32, device=samples.pixel_ids.device)
    torch.ops.turbogs.count_filled(samples.pixel_ids, count)
    return count


def require_views(count: int) -> None:
    """Raise `InputError` where a batch has no view, or more than the kernels take."""
    if not 1 <= count <= MAX_VIEWS:
        raise InputError(f"a batch takes 1 .. {MAX_VIEWS} views, got {count}")


@dataclass
class CudaRendered:
    """One forward pass (see `Rendered`). With a workspace, valid until the next pass."""

    colors: Tensor
    alphas: Tensor
    depths: Tensor | None
    num_pairs: Tensor
    """[1] int32 on the device: the (tile, splat) pairs of this pass."""
    _gaussians: Gaussians = field(repr=False)
    _cameras: Cameras = field(repr=False)
    _samples: PixelSamples = field(repr=False)
    _sh_degree: int = field(repr=False)
    _settings: RasterSettings = field(repr=False)
    _buffers: _FreshBuffers | Workspace = field(repr=False)
    _radii: Tensor = field(repr=False)  # [K, N, 2]
    _forward: ForwardArguments = field(repr=False)
    _cleared: bool = field(repr=False)  # the projection has cleared the records on screen, for one backward pass

    @torch.no_grad()
    def projected(self) -> Projected:
        """The projection that this pass drew."""
        splats = self._forward.instances.view(*self._radii.shape[:2], INSTANCE_FLOATS)
        splats = torch.where((self._radii > 0).any(dim=-1, keepdim=True), splats, 0.0)
        return Projected(
            means2d=splats[..., :2],
            conics=splats[..., 2:5],
            depths=splats[..., 6],
            opacities=splats[..., 5],
            radii=self._radii.clone(),
        )

    @torch.no_grad()
    def backward(
        self,
        color_gradients: Tensor,
        pixel_errors: Tensor | None = None,
        *,
        with_statistics: bool = False,
        alpha_gradients: Tensor | None = None,
        depth_gradients: Tensor | None = None,
    ) -> CudaScreenGradients:
        """Back-propagate to the screen; the arguments are those of `Rendered.backward`.

        Raises:
            InputError: depth gradients of a pass without depths; a tensor of wrong shape, dtype or device.
        """
        if depth_gradients is not None and self.depths is None:
            raise InputError("depth_gradients need a pass with depths: rasterize(..., with_depth=True)")
        slots = len(self._samples)
        optional = {
            "alpha_gradients": alpha_gradients,
            "depth_gradients": depth_gradients,
            "pixel_errors": pixel_errors,
        }
        given = {"color_gradients": (color_gradients, (slots, 3))}
        given |= {name: (value, (slots,)) for name, value in optional.items() if value is not None}
        ready = {}
        for name, (value, shape) in given.items():
            if value.shape != shape or value.dtype != torch.float32 or value.device != self.colors.device:
                wanted = f"float32 {list(shape)} on {self.colors.device}"
                raise InputError(f"{name} must be {wanted}, got {value.dtype} {list(value.shape)} on {value.device}")
            ready[name] = value.contiguous()
        records = self._buffers.buffer("records", (len(self._forward.instances), RECORD_FLOATS), torch.float32)
        torch.ops.turbogs.raster_backward(
            *self._forward,
            ready["color_gradients"],
            ready.get("alpha_gradients"),
            ready.get("depth_gradients"),
            ready.get("pixel_errors"),
            records,
            with_statistics,
            self._cleared,
        )
        self._cleared = False
        return CudaScreenGradients(
            gaussians=self._gaussians,
            cameras=self._cameras,
            samples=self._samples,
            sh_degree=self._sh_degree,
            settings=self._settings,
            records=records.view(*self._radii.shape[:2], RECORD_FLOATS),
            radii=self._radii,
            with_statistics=with_statistics,
            overflow=self._buffers.overflow if isinstance(self._buffers, Workspace) else None,
        )


@torch.no_grad()
def rasterize_cuda(
    gaussians: Gaussians,
    cameras: Cameras,
    samples: PixelSamples,
    *,
    sh_degree: int | None = None,
    settings: RasterSettings = DEFAULT_SETTINGS,
    with_depth: bool = False,
    workspace: Workspace | None = None,
) -> CudaRendered:
    """Render samples; see `engine.rendering.rasterize`. On torch's current stream of the Gaussians' device.

    Args:
        workspace: memory to use again, and no waiting for the GPU; see `Workspace` for what the caller then owes.

    Raises:
        InputError: no kernels here, a tensor of wrong dtype or device, or more pairs than a pass can have.
    """
    library.require()
    degree = used_degree(gaussians, sh_degree)
    _check(gaussians, cameras, samples)
    gaussians = gaussians.map(_prepared)
    device = gaussians.device
    buffers = workspace if workspace is not None else _FreshBuffers(device)
    views, count, slots = len(cameras), len(gaussians), len(samples)
    total, num_tiles, num_active = views * count, len(samples.grid), len(samples.tile_ids)

    def integers(name: str, *shape: int, dtype: torch.dtype = torch.int32) -> Tensor:
        return buffers.buffer(name, shape, dtype)

    def floats(name: str, *shape: int) -> Tensor:
        return buffers.buffer(name, shape, torch.float32)

    # A pass over every tile needs no table of the active ones.
    everywhere = num_active == num_tiles
    tile_ids = None if everywhere else samples.tile_ids.contiguous()
    active_prefix = None if everywhere else integers("active_prefix", num_tiles + 1)
    packed_cameras = floats("cameras", views, CAMERA_FLOATS)
    instances = floats("instances", total, INSTANCE_FLOATS)
    radii = integers("radii", views, count, 2)
    tile_cursors = integers("tile_cursors", num_active + 1)
    # With a workspace a backward pass is likely to follow.
    records = floats("records", total, RECORD_FLOATS) if workspace is not None else None
    torch.ops.turbogs.raster_project(
        [value for _, value in gaussians.items()],
        cameras.viewmats.detach().contiguous(),
        cameras.Ks.detach().contiguous(),
        samples.sizes.reshape(-1).tolist(),
        degree,
        settings.eps2d,
        settings.near_plane,
        settings.far_plane,
        settings.alpha_min,
        tile_ids,
        packed_cameras,
        active_prefix,
        instances,
        radii,
        tile_cursors,
        records,
    )

    status = workspace.status if workspace is not None else torch.zeros(2, dtype=torch.int32, device=device)
    capacity = workspace.capacity(count, num_active) if workspace is not None else None
    tile_starts, counters = integers("tile_starts", num_active + 1), integers("pair_counters", 2)
    torch.ops.turbogs.raster_count_pairs(
        tile_cursors,
        tile_starts,
        status,
        counters,
        integers("block_sums", max(1, math.ceil(num_active / SCAN_TILES)), 2, dtype=torch.int64),
        COUNT_MAX if capacity is None else capacity,
    )
    if capacity is None:
        pairs = int(status[0])
        require_possible(pairs)
        capacity = round_capacity(pairs)
        if workspace is not None:
            workspace.learn(pairs, num_active)

    pair_ids = integers("pair_ids", capacity)
    torch.ops.turbogs.raster_sort_pairs(
        instances,
        radii,
        packed_cameras,
        active_prefix,
        tile_cursors,
        tile_starts,
        status,
        integers("pair_keys", capacity, dtype=torch.int64),
        pair_ids,
        counters,
        integers("runs", capacity // (RUN // 2), 2),
    )
    if workspace is not None:
        workspace.send_count(num_active)

    chunks = warps_per_tile(slots, num_active)
    colors = torch.empty(slots, 3, device=device)
    alphas = torch.empty(slots, device=device)
    depths = torch.empty(slots, device=device) if with_depth else None
    forward = ForwardArguments(
        cameras=packed_cameras,
        tile_ids=tile_ids,
        tile_offsets=samples.tile_offsets.contiguous(),
        pixel_ids=samples.pixel_ids.contiguous(),
        tile_starts=tile_starts,
        pair_ids=pair_ids,
        instances=instances,
        colors=colors,
        alphas=alphas,
        transmittances=floats("transmittances", slots),
        depths=depths,
        last_pairs=integers("last_pairs", slots),
        masks=integers("masks", (capacity // WARP + num_active + 1) * chunks),
        bucket_counts=integers("bucket_counts", num_active * chunks),
        chunks=chunks,
        alpha_min=settings.alpha_min,
        alpha_max=settings.alpha_max,
        transmittance_min=settings.transmittance_min,
    )
    torch.ops.turbogs.raster_forward(*forward)
    return CudaRendered(
        colors=colors,
        alphas=alphas,
        depths=depths,
        num_pairs=status[:1],
        _gaussians=gaussians,
        _cameras=cameras,
        _samples=samples,
        _sh_degree=degree,
        _settings=settings,
        _buffers=buffers,
        _radii=radii,
        _forward=forward,
        _cleared=records is not None,
    )
