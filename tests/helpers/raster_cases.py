"""What the tests of the CUDA rasterizer share: scenes in float32 on the GPU and their twins in float64 on the CPU."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import pytest
import torch
from helpers.rendering_scenes import dense_on_grid, make_cameras, make_gaussians, thin_out
from torch import Tensor

from turbogs_plugin.engine.cuda import library as kernels
from turbogs_plugin.engine.layout import ScreenRecord, columns
from turbogs_plugin.engine.render import dense_samples
from turbogs_plugin.types import Cameras, Gaussians, PixelSamples

Result = TypeVar("Result")

GPU_ONLY = [
    pytest.mark.gpu,
    pytest.mark.skipif(bool(kernels.unavailable_reason()), reason=kernels.unavailable_reason() or "usable"),
]

FORWARD_BOUND = 1e-4
FLIP_SHARE = 1e-3  # of the samples may lie on a threshold
COSINE_BOUND, GRADIENT_BOUND = 0.9999, 1e-3
STEADY_MOVES, STEADY_SIZE = 3, 2e-7

RECORD_COLUMNS = columns(ScreenRecord)


@dataclass
class Case:
    """A scene twice: float64 on the CPU, and the same numbers, rounded to float32 beforehand, on the GPU."""

    gaussians: Gaussians
    cameras: Cameras
    samples: PixelSamples
    gpu_gaussians: Gaussians
    gpu_cameras: Cameras
    gpu_samples: PixelSamples


def samples_to(samples: PixelSamples, device: torch.device | str) -> PixelSamples:
    values = {name: getattr(samples, name) for name in ("pixel_ids", "tile_ids", "tile_offsets", "weights")}
    return replace(samples, **{name: None if value is None else value.to(device) for name, value in values.items()})


def make_case(
    sizes: list[tuple[int, int]],
    count: int,
    rate: float = 1.0,
    seed: int = 0,
    empty_slots: int = 0,
    log_scale: float = 0.0,
    origin: tuple[int, int] = (0, 0),
    device: str = "cuda",
) -> Case:
    """Random Gaussians seen by cameras of these image sizes. `rate`: share of each tile's pixels; below 1 some tiles
    have no samples at all. `log_scale`: added to scales. `origin`: of the grid of tiles."""
    gaussians = make_gaussians(count, seed, torch.float32)
    gaussians.scales += log_scale
    cameras = make_cameras(sizes, torch.float32)
    samples = dense_samples(cameras) if origin == (0, 0) else dense_on_grid(cameras.sizes, origin)
    if rate < 1:
        samples = thin_out(samples, rate, seed, empty_slots)
    return Case(
        gaussians.map(Tensor.double),
        cameras.to(dtype=torch.float64),
        samples,
        gaussians.map(lambda value: value.to(device)),
        cameras.to(device),
        samples_to(samples, device),
    )


def upstream(case: Case, depths: bool = False) -> dict[str, Tensor]:
    """Random gradients and errors at the samples, float64 on the CPU, zero in empty slots; with `depths` of depths."""
    generator = torch.Generator().manual_seed(0)
    count, filled = len(case.samples), case.samples.filled
    values = {
        "color_gradients": torch.randn(count, 3, generator=generator),
        "pixel_errors": torch.rand(count, generator=generator),
        "alpha_gradients": torch.randn(count, generator=generator),
    }
    if depths:
        values["depth_gradients"] = torch.randn(count, generator=generator)
    return {name: (value * filled.reshape(-1, *[1] * (value.dim() - 1))).double() for name, value in values.items()}


def on_gpu(values: dict[str, Tensor], device: str = "cuda") -> dict[str, Tensor]:
    return {name: value.float().to(device) for name, value in values.items()}


def on_side_stream(work: Callable[[], Result]) -> Result:
    """The result of `work` on a stream of its own, which sleeps first: work on the default stream would overtake it."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        torch.cuda._sleep(50_000_000)
        result = work()
    stream.synchronize()
    return result


def assert_forward_close(got: Tensor, wanted: Tensor, what: str) -> None:
    """Within the bound, except where a threshold decided otherwise: few samples, and of both signs."""
    difference = (got.double().cpu() - wanted).flatten()
    flips = difference.abs() > FORWARD_BOUND * wanted.abs().flatten().clamp(min=1.0)
    assert flips.double().mean() <= FLIP_SHARE, f"{what}: {int(flips.sum())} of {len(flips)} beyond the bound"
    # A flip at alpha_min moves a pixel by 1/255 of a colour at most, times a few.
    assert difference.abs().max() <= 0.05 * wanted.abs().max().clamp(min=1.0), f"{what}: {difference.abs().max():.2e}"


def gradient_errors(got: Tensor, wanted: Tensor) -> tuple[float, float]:
    """(cosine, relative L2)."""
    got, wanted = got.double().cpu().flatten(), wanted.double().flatten()
    cosine = torch.dot(got, wanted) / (got.norm() * wanted.norm()).clamp(min=1e-300)
    return float(cosine), float((got - wanted).norm() / wanted.norm().clamp(min=1e-300))


def assert_gradients_close(got: Tensor, wanted: Tensor, what: str, bound: float = GRADIENT_BOUND) -> None:
    """Cosine, relative L2, and the magnitude of rows."""
    if wanted.norm() == 0:
        assert got.abs().max() == 0, what
        return
    cosine, relative = gradient_errors(got, wanted)
    assert cosine >= COSINE_BOUND and relative <= bound, f"{what}: cosine {cosine:.6f}, relative {relative:.2e}"
    rows, wanted_rows = got.double().cpu().flatten(0, -2).norm(dim=-1), wanted.double().flatten(0, -2).norm(dim=-1)
    large = wanted_rows > 1e-3 * wanted_rows.max()
    ratio = rows[large] / wanted_rows[large]
    assert (ratio - 1).abs().quantile(0.99) <= 10 * GRADIENT_BOUND, f"{what}: row magnitudes differ"


def assert_records_close(records: Tensor, wanted: Tensor) -> None:
    """Every column of `layout.ScreenRecord`."""
    for name, column in RECORD_COLUMNS.items():
        assert_gradients_close(records[..., column], wanted[..., column], name)
