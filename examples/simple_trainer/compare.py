"""gsplat's simple_trainer, stock and with each swap, on captures: the numbers of docs/drop-in.md's table.

    git clone --branch v1.5.3 https://github.com/nerfstudio-project/gsplat .hosts/1.5.3
    python examples/simple_trainer/compare.py --host .hosts/1.5.3 --scenes PATH/fox PATH/caliterra --out dropin

With ``--variants stock step --steps 30000 --marks 7000 --seeds 42 43 44`` it prints how much sooner the whole step
passes what stock has at 7000 and 30000 steps.

Each run is a process of its own, on a free GPU. ``OUT/dropin.json`` is written anew after each one: every run's marks
(step, seconds of training alone, PSNR, SSIM, Gaussians), or its error, which stops no other. A run that is there
already is not done again. For gsplat's own speed, fused-ssim must be installed; a run says what was stood in for.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import density
import errors
import moment_lm
import sparse_pixels
import torch
import tyro
import whole_step
from editing import edited

HERE = Path(__file__).resolve().parent

VARIANTS: dict[str, tuple[str, ...]] = {
    "stock": (),
    "step": (whole_step.EDITS,),
    "density": (density.EDITS,),
    "errors": (density.EDITS, errors.EDITS),
    "lm": (density.EDITS, errors.EDITS, moment_lm.EDITS),
    "sparse": (sparse_pixels.EDITS,),
    "all": (density.EDITS, errors.EDITS, moment_lm.EDITS, sparse_pixels.EDITS),
}
"""Name -> the edits of gsplat's file."""

TRAINER = "examples/simple_trainer.py"
CLONE = "git clone --branch v1.5.3 https://github.com/nerfstudio-project/gsplat .hosts/1.5.3"
SPARSE_VIEWS = 4
"""Batch size of the variants with sparse pixels."""


@dataclass
class Options:
    """
    Args:
        host: a copy of gsplat's repository, with examples/simple_trainer.py of 1.5.3 or main.
        scenes: folders with images/ and sparse/0/.
        out: folder of the results.
        variants: some of stock, step, density, errors, lm, sparse, all.
        steps: of each run; the whole step has `own_steps`, or at most what it proposes itself.
        marks: steps after which it is evaluated, beside the last one; the whole step is at each twentieth of its run.
        factor: the photos' own, by which they are smaller: images_4/ at 4.
        seeds: each variant is run with each; gsplat's own is 42.
        limit: seconds that one run may take.
        extra: further arguments of the trainer, in one text.
        python: that of an environment in which gsplat and this package are installed. None: this one, with the host's
            gsplat and this repository's package.
    """

    host: Path
    scenes: tuple[Path, ...]
    out: Path
    variants: tuple[str, ...] = ("stock", "density", "errors", "lm", "sparse")
    steps: int = 7000
    own_steps: int | None = None
    marks: tuple[int, ...] = (500, 1000, 2000, 3000, 4000, 5000, 6000)
    factor: int = 1
    seeds: tuple[int, ...] = (42,)
    limit: float = 600.0
    extra: str = ""
    python: Path | None = None

    @property
    def paths(self) -> list[Path]:
        """Where a run finds what is not installed."""
        examples = self.host.resolve() / "examples"
        return [examples] if self.python else [self.host.resolve(), examples, HERE.parents[1]]


def require_host(host: Path) -> None:
    if not (host / TRAINER).is_file():
        raise SystemExit(f"{host / TRAINER} is not there: {CLONE}")


def edited_trainer(host: Path, variant: str, folder: Path) -> Path:
    """A copy of the host's trainer with a variant's edits."""
    source = (host / TRAINER).read_text(encoding="utf-8")
    for edits in VARIANTS[variant]:
        source = edited(source, edits)
    trainer = folder / f"{variant}.py"
    trainer.write_text(source, encoding="utf-8")
    return trainer


