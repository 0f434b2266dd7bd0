"""Input that is refused before the cameras of photos are found, or any photo is decoded."""

from pathlib import Path

import pytest
from helpers.framework_runs import tiny_config
from PIL import Image

from turbogs_plugin.errors import InputError
from turbogs_plugin.files import require_writable
from turbogs_plugin.train import run


@pytest.fixture(autouse=True)
def unread(monkeypatch) -> None:
    """Nothing looks at a capture."""

    def opened(*_, **__):
        raise AssertionError("photos are read")

    monkeypatch.setattr(run, "open_scene", opened)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("budget.max_memory=2GiB", "--max-memory limits the memory of a GPU, and this run would be on a CPU: leave"),
        ("train.init=absent.ply", "no such model 'absent.ply'"),
    ],
)
@pytest.mark.parametrize("begin", [run.plan_run, run.train])
def test_what_needs_no_photo(capture, tmp_path, begin, override, words):
    with pytest.raises(InputError, match=words):
        begin(tiny_config(capture, override), *([tmp_path / "run"] if begin is run.train else []))
    assert not (tmp_path / "run").exists()


def test_a_factor_for_which_photos_are_too_small_is_refused_before_they_are_reconstructed(tmp_path, monkeypatch):
    monkeypatch.setattr("turbogs_plugin.reconstruct.run.reconstruct", None)
    photos = tmp_path / "walk"
    photos.mkdir()
    for number in range(3):
        Image.new("RGB", (40, 24)).save(photos / f"{number}.png")
    with pytest.raises(InputError, match=r"--factor 10 leaves too little of photos of 40x24.* is 6"):
        run.train(tiny_config(photos, "scene.factor=10"), tmp_path / "run")
    assert [entry.name for entry in tmp_path.iterdir()] == ["walk"]


def test_a_folder_that_cannot_be_written_is_not_resumed(capture, tmp_path, monkeypatch):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text(tiny_config(capture).without_plan().to_yaml())

    def refused(folder: Path, given: str) -> None:
        require_writable(folder / "config.yaml" / "file", given)  # whoever runs this may write to any folder

    monkeypatch.setattr(run, "require_writable", refused)
    with pytest.raises(InputError, match=r"what --resume .*run writes cannot be made in .*: choose a folder"):
        run.resume(tmp_path / "run")
