"""Whether a model fits a capture's points, and by which change."""

import numpy as np
import pytest
import torch
from helpers.models import random_gaussians
from scipy.spatial.transform import Rotation

from turbogs_plugin.model.placement import nearest_change
from turbogs_plugin.model.similarity import Similarity
from turbogs_plugin.types import SH_C0

SAME = Similarity(np.eye(3), 1.0, np.zeros(3))


@pytest.mark.parametrize(
    ("turn", "scale", "cut", "count", "fits"),
    [
        (0.0, 1.0, False, 2000, True),
        (0.0, 1.0, True, 2000, True),  # only the Gaussians of an object
        (0.7, 0.3, False, 2000, False),
        (0.0, 0.3, False, 2000, False),
        (0.7, 0.3, False, 500, True),  # too few points tell nothing
    ],
)
def test_a_model_fits_where_it_lies_by_the_points(turn, scale, cut, count, fits):
    """Points of a surface whose colour goes with the place."""
    u, v = np.random.default_rng(0).uniform(-1, 1, size=(2, count))
    points = np.stack([u, v, 0.3 * np.sin(3 * u)], axis=1) + 5.0
    shades = np.stack([0.5 + 0.4 * u, 0.5 + 0.4 * v, 0.5 + 0 * u], axis=1)
    kept = np.hypot(u, v) < (0.3 if cut else 9)
    model = random_gaussians(int(kept.sum()), 0, dtype=torch.float64)
    change = Similarity(Rotation.from_euler("xyz", (turn, turn, 0)).as_matrix(), scale, np.full(3, 5 * (1 - scale)))
    model.means = torch.from_numpy(points[kept] + 0.01)
    model.sh0 = torch.from_numpy((shades[kept] - 0.5) / SH_C0)[:, None]
    moved = change.apply(model)
    assert nearest_change(moved, [SAME], points, (255 * shades).astype(np.uint8)) == (SAME, fits)
    assert nearest_change(moved, [SAME, change.inverse()], points, (255 * shades).astype(np.uint8))[1]
    assert nearest_change(moved.map(lambda value: value * torch.nan), [SAME], points, (255 * shades).astype(np.uint8))[
        1
    ]
