"""Runs of several processes that stop, break or go on with another number: one line, the last good checkpoint."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from helpers.framework_runs import ENDLESS, TINY, assert_identical, saved, tiny_config
from helpers.processes import PRELOADED, comes_true, command_line, ended, said, start_ranks
from torch.distributed.launcher.api import LaunchConfig, elastic_launch

from turbogs_plugin.config.configuration import Config
from turbogs_plugin.distributed import processes as distributed_processes
from turbogs_plugin.distributed.processes import joined
from turbogs_plugin.distributed.ranks import ProcessRanks
from turbogs_plugin.train import run
from turbogs_plugin.train.checkpoint import latest_checkpoint, load_checkpoint
from turbogs_plugin.train.history import read_history
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.train.wall import WallRecord

EXCHANGES = ("agree", "gather_numbers", "broadcast", "exchange")
MOMENTS = 60
"""A tiny run has more exchanges: four of its maps, four and more of each of its 14 iterations."""
SECONDS = 30.0
"""All processes of a training have ended so long after one of them was lost."""


def training(config: Config, out: Path, trouble: str) -> None:
    """In every process: a run, with trouble in one of them."""
    with joined("cpu") as ranks:
        last = ranks.rank == ranks.count - 1
        step = Trainer.step

        def without_memory(trainer: Trainer) -> None:
            if trainer.iteration == 4:
                raise torch.cuda.OutOfMemoryError("CUDA out of memory")
            step(trainer)

        def interrupted(trainer: Trainer) -> None:
            if trainer.iteration == 5:
                signal.raise_signal(signal.SIGTERM)
            step(trainer)

        def full(trainer: Trainer) -> None:
            """No file of this process may be longer than half a checkpoint: a write breaks in its middle."""
            if trainer.iteration == 4:
                size = latest_checkpoint(out / "checkpoints").stat().st_size
                resource.setrlimit(resource.RLIMIT_FSIZE, (size // 2, size // 2))
            step(trainer)

        def killed_at_an_exchange(number: int) -> None:
            """This process is killed before its exchange of this number."""
            calls = itertools.count()

            def struck() -> None:
                if next(calls) == number:
                    os.kill(os.getpid(), signal.SIGKILL)

            for name in EXCHANGES:
                method = getattr(ProcessRanks, name)
                setattr(ProcessRanks, name, lambda *given, method=method, **more: struck() or method(*given, **more))

        if trouble in ("memory", "signal") and last:
            Trainer.step = without_memory if trouble == "memory" else interrupted
        if trouble == "disk" and ranks.first:
            Trainer.step = full
        if trouble.startswith("killed at") and ranks.rank == int(trouble[-1]) % ranks.count:
            killed_at_an_exchange(random.Random(int(trouble[-1])).randrange(MOMENTS))
        session = run.resume(out, ranks=ranks) if out.exists() else run.train(config, out, ranks=ranks)
    if session.signal:
        sys.stderr.flush()
        os._exit(128 + session.signal)


def trained(count: int, folder: Path, capture: Path, trouble: str = "", *overrides: str) -> tuple[list[int], str]:
    """(exit codes, what all said) of a training in `folder`, the run in ``folder/run``."""
    config = tiny_config(capture, *overrides)
    codes = ended(start_ranks(count, training, folder, config, folder / "run", trouble), 120)
    return codes, said(folder)


def the_error(text: str) -> str:
    """The one line with the word."""
    (line,) = [line for line in text.splitlines() if "error" in line.lower()]
    return line


def test_a_run_goes_on_with_another_number_of_processes(capture, tmp_path):
    """From iteration 10 of a run of two, which leaves what one process leaves. One and four processes take it to the
    end, and two to equal bits."""
    codes, text = trained(2, tmp_path, capture, "", "train.checkpoint_every=10")
    assert codes == [0, 0], text
    of_two = tmp_path / "run"
    assert [evaluation.iteration for evaluation in read_history(of_two / "history.jsonl")] == [0, 7, 14]
    assert (of_two / "model.ply").is_file() and (of_two / "wall.json").is_file()
    later, finals = {}, {}
    for count in (1, 2, 4):
        folder = tmp_path / str(count)
        shutil.copytree(of_two, folder / "run")
        (folder / "run/checkpoints/iteration-000014.pt").unlink()
        config = folder / "run/config.yaml"
        config.write_text(config.read_text().replace("checkpoint_every: 10", "checkpoint_every: 13"))
        if count == 1:
            run.resume(folder / "run")
        else:
            codes, text = trained(count, folder, capture)
            assert codes == [0] * count, text
        later[count], finals[count] = (
            load_checkpoint(folder / f"run/checkpoints/iteration-0000{number}.pt")["trainer"] for number in (13, 14)
        )
    whole = saved(of_two)
    assert_identical(finals[2], whole)
    for count in (1, 4):
        assert len(finals[count]["gaussians"]["means"]) == len(whole["gaussians"]["means"])
        assert torch.equal(later[count]["maps"]["stamps"], later[2]["maps"]["stamps"])


@pytest.mark.parametrize("seed", [1, 4, 5])  # exchanges 8, 15 and 39
def test_a_process_killed_at_a_random_moment_ends_all_with_one_line(seed, capture, tmp_path):
    """Before maps are whole, between two exchanges of an iteration, in an event or a comparison of the replicas."""
    folder, lost = tmp_path / "run/checkpoints", seed % 2
    processes = start_ranks(2, training, tmp_path, tiny_config(capture), tmp_path / "run", f"killed at {seed}")
    codes = ended(processes, SECONDS)
    assert codes[lost] == -signal.SIGKILL and codes[1 - lost] == 1, said(tmp_path)
    line = the_error(said(tmp_path))
    assert "another process of this training ended" in line
    newest = latest_checkpoint(folder)
    if newest is not None:
        assert f"the last good checkpoint is '{newest}'" in line
        assert load_checkpoint(newest)["trainer"]["iteration"] in (5, 10)


TROUBLES = {
    "memory": "iteration 4: the device's memory was too small",
    "disk": "iteration 6: the checkpoint could not be written",
}


@pytest.mark.parametrize("trouble", TROUBLES)
def test_trouble_of_one_process_ends_all_with_its_own_line(trouble, capture, tmp_path):
    codes, text = trained(2, tmp_path, capture, trouble, "train.checkpoint_every=3")
    assert set(codes) <= {1, 2}, (codes, text)
    line = the_error(text)
    assert TROUBLES[trouble] in line and "turbogs: error:" in line
    newest = latest_checkpoint(tmp_path / "run/checkpoints")
    assert f"the last good checkpoint is '{newest}'" in line and newest.name == "iteration-000003.pt"
    assert load_checkpoint(newest)["trainer"]["iteration"] == 3


def test_a_signal_to_one_process_stops_and_saves_all(capture, tmp_path):
    codes, text = trained(2, tmp_path, capture, "signal", *ENDLESS)
    assert codes == [128 + signal.SIGTERM] * 2, text
    state = saved(tmp_path / "run")
    assert 6 <= state["iteration"] <= 12


def lost_once(words: list[str]) -> None:
    """In every process that torchrun's agent starts: the command, which at first one of them does not survive."""
    step = Trainer.step

    def killed(trainer: Trainer) -> None:
        if trainer.iteration == 7:
            os.kill(os.getpid(), signal.SIGKILL)
        step(trainer)

    if os.environ["RANK"] == "1" and os.environ["TORCHELASTIC_RESTART_COUNT"] == "0":
        Trainer.step = killed
    with pytest.raises(SystemExit) as end:
        command_line(words)
    assert not end.value.code, end.value.code


