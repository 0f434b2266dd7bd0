"""A sweep on several GPUs of this machine: a process for each, which share the cells by their claims."""

from __future__ import annotations

import io
import multiprocessing
import os
import signal
import sys
from collections.abc import Sequence
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess

import torch

from turbogs_plugin.device import processor_cores
from turbogs_plugin.distributed.processes import end_with_parent
from turbogs_plugin.errors import InputError, TrainingStopped, exit_code
from turbogs_plugin.study.sweep import SweepOptions, cells_left, run_sweep, written_before

UNFINISHED = 3
"""Exit code of a sweep that `--within` ended, so that a script can call again; and of its workers."""


class _Lines(io.TextIOWrapper):
    """A stream without bars: those of several workers would overwrite each other on a terminal."""

    def isatty(self) -> bool:
        return False


def run_on_gpus(options: SweepOptions, sweep: tuple) -> int:
    """`run_sweep` by a process for each of `options.gpus`; returns when all have ended.

    A worker that is killed takes nothing along but the cell it trained, which another one takes over.

    Args:
        sweep: arguments of `run_sweep`, with these options.

    Returns:
        How many cells are left, for another call, because `options.within` was over.

    Raises:
        InputError: a GPU is not there, or what `run_sweep` raises.
        TrainingStopped: every worker ended without finishing.
    """
    present = torch.cuda.device_count()
    absent = [gpu for gpu in options.gpus if gpu >= present]
    if options.device != "cpu" and absent:
        remedy = f"{present} answer" if present else "none answers; leave it out"
        raise InputError(f"--gpus: there is no GPU {absent[0]}, {remedy}, or see 'turbogs doctor'")
    _, variants, _, _, folder, *_ = sweep
    before = written_before(options, variants, folder)
    context = multiprocessing.get_context("spawn")
    workers = [context.Process(target=_work, args=(options.gpus, place, sweep)) for place in range(len(options.gpus))]
    for worker in workers:
        worker.start()
    try:
        _wait_for(workers)
    finally:
        for worker in workers:
            if worker.is_alive():
                worker.terminate()
            worker.join()
    codes = [worker.exitcode for worker in workers]
    if 2 in codes:  # said by the worker
        sys.stderr.flush()
        raise SystemExit(2)
    if not {0, UNFINISHED} & set(codes):
        raise TrainingStopped("no process of this study lived to its end: the same command goes on")
    return 0 if 0 in codes else cells_left(before, folder)


def _wait_for(workers: Sequence[BaseProcess]) -> None:
    """Until all have ended, or one found the input wrong. One that was killed is told."""
    running = {worker.sentinel: (gpu, worker) for gpu, worker in enumerate(workers)}
    while running:
        for sentinel in wait(list(running)):
            number, worker = running.pop(sentinel)
            worker.join()
            if worker.exitcode == 2:
                return
            if worker.exitcode not in (0, UNFINISHED):
                print(f"worker {number} ended early (code {worker.exitcode}): others take its cells", file=sys.stderr)


def _work(gpus: Sequence[int], place: int, sweep: tuple) -> None:
    """In a process of its own, before CUDA starts. It ends with the one that started it."""
    end_with_parent(multiprocessing.parent_process().is_alive)
    gpu = gpus[place]
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    visible = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
    os.environ["CUDA_VISIBLE_DEVICES"] = visible[gpu] if gpu < len(visible) else str(gpu)
    # Each process with as many threads as there are cores would wait for the others' at every parallel loop.
    torch.set_num_threads(max(1, processor_cores() // len(gpus)))

    # A line at a time, with its end, or those of two workers would stand on one.
    sys.stderr = _Lines(os.fdopen(os.dup(2), "wb"), line_buffering=True)

    def swept() -> int:
        try:
            return UNFINISHED if run_sweep(*sweep) else 0
        except InputError:
            if place == 0:  # it is the same for all, and one says so
                raise
            return 2

    sys.exit(exit_code(swept))
