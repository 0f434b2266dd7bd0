"""The random numbers: published vectors, and the logarithm operation by operation."""

import numpy as np
import pytest
import torch

from turbogs_plugin.engine.reference.philox import MASK, exponentials, philox4x32, random_words


def words(*values):
    return tuple(torch.tensor(value) for value in values)


# Random123's known-answer vectors for philox4x32-10: counter, key, result.
KNOWN_ANSWERS = [
    ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
    ((MASK,) * 4, (MASK, MASK), (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    (
        (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
        (0xA4093822, 0x299F31D0),
        (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
    ),
]


@pytest.mark.parametrize(("counter", "key", "expected"), KNOWN_ANSWERS)
def test_published_vectors(counter, key, expected):
    assert tuple(int(word) for word in philox4x32(words(*counter), key)) == expected


def test_layout_of_counter_and_key():
    seed, iteration = 0x123456789ABCDEF0, 77
    place = torch.arange(5)
    drawn = random_words(place, torch.tensor([3]), 2, seed, iteration)
    for index in range(5):
        counter = words(index, 3, 2, seed >> 32)
        expected = philox4x32(counter, (seed & MASK, iteration))
        assert [int(word[index]) for word in drawn] == [int(word) for word in expected]


def arguments():
    """Words whose uniforms cover both ends of (0, 1) densely, and what lies between."""
    edge = np.arange(4096)
    between = np.random.default_rng(0).integers(0, 1 << 23, 100_000)
    return np.unique(np.concatenate([edge, (1 << 23) - 1 - edge, between])) << 9


def test_exponentials_are_accurate_and_monotone():
    drawn = arguments()
    expected = -np.log((2.0 * (drawn >> 9) + 1) * 2.0**-24)
    result = exponentials(torch.from_numpy(drawn)).double().numpy()
    assert np.abs(result / expected - 1).max() < 2e-7
    assert (np.diff(result) <= 0).all()
    assert result.min() >= 2.0**-24
    assert result.max() <= 24 * np.log(2) * (1 + 1e-7)


def test_exponentials_follow_the_documented_operations():
    f32 = np.float32
    drawn = arguments()
    m = (2 * (drawn >> 9) + 1).astype(f32)
    b = m.view(np.int32)
    k = (b - np.int32(0x3F3504F3)) >> 23
    f = (b - (k << 23)).astype(np.int32).view(f32)
    z = f - f32(1)
    s = z / (f + f32(1))
    q = s * s
    c3, c5, c7, c9 = (f32(2 / n) for n in (3, 5, 7, 9))
    p = ((c9 * q + c7) * q + c5) * q + c3
    log_f = f32(2) * s + s * (q * p)
    expected = (24 - k).astype(f32) * np.array(0x3F317218, np.int32).view(f32) - log_f
    result = exponentials(torch.from_numpy(drawn)).numpy()
    assert expected.dtype == f32
    assert (result.view(np.int32) == expected.view(np.int32)).all()
