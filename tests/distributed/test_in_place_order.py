"""The order that the exchange in place asks of GPUs, as far as streams and barriers enforce it.

A CPU has no streams. So stand-ins note what each of several processes gives to its stream, and what that must come
after. Work that nothing puts in order may be done in either order by a GPU.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from itertools import product
from types import SimpleNamespace

import pytest
import torch
from helpers.models import random_gaussians
from torch import Tensor

from turbogs_plugin.distributed import ranks_engine
from turbogs_plugin.distributed.in_place import STEPPED, InPlace
from turbogs_plugin.distributed.peer_memory import PeerMemory
from turbogs_plugin.distributed.ranks_engine import RanksEngine, SharedScreen
from turbogs_plugin.distributed.shares import Share
from turbogs_plugin.engine.moments import GaussianMoments

CPU = torch.device("cpu")


class Noted:
    """What processes give to their streams, one process after the other, as no host waits.

    Attributes:
        process: whose turn it is.
        after: what must be done -> what must be done before it, directly.
        barriers: the numbers of all barriers.
    """

    def __init__(self) -> None:
        self.process = 0
        self.after: dict[tuple, set[tuple]] = defaultdict(set)
        self.barriers: list[int] = []
        self._last: dict[int, set[tuple]] = defaultdict(set)  # of each process; what is next comes after it
        self._calls: dict[tuple, int] = defaultdict(int)

    def note(self, name: str) -> None:
        """The process's stream does this next."""
        self._enqueue((name, self.process, self._number(name)))

    def meet(self, name: str) -> None:
        """The process's stream comes to a place where all processes meet."""
        self._enqueue((name, "all", self._number(name)))

    def is_before(self, first: tuple, then: tuple) -> bool:
        """Whether that is certain."""
        assert first in self.after and then in self.after, (first, then)
        seen, found = set(), [then]
        while found:
            for earlier in self.after[found.pop()] - seen:
                seen.add(earlier)
                found.append(earlier)
        return first in seen

    def _number(self, name: str) -> int:
        self._calls[name, self.process] += 1
        return self._calls[name, self.process] - 1

    def _enqueue(self, done: tuple) -> None:
        self.after[done] |= self._last[self.process]
        self._last[self.process] = {done}


class Ranks:
    """What the exchange needs to know of the processes."""

    asked = 0

    def __init__(self, noted: Noted, rank: int, count: int) -> None:
        self._noted, self.rank, self.count = noted, rank, count

    def to_all(self, own: Tensor, sizes: list[int]) -> list[Tensor]:
        """The process's stream goes on when all parts have arrived."""
        self._noted.note("send")
        self._noted.meet("gather")
        return [torch.zeros(size) for size in sizes]


class Engine:
    overflow = draw = expose = learn_exposures = supervise = evaluate = learn = evaluate_and_learn = None

    def __init__(self, noted: Noted) -> None:
        self._noted = noted

    def lend(self, memory: object) -> bool:
        return True

    def gather(self, *arguments: object) -> None:
        self._noted.note("read colors")

    def collect(self, *arguments: object) -> None:
        self._noted.note("collect")

    def update(self, *arguments: object) -> None:
        self._noted.note("step")


class Screen(SharedScreen):
    """A pass of two views in this memory; None: by messages."""

    def __init__(self, engine: Engine, shares: list[Share], memory: InPlace | None) -> None:
        self.batch = SimpleNamespace(samples=SimpleNamespace(view_ids=(0, 1)))
        self._arguments, self._memory = (engine, shares), memory

    def of_rows(self, rows: list[slice], own: object) -> None:
        if self._memory is not None:
            self._memory.collect(*self._arguments, rows, None, None)


def shared(noted: Noted, count: int) -> Callable[[Ranks, int, torch.device], PeerMemory]:
    """Memory of processes of which the first one asks first."""
    made: list[list[Tensor]] = []
    asked: dict[int, int] = defaultdict(int)

    def share(ranks: Ranks, size: int, device: torch.device) -> PeerMemory:
        number = asked[ranks.rank]
        asked[ranks.rank] += 1
        if number == len(made):
            made.append([torch.zeros(size) for _ in range(count)])

        def barrier(channel: int) -> None:
            noted.barriers.append(channel)
            noted.meet(f"memory {number}, barrier {channel}")

        return PeerMemory(made[number], barrier)

    return share


def iterations(monkeypatch: pytest.MonkeyPatch, count: int, gaussians: int, ways: list[bool]) -> Noted:
    """Iterations of some processes, which say whether in place."""
    noted = Noted()
    monkeypatch.setattr(ranks_engine, "OWNERS_FROM", 0)
    shares = [Share(slice(0, 1), slice(5 * rank, 5 * rank + 5), slice(rank, rank + 1)) for rank in range(count)]
    share, processes = shared(noted, count), []
    for rank in range(count):
        engine = RanksEngine(Engine(noted), Ranks(noted, rank, count), CPU, share)
        model = engine.place(random_gaussians(gaussians))
        processes.append((engine, model, GaussianMoments.zeros(model)))
    for way, (rank, (engine, model, moments)) in product(ways, enumerate(processes)):
        noted.process = rank
        assert engine.memory.prepare(engine.engine, shares, len(model), CPU)
        engine._exchange = engine.memory if way else engine.messages
        noted.note("render")  # reads the model, overwrites this process's records and colours
        if way:
            engine.memory.colors(engine.engine, shares, torch.zeros(5, 3), torch.zeros(2, dtype=torch.int32))
        noted.note("backward")  # reads the model, writes this process's records
        screen = Screen(engine.engine, shares, engine.memory if way else None)
        engine.update(None, screen, model, moments, None)
    for rank in range(count):
        noted.process = rank
        noted.note("end")
    return noted


WAYS = [True, True, False, True, True]


@pytest.mark.parametrize(("count", "gaussians"), [(2, 20), (3, 8)])
def test_streams_and_barriers_keep_the_order(monkeypatch, count, gaussians):
    """The last of three processes with 8 Gaussians has no rows. In place the owner's step writes to all models; by
    messages each process copies what has arrived into its own."""
    noted = iterations(monkeypatch, count, gaussians, WAYS)
    assert noted.barriers.count(STEPPED) == count * sum(WAYS)
    rows = [rank for rank in range(count) if ("step", rank, 0) in noted.after]
    assert len(rows) == 2
    for reader, owner, number in product(range(count), range(count), range(len(WAYS))):
        following = number + 1 < len(WAYS)
        then = ("render", reader, number + 1) if following else ("end", reader, 0)
        if owner in rows:
            step = ("step", owner, number)
            assert noted.is_before(step, then), "renders a model that has not arrived"
            if WAYS[number]:
                assert noted.is_before(("backward", reader, number), step), "overwrites a model that is still read"
        in_place = sum(WAYS[:number])
        if WAYS[number]:
            colors, collect = ("read colors", reader, in_place), ("collect", reader, in_place)
            assert noted.is_before(("render", owner, number), colors), "reads colours that are not rendered"
            assert noted.is_before(("backward", owner, number), collect), "collects records that are not complete"
        if WAYS[number] and following:
            for read in (("read colors", reader, in_place), ("collect", reader, in_place)):
                assert noted.is_before(read, ("render", owner, number + 1)), "overwrites what is still read"
        if not WAYS[number]:
            assert noted.is_before(("send", owner, 0), then), "renders a model that has not arrived"
            if owner in rows:
                arrived = ("gather", "all", 0)
                assert noted.is_before(arrived, ("step", owner, number + 1)), "a step in place before what arrives"
