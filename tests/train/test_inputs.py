"""Input that is refused before the cameras of photos are found, or any photo is decoded."""

from pathlib import Path

import pytest
from helpers.framework_runs import tiny_config

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


def test_a_folder_that_cannot_be_written_is_not_resumed(capture, tmp_path, monkeypatch):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text(tiny_config(capture).without_plan().to_yaml())

    def refused(folder: Path, given: str) -> None:
        require_writable(folder / "config.yaml" / "file", given)  # whoever runs this may write to any folder

    monkeypatch.setattr(run, "require_writable", refused)
    with pytest.raises(InputError, match=r"what --resume .*run writes cannot be made in .*: choose a folder"):
        run.resume(tmp_path / "run")
