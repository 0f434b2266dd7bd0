"""The command line: bad input is one line on stderr, exit code 2, and nothing written."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.framework_runs import TINY, stop_after
from helpers.refusals import assert_one_line
from PIL import Image

from turbogs_plugin import __version__, captures, cli
from turbogs_plugin.commands import COMMANDS
from turbogs_plugin.config import configuration
from turbogs_plugin.engine.render import render_image
from turbogs_plugin.errors import InputError
from turbogs_plugin.export.renders import distinct_stems
from turbogs_plugin.model.ply import load_ply
from turbogs_plugin.train import inputs, run

pytestmark = pytest.mark.usefixtures("plotted")

QUICK = ("train.iterations=2", "train.sh_degree=0", "train.evaluate_at=[]")


@pytest.fixture(scope="module")
def finished(capture, tmp_path_factory) -> Path:
    """A finished run, made by the command itself."""
    folder = tmp_path_factory.mktemp("cli-runs") / "run"
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as end:
        patch.setattr(sys, "argv", ["turbogs", "train", str(capture), "--out", str(folder), "--device", "cpu", *QUICK])
        cli.main()
    assert not end.value.code
    return folder


def tree(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_photos_of_more_pixels_than_pillow_takes_for_harmless(turbogs, capture, monkeypatch):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    assert turbogs("plan", capture, "--device", "cpu")[0] == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--max-gaussians", "0"], ["--max-gaussians 0: it must be above 0"]),
        (["--config", "turbo"], ["'turbo'", "turbogs-big", "did you mean 'turbogs'"]),
        (["schedule.min_views=9", "schedule.max_views=4"], ["max_views", "9", "4"]),
        (["--factor", "0"], ["factor = 0 is not valid: it must be at least 1"]),
        (["--max-memory", ""], ["'' has no value", "leave it out"]),
    ],
)
def test_a_bad_setting_is_refused(turbogs, capture, tmp_path, arguments, words):
    assert_one_line(turbogs("train", capture, "--out", tmp_path / "run", "--device", "cpu", *arguments), *words)
    assert not (tmp_path / "run").exists()


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has CUDA")
@pytest.mark.parametrize("words", ["train CAPTURE --out NEW", "train PHOTOS --out NEW", "eval RUN", "render RUN", ""])
def test_cuda_asked_for_and_absent(turbogs, capture, finished, tmp_path, monkeypatch, words):
    """Nothing is decoded before, and no camera looked for; nor where a run of a GPU is to go on."""
    monkeypatch.setattr(inputs, "load_scene", lambda *_, **__: pytest.fail("the capture was loaded"))
    monkeypatch.setattr("turbogs_plugin.reconstruct.run.reconstruct_beside", lambda *_: pytest.fail("solved"))
    places = {"CAPTURE": capture, "PHOTOS": capture / "images", "NEW": tmp_path / "run", "RUN": finished}
    call = [*(places.get(word, word) for word in words.split()), "--device", "cuda"]
    if not words:
        stopped = Path(shutil.copytree(finished, tmp_path / "stopped"))
        (stopped / "report.md").unlink()
        file = stopped / "config.yaml"
        file.write_text(file.read_text().replace("device: cpu", "device: cuda"))
        call = ["train", "--resume", stopped]
    assert_one_line(turbogs(*call), "CUDA", "turbogs doctor", "--device cpu")
    assert not (tmp_path / "run").exists()


def test_a_capture_that_a_run_has_trained_on_is_not_judged_again(turbogs, capture, finished, tmp_path, monkeypatch):
    monkeypatch.setattr(inputs, "require_agreement", lambda scene: pytest.fail("judged"))
    assert turbogs("eval", finished, "--device", "cpu")[0] == 0
    (Path(shutil.copytree(finished, tmp_path / "run")) / "report.md").unlink()
    assert turbogs("train", "--resume", tmp_path / "run")[0] == 0
    for call in (("plan", capture), ("train", capture, "--out", tmp_path / "new")):
        with pytest.raises(pytest.fail.Exception, match="judged"):
            turbogs(*call, "--device", "cpu")
    assert turbogs("plan", capture, "--device", "cpu", "scene.force=true")[0] == 0


def test_an_output_folder_with_other_files_is_left_alone(turbogs, capture, finished, tmp_path):
    (tmp_path / "a.b=c").write_text("mine")  # no override, as it follows an option
    before = tree(finished)
    for out in (finished, tmp_path, tmp_path / "a.b=c"):
        assert_one_line(turbogs("train", capture, "--out", out, "--device", "cpu", *QUICK), "not empty", "--resume")
    assert_one_line(turbogs("train", capture, "--out", tmp_path / "a.b=c" / "run", *QUICK), "cannot be made")
    assert tree(tmp_path) == {"a.b=c": b"mine"} and tree(finished) == before


@pytest.mark.parametrize("out", ["/proc/run", "dangling", "dangling/run"])
def test_an_output_folder_that_cannot_be_made_is_refused_before_anything_is_computed(
    turbogs, capture, tmp_path, monkeypatch, out
):
    (tmp_path / "dangling").symlink_to("nowhere")
    monkeypatch.setattr(inputs, "load_scene", lambda *_, **__: pytest.fail("the capture was loaded"))
    assert_one_line(turbogs("train", capture, "--out", tmp_path / out, *QUICK), out, "cannot be made", "choose")
    assert [path.name for path in tmp_path.iterdir()] == ["dangling"]


def test_what_the_system_refuses_is_one_line(turbogs, tmp_path, monkeypatch):
    def refused(*arguments, **options):
        raise OSError(28, "No space\x1b[2J left on device")

    monkeypatch.setattr(captures, "write_demo_capture", refused)
    assert_one_line(turbogs("demo", tmp_path / "demo"), "the system says: No space?[2J left on device; choose another")


@pytest.mark.parametrize("order", ["SCENE train.seed=5 OPTIONS", "SCENE OPTIONS train.seed=5", "OPTIONS SCENE"])
def test_overrides_stand_anywhere(turbogs, capture, monkeypatch, order):
    seen, words = [], order.replace("SCENE", str(capture)).replace("OPTIONS", "--config demo --device cpu").split()
    monkeypatch.setattr(run, "plan_run", lambda config, count: seen.append(config.train) or SimpleNamespace(text=str))
    code, _, error = turbogs("plan", *words, "train.iterations=7")
    assert code == 0, error
    assert [(train.seed, train.iterations) for train in seen] == [(5 if "seed" in order else 0, 7)]


@pytest.mark.parametrize("changes", [["train.seed=5", "--config", "demo"], ["--config", "demo", "train.seed=5"]])
def test_plan_without_a_capture_lists_the_settings(turbogs, monkeypatch, changes):
    monkeypatch.setattr(configuration, "settings_text", lambda config: f"train.seed {config.train.seed}")
    assert turbogs("plan", *changes) == (0, "train.seed 5\n", "")


def test_incomplete_and_contradictory_calls(turbogs, capture, tmp_path):
    assert_one_line(turbogs("train", capture), "SCENE and --out")
    assert_one_line(turbogs("train", "train.iterations=2", "--out", tmp_path / "run"), "no such scene")
    for other in ([capture], ["--device", "cpu"]):
        assert_one_line(turbogs("train", *other, "--resume", tmp_path), "nothing else")
    for words in (["eval"], ["render"], ["export"], ["train", "--resume"]):
        assert_one_line(turbogs(*words, tmp_path), "holds no run")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", [["eval", ""], ["train", ".", "--out", ""], ["train", ".", "--out="]])
def test_an_empty_path_is_not_the_current_folder(turbogs, capture, tmp_path, monkeypatch, words):
    monkeypatch.chdir(shutil.copytree(capture, tmp_path / "copy"))
    before = tree(tmp_path)
    assert_one_line(turbogs(*words), "has no value: write one")
    assert tree(tmp_path) == before


@pytest.mark.parametrize(("words", "port"), [("--viewer --out RUN", 8080), ("--out RUN --viewer 9000", 9000)])
def test_a_viewer_has_a_usual_port(turbogs, capture, tmp_path, monkeypatch, words, port):
    def page(host, port, training):
        raise InputError(f"at {host}:{port}")

    monkeypatch.setattr("turbogs_plugin.viewer.server.Page", page)
    call = words.replace("RUN", str(tmp_path / "run")).split()
    assert_one_line(turbogs("train", capture, *QUICK, *call), f"at 127.0.0.1:{port}")


def test_a_run_is_no_capture(turbogs, finished, capture, tmp_path):
    said = f"{finished} is a run's folder: give the capture that it was trained on"
    assert_one_line(turbogs("train", finished, "--out", tmp_path / "run", "--device", "cpu", *QUICK), said)
    assert_one_line(turbogs("plan", finished, "--device", "cpu"), said)
    assert_one_line(turbogs("reconstruct", finished, "--out", tmp_path / "cameras"), said)
    assert not list(tmp_path.iterdir())


def test_a_run_without_or_with_a_broken_checkpoint(turbogs, finished, tmp_path):
    broken = Path(shutil.copytree(finished, tmp_path / "broken"))
    checkpoint = next((broken / "checkpoints").glob("*.pt"))
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    for verb in ("eval", "export"):
        assert_one_line(turbogs(verb, broken), "cannot be used", checkpoint.name)
    shutil.rmtree(broken / "checkpoints")
    before = tree(broken)
    for verb in ("eval", "render", "export"):
        assert_one_line(turbogs(verb, broken), "has no checkpoint", "--scene")
    (broken / "report.md").unlink()
    del before["report.md"]
    assert_one_line(turbogs("train", "--resume", broken), f"'{broken}' is finished", "model.ply")
    assert tree(broken) == before


def test_to_go_on_with_a_finished_run_says_so_and_changes_no_file(turbogs, finished, tmp_path):
    run = Path(shutil.copytree(finished, tmp_path / "run"))
    before = tree(run)
    assert turbogs("train", "--resume", run) == (0, f"{run} is finished: its model is {run / 'model.ply'}\n", "")
    assert tree(run) == before
    (run / "report.md").unlink()
    assert turbogs("train", "--resume", run, "--no-report")[1].endswith("model.ply\n")
    assert turbogs("train", "--resume", run)[0] == 0 and (run / "report.md").is_file(), "what was left to do"


def test_a_run_whose_capture_moved_goes_on_with_another_path(turbogs, finished, capture, tmp_path):
    moved = Path(shutil.copytree(finished, tmp_path / "moved"))
    file = moved / "config.yaml"
    file.write_text(file.read_text().replace(str(capture), str(tmp_path / "gone")))
    (moved / "report.md").unlink()  # so that there is something left to do
    for words in (["eval"], ["render"], ["view"], ["export", "--max-gaussians", 5], ["train", "--resume"]):
        assert_one_line(turbogs(*words, moved), f"{tmp_path / 'gone'} does not exist; '{file}' names it as scene.path")
    file.write_text(file.read_text().replace(str(tmp_path / "gone"), str(capture)))
    assert turbogs("eval", moved)[0] == 0


def test_a_finished_run_is_evaluated_rendered_and_exported(turbogs, finished, tmp_path):
    code, out, _ = turbogs("eval", finished, "--device", "cpu")
    assert code == 0 and re.match(r"view +PSNR +SSIM\nview_000.png +\d+\.\d\d +0\.\d{4}\n", out)
    assert "iteration 2" in out and "LPIPS was not computed" in out and (finished / "metrics.json").is_file()
    code, out, _ = turbogs("render", finished, "--device", "cpu", "--split", "train")
    images = sorted((finished / "renders" / "train").iterdir())
    assert code == 0 and len(images) == 7 and Image.open(images[0]).size == (40, 24)
    code, out, _ = turbogs("export", finished, "--format", "ply", "--out", tmp_path / "mine.ply")
    assert code == 0 and (tmp_path / "mine.ply").read_bytes() == (finished / "model.ply").read_bytes()
    assert_one_line(turbogs("export", finished, "--out", tmp_path / "mine.ply"), "exists")


def test_depth_images_are_in_the_captures_own_units(turbogs, capture, finished):
    """The exported model and the capture's own cameras, which are in these units, give equal depths."""
    code, out, _ = turbogs("render", finished, "--depth", "--device", "cpu")
    folder = finished / "renders" / "test-depth"
    assert code == 0 and str(folder) in out
    loaded, model = captures.load_scene(capture), load_ply(finished / "model.ply")
    cameras, frame = loaded.test.cameras, loaded.frame
    center = torch.from_numpy(frame.center).float()
    assert abs(frame.scale - 1) > 0.1  # or the units show nothing
    cameras.viewmats[:, :3, 3] = cameras.viewmats[:, :3, 3] * frame.scale - cameras.viewmats[:, :3, :3] @ center
    for view, stem in enumerate(distinct_stems(loaded.test.names)):
        depths = np.load(folder / f"{stem}.npy")
        assert depths.dtype == np.float32 and depths.shape == (24, 40)
        expected = render_image(model, cameras, view, with_depth=True).depths.numpy()
        assert np.median(np.abs(depths - expected)) < 1e-4 * np.median(expected)
        assert Image.open(folder / f"{stem}.png").size == (40, 24)


