"""`turbogs export`, renders and films: what they write and say, and what they refuse."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.refusals import assert_one_line

from turbogs_plugin.captures import load_scene
from turbogs_plugin.captures.undistort import load_pycolmap
from turbogs_plugin.commands.options import GivenOptions
from turbogs_plugin.engine.render import render_image
from turbogs_plugin.errors import InputError
from turbogs_plugin.export import renders
from turbogs_plugin.export.camera_path import through_views
from turbogs_plugin.export.model_export import EXPORTS, contributions, pruned
from turbogs_plugin.model.formats import FORMATS
from turbogs_plugin.model.ply import load_ply, save_ply
from turbogs_plugin.train.saved_model import load_given, load_model, read_given
from turbogs_plugin.types import SH_C0, WHITE

FILES = list(EXPORTS)
LOSSY = ("spz", "spz2", "splat")


@pytest.mark.parametrize("name", FILES)
def test_an_export_says_bytes_and_what_was_lost(turbogs, finished, tmp_path, name):
    file = tmp_path / f"m.{name.rstrip('2')}"
    code, out, err = turbogs("export", finished, "--format", name, "--out", file)
    assert code == 0, err
    held = sum(4 * value.numel() for _, value in load_ply(finished / "model.ply").items())
    assert f"{held:,} bytes in float32 -> {file.stat().st_size:,} bytes in the file" in out
    before, after = map(float, re.search(r"PSNR   ([\d.]+) -> ([\d.]+) dB on 1 of 1 test views", out).groups())
    assert abs(before - after) < (1 if name in LOSSY else 0.005)
    assert ("version" in out) == (name.rstrip("2") == "spz")


@pytest.mark.parametrize("name", FILES)
def test_a_capture_far_from_its_origin_is_exported_about_another(turbogs, finished, capture, tmp_path, name):
    """UTM metres; the file is found again beside its capture."""
    moved, file = tmp_path / "moved", tmp_path / f"m.{name.rstrip('2')}"
    shutil.copytree(capture, moved)
    model = load_pycolmap().Reconstruction(moved / "sparse/0")
    model.transform(load_pycolmap().Sim3d(1.0, load_pycolmap().Rotation3d(), np.array([5e5, 5.4e6, 300.0])))
    model.write(moved / "sparse/0")
    far, frame = tmp_path / "far.ply", load_scene(moved).frame
    save_ply(load_model(finished, torch.device("cpu")).gaussians, far, frame)
    code, out, err = turbogs("export", far, "--scene", moved, "--format", name, "--out", file)
    assert code == 0 and re.search(r"about the local origin (499|500)\d{3} 5\d{6} \d+", out), (out, err)
    before, after = map(float, re.search(r"PSNR   ([\d.]+) -> ([\d.]+) dB", out).groups())
    assert abs(before - after) < (1 if name in LOSSY else 0.01)
    if name in FORMATS:
        assert (load_given(file, load_scene(moved))[0].means - load_ply(far, frame).means).abs().max() < 1e-3


@pytest.mark.parametrize(("name", "marked"), [("spz", True), ("ply", True), ("glb", False)])
def test_a_file_says_its_model_is_antialiased_or_the_export_does(turbogs, finished, capture, tmp_path, name, marked):
    model, file = load_model(finished, torch.device("cpu")), tmp_path / f"m.{name}"
    save_ply(model.gaussians, tmp_path / "a.ply", model.frame, antialiased=True)
    code, out, err = turbogs("export", tmp_path / "a.ply", "--scene", capture, "--format", name, "--out", file)
    before, after = map(float, re.search(r"PSNR   ([\d.]+) -> ([\d.]+) dB", out).groups())
    assert code == 0 and marked == ("antialiased" not in out) and (marked or before - after > 0.01), (out, err)
    assert not marked or read_given(file)[1]


def test_a_given_model_has_the_background_of_its_photos(capture):
    """As a run on them: a configuration without a plan would have black."""
    assert GivenOptions(scene=capture).settings(()).train.background == "auto"
    assert GivenOptions(scene=capture).settings(("train.background=white",)).train.background == "white"


def test_a_run_whose_capture_is_gone_is_exported_unmeasured(turbogs, finished, capture, tmp_path):
    moved = tmp_path / "moved"
    shutil.copytree(finished, moved)
    text = (moved / "config.yaml").read_text()
    (moved / "config.yaml").write_text(text.replace(str(capture), str(tmp_path / "gone")))
    code, out, _ = turbogs("export", moved, "--format", "spz")
    assert code == 0 and "not measured" in out and (moved / "model.spz").is_file()
    assert_one_line(turbogs("export", moved, "--format", "html"), "gone")
    assert_one_line(turbogs("export", moved, "--max-gaussians", "5", "--out", tmp_path / "a.ply"), "gone")


def test_pruning_keeps_what_adds_most(model, scene):
    """Against a sum by hand: the colour of a Gaussian that alone is white is its weight at each pixel."""
    gaussians, cameras = model.gaussians, scene.train.cameras
    weights = contributions(gaussians, cameras, model.config.raster)
    strongest = int(weights.argmax())
    alone = gaussians.map(torch.clone)
    alone.sh0[:], alone.shN[:] = -10.0, 0.0
    alone.sh0[strongest] = 0.5 / SH_C0
    images = [render_image(alone, cameras, view, settings=model.config.raster).colors for view in range(len(cameras))]
    assert sum(float(image[..., 0].sum()) for image in images) == pytest.approx(float(weights[strongest]), rel=1e-3)
    kept, least = pruned(gaussians, weights, 100), pruned(gaussians, -weights, 100)
    seen = [render_image(part, cameras, 0).alphas.mean() for part in (kept, least)]
    assert len(kept) == 100 and seen[0] > seen[1]


def test_an_export_of_fewer(turbogs, finished, tmp_path):
    code, out, err = turbogs("export", finished, "--max-gaussians", "50", "--out", tmp_path / "few.ply")
    assert code == 0 and len(load_ply(tmp_path / "few.ply")) == 50 and "the 50 of" in out, err
    before = (finished / "model.ply").read_bytes()
    code, out, err = turbogs("export", finished, "--max-gaussians", "40")
    assert code == 0 and len(load_ply(finished / "export.ply")) == 40, err
    assert_one_line(
        turbogs("export", finished, "--max-gaussians", "0", "--out", tmp_path / "b.ply"), "--max-gaussians 0"
    )
    assert (finished / "model.ply").read_bytes() == before


def test_bad_input_is_one_line(turbogs, finished, capture, tmp_path):
    points = tmp_path / "points.ply"
    places = "".join(f"property float {axis}\n" for axis in "xyz")
    points.write_text(f"ply\nformat ascii 1.0\nelement vertex 1\n{places}end_header\n1 2 3\n")
    assert_one_line(turbogs("export", finished, "--format", "obj"), "--format obj", "ply, pt, spz")
    assert_one_line(turbogs("export", tmp_path, "--format", "spz"), "holds no run")
    assert_one_line(turbogs("export", finished, "--format", "html", "--out", tmp_path / "x.md"), "ends in .html")
    call = ("export", points, "--scene", capture, "--format", "spz", "--out")
    assert_one_line(turbogs(*call, tmp_path / "a.spz"), "not a 3DGS model")
    assert_one_line(turbogs(*call, points), "exists")
    assert_one_line(turbogs(*call, tmp_path / "absent" / "a.spz"), "absent")
    assert_one_line(turbogs("export", capture, "--cameras"), "--out FOLDER")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["points.ply"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--path", "orbit", "--out", "a.avi"), ".mp4"),
        (("--path", "nowhere", "--out", "a.mp4"), "--path 'nowhere'"),
        (("--path", "orbit", "--out", "a.mp4", "--seconds", "0"), "--seconds 0"),
        (("--path", "orbit", "--out", "absent/a.mp4"), "absent"),
        (("--path", "orbit"), "--out FILE.mp4"),
        (("--path", "orbit", "--out", "a.mp4", "--depth"), "--depth"),
        (("--seconds", "3"), "--path"),
        (("--path", "orbit", "--out", "a.mp4", "--fps", "0"), "--fps 0"),
        (("--path", "orbit", "--out", "a.mp4", "--size", "640"), "--size '640': write WIDTHxHEIGHT"),
    ],
)
def test_a_film_that_cannot_be_made_is_refused(turbogs, finished, tmp_path, monkeypatch, options, words):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(renders.importlib.util, "find_spec", lambda name: name)
    assert_one_line(turbogs("render", finished, *options), words)
    assert not list(tmp_path.iterdir())


def test_a_film_has_the_background_and_all_of_its_frames_or_is_none(model, scene, tmp_path, monkeypatch):
    ffmpeg, look = pytest.importorskip("imageio_ffmpeg"), replace(model.own_look(), background=WHITE)
    empty = model.gaussians.map(lambda value: value[:0])
    renders.write_film(empty, look, through_views(scene.train.cameras, 3), tmp_path / "a.mp4", 60)
    _, frame, *_ = ffmpeg.read_frames(str(tmp_path / "a.mp4"))
    assert np.frombuffer(frame, dtype=np.uint8).min() > 250
    monkeypatch.setattr(ffmpeg, "count_frames_and_secs", lambda file: (2, 0.1))  # as where a disk is full at the end
    with pytest.raises(InputError, match=r"cannot be encoded \(2 of 3 frames are in it\): is its disk full"):
        renders.write_film(empty, look, through_views(scene.train.cameras, 3), tmp_path / "b.mp4", 60)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


@pytest.mark.parametrize("path", ["orbit", "views", "file"])
def test_a_film(turbogs, finished, tmp_path, path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    if path == "file":
        content = {"w": 33, "h": 24, "fl_x": 30.0, "frames": [{"transform_matrix": np.eye(4).tolist()}] * 2}
        (tmp_path / "path.json").write_text(json.dumps(content))
        path = tmp_path / "path.json"
    video = tmp_path / "a.mp4"
    sized = path == "orbit"
    shape = ["--fps", "30", "--size", "48x30"] if sized else []
    call = ["render", finished, "--path", path, "--out", video, "--seconds", "0.1", *shape, "--device", "cpu"]
    code, out, err = turbogs(*call)
    assert code == 0 and str(video) in out, err
    reader = ffmpeg.read_frames(str(video))
    facts = next(reader)
    assert facts["fps"] == (30 if sized else 60)
    assert facts["size"] == ((48, 30) if sized else (40, 24) if path == "views" else (32, 24))
    frames = [np.frombuffer(frame, dtype=np.uint8) for frame in reader]
    assert len(frames) == (3 if sized else 6)
    if path == "views":
        assert frames[0].std() > 5 and np.abs(frames[0].astype(int) - frames[5]).mean() > 1
