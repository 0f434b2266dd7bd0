"""Which pairs are matched: by number, order and GPS."""

import numpy as np
import pytest

from turbogs_plugin.reconstruct import matching
from turbogs_plugin.reconstruct.matching import are_ordered, choose_matching, metres_of, natural_order, sequential_pairs

FILM = [f"frame_{number:05d}.jpg" for number in range(0, 1000, 2)]
HASHES = [f"{number * 2654435761 % 2**32:08x}.jpg" for number in range(500)]
NOWHERE = np.full((500, 2), np.nan)


def flight(count: int, spread: float) -> np.ndarray:
    """[count, 2] degrees: a meander of `spread` metres at 48 degrees north."""
    side = int(np.ceil(np.sqrt(count)))
    row, column = np.divmod(np.arange(count), side)
    column = np.where(row % 2, side - 1 - column, column)
    north, east = row / side * spread, column / side * spread
    return np.stack([48.0 + north / 111_195, 11.0 + east / (111_195 * np.cos(np.radians(48)))], axis=1)


def assert_proper(pairs: np.ndarray, count: int) -> None:
    assert pairs.dtype == np.int64 and (pairs[:, 0] < pairs[:, 1]).all()
    assert pairs.min() >= 0 and pairs.max() < count and len(np.unique(pairs, axis=0)) == len(pairs)


@pytest.mark.parametrize("count", [3, matching.FEW])
def test_few_photos_are_matched_each_with_each(count):
    chosen = choose_matching(HASHES[:count], flight(count, 500.0))
    assert_proper(chosen.pairs, count)
    assert (len(chosen.pairs), chosen.similar) == (count * (count - 1) // 2, 0) and "each with each" in chosen.reason


def test_ordered_photos_are_matched_with_those_that_follow_and_the_similar_ones():
    chosen = choose_matching(FILM, NOWHERE)
    assert_proper(chosen.pairs, 500)
    assert chosen.similar == matching.LOOPS and "order of their names" in chosen.reason
    steps = np.unique(chosen.pairs[:, 1] - chosen.pairs[:, 0])
    assert steps.tolist() == [*range(1, 11), 16, 32, 64, 128, 256]


def test_the_order_is_that_of_the_numbers_not_of_the_letters():
    names = sorted(f"IMG_{number}.jpg" for number in range(1, 301))
    chosen = choose_matching(names, NOWHERE[:300])
    first = names.index("IMG_9.jpg")
    assert {names.index("IMG_10.jpg"), names.index("IMG_8.jpg")} <= set(
        chosen.pairs[(chosen.pairs == first).any(1)].flat
    )
    assert [names[view] for view in natural_order(names)][8:11] == ["IMG_9.jpg", "IMG_10.jpg", "IMG_11.jpg"]


def test_photos_with_gps_are_matched_with_the_nearest():
    positions = flight(500, 400.0)
    chosen = choose_matching(HASHES, positions)
    assert_proper(chosen.pairs, 500)
    assert chosen.similar == matching.LOOPS and "GPS" in chosen.reason
    metres = metres_of(positions)
    apart = np.linalg.norm(metres[chosen.pairs[:, 0]] - metres[chosen.pairs[:, 1]], axis=1)
    assert apart.max() < 200  # of up to 560
    assert (np.bincount(chosen.pairs.ravel(), minlength=500) >= matching.NEIGHBORS).all()


def test_gps_of_a_room_or_of_a_few_photos_says_nothing():
    assert "similar" in choose_matching(HASHES, flight(500, 10.0)).reason
    some = flight(500, 400.0)
    some[::5] = np.nan
    assert choose_matching(HASHES, some).similar == matching.ALIKE


def test_photos_without_gps_among_those_with_it_are_matched_by_order():
    some = flight(500, 400.0)
    some[7] = np.nan
    chosen = choose_matching(FILM, some)
    assert_proper(chosen.pairs, 500)
    assert (chosen.pairs == 7).any(axis=1).sum() >= 10


def test_photos_of_no_order_are_matched_with_the_similar_ones():
    chosen = choose_matching(HASHES, NOWHERE)
    assert (chosen.pairs.shape, chosen.similar) == ((0, 2), matching.ALIKE)


@pytest.mark.parametrize(
    ("names", "ordered"),
    [
        (["a/1.jpg", "a/2.jpg", "a/4.jpg"], True),
        (["IMG_0001.JPG", "IMG_0003.JPG"], True),
        (["IMG_0001.JPG", "IMG_0500.JPG"], False),
        (["left.jpg", "right.jpg"], False),
        (["a1.jpg", "b2.jpg"], False),
        (["one.jpg"], False),
    ],
)
def test_what_counts_as_ordered(names, ordered):
    assert are_ordered(names) is ordered


def test_a_short_sequence_has_no_pair_beyond_its_end():
    assert sequential_pairs(3).tolist() == [[0, 1], [1, 2], [0, 2]]


def test_metres_of_degrees():
    metres = metres_of(np.array([[48.0, 11.0], [48.001, 11.0], [48.0, 11.001], [48.0, 11.0], [48.0, 11.0]]))
    np.testing.assert_allclose(metres[1] - metres[0], [111.19, 0.0], atol=0.1)
    np.testing.assert_allclose(metres[2] - metres[0], [0.0, 74.4], atol=0.1)
