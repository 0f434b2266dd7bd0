"""Projection backward against the float64 reference, and the fused step against the unfused torch twins."""

from dataclasses import fields

import numpy as np
import pytest
import torch
from helpers.raster_cases import GPU_ONLY
from helpers.rendering_scenes import make_cameras, make_gaussians

from turbogs_plugin.distributed.peer_memory import aligned_starts
from turbogs_plugin.engine.cuda import launches
from turbogs_plugin.engine.cuda import training as training_kernels
from turbogs_plugin.engine.cuda.raster import CudaScreenGradients
from turbogs_plugin.engine.layout import MAX_VIEWS, ScreenRecord
from turbogs_plugin.engine.reference.projection import drawable_rows, project_rows
from turbogs_plugin.engine.reference.raster import ReferenceScreenGradients
from turbogs_plugin.engine.render_pass import DEFAULT_SETTINGS
from turbogs_plugin.engine.shared import ModelCopies
from turbogs_plugin.errors import InputError
from turbogs_plugin.strategies.learning_rates import LearningRates
from turbogs_plugin.strategies.optimizers.moment_lm import MomentLMOptimizer
from turbogs_plugin.strategies.optimizers.sparse_adam import SparseAdam
from turbogs_plugin.types import PARAMETER_NAMES, GaussianGradients, Gaussians, GaussianStats, PixelSamples, Step

pytestmark = GPU_ONLY

DEVICE = "cuda"
SIZES = [(48, 32), (33, 40), (64, 20)]
STEP = Step(iteration=100, total=5000, refine_until=3500, scene_extent=300.0)
RATES = LearningRates(scales=0.1, quats=0.05, opacities=0.2, sh0=0.1, shN=0.05)
"""Large, so that a step is not lost in the rounding of the parameters."""

OPTIMIZERS = {
    "adam": SparseAdam(RATES),
    "lm": MomentLMOptimizer(RATES),
    "unscaled lm": MomentLMOptimizer(RATES, scaled=False, eps=1e-8),
    "no momentum": MomentLMOptimizer(RATES, beta1=0.0, beta2=0.0),
}


