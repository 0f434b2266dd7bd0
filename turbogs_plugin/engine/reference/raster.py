"""The rasterizer in torch: the definition of every other one, and the one that runs without a GPU."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from turbogs_plugin.engine.layout import ScreenRecord
from turbogs_plugin.engine.reference.compositing import ALPHA_TINY, Compositor, splat_table
from turbogs_plugin.engine.reference.intersection import intersect_tiles
from turbogs_plugin.engine.reference.philox import PURPOSE_DROPOUT, random_words
from turbogs_plugin.engine.reference.projection import Rows, Splats, drawable_rows, project_rows
from turbogs_plugin.engine.render_pass import (
    DEFAULT_OPTIONS,
    Projected,
    Rendered,
    RenderOptions,
    ScreenGradients,
    ScreenRecords,
    Upstream,
)
from turbogs_plugin.engine.rules import Dropout
from turbogs_plugin.types import PARAMETER_NAMES, Cameras, GaussianGradients, Gaussians, GaussianStats, PixelSamples


@dataclass
class ReferenceScreenGradients(ScreenGradients):
    """Gradients on the screen (see `ScreenGradients`).

    Args:
        rows: the (view, Gaussian) of each row.
        splats: their projection, connected to `leaves` by autograd.
        leaves: the parameters of the rows, see `Rows.take`.
        records: [R, 16], see `layout.ScreenRecord`.
        samples: the pass's samples.
    """

    rows: Rows
    splats: Splats
    leaves: Gaussians
    records: Tensor
    samples: PixelSamples

    def plain(self) -> ScreenRecords:
        return ScreenRecords(self.rows.scatter(self.records), self.rows.scatter(self.splats.radii))

    def parameter_gradients(self, rows: bool, stats: GaussianStats | None = None) -> GaussianGradients:
        records, splats = self.records, self.splats
        outputs = (splats.means2d, splats.conics, splats.colors, splats.opacities, splats.depths)
        columns = (ScreenRecord.MEAN, ScreenRecord.CONIC, ScreenRecord.COLOR, ScreenRecord.OPACITY, ScreenRecord.DEPTH)
        upstream = [records[:, column] for column in columns]
        leaves = [value for _, value in self.leaves.items()]
        with torch.autocast("cpu", enabled=False):
            gradients = torch.autograd.grad(outputs, leaves, upstream, allow_unused=True, materialize_grads=True)
        place = self.rows.scatter if rows else self._sum_over_views
        named = {
            name: value if name == "shN" else place(value)
            for name, value in zip(PARAMETER_NAMES, gradients, strict=True)
        }
        weights = self._sum_over_views(records[:, ScreenRecord.WEIGHT_SUM])[0]
        if stats is not None:
            self._add_statistics(stats)
        return GaussianGradients(**named, touched=weights > 0)

    def _sum_over_views(self, values: Tensor) -> Tensor:
        """[R, ...] -> [1, N, ...]."""
        summed = values.new_zeros(self.rows.shape[1], *values.shape[1:])
        return summed.index_add(0, self.rows.gaussians, values)[None]

    def _add_statistics(self, stats: GaussianStats) -> None:
        records, views, gaussians = self.records, self.rows.views, self.rows.gaussians
        sizes = torch.as_tensor(self.samples.sizes, device=records.device).to(records.dtype)  # [K, 2]
        half = 0.5 * len(sizes) * sizes[views]  # [R, 2] from pixels to gsplat's units
        on_screen = (self.splats.radii > 0).any(dim=-1)
        sums = {
            "error_sums": records[:, ScreenRecord.ERROR_SUM],
            "distance_sums": records[:, ScreenRecord.DISTANCE_SUM],
            "weight_sums": records[:, ScreenRecord.WEIGHT_SUM],
            "grad_sums": (records[:, ScreenRecord.MEAN] * half).norm(dim=-1),
            "absgrad_sums": (records[:, ScreenRecord.ABSOLUTE] * half).norm(dim=-1),
            "square_sums": records[:, ScreenRecord.SQUARE_SUM],
            "view_counts": on_screen,
        }
        for name, values in sums.items():
            getattr(stats, name).index_add_(0, gaussians, values.to(stats.error_sums.dtype))
        radii = self.splats.radii.amax(dim=-1) / sizes.amax(dim=-1)[views]
        largest = self.rows.scatter(radii).amax(dim=0).to(stats.max_radii.dtype)
        torch.maximum(stats.max_radii, largest, out=stats.max_radii)


@dataclass(repr=False)
class ReferenceRendered(Rendered):
    """One forward pass (see `Rendered`)."""

    _sums: Tensor
    _compositor: Compositor
    _rows: Rows
    _splats: Splats
    _leaves: Gaussians
    _background: Tensor | None  # [3]; None: black

    @torch.no_grad()
    def projected(self) -> Projected:
        shown = (self._splats.radii > 0).any(dim=-1)

        def placed(values: Tensor) -> Tensor:
            return self._rows.scatter(torch.where(shown.reshape(-1, *[1] * (values.dim() - 1)), values, 0))

        return Projected(**{each.name: placed(getattr(self._splats, each.name)) for each in fields(Projected)})

    @torch.no_grad()
    def _backward(self, upstream: Upstream, with_statistics: bool) -> ReferenceScreenGradients:
        zeros = torch.zeros_like(self.alphas)
        given = {name: zeros if value is None else value for name, value in vars(upstream).items()}
        # The expected depth is a quotient of two of the sums.
        alphas = self._sums[:, 3].clamp(min=ALPHA_TINY)
        divided = given["depth_gradients"] / alphas
        through_alpha = torch.where(self._sums[:, 3] >= ALPHA_TINY, divided * self._sums[:, 4] / alphas, 0.0)
        to_alpha = given["alpha_gradients"] - through_alpha
        with torch.autocast("cpu", enabled=False):
            if self._background is not None:
                to_alpha = to_alpha - given["color_gradients"].to(self._background) @ self._background
            columns = [given["color_gradients"], to_alpha[:, None], divided[:, None]]
            gradients = torch.cat(columns, dim=1).to(self._sums.dtype)
            records = self._compositor.backward(self._sums, gradients, given["pixel_errors"])
        return ReferenceScreenGradients(self._rows, self._splats, self._leaves, records, self._compositor.samples)


def rasterize_reference(
    gaussians: Gaussians, cameras: Cameras, samples: PixelSamples, options: RenderOptions = DEFAULT_OPTIONS
) -> ReferenceRendered:
    """`Engine.render`; float32 or float64, CPU or CUDA."""
    settings = options.settings
    stay = kept(options.dropout, len(gaussians), gaussians.device)
    with torch.autocast("cpu", enabled=False):  # a host's changes no product, as it changes none in the kernels
        rows, leaves, splats = _projected(gaussians, cameras, options, None if stay is None else stay[:, None])
    with torch.no_grad():
        table = splat_table(splats)
        compositor = Compositor(intersect_tiles(rows, splats, samples, settings), samples, settings, table)
        sums = compositor.forward()
        depths = sums[:, 4] / sums[:, 3].clamp(min=ALPHA_TINY) if options.with_depth else None
        colors, background = sums[:, :3], None
        if any(options.background):
            background = sums.new_tensor(options.background)
            colors = colors + (1.0 - sums[:, 3:4]) * background
    return ReferenceRendered(colors, sums[:, 3], depths, sums, compositor, rows, splats, leaves, background)


def kept(dropout: Dropout, count: int, device: torch.device) -> Tensor | None:
    """[N] bool, the Gaussians that are not left out: row n is one if word 0 of place n is not below the threshold.

    None where all stay.
    """
    if dropout.threshold == 0:
        return None
    rows = torch.arange(count, device=device)
    return random_words(rows, 0, PURPOSE_DROPOUT, dropout.seed, dropout.iteration)[0] >= dropout.threshold


def screen_gradients(
    gaussians: Gaussians, cameras: Cameras, samples: PixelSamples, options: RenderOptions, plain: ScreenRecords
) -> ReferenceScreenGradients:
    """`Engine.screen_gradients`: projects those Gaussians again that were drawn."""
    rows, leaves, splats = _projected(gaussians, cameras, options, (plain.radii > 0).any(dim=-1).T)
    records = plain.records.flatten(0, 1)[rows.flat]  # [R, 16]
    return ReferenceScreenGradients(rows, splats, leaves, records, samples)


def _projected(
    gaussians: Gaussians, cameras: Cameras, options: RenderOptions, among: Tensor | None
) -> tuple[Rows, Gaussians, Splats]:
    """The rows that can be drawn, their parameters, and their projection, connected to these by autograd.

    Args:
        among: as in `drawable_rows`.
    """
    degree, settings = options.used_degree(gaussians), options.settings
    with torch.enable_grad():
        rows = drawable_rows(gaussians, cameras, settings, among)
        leaves = rows.take(gaussians).map(lambda value: value.detach().requires_grad_())
        return rows, leaves, project_rows(rows, leaves, cameras, degree, settings)
