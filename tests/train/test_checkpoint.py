"""Checkpoints: never half-written, never executed."""

import errno
import os
import pickle
import threading
import zipfile

import pytest
import torch

from turbogs_plugin import files
from turbogs_plugin.errors import InputError, TrainingStopped
from turbogs_plugin.model import torch_file
from turbogs_plugin.train import checkpoint
from turbogs_plugin.train.checkpoint import latest_checkpoint, load_checkpoint, save_checkpoint
from turbogs_plugin.train.history import Evaluation, append_evaluation, read_history


def state(value: float = 1.0) -> dict:
    return {
        "tensors": {"a": torch.full((50, 3), value), "half": torch.ones(3, dtype=torch.float16)},
        "numbers": [1, 2.5, True, None, "text"],
        "pair": (1, 2),
    }


def assert_newest(folder, value: float) -> None:
    assert torch.equal(load_checkpoint(latest_checkpoint(folder))["tensors"]["a"], state(value)["tensors"]["a"])


def test_what_goes_in_comes_out(tmp_path):
    path = save_checkpoint(tmp_path / "new", 7, state())
    assert latest_checkpoint(tmp_path / "new") == path
    loaded = load_checkpoint(path)
    assert loaded["numbers"] == state()["numbers"] and loaded["pair"] == (1, 2)
    assert all(torch.equal(loaded["tensors"][name], value) for name, value in state()["tensors"].items())


@pytest.mark.parametrize("iterations", [(5,), (5, 100), (1, 5, 100), (995_000, 997_500, 1_000_000, 1_002_500)])
def test_only_the_newest_two_stay(tmp_path, iterations):
    """After each save, also from the iteration on that has a digit more."""
    for count, iteration in enumerate(iterations, start=1):
        save_checkpoint(tmp_path, iteration, state(iteration))
        kept = {f"iteration-{number:06d}.pt" for number in iterations[max(0, count - 2) : count]}
        assert {file.name for file in tmp_path.iterdir()} == kept
        assert_newest(tmp_path, iteration)


class DiskFull:
    """Stands for a file on a disk with room for so many bytes."""

    def __init__(self, file, room: int) -> None:
        self.file, self.room = file, room

    def write(self, data) -> int:
        self.room -= len(data)
        if self.room < 0:
            raise OSError(28, "No space left on device")
        return self.file.write(data)

    def __getattr__(self, name):
        return getattr(self.file, name)


@pytest.mark.parametrize("room", [0, 1, 100, 1500, 2500])
def test_a_full_disk_keeps_the_newest_checkpoint(tmp_path, monkeypatch, room):
    save_checkpoint(tmp_path, 1, state(1.0))
    before = sorted(os.listdir(tmp_path))
    whole_write = files.write_atomically

    def limited(path, write, **options):
        whole_write(path, lambda file: write(DiskFull(file, room)), **options)

    monkeypatch.setattr(torch_file, "write_atomically", limited)
    with pytest.raises(TrainingStopped, match=r"iteration 2: .*not be written.*\(No space left on device\).*--resume"):
        save_checkpoint(tmp_path, 2, state(2.0))
    assert sorted(os.listdir(tmp_path)) == before
    assert_newest(tmp_path, 1.0)


class Killed(BaseException):
    """Stands for a kill: nothing after it runs, not even the removal of temporary files."""


@pytest.mark.parametrize("call", range(1, 6))
def test_a_kill_between_any_two_steps_keeps_a_whole_checkpoint(tmp_path, monkeypatch, call):
    save_checkpoint(tmp_path, 1, state(1.0))
    save_checkpoint(tmp_path, 2, state(2.0))
    calls = []

    def killing(module, name):
        original = getattr(module, name)

        def step(*arguments, **options):
            calls.append(name)
            if len(calls) >= call:
                raise Killed
            return original(*arguments, **options)

        monkeypatch.setattr(module, name, step)

    killing(os, "fsync")
    killing(os, "replace")
    killing(files.Path, "unlink")
    try:
        save_checkpoint(tmp_path, 3, state(3.0))
        survived = True
    except Killed:
        survived = False
    monkeypatch.undo()
    assert survived == (call == 5)
    newest = latest_checkpoint(tmp_path)
    assert newest.name in ("iteration-000002.pt", "iteration-000003.pt")
    assert_newest(tmp_path, int(newest.stem[-1]))
    save_checkpoint(tmp_path, 4, state(4.0))
    assert_newest(tmp_path, 4.0)


class Exploit:
    def __reduce__(self):
        return os.mkdir, ("exploited",)


