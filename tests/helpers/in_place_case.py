"""What each process of a test on several GPUs does: steps with the exchange in place, which keep what was read of the
others, to be compared with what messages give of it. Two runs of one way differ by the order of sums on a GPU."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from os import getpid, kill
from pathlib import Path
from typing import Any

import torch

from turbogs_plugin.captures import load_scene
from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.distributed.in_place import InPlace
from turbogs_plugin.distributed.messages import Messages, gather_rows
from turbogs_plugin.distributed.processes import joined
from turbogs_plugin.distributed.ranks import ProcessRanks, Ranks
from turbogs_plugin.distributed.ranks_engine import RanksEngine, SharedScreen
from turbogs_plugin.engine import ReferenceEngine
from turbogs_plugin.engine.cuda import workspace
from turbogs_plugin.engine.render_pass import ScreenRecords
from turbogs_plugin.train.loop import TrainingLoop
from turbogs_plugin.train.trainer import Trainer

CASES = ((3, 5), (1, 1))
"""The fewest and the most views of an iteration."""
STEPS = 60


class Kept:
    """What passes read in place, and what they would have sent; compared at the end, so that nothing waits before."""

    def __init__(self) -> None:
        self.colors: list[tuple] = []
        self.screens: list[tuple] = []
        self.parameters: list[tuple] = []
        self.arrived_in_place = 0
        self._before = {(InPlace, "colors"): self.kept_colors, (SharedScreen, "of_rows"): self.kept_rows}
        self._before[RanksEngine, "update"] = self.kept_update
        for (owner, name), kept in self._before.items():
            self._before[owner, name] = method = getattr(owner, name)
            setattr(owner, name, self.around(method, kept))

    def around(self, method: Callable, kept: Callable) -> Callable:
        return lambda *arguments: kept(method, *arguments)

    def kept_colors(self, colors: Callable, memory: InPlace, shares: list, own: Any, *flags: Any) -> Any:
        found = colors(memory, shares, own, *flags)
        # The next pass overwrites what this one has rendered and gathered.
        self.colors.append((shares, None if own is None else own.clone(), found.clone()))
        return found

    def kept_rows(self, of_rows: Callable, screen: SharedScreen, rows: list, own: Any) -> Any:
        found, plain = of_rows(screen, rows, own), screen._plain
        if plain is not None:
            plain = ScreenRecords(plain.records.clone(), plain.radii.clone())
        # The step leaves nothing of use in the records.
        self.screens.append((replace(screen, _plain=plain), rows, found.records.clone(), found.radii.clone()))
        return found

    def kept_update(
        self, update: Callable, engine: RanksEngine, rule: Any, screen: Any, model: Any, *more: Any
    ) -> None:
        update(engine, rule, screen, model, *more)
        owned = engine._owned
        if owned is not None:  # else all processes made all steps
            self.arrived_in_place += engine._exchange is engine.memory
            self.parameters.append((owned.rows, owned.gaussians.map(torch.clone), model.map(torch.clone)))

    def compare(self, ranks: ProcessRanks) -> None:
        for (owner, name), method in self._before.items():
            setattr(owner, name, method)
        messages = Messages(ReferenceEngine(), ranks)
        for screen, rows, records, radii in self.screens:
            target = ScreenRecords(torch.empty_like(records), torch.empty_like(radii))
            messages.collect(screen.batch.shares, rows, screen._plain, target)
            assert torch.equal(radii, target.radii)
            seen = (radii > 0).any(dim=-1)
            # A pass that overflows draws nothing: what lies there may be NaN.
            torch.testing.assert_close(records[seen], target.records[seen], rtol=0, atol=0, equal_nan=True)
        for shares, own, found in self.colors:
            own = found[:0] if own is None else own
            colors = torch.cat(ranks.exchange([own.flatten()] * ranks.count, [3 * share.num_slots for share in shares]))
            torch.testing.assert_close(colors.view(-1, 3), found, rtol=0, atol=0, equal_nan=True)
        for rows, own, found in self.parameters:
            sent = found.map(torch.zeros_like)
            for name, value in sent.items():
                value[rows[ranks.rank]] = getattr(own, name)
            gather_rows(ranks, [value for _, value in sent.items()])
            for name, value in found.items():
                assert torch.equal(getattr(sent, name), value), name


def trainer_of(capture: Path, ranks: Ranks, views: tuple[int, int] = (3, 5)) -> Trainer:
    settings = [f"train.iterations={STEPS}", "train.refine_until=50", "density.refine_from=10", "train.device=cuda"]
    settings += ["density.refine_every=15", f"schedule.min_views={views[0]}", f"schedule.max_views={views[1]}"]
    config = load_config("turbogs", settings)
    config.scene.path = str(capture)
    scene, device = load_scene(capture), torch.device("cuda")
    trainer = Trainer(config.without_plan(), scene, device, engine=ranks.engine(device))
    trainer.initialise_maps()
    return trainer


def recoveries(trainer: Trainer) -> list[int]:
    """The iterations at which the engine recovers, as they come."""
    found, engine = [], trainer.engine.engine
    recover = engine.recover

    def noted() -> None:
        found.append(trainer.iteration)
        recover()

    engine.recover = noted
    return found


def compared(capture: Path, ranks: Ranks) -> None:
    """Every case, with density control, a view rendered densely by one process alone, and an overflow in one."""
    workspace.CAPACITY_STEP = 32  # so that these few intersections can be too many
    for views in CASES:
        kept = Kept()
        trainer = trainer_of(capture, ranks, views)
        recovered, engine = recoveries(trainer), trainer.engine
        count, loop = len(trainer.gaussians), TrainingLoop(trainer)
        loop.advance(20)
        if engine._exchange is not engine.memory:
            raise AssertionError("the exchange went by messages: no symmetric memory on this machine?")
        assert kept.arrived_in_place > 0
        if ranks.first:
            trainer.dense_errors(0)
        engine.in_place = False  # some iterations by messages between
        loop.advance(24)
        engine.in_place = True
        loop.advance(30)
        if ranks.rank == ranks.count - 1:
            engine.engine.workspace._intersections_per_tile *= 0.3
        loop.advance(STEPS)
        trainer.complete()
        assert len(trainer.gaussians) != count and trainer.iteration == STEPS
        assert recovered, "no overflow"
        kept.compare(ranks)


def dying(capture: Path, ranks: Ranks, told: Path) -> None:
    """The last process is killed between two iterations; the others wait for it at a barrier of their GPUs."""
    trainer = trainer_of(capture, ranks)
    for number in range(STEPS):
        trainer.step()
        if number == 20 and ranks.rank == ranks.count - 1:
            told.write_text(str(time.time()))
            kill(getpid(), signal.SIGKILL)


if __name__ == "__main__":
    with joined("cuda") as all_ranks:
        if sys.argv[1] == "compared":
            compared(Path(sys.argv[2]), all_ranks)
        else:
            dying(Path(sys.argv[2]), all_ranks, Path(sys.argv[3]))
