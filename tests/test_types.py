"""`PixelSamples` of given pixels."""

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


def some_pixels(count: int, seed: int = 0):
    """Views, x and y [P] of distinct pixels of images of `SIZES`, in no order."""
    generator = torch.Generator().manual_seed(seed)
    every = [(view, x, y) for view, (width, height) in enumerate(SIZES) for x in range(width) for y in range(height)]
    chosen = torch.randperm(len(every), generator=generator)[:count]
    return torch.tensor(every)[chosen].unbind(dim=1)


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
    starts, columns = TileGrid(samples.sizes).offsets[:-1], TileGrid(samples.sizes).shapes[:, 0]
    views = samples.view_of_slot()
    places = torch.as_tensor(starts)[views] + y // 16 * torch.as_tensor(columns)[views] + x // 16
    assert torch.equal(samples.tile_ids[tiles].long(), places)


def as_set(views, x, y) -> set[tuple[int, int, int]]:
    return set(zip(views.tolist(), x.tolist(), y.tolist(), strict=True))


@pytest.mark.parametrize("count", [1, 2, 300])
def test_coordinates_come_in_the_order_of_samples(count):
    views, x, y = some_pixels(count)
    samples = PixelSamples.from_coordinates(views.int(), x, y, SIZES, view_ids=(7, 3))
    assert samples.view_ids == (7, 3) and len(samples) == count
    assert_in_order(samples)
    assert as_set(samples.view_of_slot(), *samples.coordinates().unbind(dim=-1)) == as_set(views, x, y)


def test_all_pixels_are_the_dense_samples():
    expected = dense_pixels((0, 1), SIZES, "cpu")
    samples = PixelSamples.from_coordinates(*some_pixels(37 * 21 + 16 * 50), SIZES)
    for name in ("pixel_ids", "tile_ids", "tile_offsets"):
        assert torch.equal(getattr(samples, name), getattr(expected, name))


@pytest.mark.parametrize("origin", [(0, 0), (15, 1), (7, 8)])
def test_a_grid_may_begin_before_its_images(origin):
    grid = TileGrid(SIZES, origin)
    samples = dense_on_grid(SIZES, origin)
    assert samples.origin == origin and len(samples.grid) == len(grid) == grid.offsets[-1]
    x, y = samples.coordinates().unbind(dim=-1)
    column, line = (x + origin[0]) // 16, (y + origin[1]) // 16
    assert grid.shapes.tolist() == [[(w + origin[0] + 15) // 16, (h + origin[1] + 15) // 16] for w, h in SIZES.tolist()]
    views = samples.view_of_slot()
    places = torch.as_tensor(grid.offsets)[views] + line * torch.as_tensor(grid.shapes)[views, 0] + column
    assert torch.equal(samples.tile_ids[samples.tile_of_slot()].long(), places)
    second = samples.of_tiles(slice(int(grid.offsets[1]), len(grid)), slice(1, 2), slice(37 * 21, 37 * 21 + 16 * 50))
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


ONE = torch.tensor([1])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((torch.tensor([0, 2]), ONE.repeat(2), ONE.repeat(2), SIZES), r"outside its image \(view 2, x 1, y 1\)"),
        ((ONE, torch.tensor([16]), ONE, SIZES), r"outside its image \(view 1, x 16, y 1\)"),
        ((ONE, ONE, -ONE, SIZES), r"outside its image \(view 1, x 1, y -1\)"),
        ((ONE.repeat(2), ONE.repeat(2), ONE.repeat(2), SIZES), r"twice \(view 1, x 1, y 1\)"),
        ((ONE, ONE.float(), ONE, SIZES), "x is not a tensor of integers"),
        ((ONE, ONE, [1], SIZES), "y is not a tensor of integers"),
        ((ONE.repeat(2), ONE, ONE, SIZES), r"views is not .* \[P\] as x and y"),
        ((ONE[:0], ONE[:0], ONE[:0], SIZES), "P at least 1"),
        ((ONE, ONE, ONE, (37, 21)), r"sizes have shape \(2,\)"),
        ((ONE, ONE, ONE, SIZES, (4, 4)), "expected 2 different numbers of views"),
    ],
)
def test_pixels_that_do_not_fit_are_refused(arguments, words):
    with pytest.raises(InputError, match=words):
        PixelSamples.from_coordinates(*arguments)


@pytest.mark.parametrize(
    "mask",
    [torch.ones(4, 4), torch.ones(4, dtype=torch.bool), np.ones((4, 4), bool), torch.zeros(4, 4).bool()],
    ids=str,
)
def test_a_mask_that_does_not_fit_is_refused(mask):
    with pytest.raises(InputError, match=r"a tensor of bool|P at least 1"):
        PixelSamples.from_mask(mask)


def test_selected_cameras_have_the_matrices_of_now():
    """Selected cameras follow changes of the cameras until then, and gradients."""
    cameras = make_cameras([(40, 30), (20, 20), (30, 50)])
    for change in range(3):
        if change == 1:
            cameras.viewmats = cameras.viewmats + 1.0
        elif change == 2:
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
    cameras.viewmats = torch.zeros_like(cameras.viewmats)  # of other cameras from here on
    assert torch.equal(chosen.viewmats, wanted)
    chosen.viewmats[0], chosen.Ks = 0.0, chosen.Ks + 1.0  # a copy of their own
    viewmats, _, rows = chosen.by_row()
    assert list(rows) == [0, 1] and torch.equal(viewmats[1], wanted[1]) and not viewmats[0].any()
    with pytest.raises(IndexError):
        cameras.select([4])


def test_selected_cameras_can_be_copied_saved_and_moved():
    chosen = make_cameras([(40, 30), (20, 20), (30, 50)]).select([2, 1])
    wanted = make_cameras([(40, 30), (20, 20), (30, 50)])
    for copied in (copy.deepcopy(chosen), pickle.loads(pickle.dumps(chosen)), chosen.to("cpu"), chosen):
        assert torch.equal(copied.centers, wanted.centers[[2, 1]])
        assert torch.equal(copied.directions, wanted.directions[[2, 1]]) and torch.equal(copied.Ks, wanted.Ks[[2, 1]])
        assert copied.sizes.tolist() == [[30, 50], [20, 20]] and "Cameras(viewmats=tensor" in repr(copied)
    assert chosen.to(dtype=torch.float32).viewmats.dtype == torch.float32
