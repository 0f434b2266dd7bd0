"""Runs from end to end: the order of Algorithm 1, stops and resumes, and runs that cannot go on."""

import json
import math
import os
import pty
import re
import shutil
import signal
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
import torch
from helpers.framework_runs import assert_identical, saved, stop_after, tiny_config, tiny_trainer
from helpers.optimizers import make_gaussians
from helpers.processes import ended, said, start_ranks
from helpers.refusals import assert_refused
from PIL import Image

from turbogs_plugin.captures import load_scene
from turbogs_plugin.config.configuration import Config, load_config, resolve
from turbogs_plugin.errors import InputError, TrainingStopped
from turbogs_plugin.files import require_writable
from turbogs_plugin.report.run_report import write_report
from turbogs_plugin.scene.fingerprint import capture_difference, capture_state
from turbogs_plugin.strategies.density.error_driven import ErrorDrivenDensity
from turbogs_plugin.strategies.density.rows import NoDensity
from turbogs_plugin.strategies.losses import CharbonnierLoss
from turbogs_plugin.strategies.protocols import SparseLoss
from turbogs_plugin.strategies.returned import require_rows, require_stats
from turbogs_plugin.train import run
from turbogs_plugin.train.checkpoint import latest_checkpoint
from turbogs_plugin.train.history import read_history
from turbogs_plugin.train.inputs import open_scene
from turbogs_plugin.train.metrics import evaluate
from turbogs_plugin.train.run import fit
from turbogs_plugin.train.session import interruptible
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import GaussianStats, LossOutput, PixelSamples, RowUpdate
from turbogs_plugin.yaml_json import parse_yaml

pytestmark = pytest.mark.usefixtures("plotted")


@pytest.fixture(scope="module")
def whole(capture, tmp_path_factory) -> run.RunSession:
    """A run never stopped."""
    return run.train(tiny_config(capture), tmp_path_factory.mktemp("runs") / "whole", write_report)


def test_a_run_leaves_everything_that_it_promises(whole, capture):
    folder = whole.folder
    history = [json.loads(line) for line in folder.history.read_text().splitlines()]
    assert [line["iteration"] for line in history] == [0, 7, 14]
    for line in history:
        assert {"train_seconds", "psnr", "ssim", "l1", "num_gaussians", "memory_bytes"} <= set(line)
        assert all(np.isfinite(line[name]) for name in ("psnr", "ssim", "l1", "worst_psnr", "train_seconds"))
    assert history[-1]["psnr"] > history[0]["psnr"] + 1.0
    assert [line["train_seconds"] for line in history] == sorted(line["train_seconds"] for line in history)
    assert history[-1]["nonfinite_losses"] == history[-1]["skipped_updates"] == 0
    test = load_scene(capture).test
    measured = evaluate(whole.trainer.gaussians, test, whole.trainer.look(test.names))
    assert history[-1]["psnr"] == pytest.approx(measured.mean.psnr) and len(measured.views) == 1

    page = folder.report.read_text()
    for promised in ("psnr.png", "l1.png", "test-000.jpg", "config.yaml", "gsplat", "LPIPS was not computed", "FPS"):
        assert promised in page
    for name in ("psnr.png", "l1.png", "test-000.jpg"):
        Image.open(folder.path / "report" / name).verify()
    asked = tiny_config(capture)
    assert resolve(parse_yaml(folder.config.read_text(), "config")) == run.plan_run(asked).apply(asked)


