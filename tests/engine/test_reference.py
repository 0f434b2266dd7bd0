"""The reference rasterizer against gsplat's torch code, and its gradients against autograd and differences."""

import numpy as np
import pytest
import torch
from helpers.gsplat_torch import Drawn, gsplat_torch_render
from helpers.refusals import assert_refused
from helpers.rendering_scenes import dense_on_grid, make_cameras, make_gaussians, thin_out

from turbogs_plugin.engine.layout import ScreenRecord
from turbogs_plugin.engine.reference import compositing, projection
from turbogs_plugin.engine.render import dense_samples, rasterize
from turbogs_plugin.engine.render_pass import RasterSettings
from turbogs_plugin.types import PARAMETER_NAMES, GaussianStats, PixelSamples

SIZES = [(37, 29), (20, 50)]
ACTIVATED = {"opaque": 5.0, "as made": 0.0}


def upstream(samples: PixelSamples, dtype=torch.float64) -> dict[str, torch.Tensor]:
    """Arguments of a backward pass; made-up values in empty slots too."""
    generator, count = torch.Generator().manual_seed(0), len(samples)
    colors = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    alphas, depths = torch.randn(2, count, generator=generator, dtype=torch.float64)
    values = {"color_gradients": colors, "pixel_errors": colors.abs().sum(dim=1)}
    values |= {"alpha_gradients": alphas, "depth_gradients": depths}
    return {name: value.to(dtype) for name, value in values.items()}


def of_colors(samples: PixelSamples) -> tuple[torch.Tensor, torch.Tensor]:
    """Gradients of colours, and errors."""
    values = upstream(samples)
    return values["color_gradients"], values["pixel_errors"]


@pytest.mark.parametrize("opacity", ACTIVATED)
def test_sums_are_those_of_gsplats_torch_code(opacity, monkeypatch):
    """Both sides of every threshold occur; the slices are short so that several are needed."""
    monkeypatch.setattr(compositing, "SLICE_SPLATS", 7)
    gaussians, cameras = make_gaussians(40), make_cameras(SIZES)
    gaussians.opacities += ACTIVATED[opacity]
    samples = thin_out(dense_samples(cameras), 0.3, empty_slots=2)
    color_gradients, errors = of_colors(samples)
    errors = torch.where(samples.filled, errors, 0)
    drawn: list[Drawn] = []
    _, alphas, _ = gsplat_torch_render(gaussians, cameras, samples, drawn=drawn)
    if opacity == "opaque":
        assert (1 - alphas).min() < 0.1
    rendered = rasterize(gaussians, cameras, samples)
    record = rendered.backward(color_gradients, errors).full_records()
    for view, one in enumerate(drawn):
        factors = {ScreenRecord.ERROR_SUM: errors[one.slots][:, None], ScreenRecord.WEIGHT_SUM: 1.0}
        factors[ScreenRecord.DISTANCE_SUM] = (2 * one.sigmas).sqrt()
        for column, factor in factors.items():
            expected = torch.zeros(len(gaussians), dtype=torch.float64)
            expected[one.order] = (factor * one.weights).sum(dim=0)
            np.testing.assert_allclose(record[view, :, column], expected, atol=1e-11)


def test_pixels_end_before_the_splat_that_would_bring_them_to_the_limit():
    """Ten opaque splats in a row: 1e-3 is left after the first; the second would leave 1e-6, so it is not drawn."""
    gaussians, cameras = make_gaussians(10, degree=0), make_cameras([(1, 1)])
    cameras.Ks[:, :2, 2] = 0.5
    ray = cameras.directions[0]
    gaussians.means[:] = cameras.centers[0] + torch.arange(2.0, 12.0, dtype=torch.float64)[:, None] * ray
    gaussians.opacities[:] = 8.0  # sigmoid 0.9997
    rendered = rasterize(gaussians, cameras, dense_samples(cameras), with_depth=True)
    np.testing.assert_allclose(rendered.alphas, [0.999])
    np.testing.assert_allclose(rendered.depths, [2.0])
    gradients = rendered.backward(torch.ones_like(rendered.colors)).parameter_gradients(rows=False)
    assert gradients.touched.tolist() == [True] + [False] * 9
    assert float(gradients.opacities.abs().max()) == 0  # cut at alpha_max: no gradient


