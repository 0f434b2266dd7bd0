"""The rasterizer in CUDA (csrc/raster), twin of `engine.reference.raster`: projection, sort by tile, forward and
backward pass.

Everything is float32. Without a `Workspace` a pass waits once for the GPU, to learn the number of intersections of
tiles and splats; with one it never waits (see `workspace.py`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.engine.cuda import launches, library
from turbogs_plugin.engine.cuda.workspace import Workspace, require_possible, round_capacity
from turbogs_plugin.engine.layout import (
    BUCKET,
    INTERSECTIONS_MAX,
    MAX_VIEWS,
    SCAN_TILES,
    SORT_RUN,
    WARP_SIZE,
    CameraRow,
    InstanceRow,
    ParameterRow,
    ScreenRecord,
)
from turbogs_plugin.engine.rendered import DEFAULT_SETTINGS, Projected, RasterSettings, require_statistics
from turbogs_plugin.engine.shared import used_degree
from turbogs_plugin.errors import InputError
from turbogs_plugin.types import Cameras, GaussianGradients, Gaussians, GaussianStats, PixelSamples


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
    return max(1, -(-slots // (max(1, tiles) * WARP_SIZE)))


@dataclass
class CudaScreenGradients:
    """Gradients on the screen (see `ScreenGradients`), and what takes them to the parameters.

    Args:
        gaussians: the model that was drawn, raw parameters: contiguous, and the caller's own tensors where those were.
        cameras: the K views.
        samples: of the pass.
        sh_degree: bands that were used.
        settings: of the pass.
        records: [K, N, 16] float32, `layout.ScreenRecord`. Where a Gaussian is off screen, a record may hold anything.
        radii: [K, N, 2] int32, zero where off screen.
        with_statistics: whether the columns that only density control asks for were filled.
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
        backward = launches.ProjectionBackward(
            screen=self.backward_arguments(stats),
            rows=new(num_rows, count, ParameterRow.SIZE, device=device),
            shN_gradients=new(count, bands, 3, device=device),
            touched=new(count, dtype=torch.bool, device=device),
            view_losses=new(num_rows, count, device=device),
        )
        library.launch(backward)
        packed = backward.rows
        return GaussianGradients(
            means=packed[..., ParameterRow.MEANS],
            scales=packed[..., ParameterRow.SCALES],
            quats=packed[..., ParameterRow.QUATS],
            sh0=packed[..., ParameterRow.SH0].unsqueeze(-2),
            opacities=packed[..., ParameterRow.OPACITIES].squeeze(-1),
            shN=backward.shN_gradients,
            touched=backward.touched,
            view_losses=backward.view_losses,
        )

    def backward_arguments(self, stats: GaussianStats | None) -> launches.ScreenBackward:
        """What the launches that take these gradients to the parameters have in common."""
        require_views(len(self.cameras))
        require_statistics(self.with_statistics, stats)
        return launches.ScreenBackward(
            scene=_scene(self.gaussians, self.cameras, self.sh_degree, self.settings),
            records=self.records,
            radii=self.radii,
            stats=launches.NO_STATS if stats is None else stats,
            num_filled=count_filled(self.samples),
            num_slots=len(self.samples),
            overflow=self.overflow,
        )


def _scene(gaussians: Gaussians, cameras: Cameras, sh_degree: int, settings: RasterSettings) -> launches.Scene:
    return launches.Scene(
        gaussians=gaussians,
        viewmats=cameras.viewmats.detach().contiguous(),
        Ks=cameras.Ks.detach().contiguous(),
        sizes=cameras.sizes.reshape(-1).tolist(),
        sh_degree=sh_degree,
        eps2d=settings.eps2d,
    )


