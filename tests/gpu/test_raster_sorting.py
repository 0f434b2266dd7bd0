"""Every tile's intersections: each splat that reaches it once, by depth and then by instance, whatever their number."""

from itertools import pairwise

import pytest
import torch
from helpers.raster_cases import GPU_ONLY, make_case, samples_to
from helpers.rendering_scenes import one_tile_of_a_wide_image, stacked_splats

from turbogs_plugin.engine.cuda import raster as cuda
from turbogs_plugin.engine.rendering import dense_samples

pytestmark = GPU_ONLY

COUNTS = [1, 2, 31, 32, 33, 64, 65, 128, 200, 256, 257, 512, 513, 1000, 1024, 1025, 2048, 2049, 4097, 9000]


def random_depths(count, generator):
    return 1 + 4 * torch.rand(count, generator=generator)


def equal_depths(count, generator):
    return torch.full((count,), 3.0)


def two_depths(count, generator):
    return torch.where(torch.rand(count, generator=generator) < 0.5, 2.0, 3.0)


def close_depths(count, generator):
    """Neighbours in the last places, and one far splat that takes the leading bits of the range."""
    depths = 3.0 + torch.randint(0, max(2, count // 2), (count,), generator=generator) * 2.4e-7
    depths[0] = 1e9
    return depths


def falling_depths(count, generator):
    return torch.linspace(9, 1, count)


def intersections_of_tiles(rendered):
    """Instances of each active tile, in order."""
    forward = rendered._forward
    starts = forward.tile_starts.tolist()
    return [forward.intersection_ids[begin:end].cpu() for begin, end in pairwise(starts)]


def render(gaussians, cameras, samples):
    gaussians = gaussians.map(lambda value: value.cuda())
    return cuda.rasterize_cuda(gaussians, cameras.to("cuda"), samples_to(samples, "cuda"))


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize(
    "depths",
    [random_depths, equal_depths, two_depths, close_depths, falling_depths],
    ids=lambda depths: depths.__name__,
)
def test_a_tile_is_in_order(depths, count):
    z = depths(count, torch.Generator().manual_seed(count))
    (got,) = intersections_of_tiles(render(*stacked_splats(z)))
    assert torch.equal(got.long(), z.sort(stable=True).indices)


def test_tiles_of_many_views_are_in_order():
    """Splats from smaller than a pixel to larger than the images; two passes agree to the bit."""
    case = make_case([(700, 300), (330, 470)], count=3000, seed=3, log_scale=-1.0)
    case.gpu_gaussians.scales += torch.linspace(-3, 3, 3000, device="cuda")[:, None]
    rendered, again = (
        cuda.rasterize_cuda(case.gpu_gaussians, case.gpu_cameras, dense_samples(case.gpu_cameras)) for _ in range(2)
    )
    tiles = intersections_of_tiles(rendered)
    assert sum(map(len, tiles)) == int(rendered.num_intersections) > 20_000
    depths = rendered.projected().depths.flatten().cpu()
    for instances in tiles:
        order = depths[instances.long()]
        later = (order[1:] > order[:-1]) | ((order[1:] == order[:-1]) & (instances[1:] > instances[:-1]))
        assert later.all()
    assert all(torch.equal(a, b) for a, b in zip(tiles, intersections_of_tiles(again), strict=True))


def test_more_large_splats_than_their_list_has_room_for():
    rendered = render(*one_tile_of_a_wide_image())
    (got,) = intersections_of_tiles(rendered)
    drawn = rendered.projected()
    assert torch.equal(got.long(), drawn.depths[0].cpu().sort(stable=True).indices)
    assert (drawn.radii[0] > 2000).all()