def test_moments_and_statistics_follow_their_gaussians(capture):
    """A change of the set, which the trainer brings into the order of space: every row is still its Gaussian's."""
    trainer = tiny_trainer(capture)
    moments, count = trainer.optimizer.moments, len(trainer.gaussians)
    tags = torch.arange(1.0, count + 1)  # which Gaussian a row is, in all that has rows
    trainer.gaussians.sh0[:, 0, 0] = moments.exp_avg[:, 0] = moments.exp_avg_shN[:, 0] = tags
    moments.steps[:] = tags.int()
    trainer.density.stats.error_sums[:] = tags
    shuffled = torch.randperm(count, generator=torch.Generator().manual_seed(0))
    source = torch.cat([shuffled, shuffled[:9]])
    fresh = torch.arange(count + 9) >= count
    trainer.follow(RowUpdate(source, fresh, {}))
    moments, tags = trainer.optimizer.moments, trainer.gaussians.sh0[:, 0, 0]
    assert sorted(tags.tolist()) == sorted((source + 1.0).tolist()) and not torch.equal(tags, source + 1.0)
    assert torch.equal(moments.steps, tags.int())
    for rows in (moments.exp_avg[:, 0], moments.exp_avg_shN[:, 0], trainer.density.stats.error_sums):
        assert int((rows == 0).sum()) == 9
        assert torch.equal(rows, torch.where(rows == 0, 0.0, tags))


STOPS = dict.fromkeys((1, 2, 3, 5, 6, 7, 9, 10, 12), signal.SIGINT) | {7: signal.SIGTERM, 9: signal.SIGHUP}
"""Before and after events of density control, at an evaluation, at checkpoints; by Ctrl-C, and once by `kill` and by a
terminal that closes."""


def test_a_run_stopped_again_and_again_is_the_same_bit_for_bit(capture, whole, tmp_path, monkeypatch):
    """At every stop, the first before the first iteration, and at its end."""
    config = tiny_config(capture).without_plan()
    trainer = Trainer(config, open_scene(config.scene, True), torch.device("cpu"))
    initialise, place = Trainer.initialise_maps, tmp_path / "run"
    with monkeypatch.context() as context:
        context.setattr(Trainer, "initialise_maps", lambda each: (initialise(each), signal.raise_signal(signal.SIGINT)))
        assert run.train(tiny_config(capture), place).signal == signal.SIGINT
    trainer.initialise_maps()
    assert_identical(trainer.state_dict(), saved(place))
    for iteration, number in STOPS.items():
        with monkeypatch.context() as context:
            stop_after(context, iteration, lambda trainer, number=number: os.kill(os.getpid(), number))
            assert run.resume(place).signal == number
        while trainer.iteration < iteration:
            trainer.step()
        assert_identical(trainer.state_dict(), saved(place))
    with pytest.raises(ValueError, match="lacks what further iterations read"):
        trainer.load_state_dict(saved(whole.folder.path) | {"iteration": 12})
    resumed = run.resume(place)
    assert_identical(whole.trainer.state_dict(), resumed.trainer.state_dict())
    for again in (resumed, run.resume(place)):
        assert again.signal is None
        assert_identical(saved(whole.folder.path), again.state_dict()["trainer"])
        assert_identical(saved(whole.folder.path), saved(place))
    histories = (read_history(outcome.folder.history) for outcome in (whole, resumed))
    numbers = [[(e.iteration, e.psnr, e.ssim, e.l1, e.num_gaussians) for e in history] for history in histories]
    assert numbers[0] == numbers[1]


def test_a_closed_terminal_and_its_shell_are_one_signal_and_none_under_nohup():
    stops = []
    with interruptible(stops.append):
        signal.raise_signal(signal.SIGHUP)
        signal.raise_signal(signal.SIGHUP)
    assert stops == [signal.SIGHUP] and signal.getsignal(signal.SIGHUP) is signal.SIG_DFL
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interruptible(stops.append):
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
    assert stops == [signal.SIGHUP]


