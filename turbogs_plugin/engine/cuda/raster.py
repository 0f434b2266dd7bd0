"""The rasterizer in CUDA (csrc/raster), twin of `engine.reference.raster`: projection, sorting by tile, forward and
backward pass.

Everything is float32. Without a `Workspace` a pass waits once for the GPU, to learn the number of intersections of
tiles and splats; with one it never waits (see `workspace.py`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from turbogs_plugin.engine import layout
from turbogs_plugin.engine.cuda import launches, library
from turbogs_plugin.engine.cuda.workspace import Kept, Workspace, require_possible, round_capacity
from turbogs_plugin.engine.layout import InstanceRow, ParameterRow, ScreenRecord
from turbogs_plugin.engine.moments import COLUMNS
from turbogs_plugin.engine.render_pass import (
    DEFAULT_OPTIONS,
    Projected,
    Rendered,
    RenderOptions,
    ScreenGradients,
    ScreenRecords,
    Upstream,
)
from turbogs_plugin.errors import InputError
from turbogs_plugin.types import Cameras, GaussianGradients, Gaussians, GaussianStats, PixelSamples


def plain_floats(tensor: Tensor) -> Tensor:
    """The tensor as kernels take it: float32, contiguous and without a gradient; a copy only if needed."""
    if tensor.requires_grad or tensor.dtype != torch.float32:
        tensor = tensor.detach().float()
    return tensor.contiguous()


def ready(gaussians: Gaussians) -> Gaussians:
    """The model as kernels take it: `plain_floats` that are aligned for 16-byte loads; the given one where it is so."""

    def prepared(value: Tensor) -> Tensor:
        value = plain_floats(value)
        return value if value.data_ptr() % 16 == 0 else value.clone()

    return gaussians if all(prepared(value) is value for _, value in gaussians.items()) else gaussians.map(prepared)


def warps_per_tile(slots: int, tiles: int) -> int:
    """Work items of a tile, 32 slots each, by the average slots of a tile; fuller tiles take several rounds."""
    return max(1, -(-slots // (max(1, tiles) * layout.WARP_SIZE)))


@dataclass
class CudaScreenGradients(ScreenGradients):
    """Gradients on the screen (see `ScreenGradients`), and what is needed to take them to the parameters.

    Args:
        scene: what was drawn. Its Gaussians are raw parameters, the caller's own tensors if those were contiguous.
        records: [K, N, 16] float32, `layout.ScreenRecord`. Where a Gaussian is off screen, a record may hold anything.
        radii: [K, N, 2] int32, zero where off screen.
        overflow: [1] int32 on the device, or None; if not 0, the pass drew nothing and nothing may change.
    """

    scene: launches.Scene
    records: Tensor
    radii: Tensor
    overflow: Tensor | None = None

    def plain(self) -> ScreenRecords:
        return ScreenRecords(self.records, self.radii)

    def parameter_gradients(self, rows: bool, stats: GaussianStats | None = None) -> GaussianGradients:
        # The fields that have rows are views of one packed [K, N, 14] tensor. After an overflow they are zero.
        gaussians = self.scene.gaussians
        shape = (len(self.records) if rows else 1, len(gaussians))
        # The kernel writes every entry, unless an overflow keeps it from running.
        new = partial(torch.empty if self.overflow is None else torch.zeros, device=self.records.device)
        packed, shN = new(*shape, ParameterRow.SIZE), new(gaussians.shN.shape)
        touched = new(len(gaussians), dtype=torch.bool)
        screen = self.backward_arguments(stats)
        library.launch(launches.ProjectionBackward(screen, packed, shN, touched))
        columns = {
            name: packed[..., place].view(*shape, *getattr(gaussians, name).shape[1:])
            for name, place in COLUMNS.items()
        }
        return GaussianGradients(**columns, shN=shN, touched=touched)

    def backward_arguments(self, stats: GaussianStats | None) -> launches.ScreenBackward:
        """The arguments shared by the launches that take these gradients to the parameters."""
        return launches.ScreenBackward(
            scene=self.scene,
            records=self.records,
            radii=self.radii,
            stats=launches.NO_STATS if stats is None else stats,
            overflow=self.overflow,
        )


@dataclass(repr=False)
class CudaRendered(Rendered):
    """One forward pass (see `Rendered`). With a workspace, valid until the next pass."""

    _status: Tensor  # [2] int32, of `layout.PassStatus`
    _scene: launches.Scene
    _workspace: Workspace | None
    _radii: Tensor  # [K, N, 2]
    _forward: launches.RasterForward
    _cleared: bool  # the projection has cleared the records on screen, for one backward pass

    @property
    def num_intersections(self) -> Tensor:
        """[1] int32 on the device: the intersections of tiles and splats of this pass."""
        return self._status[:1]

    @torch.no_grad()
    def projected(self) -> Projected:
        splats = self._forward.instances.view(*self._radii.shape[:2], InstanceRow.SIZE)
        splats = torch.where((self._radii > 0).any(dim=-1, keepdim=True), splats, 0.0)
        return Projected(
            means2d=splats[..., InstanceRow.MEAN],
            conics=splats[..., InstanceRow.CONIC],
            depths=splats[..., InstanceRow.DEPTH],
            opacities=splats[..., InstanceRow.OPACITY],
            radii=self._radii.clone(),
        )

    def _backward(self, upstream: Upstream, with_statistics: bool) -> CudaScreenGradients:
        buffers = Buffers(self._workspace, self.colors.device)
        records = buffers.floats("records", len(self._forward.instances), ScreenRecord.SIZE)
        if not self._cleared:
            records.zero_()
        library.launch(launches.RasterBackward(self._forward, upstream.contiguous(), records, with_statistics))
        self._cleared = False
        overflow = None if self._workspace is None else self._workspace.overflow
        records = records.view(*self._radii.shape[:2], ScreenRecord.SIZE)
        return CudaScreenGradients(self._scene, records, self._radii, overflow)


def scene_of(gaussians: Gaussians, cameras: Cameras, options: RenderOptions) -> launches.Scene:
    """What a pass draws, of Gaussians that are `ready`."""
    viewmats, Ks, rows = cameras.by_row()
    return launches.Scene(
        gaussians=gaussians,
        viewmats=plain_floats(viewmats),
        Ks=plain_floats(Ks),
        images=[number for size, row in zip(cameras.sizes.tolist(), rows, strict=True) for number in (*size, row)],
        sh_degree=options.used_degree(gaussians),
        eps2d=options.settings.eps2d,
    )


@dataclass(frozen=True)
class Buffers:
    """Uninitialised memory for a pass: from the workspace, or newly allocated without one."""

    workspace: Workspace | None
    device: torch.device

    def integers(self, name: str, *shape: int, dtype: torch.dtype = torch.int32) -> Tensor:
        if self.workspace is None:
            return torch.empty(shape, dtype=dtype, device=self.device)
        return self.workspace.buffer(name, shape, dtype)

    def floats(self, name: str, *shape: int) -> Tensor:
        return self.integers(name, *shape, dtype=torch.float32)

    def kept(self, name: str, make: Callable[..., Kept], *sizes: int) -> Kept:
        """Result of `make` with these buffers and sizes; with a workspace, see `Workspace.kept`."""
        of_sizes = partial(make, self, *sizes)
        return of_sizes() if self.workspace is None else self.workspace.kept(name, sizes, of_sizes)


def _front_arrays(
    buffers: Buffers, views: int, count: int, num_active: int, num_tiles: int
) -> tuple[launches.Splats, launches.TileLists, Tensor, Tensor | None]:
    """What the projection and the count of intersections write: splats, lists of tiles, sums of blocks, records."""
    workspace = buffers.workspace
    splats = launches.Splats(
        cameras=buffers.floats("cameras", views, layout.CameraRow.SIZE),
        instances=buffers.floats("instances", views * count, InstanceRow.SIZE),
        radii=buffers.integers("radii", views, count, 2),
        active_prefix=None if num_active == num_tiles else buffers.integers("active_prefix", num_tiles + 1),
    )
    tiles = launches.TileLists(
        tile_cursors=buffers.integers("tile_cursors", num_active + 1),
        tile_starts=buffers.integers("tile_starts", num_active + 1),
        status=torch.zeros(2, dtype=torch.int32, device=buffers.device) if workspace is None else workspace.status,
        counters=buffers.integers("counters", 2),
    )
    block_sums = buffers.integers("block_sums", max(1, math.ceil(num_active / layout.SCAN_TILES)), 2, dtype=torch.int64)
    # With a workspace a backward pass is likely to follow.
    records = None if workspace is None else buffers.floats("records", views * count, ScreenRecord.SIZE)
    return splats, tiles, block_sums, records


def _intersection_arrays(buffers: Buffers, capacity: int) -> launches.Intersections:
    return launches.Intersections(
        intersection_keys=buffers.integers("intersection_keys", capacity, dtype=torch.int64),
        intersection_ids=buffers.integers("intersection_ids", capacity),
        runs=buffers.integers("runs", capacity // (layout.SORT_RUN // 2), 2),
    )


def _pixel_arrays(buffers: Buffers, capacity: int, slots: int, num_active: int) -> launches.PixelArrays:
    chunks = warps_per_tile(slots, num_active)
    return launches.PixelArrays(
        colors=buffers.floats("colors", slots, 3),
        alphas=buffers.floats("alphas", slots),
        transmittances=buffers.floats("transmittances", slots),
        last_intersections=buffers.integers("last_intersections", slots),
        masks=buffers.integers("masks", (capacity // layout.BUCKET + num_active + 1) * chunks),
        bucket_counts=buffers.integers("bucket_counts", num_active * chunks),
        chunks=chunks,
    )


def rasterize_cuda(
    gaussians: Gaussians,
    cameras: Cameras,
    samples: PixelSamples,
    options: RenderOptions = DEFAULT_OPTIONS,
    workspace: Workspace | None = None,
) -> CudaRendered:
    """`Engine.render`, on torch's current stream of the Gaussians' device. `workspace`: memory to reuse, so that
    nothing waits for the GPU; `Workspace` says what the caller must then do.

    Raises:
        InputError: cameras of other image sizes than the samples', or more intersections than a pass can have.
        RuntimeError: a tensor of wrong shape, dtype or device; the message names it.
    """
    if cameras.sizes.tolist() != samples.sizes.tolist():
        raise InputError("cameras and samples differ in their image sizes: select the cameras of samples.view_ids")
    scene = scene_of(ready(gaussians), cameras, options)
    settings, device = options.settings, gaussians.device
    buffers = Buffers(workspace, device)
    views, count, slots = len(cameras), len(gaussians), len(samples)
    num_tiles, num_active = len(samples.grid), len(samples.tile_ids)

    # A pass over every tile needs no table of the active ones.
    tile_ids = None if num_active == num_tiles else samples.tile_ids.contiguous()
    splats, tiles, block_sums, records = buffers.kept("front", _front_arrays, views, count, num_active, num_tiles)
    grid = launches.GridOrigin(*samples.origin)
    arrays = (splats, tile_ids, tiles.tile_cursors, records)
    library.launch(launches.RasterProject(scene, grid, settings, options.dropout, *arrays))

    capacity = None if workspace is None else workspace.capacity(count, num_active)
    most = layout.INTERSECTIONS_MAX if capacity is None else capacity
    library.launch(launches.RasterCountIntersections(tiles, block_sums, most))
    if capacity is None:
        found = int(tiles.status[0])
        require_possible(found)
        capacity = round_capacity(found)
        if workspace is not None:
            workspace.learn(found, num_active)

    intersections = buffers.kept("intersections", _intersection_arrays, capacity)
    library.launch(launches.RasterSortIntersections(splats, tiles, intersections))
    if workspace is not None:
        workspace.send_count(num_active)

    forward = launches.RasterForward(
        cameras=splats.cameras,
        tile_ids=tile_ids,
        tile_offsets=samples.tile_offsets.contiguous(),
        pixel_ids=samples.pixel_ids.contiguous(),
        tile_starts=tiles.tile_starts,
        intersection_ids=intersections.intersection_ids,
        instances=splats.instances,
        pixels=buffers.kept("pixels", _pixel_arrays, capacity, slots, num_active),
        depths=torch.empty(slots, device=device) if options.with_depth else None,
        settings=settings,
        background=launches.Background(*options.background),
    )
    library.launch(forward)
    return CudaRendered(
        forward.pixels.colors,
        forward.pixels.alphas,
        forward.depths,
        _status=tiles.status,
        _scene=scene,
        _workspace=workspace,
        _radii=splats.radii,
        _forward=forward,
        _cleared=workspace is not None,
    )
