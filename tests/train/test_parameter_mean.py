"""The mean of the last iterations, which becomes the model: what counts, restarts, resumes."""

import re
from pathlib import Path

import pytest
import torch
from helpers.framework_runs import assert_identical, stop_after, tiny_config, tiny_trainer

from turbogs_plugin.train.loop import Listener, TrainingLoop
from turbogs_plugin.train.parameter_mean import AVERAGE_EVERY, ParameterMean
from turbogs_plugin.train.run import resume, train
from turbogs_plugin.train.trainer import Trainer

AVERAGED = ("train.iterations=22", "train.average_last=0.6", "density.final_keep=1.0", "train.exposure=true")
"""After the last change of the set, at iteration 9, these count: 12, 16, 20, and the end, 22."""


class Kept(Listener):
    """Every iteration's parameters, and the size of the mean after it."""

    def __init__(self) -> None:
        self.learnt, self.counts = {}, {}

    def advanced(self, loop: TrainingLoop) -> None:
        trainer = loop.trainer
        self.learnt[trainer.iteration] = {name: value.clone() for name, value in trainer.learnt().items()}
        self.counts[trainer.iteration] = trainer.parameter_mean.count


def trained(capture, *overrides: str) -> tuple[Trainer, Kept]:
    kept, trainer = Kept(), tiny_trainer(capture, *overrides)
    loop = TrainingLoop(trainer)
    loop.listeners = [kept]
    loop.run()
    return trainer, kept


@pytest.fixture(scope="module")
def averaged(capture) -> tuple[Trainer, Kept]:
    """Not to be changed."""
    return trained(capture, *AVERAGED)


def tensors(value: float, rows: int = 2) -> dict[str, torch.Tensor]:
    return {"means": torch.full((rows, 3), value), "opacities": torch.full((rows,), -value)}


def test_it_is_the_mean_of_what_was_added():
    mean = ParameterMean(0.5, tensors(0.0))
    assert mean.count == 0 and all(len(value) == 0 for value in mean.tensors.values())
    present = tensors(1.0)
    mean.add(present)
    present["means"] += 100.0  # a copy was kept
    for value in (2.0, 6.0):
        mean.add(tensors(value))
    assert mean.count == 3
    torch.testing.assert_close(mean.tensors, tensors(3.0))
    mean.restart()
    mean.add(tensors(5.0, rows=7))
    torch.testing.assert_close(mean.tensors, tensors(5.0, rows=7))
    mean.add(tensors(8.0, rows=3))  # of other Gaussians, so it begins anew
    torch.testing.assert_close(mean.tensors, tensors(8.0, rows=3))


def test_the_lines_of_the_documentation():
    """docs/drop-in.md, in a loop as gsplat's."""
    page = (Path(__file__).parents[2] / "docs/drop-in.md").read_text()
    (code,) = re.findall(r"```python\n(from turbogs_plugin\.train\.parameter_mean .*?)```", page, re.DOTALL)
    start, each_step, end = (compile(part, "drop-in.md", "exec") for part in re.split(r"\n\n(?=if |mean\.)", code))
    names = {"splats": torch.nn.ParameterDict(tensors(0.0)), "max_steps": 100}
    exec(start, names)
    for step in range(100):
        for parameter in names["splats"].values():
            parameter.data.fill_(step)
        exec(each_step, names | {"step": step})
    exec(end, names)
    after = [iteration - 1 for iteration in range(90, 101) if iteration % AVERAGE_EVERY == 0]
    assert names["splats"]["means"][0, 0].item() == pytest.approx(sum(after) / len(after))


def test_the_last_share_of_a_run_counts_and_its_end_always_does():
    mean = ParameterMean(0.1, tensors(0.0))
    assert [i for i in range(1, 104) if mean.due(i, 103)] == [96, 100, 103]
    assert mean.due(3, 3) and mean.due(36, 40) and ParameterMean(1.0, tensors(0.0)).due(AVERAGE_EVERY, 1000)


def test_the_model_at_the_end_is_the_mean(averaged):
    trainer, kept = averaged
    assert [i for i in range(10, 23) if kept.counts[i] != kept.counts[i - 1]] == [12, 16, 20, 22]
    for name, value in trainer.learnt().items():
        expected = torch.stack([kept.learnt[i][name].double() for i in (12, 16, 20, 22)]).mean(dim=0)
        torch.testing.assert_close(value.double(), expected, rtol=1e-6, atol=1e-6)
        assert not torch.equal(value, kept.learnt[22][name])


def test_training_itself_is_the_same(averaged, capture):
    """Until the end, where the model alone becomes another."""
    trainer, kept = averaged
    plain = tiny_trainer(capture, *AVERAGED, "train.average_last=0")
    TrainingLoop(plain).run()
    assert_identical(kept.learnt[22], plain.learnt())
    for name in ("optimizer", "density", "maps"):
        assert_identical(getattr(trainer, name).state_dict(), getattr(plain, name).state_dict())
    assert "parameter_mean" not in plain.state_dict()


def test_a_resume_within_the_mean_gives_the_same_bits(capture, tmp_path, monkeypatch):
    whole = train(tiny_config(capture, *AVERAGED), tmp_path / "whole")
    with monkeypatch.context() as context:
        stop_after(context, 13)
        train(tiny_config(capture, *AVERAGED), tmp_path / "stopped")
    resumed = resume(tmp_path / "stopped")
    assert resumed.resumed and whole.trainer.iteration == 22
    assert_identical(whole.trainer.state_dict(), resumed.trainer.state_dict())
    again = resume(tmp_path / "stopped")  # a run at its end stays as it is
    assert_identical(whole.state_dict()["trainer"], again.state_dict()["trainer"])