def test_a_run_stops_and_saves_when_its_terminal_closes(capture, tmp_path):
    """Whatever it would write to the terminal is lost, and nothing else."""
    (tmp_path / "config.yaml").write_text(tiny_config(capture, "train.iterations=100000").to_yaml())
    code = "from turbogs_plugin.cli import main; main()"
    words = ["train", str(capture), "--config", str(tmp_path / "config.yaml"), "--out", str(tmp_path / "run")]
    process, terminal = pty.fork()
    if not process:
        os.execv(sys.executable, [sys.executable, "-c", code, *words])
    told = b""
    while b"it/s" not in told and (part := os.read(terminal, 1000)):  # training has begun
        told += part
    os.close(terminal)
    assert os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == 128 + signal.SIGHUP
    assert latest_checkpoint(tmp_path / "run" / "checkpoints") is not None


def killed(capture: Path, out: Path, iteration: int) -> None:
    """In a process of its own: a run that is killed."""
    stop_after(pytest.MonkeyPatch(), iteration, lambda trainer: os.kill(os.getpid(), signal.SIGKILL))
    run.train(tiny_config(capture, "train.checkpoint_every=2"), out)


@pytest.mark.parametrize(("iteration", "kept"), [(1, 0), (7, 6)])
def test_a_run_killed_without_notice_resumes_bit_for_bit(capture, whole, tmp_path, iteration, kept):
    """Before the first checkpoint, and between two. What a kill in the midst of one leaves: test_checkpoint.py."""
    assert ended(start_ranks(1, killed, tmp_path, capture, tmp_path / "run", iteration)) == [-signal.SIGKILL]
    assert not kept or saved(tmp_path / "run")["iteration"] == kept
    assert_identical(whole.trainer.state_dict(), run.resume(tmp_path / "run").trainer.state_dict())


@pytest.mark.parametrize("times", [1, 2])
def test_a_run_whose_memory_is_full_on_the_way_goes_on_once_from_its_checkpoint(
    capture, whole, tmp_path, monkeypatch, capfd, times
):
    """By the same bits, where another process took the memory for a while."""
    step, left = Trainer.step, [times]

    def full(trainer):
        if trainer.iteration == 7 and left[0]:
            left[0] -= 1
            trainer.gaussians.means += 1.0  # in the midst of an iteration
            raise torch.cuda.OutOfMemoryError("CUDA out of memory")
        step(trainer)

    monkeypatch.setattr(Trainer, "step", full)
    again = partial(run.train, tiny_config(capture, "train.checkpoint_every=4"), tmp_path / "run")
    if times == 2:
        with pytest.raises(TrainingStopped, match=r"iteration 7: .* the last good checkpoint is .*iteration-000004"):
            again()
    else:
        assert_identical(whole.trainer.state_dict(), again().trainer.state_dict())
        assert [entry.iteration for entry in read_history(tmp_path / "run/history.jsonl")] == [0, 7, 14]
    assert "iteration 7: the device's memory was full; once more from iteration 4" in capfd.readouterr().err


def terminated(capture: Path) -> None:
    """In a process of its own, which has pycolmap: SIGTERM once a capture is read."""
    load_scene(capture)
    os.kill(os.getpid(), signal.SIGTERM)


def test_sigterm_before_training_ends_the_process_without_a_trace(capture, tmp_path):
    """pycolmap brings a handler that prints one."""
    assert ended(start_ranks(1, terminated, tmp_path, capture)) == [-signal.SIGTERM] and said(tmp_path) == ""


def not_finite(trainer):
    trainer.gaussians.means[3] = torch.nan


def all_gone(trainer):
    nobody = torch.zeros(0, dtype=torch.int64)
    trainer.follow(RowUpdate(nobody, nobody.bool(), {}))


@pytest.mark.parametrize(
    ("iteration", "lose", "reason"),
    [(10, not_finite, r"1 of \d+ Gaussians are not finite"), (7, all_gone, "every Gaussian was removed")],
)
def test_a_model_that_is_lost_ends_the_run_and_is_never_saved(capture, tmp_path, monkeypatch, iteration, lose, reason):
    stop_after(monkeypatch, iteration, lose)
    with pytest.raises(TrainingStopped, match=rf"iteration {iteration}: {reason}.*iteration-000005\.pt"):
        run.train(tiny_config(capture), tmp_path / "run")
    assert saved(tmp_path / "run")["iteration"] == 5
    assert all(value.isfinite().all() for value in saved(tmp_path / "run")["gaussians"].values())


