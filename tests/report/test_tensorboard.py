"""`report.tensorboard`: what is written at which iteration, once; and that nothing is written unless asked for."""

import sys
from pathlib import Path
from types import ModuleType
from typing import ClassVar

import numpy as np
import pytest
from helpers.framework_runs import TINY, stop_after, tiny_config

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.report.tensorboard import EventWriter, event_writers
from turbogs_plugin.train import run
from turbogs_plugin.train.history import read_history
from turbogs_plugin.train.trainer import Trainer

pytestmark = pytest.mark.usefixtures("plotted")

ASKED = "report.tensorboard=true"
SHORT = ("train.iterations=2", "train.refine_until=1", "train.evaluate_at=[]")
"""For tests of what is written, whatever was learnt."""


class Recorder:
    """In the place of SummaryWriter: keeps what it is told."""

    made: ClassVar[list["Recorder"]] = []

    def __init__(self, folder: str, purge_step: int) -> None:
        self.folder, self.purge_step = folder, purge_step
        self.scalars, self.images = [], []
        self.flushed = self.closed = False
        Recorder.made.append(self)

    def add_scalar(self, tag: str, value: float, step: int) -> None:
        self.scalars.append((tag, value, step))

    def add_image(self, tag: str, pixels: np.ndarray, step: int, dataformats: str) -> None:
        assert dataformats == "HWC" and pixels.dtype == np.uint8
        self.images.append((tag, pixels, step))

    def flush(self) -> None:
        self.flushed = True

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def writers(monkeypatch) -> list[Recorder]:
    """The recorders, in the order in which they were made."""
    module = ModuleType("torch.utils.tensorboard")
    module.SummaryWriter = Recorder
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", module)
    monkeypatch.setattr(Recorder, "made", [])
    return Recorder.made


def lose_after_8(config: Config, folder: Path, monkeypatch) -> None:
    """A run that dies after an evaluation at 7, and has a checkpoint of 5."""

    def die(trainer: Trainer) -> None:
        raise ProcessLookupError("killed")

    with monkeypatch.context() as patch, pytest.raises(ProcessLookupError):
        stop_after(patch, 8, die)
        run.train(config, folder, watch=event_writers(config))


def test_a_run_tells_its_history_and_its_test_views(writers, capture, tmp_path):
    config = tiny_config(capture, ASKED)
    run.train(config, tmp_path / "run", watch=event_writers(config))
    (writer,) = writers
    history = read_history(tmp_path / "run/history.jsonl")
    assert (writer.folder, writer.purge_step) == (str(tmp_path / "run/tensorboard"), 0) and writer.closed
    told = {(tag, step): value for tag, value, step in writer.scalars}
    assert len(told) == len(writer.scalars), "no point twice"
    for tag in ("test/psnr", "test/worst_psnr", "test/l1", "counts/num_gaussians", "cost/train_seconds"):
        wanted = [(entry.iteration, getattr(entry, tag.partition("/")[2])) for entry in history]
        assert [(step, value) for (name, step), value in told.items() if name == tag] == wanted
    assert not any("own_" in tag for tag, _ in told), "what was not measured has no curve"
    assert [step for _, _, step in writer.images] == [0, 7, 14]
    first, _, last = (pixels for _, pixels, _ in writer.images)
    assert first.shape[0] == 40 and first.shape[1] > 3 * 48 and (first[:, :48] == last[:, :48]).all()
    assert (first[:, 60:100] != last[:, 60:100]).any(), "the render changes, the photo does not"


def test_a_resumed_run_takes_the_place_of_what_it_does_again(writers, capture, tmp_path, monkeypatch):
    config = tiny_config(capture, ASKED)
    lose_after_8(config, tmp_path / "run", monkeypatch)
    resumed = run.resume(tmp_path / "run", watch=event_writers(config))
    first, second = writers
    assert {step for _, _, step in first.scalars} == {0, 7} and first.flushed
    assert {step for _, _, step in second.scalars} == {7, 14} and second.purge_step == 6
    assert [entry.iteration for entry in resumed.history] == [0, 7, 14]


def test_nothing_is_written_unless_asked_for(writers, capture, tmp_path):
    config = tiny_config(capture, *SHORT)
    assert event_writers(config) == []
    run.train(config, tmp_path / "run", watch=event_writers(config))
    assert not writers and not (tmp_path / "run/tensorboard").exists()


def test_strips_are_small_and_may_be_none(writers, capture, tmp_path, monkeypatch):
    monkeypatch.setattr("turbogs_plugin.report.tensorboard.WIDEST_STRIP", 60)
    config = tiny_config(capture, *SHORT, ASKED)
    with monkeypatch.context() as without:
        without.setattr("turbogs_plugin.report.tensorboard.STRIPS", 0)
        run.train(config, tmp_path / "none", watch=event_writers(config))
    run.train(config, tmp_path / "run", watch=event_writers(config))
    none, some = writers
    assert not none.images and none.scalars
    assert {pixels.shape for _, pixels, _ in some.images} == {(15, 60, 3)}


def test_a_missing_package_is_named_before_anything_is_written(turbogs, capture, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    code, out, err = turbogs("train", capture, "--out", tmp_path / "run", "--device", "cpu", *TINY, ASKED)
    assert (code, out) == (2, "") and err.count("\n") == 1, err
    assert 'needs the package tensorboard: pip install "turbogs-plugin[tensorboard]"' in err
    assert list(tmp_path.iterdir()) == []


def test_the_library_itself_shows_every_point_once(capture, tmp_path, monkeypatch):
    accumulators = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    config = tiny_config(capture, ASKED)
    lose_after_8(config, tmp_path / "run", monkeypatch)
    resumed = run.resume(tmp_path / "run", watch=[EventWriter.of_run])
    events = accumulators.EventAccumulator(str(tmp_path / "run/tensorboard"))
    events.Reload()
    wanted = [(entry.iteration, pytest.approx(entry.psnr)) for entry in resumed.history]
    assert [(event.step, event.value) for event in events.Scalars("test/psnr")] == wanted
    (name,) = events.Tags()["images"]
    assert [event.step for event in events.Images(name)] == [0, 7, 14]
    assert (events.Images(name)[0].height, events.Images(name)[0].width) == (40, 3 * 48 + 12)
