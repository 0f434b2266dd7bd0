"""Photos and maps that do not fit in host memory: in files, to the same bits; refused where no disk has room."""

import os
import shutil
from pathlib import Path

import pytest
import torch
from helpers.framework_runs import assert_identical, stop_after, tiny_config

from turbogs_plugin.captures import load_scene
from turbogs_plugin.errors import InputError
from turbogs_plugin.plan import facts
from turbogs_plugin.scene import host_arrays
from turbogs_plugin.scene.host_arrays import host_array, in_file
from turbogs_plugin.train import run

HOST_MEMORY = 1000
"""Bytes: less than one photo of the capture takes."""
CPU = torch.device("cpu")


@pytest.fixture
def little_memory(monkeypatch, tmp_path) -> Path:
    """A machine with `HOST_MEMORY`, and the folder in which its files lie."""
    (tmp_path / "disk").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "disk"))
    monkeypatch.setattr(host_arrays.tempfile, "tempdir", None)
    for module in (host_arrays, facts):
        monkeypatch.setattr(module, "free_host_bytes", lambda: HOST_MEMORY)
    return tmp_path / "disk"


def test_an_array_lies_where_there_is_room(little_memory):
    small, large = (host_array((count, 3), torch.int16, "maps") for count in (83, 84))
    assert not in_file(small) and in_file(large) and large.shape == (84, 3) and large.dtype == torch.int16
    assert os.listdir(little_memory) == []  # nothing stays behind, whatever ends the process
    large.copy_(torch.arange(252).view(84, 3))
    host_arrays.read_ahead([large[3:9], small, large[:0]])
    assert torch.equal(large[40:50].clone(), torch.arange(252, dtype=torch.int16).view(84, 3)[40:50])


def test_what_fits_on_no_disk_is_refused(little_memory, monkeypatch):
    monkeypatch.setattr(host_arrays.os, "posix_fallocate", lambda *_: os.truncate("/nowhere", 3))
    with pytest.raises(InputError, match=r"cannot be made in .*No such file.*: set TMPDIR to a folder with more"):
        host_array((2000,), torch.uint8, "12 photos")
    assert os.listdir(little_memory) == []


@pytest.mark.parametrize(
    ("groups", "left"),
    [
        ({}, 8000 * 1024),
        ({"a/memory.max": "max", "memory.max": "5000", "memory.current": "1000"}, 4000),
        ({"a/memory.max": "3000", "a/memory.current": "2900", "a/memory.stat": "anon 2000\ninactive_file 800"}, 900),
        ({"memory.max": "700", "memory.current": "900"}, 0),
    ],
)
def test_free_memory_is_that_of_the_container(monkeypatch, groups, left):
    written = {f"/sys/fs/cgroup/{name}": text for name, text in groups.items()}
    written |= {"/proc/meminfo": "MemTotal: 9000 kB\nMemAvailable: 8000 kB", "/proc/self/cgroup": "1:name=b:/c\n0::/a"}
    monkeypatch.setattr(host_arrays, "_lines", lambda path: written.get(str(path), "").splitlines())
    assert host_arrays.free_host_bytes() == left


def test_a_whole_run_streams_and_resumes_to_the_same_model(capture, little_memory, monkeypatch, tmp_path):
    """What the plan decides; stopped and resumed with little memory, and with much."""
    stop_after(monkeypatch, 7)
    streamed = run.train(tiny_config(capture), tmp_path / "streamed")
    assert streamed.signal and streamed.trainer.config.train.pixels_place == "host"
    assert in_file(streamed.trainer.views.photos.stored)
    assert "> 50% of 0 MiB free on the host: maps in a file" in (tmp_path / "streamed/plan.txt").read_text()
    shutil.copytree(tmp_path / "streamed", tmp_path / "moved")
    resumed = [run.resume(tmp_path / "streamed")]
    assert in_file(resumed[0].trainer.maps.state_dict()["errors"])
    monkeypatch.undo()
    resumed.append(run.resume(tmp_path / "moved"))
    assert not in_file(resumed[1].trainer.maps.state_dict()["errors"])
    assert not in_file(resumed[1].trainer.views.photos.stored)
    whole = run.train(tiny_config(capture), tmp_path / "whole")
    for session in resumed:
        assert_identical(whole.trainer.state_dict(), session.trainer.state_dict())


def test_photos_are_counted_while_they_are_decoded(capture):
    counts = []
    load_scene(capture, progress=lambda *count: counts.append(count))
    assert counts == [(loaded, 8) for loaded in range(1, 9)]
