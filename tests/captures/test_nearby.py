"""Photos of a capture or of a run: the line names what to give instead."""

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


def refusal(path: Path) -> str:
    assert not holds_photos_alone(path)
    with pytest.raises(InputError) as refused:
        load_scene(path)
    return str(refused.value)


def test_photos_of_a_colmap_capture(capture, monkeypatch):
    photos = capture / "images"
    assert refusal(photos) == f"{photos} lies in the capture {capture}: give that folder"
    monkeypatch.chdir(photos)
    assert refusal(Path()) == f". lies in the capture {capture}: give that folder"


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
