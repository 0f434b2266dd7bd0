"""The command line: bad input is one line on stderr, exit code 2, and nothing written."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
import torch
from helpers.framework_runs import TINY, stop_after
from PIL import Image

from turbogs_plugin import __version__, captures, cli
from turbogs_plugin.engine.rendering import render_image
from turbogs_plugin.export.renders import distinct_stems
from turbogs_plugin.model.ply import load_ply
from turbogs_plugin.train import inputs, run
from turbogs_plugin.train.trainer import Trainer

pytestmark = pytest.mark.usefixtures("plotted")

QUICK = ("train.iterations=2", "train.sh_degree=0", "train.evaluate_at=[]")


@pytest.fixture
def copy(capture, tmp_path) -> Path:
    """A capture to break."""
    return Path(shutil.copytree(capture, tmp_path / "copy"))


@pytest.fixture(scope="module")
def finished(capture, tmp_path_factory) -> Path:
    """A finished run, made by the command itself."""
    folder = tmp_path_factory.mktemp("cli-runs") / "run"
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as end:
        patch.setattr(
            sys, "argv", ["turbogs", "train", *map(str, (capture, "--out", folder, "--device", "cpu", *QUICK))]
        )
        cli.main()
    assert not end.value.code
    return folder


def assert_refused(result: tuple[int, str, str], *words: str) -> None:
    code, out, err = result
    assert code == 2 and out == ""
    assert err.startswith("turbogs: error: ") and err.count("\n") == 1 and err.endswith("\n"), err
    for word in words:
        assert str(word) in err


def tree(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def model_of(capture: Path) -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(str(capture / "sparse" / "0"))


def without_model(capture: Path) -> None:
    (capture / "sparse/0/images.bin").unlink()


def without_images(capture: Path) -> None:
    empty = pycolmap.Reconstruction()
    for camera in model_of(capture).cameras.values():
        empty.add_camera_with_trivial_rig(camera)
    _replace_model(capture, empty)


def _replace_model(capture: Path, model: pycolmap.Reconstruction) -> None:
    for file in (capture / "sparse" / "0").iterdir():
        file.unlink()
    model.write_binary(str(capture / "sparse" / "0"))


def without_six_photos(capture: Path) -> None:
    for path in sorted((capture / "images").iterdir())[2:]:
        path.unlink()


def truncated_photo(capture: Path) -> None:
    path = sorted((capture / "images").iterdir())[1]
    path.write_bytes(path.read_bytes()[:-200])


def photo_of_another_size(capture: Path) -> None:
    path = sorted((capture / "images").iterdir())[1]
    Image.fromarray(np.zeros((20, 20, 3), dtype=np.uint8)).save(path)


def panorama(capture: Path) -> None:
    model = model_of(capture)
    for camera in model.cameras.values():
        camera.model = pycolmap.CameraModelId.EQUIRECTANGULAR
        camera.params = [camera.width, camera.height]
    _replace_model(capture, model)


def two_views(capture: Path) -> None:
    folder = capture.with_name("few")
    shutil.rmtree(capture)
    from turbogs_plugin.captures import write_demo_capture

    write_demo_capture(folder, views=3, width=32, height=32)
    model = model_of(folder)
    model.deregister_frame(max(model.frames))
    folder.rename(capture)
    _replace_model(capture, model)


BROKEN = [
    (without_model, ["copy", "sparse/0 has no images", "bring that file"]),
    (without_images, ["no images"]),
    (without_six_photos, ["6 of 8", "view_002.png", "view_003.png", "bring them back"]),
    (truncated_photo, ["view_001.png"]),
    (photo_of_another_size, ["view_001.png", "20x20", "48x40"]),
    (panorama, ["EQUIRECTANGULAR", "panorama"]),
    (two_views, ["3"]),
]


def test_photos_of_more_pixels_than_pillow_takes_for_harmless(turbogs, capture, monkeypatch):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    code, out, _ = turbogs("plan", capture, "--device", "cpu")
    assert code == 0 and "views of 48x40 pixels" in out


@pytest.mark.parametrize(("damage", "words"), BROKEN, ids=[damage.__name__ for damage, _ in BROKEN])
def test_a_broken_capture_is_refused(turbogs, copy, tmp_path, damage, words):
    damage(copy)
    assert_refused(turbogs("train", copy, "--out", tmp_path / "run", "--device", "cpu", *QUICK), *words)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--max-gaussians", "0"], ["--max-gaussians 0", "at least 1"]),
        (["--config", "turbo"], ["'turbo'", "turbogs-big", "did you mean 'turbogs'"]),
        (["--config", "absent.yaml"], ["absent.yaml"]),
        (["schedule.min_views=9", "schedule.max_views=4"], ["max_views", "9", "4"]),
        (["optimizer.learning_rates.means=-1"], ["means", "-1"]),
        (["train.iteration=1"], ["did you mean 'iterations'"]),
        (["nonsense"], ["section.key=value"]),
        (["scene.test_every=1"], ["test_every"]),
        (["--factor", "0"], ["--factor 0: it must be at least 1"]),
        (["report.lpips_weights=absent.pth"], ["absent.pth"]),
        (["--max-memory", ""], ["--max-memory ''", "leave it out"]),
        (["--time-budget", ""], ["--time-budget ''", "leave it out"]),
        (["scene.path=elsewhere"], ["scene.path", "leave the override out"]),
        (["--time-budget", "nonsense"], ["error: --time-budget 'nonsense' is no amount of time: write 20s"]),
        (["--max-memory", "much"], ["error: --max-memory 'much' is no amount of memory"]),
        (["train.iterations=abc"], ["train.iterations: expected a whole number or auto, got 'abc'"]),
        (["train.iterations="], ["override 'train.iterations=' lacks a value"]),
        (["train.iterations=["], ["override 'train.iterations=[' is not valid YAML"]),
        (["train.iterations=2", "--time-budget", "9s"], ["train.iterations=2 and the time budget 9s exclude"]),
    ],
    ids=lambda value: value[-1] if isinstance(value, list) else None,
)
def test_a_bad_setting_is_refused(turbogs, capture, tmp_path, arguments, words):
    assert_refused(turbogs("train", capture, "--out", tmp_path / "run", "--device", "cpu", *arguments), *words)
    assert not (tmp_path / "run").exists()


def test_no_such_scene(turbogs, tmp_path):
    assert_refused(turbogs("train", tmp_path / "absent", "--out", tmp_path / "run"), "no such scene", "absent")


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has CUDA")
@pytest.mark.parametrize("verb", ["train", "eval", "render"])
def test_cuda_asked_for_and_absent(turbogs, capture, finished, tmp_path, verb):
    arguments = [capture, "--out", tmp_path / "run"] if verb == "train" else [finished]
    assert_refused(turbogs(verb, *arguments, "--device", "cuda"), "CUDA", "--device cpu")
    assert not (tmp_path / "run").exists()


def test_an_output_folder_with_another_run_is_left_alone(turbogs, capture, finished):
    before = tree(finished)
    assert_refused(turbogs("train", capture, "--out", finished, "--device", "cpu", *QUICK), "another run", "--resume")
    assert tree(finished) == before


def test_a_command_to_go_on_is_right_for_folders_with_spaces(turbogs, capture, tmp_path):
    run = tmp_path / "my run"
    run.mkdir()
    (run / "config.yaml").touch()
    assert_refused(turbogs("train", capture, "--out", run, "--device", "cpu", *QUICK), f"--resume '{run}'")


def test_a_name_that_is_not_utf_8_is_refused_before_anything_is_computed(turbogs, capture, tmp_path):
    said = r"'l\udcfct' is not UTF-8, in which reports and configurations are written: rename it"
    assert_refused(turbogs("train", capture, "--out", "l\udcfct", *QUICK), said)


def test_an_output_folder_with_other_files_is_left_alone(turbogs, capture, tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    assert_refused(turbogs("train", capture, "--out", tmp_path, "--device", "cpu", *QUICK), "not empty")
    assert_refused(turbogs("train", capture, "--out", tmp_path / "thesis.tex", *QUICK), "is a file")
    assert_refused(turbogs("train", capture, "--out", tmp_path / "thesis.tex" / "run", *QUICK), "cannot be made")
    assert tree(tmp_path) == {"thesis.tex": b"mine"}


@pytest.mark.parametrize("out", ["/proc/run", "dangling", "dangling/run"])
def test_an_output_folder_that_cannot_be_made_is_refused_before_anything_is_computed(
    turbogs, capture, tmp_path, monkeypatch, out
):
    (tmp_path / "dangling").symlink_to("nowhere")
    monkeypatch.setattr(inputs, "load_and_find", lambda *_, **__: pytest.fail("the capture was loaded"))
    assert_refused(turbogs("train", capture, "--out", tmp_path / out, *QUICK), out, "cannot be made", "choose")
    assert [path.name for path in tmp_path.iterdir()] == ["dangling"]


@pytest.mark.parametrize(
    ("error", "remedy"),
    [
        (OSError(28, "No space left on device"), "error: the system says: No space left on device; choose another"),
        (OSError(28, "No space left on device", "/place"), "choose another place or make room"),
        (FileNotFoundError(2, "No such file or directory", "/place"), "; see that its folder is there, or choose"),
        (OSError(5, "Input/output error", "/place"), "; choose another place\n"),
        (PermissionError(13, "Denied", "/place"), "choose another place or give yourself leave to use it (chmod)"),
    ],
)
def test_what_the_system_refuses_is_one_line(turbogs, tmp_path, monkeypatch, error, remedy):
    def refused(path):
        raise error

    monkeypatch.setattr(captures, "write_demo_capture", refused)
    words = [error.strerror, *filter(None, [error.filename]), remedy]
    assert_refused(turbogs("demo", tmp_path / "demo"), *words)


@pytest.mark.parametrize(
    "order",
    [
        "plan SCENE train.seed=5 --config demo --device cpu train.iterations=7",
        "plan SCENE --config demo train.seed=5 --device cpu train.iterations=7",
        "plan SCENE --config demo --device cpu train.iterations=7 train.seed=5",
        "plan --config demo --device cpu SCENE train.iterations=7 train.seed=5",
    ],
)
def test_overrides_stand_anywhere(turbogs, capture, monkeypatch, order):
    seen = []
    monkeypatch.setattr(
        run, "plan_run", lambda config, processes: seen.append(config.train) or SimpleNamespace(text=str)
    )
    code, _, error = turbogs(*order.replace("SCENE", str(capture)).split())
    assert code == 0, error
    assert [(train.seed, train.iterations) for train in seen] == [(5, 7)]


def test_what_follows_an_option_is_no_override(turbogs, capture, tmp_path):
    (tmp_path / "a.b=c").write_text("mine")
    assert_refused(turbogs("train", capture, "--out", tmp_path / "a.b=c", *QUICK), "a.b=c", "is a file")


@pytest.mark.parametrize(
    ("call", "words"),
    [
        ("report a b --out OUT --psnr -5", ["--psnr -5"]),
        ("report a b --out OUT --psnr 20 nan", ["--psnr 20.0 nan"]),
        ("bench step --photos 3 --size 0 48", ["--size 0 48"]),
        ("bench step --photos 3 --size -5 48", ["--size -5 48"]),
        ("bench step --photos 3 --pixel-budget -1", ["--pixel-budget -1"]),
        ("bench step --photos 3 --pixel-budget inf", ["--pixel-budget inf"]),
        ("bench step --photos 3 --out /proc/x.json", ["--out '/proc/x.json' cannot be made"]),
        ("bench numerics", ["needs --out FOLDER"]),
        ("bench numerics loss.type=charbonnier --out /proc/x", ["takes --device besides"]),
        ("bench raster --rates 0", ["--rates 0"]),
        ("bench raster --rates 0.5 -1", ["--rates 0.5 -1"]),
        ("bench raster --rates nan", ["--rates nan"]),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_numbers_and_places_that_mean_nothing_are_refused(turbogs, tmp_path, call, words):
    assert_refused(turbogs(*call.replace("OUT", str(tmp_path / "out")).split()), *words)
    assert not list(tmp_path.iterdir())


def test_incomplete_and_contradictory_calls(turbogs, capture, tmp_path):
    assert_refused(turbogs("train"), "SCENE")
    assert_refused(turbogs("train", capture), "--out")
    change = "train.iterations=2"
    for call in (["train", "--out", tmp_path / "run", change], ["train", change, "--out", tmp_path / "run"]):
        assert_refused(turbogs(*call), f"train needs a SCENE: '{change}' is a change of a setting")
    assert_refused(turbogs("plan", change), "plan needs a SCENE")
    assert not list(tmp_path.iterdir())
    assert_refused(turbogs("train", capture, "--resume", tmp_path), "nothing else")
    assert_refused(turbogs("train", "--resume", tmp_path, "--device", "cpu"), "nothing else")


def test_an_empty_path_is_not_the_current_folder(turbogs, copy, tmp_path, monkeypatch):
    monkeypatch.chdir(copy)
    before = tree(tmp_path)
    said = "an argument is '': write a value, as . for the current folder, or leave it out"
    assert_refused(turbogs("train", "", "--out", tmp_path / "run", "--device", "cpu", *QUICK), said)
    for verb in ("plan", "eval", "render", "export", "view", "demo", "report"):
        assert_refused(turbogs(verb, ""), said)
    assert_refused(turbogs("reconstruct", "", "--out", tmp_path / "cameras"), said)
    for option in (("--out", ""), ("--out=",)):
        assert_refused(turbogs("train", copy, *option, *QUICK), "--out '': write a value")
    assert_refused(turbogs("plan", copy, "--init", ""), "--init '': write points, random, or a model's file")
    assert tree(tmp_path) == before


@pytest.mark.parametrize("more", [(), QUICK])
def test_a_viewer_takes_a_port(turbogs, copy, tmp_path, more):
    said = "--viewer 'abc': it takes a port, which is a number, or nothing for 8080"
    assert_refused(turbogs("train", copy, "--out", tmp_path / "run", "--viewer", "abc", *more), said)
    assert_refused(turbogs("train", "--resume", tmp_path / "run", "--viewer", "abc"), said)
    assert_refused(
        turbogs("train", "--viewer", tmp_path / "absent", "--out", tmp_path / "run"), "absent does not exist"
    )
    assert not (tmp_path / "run").exists()


def test_a_run_is_no_capture(turbogs, finished, capture, tmp_path):
    said = f"{finished} is a run's folder, not a capture: give {capture}, which it was trained on"
    assert_refused(turbogs("train", finished, "--out", tmp_path / "run", "--device", "cpu", *QUICK), said)
    assert_refused(turbogs("plan", finished, "--device", "cpu"), said)
    assert_refused(turbogs("reconstruct", finished, "--out", tmp_path / "cameras"), said)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("verb", ["eval", "render", "export"])
def test_verbs_without_a_run(turbogs, tmp_path, verb):
    assert_refused(turbogs(verb, tmp_path), "holds no run")
    assert_refused(turbogs("train", "--resume", tmp_path), "holds no run")
    assert not list(tmp_path.iterdir())


def test_a_run_without_or_with_a_broken_checkpoint(turbogs, finished, capture, tmp_path):
    broken = Path(shutil.copytree(finished, tmp_path / "broken"))
    checkpoint = next((broken / "checkpoints").glob("*.pt"))
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    for arguments in (["eval", broken], ["export", broken], ["train", "--resume", broken]):
        assert_refused(turbogs(*arguments), "cannot be used", checkpoint.name)
    shutil.rmtree(broken / "checkpoints")
    before = tree(broken)
    for verb in ("eval", "render", "export"):
        assert_refused(turbogs(verb, broken), "has no checkpoint", f"{broken / 'model.ply'} --scene {capture}")
    assert_refused(turbogs("train", "--resume", broken), f"'{broken}' is finished", "model.ply", "another --out")
    assert tree(broken) == before
    (broken / "model.ply").unlink()
    assert_refused(turbogs("eval", broken), "no checkpoint yet", f"turbogs train --resume {broken}")


def test_to_go_on_with_a_finished_run_says_so_and_changes_no_file(turbogs, finished, tmp_path):
    run = Path(shutil.copytree(finished, tmp_path / "run"))
    before = tree(run)
    assert turbogs("train", "--resume", run) == (0, f"{run} is finished: 2 of 2 iterations\n", "")
    assert tree(run) == before
    (run / "report.md").unlink()
    assert turbogs("train", "--resume", run, "--no-report")[1].endswith("is finished: 2 of 2 iterations\n")
    assert turbogs("train", "--resume", run)[0] == 0 and (run / "report.md").is_file(), "what was left to do"


def without_section(text: str) -> str:
    return text[: text.index("\nbudget:") + 1]


def without_field(text: str) -> str:
    return text.replace("  initial_size: 1.0\n", "")


def without_nested_field(text: str) -> str:
    return re.sub(r"    opacities: .*\n", "", text, count=1)


@pytest.mark.parametrize(
    ("cut", "missing"),
    [
        (without_section, "'budget'"),
        (without_field, "'train.initial_size'"),
        (without_nested_field, "'optimizer.learning_rates.opacities'"),
    ],
)
def test_a_run_whose_configuration_was_cut_is_refused(turbogs, finished, tmp_path, cut, missing):
    broken = Path(shutil.copytree(finished, tmp_path / "broken"))
    text = (broken / "config.yaml").read_text()
    (broken / "config.yaml").write_text(cut(text))
    assert cut(text) != text
    for arguments in (["eval", broken], ["train", "--resume", broken]):
        assert_refused(turbogs(*arguments), "config.yaml", f"lacks {missing}")


def test_a_run_whose_configuration_has_a_wrong_value_is_refused_by_its_file(turbogs, finished, tmp_path):
    run = Path(shutil.copytree(finished, tmp_path / "run"))
    file = run / "config.yaml"
    file.write_text(file.read_text().replace("seed: 0", "seed: -1"))
    for arguments in (["eval", run], ["train", "--resume", run]):
        assert_refused(turbogs(*arguments), f"'{file}': train: seed = -1 is not valid", "bring back")


def test_a_run_whose_capture_moved_says_where_to_tell(turbogs, finished, capture, tmp_path):
    moved = Path(shutil.copytree(finished, tmp_path / "moved"))
    file = moved / "config.yaml"
    file.write_text(file.read_text().replace(str(capture), str(tmp_path / "gone")))
    (moved / "report.md").unlink()  # so that there is something left to do
    for arguments in (["eval", moved], ["render", moved], ["train", "--resume", moved]):
        assert_refused(turbogs(*arguments), tmp_path / "gone", f"edit scene.path in {file}")
    file.write_text(file.read_text().replace(str(tmp_path / "gone"), str(capture)))
    assert turbogs("eval", moved)[0] == 0


def test_renders_keep_the_names_of_photos_apart():
    names = ["a.png", "a.jpg", "b/c.png", "b__c.png", "a-2.png", "d.png"]
    assert distinct_stems(names) == ["a", "a-2", "b__c", "b__c-2", "a-2-2", "d"]


def test_a_finished_run_is_evaluated_rendered_and_exported(turbogs, finished, tmp_path):
    code, out, _ = turbogs("eval", finished, "--device", "cpu")
    assert code == 0 and "view_000.png" in out and "not computed" in out and "iteration 2" in out
    code, out, _ = turbogs("render", finished, "--device", "cpu", "--split", "train")
    images = sorted((finished / "renders" / "train").iterdir())
    assert code == 0 and len(images) == 7 and Image.open(images[0]).size == (48, 40)
    code, out, _ = turbogs("export", finished, "--format", "ply", "--out", tmp_path / "mine.ply")
    assert code == 0 and (tmp_path / "mine.ply").read_bytes() == (finished / "model.ply").read_bytes()
    assert_refused(turbogs("export", finished, "--out", tmp_path / "mine.ply"), "exists")


def test_a_report_links_the_page_only_where_it_is_there(turbogs, finished, tmp_path):
    run = Path(shutil.copytree(finished, tmp_path / "run"))
    assert "](model.html)" not in (run / "report.md").read_text()
    (run / "model.html").touch()
    (run / "report.md").unlink()
    assert turbogs("train", "--resume", run)[0] == 0 and "](model.html)" in (run / "report.md").read_text()


def test_depth_images_are_in_the_captures_own_units(turbogs, capture, finished):
    """As the exported model and the capture's own cameras, which are in these units, give them."""
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
        assert depths.dtype == np.float32 and depths.shape == (40, 48)
        expected = render_image(model, cameras, view, with_depth=True).depths.numpy()
        assert np.median(np.abs(depths - expected)) < 1e-4 * np.median(expected)
        assert Image.open(folder / f"{stem}.png").size == (48, 40)