def test_ctrl_c_saves_and_says_how_to_go_on(turbogs, capture, tmp_path, monkeypatch):
    stop_after(monkeypatch, 3)
    code, out, err = turbogs("train", capture, "--out", tmp_path / "run", "--device", "cpu", *TINY)
    assert code == 130 and out == "" and f"turbogs train --resume {tmp_path / 'run'}" in err
    assert (tmp_path / "run/checkpoints/iteration-000003.pt").is_file() and "--trust" not in err
    for verb in ("eval", "render", "export"):
        with pytest.warns(UserWarning, match=f"^{tmp_path}/run is not finished: iteration 3 of 14$"):
            assert turbogs(verb, tmp_path / "run")[0] == 0
    (tmp_path / "mine.py").write_text("from turbogs_plugin.strategies import RandomPixelSampler as Mine\n")
    monkeypatch.chdir(tmp_path)
    words = ("--out", "own", "--device", "cpu", *TINY, "pixel_sampler.type=mine:Mine")
    assert turbogs("train", capture, *words)[2].endswith("turbogs train --resume own --trust\n")


def test_a_run_that_cannot_go_on_is_one_line_and_exit_code_1(turbogs, capture, tmp_path, monkeypatch):
    stop_after(monkeypatch, 1, lambda trainer: trainer.gaussians.opacities.fill_(torch.inf))
    code, out, err = turbogs("train", capture, "--out", tmp_path / "run", "--device", "cpu", *QUICK)
    errors = [line for line in err.splitlines() if line.startswith("turbogs: error:")]
    assert code == 1 and out == "" and len(errors) == 1 and "not finite" in errors[0]


