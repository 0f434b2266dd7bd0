"""Processes of a test that form a group of torch.distributed on the CPU. Forked from a server that has torch loaded, so
that a group starts in a second."""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
import torch.distributed

STORES: list[torch.distributed.TCPStore] = []
"""Stores of the latest processes."""

PRELOADED = [
    "torch",
    "torch.fx.experimental.symbolic_shapes",  # and sympy: the first gradient of each process would import them
    *(
        f"turbogs_plugin.{name}"
        for name in ("train.run", "report.run_report", "cli", "strategies.density.error_driven")
    ),
    *("pycolmap", "numpy.ma", "numpy.random", "torch.distributed.launcher.api"),
    "pytest",  # which the module of a test imports
]


def start_ranks(count: int, function: Callable[..., object], folder: Path, *arguments: Any) -> list[Any]:
    """Processes in which `function(*arguments)` runs with torchrun's variables; stderr goes to ``folder/err-RANK``."""
    folder.mkdir(parents=True, exist_ok=True)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    # As torchrun's agent does: the store, at a free port, outlives every process.
    store = torch.distributed.TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)
    shared = (count, store.port, function, folder, arguments)
    processes = [context.Process(target=_rank, args=(rank, *shared)) for rank in range(count)]
    for process in processes:
        process.start()
    STORES[:] = [store]
    return processes


def ended(processes: list[Any], seconds: float = 120.0) -> list[int]:
    """The exit codes of processes; those that do not end in time are killed."""
    end = time.monotonic() + seconds
    for process in processes:
        process.join(max(0.0, end - time.monotonic()))
    late = [process for process in processes if process.is_alive()]
    for process in late:
        process.kill()
        process.join(10.0)
    assert not late, "processes wait for ever"
    return [process.exitcode for process in processes]


def comes_true(condition: Callable[[], bool], seconds: float) -> bool:
    """Wait for a condition; whether it came true in time."""
    give_up = time.monotonic() + seconds
    while not condition() and time.monotonic() < give_up:
        time.sleep(0.01)
    return condition()


def said(folder: Path) -> str:
    """All that the processes wrote to stderr."""
    return "".join(path.read_text() for path in sorted(folder.glob("err-*")))


def _rank(rank: int, count: int, port: int, function: Callable[..., object], folder: Path, arguments: tuple) -> None:
    os.environ.update(RANK=str(rank), WORLD_SIZE=str(count), LOCAL_RANK=str(rank), LOCAL_WORLD_SIZE=str(count))
    os.environ.update(MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port), TORCHELASTIC_USE_AGENT_STORE="True")
    torch.set_num_threads(1)
    error = (folder / f"err-{rank}").open("w")
    os.dup2(error.fileno(), 2)
    sys.stderr = error
    function(*arguments)
    error.flush()


def command_line(words: list[str]) -> None:
    """In a process of its own: the command."""
    from turbogs_plugin import cli

    sys.argv = ["turbogs", *words]
    cli.main()


def grouped() -> Any:
    """This process's `ProcessRanks`, of a gloo group."""
    from turbogs_plugin.distributed.ranks import ProcessRanks

    torch.distributed.init_process_group("gloo", timeout=timedelta(seconds=60))
    return ProcessRanks()
