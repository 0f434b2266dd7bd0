"""The lines about photos while they are decoded."""

import sys

import pytest
from helpers.simulated_time import SimulatedTime

from turbogs_plugin.train.progress import LoadingProgress


@pytest.mark.parametrize("terminal", [False, True])
def test_time_left_counts_from_the_first_photo(monkeypatch, capsys, terminal):
    """Not from what is done before one is decoded: lenses and masks, here for 100 s."""
    clock = SimulatedTime(monkeypatch)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    progress = LoadingProgress()
    clock.passes(100.0)
    for loaded in range(1, 41):
        clock.passes(0.5)
        progress(loaded, 40)
    shown = capsys.readouterr().err.replace("\r", "\n").replace("\033[K", "").split("\n")
    assert [line for line in shown if line][:2] == (
        ["5 of 40 photos decoded, about 18 s left", "6 of 40 photos decoded, about 17 s left"]
        if terminal
        else ["5 of 40 photos decoded, about 18 s left", "25 of 40 photos decoded, about 8 s left"]
    )
    assert not terminal or shown[-1] == ""  # the line is gone


def test_photos_that_are_decoded_at_once_are_not_counted(monkeypatch, capsys):
    clock = SimulatedTime(monkeypatch)
    progress = LoadingProgress()
    clock.passes(100.0)
    for loaded in range(1, 41):
        progress(loaded, 40)
    assert capsys.readouterr().err == ""
