"""Every tile's intersections: each splat that reaches it once, by depth and then by instance, whatever their number."""

import math
from itertools import pairwise

import pytest
import torch
from helpers.raster_cases import GPU_ONLY, make_case, samples_to
from helpers.rendering_scenes import make_cameras, make_gaussians, one_tile_of_a_wide_image, stacked_splats

from turbogs_plugin.engine.cuda import raster as cuda
from turbogs_plugin.engine.cuda.workspace import Workspace
from turbogs_plugin.engine.render import dense_samples

pytestmark = GPU_ONLY

COUNTS = [1, 2, 31, 32, 33, 64, 65, 128, 200, 256, 257, 512, 513, 1000, 1024, 1025, 2048, 2049, 4097, 9000]


def random_depths(count, generator):
    return 1 + 4 * torch.rand(count, generator=generator)


def equal_depths(count, generator):
    return torch.full((count,), 3.0)


def close_depths(count, generator):
    """Neighbours in the last places, and one far splat that takes the leading bits of the range."""
    depths = 3.0 + torch.randint(0, max(2, count // 2), (count,), generator=generator) * 2.4e-7
    depths[0] = 1e9
    return depths


def intersections_of_tiles(rendered):
    """Instances of each active tile, in order."""
    forward = rendered._forward
    starts = forward.tile_starts.tolist()
    return [forward.intersection_ids[begin:end].cpu() for begin, end in pairwise(starts)]


def render(gaussians, cameras, samples):
    gaussians = gaussians.map(lambda value: value.cuda())
    return cuda.rasterize_cuda(gaussians, cameras.to("cuda"), samples_to(samples, "cuda"))


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("depths", [random_depths, equal_depths, close_depths], ids=lambda depths: depths.__name__)
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


WIDE_IMAGE = (8192, 16)  # one row of tiles


def splats_that_end_at_a_tile(columns, copies):
    """Splats across `columns` tiles of one row, and the sentinel of a place that nothing was written to: the last row,
    which is off screen.

    Each ends within a thousandth of a pixel of the first pixel centre of the next tile. The half width of its box and
    that of its row are computed by different formulas, so some reach that tile by the second alone.
    """
    extent = math.sqrt(2 * math.log(0.9 * 255) * 1.001 + 0.002)  # standard deviations, as tile_reach.cuh enlarges it
    half = torch.linspace(-1.5, 1.5, 60, dtype=torch.float64) + 8 * columns - 4
    deviations = half / extent
    offsets = torch.linspace(-1e-3, 1e-3, 41, dtype=torch.float64)
    x = (16 * (columns + 4) + 0.5 - half[:, None] + offsets).flatten().repeat_interleave(copies)
    count = len(x) + 1
    gaussians, cameras = make_gaussians(count, dtype=torch.float32), make_cameras([WIDE_IMAGE], torch.float32)
    cameras.viewmats[0], cameras.Ks[0] = torch.eye(4), torch.eye(3)  # a pixel is one unit at depth 1
    gaussians.means[:-1] = torch.stack([x, torch.full_like(x, 8.0), torch.ones_like(x)], dim=1).float()
    gaussians.means[-1] = torch.tensor([0.0, 0.0, -1.0])
    gaussians.quats[:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    scales = (deviations.square() - 0.3).sqrt().log().repeat_interleave(len(offsets) * copies)
    gaussians.scales[:-1] = torch.stack([scales, torch.zeros_like(scales), torch.full_like(scales, -20.0)], 1).float()
    gaussians.opacities[:] = math.log(9.0)
    return gaussians, cameras


@pytest.mark.parametrize(("columns", "copies"), [(256, 1), (96, 32)], ids=["windows", "rows of a warp"])
def test_splats_that_round_to_a_tile_beyond_their_box_lose_nothing(columns, copies):
    """Where the box has as many tiles as a window or 32 rows of small splats may have, one tile more still counts."""
    gaussians, cameras = splats_that_end_at_a_tile(columns, copies)
    gaussians, cameras = gaussians.map(lambda value: value.cuda()), cameras.to("cuda")
    samples, memory = dense_samples(cameras), Workspace("cuda")
    first = cuda.rasterize_cuda(gaussians, cameras, samples, workspace=memory)
    sentinel = len(gaussians) - 1
    assert (first.projected().radii[0, :-1, 0] > 0).all() and (first.projected().radii[0, -1] == 0).all()
    capacity = memory.capacity(len(gaussians), len(samples.tile_ids))
    memory.buffer("intersection_keys", (capacity,), torch.int64).fill_(sentinel)
    rendered = cuda.rasterize_cuda(gaussians, cameras, samples, workspace=memory)
    tiles = intersections_of_tiles(rendered)
    assert memory.take_lost(wait=True) == 0
    assert sum(map(len, tiles)) == int(rendered.num_intersections) > columns * sentinel
    for instances in tiles:
        assert (instances[1:] > instances[:-1]).all()  # all depths are equal
        assert sentinel not in instances