def joining_twice() -> None:
    """In every process: joined anew by the launcher's store, which still has the addresses of the first time."""
    for attempt in ("0", "1"):
        os.environ["TORCHELASTIC_RESTART_COUNT"] = attempt
        time.sleep(0.5 * int(os.environ["RANK"]))  # the first process looks before the second one has told its own
        with joined("cpu") as ranks:
            assert ranks.agree(attempt) == attempt


def test_processes_that_start_again_do_not_call_at_old_addresses(tmp_path):
    assert ended(start_ranks(2, joining_twice, tmp_path), 60.0) == [0, 0], said(tmp_path)


@pytest.fixture
def handlers() -> Iterator[None]:
    """Handlers of signals are set back: torchrun's agent sets its own, and leaves them."""
    asked = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
    before = {number: signal.getsignal(number) for number in asked}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_torchrun_starts_a_lost_run_again_from_its_checkpoint(capture, tmp_path, handlers):
    """By the agent of torchrun, in this process; its processes are forked, where torchrun's begin with Python."""
    multiprocessing.get_context("forkserver").set_forkserver_preload(PRELOADED)
    endpoint = {"rdzv_backend": "c10d", "rdzv_endpoint": "localhost:0", "local_addr": "localhost"}
    times = {"max_restarts": 1, "monitor_interval": 0.1}
    config = LaunchConfig(1, 1, 2, run_id="restart", start_method="forkserver", **endpoint, **times)
    run_folder = tmp_path / "run"
    words = ["train", str(capture), "--out", str(run_folder), "--device", "cpu", "--no-report", *TINY, *ENDLESS[2:]]
    words += ["train.iterations=10", "schedule.max_views=2"]
    elastic_launch(config, lost_once)(words)
    assert read_history(run_folder / "history.jsonl")[-1].iteration == 10
    assert WallRecord.read(run_folder / "wall.json").wall_seconds is None, "no process was lost"


