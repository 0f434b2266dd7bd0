"""The processes that train one model together: who they are, and what they tell each other on the host.

`Ranks` is one process alone, for which everything here does nothing; `ProcessRanks` are those that torchrun started.
"""

from __future__ import annotations

import functools
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import torch
from torch import Tensor

from turbogs_plugin.engine import Engine, engine_of
from turbogs_plugin.errors import TrainingStopped

Value = TypeVar("Value")


class RankLost(TrainingStopped):
    """Another process of the training ended or does not answer."""


class Ranks:
    """One process.

    Attributes:
        rank: number of this process.
        count: number of processes.
        stop_signal: number of the signal by which all stop, as far as they know; 0: none.
    """

    rank = 0
    count = 1
    stop_signal = 0

    @property
    def first(self) -> bool:
        """Whether this process writes, prints and evaluates."""
        return self.rank == 0

    def agree(self, value: Value) -> Value:
        """The first process's value, on all."""
        return value

    def ask_to_stop(self, signal: int) -> bool:
        """Ask that all stop. False: there are no others, so the caller stops by itself."""
        return False

    def engine(self, device: torch.device) -> Engine:
        """The engine of a training on this process's device, together with the others'."""
        return engine_of(device, for_training=True)

    def meet(self, device: torch.device) -> None:
        """Connect the processes' GPUs, so that no exchange waits for it: NCCL takes up to half a second. Every process
        must call this, and waits for the others. Another thread may exchange what lies on the host meanwhile.

        Args:
            device: of the training; where it is a CPU, nothing is left to connect.
        """

    @contextmanager
    def working(self) -> Iterator[None]:
        """While entered, this process does something long that no iteration shows, such as writing a checkpoint."""
        yield


ONE = Ranks()
"""A process that trains alone."""


def _answered(method: Callable[..., Value]) -> Callable[..., Value]:
    """Raise `RankLost` where another process does not answer."""

    @functools.wraps(method)
    def answered(self: ProcessRanks, *arguments: Any, **options: Any) -> Value:
        try:
            return method(self, *arguments, **options)
        except torch.cuda.OutOfMemoryError:
            raise
        except RuntimeError as error:  # gloo's and NCCL's errors are of this kind
            text = re.sub(r"\[/[^]]*\] *", "", str(error)).strip()  # without places in torch's sources
            reason = re.split(r"\. |\n", text)[0][:200] or type(error).__name__
            raise RankLost(f"another process of this training ended or does not answer ({reason})") from error

    return answered


class ProcessRanks(Ranks):
    """The processes of torch's default group, which is initialised.

    Tensors travel by the backend of their device: NCCL on GPUs, gloo on CPUs.

    Args:
        gpu: number of this process's GPU among those that it sees.

    Attributes:
        asked: number of the signal by which this process wants all to stop; 0: none.
        latest: `time.monotonic` of the latest sign of progress; infinite while `working`.
        reads_peers: all processes may use each other's memory in place, as far as they have tried.
    """

    def __init__(self, gpu: int = 0) -> None:
        import torch.distributed as distributed

        self._distributed, self._gpu = distributed, gpu
        # Newer versions of torch have another name for it, and warn of the old one.
        self._all_gather = getattr(distributed, "all_gather_single", None) or distributed.all_gather_into_tensor
        self.rank, self.count = distributed.get_rank(), distributed.get_world_size()
        self.stop_signal = self.asked = 0
        self.latest = time.monotonic()
        self.reads_peers = True

    @_answered
    def agree(self, value: Value) -> Value:
        box = [value]
        self._distributed.broadcast_object_list(box, src=0, device=torch.device("cpu"))
        return box[0]

    @_answered
    def gather_numbers(self, values: list[int]) -> list[list[int]]:
        """Integers of every process, equally many of each; rank after rank."""
        own = torch.tensor(values, dtype=torch.int64)
        parts = [torch.empty_like(own) for _ in range(self.count)]
        self._distributed.all_gather(parts, own)
        return [part.tolist() for part in parts]

    @_answered
    def broadcast(self, tensor: Tensor, source: int = 0) -> None:
        """Overwrite a contiguous tensor by rank `source`'s."""
        self._distributed.broadcast(tensor, src=source)

    @_answered
    def gather(self, tensor: Tensor, gathered: Tensor | None = None) -> Tensor:
        """[count, ...]: the tensors of all processes, of one shape, rank after rank. `gathered`: to be overwritten."""
        if gathered is None:
            gathered = tensor.new_empty(self.count, *tensor.shape)
        self._all_gather(gathered.flatten(0, 1), tensor)
        return gathered

    @_answered
    def send_and_receive(self, sent: list[tuple[int, Tensor]], received: list[tuple[int, Tensor]]) -> None:
        """Send tensors to other processes and receive theirs, at once. What two send each other is in one order.

        Args:
            sent: (rank, contiguous tensor) each; empty ones are left out.
            received: (rank, contiguous tensor to overwrite) each.
        """
        distributed = self._distributed
        given = [(distributed.isend, *each) for each in sent] + [(distributed.irecv, *each) for each in received]
        operations = [distributed.P2POp(act, tensor, rank) for act, rank, tensor in given if tensor.numel()]
        for work in distributed.batch_isend_irecv(operations) if operations else ():
            work.wait()

    def ask_to_stop(self, signal: int) -> bool:
        self.asked = signal
        return True

    def engine(self, device: torch.device) -> Engine:
        from turbogs_plugin.distributed.ranks_engine import RanksEngine  # which is made of this class

        return RanksEngine(engine_of(device, for_training=True), self, device)

    def meet(self, device: torch.device) -> None:
        # Not on a CPU: gloo takes exchanges of two threads in the order in which they come, which processes differ in.
        if device.type == "cuda":
            torch.cuda.set_device(self._gpu)  # every thread has a current one
            self.broadcast(torch.zeros(1, device=device))

    @contextmanager
    def working(self) -> Iterator[None]:
        self.latest = float("inf")
        yield
        self.latest = time.monotonic()
