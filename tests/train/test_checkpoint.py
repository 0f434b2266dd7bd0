"""Checkpoints: never half-written, never executed."""

import os
import pickle
import resource
import zipfile
from contextlib import nullcontext
from pathlib import Path

import pytest
import torch
from helpers.framework_runs import assert_identical
from helpers.refusals import assert_refused

from turbogs_plugin import files
from turbogs_plugin.errors import TrainingStopped
from turbogs_plugin.train import checkpoint
from turbogs_plugin.train.checkpoint import latest_checkpoint, load_checkpoint, save_checkpoint


def state(value: float = 1.0) -> dict:
    return {
        "tensors": {"a": torch.full((50, 3), float(value)), "half": torch.ones(3, dtype=torch.float16)},
        "numbers": [1, 2.5, True, None, "text"],
        "pair": (1, 2),
    }


def assert_newest(folder, value: float) -> None:
    assert_identical(load_checkpoint(latest_checkpoint(folder)), state(value))


@pytest.mark.parametrize("iterations", [(5,), (5, 100), (1, 5, 100), (995_000, 997_500, 1_000_000, 1_002_500)])
def test_only_the_newest_two_stay(tmp_path, iterations):
    """After each save, also from the iteration on that has a digit more."""
    for count, iteration in enumerate(iterations, start=1):
        save_checkpoint(tmp_path, iteration, state(iteration))
        kept = {f"iteration-{number:06d}.pt" for number in iterations[max(0, count - 2) : count]}
        assert {file.name for file in tmp_path.iterdir()} == kept
        assert_newest(tmp_path, iteration)


@pytest.mark.parametrize("room", [0, 1, 100, 1500, 2500])
def test_a_disk_that_refuses_keeps_the_newest_checkpoint(tmp_path, room):
    save_checkpoint(tmp_path, 1, state(1.0))
    before, limits = sorted(os.listdir(tmp_path)), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, limits[1]))
    try:
        with pytest.raises(TrainingStopped, match=r"iteration 2: .*not be written.*\(File too large\).*--resume"):
            save_checkpoint(tmp_path, 2, state(2.0))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
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
    with nullcontext() if call == 5 else pytest.raises(Killed):
        save_checkpoint(tmp_path, 3, state(3.0))
    monkeypatch.undo()
    newest = latest_checkpoint(tmp_path)
    assert newest.name in ("iteration-000002.pt", "iteration-000003.pt")
    assert_newest(tmp_path, int(newest.stem[-1]))
    save_checkpoint(tmp_path, 4, state(4.0))
    assert_newest(tmp_path, 4.0)


class Exploit:
    def __reduce__(self):
        return os.mkdir, ("exploited",)


def compressed(file: Path) -> None:
    whole = save_checkpoint(file.parent, 1, state())
    with zipfile.ZipFile(whole) as source, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as target:
        for entry in source.namelist():
            target.writestr(entry, source.read(entry))


REFUSED = {
    "code": (lambda file: torch.save({"format": checkpoint.FORMAT, "x": Exploit()}, file), "cannot be used"),
    "code, protocol 4": (lambda file: torch.save({"x": Exploit()}, file, pickle_protocol=4), "more than plain tensors"),
    "a bare pickle": (lambda file: file.write_bytes(pickle.dumps(Exploit())), "cannot be used"),
    "a tensor larger than its storage": (
        lambda file: torch.save({"format": checkpoint.FORMAT, "x": torch.zeros(1).expand(2**40)}, file),
        "not stored whole",
    ),
    "a compressed archive": (compressed, "compressed"),
    "no file": (lambda file: None, "cannot read checkpoint"),
    "another format": (lambda file: torch.save({"format": 999}, file), "not a checkpoint of this version"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_no_checkpoint_is_refused_and_runs_nothing(tmp_path, monkeypatch, what):
    monkeypatch.chdir(tmp_path)
    write, words = REFUSED[what]
    write(tmp_path / "hostile.pt")
    assert_refused(words, load_checkpoint, tmp_path / "hostile.pt")
    assert not (tmp_path / "exploited").exists()


@pytest.mark.parametrize("keep", [0, 1, 100, 0.5, 0.99])
def test_a_truncated_file_is_refused(tmp_path, keep):
    path = save_checkpoint(tmp_path, 1, state())
    data = path.read_bytes()
    path.write_bytes(data[: keep if isinstance(keep, int) else int(keep * len(data))])
    assert_refused(r"cannot be used: .*; train anew with another --out", load_checkpoint, path)
    (tmp_path / "iteration-000000.pt").touch()
    assert_refused(r"cannot be used: .*; remove it to go on from iteration-000000\.pt, or", load_checkpoint, path)


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
