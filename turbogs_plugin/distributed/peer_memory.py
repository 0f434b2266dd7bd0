"""Memory of GPUs of one host that all processes of a training read and write in place, over NVLink.

By torch's symmetric memory: every process allocates as much, and maps what the others have. Nothing here uses
multicast, and torch is told not to prepare it.
"""

from __future__ import annotations

import os
import subprocess
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import accumulate

import torch
from torch import Tensor

from turbogs_plugin.distributed.ranks import ProcessRanks
from turbogs_plugin.engine.layout import MAX_PEERS

PROOF_MILLISECONDS = 60_000
"""Time without an answer from another GPU after which the first barrier ends the process. Later ones wait for ever, as
the first process may evaluate for an hour; a process that is lost is noticed by its launcher."""

LEAST = 1 << 24
"""Least size of a memory that holds many numbers, 64 MiB."""

ALIGNMENT = 64
"""Alignment of what lies in a memory, in numbers of four bytes."""


def with_room(numbers: int) -> int:
    """Size of what must grow to `numbers`: half more, as all processes wait for each other and their GPUs."""
    return numbers + numbers // 2


def aligned_starts(sizes: Iterable[int]) -> list[int]:
    """Where parts of these sizes begin in a memory, one after the other, and behind them its size; all in numbers."""
    return list(accumulate((-(-size // ALIGNMENT) * ALIGNMENT for size in sizes), initial=0))


@dataclass
class PeerMemory:
    """Memory of every process, of one size, for all to read and write.

    Args:
        parts: [size] float32 of each process, rank after rank.
        barrier: called with a small number by every process: what its stream does next comes after all that the
            streams of all did before their calls with this number. No host waits. It keeps the memory mapped.
    """

    parts: list[Tensor]
    barrier: Callable[[int], None]


Sharing = Callable[[ProcessRanks, int, torch.device], PeerMemory | None]
"""What gives memory to all processes, as `share_memory` does; tests have others."""


def share_memory(ranks: ProcessRanks, size: int, device: torch.device) -> PeerMemory | None:
    """Memory for `size` numbers of every process, zeros; or None on all of them, if one cannot have it. Every process
    must call this, with one size."""
    if device.type != "cuda":
        return None
    # Every process sees its own GPU alone, as number 0 (`processes.joined`). Torch would take that for one GPU of all.
    os.environ.setdefault("TORCH_SYMM_MEM_ALLOW_OVERLAPPING_DEVICES", "1")
    os.environ.setdefault("TORCH_SYMM_MEM_DISABLE_MULTICAST", "1")
    steps, memory = _steps(ranks, size), None
    for _ in range(3):  # step by step, so that none waits in one for a process that failed in the step before
        try:
            memory = next(steps, None)
        except Exception as error:  # of drivers and versions of torch, whatever they raise
            memory, reason = None, f"{type(error).__name__}: {error}".splitlines()[0]
            warnings.warn(f"GPUs do not read each other's memory, and send messages ({reason})", stacklevel=2)
        if not all(done for (done,) in ranks.gather_numbers([int(memory is not None)])):
            return None
    return memory


def _steps(ranks: ProcessRanks, size: int) -> Iterator[PeerMemory]:
    """Allocate this process's part; map all parts; prove that GPUs meet at a barrier in them. Ends early where this
    process cannot have such memory."""
    import torch.distributed._symmetric_memory as symmetric

    one_host = os.environ.get("LOCAL_WORLD_SIZE") == os.environ.get("WORLD_SIZE")
    if not one_host or ranks.count > MAX_PEERS or not _linked():
        return
    # As `symmetric.empty` does, but never from a pool: what one process has kept from earlier runs there, another may
    # not, and only one of the two would then wait for the other.
    device = torch.device("cuda", torch.cuda.current_device())
    if torch.cuda.mem_get_info(device)[0] < 8 * size:  # the driver gives this memory, without what torch keeps
        torch.cuda.empty_cache()
    own = symmetric._SymmetricMemory.empty_strided_p2p((size,), (1,), torch.float32, device)
    yield PeerMemory([own.zero_()], lambda channel: None)

    group = torch.distributed.group.WORLD
    assert group is not None
    handle = symmetric.rendezvous(own, group)
    parts = [handle.get_buffer(rank, (size,), torch.float32) for rank in range(ranks.count)]
    parts[ranks.rank] = own
    memory = PeerMemory(parts, handle.barrier)
    yield memory

    handle.barrier(channel=0, timeout_ms=PROOF_MILLISECONDS)
    torch.cuda.synchronize(device)
    yield memory


def _linked() -> bool:
    """Whether this process's GPU has an NVLink that is up; True where the driver does not say. Barriers need atomic
    operations in the other GPU's memory, which PCIe has not."""
    name = f"GPU-{torch.cuda.get_device_properties(torch.cuda.current_device()).uuid}"
    command = ["nvidia-smi", "nvlink", "--status", "--id", name]
    try:
        asked = subprocess.run(command, capture_output=True, text=True, timeout=PROOF_MILLISECONDS / 1000)
    except (OSError, subprocess.TimeoutExpired):
        return True
    return asked.returncode != 0 or "GB/s" in asked.stdout  # of a link that is up
