"""SSIM of the samples of tiles, in Gaussian windows (Wang et al. 2004) that end at the edge of the tile."""

from __future__ import annotations

import torch
from torch import Tensor

from turbogs_plugin.engine.layout import WINDOW_RADIUS
from turbogs_plugin.engine.reference.tile_groups import TileGroups
from turbogs_plugin.engine.rules import LUMINANCE_CONSTANT, STRUCTURE_CONSTANT, WINDOW_SIGMA
from turbogs_plugin.types import TILE_SIZE, PixelSamples


def window_similarity(
    colors: Tensor, targets: Tensor, samples: PixelSamples, groups: TileGroups
) -> tuple[Tensor, Tensor]:
    """SSIM of every sample, and what it gives to the gradient.

    The window of sample i has the weights ``w_j g(i - j)`` over the samples j of its tile, over their sum n_i, with g a
    Gaussian of `WINDOW_SIGMA` pixels that ends after `WINDOW_RADIUS` pixels along each axis. Means, variances and
    covariance under the window give the luminance term times the contrast-structure term::

        S_i = (2 m_x m_y + c1) / (m_x^2 + m_y^2 + c1) * (2 s_xy + c) / (s_x^2 + s_y^2 + c)
        h_j = sum over i of w_i g(i - j) / n_i * (a_i (y_j - m_y,i) - b_i (x_j - m_x,i) + l_i)

    a, b and l are those of the sample's window: ``2 L / (s_x^2 + s_y^2 + c)``, ``S a / L`` and the slope of the
    luminance term L with m_x, times the other. With ``omega_j = w_j / sum(w)`` over the tile, the tile's similarity is
    ``sum of omega_i S_i`` and its derivative with x_j is ``omega_j h_j``.

    The moments are taken relative to the tile's first sample. They are differences of sums, so that of colours of
    thousands a flat window's variance is lost; the covariance is then held to what the variances allow, and S to 1.
    And c is SSIM's c2 plus the mean squares' rounding: where that is larger, a window that seems to have no variance
    would else have the slope of a flat one, times what rounding makes of colours of thousands. The gradient ignores
    both.

    Args:
        colors, targets: [P, 3], 0 where the weight is 0.
        samples: the P slots. In a tile, each pixel at most once.
        groups: of these samples, with w.

    Returns:
        S and h, [P, 3] each.
    """
    places = _places(samples, groups.tile_of_slot)
    first_x, first_y = groups.spread(colors[groups.first_slots]), groups.spread(targets[groups.first_slots])  # [P, 3]
    x, y = colors - first_x, targets - first_y

    def windows(values: Tensor) -> Tensor:
        """[P, C] -> [P, C]: sums of w times the values under each sample's window."""
        return _sum_windows(groups.weights * values, places, groups.tiles)

    totals = windows(torch.ones_like(groups.weights))  # n
    inverse_totals = 1.0 / torch.where(totals > 0, totals, 1.0)
    moments = windows(torch.cat([x, y, x * x, y * y, x * y], dim=1)) * inverse_totals
    mean_x, mean_y, xx, yy, xy = moments.chunk(5, dim=1)
    variance_x = (xx - mean_x * mean_x).clamp(min=0.0)
    variance_y = (yy - mean_y * mean_y).clamp(min=0.0)
    largest = variance_x.sqrt() * variance_y.sqrt()
    covariance = torch.minimum(torch.maximum(xy - mean_x * mean_y, -largest), largest)

    steady = STRUCTURE_CONSTANT + torch.finfo(xx.dtype).eps * (xx + yy)  # c
    spread = variance_x + variance_y + steady
    structure = (2.0 * covariance + steady) / spread
    true_x, true_y = mean_x + first_x, mean_y + first_y
    level = true_x * true_x + true_y * true_y + LUMINANCE_CONSTANT
    luminance = (2.0 * true_x * true_y + LUMINANCE_CONSTANT) / level
    at_y = 2.0 * luminance / spread
    at_x = at_y * structure
    constant = structure * 2.0 * (true_y - luminance * true_x) / level
    terms = torch.cat([at_y, at_x, constant - at_y * mean_y + at_x * mean_x], dim=1) * inverse_totals
    sum_y, sum_x, rest = windows(terms).chunk(3, dim=1)
    return structure * luminance, sum_y * y - sum_x * x + rest


def _places(samples: PixelSamples, tile_of_slot: Tensor) -> Tensor:
    """[P] int64: the place of each slot among the pixels of all T tiles, row by row in a tile; in empty slots any."""
    inside = (samples.coordinates() + torch.tensor(samples.origin, device=samples.pixel_ids.device)) % TILE_SIZE
    return (tile_of_slot * TILE_SIZE + inside[:, 1]) * TILE_SIZE + inside[:, 0]


def _sum_windows(values: Tensor, places: Tensor, tiles: int) -> Tensor:
    """[P, C] -> [P, C]: for each slot the sum of its tile's values times g of their distance from it."""
    planes = values.new_zeros(tiles * TILE_SIZE**2, values.shape[1]).index_add_(0, places, values)
    planes = planes.view(tiles, TILE_SIZE, TILE_SIZE, values.shape[1])  # [T, S, S, C]
    along = torch.arange(TILE_SIZE, device=values.device, dtype=values.dtype)
    distances = (along[:, None] - along).abs()
    gaussian = torch.exp(-0.5 * (distances / WINDOW_SIGMA) ** 2) * (distances <= WINDOW_RADIUS)  # [S, S]
    sums = torch.einsum("ij,tjkc->tikc", gaussian, planes)
    sums = torch.einsum("ij,tkjc->tkic", gaussian, sums)
    return sums.reshape(tiles * TILE_SIZE**2, values.shape[1])[places]
