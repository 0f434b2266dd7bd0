"""Runs one trainer, stock or edited, and writes down its evaluations: the clock is that of training alone.

``python measured.py SIMPLE_TRAINER.py RECORD.json default --data_dir SCENE ...``: the trainer's own arguments.

The clock starts where the trainer's does and stands still during evaluations. Checkpoints and pictures are not written.
Decoded training photos stay on the GPU, unless MEASURED_LOADER is ``own``: then the trainer's four loader processes
read them. MEASURED_SEED takes the place of the trainer's 42. MEASURED_PICTURES="VIEW 1 3 10" writes RECORD_1.png and so
on: test view VIEW as the model shows it after 1, 3 and 10 seconds of training; the run ends after the last one.
"""

from __future__ import annotations

import json
import os
import runpy
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from stand_ins import stand_in, without_gpu

GPU = torch.cuda.is_available()


class CachedLoader:
    """In the place of torch's `DataLoader`: the same batches in the same kind of order, photos on the device."""

    def __init__(self, dataset: Any, batch_size: int) -> None:
        self.items = [dataset[place] for place in range(len(dataset))]
        for item in self.items:
            item["image"] = item["image"].to("cuda" if GPU else "cpu")
        self.batch_size = batch_size

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for places in torch.randperm(len(self.items)).split(self.batch_size):
            yield torch.utils.data.default_collate([self.items[place] for place in places])


class Recorder:
    """Stands in the trainer's source under the name ``recorder``."""

    def __init__(self, file: Path, missing: list[str]) -> None:
        self.file = file
        self.record: dict[str, Any] = {"stand_ins": missing, "marks": []}
        self.paused = self.began = 0.0
        self.view, *self.due = map(int, os.environ.get("MEASURED_PICTURES", "0").split())

    def start(self) -> float:
        torch.cuda.synchronize()
        self.began = time.time()
        return self.began

    def evaluate(self, runner: Any, step: int) -> None:
        """The trainer's evaluation after a step, off the clock."""
        torch.cuda.synchronize()
        stopped = time.time()
        runner.eval(step)
        stats = json.loads(Path(f"{runner.stats_dir}/val_step{step:04d}.json").read_text())
        mark = {"step": step + 1, "seconds": stopped - self.began - self.paused, "gaussians": stats["num_GS"]}
        self.record["marks"].append({**mark, "psnr": stats["psnr"], "ssim": stats["ssim"]})
        self.record["gpu_gib"] = torch.cuda.max_memory_allocated() / 2**30
        self.file.write_text(json.dumps(self.record))
        torch.cuda.synchronize()
        self.paused += time.time() - stopped

    def watched(self, steps: Iterable[int], runner: Any) -> Iterator[int]:
        """The trainer's steps, with a picture between two of them wherever one is due."""
        pictures = bool(self.due)
        for step in steps:
            yield step
            if self.due and time.time() - self.began - self.paused >= self.due[0]:
                self.picture(runner, step)
                if not self.due:
                    return
        while pictures and self.due:
            self.picture(runner, step)

    @torch.no_grad()
    def picture(self, runner: Any, step: int) -> None:
        """The first picture that is due, off the clock."""
        torch.cuda.synchronize()
        stopped = time.time()
        item = runner.valset[self.view]
        truth = item["image"].to(runner.device) / 255.0
        height, width = truth.shape[:2]
        where = {"camtoworlds": item["camtoworld"][None].to(runner.device), "Ks": item["K"][None].to(runner.device)}
        planes = {"near_plane": runner.cfg.near_plane, "far_plane": runner.cfg.far_plane}
        colors = runner.rasterize_splats(
            **where, width=width, height=height, sh_degree=runner.cfg.sh_degree, **planes, masks=None
        )[0][0].clamp(0, 1)
        mark = self.due.pop(0)
        psnr = -10 * float((colors - truth).square().mean().log10())
        taken = {"mark": mark, "step": step + 1, "seconds": stopped - self.began - self.paused, "psnr": psnr}
        self.record.setdefault("pictures", []).append(taken)
        file = self.file.with_name(f"{self.file.stem}_{mark}.png")
        Image.fromarray((255 * colors).round().byte().cpu().numpy()).save(file)
        self.file.write_text(json.dumps(self.record))
        self.paused += time.time() - stopped


def instrumented(source: str) -> str:
    """The trainer's source with a recorder in it.

    Raises:
        SystemExit: a place is not there once.
    """
    replacements = {
        "set_random_seed(42 + local_rank)": f"set_random_seed({os.environ.get('MEASURED_SEED', '42')} + local_rank)",
        "global_tic = time.time()": "global_tic = recorder.start()",
        "                self.eval(step)\n": "                recorder.evaluate(self, step)\n",
        "                torch.save(\n": "                (lambda *nothing: None)(\n",
        "        for step in pbar:\n": "        for step in recorder.watched(pbar, self):\n",
        "num_workers=1": "num_workers=0",  # test photos: starting a process at each evaluation takes seconds
    }
    for old, new in replacements.items():
        if source.count(old) != 1:
            sys.exit(f"{old.strip()!r} is there {source.count(old)} times: expected gsplat's simple_trainer.py")
        source = source.replace(old, new)
    if not GPU:
        source = source.replace('f"cuda:{local_rank}"', '"cpu"').replace('f"{cfg.backend}:{local_rank}"', '"cpu"')
    return source


def main() -> None:
    trainer, record = Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve()
    sys.argv = [str(trainer), *sys.argv[3:]]
    sys.path.insert(0, str(trainer.parent))
    recorder = Recorder(record, stand_in())
    if not GPU:
        without_gpu()
    if os.environ.get("MEASURED_LOADER") != "own":
        loader = torch.utils.data.DataLoader
        torch.utils.data.DataLoader = lambda dataset, batch_size, shuffle, **options: (
            CachedLoader(dataset, batch_size)
            if shuffle
            else loader(dataset, batch_size=batch_size, shuffle=False, **options)
        )
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / trainer.name
        copy.write_text(instrumented(trainer.read_text()))
        runpy.run_path(str(copy), {"recorder": recorder}, run_name="__main__")


if __name__ == "__main__":
    main()