def test_a_training_without_a_finite_loss_ends(capture, tmp_path):
    class Lost(SparseLoss):
        def __call__(self, colors, targets, samples):
            return LossOutput(colors.sum() * torch.nan, colors * torch.nan, colors[:, 0] * torch.nan)

    with pytest.raises(TrainingStopped, match="iteration 7: no loss was finite: see Lost"):
        fit(capture, config=tiny_config(capture).to_mapping(), loss=Lost())


def test_non_finite_losses_are_counted(capture, tmp_path, monkeypatch):
    def spoil(trainer):
        trainer.views.photos.colors = trainer.views.photos.colors.float() * torch.nan

    stop_after(monkeypatch, 10, spoil)
    outcome = run.train(tiny_config(capture), tmp_path / "run", write_report)
    assert outcome.history[-1].nonfinite_losses == 4
    assert all(value.isfinite().all() for value in saved(tmp_path / "run")["gaussians"].values())
    assert "non-finite loss: 4" in outcome.folder.report.read_text()


def test_a_capture_made_anew_since_the_run_began_is_refused(capture, whole, tmp_path):
    """Turned by a hundredth, say; two readings of one reconstruction differ by less."""
    began, present = (capture_state(load_scene(capture)) for _ in range(2))
    for views in (present["train_views"], present["test_views"]):
        views["viewmats"] += 2e-6
        views["Ks"] *= 1 + 2e-6
    assert capture_difference(began, present) == ""
    present["test_views"]["viewmats"][0, 0, 3] += 2e-5
    assert capture_difference(began, present) == "other cameras of test images"
    scaled = began | {"frame": began["frame"] | {"scale": 2 * began["frame"]["scale"]}}
    assert capture_difference(began, scaled) == "other coordinates"

    run_folder = Path(shutil.copytree(whole.folder.path, tmp_path / "run"))
    config = whole.folder.read_config()
    config.scene.path = str(shutil.copytree(capture, tmp_path / "capture"))
    (run_folder / "config.yaml").write_text(config.to_yaml())
    reconstruction = pycolmap.Reconstruction(tmp_path / "capture/sparse/0")
    turn = pycolmap.Rotation3d(np.array([0.0, 0.0, 0.01, 1.0]))
    reconstruction.transform(pycolmap.Sim3d(1.0, turn, np.zeros(3)))
    reconstruction.write_binary(tmp_path / "capture/sparse/0")
    before = latest_checkpoint(run_folder / "checkpoints").read_bytes()
    words = r"capture '.*capture' has other cameras of train images than .*run' began: .*another --out"
    assert_refused(words, run.resume, run_folder)
    assert latest_checkpoint(run_folder / "checkpoints").read_bytes() == before


@pytest.mark.parametrize(("size", "expected"), [(0.0, 40.0), (0.3, 0.3 * 14.0)])
def test_what_is_far_is_kept_from_growing(capture, size, expected):
    trainer = tiny_trainer(capture, f"train.distant_size={size}", "density.refine_from=100")
    far = trainer.gaussians.means.norm(dim=1).argmax()
    trainer.gaussians.means[far] *= 15.0 * trainer.extent / trainer.gaussians.means[far].norm()
    trainer.gaussians.scales[far] = math.log(40.0 * trainer.extent)
    trainer.step()
    assert torch.allclose(trainer.gaussians.scales[far].exp(), torch.tensor(expected * trainer.extent), rtol=0.05)


