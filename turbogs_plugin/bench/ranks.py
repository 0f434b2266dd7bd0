"""`turbogs bench ranks`: an iteration on one GPU and on several, and what of it is exchange.

The models are trained once, on one GPU; then torchrun's processes time the same iterations for each number of GPUs.
"""

from __future__ import annotations

import json
import pickle
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from turbogs_plugin.bench.clocks import back_to_back, device_times
from turbogs_plugin.bench.models import trained_model
from turbogs_plugin.bench.recorder import Recorder
from turbogs_plugin.bench.step import StepBench, warm_trainer
from turbogs_plugin.captures import load_scene
from turbogs_plugin.device import synchronize
from turbogs_plugin.distributed import ranks_engine
from turbogs_plugin.distributed.in_place import InPlace
from turbogs_plugin.distributed.processes import joined, start
from turbogs_plugin.distributed.ranks import ProcessRanks, Ranks
from turbogs_plugin.distributed.ranks_engine import RanksEngine
from turbogs_plugin.distributed.rows import OwnedRows
from turbogs_plugin.distributed.shared_pass import SharedScreen
from turbogs_plugin.errors import TrainingStopped
from turbogs_plugin.scene import Scene
from turbogs_plugin.study.cell import scene_on
from turbogs_plugin.train.inputs import resolve_device
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import Gaussians

PARTS = ("draw", "arrival", "render", "colors", "loss", "backward", "records", "solve", "barrier", "parameters")
"""Parts of an iteration. `colors` and `records` are exchanges, with the wait for the slowest process, and so is the
`barrier` after the steps, in place. By messages `parameters` packs those of the process, which travel in the next draw;
`arrival` is what is left of their way then, with the copies after it."""


@dataclass(frozen=True)
class Way:
    """Of an exchange: attributes of `RanksEngine`."""

    by_rows: bool = True
    in_place: bool = True