def test_a_reader_that_stops_early_is_no_error():
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "turbogs_plugin"]  # the list of commands
    ended = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False, timeout=120)
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (141, "")


def test_a_run_without_a_report_tells_its_model_and_both_clocks(turbogs, capture, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.version, "cuda", None)
    monkeypatch.setattr(shutil, "which", str)
    options = ("--device", "cpu", "--no-report")
    code, out, err = turbogs("train", capture, "--out", tmp_path / "run", *options, *QUICK)
    assert re.search("\ntraining on the CPU .*--factor 4.*; an NVIDIA GPU is here, .* built without CUDA", err)
    assert code == 0 and not (tmp_path / "run/report.md").exists() and not (tmp_path / "run/report").exists()
    assert (tmp_path / "run/model.ply").is_file() and "report.md" not in out
    assert re.match(r"trained \d+\.\d s, \d+\.\d s on the wall\n", out)
    code, out, _ = turbogs("train", "--resume", tmp_path / "run")
    assert code == 0 and (tmp_path / "run/report.md").is_file() and "report.md" in out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("trian x --out y", "no such command 'trian': did you mean 'train'? (known: ablate, bench, "),
        ("train s --out r --fctor 3", "turbogs train: there is no --fctor: did you mean '--factor'?"),
        ("train --scene s --out r", "turbogs train: there is no --scene: write the SCENE without --scene; see"),
        ("train s --out r --iterations 5", "turbogs train: there is no --iterations: write train.iterations=5; see"),
        ("train s --out r --train.seed=5", "turbogs train: there is no --train.seed: write train.seed=5; see"),
        ("train s --out r --pixel-sampler dense", "there is no --pixel-sampler: write pixel_sampler.type=dense; see"),
        ("ablate parts --out o --time-budget 9s", "ablate: there is no --time-budget: write budget.time=9s; see"),
        ("ablate parts --out o --seed 1", "ablate: there is no --seed: did you mean '--seeds'?"),
        ("plan iterations=5", "'iterations=5' is not of the form section.key=value: write train.iterations=5"),
        ("plan x train.seed 5", "'train.seed' is not of the form section.key=value: write train.seed=VALUE"),
        ("plan pixel_sampler.tpe=dense", "unknown key 'pixel_sampler.tpe': did you mean 'type'?"),
        ("evaluate run", "no such command 'evaluate': did you mean 'eval'?"),
        ("train s --out r --factor abc", "--factor takes only whole numbers; see turbogs train --help"),
        ("train s --out r --device tpu", "'tpu' is none of auto, cpu, cuda; see turbogs train --help"),
        ("ablate parts --scene s --out o --only a train.seed=1", "put changes of settings before --only; see"),
        ("ablate parts --scene s --out o --seeds 0 train.seed=1", "put changes of settings before --seeds; see"),
        ("render r --path orbit", "--path writes a film: name its new file by --out FILE.mp4"),
        ("render r --path orbit --out f.mp4 --depth", "--path writes a film of colours: leave --depth out"),
        ("eval r --factor 2", "--factor is for a model's file with --scene"),
        ("train s --out --factor 2", "--out lacks a value; see turbogs train --help"),
        ("eval", "turbogs eval: it needs RUN|MODEL; see turbogs eval --help"),
        ("doctor x", "turbogs doctor: it takes no 'x'; see turbogs doctor --help"),
    ],
)
def test_words_that_no_command_takes_are_refused_in_a_line(turbogs, words, said):
    assert_one_line(turbogs(*words.split()), said)


@pytest.mark.parametrize("verb", COMMANDS)
def test_every_command_has_help(turbogs, verb):
    code, out, err = turbogs(verb, "--help")
    assert code == 0 and f"usage: turbogs {verb}" in out and err == ""
    code, out, err = turbogs()
    assert code == 0 and f"\n  {verb} " in out and err == ""
    assert turbogs("--version") == (0, f"turbogs {__version__}\n", "")
    assert verb != "train" or {*configuration.config_names()} <= {*re.split(r"[\s,;]+", turbogs("train", "--help")[1])}
