"""What a reconstruction leaves on the disk: whole or not at all, made by one process, and damaged by others."""

import fcntl
import sqlite3
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pycolmap
import pytest
from helpers.refusals import assert_refused
from PIL import Image

from turbogs_plugin.captures import write_demo_capture
from turbogs_plugin.reconstruct import Solution, reconstruct, run, solver
from turbogs_plugin.reconstruct.effort import DOUBLED
from turbogs_plugin.reconstruct.photos import read_photos
from turbogs_plugin.reconstruct.workspace import Workspace

HOLD = "import fcntl, sys; file = open(sys.argv[1], 'r+b'); fcntl.flock(file, 2); print(flush=True); input()"


@pytest.fixture
def photos(tmp_path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for name in "abc":
        Image.new("RGB", (64, 48)).save(folder / f"{name}.jpg")
    return folder


@pytest.fixture
def begun(photos, tmp_path) -> Workspace:
    workspace = Workspace(tmp_path / "scene")
    workspace.begin(read_photos(photos))
    return workspace


def test_a_model_that_a_full_disk_cut_is_no_solution(begun, tmp_path):
    model = pycolmap.Reconstruction(write_demo_capture(tmp_path / "demo", views=3, width=16, height=12) / "sparse/0")
    solution = Solution(begun.scene, 3, 3, model.num_points3D(), [], [])

    class Cut:
        def write_binary(self, folder: Path) -> None:
            model.write_binary(folder)
            with open(folder / "images.bin", "r+b") as file:
                file.truncate(100)

    with pytest.raises(OSError, match="cannot be written whole") as refused:
        begun.finish(Cut(), solution)
    assert refused.value.filename == str(begun.model)
    assert begun.read_solution() is None and not begun.model.exists()
    begun.finish(model, solution)
    assert begun.read_solution() == solution


def test_a_scene_is_made_by_one_process_and_a_killed_one_does_not_hold_it(photos, begun, monkeypatch):
    monkeypatch.setattr(run, "_reconstruct", lambda *_: "made")
    other = subprocess.Popen([sys.executable, "-c", HOLD, begun.listed], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        other.stdout.readline()
        assert_refused("scene' is being made by another process: wait for it", reconstruct, photos, begun.scene)
    finally:
        other.kill()
        other.communicate()
    assert reconstruct(photos, begun.scene) == "made"


def test_calls_for_a_finished_scene_wait_for_each_other(begun, monkeypatch):
    asked = []
    monkeypatch.setattr(fcntl, "flock", lambda file, operation: asked.append(operation))
    for solution in (None, Solution(begun.scene, 3, 3, 1, [], [])):
        monkeypatch.setattr(begun, "read_solution", lambda solution=solution: solution)
        with begun.held():
            pass
    assert asked == [fcntl.LOCK_EX | fcntl.LOCK_NB, fcntl.LOCK_EX]


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_a_damaged_database_is_named_and_left(photos, begun, share):
    """One that is no database, and one that was cut."""
    database = begun.database(DOUBLED)
    with sqlite3.connect(database) as connection:
        connection.execute("CREATE TABLE features (data)")
        connection.execute("INSERT INTO features VALUES (?)", (bytes(50_000),))
    connection.close()
    content = database.read_bytes()
    database.write_bytes(content[: int(share * len(content))] or b"no database")
    for _ in range(2):
        words = f"'{database}' is damaged: delete it and call again"
        assert_refused(words, reconstruct, photos, begun.scene)
    database.unlink()
    assert_refused("none of the 3 photos shows anything", reconstruct, photos, begun.scene)


def test_a_disk_without_room_is_refused_before_features_and_gone_on_with(photos, tmp_path, turbogs, monkeypatch):
    scene = tmp_path / "scene"
    with monkeypatch.context() as patch:
        patch.setattr(solver, "shutil", SimpleNamespace(disk_usage=lambda folder: SimpleNamespace(free=2_000_000)))
        patch.setattr(pycolmap, "extract_features", lambda *_, **__: pytest.fail("features were looked for"))
        code, out, err = turbogs("reconstruct", photos, "--out", scene)
    said = "features and matches of 3 photos need 9 MB, and 2 are free; choose another place or make room"
    assert (code, out) == (2, "") and err.endswith(f"doubled.db': {said}\n") and err.count("\n") == 1
    assert (scene / "images/a.jpg").exists()
    monkeypatch.setattr(run, "_reconstruct", lambda *_: "made")
    assert reconstruct(photos, scene) == "made"


@pytest.mark.parametrize("content", ["5", "[1]", "null", "{"])
def test_a_damaged_list_of_photos_is_not_gone_on_with(photos, begun, content):
    begun.listed.write_text(content)
    assert_refused(r"begun with other photos \(3 new, 0 gone, 0 changed since\)", reconstruct, photos, begun.scene)


@pytest.mark.parametrize(("out", "words"), [("a file", "holds something else"), ("a file/scene", "not a folder")])
def test_a_file_is_no_place_for_a_scene(photos, tmp_path, out, words):
    (tmp_path / "a file").write_text("x")
    assert_refused(words, reconstruct, photos, tmp_path / out)
    assert (tmp_path / "a file").read_text() == "x"
