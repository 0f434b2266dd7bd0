"""Which pairs are matched: by number, order and GPS."""

import numpy as np
import pytest

from turbogs_plugin.reconstruct import matching
from turbogs_plugin.reconstruct.matching import choose_pairs, metres_of, natural_order

FILM = [f"frame_{number:05d}.jpg" for number in range(0, 1000, 2)]
HASHES = [f"{number * 2654435761 % 2**32:08x}.jpg" for number in range(500)]
NOWHERE = np.full((500, 2), np.nan)


def flight(count: int, spread: float) -> np.ndarray:
    """[count, 2] degrees: a grid of `spread` metres at 48 degrees north."""
    side = int(np.ceil(np.sqrt(count)))
    north, east = np.divmod(np.arange(count), side) * np.array(spread / side)
    return np.stack([48.0 + north / 111_195, 11.0 + east / (111_195 * np.cos(np.radians(48)))], axis=1)


def assert_proper(pairs: np.ndarray, count: int) -> None:
    assert pairs.dtype == np.int64 and (pairs[:, 0] < pairs[:, 1]).all()
    assert pairs.min() >= 0 and pairs.max() < count and len(np.unique(pairs, axis=0)) == len(pairs)


@pytest.mark.parametrize("count", [3, matching.FEW])
def test_few_photos_are_matched_each_with_each(count):
    pairs, reason = choose_pairs(HASHES[:count], flight(count, 500.0))
    assert_proper(pairs, count)
    assert len(pairs) == count * (count - 1) // 2 and "each with each" in reason


def test_ordered_photos_are_matched_with_those_that_follow_and_every_tenth_with_every_tenth():
    pairs, reason = choose_pairs(FILM, NOWHERE)
    assert_proper(pairs, 500)
    assert reason == "in the order of their names"
    steps, counts = np.unique(pairs[:, 1] - pairs[:, 0], return_counts=True)
    assert steps[counts > 100].tolist() == [*range(1, 11), 16, 32, 64, 128, 256]
    assert [0, 490] in pairs.tolist() and [1, 491] not in pairs.tolist(), "a walk that comes back is closed"
    assert len(pairs) < 500 * 20


def test_the_order_is_that_of_the_numbers_not_of_the_letters():
    names = sorted(f"IMG_{number}.jpg" for number in range(1, 301))
    pairs, _ = choose_pairs(names, NOWHERE[:300])
    first = names.index("IMG_9.jpg")
    assert {names.index("IMG_10.jpg"), names.index("IMG_8.jpg")} <= set(pairs[(pairs == first).any(1)].flat)
    assert [names[view] for view in natural_order(names)][8:11] == ["IMG_9.jpg", "IMG_10.jpg", "IMG_11.jpg"]


def test_photos_with_gps_are_matched_with_the_nearest():
    positions = flight(500, 400.0)
    pairs, reason = choose_pairs(HASHES, positions)
    assert_proper(pairs, 500)
    assert reason == "with the 40 nearest by GPS"
    metres = metres_of(positions)
    apart = np.linalg.norm(metres[pairs[:, 0]] - metres[pairs[:, 1]], axis=1)
    assert apart.max() < 200  # the flight is 560 m across
    assert (np.bincount(pairs.ravel(), minlength=500) >= matching.NEIGHBORS).all()


def test_gps_of_a_room_or_of_a_few_photos_says_nothing():
    some = flight(500, 400.0)
    some[::5] = np.nan
    for positions in (flight(500, 10.0), some):
        pairs, reason = choose_pairs(HASHES, positions)
        assert len(pairs) == 500 * 499 // 2 and "neither names nor GPS" in reason
