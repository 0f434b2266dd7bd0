"""Amounts of memory and time as people write them."""

import pytest

from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.config.units import parse_bytes, parse_seconds
from turbogs_plugin.errors import InputError


@pytest.mark.parametrize(
    ("text", "expected"),
    [("2GiB", 2**31), ("1.5 gib", 3 * 2**29), ("1500MB", 1500 * 10**6), ("4096", 4096), ("7kib", 7168)],
)
def test_amounts_of_memory(text, expected):
    assert parse_bytes(text) == expected


@pytest.mark.parametrize(("text", "expected"), [("20s", 20), ("2m", 120), ("1.5 h", 5400), ("0.5", 0.5), ("3min", 180)])
def test_amounts_of_time(text, expected):
    assert parse_seconds(text) == expected


@pytest.mark.parametrize("text", ["", "GiB", "-2GiB", "2 apples", "0", "1e9", "2GiB 3", "inf", "nan", "9" * 400])
def test_no_amounts(text):
    for parse in (parse_bytes, parse_seconds):
        with pytest.raises(InputError, match="is no amount of"):
            parse(text)


@pytest.mark.parametrize(
    ("override", "word"),
    [
        ("train.iterations=2147483648", "iterations = 2147483648"),
        ("train.base_iterations=2147483648", "base_iterations = 2147483648"),
        ("budget.time=1000000h", "at most 100h"),
    ],
)
def test_lengths_that_cannot_be_counted_are_refused(override, word):
    with pytest.raises(InputError, match=word):
        load_config("turbogs", [override])
