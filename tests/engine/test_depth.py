"""The depth term: what depths a capture knows, the loss against autograd, and depths that nothing is learnt from."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.framework_runs import tiny_trainer
from helpers.rendering_scenes import make_cameras, make_gaussians

from turbogs_plugin.engine import ReferenceEngine
from turbogs_plugin.engine.reference.losses import depth_loss
from turbogs_plugin.engine.render import dense_samples
from turbogs_plugin.engine.render_pass import RenderOptions
from turbogs_plugin.engine.rules import LossTerms
from turbogs_plugin.errors import InputError
from turbogs_plugin.scene.depths import CELL, DepthPair, InverseDepths
from turbogs_plugin.strategies.losses import EPSILON, CharbonnierLoss, CharbonnierNccLoss, SparseSsimLoss
from turbogs_plugin.types import PARAMETER_NAMES
from turbogs_plugin.types.cameras import Observations

TERMS = LossTerms(EPSILON, depth_weight=0.7)
CAMERAS = make_cameras([(21, 18), (33, 16)])
DEPTHS = [0.0, 1e-30, 0.01, 2.0, 1e30, math.inf, -1.0, math.nan]


def cells_of(values: torch.Tensor | None = None) -> InverseDepths:
    """Cells of `CAMERAS`: random ones, a third of them known, or these values over and over."""
    counts = (-(-CAMERAS.sizes // CELL)).prod(axis=1)
    cells = torch.rand(counts.sum(), generator=torch.Generator().manual_seed(1)) - 0.4
    cells = cells.clamp(min=0) if values is None else values.float().repeat(len(cells))[: len(cells)]
    return InverseDepths(cells, torch.tensor([0, counts[0]]), float((cells > 0).float().mean().clamp(min=1e-3)))


def test_gradients_of_every_parameter_are_those_of_autograd():
    """In float64; the term by itself, written out. Some samples see nothing, as the Gaussians are few."""
    samples, known, gaussians = dense_samples(CAMERAS), cells_of(), make_gaussians(12, spread=0.4)
    samples = replace(
        samples, pixel_ids=samples.pixel_ids.clone(), weights=0.5 + cells_of().cells.repeat(20)[: len(samples)]
    )
    samples.pixel_ids[[3, 400]] = -1
    engine, options = ReferenceEngine(), RenderOptions(with_depth=True)
    rendered = engine.render(gaussians, CAMERAS, samples, options)
    blank = torch.zeros(len(samples), 3, dtype=torch.float64)
    output = engine.evaluate(TERMS, blank, blank, samples, DepthPair(rendered.depths, known))

    depths, x, y = rendered.depths.clone().requires_grad_(), *samples.coordinates().unbind(dim=1)
    second = samples.view_of_slot() == 1
    places = torch.where(second, known.starts[1] + (y // CELL) * 9 + x // CELL, (y // CELL) * 6 + x // CELL)
    truth = known.cells[places].double()
    used = samples.filled & (truth > 0) & (depths > 0)
    assert 0.2 < used.double().mean() < 0.9 and (samples.filled & (depths == 0)).any()
    away = 1 / depths[used] - truth[used]
    expected = 0.7 * (samples.weights[used] * ((away**2 + EPSILON**2).sqrt() - EPSILON)).sum()
    expected = expected / known.share / samples.filled.sum()
    expected.backward()
    torch.testing.assert_close(output.loss, expected.detach())
    torch.testing.assert_close(output.depth_gradients, depths.grad)

    screen = rendered.backward(output.color_gradients, depth_gradients=output.depth_gradients)
    found = screen.parameter_gradients(rows=False)
    for name in PARAMETER_NAMES:
        direction = torch.randn(getattr(gaussians, name).shape, generator=torch.Generator().manual_seed(3)).double()
        sides = []
        for step in (1e-5, -1e-5):
            moved = replace(gaussians, **{name: getattr(gaussians, name) + step * direction})
            again = engine.render(moved, CAMERAS, samples, options).depths
            sides.append(depth_loss(TERMS, DepthPair(again, known), samples)[0])
        slope = (getattr(found, name).reshape(direction.shape) * direction).sum()
        torch.testing.assert_close(slope, (sides[0] - sides[1]) / 2e-5, rtol=2e-3, atol=1e-7)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("truth", [0.0, 1e-30, 0.3, 1e3, 1e30, math.inf, math.nan])
def test_no_depth_makes_a_gradient_that_is_not_finite(truth, dtype):
    """Nothing is learnt where either depth is none: not positive, not finite, or nearer than any near plane."""
    samples, known = dense_samples(CAMERAS), cells_of(torch.tensor([truth]))
    depths = torch.tensor(DEPTHS, dtype=dtype).repeat(len(samples))[: len(samples)]
    loss, gradients = depth_loss(TERMS, DepthPair(depths, known), samples)
    assert loss.isfinite() and gradients.isfinite().all()
    assert bool(gradients[depths == 2.0].any()) == (0 < truth <= 1e3)
    for depth in (0.0, 1e-30, -1.0):
        assert not gradients[depths == depth].any()


def test_one_known_cell_pulls_its_samples_alone():
    samples, known = dense_samples(CAMERAS), cells_of(torch.zeros(1))
    known.cells[0] = 0.25
    _, gradients = depth_loss(TERMS, DepthPair(torch.full((len(samples),), 2.0), known), samples)
    inside = (samples.coordinates() < CELL).all(dim=1) & (samples.view_of_slot() == 0)
    assert torch.equal(gradients != 0, inside) and (gradients[inside] < 0).all(), "too near: the loss falls with depth"


def test_points_tell_the_depth_where_photos_show_them():
    """The nearest of two in a cell; neither a point that another place shows, nor one behind the camera."""
    cameras = make_cameras([(40, 30)] * 2)
    points = torch.tensor([[0, 0, 0], [0, 0, 2.0], [0.5, 0, 0], [0, 0, -50.0]])
    seen = points.double() @ cameras.viewmats[:, :3, :3].mT + cameras.viewmats[:, None, :3, 3]  # [2, 4, 3]
    pixels = seen @ cameras.Ks.mT
    pixels = (pixels[..., :2] / pixels[..., 2:]).numpy()
    shown = Observations(
        np.array([pixels[0, 0], pixels[0, 0], pixels[1, 2], pixels[1, 0] + 3, pixels[1, 3]]),
        np.array([0, 0, 1, 1, 1]),
        np.array([0, 0, 2, 0, 3]),
    )
    known = InverseDepths.of(cameras, shown, points)
    expected = torch.zeros(2, 8, 10)
    for view, point in ((0, 0), (1, 2)):
        x, y = (pixels[view, point] // CELL).astype(int)
        expected[view, y, x] = 1 / seen[view, point, 2]
    torch.testing.assert_close(known.cells.view(2, 8, 10), expected)
    assert known.share == 2 * CELL**2 / 2400
    nearer = replace(shown, point_ids=np.array([1, 0, 2, 0, 3]), pixels=shown.pixels.copy())
    both = cameras.select((0, 0))
    both.viewmats[:] = torch.eye(4)
    both.viewmats[:, 2, 3] = 4.0
    nearer.pixels[:2] = both.Ks[0, :2, 2]
    assert float(InverseDepths.of(both, nearer, points).cells.max()) == 0.25, "the farther point is 6 away"
    for none in (None, Observations(np.zeros((0, 2)), np.zeros(0, int), np.zeros(0, int))):
        with pytest.raises(InputError, match=r"^loss\.depth_weight: this capture does not say where photos show"):
            InverseDepths.of(cameras, none, points)


@pytest.mark.parametrize("loss", [CharbonnierLoss, CharbonnierNccLoss, SparseSsimLoss])
def test_every_loss_owns_the_weight(loss):
    assert loss().terms.depth_weight == 0 and loss(depth_weight=0.3).terms.depth_weight == 0.3
    with pytest.raises(InputError, match="depth_weight"):
        loss(depth_weight=-1.0)


def test_training_with_the_term_brings_depths_nearer(scene):
    """Against the same steps without it, at the pixels of the capture's points."""
    errors = []
    known = InverseDepths.of(scene.train.cameras, scene.train.observations, scene.points)
    for weight in (0.0, 1.0):
        trainer = tiny_trainer(scene, f"loss.depth_weight={weight}", "train.dropout=0")
        for _ in range(10):
            trainer.step()
        samples = dense_samples(trainer.views.cameras)
        found = trainer.engine.render(trainer.gaussians, trainer.views.cameras, samples, RenderOptions(with_depth=True))
        errors.append(float(depth_loss(TERMS, DepthPair(found.depths, known), samples)[0]))
    assert errors[1] < 0.9 * errors[0]
