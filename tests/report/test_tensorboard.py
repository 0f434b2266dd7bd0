"""`report.tensorboard`: what TensorBoard reads of a run; and that nothing is written unless asked for."""

import sys

import pytest
from helpers.framework_runs import TINY, stop_after, tiny_config

from turbogs_plugin.report.tensorboard import event_writers
from turbogs_plugin.train import run
from turbogs_plugin.train.trainer import Trainer

accumulators = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
pytestmark = pytest.mark.usefixtures("plotted")

ASKED = "report.tensorboard=true"


def test_a_run_that_was_lost_and_resumed_has_every_point_once(capture, tmp_path, monkeypatch):
    """It dies after an evaluation at 7, and has a checkpoint of 5."""
    config, folder = tiny_config(capture, ASKED), tmp_path / "run"

    def die(trainer: Trainer) -> None:
        raise ProcessLookupError("killed")

    with monkeypatch.context() as patch, pytest.raises(ProcessLookupError):
        stop_after(patch, 8, die)
        run.train(config, folder, watch=event_writers(config))
    history = run.resume(folder, watch=event_writers(config)).history
    assert [entry.iteration for entry in history] == [0, 7, 14]
    events = accumulators.EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    for tag in ("test/psnr", "test/worst_psnr", "test/l1", "counts/num_gaussians", "cost/train_seconds"):
        wanted = [(entry.iteration, pytest.approx(getattr(entry, tag.partition("/")[2]))) for entry in history]
        assert [(event.step, event.value) for event in events.Scalars(tag)] == wanted
    scalars = events.Tags()["scalars"]
    assert not any("whole_" in tag or "aligned_" in tag for tag in scalars), "what was not measured has no curve"


def test_a_missing_package_is_named_before_anything_is_written(turbogs, capture, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    assert event_writers(tiny_config(capture)) == [], "nothing is written unless asked for"
    code, out, err = turbogs("train", capture, "--out", tmp_path / "run", "--device", "cpu", *TINY, ASKED)
    assert (code, out) == (2, "") and err.count("\n") == 1, err
    assert 'needs the package tensorboard: pip install "tensorboard>=2.12"' in err
    assert list(tmp_path.iterdir()) == []
