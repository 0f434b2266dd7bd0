"""Exact tile intersection: nothing that contributes is lost, nothing else is kept."""

import numpy as np
import pytest
import torch
from helpers.rendering_scenes import dense_on_grid, make_cameras, make_gaussians, thin_out

from turbogs_plugin.engine.reference.intersection import intersect_tiles
from turbogs_plugin.engine.reference.projection import drawable_rows, project_rows
from turbogs_plugin.engine.render_pass import RasterSettings

SETTINGS = RasterSettings()


def contributing(rows, splats, samples, tile: int) -> torch.Tensor:
    """[R] bool by brute force: alpha reaches the threshold at some pixel of the tile."""
    grid, tile_id = samples.grid, int(samples.tile_ids[tile])
    view = int(np.searchsorted(grid.starts, tile_id, side="right")) - 1
    line, column = divmod(tile_id - int(grid.starts[view]), int(grid.shapes[view, 0]))
    width, height = samples.sizes[view]
    left, top = 16 * column - samples.origin[0], 16 * line - samples.origin[1]
    y, x = torch.meshgrid(
        torch.arange(max(top, 0), min(top + 16, height)),
        torch.arange(max(left, 0), min(left + 16, width)),
        indexing="ij",
    )
    centers = torch.stack([x, y], dim=-1).reshape(-1, 2) + 0.5
    dx, dy = (splats.means2d[:, None] - centers.to(splats.means2d.dtype)).unbind(dim=-1)
    a, b, c = splats.conics[:, :, None].unbind(dim=1)
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha = splats.opacities[:, None] * torch.exp(-sigma)
    return ((alpha >= SETTINGS.alpha_min) & (sigma >= 0)).any(dim=1) & (rows.views == view)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("shape", "origin"), [("round", (0, 0)), ("needles", (0, 0)), ("needles", (15, 6))])
def test_no_contribution_is_lost_and_order_is_by_depth(dtype, shape, origin):
    gaussians = make_gaussians(300, dtype=dtype, degree=0, spread=1.5)
    if shape == "needles":
        gaussians.scales[:, 0] += 6
        gaussians.scales[:, 1:] -= 5
    cameras = make_cameras([(70, 45), (33, 64)], dtype)
    samples = thin_out(dense_on_grid(cameras.sizes, origin), 0.2)
    rows = drawable_rows(gaussians, cameras, SETTINGS)
    splats = project_rows(rows, rows.take(gaussians), cameras, 0, SETTINGS)
    intersections = intersect_tiles(rows, splats, samples, SETTINGS)
    assert len(samples.tile_ids) < len(samples.grid)
    found, needed = 0, 0
    for tile, listed in enumerate(intersections.rows.split(intersections.tile_counts.tolist())):
        expected = contributing(rows, splats, samples, tile).nonzero()[:, 0]
        assert set(expected.tolist()) <= set(listed.tolist())
        keys = list(zip(splats.depths[listed].tolist(), rows.gaussians[listed].tolist(), strict=True))
        assert keys == sorted(keys)
        assert len(set(listed.tolist())) == len(listed)
        found, needed = found + len(listed), needed + len(expected)
    # What is kept without contributing lies between two pixel centres.
    assert needed > 200
    assert found <= 1.1 * needed + 5
