"""Samplers and maps on the GPU against the CPU: equal sets, equal maps, means that never stall."""

import numpy as np
import pytest
import torch

from turbogs_plugin.engine.reference.philox import exponentials
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.strategies.pixel_sampling import DensePixelSampler, ErrorGuidedPixelSampler, RandomPixelSampler
from turbogs_plugin.types import Step

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs an NVIDIA GPU"),
]

SIZES = np.array([[37, 21], [16, 16], [1, 1], [50, 3], [300, 200]])
SAMPLERS = [
    *(ErrorGuidedPixelSampler(unit=unit, importance=a) for unit in ("pixel", "tile") for a in (0.0, 0.5)),
    ErrorGuidedPixelSampler(mixed="uniform"),
    *(RandomPixelSampler(unit=unit) for unit in ("pixel", "tile")),
    DensePixelSampler(),
]


def step(iteration):
    return Step(iteration=iteration, total=10**6, refine_until=10**6, seed=2**33 + 5)


def pair_of_maps():
    maps = [ErrorMaps(SIZES, device=device) for device in ("cpu", "cuda")]
    for view_id, (width, height) in enumerate(SIZES.tolist()):
        errors = torch.rand(width * height, generator=torch.Generator().manual_seed(view_id)) ** 4
        for each in maps:
            each.initialise(view_id, errors.to(each.device))
    return maps


@pytest.mark.parametrize("sampler", SAMPLERS, ids=repr)
def test_ten_iterations_draw_equal_sets_and_leave_equal_maps(sampler):
    on_cpu, on_gpu = pair_of_maps()
    for t in range(10):
        views, rate = ((4, 0, 3), (2, 4), (1, 3, 4, 0))[t % 3], (0.03, 0.15, 0.5)[t % 3]
        samples = sampler.sample(on_cpu, views, rate, step(t))
        twins = sampler.sample(on_gpu, views, rate, step(t))
        for name in ("pixel_ids", "tile_ids", "tile_offsets"):
            assert torch.equal(getattr(samples, name), getattr(twins, name).cpu()), name
        if samples.weights is not None:
            torch.testing.assert_close(samples.weights, twins.weights.cpu(), rtol=2e-4, atol=1e-6)
        errors = torch.rand(len(samples), generator=torch.Generator().manual_seed(t)) * 3
        on_cpu.update(samples, errors, step(t))
        on_gpu.update(twins, errors.cuda(), step(t))
        for name in ("errors", "stamps", "view_sums"):
            assert torch.equal(getattr(on_cpu, name), getattr(on_gpu, name).cpu()), name


def test_exponentials_have_the_same_bits():
    words = torch.arange(1 << 23) << 9
    assert torch.equal(exponentials(words), exponentials(words.cuda()).cpu())


def test_means_are_a_known_number_of_calls_old():
    """With refresh = 4: exact at the first call, then the state of 4 to 7 calls before, also across a resume."""
    maps = ErrorMaps(np.array([[16, 16]]), device="cuda", refresh=4)
    maps.initialise(0, torch.zeros(256, device="cuda"))
    seen = []
    for call in range(18):
        maps.view_sums.fill_(256.0 * call)  # the mean at this call is its number
        if call in (7, 10):
            resumed = ErrorMaps(np.array([[16, 16]]), device="cuda", refresh=4)
            resumed.load_state_dict(maps.state_dict())
            maps = resumed
        seen.append(maps.view_means()[0])
    assert seen == [0, 0, 0, 0, 0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12]


def test_sums_can_be_read_at_once_after_initialise():
    maps = ErrorMaps(np.array([[16, 16]]), device="cuda", refresh=4)
    for value in (1.0, 2.0, 3.0):
        maps.initialise(0, torch.full((256,), value, device="cuda"))
        assert maps.view_means()[0] == value
