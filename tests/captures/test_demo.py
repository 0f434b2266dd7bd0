"""The demo capture: a COLMAP dataset like any other, the same for a seed, with points where the photos show them."""

from pathlib import Path

import pycolmap
import pytest
import torch
from helpers.refusals import assert_refused

from turbogs_plugin.captures import load_scene, write_demo_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return write_demo_capture(tmp_path_factory.mktemp("demo") / "capture", views=12, width=80, height=60)


def test_points_lie_where_photos_have_their_colour_and_tracks_are_consistent(capture):
    scene = load_scene(capture)
    assert (len(scene.train), len(scene.test)) == (10, 2) and len(scene.points) > 1000
    cameras = scene.train.cameras
    local = scene.points @ cameras.viewmats[4, :3, :3].T + cameras.viewmats[4, :3, 3]
    pixels = local @ cameras.Ks[4].T
    pixels = (pixels[:, :2] / pixels[:, 2:]).floor().long()
    shown = ((pixels >= 0) & (pixels < torch.tensor([80, 60]))).all(dim=1)
    seen = scene.train.photos.image(4)[pixels[shown, 1], pixels[shown, 0]]
    assert (seen - scene.point_colors[shown] / 255).abs().mean(dim=1).median() < 0.05
    model = pycolmap.Reconstruction(capture / "sparse/0")
    assert model.compute_mean_track_length() > 3 and model.compute_mean_reprojection_error() < 0.5
    assert min(point.track.length() for point in model.points3D.values()) >= 2


def test_is_a_function_of_the_seed(tmp_path, capture):
    size = {"views": 12, "width": 80, "height": 60}
    same, other = (write_demo_capture(tmp_path / f"{seed}", seed=seed, **size) for seed in (0, 1))
    for path in sorted(path.relative_to(capture) for path in capture.rglob("*") if path.is_file()):
        equal = (same / path).read_bytes() == (capture / path).read_bytes()
        assert equal, path
    photo = "images/view_003.png"
    assert (other / photo).read_bytes() != (capture / photo).read_bytes()


def test_nothing_is_written_over(tmp_path, capture):
    before = {path: path.stat().st_mtime_ns for path in capture.rglob("*")}
    assert_refused("is there already", write_demo_capture, capture)
    assert {path: path.stat().st_mtime_ns for path in capture.rglob("*")} == before
    assert_refused("at least 3", write_demo_capture, tmp_path / "few", views=2)
    assert not list(tmp_path.iterdir())


def test_on_a_full_disk_it_is_refused_and_leaves_nothing(tmp_path, monkeypatch):
    whole = pycolmap.Reconstruction.write_binary

    def cut(model: pycolmap.Reconstruction, folder: Path) -> None:
        whole(model, folder)
        (folder / "points3D.bin").write_bytes(b"")

    monkeypatch.setattr(pycolmap.Reconstruction, "write_binary", cut)
    words = f"'{tmp_path / 'capture'}' cannot be written whole: make room there"
    assert_refused(words, write_demo_capture, tmp_path / "capture", views=3, width=16, height=12)
    assert not list(tmp_path.iterdir())
