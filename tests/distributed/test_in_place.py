"""The exchange in place gives what messages give, to the bit, with memory that all processes read."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
import torch
from helpers.framework_runs import assert_identical, tiny_capture, tiny_trainer
from helpers.models import random_gaussians
from helpers.peer_files import KeepingEngine, PeerFiles
from helpers.processes import ended, grouped, said, start_ranks

from turbogs_plugin.captures import load_scene
from turbogs_plugin.distributed import in_place, peer_memory, ranks_engine
from turbogs_plugin.distributed.in_place import DRAWN, STEPPED, WRITTEN, InPlace
from turbogs_plugin.distributed.messages import rows_of
from turbogs_plugin.distributed.peer_memory import PeerMemory, aligned_starts, share_memory
from turbogs_plugin.distributed.ranks import ProcessRanks
from turbogs_plugin.distributed.ranks_engine import RanksEngine
from turbogs_plugin.engine import ReferenceEngine
from turbogs_plugin.engine.shared import ModelCopies, SharedEngine
from turbogs_plugin.model.torch_file import leaves
from turbogs_plugin.train.loop import TrainingLoop
from turbogs_plugin.train.trainer import Trainer

CPU = torch.device("cpu")

CASES = {
    "usual": (),
    "one view": ("schedule.type=fixed", "schedule.views=1"),
    "one tile": ("schedule.type=fixed", "schedule.views=1", "schedule.pixel_budget=0.1", "pixel_sampler.unit=tile"),
    "no rule": ("optimizer.type=adam",),
}
"""Name -> overrides. The fourth iteration has an event of density control, where it is on. With one tile all processes
but one have no samples; without a rule all get all records."""

OF_THREE = ("usual", "one tile")
"""With three processes these are enough: some views are shared by all."""

STEPS = 5

scene_of = cache(load_scene)  # a trainer only reads it


def trainer_of(
    capture: Path, ranks: ProcessRanks, files: PeerFiles, *overrides: str, engine: SharedEngine | None = None
) -> Trainer:
    """With memory of these files, and an engine that keeps passes there."""
    engine = RanksEngine(engine or KeepingEngine(), ranks, CPU, files)
    return tiny_trainer(scene_of(capture), *overrides, engine=engine)


def run(trainer: Trainer, way: bool | None = True) -> dict:
    """The state after `STEPS`, with an evaluation in the middle. `way`: in place; None where memory may end then."""
    for number in range(STEPS):
        trainer.step()
        assert way is None or (trainer.engine._exchange is trainer.engine.memory) == way
        if number == STEPS // 2:
            trainer.dense_errors(0)
            trainer.complete()
    trainer.complete()
    return copy.deepcopy(dict(leaves(trainer.state_dict(), "state")))


def every_case(capture: Path, folder: Path) -> None:
    """In every process: each case by messages and in place; the memory grows by an event of density control."""
    ranks, wanted = grouped(), {}
    ranks_engine.OWNERS_FROM = in_place.LEAST = 0  # rows have owners in messages, too; these memories are files
    for name in CASES if ranks.count == 2 else OF_THREE:
        trainer = trainer_of(capture, ranks, PeerFiles(folder / f"{name}-messages", most=0), *CASES[name])
        wanted[name] = run(trainer, False)
        memory = PeerFiles(folder / name)
        trainer = trainer_of(capture, ranks, memory, *CASES[name])
        number = len(trainer.gaussians)
        assert_identical(run(trainer), wanted[name])
        assert len(trainer.gaussians) != number
        assert memory.barriers == [WRITTEN, DRAWN, STEPPED] * STEPS
    few(capture, ranks, folder)
    if ranks.count > 2:
        return
    without_some_memory(capture, ranks, folder, wanted["usual"])
    growing(capture, ranks, folder, wanted["usual"])
    lost(capture, ranks, folder)


def without_some_memory(capture: Path, ranks: ProcessRanks, folder: Path, wanted: dict) -> None:
    """Where there is no memory for passes, from the start or from the moment when it must grow, all goes by messages.
    Nobody asks again. An engine that keeps no passes sends messages, too."""
    for most in (1, 3):  # the first one is the model's, the others are of passes
        files = PeerFiles(folder / f"only {most}", most=most)
        assert_identical(run(trainer_of(capture, ranks, files), None), wanted)
        in_place_steps = files.barriers.count(STEPPED)
        assert files.refused == 1 and (0 < in_place_steps < STEPS if most > 1 else in_place_steps == 0)
    files = PeerFiles(folder / "none kept")
    assert_identical(run(trainer_of(capture, ranks, files, engine=ReferenceEngine()), False), wanted)
    assert not files.barriers


def growing(capture: Path, ranks: ProcessRanks, folder: Path, wanted: dict) -> None:
    """Without room to spare, the event before the last iteration makes the memory of the model grow."""
    before = in_place.with_room
    in_place.with_room = lambda numbers: numbers
    files = PeerFiles(folder / "growing")
    trainer = trainer_of(capture, ranks, files)
    counts = [len(trainer.gaussians)]
    assert_identical(run(trainer), wanted)
    counts.append(len(trainer.gaussians))
    widths = [value[0].numel() for _, value in trainer.gaussians.items()]
    sizes = [aligned_starts([count * width for width in widths])[-1] for count in counts]
    assert sizes[0] < sizes[1] and set(sizes) <= set(files.sizes)
    in_place.with_room = before


def few(capture: Path, ranks: ProcessRanks, folder: Path) -> None:
    """The last process has no rows."""
    count, states = 4 * (ranks.count - 1), []
    assert rows_of(count, ranks.count)[-1] == slice(count, count)
    for way in (False, True):
        files = PeerFiles(folder / f"few-{way}", most=100 * way)
        trainer = trainer_of(capture, ranks, files, "density.type=none")
        first = trainer.gaussians.map(torch.clone)
        trainer.begin_with(first.map(lambda value: value[:count].clone()))
        states.append(run(trainer, way))
        assert not torch.equal(trainer.gaussians.means, first.means[:count])
        assert files.barriers.count(STEPPED) == way * STEPS
    assert_identical(*states)


def lost(capture: Path, ranks: ProcessRanks, folder: Path) -> None:
    """One process has too little memory for one pass: all repeat it, and nothing of it stays."""
    states = []
    for way in (False, True):
        engine = KeepingEngine(lose=2 if ranks.rank == ranks.count - 1 else None)
        files = PeerFiles(folder / f"lost-{way}", most=100 * way)
        trainer = trainer_of(capture, ranks, files, "density.type=none", engine=engine)
        TrainingLoop(trainer).advance(6)
        trainer.complete()
        assert engine.recovered == 1 and int(trainer.optimizer.moments.steps.max()) == 6
        states.append(copy.deepcopy(dict(leaves(trainer.state_dict(), "state"))))
    assert_identical(*states)


@pytest.mark.parametrize("count", [2, 3])
def test_both_ways_give_the_same_to_the_bit(tmp_path, count):
    capture = tiny_capture(tmp_path)
    codes = ended(start_ranks(count, every_case, tmp_path / "out", capture, tmp_path / "memory"), 300)
    assert codes == [0] * count, said(tmp_path / "out")


class Alone:
    """What `share_memory` needs to know of the processes, of which each does what the first one does.

    Args:
        others: whether the other process had no error, in each step.
    """

    rank, count = 0, 2

    def __init__(self, *others: int) -> None:
        self.others = list(others)

    def gather_numbers(self, values: list[int]) -> list[list[int]]:
        return [values, [self.others.pop(0)]]


def test_a_model_may_be_placed_over_itself_and_others_have_the_same_places(monkeypatch):
    monkeypatch.setattr(in_place, "LEAST", 0)
    model = random_gaussians(40)

    def share(ranks: Alone, size: int, device: torch.device) -> PeerMemory:
        return PeerMemory([torch.zeros(size) for _ in range(2)], print)

    memory = InPlace(ReferenceEngine(), Alone(), share)
    whole = memory.place(model)
    half = memory.place(whole.map(lambda value: value[::2]))  # of the very memory that it overwrites
    (other,) = memory.others(half)
    assert memory.others(whole) is None
    for name, value in half.items():
        assert torch.equal(value, getattr(model, name)[::2]), name
        assert getattr(other, name).shape == value.shape
    assert len(set(ModelCopies(half, [other]).distances)) == 1


def test_all_send_messages_if_one_cannot_share_its_memory(monkeypatch):
    """Here or there, in any step; the next steps are not begun. There is none on a CPU."""
    memory, device = PeerMemory([], print), torch.device("cuda")

    def failing(*arguments: object) -> Iterator[PeerMemory]:
        yield memory
        raise ValueError("no peer access\nat line 3")

    for name in ("ALLOW_OVERLAPPING_DEVICES", "DISABLE_MULTICAST"):
        monkeypatch.setenv(f"TORCH_SYMM_MEM_{name}", "1")
    monkeypatch.setattr(peer_memory, "_steps", lambda *arguments: iter([memory] * 3))
    assert share_memory(Alone(1, 1, 1), 10, device) is memory
    for there in (Alone(0), Alone(1, 0), Alone(1, 1, 0)):
        assert share_memory(there, 10, device) is None and not there.others
    monkeypatch.setattr(peer_memory, "_steps", lambda *arguments: iter([memory] * 2))  # the proof fails
    assert share_memory(Alone(1, 1, 1), 10, device) is None
    monkeypatch.setattr(peer_memory, "_steps", failing)
    with pytest.warns(UserWarning, match=r"ValueError: no peer access\)"):
        assert share_memory(here := Alone(1, 1), 10, device) is None
    assert not here.others
    assert share_memory(Alone(), 10, CPU) is None
