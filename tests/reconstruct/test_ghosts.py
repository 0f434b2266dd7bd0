"""Ghosts are found in graphs of pairs that are made up: no photo is needed."""

import numpy as np
import pytest

from turbogs_plugin.captures.matches import epipolar_distances
from turbogs_plugin.reconstruct.ghosts import Agreement, consistent_groups, ghost_pairs


def walk(count: int, reach: int, ghosts: range = range(0), repeated: int = 60) -> Agreement:
    """A walk of photos, each matching the next ones, more the nearer; and all matching all by repeated structure.

    Args:
        ghosts: photos that the solve has put where the repeated structure says.
        repeated: matches of a pair by repeated structure.
    """
    pairs = np.stack(np.triu_indices(count, 1), axis=1)
    true = np.maximum(0, 400 - (400 // reach) * (pairs[:, 1] - pairs[:, 0] - 1))
    agree = (true > 0) != np.logical_xor(*np.isin(pairs, list(ghosts)).T)
    matches, names = np.where(true, true, repeated), tuple(f"{view:02d}.jpg" for view in range(count))
    return Agreement(names, pairs, np.where(agree, matches, 0), np.where(agree, 0, matches))


def test_photos_in_their_place_are_one_group_though_many_pairs_contradict():
    agreement = walk(16, 5, repeated=20)
    assert agreement.contradicts.sum() > len(agreement.pairs) // 3
    assert consistent_groups(agreement) == [list(range(16))]
    assert not ghost_pairs(agreement, [list(range(16))]).any()


@pytest.mark.parametrize("repeated", [6, 20])
@pytest.mark.parametrize("ghosts", [range(4), range(6, 9), range(15, 16)])
def test_photos_at_a_ghost_are_a_group_of_their_own(ghosts, repeated):
    """Though more pairs agree with the ghost than contradict it: the true ones have more matches."""
    agreement = walk(16, 5, ghosts, repeated=repeated)
    main, *others = consistent_groups(agreement)
    assert sorted(view for group in others for view in group) == list(ghosts)
    assert main == [view for view in range(16) if view not in ghosts]


def test_the_pairs_of_a_ghost_are_those_that_agree_across():
    agreement = walk(16, 5, range(4), repeated=20)
    marked = agreement.pairs[ghost_pairs(agreement, consistent_groups(agreement))]
    assert len(marked) == 12 * 4 - (5 + 4 + 3 + 2)  # the walk's own pairs contradict
    assert all((first < 4) != (second < 4) and second - first > 5 for first, second in marked)


def test_many_weak_pairs_of_a_large_capture_do_not_outweigh_the_strong_ones():
    agreement = walk(300, 8, range(40), repeated=20)
    assert [len(group) for group in consistent_groups(agreement)] == [260, 40]
    assert len(consistent_groups(walk(300, 8, repeated=20))) == 1


def test_parts_that_weak_pairs_alone_connect_are_together_if_these_agree():
    """Two rooms of 12 photos each, all within reach of each other, and one pair with few matches through the door."""
    rooms = [(first, second) for second in range(24) for first in range(second) if first // 12 == second // 12]
    pairs, many = np.array([*rooms, (0, 12)]), np.full(len(rooms) + 1, 300)
    many[-1] = 40
    names = tuple(map(str, range(24)))
    assert consistent_groups(Agreement(names, pairs, many, 0 * many)) == [list(range(24))]
    contradicting = np.where(many == 40, 40, 0)
    apart = consistent_groups(Agreement(names, pairs, many - contradicting, contradicting))
    assert apart == [list(range(12)), list(range(12, 24))]


def test_epipolar_distances_are_zero_for_points_and_not_for_others():
    generator = np.random.default_rng(0)
    points = generator.uniform([-1, -1, 4], [1, 1, 8], (50, 3))
    angle = 0.2
    relative = np.eye(4)
    relative[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    relative[:3, 3] = [1.0, 0.3, 0.1]
    seen = points @ relative[:3, :3].T + relative[:3, 3]
    first, second = points / points[:, 2:], seen / seen[:, 2:]
    assert epipolar_distances(relative, first, second).max() < 1e-12
    # Sampson's distance of a shift by d across the line, at second order of both views: d / sqrt(2) for equal ones.
    across = second + np.array([0.0, 0.01, 0.0])
    moved = epipolar_distances(relative, first, across)
    assert (moved > 0.004).all() and (moved < 0.0101).all()
    relative[:3, 3] = 0.0
    assert (epipolar_distances(relative, first, second) == 0).all()
