"""The order that the exchange in place asks of GPUs, as far as streams and barriers enforce it.

A CPU has no streams. So stand-ins note what each of several processes gives to which of its streams, and what that must
come after. Work that nothing puts in order may be done in either order by a GPU.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from itertools import product

import pytest
import torch
from helpers.models import random_gaussians
from torch import Tensor

from turbogs_plugin.distributed.exchange import RankExchange
from turbogs_plugin.distributed.in_place import FREE, STEPPED, InPlace
from turbogs_plugin.distributed.peer_memory import PeerMemory
from turbogs_plugin.distributed.shared_model import SharedModel
from turbogs_plugin.distributed.shares import Share
from turbogs_plugin.engine.layout import ScreenRecord
from turbogs_plugin.engine.moments import GaussianMoments
from turbogs_plugin.engine.rendered import ScreenRecords

CPU = torch.device("cpu")


class Noted:
    """What processes give to their streams, one process after the other, as no host waits.

    Attributes:
        process: whose turn it is.
        stream: its current stream.
        after: what must be done -> what must be done before it, directly.
        barriers: the numbers of all barriers.
    """

    def __init__(self) -> None:
        self.process, self.stream = 0, "main"
        self.after: dict[tuple, set[tuple]] = defaultdict(set)
        self.barriers: list[int] = []
        self._last: dict[tuple, set[tuple]] = defaultdict(set)  # of each stream; what is next comes after it
        self._calls: dict[tuple, int] = defaultdict(int)

    def note(self, name: str) -> None:
        """The current stream does this next."""
        self._enqueue((name, self.process, self._number(name)))

    def meet(self, name: str) -> tuple:
        """The current stream comes to a place where all processes meet; what is there."""
        return self._enqueue((name, "all", self._number(name)))

    def last(self) -> set[tuple]:
        """What the current stream does last, as an event has it."""
        return set(self._last[self.process, self.stream])

    def wait(self, last: set[tuple]) -> None:
        """What the current stream does next comes after this as well."""
        self._last[self.process, self.stream] |= last

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

    def _enqueue(self, done: tuple) -> tuple:
        self.after[done] |= self.last()
        self._last[self.process, self.stream] = {done}
        return done


class Ranks:
    """What the exchange needs to know of the processes."""

    reads_peers = True
    asked = 0

    def __init__(self, noted: Noted, rank: int, count: int) -> None:
        self._noted, self.rank, self.count = noted, rank, count

    def begin_gather(self, tensor: Tensor, gathered: Tensor) -> Callable[[], None]:
        """On a stream of its own, behind the current one."""
        noted = self._noted
        last, before, noted.stream = noted.last(), noted.stream, "messages"
        noted.wait(last)
        arrived = noted.meet("gather")
        noted.stream = before
        return lambda: noted.wait({arrived})


class Engine:
    overflow = None

    def __init__(self, noted: Noted) -> None:
        self._noted = noted

    def lend(self, memory: object) -> None:
        pass

    def gather(self, *arguments: object) -> None:
        self._noted.note("read colors")

    def collect(self, *arguments: object) -> None:
        self._noted.note("collect")

    def update(self, *arguments: object) -> None:
        self._noted.note("step")


class Screen:
    """Of a pass in this memory; None: by messages."""

    views = 2

    def __init__(self, engine: Engine, shares: list[Share], memory: InPlace | None, count: int) -> None:
        self._arguments = engine, shares, count, None
        self._memory, self._target = memory, ScreenRecords(torch.zeros(2, 1, ScreenRecord.SIZE), torch.zeros(2), False)

    def of_rows(self, rows: list[slice], own: object) -> None:
        if self._memory is not None:
            self._memory.collect(*self._arguments, self._target, 0)


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
    """Iterations of some processes, which say whether in place; the next draw is noted as well."""
    noted = Noted()
    cat = torch.cat

    def noted_cat(tensors: list[Tensor], **options: object) -> Tensor:
        if "out" in options:
            noted.note("pack")
        return cat(tensors, **options)

    monkeypatch.setattr(torch, "cat", noted_cat)
    monkeypatch.setattr(torch, "_foreach_copy_", lambda targets, sources: noted.note("copy"))
    shares = [Share(slice(0, 1), slice(5 * rank, 5 * rank + 5), slice(rank, rank + 1), False) for rank in range(count)]
    (share, share_models), processes = (shared(noted, count), shared(noted, count)), []
    for rank in range(count):
        exchange = RankExchange(Ranks(noted, rank, count))
        exchange.by_rows = True
        exchange.memory = InPlace(exchange.ranks, share)
        exchange.model = SharedModel(exchange.ranks, share_models)
        model = exchange.place(random_gaussians(gaussians))
        processes.append((exchange, model, GaussianMoments.zeros(model)))
    for way, (rank, (exchange, model, moments)) in product(ways, enumerate(processes)):
        noted.process, exchange.in_place, engine = rank, way, Engine(noted)
        exchange.finish()
        memory = exchange._prepared(engine, shares, model)
        noted.note("render")  # reads the model, overwrites this process's records and colours
        if memory is not None:
            memory.colors(engine, shares, torch.zeros(5, 3), 0, torch.zeros(2, dtype=torch.int32))
        exchange.update(engine, None, Screen(engine, shares, memory, gaussians), model, moments, None)
        noted.note("draw")
    for rank, (exchange, *_) in enumerate(processes):
        noted.process = rank
        exchange.finish()
        noted.note("end")
    return noted


WAYS = [True, True, False, True, True]


@pytest.mark.parametrize(("count", "gaussians"), [(2, 20), (3, 8)])
def test_streams_and_barriers_keep_the_order(monkeypatch, count, gaussians):
    """Of three processes with 8 Gaussians the last one has no rows. In place the owner's step writes to all models; by
    messages each process copies what has arrived into its own."""
    noted = iterations(monkeypatch, count, gaussians, WAYS)
    assert FREE not in noted.barriers and noted.barriers.count(STEPPED) == count * sum(WAYS)
    rows = [rank for rank in range(count) if ("step", rank, 0) in noted.after]
    assert len(rows) == 2
    for reader, owner, number in product(range(count), range(count), range(len(WAYS))):
        following = number + 1 < len(WAYS)
        then = ("render", reader, number + 1) if following else ("end", reader, 0)
        if WAYS[number]:
            if owner in rows:
                step = ("step", owner, number)
                assert noted.is_before(("render", reader, number), step), "overwrites a model that is still rendered"
                assert noted.is_before(step, then), "renders a model that has not arrived"
            in_place = sum(WAYS[:number])
            for read in (("read colors", reader, in_place), ("collect", reader, in_place)):
                if following:
                    assert noted.is_before(read, ("render", owner, number + 1)), "overwrites what is still read"
        else:
            copy = ("copy", reader, sum(not way for way in WAYS[:number]))
            assert noted.is_before(("pack", owner, 0), copy), "copies what is not packed yet"
            assert noted.is_before(("render", reader, number), copy), "overwrites a model that is still rendered"
            assert noted.is_before(copy, then), "renders a model that has not arrived"
            if owner in rows:
                assert noted.is_before(copy, ("step", owner, number + 1)), "a step in place comes before what arrives"


def test_parameters_travel_beside_the_next_draw_as_messages(monkeypatch):
    """They do not wait for it; what has arrived is copied behind it."""
    noted = iterations(monkeypatch, 2, 20, WAYS)
    number = WAYS.index(False)
    for rank in range(2):
        assert noted.is_before(("draw", rank, number), ("copy", rank, 0))
        assert not noted.is_before(("draw", rank, number), ("gather", "all", 0))
