"""`PixelSamples` of given pixels, and selected cameras."""

import copy
import pickle

import numpy as np
import pytest
import torch
from helpers.rendering_scenes import dense_on_grid, make_cameras

from turbogs_plugin.errors import InputError
from turbogs_plugin.tiles import dense_pixels
from turbogs_plugin.types import PixelSamples, TileGrid, sample_order

SIZES = np.array([(37, 21), (16, 50)])


def assert_in_order(samples: PixelSamples) -> None:
    """What `PixelSamples` promises of the order of slots and tiles."""
    assert samples.filled.all() and not samples.has_empty_slots
    assert {samples.pixel_ids.dtype, samples.tile_ids.dtype, samples.tile_offsets.dtype} == {torch.int32}
    assert samples.tile_offsets[0] == 0 and samples.tile_offsets[-1] == len(samples)
    assert (samples.tile_offsets.diff() > 0).all() and (samples.tile_ids.diff() > 0).all()
    assert samples.tile_ids[-1] < len(samples.grid)
    x, y = samples.coordinates().unbind(dim=-1)
    tiles, ranks = samples.tile_of_slot(), sample_order(x % 16, y % 16)
    assert ((tiles.diff() > 0) | (ranks.diff() > 0)).all()
    assert_in_their_tiles(samples)


def assert_in_their_tiles(samples: PixelSamples) -> None:
    (x, y), grid, views = samples.coordinates().unbind(dim=-1), samples.grid, samples.view_of_slot()
    column, line = (x + samples.origin[0]) // 16, (y + samples.origin[1]) // 16
    places = torch.as_tensor(grid.starts)[views] + line * torch.as_tensor(grid.shapes)[views, 0] + column
    assert torch.equal(samples.tile_ids[samples.tile_of_slot()].long(), places)


def test_all_pixels_are_the_dense_samples():
    expected = dense_pixels((0, 1), SIZES[[0, 0]], "cpu")
    samples = PixelSamples.from_mask(torch.ones(2, 21, 37, dtype=torch.bool))
    for name in ("pixel_ids", "tile_ids", "tile_offsets"):
        assert torch.equal(getattr(samples, name), getattr(expected, name))


@pytest.mark.parametrize("origin", [(0, 0), (15, 1), (7, 8)])
def test_a_grid_may_begin_before_its_images(origin):
    grid = TileGrid(SIZES, origin)
    samples = dense_on_grid(SIZES, origin)
    assert samples.origin == origin and len(samples.grid) == len(grid) == grid.starts[-1]
    assert grid.shapes.tolist() == [[(w + origin[0] + 15) // 16, (h + origin[1] + 15) // 16] for w, h in SIZES.tolist()]
    assert_in_their_tiles(samples)
    second = samples.of_tiles(slice(int(grid.starts[1]), len(grid)), slice(1, 2), slice(37 * 21, 37 * 21 + 16 * 50))
    assert second.tile_ids[0] == 0 and second.origin == origin and (second.view_of_slot() == 0).all()


@pytest.mark.parametrize("views", [None, 1, 3])
def test_a_mask_is_its_pixels(views):
    mask = torch.rand(*([] if views is None else [views]), 21, 37, generator=torch.Generator().manual_seed(0)) < 0.1
    samples = PixelSamples.from_mask(mask)
    assert_in_order(samples)
    again = torch.zeros(views or 1, 21, 37, dtype=torch.bool)
    x, y = samples.coordinates().unbind(dim=-1)
    again[samples.view_of_slot(), y, x] = True
    assert torch.equal(again.reshape(mask.shape), mask) and len(samples) == mask.sum()
    assert samples.sizes.tolist() == [[37, 21]] * (views or 1)


def test_a_view_without_pixels_stays_in_the_batch():
    mask = torch.zeros(3, 21, 37, dtype=torch.bool)
    mask[2, 20, 36] = True
    samples = PixelSamples.from_mask(mask, view_ids=(4, 5, 6))
    assert samples.view_ids == (4, 5, 6) and samples.view_of_slot().tolist() == [2]
    assert samples.tile_ids.tolist() == [17]  # of 3 * 6


def test_a_mask_that_does_not_fit_is_refused():
    for mask in (torch.ones(4, 4), torch.ones(4).bool(), np.ones((4, 4), bool), torch.zeros(4, 4).bool()):
        with pytest.raises(InputError, match="a tensor of bool"):
            PixelSamples.from_mask(mask)
    with pytest.raises(InputError, match="expected 2 different numbers of views"):
        PixelSamples.from_mask(torch.ones(2, 4, 4, dtype=torch.bool), (4, 4))


def test_selected_cameras_have_the_matrices_of_now():
    """Selected cameras follow changes of the cameras until then, and gradients."""
    cameras = make_cameras([(40, 30), (20, 20), (30, 50)])
    for _ in range(2):
        cameras.viewmats.add_(1.0)
        cameras.Ks.mul_(2.0)
        chosen = cameras.select([2, 0])
        assert torch.equal(chosen.viewmats, cameras.viewmats[[2, 0]]) and torch.equal(chosen.Ks, cameras.Ks[[2, 0]])
        assert chosen.sizes.tolist() == [[30, 50], [40, 30]] and len(chosen) == 2
    cameras.viewmats.requires_grad_()
    for _ in range(2):
        chosen = cameras.select([1])
        with torch.no_grad():  # somebody else's first look
            assert len(chosen.viewmats) == 1
        chosen.viewmats.sum().backward()
    assert torch.equal(cameras.viewmats.grad.sum(dim=(1, 2)), torch.tensor([0.0, 32.0, 0.0], dtype=torch.float64))


def test_selected_cameras_share_memory_until_their_matrices_are_read():
    cameras = make_cameras([(40, 30), (20, 20), (30, 50), (20, 20)])
    chosen = cameras.select(np.array([3, 0, 2])).select(range(1, 3))
    viewmats, Ks, rows = chosen.by_row()
    assert viewmats is cameras.viewmats and Ks is cameras.Ks and rows == (0, 2)
    assert cameras.by_row()[2] == range(4) and chosen.sizes.tolist() == [[40, 30], [30, 50]]
    wanted = cameras.viewmats[[0, 2]].clone()
    chosen.viewmats[0] = 0.0  # a copy of their own
    viewmats, _, rows = chosen.by_row()
    assert list(rows) == [0, 1] and torch.equal(viewmats[1], wanted[1]) and not viewmats[0].any()
    assert torch.equal(cameras.viewmats[[0, 2]], wanted)
    with pytest.raises(IndexError):
        cameras.select([4])


def test_selected_cameras_can_be_copied_saved_and_moved():
    chosen = make_cameras([(40, 30), (20, 20), (30, 50)]).select([2, 1])
    wanted = make_cameras([(40, 30), (20, 20), (30, 50)])
    for copied in (copy.deepcopy(chosen), pickle.loads(pickle.dumps(chosen)), chosen.to("cpu"), chosen):
        assert torch.equal(copied.centers, wanted.centers[[2, 1]])
        assert torch.equal(copied.directions, wanted.directions[[2, 1]]) and torch.equal(copied.Ks, wanted.Ks[[2, 1]])
        assert copied.sizes.tolist() == [[30, 50], [20, 20]]
    assert chosen.to(dtype=torch.float32).viewmats.dtype == torch.float32
