"""The processes that train one model together: who they are, and what they tell each other on the host.

`Ranks` is one process alone, for which everything here does nothing; `ProcessRanks` are those that torchrun started.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from turbogs_plugin.engine import Engine, engine_of
from turbogs_plugin.errors import TrainingStopped
from turbogs_plugin.model.torch_file import leaves
from turbogs_plugin.types import RowUpdate

Value = TypeVar("Value")


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
        must call this, and waits for the others. Another thread may exchange what lies on the host meanwhile."""


ONE = Ranks()
"""A process that trains alone."""


def _answered(method: Callable[..., Value]) -> Callable[..., Value]:
    """Raise `TrainingStopped` where another process does not answer."""

    @functools.wraps(method)
    def answered(self: ProcessRanks, *arguments: Any, **options: Any) -> Value:
        try:
            return method(self, *arguments, **options)
        except torch.cuda.OutOfMemoryError:
            raise
        except RuntimeError as error:  # gloo's and NCCL's errors are of this kind
            reason = re.split(r"\. |\n", str(error))[0][:200]
            raise TrainingStopped(f"another process of this training ended or does not answer ({reason})") from error

    return answered


class ProcessRanks(Ranks):
    """The processes of torch's default group. Tensors travel by the backend of their device: NCCL on GPUs, gloo on
    CPUs. `asked`: number of the signal by which this process wants all to stop; 0: none."""

    def __init__(self) -> None:
        import torch.distributed as distributed

        self._distributed = distributed
        self.rank, self.count = distributed.get_rank(), distributed.get_world_size()
        self.stop_signal = self.asked = 0

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
    def exchange(self, sent: Sequence[Tensor], sizes: Sequence[int]) -> list[Tensor]:
        """Send a flat float32 tensor to each process, rank after rank, this one included, and receive one from each,
        equal to the bit. `sizes`: of what each process sends to this one."""
        received = sent[0].new_empty(sum(sizes))
        self._distributed.all_to_all_single(received, torch.cat(list(sent)), list(sizes), [len(part) for part in sent])
        return list(received.split(list(sizes)))

    def ask_to_stop(self, signal: int) -> bool:
        self.asked = signal
        return True

    def engine(self, device: torch.device) -> Engine:
        from turbogs_plugin.distributed.ranks_engine import RanksEngine  # which is made of this class

        return RanksEngine(engine_of(device, for_training=True), self, device)

    def meet(self, device: torch.device) -> None:
        # Not on a CPU: gloo takes exchanges of two threads in the order in which they come, which processes differ in.
        if device.type == "cuda":
            self.broadcast(torch.zeros(1, device=device))


def require_equal(ranks: ProcessRanks, state: dict[str, Any]) -> None:
    """Compare a state, as of `Engine.verify`, with the first process's, to the bit. Every process must call this; all
    raise `TrainingStopped` where a tensor or a number of one differs."""
    names, equal = [], []
    for name, value in leaves(state, "state"):
        if isinstance(value, Tensor | int | float):
            own = value.detach() if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float64)
            own = own.flatten().clone(memory_format=torch.contiguous_format).view(torch.uint8)
            first = own.clone()
            ranks.broadcast(first)
            names.append(name)
            equal.append(int(torch.equal(first, own)))
    for rank, found in enumerate(ranks.gather_numbers(equal)):
        if 0 in found:
            raise TrainingStopped(
                f"iteration {state['iteration']}: {names[found.index(0)]} of rank {rank} differs from rank 0's, "
                "though all make equal steps; do the GPUs and their software differ, or is one broken?"
            )


def first_change(ranks: ProcessRanks, update: RowUpdate | None, device: torch.device) -> RowUpdate | None:
    """The first process's change of the set of Gaussians, on all."""
    tensors, plain = {}, None
    if update is not None:
        tensors = {"source": update.source, "fresh": update.fresh.to(torch.uint8), **update.values}
        places = {name: (value.shape, value.dtype) for name, value in tensors.items()}
        plain = places, update.reset, (update.num_cloned, update.num_split, update.num_pruned)
    plain = ranks.agree(plain)
    if plain is None:
        return None
    places, reset, counts = plain
    for name, (shape, dtype) in places.items():
        own = tensors[name].contiguous() if ranks.first else torch.empty(shape, dtype=dtype, device=device)
        ranks.broadcast(own)
        tensors[name] = own
    values = {name: tensors[name] for name in places if name not in ("source", "fresh")}
    return RowUpdate(tensors["source"], tensors["fresh"].bool(), values, reset, *counts)