def test_projected_is_what_was_drawn():
    gaussians, cameras = make_gaussians(60, spread=3.0), make_cameras(SIZES)
    samples = dense_samples(cameras)
    projected = rasterize(gaussians, cameras, samples).projected()
    rows = projection.drawable_rows(gaussians, cameras, RasterSettings())
    splats = projection.project_rows(rows, rows.take(gaussians), cameras, 3, RasterSettings())
    shown = (projected.radii > 0).any(dim=-1)
    assert 0 < int(shown.sum()) < shown.numel()
    for name in ("means2d", "conics", "depths", "opacities"):
        assert torch.equal(getattr(projected, name)[shown], rows.scatter(getattr(splats, name))[shown])
        assert (getattr(projected, name)[~shown] == 0).all()
    assert torch.equal(projected.radii, rows.scatter(splats.radii))


def test_what_lies_behind_the_end_of_a_pixel_has_no_gradient_at_all():
    """In float32 too, where the sums of what is left behind are not exactly zero."""
    gaussians, cameras = make_gaussians(200, dtype=torch.float32, spread=0.3), make_cameras([(32, 32)], torch.float32)
    gaussians.opacities[:] = 5.0
    samples = dense_samples(cameras)
    rendered = rasterize(gaussians, cameras, samples, with_depth=True)
    gradients = rendered.backward(**upstream(samples, torch.float32)).parameter_gradients(rows=True)
    assert 10 < int(gradients.touched.sum()) < 190
    for name in PARAMETER_NAMES[:-1]:
        assert float(getattr(gradients, name)[:, ~gradients.touched].abs().max()) == 0


@pytest.mark.parametrize("opacity", ACTIVATED)
def test_values_and_gradients_are_those_of_gsplats_torch_code_and_rows_sum_to_them(opacity):
    """By autograd through gsplat's projection; depth is along the camera's axis, as there."""
    gaussians, cameras = make_gaussians(60), make_cameras(SIZES)
    gaussians.opacities += ACTIVATED[opacity]
    samples = thin_out(dense_samples(cameras), 0.4, empty_slots=3)
    values = upstream(samples)
    rendered = rasterize(gaussians, cameras, samples, with_depth=True)
    leaves = gaussians.map(lambda value: value.clone().requires_grad_())
    outputs = gsplat_torch_render(leaves, cameras, samples)
    for ours, theirs in zip((rendered.colors, rendered.alphas, rendered.depths), outputs, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-13)
    loss = (outputs[0] * values["color_gradients"]).sum(dim=1)
    loss = loss + outputs[1] * values["alpha_gradients"] + outputs[2] * values["depth_gradients"]
    loss[samples.filled].sum().backward()

    by_view = rendered.backward(**values).parameter_gradients(rows=True)
    total = rasterize(gaussians, cameras, samples).backward(**values).parameter_gradients(rows=False)
    for name in PARAMETER_NAMES:
        expected = getattr(leaves, name).grad
        scale = float(expected.abs().max())
        assert scale > 0
        torch.testing.assert_close(total.summed(name), expected, rtol=0, atol=1e-12 * scale)
        torch.testing.assert_close(by_view.summed(name), expected, rtol=0, atol=1e-12 * scale)
        if name != "shN":
            assert getattr(by_view, name).shape == (2, *expected.shape)
            assert getattr(total, name).shape == (1, *expected.shape)


def test_each_view_row_is_the_gradient_of_that_view_alone():
    gaussians, cameras = make_gaussians(30), make_cameras(SIZES)
    samples = dense_samples(cameras)
    colors, errors = of_colors(samples)
    rows = rasterize(gaussians, cameras, samples).backward(colors, errors).parameter_gradients(rows=True)
    for view in range(2):
        mine = samples.view_of_slot() == view
        alone = rasterize(gaussians, cameras.select([view]), dense_samples(cameras, [view]))
        expected = alone.backward(colors[mine], errors[mine]).parameter_gradients(rows=True)
        for name in PARAMETER_NAMES[:-1]:
            torch.testing.assert_close(getattr(rows, name)[view], getattr(expected, name)[0])


def test_absolute_gradients_and_squares_are_those_of_single_pixels():
    """One pixel at a time they are the gradient's absolute value, and the square of o * d loss / d o."""
    gaussians, cameras = make_gaussians(20), make_cameras([(6, 5)])
    samples = dense_samples(cameras)
    colors, errors = of_colors(samples)

    def record(color_gradients):
        screen = rasterize(gaussians, cameras, samples).backward(color_gradients, errors, with_statistics=True)
        return screen.full_records()[0]  # [N, 16]

    whole = record(colors)
    single = torch.stack([record(torch.where(torch.arange(30)[:, None] == slot, colors, 0)) for slot in range(30)])
    means, absolute = single[..., ScreenRecord.MEAN], whole[:, ScreenRecord.ABSOLUTE]
    torch.testing.assert_close(means.sum(dim=0), whole[:, ScreenRecord.MEAN])
    torch.testing.assert_close(means.abs().sum(dim=0), absolute)
    assert (absolute > whole[:, ScreenRecord.MEAN].abs() + 1e-6).any()
    squares = (torch.sigmoid(gaussians.opacities) * single[..., ScreenRecord.OPACITY]).square().sum(dim=0)
    assert squares.max() > 0
    torch.testing.assert_close(whole[:, ScreenRecord.SQUARE_SUM], squares)


