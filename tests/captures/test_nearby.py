"""Folders and files in a capture, and folders with captures in them: the line names the capture."""

import shutil
from pathlib import Path

import pytest
from helpers.framework_runs import tiny_capture
from PIL import Image

from turbogs_plugin.captures import load_scene
from turbogs_plugin.captures.kinds import holds_photos_alone
from turbogs_plugin.errors import InputError
from turbogs_plugin.reconstruct.photos import read_photos


@pytest.fixture
def capture(tmp_path) -> Path:
    """A COLMAP capture, which has a sparse/0."""
    return tiny_capture(tmp_path / "far/from/others")


def with_poses(folder: Path, name: str = "transforms.json") -> Path:
    """A capture as others see it, with photos; what its file says is not read."""
    (folder / "images").mkdir(parents=True)
    for view in range(4):
        Image.new("RGB", (8, 8)).save(folder / "images" / f"{view}.png")
    (folder / name).write_text("{}")
    return folder


def refusal(path: Path) -> str:
    assert not holds_photos_alone(path)
    with pytest.raises(InputError) as refused:
        load_scene(path)
    return str(refused.value)


@pytest.mark.parametrize("name", ["transforms.json", "transforms_train.json", "poses_bounds.npy"])
def test_photos_of_a_capture(tmp_path, name):
    capture = with_poses(tmp_path / "a/b/capture", name)
    shutil.copytree(capture / "images", capture / "photos/left")
    for part in ("images", "photos/left", "images/0.png", name):
        assert refusal(capture / part) == f"{capture / part} lies in the capture {capture} ({name}): give that folder"


def test_photos_of_a_colmap_capture(capture, monkeypatch):
    for part in ("images", "sparse", "sparse/0", "sparse/0/images.bin"):
        said = f"{capture / part} lies in the capture {capture} (sparse/0): give that folder"
        assert refusal(capture / part) == said
    monkeypatch.chdir(capture / "images")
    assert refusal(Path()) == f". lies in the capture {capture} (sparse/0): give that folder"


@pytest.mark.parametrize("place", ["inner", "datasets/plush"])
def test_a_capture_that_lies_deeper(tmp_path, place):
    inner = with_poses(tmp_path / "x" / place)
    assert refusal(tmp_path / "x") == f"{inner} has a transforms.json: give that folder"


def test_photos_with_their_own_reconstruction_in_them_are_alone(tmp_path):
    """As `turbogs train PHOTOS --out PHOTOS/runs/one` leaves them: the next run finds it there."""
    photos = tmp_path / "a/b/photos"
    photos.mkdir(parents=True)
    for view in range(4):
        Image.new("RGB", (8, 8)).save(photos / f"{view}.png")
    made = shutil.copytree(tiny_capture(tmp_path), photos / "runs/photos-scene")
    (made / "reconstruction").mkdir()
    assert holds_photos_alone(photos)
    with pytest.raises(InputError, match="has 4 photos and nothing that says where"):
        load_scene(photos)


def test_of_several_captures_in_a_folder_a_line_names_all(capture):
    other = shutil.copytree(capture, capture.parent / "second")
    first, second = sorted([capture, other])
    said = f"{first} has a sparse/0, {second} has a sparse/0: give one of these folders"
    assert refusal(capture.parent) == said


@pytest.mark.parametrize("part", ["model.ply", "checkpoints", "report"])
def test_a_run_is_no_folder_of_photos(tmp_path, part):
    run = tmp_path / "run"
    for view in range(4):
        (run / "report").mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (8, 8)).save(run / "report" / f"test-{view:03d}.jpg")
    if part != "report":
        (run / "report").rename(run / "renders")
        (run / part).mkdir()
    assert holds_photos_alone(run)
    (run / "config.yaml").write_text("scene: {path: /data/cup}\n")
    said = f"{run} is a run's folder: give the capture that it was trained on, which its config.yaml names"
    assert refusal(run) == said
    with pytest.raises(InputError) as refused:
        read_photos(run)
    assert str(refused.value) == said