def count_filled(samples: PixelSamples) -> Tensor | None:
    """[1] int32 on the device: the filled slots; None where all are."""
    if not samples.has_empty_slots:
        return None
    count = torch.zeros(1, dtype=torch.int32, device=samples.pixel_ids.device)
    library.launch(launches.CountFilled(pixel_ids=samples.pixel_ids, num_filled=count))
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
    num_intersections: Tensor
    """[1] int32 on the device: the intersections of tiles and splats of this pass."""
    _gaussians: Gaussians = field(repr=False)
    _cameras: Cameras = field(repr=False)
    _samples: PixelSamples = field(repr=False)
    _sh_degree: int = field(repr=False)
    _settings: RasterSettings = field(repr=False)
    _buffers: _FreshBuffers | Workspace = field(repr=False)
    _radii: Tensor = field(repr=False)  # [K, N, 2]
    _forward: launches.RasterForward = field(repr=False)
    _cleared: bool = field(repr=False)  # the projection has cleared the records on screen, for one backward pass

    @torch.no_grad()
    def projected(self) -> Projected:
        """The projection that this pass drew."""
        splats = self._forward.instances.view(*self._radii.shape[:2], InstanceRow.SIZE)
        splats = torch.where((self._radii > 0).any(dim=-1, keepdim=True), splats, 0.0)
        return Projected(
            means2d=splats[..., InstanceRow.MEAN],
            conics=splats[..., InstanceRow.CONIC],
            depths=splats[..., InstanceRow.DEPTH],
            opacities=splats[..., InstanceRow.OPACITY],
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
        records = self._buffers.buffer("records", (len(self._forward.instances), ScreenRecord.SIZE), torch.float32)
        library.launch(
            launches.RasterBackward(
                forward=self._forward,
                color_gradients=ready["color_gradients"],
                alpha_gradients=ready.get("alpha_gradients"),
                depth_gradients=ready.get("depth_gradients"),
                pixel_errors=ready.get("pixel_errors"),
                records=records,
                with_density_sums=with_statistics,
                cleared=self._cleared,
            )
        )
        self._cleared = False
        return CudaScreenGradients(
            gaussians=self._gaussians,
            cameras=self._cameras,
            samples=self._samples,
            sh_degree=self._sh_degree,
            settings=self._settings,
            records=records.view(*self._radii.shape[:2], ScreenRecord.SIZE),
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
        InputError: no kernels here, a tensor of wrong dtype or device, or more intersections than a pass can have.
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
    splats = launches.Splats(
        cameras=floats("cameras", views, CameraRow.SIZE),
        instances=floats("instances", total, InstanceRow.SIZE),
        radii=integers("radii", views, count, 2),
        active_prefix=None if everywhere else integers("active_prefix", num_tiles + 1),
    )
    tiles = launches.TileLists(
        tile_cursors=integers("tile_cursors", num_active + 1),
        tile_starts=integers("tile_starts", num_active + 1),
        status=workspace.status if workspace is not None else torch.zeros(2, dtype=torch.int32, device=device),
        counters=integers("counters", 2),
    )
    # With a workspace a backward pass is likely to follow.
    records = floats("records", total, ScreenRecord.SIZE) if workspace is not None else None
    library.launch(
        launches.RasterProject(
            scene=_scene(gaussians, cameras, degree, settings),
            settings=settings,
            splats=splats,
            tile_ids=tile_ids,
            tile_cursors=tiles.tile_cursors,
            records=records,
        )
    )

    capacity = workspace.capacity(count, num_active) if workspace is not None else None
    blocks = max(1, math.ceil(num_active / SCAN_TILES))
    library.launch(
        launches.RasterCountIntersections(
            tiles=tiles,
            block_sums=integers("block_sums", blocks, 2, dtype=torch.int64),
            capacity=INTERSECTIONS_MAX if capacity is None else capacity,
        )
    )
    if capacity is None:
        intersections = int(tiles.status[0])
        require_possible(intersections)
        capacity = round_capacity(intersections)
        if workspace is not None:
            workspace.learn(intersections, num_active)

    intersection_ids = integers("intersection_ids", capacity)
    library.launch(
        launches.RasterSortIntersections(
            splats=splats,
            tiles=tiles,
            intersection_keys=integers("intersection_keys", capacity, dtype=torch.int64),
            intersection_ids=intersection_ids,
            runs=integers("runs", capacity // (SORT_RUN // 2), 2),
        )
    )
    if workspace is not None:
        workspace.send_count(num_active)

    chunks = warps_per_tile(slots, num_active)
    forward = launches.RasterForward(
        cameras=splats.cameras,
        tile_ids=tile_ids,
        tile_offsets=samples.tile_offsets.contiguous(),
        pixel_ids=samples.pixel_ids.contiguous(),
        tile_starts=tiles.tile_starts,
        intersection_ids=intersection_ids,
        instances=splats.instances,
        colors=torch.empty(slots, 3, device=device),
        alphas=torch.empty(slots, device=device),
        transmittances=floats("transmittances", slots),
        depths=torch.empty(slots, device=device) if with_depth else None,
        last_intersections=integers("last_intersections", slots),
        masks=integers("masks", (capacity // BUCKET + num_active + 1) * chunks),
        bucket_counts=integers("bucket_counts", num_active * chunks),
        chunks=chunks,
        settings=settings,
    )
    library.launch(forward)
    return CudaRendered(
        colors=forward.colors,
        alphas=forward.alphas,
        depths=forward.depths,
        num_intersections=tiles.status[:1],
        _gaussians=gaussians,
        _cameras=cameras,
        _samples=samples,
        _sh_degree=degree,
        _settings=settings,
        _buffers=buffers,
        _radii=splats.radii,
        _forward=forward,
        _cleared=records is not None,
    )
