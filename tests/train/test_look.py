"""Exposures of photos, by their neighbours in a sequence."""

import pytest
import torch

from turbogs_plugin.train.look import exposed, interpolated_exposures

NAMES = [f"{number}.jpg" for number in range(40)]
TRAINED = [name for number, name in enumerate(NAMES) if number % 8]
TEST = NAMES[::8]


def of(gains: torch.Tensor) -> torch.Tensor:
    """[V, 3, 4]: gains [V] of all channels, with the mean taken off."""
    offsets = torch.zeros(len(gains), 3, 4)
    offsets[:, range(3), range(3)] = (gains - gains.mean())[:, None]
    return offsets


def rows(names: list[str]) -> torch.Tensor:
    return torch.tensor([NAMES.index(name) for name in names])


def test_exposures_that_follow_the_sequence_are_told():
    wave = of(0.4 * torch.sin(torch.arange(40) / 6))
    told = interpolated_exposures(wave[rows(TRAINED)], TRAINED, TEST)
    inside = told[1:] - wave[rows(TEST)][1:]  # the first photo has one neighbour
    assert inside.abs().max() < 0.02 < 0.1 < wave[rows(TEST)].abs().max()
    assert (told[0] - wave[1]).abs().max() < 0.02


def test_exposures_at_random_tell_nothing():
    """The identity is nearer to the truth than neighbours are, and what is told is nearer to the identity still."""
    random = torch.Generator().manual_seed(3)
    noise = of(0.3 * torch.randn(40, generator=random))
    told = interpolated_exposures(noise[rows(TRAINED)], TRAINED, TEST)
    assert told.norm() < 0.3 * noise[rows(TEST)].norm()


@pytest.mark.parametrize("trained", [["a/1.jpg"], ["a/1.jpg", "a/2.jpg"], ["1.jpg", "2.jpg", "3.jpg"]])
def test_without_neighbours_or_differences_it_is_the_identity(trained):
    offsets = torch.zeros(len(trained), 3, 4) if len(trained) == 3 else torch.ones(len(trained), 3, 4)
    assert not interpolated_exposures(offsets, trained, ["1.png", "b/1.jpg"]).any()


def test_exposed_is_the_affine_map_of_each_colour():
    random = torch.Generator().manual_seed(2)
    colors, exposure = torch.rand(4, 5, 3, generator=random), torch.randn(3, 4, generator=random)
    wanted = [color + exposure[:, :3] @ color + exposure[:, 3] for color in colors.reshape(-1, 3)]
    torch.testing.assert_close(exposed(colors, exposure).reshape(-1, 3), torch.stack(wanted))
    assert (exposed(colors, torch.zeros(3, 4)) == colors).all()
