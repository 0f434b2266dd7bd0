"""Edges of the CUDA rasterizer: nothing to draw, streams, layouts, wrong input, and overflow with its retry."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.raster_cases import GPU_ONLY, make_case, on_gpu, on_side_stream, upstream

from turbogs_plugin.engine.cuda import library, workspace
from turbogs_plugin.engine.cuda import raster as cuda
from turbogs_plugin.engine.cuda.engine import CudaEngine
from turbogs_plugin.engine.cuda.workspace import Workspace
from turbogs_plugin.engine.layout import ScreenRecord
from turbogs_plugin.engine.reference.projection import SPAN_MAX
from turbogs_plugin.engine.reference.raster import rasterize_reference
from turbogs_plugin.engine.render_pass import RenderOptions
from turbogs_plugin.errors import InputError
from turbogs_plugin.types import PARAMETER_NAMES, Cameras

pytestmark = GPU_ONLY


@pytest.fixture
def case():
    return make_case([(70, 50), (33, 47)], count=200, rate=0.4, seed=11)


def render(case, workspace=None, **options):
    options = RenderOptions(**options)
    return cuda.rasterize_cuda(case.gpu_gaussians, case.gpu_cameras, case.gpu_samples, options, workspace)


@pytest.mark.parametrize("count", [0, 200])
def test_nothing_to_draw(case, count):
    """Gaussians out of sight, and none at all."""
    case.gpu_gaussians.means[:] = case.gpu_gaussians.means.new_tensor([0.0, 1e6, 0.0])
    case.gpu_gaussians = case.gpu_gaussians.map(lambda value: value[:count])
    rendered = render(case, with_depth=True)
    assert int(rendered.num_intersections) == 0
    assert (rendered.colors == 0).all() and (rendered.alphas == 0).all() and (rendered.depths == 0).all()
    records = rendered.backward(torch.ones_like(rendered.colors)).full_records()
    assert records.shape == (2, count, 16) and (records == 0).all()


@pytest.mark.parametrize("has_workspace", [False, True])
def test_no_samples(case, has_workspace):
    """Records are cleared though nothing is rendered."""
    memory = Workspace("cuda") if has_workspace else None
    none = {"pixel_ids": case.gpu_samples.pixel_ids[:0], "tile_ids": case.gpu_samples.tile_ids[:0]}
    case.gpu_samples = replace(case.gpu_samples, **none, tile_offsets=case.gpu_samples.tile_offsets[:1])
    if memory is not None:
        poison_records(memory, case)
    rendered = render(case, workspace=memory)
    assert rendered.colors.shape == (0, 3)
    assert (rendered.backward(rendered.colors).full_records() == 0).all()


SPAN = math.log(SPAN_MAX)
LIMITS = {
    "longest axis spans too much": ("scales", SPAN + 0.01, False),
    "longest axis spans enough": ("scales", SPAN - 0.01, True),
    "scale of 0": ("scales", -math.inf, False),
    "NaN mean": ("means", math.nan, False),
    "opaque without bound": ("opacities", math.inf, True),
    "opacity of 0": ("opacities", -math.inf, False),
    "NaN opacity": ("opacities", math.nan, False),
    "infinite quaternion": ("quats", -math.inf, False),
    "colour of NaN": ("sh0", math.nan, False),
    "last harmonic infinite": ("shN", math.inf, False),
}


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("limit", LIMITS)
def test_draws_what_the_reference_draws(case, limit, degree):
    """Gaussians on either side of every rule about which ones are drawn; here a pixel is one unit at depth 1."""
    name, value, drawn = LIMITS[limit]
    for gaussians, cameras in ((case.gpu_gaussians, case.gpu_cameras), (case.gaussians, case.cameras)):
        cameras.Ks[:, [0, 1], [0, 1]] = 1.0
        cameras.viewmats[:] = torch.eye(4, dtype=cameras.viewmats.dtype)
        gaussians.means[:] = torch.tensor([0.0, 0.0, 1.0], dtype=gaussians.means.dtype)
        gaussians.scales[:], gaussians.opacities[:] = -3.0, 1.0
        getattr(gaussians, name).view(len(gaussians), -1)[::3, -1] = value
    got = render(case, sh_degree=degree).projected().radii.cpu().any(dim=-1)
    wanted = rasterize_reference(case.gaussians, case.cameras, case.samples, RenderOptions(degree))
    assert torch.equal(got, wanted.projected().radii.any(dim=-1))
    assert (got[:, ::3] == drawn).all() and got[:, 1::3].all()


def test_side_stream(case):
    wanted = render(case).colors

    def delayed():
        return render(replace(case, gpu_gaussians=case.gpu_gaussians.map(lambda value: value + 0))).colors

    assert torch.equal(on_side_stream(delayed), wanted)


def test_not_contiguous(case):
    wanted = render(case).colors
    case.gpu_gaussians = case.gpu_gaussians.map(lambda value: torch.stack([value, value], dim=-1)[..., 0])
    assert not case.gpu_gaussians.means.is_contiguous()
    got = render(case)
    assert torch.equal(got.colors, wanted)
    gradients = torch.ones(3, len(case.samples), device="cuda").T
    records, wanted = (
        each.backward(of).full_records() for each, of in ((got, gradients), (render(case), gradients + 0))
    )
    torch.testing.assert_close(records, wanted, rtol=1e-4, atol=1e-4)


def test_not_aligned(case):
    """A slice of a model: rows of shN begin at any multiple of 4 bytes."""
    wanted = render(case).colors
    case.gpu_gaussians = case.gpu_gaussians.map(lambda value: torch.cat([value[:1], value])[1:])
    assert torch.equal(render(case).colors, wanted)


def test_cameras_are_read_where_they_lie(case):
    """Those selected from a capture are rows of its tensors, in the order of the batch: forward and backward."""
    own = case.gpu_cameras
    matrices = (torch.full((5, side, side), torch.nan, device="cuda") for side in (4, 3))
    capture = Cameras(*matrices, np.ones((5, 2), dtype=np.int64))
    for row, view in ((3, 0), (1, 1)):
        capture.viewmats[row], capture.Ks[row], capture.sizes[row] = own.viewmats[view], own.Ks[view], own.sizes[view]
    wanted = render(case)
    plain = wanted.backward(torch.ones_like(wanted.colors), with_statistics=True).plain()
    case.gpu_cameras = capture.select([3, 1])
    assert torch.equal(render(case).colors, wanted.colors)
    gradients = [
        CudaEngine().screen_gradients(case.gpu_gaussians, cameras, case.gpu_samples, RenderOptions(), plain)
        for cameras in (own, case.gpu_cameras)
    ]
    assert case.gpu_cameras.by_row()[0] is capture.viewmats
    for name, value in vars(gradients[0].parameter_gradients(rows=True)).items():
        assert torch.equal(getattr(gradients[1].parameter_gradients(rows=True), name), value), name
    launch = gradients[1].backward_arguments(None)
    for row in (-1, 5):
        images = [*launch.scene.images[:-1], row]
        gradients[1].scene = replace(launch.scene, images=images)
        with pytest.raises(RuntimeError, match=f"camera {row} of view 1 is not one of 5"):
            gradients[1].parameter_gradients(rows=True)


def test_wrong_input_says_what_was_wanted(case):
    good, long = case.gpu_gaussians, replace(case.gpu_samples, pixel_ids=case.gpu_samples.pixel_ids.long())
    fourth = replace(good, shN=good.shN.new_zeros(len(good), 24, 3))
    wrong = [
        (RuntimeError, "must be a contiguous Int", {"gpu_samples": case.samples}),
        (RuntimeError, "pixel_ids must be a contiguous Int", {"gpu_samples": long}),
        (RuntimeError, "shN must be a contiguous", {"gpu_gaussians": replace(good, shN=good.shN[:-1])}),
        (InputError, "image sizes", {"gpu_cameras": case.gpu_cameras.select([1, 0])}),
        (InputError, "of degree 4: the largest that is rendered is 3", {"gpu_gaussians": fourth}),
    ]
    for kind, message, change in wrong:
        with pytest.raises(kind, match=message):
            render(replace(case, **change))
    rendered = render(case)
    with pytest.raises(RuntimeError, match="color_gradients must be a contiguous"):
        rendered.backward(torch.zeros(3, 3, device="cuda"))
    with pytest.raises(RuntimeError, match="depth gradients without depths"):
        rendered.backward(torch.zeros_like(rendered.colors), depth_gradients=torch.zeros_like(rendered.alphas))
    with pytest.raises(RuntimeError, match="raster_forward needs colors"):
        library.launch(replace(rendered._forward, pixels=replace(rendered._forward.pixels, colors=None)))


def test_workspace_gives_the_same_and_does_not_wait(case):
    wanted = render(case)
    memory = Workspace("cuda")
    values = on_gpu(upstream(case))
    records = wanted.backward(**values).full_records()
    for number in range(20):
        if number:  # the first pass learns the count
            torch.cuda.set_sync_debug_mode("error")
        try:
            got = render(case, workspace=memory)
            got_records = got.backward(**values).full_records()
        finally:
            torch.cuda.set_sync_debug_mode("default")
        assert torch.equal(got.colors, wanted.colors)
        torch.testing.assert_close(got_records, records, rtol=1e-3, atol=1e-4)
    assert memory.take_lost(wait=True) == 0


def poison_records(memory, case):
    """What passes before may have left in the records."""
    shape = (len(case.gpu_cameras) * len(case.gpu_gaussians), ScreenRecord.SIZE)
    memory.buffer("records", shape, torch.float32).fill_(math.nan)


@pytest.mark.parametrize("rows", [True, False])
def test_what_is_off_screen_has_no_record(case, rows):
    """A pass clears the records of what it sees, once; what lies in the others reaches nothing."""
    case.gpu_gaussians.means[::3] += case.gpu_gaussians.means.new_tensor([0.0, 50.0, 0.0])
    values = on_gpu(upstream(case))
    plain, memory = render(case), Workspace("cuda")
    on_screen = (plain.projected().radii > 0).any(dim=-1)
    assert not on_screen[:, ::3].any() and on_screen.any()
    wanted = plain.backward(**values)
    poison_records(memory, case)
    rendered = render(case, workspace=memory)
    for _ in range(2):  # nothing is clear any more before the second
        screen = rendered.backward(**values)
        torch.testing.assert_close(screen.full_records(), wanted.full_records(), rtol=1e-3, atol=1e-4)
    poison_records(memory, case)
    screen = render(case, workspace=memory).backward(**values)
    assert screen.records[~on_screen].isnan().all() and screen.records[on_screen].isfinite().all()
    gradients, wanted_gradients = screen.parameter_gradients(rows), wanted.parameter_gradients(rows)
    assert torch.equal(gradients.touched, wanted_gradients.touched)
    for name in PARAMETER_NAMES:
        got = getattr(gradients, name)
        torch.testing.assert_close(got, getattr(wanted_gradients, name), rtol=1e-3, atol=1e-3, msg=name)


def test_overflow_is_noticed_and_passes_are_repeated(case, monkeypatch):
    """Too little room: nothing is drawn, the flag stays up for later passes, and the repetition is right."""
    monkeypatch.setattr(workspace, "CAPACITY_STEP", 32)
    wanted = render(case)
    memory = Workspace("cuda")
    render(case, workspace=memory)
    assert memory.take_lost(wait=True) == 0
    memory._intersections_per_tile *= 0.3
    lost = render(case, workspace=memory)
    assert (lost.colors == 0).all() and int(memory.overflow) == 1
    records = lost.backward(torch.ones_like(lost.colors)).full_records()
    assert (records == 0).all()
    assert memory.take_lost(wait=True) == 1
    assert int(memory.overflow) == 0 and memory.take_lost() == 0
    assert torch.equal(render(case, workspace=memory).colors, wanted.colors)


def test_a_pass_that_would_fit_stays_empty_while_the_flag_is_up(case):
    memory = Workspace("cuda")
    render(case, workspace=memory)
    memory.overflow.fill_(1)
    for _ in range(2):
        assert (render(case, workspace=memory).colors == 0).all()
        torch.cuda.synchronize()
        memory.poll()  # now the host knows
    assert memory.take_lost() == 2
    assert (render(case, workspace=memory).colors != 0).any()
