"""History, errors of images, memory and the progress of a training."""

import json
import math
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.refusals import assert_refused
from helpers.simulated_time import SimulatedTime

from turbogs_plugin.train.history import Evaluation, append_evaluation, read_history, rewind_history
from turbogs_plugin.train.metrics import Metrics, ViewMetrics, compare, psnr
from turbogs_plugin.train.session import REFRESH_SECONDS, TrainingProgress


def evaluation(iteration: int = 10, **changes) -> Evaluation:
    return Evaluation(iteration, 1.5, 20.0 + iteration / 100, 0.8, 0.05, 1000, 2**20, **changes)


def test_a_history_reads_back_and_a_resumed_run_says_the_rest_again(tmp_path):
    path = tmp_path / "history.jsonl"
    written = [evaluation(0), evaluation(10, nonfinite_losses=2), evaluation(20), evaluation(30)]
    for line in written:
        append_evaluation(path, line)
    assert all(json.loads(line)["own_psnr"] is None for line in path.read_text().splitlines())  # NaN
    assert list(map(str, read_history(path))) == list(map(str, written))
    assert [line.iteration for line in rewind_history(path, 20)] == [0, 10, 20]
    assert [line.iteration for line in read_history(path)] == [0, 10, 20]


@pytest.mark.parametrize("cut", ['{"iteration": 1', '{"iteration": 1\n', "\0\0\0\n", "\n"])
def test_a_last_line_that_was_cut_is_left_out_of_a_history(tmp_path, cut):
    path = tmp_path / "history.jsonl"
    append_evaluation(path, evaluation(0))
    whole = path.read_text()
    path.write_text(whole + cut)
    assert [kept.iteration for kept in read_history(path)] == [0]
    path.write_text(f"{cut.rstrip()}\n{whole}")
    assert_refused(r"history\.jsonl' line 1 is not an evaluation: take that line out", read_history, path)


def test_the_worst_view_is_recorded():
    views = [ViewMetrics("a", 31.0, 0.9, 0.01), ViewMetrics("b", 18.5, 0.7, 0.1), ViewMetrics("c", 33.0, 0.9, 0.01)]
    assert Metrics(views, 10.0).worst_psnr == 18.5
    assert math.isnan(Metrics([*views, ViewMetrics("d", math.nan, 0.9, 0.01)], 10.0).worst_psnr)


@pytest.mark.parametrize("shape", [(11, 11), (24, 20), (40, 64)])
def test_errors_are_those_of_numpy_and_torchmetrics(shape):
    generator = torch.Generator().manual_seed(1)
    photo = torch.rand(*shape, 3, generator=generator)
    image = (photo + 0.2 * torch.randn(*shape, 3, generator=generator)).clamp(0, 1)
    measured, difference = compare("view", image, photo), image.double().numpy() - photo.double().numpy()
    assert measured.psnr == pytest.approx(-10 * np.log10((difference**2).mean()), abs=1e-4)
    assert measured.l1 == pytest.approx(np.abs(difference).mean(), abs=1e-6)
    torchmetrics = pytest.importorskip("torchmetrics.functional.image")
    pair = [picture.permute(2, 0, 1)[None] for picture in (image, photo)]
    expected = torchmetrics.structural_similarity_index_measure(*pair, data_range=1.0, kernel_size=11, sigma=1.5)
    assert measured.ssim == pytest.approx(expected.item(), abs=1e-6)


def test_an_exact_image_and_a_small_one():
    photo = torch.rand(12, 12, 3)
    assert compare("view", photo, photo).psnr == 100.0
    assert math.isnan(compare("view", photo[:8], photo[:8]).ssim)
    assert math.isnan(psnr(torch.full_like(photo, math.nan), photo)), "what cannot be compared does not fit"


def training(iteration: int, gaussians: int) -> SimpleNamespace:
    """What progress reads of a loop: the iteration, of 100, and the number of Gaussians."""
    return SimpleNamespace(trainer=SimpleNamespace(iteration=iteration, iterations=100, gaussians=range(gaussians)))


def test_progress_is_a_line_an_evaluation_where_there_is_no_terminal(capsys):
    with closing(TrainingProgress()) as progress:
        progress.advanced(training(1, 5))
        progress.evaluated(training(10, 5), evaluation(10, skipped_updates=3, refined_psnr=21.0, refined_ssim=0.9))
    (line,) = capsys.readouterr().err.splitlines()
    assert "10/100" in line and "20.10 dB" in line
    assert line.endswith("  3 skipped updates  14 s left  by refined test cameras 21.00 dB, SSIM 0.9000")


def test_progress_is_a_line_that_goes_on_a_terminal(capsys, monkeypatch):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    clock = SimulatedTime(monkeypatch, tick=2.0)
    with closing(TrainingProgress()) as progress:
        progress.evaluated(training(10, 5), evaluation(10))
        progress.advanced(training(50, 1234))
        clock.tick = 0.0
        clock.passes(REFRESH_SECONDS / 2)
        progress.advanced(training(60, 1234))  # too soon
        clock.passes(10.0)
        progress.advanced(training(75, 1234))
    shown = capsys.readouterr().err.split("\r\033[K")
    assert "PSNR 20.10 dB" in shown[1] and shown[1].endswith("\n") and shown[-1] == ""
    assert [line.split("  ") for line in shown[2:-1]] == [
        ["50/100", "0 it/s", "1,234 Gaussians\r"],
        ["75/100", "10 s left", "2 it/s", "1,234 Gaussians\r"],
    ]