def test_an_exported_file_that_cannot_be_written_is_refused(turbogs, finished, tmp_path):
    assert_refused(turbogs("export", finished, "--out", tmp_path / "absent" / "mine.ply"), "absent")


def test_the_demo_capture_is_not_written_over(turbogs, tmp_path):
    (tmp_path / "capture").mkdir()
    assert_refused(turbogs("demo", tmp_path / "capture"), "capture")


def test_version(turbogs):
    assert turbogs("--version") == (0, f"turbogs {__version__}\n", "")


def test_doctor(turbogs):
    code, out, _ = turbogs("doctor")
    assert code == 0
    for word in ("torch", "gsplat", "Python", "GPU", "kernels", "nvcc"):
        assert word in out


def test_ctrl_c_saves_and_says_how_to_go_on(turbogs, capture, tmp_path, monkeypatch):
    stop_after(monkeypatch, 3)
    code, out, err = turbogs("train", capture, "--out", tmp_path / "run", "--device", "cpu", *TINY)
    assert code == 130 and out == ""
    assert f"turbogs train --resume {tmp_path / 'run'}" in err
    assert (tmp_path / "run" / "checkpoints" / "latest").read_text() == "iteration-000003.pt"
    monkeypatch.undo()


def test_a_run_that_cannot_go_on_is_one_line_and_exit_code_1(turbogs, capture, tmp_path, monkeypatch):
    step = Trainer.step

    def spoiled(trainer):
        step(trainer)
        trainer.gaussians.opacities[:] = torch.inf

    monkeypatch.setattr(Trainer, "step", spoiled)
    code, out, err = turbogs("train", capture, "--out", tmp_path / "run", "--device", "cpu", *QUICK)
    errors = [line for line in err.splitlines() if line.startswith("turbogs: error:")]
    assert code == 1 and out == "" and len(errors) == 1 and "not finite" in errors[0]


def test_a_reader_that_stops_early_is_no_error():
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "turbogs_plugin.cli", "doctor"]
    ended = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (141, "")


def test_a_run_without_a_report_tells_its_model_and_both_clocks(turbogs, capture, tmp_path):
    options = ("--device", "cpu", "--no-report")
    code, out, _ = turbogs("train", capture, "--out", tmp_path / "run", *options, *QUICK)
    assert code == 0 and not (tmp_path / "run/report.md").exists() and not (tmp_path / "run/report").exists()
    assert (tmp_path / "run/model.ply").is_file() and "report.md" not in out
    assert re.search(r"^trained \d+\.\d s, \d+\.\d s on the wall$", out, re.MULTILINE)
    code, out, _ = turbogs("train", "--resume", tmp_path / "run")
    assert code == 0 and (tmp_path / "run/report.md").is_file() and "report.md" in out