def test_code_in_a_checkpoint_does_not_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save({"format": checkpoint.FORMAT, "x": Exploit()}, "iteration-000001.pt")
    with pytest.raises(InputError, match="cannot be used"):
        load_checkpoint(tmp_path / "iteration-000001.pt")
    (tmp_path / "bare.pt").write_bytes(pickle.dumps(Exploit()))
    with pytest.raises(InputError, match="cannot be used"):
        load_checkpoint(tmp_path / "bare.pt")
    assert not (tmp_path / "exploited").exists()


def test_a_tensor_larger_than_its_storage_is_refused(tmp_path):
    torch.save({"format": checkpoint.FORMAT, "x": torch.zeros(1).expand(2**40)}, tmp_path / "huge.pt")
    with pytest.raises(InputError, match="not stored whole"):
        load_checkpoint(tmp_path / "huge.pt")


def test_a_compressed_archive_is_refused(tmp_path):
    path = save_checkpoint(tmp_path, 1, state())
    bomb = tmp_path / "bomb.pt"
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as target:
        for entry in source.namelist():
            target.writestr(entry, source.read(entry))
    with pytest.raises(InputError, match="compressed"):
        load_checkpoint(bomb)


@pytest.mark.parametrize("keep", [0, 1, 100, 0.5, 0.99])
def test_a_truncated_file_is_refused(tmp_path, keep):
    path = save_checkpoint(tmp_path, 1, state())
    data = path.read_bytes()
    path.write_bytes(data[: keep if isinstance(keep, int) else int(keep * len(data))])
    with pytest.raises(InputError, match=r"cannot be used: .*; train anew with another --out"):
        load_checkpoint(path)
    (tmp_path / "iteration-000000.pt").touch()
    with pytest.raises(InputError, match=r"cannot be used: .*; remove it to go on from iteration-000000\.pt, or"):
        load_checkpoint(path)


def test_an_absent_file_and_another_format_are_refused(tmp_path):
    with pytest.raises(InputError, match="cannot read checkpoint"):
        load_checkpoint(tmp_path / "absent.pt")
    torch.save({"format": 999}, tmp_path / "other.pt")
    with pytest.raises(InputError, match="not a checkpoint of this version"):
        load_checkpoint(tmp_path / "other.pt")


@pytest.mark.parametrize(
    "value", [object(), {1, 2}, torch.nn.Parameter(torch.ones(1)), {"a": [lambda: 0]}, {(1, 2): 3}]
)
def test_only_plain_values_are_saved(tmp_path, value):
    with pytest.raises(TypeError, match=r"state\.x"):
        save_checkpoint(tmp_path, 1, {"x": value})
    assert not list(tmp_path.iterdir())


def test_processes_that_write_the_same_file_do_not_meet(tmp_path, monkeypatch):
    """As those of a study do with its results: each puts its own complete file in place."""
    target = tmp_path / "results.json"

    def write_while_another_does(file):
        with monkeypatch.context() as context:
            context.setattr(files.os, "getpid", lambda: 1)  # which runs, always
            files.write_text_atomically(target, "another's")
        file.write(b"mine")

    files.write_atomically(target, write_while_another_does)
    assert target.read_text() == "mine" and os.listdir(tmp_path) == ["results.json"]


@pytest.mark.skipif(not hasattr(os, "fdatasync"), reason="this system has no fdatasync")
def test_a_large_file_is_brought_to_the_disk_while_it_is_written(tmp_path, monkeypatch):
    """And a failure that only this tells, as systems tell each once, leaves the old file."""
    target, brought = tmp_path / "model", threading.Event()
    bring = os.fdatasync

    def told(descriptor):
        bring(descriptor)
        brought.set()

    def write(file):
        file.write(b"new")
        assert brought.wait(60)

    monkeypatch.setattr(os, "fdatasync", told)
    files.write_atomically(target, write, large=True)
    assert target.read_bytes() == b"new"

    def full(descriptor):
        brought.set()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    brought.clear()
    monkeypatch.setattr(os, "fdatasync", full)
    with pytest.raises(OSError, match="No space left") as failed:
        files.write_atomically(target, lambda file: (write(file), file.write(b"er")), large=True)
    assert failed.value.filename == str(target)
    assert target.read_bytes() == b"new" and os.listdir(tmp_path) == ["model"]


@pytest.mark.parametrize("cut", ['{"iteration": 1', '{"iteration": 1\n', "\0\0\0\n", "\n"])
def test_a_last_line_that_was_cut_is_left_out_of_a_history(tmp_path, cut):
    path, entry = tmp_path / "history.jsonl", Evaluation(0, 0.0, 9.0, 0.1, 0.1, 5, 0)
    append_evaluation(path, entry)
    whole = path.read_text()
    path.write_text(whole + cut)
    assert [kept.iteration for kept in read_history(path)] == [0]
    path.write_text(f"{cut.rstrip()}\n{whole}")
    with pytest.raises(InputError, match=r"history\.jsonl' line 1 is not an evaluation: take that line out"):
        read_history(path)
