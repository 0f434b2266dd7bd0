"""The rasterizer in torch: the definition of what every other one computes, and what runs without a GPU."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from turbogs_plugin.engine.layout import ScreenRecord
from turbogs_plugin.engine.reference import compositing
from turbogs_plugin.engine.reference.compositing import ALPHA_TINY, Compositor
from turbogs_plugin.engine.reference.intersection import intersect_tiles
from turbogs_plugin.engine.reference.projection import Rows, Splats, drawable_rows, project_rows
from turbogs_plugin.engine.rendered import DEFAULT_SETTINGS, Projected, RasterSettings, require_statistics
from turbogs_plugin.engine.shared import used_degree
from turbogs_plugin.types import Cameras, GaussianGradients, Gaussians, GaussianStats, PixelSamples

ROW_PARAMETERS = ("means", "quats", "scales", "opacities", "sh0")
"""The parameters that have one gradient row per view."""


def expected_depths(sums: Tensor) -> Tensor:
    """[P, 5] sums -> [P] expected depth, 0 where nothing was hit. Differentiable."""
    return sums[:, 4] / sums[:, 3].clamp(min=ALPHA_TINY)


@dataclass
class ReferenceScreenGradients:
    """Gradients on the screen (see `ScreenGradients`).

    Args:
        rows: which (view, Gaussian) each row is.
        splats: their projection, connected to `leaves` by autograd.
        leaves: the parameters' rows, in the order of `ROW_PARAMETERS`, and `shN`.
        records: [R, 16], see `layout.ScreenRecord`.
        samples: of the pass.
        with_statistics: whether the pass was asked for them.
    """

    rows: Rows
    splats: Splats
    leaves: list[Tensor]
    records: Tensor
    samples: PixelSamples
    with_statistics: bool = False

    def full_records(self) -> Tensor:
        """[K, N, 16], zero where a Gaussian is not drawn."""
        return self.rows.scatter(self.records)

    def parameter_gradients(self, rows: bool, stats: GaussianStats | None = None) -> GaussianGradients:
        """The gradients of the parameters: one row per view (`rows`), or their sum. May be called once."""
        require_statistics(self.with_statistics, stats)
        records, splats = self.records, self.splats
        outputs = (splats.means2d, splats.conics, splats.colors, splats.opacities, splats.depths)
        columns = (ScreenRecord.MEAN, ScreenRecord.CONIC, ScreenRecord.COLOR, ScreenRecord.OPACITY, ScreenRecord.DEPTH)
        upstream = [records[:, column] for column in columns]
        gradients = torch.autograd.grad(outputs, self.leaves, upstream, allow_unused=True, materialize_grads=True)
        place = self.rows.scatter if rows else self._sum_over_views
        named = {name: place(value) for name, value in zip(ROW_PARAMETERS, gradients, strict=False)}
        weights = records.new_zeros(self.rows.shape[1]).index_add(
            0, self.rows.gaussians, records[:, ScreenRecord.WEIGHT_SUM]
        )
        filled = self.samples.filled.sum().clamp(min=1)
        losses = place(records[:, ScreenRecord.ERROR_SUM] / filled)
        if stats is not None:
            self._add_statistics(stats)
        return GaussianGradients(**named, shN=gradients[-1], touched=weights > 0, view_losses=losses)

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
            "view_counts": on_screen,
        }
        for name, values in sums.items():
            getattr(stats, name).index_add_(0, gaussians, values.to(stats.error_sums.dtype))
        radii = self.splats.radii.amax(dim=-1) / sizes.amax(dim=-1)[views]
        largest = self.rows.scatter(radii).amax(dim=0).to(stats.max_radii.dtype)
        torch.maximum(stats.max_radii, largest, out=stats.max_radii)


@dataclass
class ReferenceRendered:
    """One forward pass (see `Rendered`)."""

    colors: Tensor
    alphas: Tensor
    depths: Tensor | None
    _sums: Tensor = field(repr=False)
    _table: Tensor = field(repr=False)
    _compositor: Compositor = field(repr=False)
    _rows: Rows = field(repr=False)
    _splats: Splats = field(repr=False)
    _leaves: list[Tensor] = field(repr=False)

    @torch.no_grad()
    def projected(self) -> Projected:
        """The projection that this pass drew."""
        names = ("means2d", "conics", "depths", "opacities", "radii")
        shown = (self._splats.radii > 0).any(dim=-1)

        def placed(values: Tensor) -> Tensor:
            return self._rows.scatter(torch.where(shown.reshape(-1, *[1] * (values.dim() - 1)), values, 0))

        return Projected(**{name: placed(getattr(self._splats, name)) for name in names})

    @torch.no_grad()
    def backward(
        self,
        color_gradients: Tensor,
        pixel_errors: Tensor | None = None,
        *,
        with_statistics: bool = False,
        alpha_gradients: Tensor | None = None,
        depth_gradients: Tensor | None = None,
    ) -> ReferenceScreenGradients:
        """Back-propagate to the screen; the arguments are those of `Rendered.backward`."""
        zeros = torch.zeros_like(self.alphas)
        alpha_gradients = zeros if alpha_gradients is None else alpha_gradients
        depth_gradients = zeros if depth_gradients is None else depth_gradients
        # The expected depth is a quotient of two of the sums.
        alphas = self._sums[:, 3].clamp(min=ALPHA_TINY)
        divided = depth_gradients / alphas
        through_alpha = torch.where(self._sums[:, 3] >= ALPHA_TINY, divided * self._sums[:, 4] / alphas, 0.0)
        gradients = torch.cat(
            [color_gradients, (alpha_gradients - through_alpha)[:, None], divided[:, None]], dim=1
        ).to(self._sums.dtype)
        records = compositing.composite_backward(self._compositor, self._table, self._sums, gradients, pixel_errors)
        return ReferenceScreenGradients(
            self._rows, self._splats, self._leaves, records, self._compositor.samples, with_statistics
        )


def rasterize_reference(
    gaussians: Gaussians,
    cameras: Cameras,
    samples: PixelSamples,
    *,
    sh_degree: int | None = None,
    settings: RasterSettings = DEFAULT_SETTINGS,
    with_depth: bool = False,
) -> ReferenceRendered:
    """Render samples; see `turbogs_plugin.engine.rendering.rasterize`. float32 or float64, CPU or CUDA."""
    degree = used_degree(gaussians, sh_degree)
    with torch.enable_grad():
        rows = drawable_rows(gaussians, cameras, settings)
        leaves = [getattr(gaussians, name).detach()[rows.gaussians].requires_grad_() for name in ROW_PARAMETERS]
        leaves.append(gaussians.shN.detach().requires_grad_())
        means, quats, scales, opacities, sh0, shN = leaves
        splats = project_rows(rows, means, quats, scales, opacities, sh0, shN, cameras, degree, settings)
    with torch.no_grad():
        compositor = Compositor(intersect_tiles(rows, splats, samples, settings), samples, settings)
        table = compositing.splat_table(splats.means2d, splats.conics, splats.colors, splats.opacities, splats.depths)
        sums = compositing.composite(compositor, table)
        depths = expected_depths(sums) if with_depth else None
    return ReferenceRendered(sums[:, :3], sums[:, 3], depths, sums, table, compositor, rows, splats, leaves)
