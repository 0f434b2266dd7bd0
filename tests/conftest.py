"""Fixtures that all tests share. The process that starts the others imports this module too, and needs neither torch
nor the package: importing them there would keep all cores but one waiting."""

import gc
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

gc.set_threshold(10_000)  # torch and the tests make half a million objects, walked through at each collection


def pytest_collection_modifyitems() -> None:
    """Give each process that runs tests one thread: tensors are small, and more threads collapse on a busy machine."""
    import torch

    torch.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def disks_are_not_waited_for() -> Iterator[None]:
    """The tests' files need not outlive a loss of power."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    """A folder of 7 training photos and a test photo of 40x24. Not to be changed."""
    from helpers.framework_runs import tiny_capture

    return tiny_capture(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(scope="module")
def scene(capture: Path):
    """The `capture`. Not to be changed."""
    from turbogs_plugin.captures import load_scene

    return load_scene(capture)


@pytest.fixture
def drawn() -> None:
    """For tests of what plots look like."""


@pytest.fixture
def plotted(request, monkeypatch) -> None:
    """Plots are made, with all that they show, but neither laid out nor rasterised, which takes a second a report; not
    with `drawn`."""
    from matplotlib.figure import Figure
    from PIL import Image

    def save(figure: Figure, file: object, **options: object) -> None:
        Image.new("RGB", (8, 8)).save(file, "PNG")

    if "drawn" not in request.fixturenames:
        monkeypatch.setattr(Figure, "savefig", save)
        monkeypatch.setattr(Figure, "draw_without_rendering", lambda figure: None)


@pytest.fixture
def few_random_points(monkeypatch) -> None:
    """Captures without points start from 500 random ones, not 50,000, which take longer than all else of a load."""
    monkeypatch.setattr("turbogs_plugin.captures.starting_points.NUM_RANDOM_POINTS", 500)


@pytest.fixture
def turbogs(monkeypatch, capsys):
    """Run the command in this process: (exit code, stdout, stderr)."""
    from turbogs_plugin import cli

    def turbogs(*arguments) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["turbogs", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            cli.main()
        captured = capsys.readouterr()
        return end.value.code or 0, captured.out, captured.err

    return turbogs
