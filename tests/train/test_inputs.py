"""Input that is refused before the cameras of photos are found, or any photo is decoded."""

from pathlib import Path

import pytest
from helpers.framework_runs import tiny_config

from turbogs_plugin.errors import InputError
from turbogs_plugin.files import require_writable
from turbogs_plugin.train import inputs, run


@pytest.fixture(autouse=True)
def unread(monkeypatch) -> None:
    """Nothing looks at a capture."""

    def opened(*_, **__):
        raise AssertionError("photos are read")

    monkeypatch.setattr(inputs, "load_and_find", opened)


def test_a_model_that_is_not_there_is_missed_before_a_photo_is_read(capture, tmp_path):
    with pytest.raises(InputError, match=r"no such model 'absent\.ply'"):
        run.train(tiny_config(capture, "train.init=absent.ply"), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_folder_that_cannot_be_written_is_not_resumed(capture, tmp_path, monkeypatch):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text(tiny_config(capture).without_plan().to_yaml())

    def refused(folder: Path, given: str) -> None:
        require_writable(folder / "config.yaml" / "file", given)  # whoever runs this may write to any folder

    monkeypatch.setattr(run, "require_writable", refused)
    with pytest.raises(InputError, match=r"what --resume .*run writes cannot be made in .*: choose a folder"):
        run.resume(tmp_path / "run")
