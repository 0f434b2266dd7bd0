"""Neighbours in the order in which photos were taken."""

import torch

from turbogs_plugin.scene.sequence import Neighbours, neighbours


def near_of(known: list[str], photos: list[str]) -> Neighbours:
    return neighbours([*known, *photos], known, photos)


def test_the_nearer_neighbour_weighs_more_and_all_photos_count():
    near = near_of(["IMG_3.jpg", "IMG_8.jpg", "IMG_10.jpg"], ["IMG_9.jpg", "IMG_4.jpg", "IMG_5.jpg"])
    assert near.rows.tolist() == [[1, 2], [0, 1], [0, 1]]  # 9 is before 10, and 4 and 5 between 3 and 8
    torch.testing.assert_close(near.weights, torch.tensor([[1 / 2, 1 / 2], [2 / 3, 1 / 3], [1 / 3, 2 / 3]]))
    torch.testing.assert_close(near.mean(torch.tensor([0.0, 3.0, 5.0])), torch.tensor([4.0, 1.0, 2.0]))


def test_a_photo_is_no_neighbour_of_itself():
    assert near_of([], ["1.jpg"]).weights.tolist() == [[0.0, 0.0]]
    near = near_of(["1.png", "2.png", "3.png"], ["1.png", "2.png", "3.png"])
    assert near.rows.tolist() == [[0, 1], [0, 2], [1, 0]]
    assert near.weights.tolist() == [[0.0, 1.0], [0.5, 0.5], [1.0, 0.0]]


def test_each_folder_is_a_sequence_of_its_own():
    near = near_of(["left/1.jpg", "left/3.jpg", "right/2.jpg"], ["left/2.jpg", "right/1.jpg", "up/1.jpg"])
    assert near.rows.tolist() == [[0, 1], [0, 2], [0, 0]]
    assert near.weights.tolist() == [[0.5, 0.5], [0.0, 1.0], [0.0, 0.0]]
    assert near.mean(torch.ones(3, 2)).tolist() == [[1.0, 1.0], [1.0, 1.0], [0.0, 0.0]]