def own_length(scene: Path, most: int) -> int:
    """The steps that `TurboStep` proposes for the photos of a folder, every eighth of which tests; at most `most`."""
    from turbogs_plugin.gsplat_bridge import TurboStep

    count = sum(1 for _ in (scene / "images").iterdir())
    return min(most, TurboStep.proposed_steps(count - -(-count // 8)))


def train(options: Options, scene: Path, variant: str, seed: int, gpu: str) -> dict[str, Any]:
    """One run: its record, or its error."""
    batch = SPARSE_VIEWS if sparse_pixels.EDITS in VARIANTS[variant] else 1
    run = {"scene": scene.name, "variant": variant, "steps": options.steps, "batch": batch, "seed": seed}
    steps, marks = options.steps, options.marks
    if whole_step.EDITS in VARIANTS[variant]:
        steps = options.own_steps or own_length(scene, options.steps)
        marks = (*marks, *(steps * part // 20 for part in range(1, 20)))
    marks = sorted({mark for mark in (*marks, steps) if 0 < mark <= steps})
    paths = [*map(str, options.paths), "" if options.python else os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths)), "MEASURED_SEED": str(seed)}
    environment |= {"CUDA_VISIBLE_DEVICES": gpu} if gpu else {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        try:
            command = [options.python or sys.executable, HERE / "measured.py"]
            command += [edited_trainer(options.host, variant, folder)]
            command += [folder / "record.json", "default", "--disable_viewer", "--disable_video"]
            command += ["--data_dir", scene.resolve(), "--data_factor", options.factor, "--result_dir", folder]
            command += ["--max_steps", steps, "--batch_size", batch, "--save_steps", steps]
            command += ["--eval_steps", *marks, *options.extra.split()]
            done = subprocess.run(
                [str(part) for part in command],
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
                timeout=options.limit,
                env=environment,
                check=False,
            )
            if done.returncode:
                run["error"] = "\n".join(done.stdout.strip().splitlines()[-8:]) or f"exit code {done.returncode}"
        except (OSError, ValueError, subprocess.TimeoutExpired) as error:
            run["error"] = str(error)
        if (folder / "record.json").exists():
            run |= json.loads((folder / "record.json").read_text())
    return run


def gpus() -> list[str]:
    """The GPUs' names for CUDA_VISIBLE_DEVICES; one empty name where there is none."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    return named.split(",") if named else [str(place) for place in range(torch.cuda.device_count())] or [""]


def compare(options: Options) -> list[dict[str, Any]]:
    """All runs of `options`, those that were there before first; writes them as they end."""
    require_host(options.host)
    options.out.mkdir(parents=True, exist_ok=True)
    file = options.out / "dropin.json"
    runs = json.loads(file.read_text())["runs"] if file.exists() else []
    runs = [run for run in runs if "error" not in run]
    there = {(run["scene"], run["variant"], run["steps"], run["seed"]) for run in runs}
    wanted = [(scene, v, seed) for scene in options.scenes for seed in options.seeds for v in options.variants]
    wanted = [(scene, v, seed) for scene, v, seed in wanted if (scene.name, v, options.steps, seed) not in there]
    free: SimpleQueue[str] = SimpleQueue()
    for gpu in gpus():
        free.put(gpu)

    def on_a_free_gpu(job: tuple[Path, str, int]) -> dict[str, Any]:
        gpu = free.get()
        try:
            return train(options, *job, gpu)
        finally:
            free.put(gpu)

    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"
    with ThreadPoolExecutor(len(gpus())) as pool:
        for done in as_completed([pool.submit(on_a_free_gpu, job) for job in wanted]):
            run = done.result()
            runs.append(run)
            write(file, device, runs)
            last = {} if "error" in run or not run["marks"] else run["marks"][-1]
            print(run["scene"], run["variant"], run.get("error", last), flush=True)
    return runs


def sooner(runs: Iterable[dict[str, Any]]) -> list[str]:
    """How much sooner each whole step passes PSNR and SSIM of each mark of stock, of a scene, whatever the seeds."""
    trained = [run for run in runs if "marks" in run]
    stock, steps = ([run for run in trained if run["variant"] == name] for name in ("stock", "step"))
    lines = []
    for run, ours in itertools.product(stock, steps):
        for mark in run["marks"] if run["scene"] == ours["scene"] else ():
            had = f"{mark['seconds']:.1f} s, {mark['psnr']:.2f} dB, {mark['ssim']:.4f}"
            past = [each for each in ours["marks"] if each["psnr"] >= mark["psnr"] and each["ssim"] >= mark["ssim"]]
            said = "not passed"
            if past:
                first = past[0]
                said = f"passed after {first['seconds']:.2f} s ({first['psnr']:.2f} dB, {first['ssim']:.4f}): "
                said += f"{mark['seconds'] / first['seconds']:.1f} times sooner"
            lines.append(f"{run['scene']}, stock {run['seed']}'s {mark['step']} steps ({had}), {ours['seed']}: {said}")
    return lines


def write(file: Path, device: str, runs: Iterable[dict[str, Any]]) -> None:
    record = {"device": device, "date": date.today().isoformat(), "runs": list(runs)}
    file.with_suffix(".part").write_text(json.dumps(record, indent=1) + "\n")
    file.with_suffix(".part").replace(file)


if __name__ == "__main__":
    made = compare(tyro.cli(Options))
    print("\n".join(sooner(made)))
    sys.exit(1 if any("error" in run for run in made) else 0)