def test_statistics_are_added_once_as_documented():
    gaussians, cameras = make_gaussians(30), make_cameras(SIZES)
    samples = thin_out(dense_samples(cameras), 0.5)
    colors, errors = of_colors(samples)
    stats = GaussianStats.zeros(30, "cpu").map(lambda value: value + 1)
    screen = rasterize(gaussians, cameras, samples).backward(colors, errors, with_statistics=True)
    gradients = screen.parameter_gradients(rows=True, stats=stats)
    record = screen.full_records()
    half = torch.as_tensor(np.array(SIZES)) * 0.5 * 2  # K = 2
    radii = rasterize(gaussians, cameras, samples).projected().radii
    shown = (radii > 0).all(dim=-1)
    expected = {
        "error_sums": record[..., ScreenRecord.ERROR_SUM].sum(dim=0),
        "distance_sums": record[..., ScreenRecord.DISTANCE_SUM].sum(dim=0),
        "weight_sums": record[..., ScreenRecord.WEIGHT_SUM].sum(dim=0),
        "grad_sums": (record[..., ScreenRecord.MEAN] * half[:, None]).norm(dim=-1).sum(dim=0),
        "absgrad_sums": (record[..., ScreenRecord.ABSOLUTE] * half[:, None]).norm(dim=-1).sum(dim=0),
        "square_sums": record[..., ScreenRecord.SQUARE_SUM].sum(dim=0),
        "view_counts": shown.double().sum(dim=0),
    }
    for name, value in expected.items():
        torch.testing.assert_close(getattr(stats, name).double(), 1 + value, rtol=1e-6, atol=1e-6, msg=name)
    largest = (radii.amax(dim=-1) / torch.tensor([[37.0], [50.0]])).amax(dim=0)
    torch.testing.assert_close(stats.max_radii, largest.clamp(min=1))
    assert torch.equal(gradients.touched, record[..., ScreenRecord.WEIGHT_SUM].sum(dim=0) > 0)


@pytest.mark.parametrize("origin", [(1, 0), (15, 15), (6, 11)])
def test_where_the_grid_of_tiles_begins_does_not_matter(origin):
    gaussians, cameras = make_gaussians(80), make_cameras(SIZES)
    by_grid = [dense_on_grid(cameras.sizes, place) for place in ((0, 0), origin)]
    assert len(by_grid[0]) == len(by_grid[1]) == cameras.sizes.prod(axis=1).sum()
    flat = [samples.flat_pixels(np.concatenate([[0], np.cumsum(samples.sizes.prod(axis=1))])) for samples in by_grid]
    values, found = of_colors(by_grid[0]), []
    for samples, pixels in zip(by_grid, flat, strict=True):
        colors, errors = (value[flat[0].argsort()][pixels] for value in values)
        rendered = rasterize(gaussians, cameras, samples, with_depth=True)
        gradients = rendered.backward(colors, errors).parameter_gradients(rows=False)
        images = [value[pixels.argsort()] for value in (rendered.colors, rendered.alphas, rendered.depths)]
        found.append([*images, *(gradients.summed(name) for name in PARAMETER_NAMES)])
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(other, one, rtol=1e-9, atol=1e-12)