@dataclass
class RanksBench:
    """What is measured.

    Args:
        gpus: numbers of GPUs, one after the other.
        grown: also K and lambda times the number of GPUs: more views for the same time.
        step: of the iterations themselves.
    """

    gpus: Sequence[int]
    grown: bool
    step: StepBench

    def run(self, path: Path, factor: int, device: torch.device) -> dict[str, Any]:
        """The measurements, ready for JSON.

        Raises:
            TrainingStopped: processes ended with an error, which they have told.
        """
        scene = scene_on(load_scene(path, factor), device)
        step, name, results = self.step, scene.name, []
        models = [trained_model(scene, count, step.training, device, step.overrides) for count in step.gaussians]
        models = [model.map(Tensor.cpu) for model in models]
        del scene
        with tempfile.TemporaryDirectory() as folder:
            job = Path(folder) / "job"
            job.write_bytes(pickle.dumps((self, models, path.resolve(), factor, device.type)))
            for count in self.gpus:
                if start(count, [str(job)], device.type, "turbogs_plugin.bench.ranks"):
                    raise TrainingStopped(f"bench ranks on {count} GPUs ended early")
                results += json.loads(job.with_name(f"result-{count}.json").read_text())
        return {"scene": name, "overrides": list(step.overrides), "passes": results}

    def measure(
        self, models: Sequence[Gaussians], scene: Scene, device: torch.device, ranks: Ranks
    ) -> list[dict[str, Any]]:
        """In each process: the passes of models in host memory with this number of GPUs."""
        results = []
        for held in models:
            model = held.map(lambda value: value.to(device))
            factors = sorted({1, ranks.count}) if self.grown else [1]
            for views, factor in [(views, factor) for views in self.step.views for factor in factors]:
                for way in self._ways(len(model), views, ranks) if factor == 1 else (Way(),):
                    if way == Way(True, False) and "in place" not in results[-1]["exchange"]:
                        continue  # it was by messages already
                    results.append(self._measure(scene, model, views * factor, factor, way, device, ranks))
                    if ranks.first:
                        print(line_of(results[-1]), flush=True)
        return results

    def _ways(self, gaussians: int, views: int, ranks: Ranks) -> list[Way]:
        """To measure: in place, where that is possible. The largest case is exchanged by messages as well, and then
        without owners, too."""
        largest = (gaussians, views) == (max(self.step.gaussians), max(self.step.views))
        messages = [Way(True, False), Way(False, False)] if largest and ranks.count > 1 else []
        return [Way(), *messages]

    def _measure(
        self, scene: Scene, model: Gaussians, views: int, factor: int, way: Way, device: torch.device, ranks: Ranks
    ) -> dict[str, Any]:
        step = replace(self.step, pixel_budget=factor * self.step.pixel_budget)
        name = "none"
        trainer = warm_trainer(step.config_of(views), scene, model, device, ranks)
        if isinstance(trainer.engine, RanksEngine):
            trainer.complete()
            ranks_engine.OWNERS_FROM = 0 if way.by_rows else 1 << 62
            trainer.engine.in_place = way.in_place
            for _ in range(3):
                trainer.step()
            name = f"{'owners of rows' if way.by_rows else 'records to all'}, {trainer.engine.way}"
        wall = back_to_back(trainer.step, step.repeats, device)
        parts = self._parts(trainer, device)
        trainer.repeat_lost(wait=True)
        trainer.complete()
        everywhere = {name: [median] for name, median in parts.items()}
        if isinstance(ranks, ProcessRanks):
            medians = ranks.gather_numbers([round(1e3 * parts.get(name, 0.0)) for name in PARTS])
            everywhere = {name: [of[place] / 1e3 for of in medians] for place, name in enumerate(PARTS)}
        return {
            "gpus": ranks.count,
            "gaussians": len(model),
            "views": views,
            "pixel_budget": step.pixel_budget,
            "exchange": name,
            "wall": wall,
            "parts_ms_of_ranks": everywhere,
        }

    def _parts(self, trainer: Trainer, device: torch.device) -> dict[str, float]:
        """Median milliseconds of each part on the device, in iterations that follow each other without a pause."""
        recorder = Recorder(device)
        places = [(trainer.pixel_sampler, "sample", "draw"), (trainer, "supervise", "loss")]
        places.append((trainer.engine, "update", "solve"))
        if isinstance(trainer.engine, RanksEngine):
            places += [(trainer.engine, "_gather_colors", "colors"), (SharedScreen, "of_rows", "records")]
            places += [(OwnedRows, "gather_parameters", "parameters")]
            places += [(InPlace, "stepped", "barrier")]
        with recorder.passes(trainer, "render", "backward"), recorder.calls(*places):
            for _ in range(self.step.repeats):
                trainer.step()
            synchronize(device)
        return {name: device_times(spans)["median_ms"] for name, spans in recorder.spans.items()}


def line_of(result: dict[str, Any]) -> str:
    """A measurement for a terminal; of each part the slowest process's time."""
    parts = ", ".join(f"{name} {max(of):.2f}" for name, of in result["parts_ms_of_ranks"].items() if max(of) > 0)
    return (
        f"{result['gpus']} GPU  M={result['gaussians']} K={result['views']} lambda={result['pixel_budget']:g} "
        f"({result['exchange']}): {result['wall']['median_ms']:.3f} ms; {parts}"
    )


def main() -> None:
    """A process that `RanksBench.run` started."""
    job = Path(sys.argv[1])
    bench, models, path, factor, kind = pickle.loads(job.read_bytes())
    with joined(kind) as ranks:
        device = resolve_device(kind)
        scene = scene_on(load_scene(path, factor), device)
        results = bench.measure(models, scene, device, ranks)
        if ranks.first:
            job.with_name(f"result-{ranks.count}.json").write_text(json.dumps(results))


if __name__ == "__main__":
    main()
