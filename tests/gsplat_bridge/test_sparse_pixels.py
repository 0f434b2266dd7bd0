"""Views, rate and maps that the sparse swap starts with."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.refusals import assert_refused

from turbogs_plugin.gsplat_bridge import maps_of_photos, sparse_budget
from turbogs_plugin.strategies.pixel_sampling import ErrorGuidedPixelSampler
from turbogs_plugin.types import SamplingBudget, Step


@pytest.mark.parametrize(
    ("num_views", "batch_size", "expected"),
    [
        (50, None, SamplingBudget(4, 0.25)),
        (3, None, SamplingBudget(3, 1 / 3)),
        (50, 1, SamplingBudget(1, 1.0)),  # all that stock sees
        (50, 16, SamplingBudget(16, 0.1)),  # the least of turbogs' schedule
    ],
)
def test_a_step_has_the_pixels_of_an_image_and_it_says_so(num_views, batch_size, expected, capsys):
    assert sparse_budget(num_views, batch_size) == expected
    (line,) = capsys.readouterr().out.splitlines()
    given = "(no batch_size is given)" if batch_size is None else f"(batch_size is {batch_size})"
    assert f"sparse_budget: {expected.views} views a step, {expected.rate:.0%} of the pixels" in line and given in line


def test_budgets_that_cannot_be_are_refused_by_name():
    grid, processing = SimpleNamespace(use_bilateral_grid=True), SimpleNamespace(post_processing="ppisp")
    assert_refused("use_bilateral_grid=True does not work with sparse pixels", sparse_budget, 5, 1, grid)
    assert_refused("post_processing='ppisp' does not work", sparse_budget, 5, 1, processing)
    for words, given in {"num_views = 0": (0,), "batch_size = 0": (5, 0), "batch_size = 6": (5, 6)}.items():
        assert_refused(words, sparse_budget, *given)


@dataclass
class Photos:
    """A data set as gsplat's: items by number, no iteration."""

    images: torch.Tensor
    patch_size: int | None = None

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, item: int) -> dict[str, torch.Tensor]:
        return {"image": self.images[item % len(self.images)]}


def test_maps_start_from_the_errors_of_black():
    images = torch.randint(256, (3, 20, 30, 3), generator=torch.Generator().manual_seed(0))
    maps = maps_of_photos(Photos(images))
    assert maps.sizes.tolist() == [[30, 20]] * 3
    torch.testing.assert_close(maps.errors, (images.sum(dim=-1) / 255).flatten().half(), rtol=2e-3, atol=0)
    of_unit = maps_of_photos(Photos(images / 255), white=1.0)
    torch.testing.assert_close(of_unit.errors, maps.errors, rtol=2e-3, atol=0)


@pytest.mark.parametrize("of_first", [True, False])
def test_masks_of_a_trainset_are_heeded(of_first):
    """gsplat's data sets have "mask" where a photo has one: True counts."""
    images = torch.randint(1, 256, (3, 20, 30, 3), generator=torch.Generator().manual_seed(0))
    mask = torch.zeros(20, 30, dtype=torch.bool)
    mask[:, :7] = True

    class Masked(Photos):
        def __getitem__(self, item):
            return super().__getitem__(item) | ({"mask": mask} if item == 0 or not of_first else {})

    maps = maps_of_photos(Masked(images))
    samples = ErrorGuidedPixelSampler().sample(maps, (1, 0), 0.5, Step(0, 10, 5))
    x = samples.coordinates()[samples.filled, 0]
    views = samples.view_of_slot()[samples.filled]
    assert (x[views == 1] < 7).all() and (x[views == 0] < 7).all() != of_first and (views == 1).any()
    assert maps.view_means()[0] == pytest.approx(float((images[0].sum(dim=-1) / 255)[mask].mean()), rel=1e-3)


def test_masks_that_leave_no_pixel_are_refused_and_one_of_several_is_not():
    image, masked = torch.full((20, 30, 3), 200), torch.zeros(20, 30, dtype=torch.bool)
    inverted = [{"image": image, "mask": masked}] * 2
    assert_refused("^masks leave no pixel of any photo: they may be inverted; True is", maps_of_photos, inverted)
    assert maps_of_photos([*inverted, {"image": image}]).view_means()[:2].tolist() == [0, 0]


def test_what_is_no_data_set_of_images_is_refused_by_name():
    good, place = {"image": torch.zeros(20, 30, 3)}, r"^trainset\[1\]\['image'\] is"
    array, patches = {"image": np.zeros((20, 30, 3))}, Photos(torch.zeros(2, 8, 8, 3), patch_size=8)
    assert_refused(rf"{place} ndarray: expected a tensor \[H, W, 3\]", maps_of_photos, [good, array])
    assert_refused("trainset needs whole images, its patch_size is 8", maps_of_photos, patches)
    for value in (torch.nan, -torch.inf):
        broken = {"image": torch.tensor([value, 2.0, 3.0]).expand(20, 30, 3)}
        assert_refused(r"^trainset\[1\]\['image'\] has values that are not finite", maps_of_photos, [good, broken])
