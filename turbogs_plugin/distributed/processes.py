"""Starting the processes of a training, joining them, and ending all of them when one is lost.

torchrun, or `start` here by the same means, starts a process for each GPU and watches them: when one ends with an
error, it ends the others, and starts all again if asked to (`--max-restarts`). A process that waits for a lost one on
its GPU cannot be told so by Python; the launcher kills it after 30 seconds. Where the launcher itself is lost, the
kernel ends all (`end_with_parent`).
"""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import sys
import traceback
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from typing import Any

import torch

from turbogs_plugin.device import processor_cores
from turbogs_plugin.distributed.ranks import ONE, ProcessRanks, Ranks
from turbogs_plugin.errors import InputError, TrainingStopped, error_line

TIMEOUT = timedelta(hours=6)
"""The longest that processes wait for each other, as while the first one finds cameras, evaluates or saves. A process
that ends is noticed at once."""

MEETING = timedelta(minutes=5)
"""The longest that processes wait for others to be started."""


def launched() -> bool:
    """Whether torchrun, or `start`, started this process beside others."""
    return "RANK" in os.environ and int(os.environ.get("WORLD_SIZE", "1")) > 1


def restarts() -> int:
    """How often torchrun has started the processes again after one was lost."""
    return int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"))


def require_gpus(count: int, device: str) -> None:
    """Raise `InputError` where fewer GPUs answer, unless processes are to train on the CPU."""
    if device != "cpu" and (present := torch.cuda.device_count()) < count:
        remedy = "ask for as many" if present else "leave it out to train on the CPU"
        raise InputError(f"--gpus {count}: {present or 'no'} GPUs answer here; {remedy}, or see 'turbogs doctor'")


def start(count: int, arguments: Sequence[str], device: str = "auto", module: str = "turbogs_plugin") -> int:
    """Start `count` processes of the `turbogs` command on this machine, as torchrun does, and wait for them. Returns
    the exit code: 0, or the code of the process that ended first with an error, which says itself why.

    Args:
        arguments: of the command.
        device: auto, cpu or cuda. On CPUs processes only share the work of tests.
        module: in the place of the command's.

    Raises:
        InputError: fewer GPUs answer.
        TrainingStopped: processes were killed before they could say a word.
    """
    from torch.distributed.elastic.multiprocessing.api import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    require_gpus(count, device)
    logging.getLogger("torch.distributed.elastic").setLevel(logging.CRITICAL)  # the processes say what happened
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, processor_cores() // count)))
    os.environ.setdefault("PYTHONSAFEPATH", "1")  # else "-m" imports modules of the current folder first
    meeting: dict[str, Any] = {"rdzv_backend": "c10d", "rdzv_endpoint": "localhost:0", "local_addr": "localhost"}
    config = LaunchConfig(1, 1, count, run_id=uuid.uuid4().hex, max_restarts=0, monitor_interval=0.1, **meeting)
    try:
        elastic_launch(config, sys.executable)("-m", module, *arguments)
    except ChildFailedError as error:
        rank, failure = error.get_first_failure()
        if all(each.exitcode < 0 for each in error.failures.values()):
            raise TrainingStopped(
                f"process {rank} of this training was killed by signal {-failure.exitcode}: go on from the last "
                "checkpoint with --resume RUN"
            ) from None
        return failure.exitcode if failure.exitcode > 0 else 1
    except SignalException as stopped:
        return 128 + stopped.sigval
    return 0


@contextmanager
def joined(device: str) -> Iterator[Ranks]:
    """While entered, this process belongs to those that train one model; `ONE` where it was started alone. With a GPU
    (`device`: auto, cpu or cuda) it sees only its own.

    An error of one process ends all, and one of them says why: the process that it happened to, or the first one that
    misses another. Raises `InputError`: there are fewer GPUs than processes on this machine, or the processes do not
    find each other."""
    if "TORCHELASTIC_RUN_ID" in os.environ:  # without a launcher, as under Slurm, a shell may go before its time
        end_with_parent()
    if not launched():
        yield ONE
        return
    import torch.distributed as distributed

    on_gpu = device != "cpu" and torch.cuda.device_count() > 0
    if on_gpu:
        _see_own_gpu()
    if sys.platform == "linux" and os.environ.get("LOCAL_WORLD_SIZE") == os.environ.get("WORLD_SIZE"):
        os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")  # on one machine, whatever its name resolves to
    try:
        store, rank, count = next(distributed.rendezvous("env://", timeout=MEETING))
        # torchrun keeps its store, where the addresses of lost processes still are: who read one would wait for ever.
        store = distributed.PrefixStore(f"start {restarts()}", store)
        distributed.init_process_group(
            "cpu:gloo,cuda:nccl" if on_gpu else "gloo", store=store, rank=rank, world_size=count, timeout=TIMEOUT
        )
    except (RuntimeError, ValueError, OSError) as error:
        raise InputError(f"the processes of this training do not find each other: {error}") from None

    def speaks() -> bool:
        try:
            return store.add("errors", 1) == 1
        except RuntimeError:  # whoever keeps the store is gone
            return True

    try:
        yield ProcessRanks()
        with suppress(RuntimeError):  # all is done, whoever has gone already
            distributed.destroy_process_group()
    except (InputError, TrainingStopped, OSError) as error:
        # At once: taking the group down could wait for processes that wait for this one.
        if speaks():
            print(error_line(error), file=sys.stderr, flush=True)
        sys.stdout.flush()
        os._exit(2 if isinstance(error, (InputError, OSError)) else 1)
    except KeyboardInterrupt:
        os._exit(128 + signal.SIGINT)
    except Exception:  # a fault of the program
        traceback.print_exc()
        os._exit(1)


def end_with_parent() -> None:
    """From now on this process is killed when its parent is gone, however that went. Linux only.

    The kernel does it, so it works where the main thread waits for a GPU or for another process. The signal is SIGKILL,
    as SIGTERM would mean to save first, which waits for processes that may be gone.

    To be called in a thread that stays, as the kernel keeps the wish with the thread. It also takes the end of the
    *thread* that started this process for the parent's; launchers wait there for their processes. A parent that was
    lost before is not noticed: processes of such a launcher, which kept their store, end with a line after `MEETING`.
    """
    if sys.platform != "linux":
        return
    parent_ends = 1  # PR_SET_PDEATHSIG of prctl(2)
    ctypes.CDLL(None).prctl(parent_ends, *(ctypes.c_ulong(value) for value in (signal.SIGKILL, 0, 0, 0)))


def _see_own_gpu() -> None:
    """Leave this process the GPU of its place on this machine, as the only one. Before CUDA starts."""
    place, count = int(os.environ.get("LOCAL_RANK", "0")), int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    visible = os.environ.get("CUDA_VISIBLE_DEVICES") or ",".join(map(str, range(torch.cuda.device_count())))
    names = visible.strip(",").split(",")
    if len(names) < count:
        raise InputError(f"{count} processes need as many GPUs on this machine, {len(names)} answer: start fewer")
    os.environ["CUDA_VISIBLE_DEVICES"] = names[place]
    if torch.cuda.device_count() != 1:
        raise InputError("CUDA has started before its time: set CUDA_VISIBLE_DEVICES to one GPU for each process")