def test_a_launcher_returns_the_code_of_its_processes(tmp_path, monkeypatch, handlers):
    """What `--gpus 2` calls, with processes that load no torch. That command itself trains in the last test here."""
    (tmp_path / "ending.py").write_text("import os, sys; sys.exit(int(sys.argv[1]) * int(os.environ['RANK']))")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    assert [distributed_processes.start(2, [code], "cpu", "ending") for code in ("0", "2")] == [0, 2]


def state(process: int) -> tuple[str, int]:
    """(letter, parent) of a process; X where there is none. One that ended and was not yet waited for is a Z."""
    try:
        words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return "X", 0
    return words[0], int(words[1])


def running(processes: list[int]) -> list[int]:
    return [process for process in processes if state(process)[0] not in "XZ"]


@pytest.mark.skipif(sys.platform != "linux", reason="by a call of Linux")
def test_processes_of_a_training_end_with_their_launcher(capture, tmp_path):
    """A launcher that is killed outright, as by the kernel when memory is short: nothing that it started goes on.

    One process hangs then, as in a call of a GPU, and hears nothing but SIGKILL; the other waits for it.
    """
    checkpoints = tmp_path / "run/checkpoints"
    words = ["train", str(capture), "--out", str(tmp_path / "run"), "--gpus", "2", "--device", "cpu", "--no-report"]
    words += [*TINY, *ENDLESS]
    with (tmp_path / "told").open("w") as told:
        command = [sys.executable, "-m", "turbogs_plugin", *words]
        launcher = subprocess.Popen(command, stdout=told, stderr=told, start_new_session=True)
    processes: list[int] = []
    try:
        assert comes_true(lambda: latest_checkpoint(checkpoints) or launcher.poll() is not None, 2 * SECONDS)
        everybody = sorted(int(path.name) for path in Path("/proc").glob("[0-9]*"))
        processes = [process for process in everybody if state(process)[1] == launcher.pid]
        assert launcher.poll() is None and len(processes) >= 2, (tmp_path / "told").read_text()
        os.kill(processes[-1], signal.SIGSTOP)
        launcher.kill()
        launcher.wait()
        assert comes_true(lambda: not running(processes), 2 * SECONDS)
    finally:
        launcher.kill()
        launcher.wait()
        for process in running(processes):
            os.kill(process, signal.SIGKILL)
    newest = latest_checkpoint(checkpoints)
    iteration = load_checkpoint(newest)["trainer"]["iteration"]
    assert iteration >= 3 and newest.name == f"iteration-{iteration:06d}.pt"
