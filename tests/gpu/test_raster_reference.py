"""The CUDA rasterizer against the reference in float64: forward, screen records, parameter gradients."""

import pytest
import torch
from helpers.raster_cases import (
    GPU_ONLY,
    RECORD_COLUMNS,
    assert_forward_close,
    assert_gradients_close,
    assert_records_close,
    make_case,
    on_gpu,
    upstream,
)

from turbogs_plugin.engine.cuda import raster as cuda
from turbogs_plugin.engine.reference.raster import kept, rasterize_reference
from turbogs_plugin.engine.render_pass import RenderOptions
from turbogs_plugin.engine.rules import NO_DROPOUT, Dropout
from turbogs_plugin.types import GaussianStats

pytestmark = GPU_ONLY

CASES = {
    "one view dense": dict(sizes=[(96, 64)], count=300, seed=1),
    "three views dense": dict(sizes=[(70, 50), (33, 47), (16, 16)], count=200, seed=2),
    "rate 0.33": dict(sizes=[(130, 90)], count=400, rate=0.33, seed=3),
    "with empty slots": dict(sizes=[(130, 90), (65, 97), (48, 48)], count=300, rate=0.1, seed=4, empty_slots=3),
    "another grid": dict(sizes=[(130, 90), (33, 47), (16, 16)], count=400, seed=9, origin=(5, 14)),
    "rate 0.33 of another grid": dict(sizes=[(130, 90)], count=400, rate=0.33, seed=3, origin=(15, 1), empty_slots=2),
    "large splats of another grid": dict(sizes=[(200, 140)], count=60, rate=0.5, seed=5, log_scale=1.2, origin=(8, 8)),
    "small splats": dict(sizes=[(160, 120), (90, 90)], count=3000, rate=0.2, seed=6, log_scale=-2.0),
    "deep": dict(sizes=[(48, 48)], count=4000, rate=0.4, seed=7, log_scale=-0.5),
    "one sample a tile": dict(sizes=[(100, 100)], count=200, rate=0.001, seed=8),
}


@pytest.fixture(params=CASES.values(), ids=CASES.keys())
def case(request):
    return make_case(**request.param)


@pytest.fixture(params=[False, True], ids=["color", "depth"])
def with_depth(request):
    return request.param


def render_both(case, with_depth=False, dropout=NO_DROPOUT):
    options = RenderOptions(with_depth=with_depth, dropout=dropout)
    got = cuda.rasterize_cuda(case.gpu_gaussians, case.gpu_cameras, case.gpu_samples, options)
    return got, rasterize_reference(case.gaussians, case.cameras, case.samples, options)


def test_forward(case, with_depth):
    got, wanted = render_both(case, with_depth)
    assert_forward_close(got.colors, wanted.colors, "colors")
    assert_forward_close(got.alphas, wanted.alphas, "alphas")
    if with_depth:
        assert_forward_close(got.depths, wanted.depths, "depths")
    empty = ~case.samples.filled
    assert (got.colors.cpu()[empty] == 0).all() and (got.alphas.cpu()[empty] == 0).all()


def test_projection(case):
    got, wanted = (rendered.projected() for rendered in render_both(case))
    assert (got.radii.cpu() != wanted.radii).double().mean() <= 1e-3  # a rounding to the next pixel
    both = (got.radii.cpu() > 0).any(-1) & (wanted.radii > 0).any(-1)
    for name in ("means2d", "conics", "depths", "opacities"):
        found, expected = getattr(got, name).cpu().double()[both], getattr(wanted, name)[both]
        torch.testing.assert_close(found, expected, rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize("dropout", [Dropout(0.3, 5, 11), Dropout(0.6, 2**31 - 1, 29_999)])
def test_the_same_gaussians_are_left_out(case, dropout):
    got, wanted = render_both(case, dropout=dropout)
    assert_forward_close(got.colors, wanted.colors, "colors")
    stay = kept(dropout, len(case.gaussians), case.gaussians.device)
    shown, wanted_shown = ((each.projected().radii.cpu() > 0).any(-1) for each in (got, wanted))
    assert not shown[:, ~stay].any() and not wanted_shown[:, ~stay].any()
    assert (shown != wanted_shown).double().mean() <= 1e-3  # a rounding to the next pixel
    given = {name: value for name, value in upstream(case).items() if name != "alpha_gradients"}
    records = got.backward(**on_gpu(given), with_statistics=True).full_records()
    assert not records.cpu()[:, ~stay].any()
    expected = wanted.backward(**given).full_records()
    assert_records_close(records, expected)


def test_screen_records(case, with_depth):
    got, wanted = render_both(case, with_depth)
    values = upstream(case, with_depth)
    records = got.backward(**on_gpu(values), with_statistics=True).full_records()
    wanted_records = wanted.backward(**values).full_records()
    assert_records_close(records, wanted_records)


def test_parameter_gradients(case):
    got, wanted = render_both(case)
    values = upstream(case)
    stats = GaussianStats.zeros(len(case.gaussians), "cuda")
    wanted_stats = GaussianStats.zeros(len(case.gaussians), "cpu").map(torch.Tensor.double)
    gradients = got.backward(**on_gpu(values), with_statistics=True).parameter_gradients(True, stats)
    wanted_gradients = wanted.backward(**values, with_statistics=True).parameter_gradients(True, wanted_stats)
    for name, _ in case.gaussians.items():
        ours, theirs = getattr(gradients, name), getattr(wanted_gradients, name)
        assert_gradients_close(ours.reshape(*theirs.shape[:2], -1), theirs.reshape(*theirs.shape[:2], -1), name)
    assert (gradients.touched.cpu() != wanted_gradients.touched).double().mean() <= 1e-2
    for name in ("error_sums", "distance_sums", "weight_sums", "grad_sums", "absgrad_sums", "square_sums"):
        assert_gradients_close(getattr(stats, name)[:, None], getattr(wanted_stats, name)[:, None], name)


@pytest.mark.parametrize("warps", [1, 2, 3, 5, 8])
def test_every_division_of_the_work_gives_the_same(warps, monkeypatch):
    case = make_case([(70, 50), (33, 47)], count=250, rate=0.6, seed=9)
    _, wanted = render_both(case)
    values = upstream(case)
    monkeypatch.setattr(cuda, "warps_per_tile", lambda slots, tiles: warps)
    got = cuda.rasterize_cuda(case.gpu_gaussians, case.gpu_cameras, case.gpu_samples)
    assert_forward_close(got.colors, wanted.colors, "colors")
    wanted_records = wanted.backward(**values).full_records()
    given = on_gpu(values)
    passes = (  # upstream and options, the sums that are zero
        (given | {"with_statistics": True}, ()),
        (given, ("absolute", "distance_sum", "square_sum")),
        (given | {"with_statistics": True, "pixel_errors": None}, ("error_sum", "distance_sum")),
    )
    for arguments, zero in passes:
        records = got.backward(**arguments).full_records()
        for name, column in RECORD_COLUMNS.items():
            if name in zero:
                assert (records[..., column] == 0).all()
            else:
                assert_gradients_close(records[..., column], wanted_records[..., column], f"{name}, zero: {zero}")
