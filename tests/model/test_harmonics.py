"""Bands of spherical harmonics that an export leaves out."""

from pathlib import Path

import pytest
import torch
from helpers.framework_runs import tiny_capture, tiny_config

from turbogs_plugin.engine.reference.spherical_harmonics import evaluate
from turbogs_plugin.errors import InputError
from turbogs_plugin.model.harmonics import band_energy, drop_faint_bands
from turbogs_plugin.model.ply import load_ply
from turbogs_plugin.train import run
from turbogs_plugin.types import Gaussians


def model(*rms: float, count: int = 30, seed: int = 0) -> Gaussians:
    """Gaussians of various colours and opacities; coefficients of degree 1, 2, ... have these root mean squares."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    bands = [scale * normal(count, 2 * degree + 1, 3) for degree, scale in enumerate(rms, start=1)]
    return Gaussians(
        means=normal(count, 3),
        quats=normal(count, 4),
        scales=normal(count, 3) - 3.0,
        opacities=3.0 * normal(count),
        sh0=normal(count, 1, 3),
        shN=torch.cat([torch.zeros(count, 0, 3), *bands], dim=1),
    )


def test_energy_is_that_of_colours_over_all_directions():
    """Against a mean over directions of the evaluated colours, degree by degree."""
    gaussians = model(0.5, 0.3, 0.2)
    count = 20_000  # a Fibonacci lattice
    height = 1.0 - 2.0 * (torch.arange(count, dtype=torch.float64) + 0.5) / count
    angle = torch.arange(count, dtype=torch.float64) * torch.pi * (1.0 + 5.0**0.5)
    ring = (1.0 - height * height).sqrt()
    directions = torch.stack([ring * angle.cos(), ring * angle.sin(), height], dim=1)
    expected = torch.zeros(4, dtype=torch.float64)
    for row in range(len(gaussians)):
        opacity = gaussians.opacities[row].double().sigmoid()
        sh0, shN = (value[row : row + 1].double().expand(count, -1, -1) for value in (gaussians.sh0, gaussians.shN))
        before = torch.zeros(count, 3, dtype=torch.float64)
        for degree in range(4):
            colors = evaluate(sh0, shN, directions, degree) + 0.5
            expected[degree] += opacity * (colors - before).square().mean()
            before = colors
    torch.testing.assert_close(
        torch.tensor(band_energy(gaussians), dtype=torch.float64), expected / expected.sum(), rtol=1e-4, atol=0
    )


@pytest.mark.parametrize(
    ("rms", "threshold", "degree"),
    [
        ((0.5, 0.3, 0.2), 0.0, 3),
        ((0.5, 0.3, 1e-4), 1e-4, 2),
        ((0.5, 1e-4, 1e-4), 1e-4, 1),
        ((1e-4, 1e-4, 0.3), 1e-4, 3),  # faint, but below what is needed
        ((1e-4, 1e-4, 1e-4), 1e-4, 0),
        ((0.5, 0.3, 0.0), 0.0, 2),
        ((0.5,), 0.9, 0),
        ((), 0.5, 0),
    ],
)
def test_the_highest_faint_degrees_go_and_the_rest_stays(rms, threshold, degree):
    gaussians = model(*rms)
    kept = drop_faint_bands(gaussians, threshold)
    assert kept.sh_degree == degree
    assert torch.equal(kept.shN, gaussians.shN[:, : (degree + 1) ** 2 - 1])
    assert kept.means is gaussians.means


def test_degrees_count_together():
    gaussians = model(0.5, 0.1, 0.1)
    shares = band_energy(gaussians)
    assert drop_faint_bands(gaussians, shares[3] * 1.01).sh_degree == 2
    assert drop_faint_bands(gaussians, (shares[2] + shares[3]) * 0.99).sh_degree == 2
    assert drop_faint_bands(gaussians, (shares[2] + shares[3]) * 1.01).sh_degree == 1


def test_what_is_transparent_or_not_finite_does_not_count():
    gaussians = model(0.5, 0.3, 0.0)
    expected = band_energy(model(0.5, 0.3, 0.0))
    gaussians.shN[0] = torch.nan
    gaussians.opacities[1] = -200.0
    gaussians.shN[1] = 1e3
    assert band_energy(gaussians)[3] < 1e-60 and band_energy(gaussians)[0] == pytest.approx(expected[0], rel=0.2)


@pytest.mark.parametrize("threshold", [-0.1, 1.0, float("nan")])
def test_a_threshold_out_of_range_is_refused(threshold):
    with pytest.raises(InputError, match="threshold"):
        drop_faint_bands(model(0.5), threshold)


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("bands")
    # Degree 2 is never opened: its coefficients are zero.
    short = ("train.iterations=6", "train.sh_interval=5", "train.evaluate_at=[]")
    run.train(tiny_config(tiny_capture(folder), *short), folder / "run")
    return folder / "run"


def rest_properties(path: Path) -> int:
    header = path.read_bytes().partition(b"end_header")[0].decode()
    return header.count("property float f_rest_")


def test_an_export_has_fewer_properties_and_reads_back(turbogs, finished, tmp_path):
    whole = load_ply(finished / "model.ply")
    assert rest_properties(finished / "model.ply") == 24
    for threshold, rest, words in (("0", 9, "degree 2 -> 1"), ("0.5", 0, "degree 2 -> 0"), (None, 24, "")):
        target = tmp_path / f"{rest}.ply"
        options = [] if threshold is None else ["--drop-bands", threshold]
        code, out, err = turbogs("export", finished, "--out", target, *options)
        assert code == 0 and words in out, err
        assert rest_properties(target) == rest
        read = load_ply(target)
        assert torch.equal(read.shN, whole.shN[:, : rest // 3]) and torch.equal(read.sh0, whole.sh0)
        assert torch.equal(read.means, whole.means)
    assert (tmp_path / "0.ply").stat().st_size < (tmp_path / "24.ply").stat().st_size