@pytest.mark.parametrize(("clears", "drawn", "remain"), [(True, False, 0), (False, False, 3), (True, True, 3)])
def test_what_stands_before_a_camera_goes_with_the_next_change(capture, clears, drawn, remain):
    trainer = tiny_trainer(replace(load_scene(capture), drawn_points=drawn), f"train.camera_clearance={clears}")
    centers = trainer.views.cameras.centers
    trainer.gaussians.means[:3] = centers[:3] + 1e-3 * trainer.extent
    trainer.follow(RowUpdate(torch.arange(len(trainer.gaussians)), torch.zeros(len(trainer.gaussians)).bool(), {}))
    near = torch.cdist(trainer.gaussians.means, centers).amin(dim=1) < 0.01 * trainer.extent
    assert int(near.sum()) == remain
    assert len(trainer.optimizer.moments.steps) == len(trainer.density.stats.grad_sums) == len(trainer.gaussians)


@pytest.mark.parametrize(
    "overrides",
    [
        ("schedule.type=fixed", "view_sampler.type=random", "pixel_sampler.type=random", "loss.type=charbonnier"),
        ("schedule.type=linear", "loss.type=sparse_ssim", "optimizer.type=sparse_adam", "density.type=none"),
        ("schedule.type=exponential", "pixel_sampler.type=dense", "density.type=gsplat_default"),
        ("pixel_sampler.importance=0.5", "optimizer.type=moment_lm", "density.score=raw"),
        ("pixel_sampler.unit=tile", "train.sh_degree=0", "train.backdrop=true"),
    ],
    ids=lambda overrides: overrides[0],
)
def test_every_alternative_trains(capture, tmp_path, overrides):
    outcome = run.train(tiny_config(capture, "train.iterations=5", *overrides), tmp_path / "run")
    assert outcome.history[-1].psnr > outcome.history[0].psnr


def test_more_views_an_iteration_than_a_gpu_takes_are_refused_before_anything_is_written():
    config = load_config("turbogs", ["schedule.max_views=200", "train.refine_cameras=false"]).without_plan()
    with pytest.raises(InputError, match=r"150 views an iteration, and a GPU takes at most 128: ask for fewer"):
        run.new_loop(config, SimpleNamespace(train=range(150)), torch.device("cuda"))


def own_sampler(*size, named=True, **changes):
    mask = torch.ones(4, *size) > 0
    return SimpleNamespace(sample=lambda _, ids, *__: replace(PixelSamples.from_mask(mask, *[ids] * named), **changes))


class OwnLoss(SparseLoss):
    """A loss whose error of a pixel has three numbers."""

    def __call__(self, colors, targets, samples):
        return LossOutput((colors - targets).square().mean(), colors - targets, (colors - targets).abs())


@pytest.mark.parametrize(
    ("part", "strategy", "message"),
    [
        ("pixel_sampler", own_sampler(24, 40, named=False), r"view_ids \[0, .*, not .*give view_ids, and masks"),
        ("pixel_sampler", own_sampler(40, 24), r"sizes \[\[24, 40\].*, not \[\[40, 24\].*masks \[K, H, W\]"),
        ("pixel_sampler", own_sampler(24, 40, weights=torch.ones(3)), "returned 3 weights for [0-9]+ slots"),
        ("loss", OwnLoss(), r"returned pixel_errors of shape \(\d+, 3\), not \(\d+,\)"),
    ],
)
def test_what_a_strategy_of_ones_own_returns_is_refused_and_nothing_is_left(
    capture, tmp_path, monkeypatch, part, strategy, message
):
    built = Config.build
    monkeypatch.setattr(Config, "build", lambda self, kind: strategy if kind == part else built(self, kind))
    with pytest.raises(InputError, match=message):
        run.train(tiny_config(capture, "schedule.min_views=3", "view_sampler.type=random"), tmp_path / "run")
    assert not (tmp_path / "run").exists()


ROWS, SAME = torch.arange(3), torch.zeros(3, dtype=torch.bool)