class Scene:
    """A model, cameras and screen gradients of the right pattern: zero where a Gaussian is not drawn or not sampled."""

    def __init__(self, count=300, degree=3, used_degree=None, seed=0, size=1e-5, views=3):
        generator = torch.Generator().manual_seed(seed)
        self.gaussians = make_gaussians(count, seed=seed, degree=degree, dtype=torch.float32)
        self.gaussians.means[: count // 10] += 6 * torch.randn(count // 10, 3, generator=generator)  # off screen
        sizes = [SIZES[view % len(SIZES)] for view in range(views)]
        self.cameras = make_cameras(sizes, dtype=torch.float32)
        self.degree = degree if used_degree is None else used_degree
        self.samples = PixelSamples(
            tuple(range(views)),
            np.array(sizes),
            torch.tensor([0, 5, 9, -1], dtype=torch.int32),
            torch.tensor([0], dtype=torch.int32),
            torch.tensor([0, 4], dtype=torch.int32),
        )
        doubled = self.gaussians.map(lambda value: value.double())
        self.rows = drawable_rows(doubled, self.cameras.to(dtype=torch.float64), DEFAULT_SETTINGS)
        records = size * torch.randn(views, count, ScreenRecord.SIZE, generator=generator)
        sums = slice(ScreenRecord.ABSOLUTE.start, ScreenRecord.WEIGHT_SUM + 1)
        records[..., sums] = records[..., sums].abs()
        records[torch.rand(views, count, generator=generator) < 0.3] = 0
        records[:, count // 2 : count // 2 + 7] = 0  # never touched
        _, splats = self.project(doubled, torch.float64)
        self.radii = self.rows.scatter(splats.radii).to(torch.int32)  # [K, N, 2], 0 off screen
        self.records = (records * (self.radii > 0).any(dim=-1, keepdim=True)).float()

    def project(self, gaussians, dtype):
        leaves = self.rows.take(gaussians).map(lambda value: value.detach().requires_grad_())
        cameras = self.cameras.to(dtype=dtype)
        with torch.enable_grad():
            return leaves, project_rows(self.rows, leaves, cameras, self.degree, DEFAULT_SETTINGS)

    def reference(self):
        """The screen gradients of the reference in float64."""
        leaves, splats = self.project(self.gaussians.map(lambda value: value.double()), torch.float64)
        records = self.records.double().flatten(0, 1)[self.rows.flat]
        return ReferenceScreenGradients(self.rows, splats, leaves, records, self.samples)

    def screen(self, gaussians=None, overflow=None):
        """Those of the kernels; the records are copied, as a step may overwrite them. Off screen they hold anything."""
        gaussians = gaussians or self.on_device()
        on_screen = (self.radii > 0).any(dim=-1, keepdim=True)
        viewmats, Ks = self.cameras.viewmats.to(DEVICE), self.cameras.Ks.to(DEVICE)
        images = [number for row, size in enumerate(self.cameras.sizes.tolist()) for number in (*size, row)]
        return CudaScreenGradients(
            scene=launches.Scene(gaussians, viewmats, Ks, images, self.degree, DEFAULT_SETTINGS.eps2d),
            records=torch.where(on_screen, self.records, torch.nan).to(DEVICE, copy=True),
            radii=self.radii.to(DEVICE),
            overflow=overflow,
        )

    def on_device(self):
        return self.gaussians.map(lambda value: value.to(DEVICE, copy=True))


def one_step(optimizer, scene, gaussians=None):
    """The Gaussians after one fused step of an optimizer that begins."""
    gaussians = scene.on_device() if gaussians is None else gaussians
    optimizer.setup(gaussians)
    training_kernels.fused_step(optimizer.rule(STEP), scene.screen(gaussians), gaussians, optimizer.moments)
    return gaussians


def doubled(value):
    value = value.cpu()
    return value.double() if value.is_floating_point() else value


def assert_close_gradients(found, expected, name):
    found, expected = found.double().cpu().flatten(), expected.flatten()
    assert float((found - expected).norm()) <= 1e-4 * float(expected.norm()), name


@pytest.mark.parametrize(("degree", "used_degree"), [(3, 3), (3, 1), (2, 2), (1, 1), (0, 0)])
@pytest.mark.parametrize("rows", [True, False])
def test_gradients_are_the_reference_s(degree, used_degree, rows):
    scene = Scene(degree=degree, used_degree=used_degree)
    count = len(scene.gaussians)
    expected_stats, stats = GaussianStats.zeros(count, "cpu"), GaussianStats.zeros(count, DEVICE)
    expected = scene.reference().parameter_gradients(rows, expected_stats)
    found = scene.screen().parameter_gradients(rows, stats)
    for name in PARAMETER_NAMES:
        value, wanted = getattr(found, name), getattr(expected, name)
        assert value.shape == wanted.shape, name
        if wanted.numel():
            assert_close_gradients(value, wanted, name)
    assert torch.equal(found.touched.cpu(), expected.touched)
    assert 0 < int(expected.touched.sum()) < count
    for field in fields(GaussianStats):
        values, wanted = getattr(stats, field.name).cpu(), getattr(expected_stats, field.name)
        torch.testing.assert_close(values, wanted, rtol=2e-5, atol=1e-10, msg=lambda text, n=field.name: f"{n}: {text}")
    assert float(expected_stats.view_counts.sum()) > 0 and float(expected_stats.max_radii.max()) > 0


def twin_step(optimizer, gaussians, scene):
    """The torch twin's step in float64, from the kernels' own gradients."""
    gradients = scene.screen().parameter_gradients(optimizer.per_view)
    values = {field.name: doubled(getattr(gradients, field.name)) for field in fields(GaussianGradients)}
    optimizer.step(gaussians, GaussianGradients(**values), STEP)


@pytest.mark.parametrize("name", OPTIMIZERS)
@pytest.mark.parametrize("degree", [3, 2, 0])
def test_fused_step_is_the_twin_s(name, degree):
    check_fused_step(name, degree=degree)


@pytest.mark.parametrize(
    ("name", "views"), [("lm", 1), ("lm", 9), ("unscaled lm", 9), ("lm", 40), ("adam", 40), ("adam", 128), ("lm", 128)]
)
def test_fused_step_of_few_and_of_many_views(name, views):
    """More rows than a Gaussian has room for in shared memory, and more views than a mask has bits."""
    check_fused_step(name, views=views, count=70)


def check_fused_step(name, **case):
    optimizer, twin = OPTIMIZERS[name], OPTIMIZERS[name]
    before = Scene(**case).gaussians
    gaussians, expected = before.map(lambda v: v.to(DEVICE, copy=True)), before.map(doubled)
    optimizer.setup(gaussians)
    moments = optimizer.moments
    twin.setup(expected)
    expected_moments = twin.moments
    for iteration in range(3):
        scene = Scene(**case, seed=iteration)
        scene.gaussians = gaussians.map(lambda value: value.cpu())  # gradients at the kernels' own parameters
        twin.moments = expected_moments
        twin_step(twin, expected, scene)
        training_kernels.fused_step(optimizer.rule(STEP), scene.screen(gaussians), gaussians, moments)
        for field in fields(moments):
            found, wanted = doubled(getattr(moments, field.name)), doubled(getattr(expected_moments, field.name))
            # The rows of the views may cancel in their sum: entries far below the largest carry its rounding.
            bound = 1e-6 * float(wanted.abs().max()) if wanted.numel() else 0.0
            torch.testing.assert_close(found, wanted, rtol=1e-5, atol=bound, msg=lambda t, n=field.name: f"{n}: {t}")
    assert int(expected_moments.steps.max()) == 3 and int(expected_moments.steps.min()) < 3
    for parameter, value in before.items():
        if value.numel() == 0:
            continue
        start, end = value.double(), getattr(gaussians, parameter).double().cpu()
        wanted = getattr(expected, parameter)
        assert float((wanted - start).norm()) > 0
        assert float((end - wanted).norm()) <= 1e-5 * float((wanted - start).norm()), parameter
    untouched = expected_moments.steps == 0
    assert untouched.any()
    for parameter, value in before.items():
        assert torch.equal(getattr(gaussians, parameter).cpu()[untouched], value[untouched]), parameter


@pytest.mark.parametrize("degree", [3, 2, 0])
def test_a_step_changes_copies_alike(degree):
    """Rows of a model in one memory, and the same rows of models in others; what no step changes stays there."""
    scene, optimizer = Scene(degree=degree), MomentLMOptimizer(RATES)
    starts = aligned_starts([value.numel() for _, value in scene.gaussians.items()])
    memories = torch.full((4, starts[-1]), torch.nan, device=DEVICE)

    def placed(memory):
        values = zip(scene.gaussians.items(), starts, strict=False)
        return Gaussians(**{name: memory[at:][: value.numel()].view(value.shape) for (name, value), at in values})

    own, *others = map(placed, memories)
    for name, value in own.items():
        value.copy_(getattr(scene.gaussians, name))
    plain = own.map(torch.clone)
    for gaussians, copies in ((plain, None), (own, ModelCopies(own, others))):
        optimizer.setup(gaussians)
        screen = scene.screen(gaussians)
        training_kernels.fused_step(optimizer.rule(STEP), screen, gaussians, optimizer.moments, copies=copies)
    stepped = optimizer.moments.steps > 0
    assert stepped.any() and not stepped.all()
    for name, value in plain.items():
        assert torch.equal(getattr(own, name), value), name
        for other in others:
            copy = getattr(other, name)
            assert torch.equal(copy[stepped], value[stepped]) and bool(copy[~stepped].isnan().all()), name
    with pytest.raises(InputError, match="must lie as the model does"):
        _ = ModelCopies(own, [others[0].map(torch.clone)]).distances


def test_long_rows_are_cut():
    """Gradients of 1e8: scaled rows of about 1e4 lose the damping beside them without their limit."""
    scene, optimizer = Scene(size=1e3), OPTIMIZERS["lm"]
    expected = scene.gaussians.map(doubled)
    optimizer.setup(expected)
    twin_step(optimizer, expected, scene)
    gaussians = one_step(optimizer, scene)
    for parameter in ("means", "scales", "quats", "sh0", "opacities"):
        start, end = getattr(scene.gaussians, parameter).double(), getattr(gaussians, parameter).double().cpu()
        wanted = getattr(expected, parameter)
        assert torch.isfinite(end).all(), parameter
        # At the limit the condition number is about 1e4, and so is the loss of precision.
        assert float((end - wanted).norm()) <= 2e-3 * float((wanted - start).norm()), parameter


@pytest.mark.parametrize("name", ["adam", "lm"])
@pytest.mark.parametrize("entry", [0, 3, 5, 8])
def test_bad_gradient_is_skipped_and_neighbours_step(name, entry):
    optimizer, bad = OPTIMIZERS[name], 17
    scene = Scene()
    scene.records[:, bad] = 1e-5
    results = []
    for value in (1e-5, float("nan")):
        scene.records[1, bad, entry] = value
        results.append((one_step(optimizer, scene), optimizer.moments))
    (clean, clean_moments), (found, moments) = results
    assert int(clean_moments.skipped) == 0 and int(moments.skipped) == 1
    assert int(moments.steps[bad]) == 0
    others = torch.arange(len(scene.gaussians)) != bad
    for parameter, value in found.items():
        assert torch.equal(value.cpu()[others], getattr(clean, parameter).cpu()[others]), parameter
        assert torch.equal(value.cpu()[bad], getattr(scene.gaussians, parameter)[bad]), parameter
    for field in fields(moments):
        if field.name != "skipped":
            assert not getattr(moments, field.name)[bad].any(), field.name


def test_overflow_changes_nothing():
    scene = Scene(count=50)
    gaussians, optimizer = scene.on_device(), OPTIMIZERS["lm"]
    optimizer.setup(gaussians)
    stats = GaussianStats.zeros(50, DEVICE)
    overflow = torch.ones(1, dtype=torch.int32, device=DEVICE)
    screen = scene.screen(gaussians, overflow=overflow)
    training_kernels.fused_step(optimizer.rule(STEP), screen, gaussians, optimizer.moments, stats)
    for parameter, value in gaussians.items():
        assert torch.equal(value.cpu(), getattr(scene.gaussians, parameter)), parameter
    assert not optimizer.moments.steps.any() and not stats.view_counts.any()
    gradients = scene.screen(overflow=overflow).parameter_gradients(True)
    assert not gradients.means.any() and not gradients.touched.any()


@pytest.mark.parametrize("count", [0, 1, 129])
def test_any_number_of_gaussians(count):
    scene = Scene(count=300)
    keep = slice(20, 20 + count)
    scene.gaussians = scene.gaussians.map(lambda value: value[keep].contiguous())
    scene.records = scene.records[:, keep].contiguous()
    scene.radii = scene.radii[:, keep].contiguous()
    optimizer = OPTIMIZERS["lm"]
    one_step(optimizer, scene)
    touched = (scene.records[..., ScreenRecord.WEIGHT_SUM] > 0).any(dim=0)
    assert torch.equal(optimizer.moments.steps.cpu().bool(), touched)
    assert len(scene.screen().parameter_gradients(True).touched) == count


def test_wrong_tensors_are_named():
    scene = Scene(count=20)
    gaussians: Gaussians = scene.on_device()
    optimizer = OPTIMIZERS["lm"]
    optimizer.setup(gaussians)
    optimizer.moments.exp_avg = optimizer.moments.exp_avg[:, :13]
    with pytest.raises(RuntimeError, match="exp_avg must be a contiguous"):
        training_kernels.fused_step(optimizer.rule(STEP), scene.screen(gaussians), gaussians, optimizer.moments)
    with pytest.raises(ValueError, match="not the Gaussians"):
        training_kernels.fused_step(optimizer.rule(STEP), scene.screen(), gaussians, optimizer.moments)
    with pytest.raises(RuntimeError, match=f"a batch has 1 .. {MAX_VIEWS} views"):
        one_step(optimizer, Scene(count=20, views=MAX_VIEWS + 1))
