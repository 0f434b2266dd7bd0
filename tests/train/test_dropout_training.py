"""A training that leaves out some of the Gaussians in each iteration."""

import pytest
import torch
from helpers.framework_runs import assert_identical, stop_after, tiny_capture, tiny_config

from turbogs_plugin.captures import load_scene
from turbogs_plugin.engine.reference.raster import kept
from turbogs_plugin.engine.rules import Dropout
from turbogs_plugin.train.run import resume, train
from turbogs_plugin.train.trainer import DROPOUT_UNTIL, Trainer

CPU = torch.device("cpu")
ON = ("train.dropout=0.4", "train.iterations=20", "train.refine_until=12")


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return tiny_capture(tmp_path_factory.mktemp("captures"))


def test_what_an_iteration_leaves_out_does_not_learn_and_the_end_has_all(capture):
    config = tiny_config(capture, *ON, "density.refine_from=1000", "density.final_keep=1", "train.distant_size=0")
    trainer = Trainer(config.without_plan(), load_scene(capture), CPU)
    trainer.initialise_maps()
    ever_left = torch.zeros(len(trainer.gaussians), dtype=torch.bool)
    for iteration in range(20):
        share = 0.4 if iteration < DROPOUT_UNTIL * 20 else 0.0
        stay = kept(Dropout(share, config.train.seed, iteration), len(trainer.gaussians), CPU)
        assert (stay is None) == (iteration >= 19)  # 0.95 of 20
        before = trainer.gaussians.map(torch.clone)
        trainer.step()
        if stay is not None:
            ever_left |= ~stay
            for name, value in trainer.gaussians.items():
                assert torch.equal(value[~stay], getattr(before, name)[~stay])
            assert not torch.equal(trainer.gaussians.means[stay], before.means[stay])
    assert ever_left.double().mean() > 0.99


def test_a_resume_leaves_out_the_same(capture, tmp_path, monkeypatch):
    config = tiny_config(capture, *ON)
    whole = train(config, tmp_path / "whole")
    stop_after(monkeypatch, 7)
    train(config, tmp_path / "stopped")
    monkeypatch.undo()
    resumed = resume(tmp_path / "stopped")
    assert_identical(whole.trainer.state_dict(), resumed.trainer.state_dict())
    without = train(tiny_config(capture, *ON, "train.dropout=0"), tmp_path / "without")
    assert not torch.equal(without.trainer.gaussians.means[:10], whole.trainer.gaussians.means[:10])
