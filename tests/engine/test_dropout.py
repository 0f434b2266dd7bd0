"""Gaussians that a pass leaves out: which, and that the rest is drawn and learns as if they were not there."""

import pytest
import torch
from helpers.rendering_scenes import make_cameras, make_gaussians

from turbogs_plugin.engine import ReferenceEngine
from turbogs_plugin.engine.reference.raster import kept
from turbogs_plugin.engine.render import dense_samples
from turbogs_plugin.engine.render_pass import RenderOptions
from turbogs_plugin.engine.rules import NO_DROPOUT, Dropout
from turbogs_plugin.types import GaussianStats

CPU = torch.device("cpu")
COUNT = 60
HALF = Dropout(0.5, seed=3, iteration=7)


@pytest.mark.parametrize("share", [0.01, 0.2, 0.9])
def test_each_gaussian_has_the_same_chance(share):
    count = 40_000
    left = [(~kept(Dropout(share, seed, at), count, CPU)).double() for seed, at in ((0, 1), (0, 2), (1, 1))]
    deviation = (share * (1 - share) / count) ** 0.5
    assert all(abs(each.mean() - share) < 5 * deviation for each in left)
    for other in left[1:]:  # drawn anew for another iteration or seed
        assert abs((left[0] * other).mean() - share**2) < 5 * deviation


@pytest.fixture(scope="module")
def scene():
    cameras = make_cameras([(40, 33), (21, 48)])
    return make_gaussians(COUNT), cameras, dense_samples(cameras, [0, 1])


def learnt(scene, dropout: Dropout, rows: torch.Tensor | None = None):
    """A pass with gradients and statistics, of these rows of the model alone."""
    gaussians, cameras, samples = scene
    if rows is not None:
        gaussians = gaussians.map(lambda value: value[rows])
    rendered = ReferenceEngine().render(gaussians, cameras, samples, RenderOptions(dropout=dropout))
    upstream = torch.linspace(-1, 1, rendered.colors.numel(), dtype=rendered.colors.dtype).view_as(rendered.colors)
    screen = rendered.backward(upstream, upstream.abs().sum(dim=1), with_statistics=True)
    stats = GaussianStats.zeros(len(gaussians), CPU)
    return rendered, screen, screen.parameter_gradients(True, stats), stats


def test_what_is_left_out_is_not_there(scene):
    rows = kept(HALF, COUNT, CPU).nonzero()[:, 0]
    assert 10 < len(rows) < 50
    got, screen, gradients, stats = learnt(scene, HALF)
    wanted, fewer, wanted_gradients, wanted_stats = learnt(scene, NO_DROPOUT, rows)
    assert torch.equal(got.colors, wanted.colors)
    out = torch.ones(COUNT, dtype=torch.bool).index_fill(0, rows, False)
    assert not got.projected().radii[:, out].any() and not screen.full_records()[:, out].any()
    assert not gradients.touched[out].any() and not gradients.means[:, out].any() and not gradients.shN[out].any()
    assert torch.equal(gradients.touched[rows], wanted_gradients.touched) and wanted_gradients.touched.any()
    torch.testing.assert_close(screen.full_records()[:, rows], fewer.full_records())
    torch.testing.assert_close(gradients.means[:, rows], wanted_gradients.means)
    for name, value in vars(stats).items():
        assert not value[out].any()
        torch.testing.assert_close(value[rows], getattr(wanted_stats, name))


def test_another_process_makes_the_same_gradients_of_some_rows(scene):
    """It is given the records of rows 16 .. 48, and must not draw again who is left out."""
    gaussians, cameras, samples = scene
    _, screen, whole, _ = learnt(scene, HALF)
    plain, part = screen.plain(), slice(16, 48)
    mine = type(plain)(plain.records[:, part], plain.radii[:, part])
    rows, options = gaussians.map(lambda value: value[part]), RenderOptions(dropout=HALF)
    screen = ReferenceEngine().screen_gradients(rows, cameras, samples, options, mine)
    gradients = screen.parameter_gradients(True, GaussianStats.zeros(32, CPU))
    assert torch.equal(gradients.touched, whole.touched[part]) and whole.touched[part].any()
    torch.testing.assert_close(gradients.means, whole.means[:, part])
    torch.testing.assert_close(gradients.opacities, whole.opacities[:, part])