@pytest.mark.parametrize(
    ("update", "message"),
    [
        (RowUpdate(ROWS, SAME, {"scale": torch.zeros(3, 3)}), "with values of scale"),
        (RowUpdate(ROWS, SAME, {}, reset=("scale",)), "with values of scale"),
        (RowUpdate(ROWS, SAME, {"scales": torch.zeros(3, 3).half()}), r"values of scales of \(torch.float16, 3, 3\)"),
        (RowUpdate(ROWS, ROWS, {}), r"with fresh of 3 rows of torch\.int64"),
        (RowUpdate(ROWS, SAME, {"scales": torch.zeros(4, 3)}), r"values of scales of \(.*, 4, 3\), not \(.*, 3, 3\)"),
        (RowUpdate(ROWS, SAME[:2], {}), "with fresh of 2 rows"),
        (RowUpdate(~SAME, SAME, {}), r"with source of torch\.bool: source has old rows, as of torch\.nonzero"),
        (RowUpdate(ROWS + 1, SAME, {}), r"with source 1 \.\. 3 of 3 old rows"),
        (SAME, "NoDensity returned Tensor, not RowUpdate"),
    ],
)
def test_a_change_of_rows_that_does_not_fit_together_is_refused(update, message):
    assert_refused(message, require_rows, update, NoDensity(), make_gaussians(3))


def test_statistics_that_do_not_follow_their_gaussians_are_named():
    density = ErrorDrivenDensity()
    density.stats = GaussianStats.zeros(3, "cpu")
    require_stats(density, 3)
    assert_refused(r"ErrorDrivenDensity.stats has 3 rows for 4 Gaussians: in apply", require_stats, density, 4)


def test_a_folder_that_cannot_be_written_is_not_resumed(capture, tmp_path, monkeypatch):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text(tiny_config(capture).without_plan().to_yaml())
    # Whoever runs this may write to any folder.
    monkeypatch.setattr(run, "require_writable", lambda path, given: require_writable(path / "config.yaml/x", given))
    assert_refused(r"what --resume .*run writes cannot be made in .*: choose a folder", run.resume, tmp_path / "run")


def test_a_folder_is_read_as_the_section_scene_says(capture):
    short = ("train.iterations=2", "train.refine_until=1", "train.device=cpu")
    given = (str(capture), capture, load_scene(capture, 2))
    models = [fit(scene, *short, "scene.factor=2").gaussians for scene in given]
    for model in models[:2]:
        assert_identical(dict(model.items()), dict(models[2].items()))
    assert not torch.equal(fit(load_scene(capture), *short).gaussians.sh0, models[0].sh0)


def test_fit_takes_a_mapping_and_a_callback_and_names_what_it_does_not_know(capture):
    seen: list = []
    settings = {"train": {"iterations": 2, "refine_until": 1, "device": "cpu"}}
    result = fit(capture, config=settings, iterations=4, callback=seen.append)
    assert seen == result.history and (result.config.train.iterations, result.config.train.refine_until) == (4, 2)
    shown = r"Fit of Scene 'capture': 7 \+ 1 views of 40x24, 73 points: 73 Gaussians of SH degree 3 on cpu, .* dB .* s"
    assert re.fullmatch(shown, repr(result)) and repr(result.scene.test.cameras) == "1 cameras of 40x24"
    assert_refused("fit: there is no 'sampler': did you mean", fit, capture, sampler=None)
    with pytest.raises(InputError, match=r"loss=CharbonnierLoss is a class: give an object, CharbonnierLoss\(\.\.\.\)"):
        fit(capture, loss=CharbonnierLoss)
    with pytest.raises(InputError, match="fit: object is no PixelSampler: it lacks sample"):
        fit(capture, config=settings, pixel_sampler=object())
    with pytest.raises(InputError, match=r"loss: depths are read for the setting loss\.depth_weight alone"):
        fit(capture, config=settings, loss=CharbonnierLoss(depth_weight=0.1))