def test_block_and_slice_sizes_do_not_matter(monkeypatch):
    gaussians, cameras = make_gaussians(60), make_cameras(SIZES)
    gaussians.opacities += 3
    samples = thin_out(dense_samples(cameras), 0.4)

    def everything():
        rendered = rasterize(gaussians, cameras, samples, with_depth=True)
        record = rendered.backward(**upstream(samples)).full_records()
        return rendered.colors, rendered.alphas, rendered.depths, record

    expected = everything()
    for block, piece in ((1, 1), (500, 3), (1 << 22, 1000)):
        monkeypatch.setitem(compositing.BLOCK_ELEMENTS, "cpu", block)
        monkeypatch.setattr(compositing, "SLICE_SPLATS", piece)
        for ours, theirs in zip(everything(), expected, strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_lower_degrees_use_their_bands_alone(degree):
    gaussians, cameras = make_gaussians(30), make_cameras([(20, 20)])
    samples = dense_samples(cameras)
    bands = (degree + 1) ** 2 - 1
    cut = gaussians.map(torch.clone)
    cut.shN[:, bands:] = 0
    rendered = rasterize(gaussians, cameras, samples, sh_degree=degree)
    torch.testing.assert_close(rendered.colors, rasterize(cut, cameras, samples).colors)
    gradients = rendered.backward(torch.ones_like(rendered.colors)).parameter_gradients(rows=False)
    assert gradients.shN.shape == gaussians.shN.shape
    assert (gradients.shN[:, bands:] == 0).all()


@pytest.mark.parametrize(
    ("held", "degree", "refusal"),
    [
        (1, -1, "degrees 0 to 1"),
        (1, 2, "degrees 0 to 1"),
        (4, None, "of degree 4: the largest that is rendered is 3"),
        (4, 3, "of degree 4: the largest that is rendered is 3"),
    ],
)
def test_a_degree_that_the_model_lacks_or_no_engine_evaluates_is_refused(held, degree, refusal):
    gaussians, cameras = make_gaussians(3, degree=held), make_cameras([(4, 4)])
    assert_refused(refusal, rasterize, gaussians, cameras, dense_samples(cameras), sh_degree=degree)


def test_negative_exponents_are_skipped():
    """A conic that rounding made indefinite draws nothing where its exponent is negative, as in gsplat."""
    centers = torch.tensor([[[1.0, 1.0], [1.0, -1.0], [0.0, 0.0]]], dtype=torch.float64)
    means, conic = torch.zeros(1, 2, dtype=torch.float64), torch.tensor([[1.0, 2.0, 1.0]], dtype=torch.float64)
    ones = torch.ones(1, dtype=torch.float64)
    table = torch.cat([means, conic, 0.5 * ones[:, None], ones.expand(1, 3), ones[:, None]], dim=1).T
    row = torch.zeros(1, 1, dtype=torch.int64)
    start = torch.ones(1, 3, 1, dtype=torch.float64)
    piece = compositing.composite_slice(table, row, row == 0, centers, start, RasterSettings())
    np.testing.assert_allclose(piece.weights[0, :, 0], [0.5 * np.exp(-3), 0, 0.5])


def test_settings_are_used():
    gaussians, cameras = make_gaussians(40), make_cameras([(24, 24)])
    samples = dense_samples(cameras)
    settings = RasterSettings(eps2d=1.0, near_plane=3.5, far_plane=5.0)
    expected, _, _ = gsplat_torch_render(gaussians, cameras, samples, settings=settings)
    rendered = rasterize(gaussians, cameras, samples, settings=settings)
    np.testing.assert_allclose(rendered.colors, expected, atol=1e-13)


@pytest.mark.parametrize(
    "values", [{"eps2d": -0.1}, {"eps2d": np.inf}, {"near_plane": np.nan}, {"transmittance_min": 1.0}], ids=str
)
def test_settings_out_of_bounds_are_refused(values):
    assert_refused(f"{list(values)[-1]} = ", RasterSettings, **values)


def test_other_cameras_and_gradients_that_are_wanted_are_refused_by_name():
    gaussians, cameras = make_gaussians(5), make_cameras([(20, 20)] * 3)
    samples = dense_samples(cameras, [0, 1])
    wanted = gaussians.map(lambda value: value.clone().requires_grad_())
    for model, wrong, words in (
        (gaussians, cameras, r"cameras are of views \[0, 1, 2\], samples of \[0, 1\]: give cameras.select"),
        (gaussians, cameras.select([1, 0]), r"cameras are of views \[1, 0\], samples of \[0, 1\]"),
        (wanted, cameras.select([0, 1]), "rasterize makes no graph"),
        (gaussians.map(torch.Tensor.float), cameras.select([0, 1]), "cameras are of torch.float64, Gaussians of torch"),
        (gaussians.map(lambda value: value[..., None]), cameras.select([0, 1]), r"means is \(5, 3, 1\) of torch"),
        (gaussians, make_cameras([(20, 18)] * 2), r"cameras have sizes \[\[20, 18\], .* samples \[\[20, 20\]"),
        (gaussians.map(torch.Tensor.half), cameras.select([0, 1]), "means are of torch.float16: give float32"),
    ):
        assert_refused(words, rasterize, model, wrong, samples)
    with torch.no_grad():
        rasterize(wanted, cameras.select([0, 1]), samples)
