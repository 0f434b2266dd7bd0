"""Measures what docs/captures.md says of lenses, exposures, masks and many photos, on a machine with a GPU.

    python docs/measure_captures.py OUT --fox-raw CAPTURE --caliterra CAPTURE [lenses exposures masks many alone ...]

Run in the project's root. Each measurement is written into OUT/captures.json as it comes, beside what earlier calls
have measured; `docs/capture_tables.py` makes tables of docs/results/h200/captures.json. Nothing else stays.

    lenses     a capture with a distorted lens, and its photos undistorted by COLMAP beforehand: whole trainings
    exposures  train.exposure=false and true: whole trainings, errors raw and after colour alignment
    masks      the right half of each photo masked, and none: whole trainings; iterations of one and the same model
    many       3,000 photos under --max-memory 8GiB: the command, with the memory of its processes
    alone      cameras of a capture found from its photos alone, against the published ones; wants no GPU
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
import traceback
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import torch
from PIL import Image

from turbogs_plugin.bench.step import StepBench
from turbogs_plugin.captures import load_scene
from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.device import free_device_memory
from turbogs_plugin.files import write_text_atomically
from turbogs_plugin.model.ply import save_ply
from turbogs_plugin.plan import make_plan
from turbogs_plugin.reconstruct import reconstruct
from turbogs_plugin.report.provenance import provenance
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.offload import place_views
from turbogs_plugin.study.cell import WARMUP_ITERATIONS, scene_on, warm_up
from turbogs_plugin.train.evaluate import evaluate
from turbogs_plugin.train.folder import RunFolder
from turbogs_plugin.train.history import read_history
from turbogs_plugin.train.run import new_loop
from turbogs_plugin.train.start import resolve_device
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.train.wall import WallRecord

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
RAW_AND_ALIGNED = ("psnr", "ssim", "aligned_psnr", "aligned_ssim")
VIEWS = (10, 5, 3)
"""Of the iterations that are timed."""
BETWEEN_SAMPLES = 0.2
"""Seconds between two looks at the memory of processes."""


@dataclass
class Measurement:
    """What is measured, on which device, and what is known so far.

    Args:
        out: folder of the record.
        device: of all trainings.
        seeds: of each variant.
        factor: scale photos down by this.
        photos: of the made-up flight.
        overrides: of every configuration.
    """

    out: Path
    device: torch.device
    seeds: int
    factor: int
    photos: int
    overrides: list[str]
    record: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.out.mkdir(parents=True, exist_ok=True)
        if self.file.is_file():
            self.record = json.loads(self.file.read_text())

    @property
    def file(self) -> Path:
        return self.out / "captures.json"

    def begin(self, name: str) -> list[dict[str, Any]]:
        """A list in the record for the runs of a measurement, in the place of an earlier one."""
        self.record[name] = {"provenance": asdict(provenance(self.device.type)), "runs": []}
        return self.record[name]["runs"]

    def add(self, runs: list[dict[str, Any]], run: dict[str, Any]) -> None:
        """Keep a run of a measurement, and print it."""
        runs.append(run)
        write_text_atomically(self.file, json.dumps(self.record, indent=1) + "\n")
        print(json.dumps(run), flush=True)

    def lenses(self, capture: Path) -> None:
        runs = self.begin("lenses")
        with tempfile.TemporaryDirectory() as folder:
            plain = Path(folder) / "undistorted"
            script = EXAMPLES / "undistort_with_colmap.py"
            subprocess.run([sys.executable, script, capture, plain], check=True, stderr=subprocess.DEVNULL)
            scenes = {"as it lies": self.load(capture), "undistorted by COLMAP": self.load(plain)}
        first, second = scenes.values()
        if first.test.names != second.test.names:
            raise RuntimeError("lenses: COLMAP undistorted other photos than those that were loaded")
        self.compare(runs, {name: (scene, []) for name, scene in scenes.items()})

    def exposures(self, capture: Path) -> None:
        scene, runs = self.load(capture), self.begin("exposures")
        ways = {value: (scene, [f"train.exposure={value}"]) for value in ("false", "true")}
        self.compare(runs, ways)

    def masks(self, capture: Path) -> None:
        runs = self.begin("masks")
        with tempfile.TemporaryDirectory() as folder:
            half = Path(folder) / "half"
            half.mkdir()
            for part in ("images", "sparse"):
                (half / part).symlink_to((capture / part).resolve(), target_is_directory=True)
            mask_half(half)
            scenes = {"none": self.load(capture), "half of each photo": self.load(half)}
            trainer = self.compare(runs, {name: (scene, []) for name, scene in scenes.items()})["none"]
            model = Path(folder) / "model.ply"
            save_ply(trainer.gaussians, model, scenes["none"].frame)
            count, degree = len(trainer.gaussians), f"train.sh_degree={trainer.config.train.sh_degree}"
            del trainer
            free_device_memory(self.device)
            repeats = 100 if self.device.type == "cuda" else 2
            bench = StepBench([count], VIEWS, 1.0, 0, repeats, [*self.overrides, degree], ply=model)
            for name, scene in scenes.items():
                for entry in bench.run(scene_on(scene, self.device), self.device)["passes"]:
                    kept = {key: entry[key] for key in ("gaussians", "views", "free_running", "wall")}
                    self.add(runs, {"variant": name, **kept, "samples": entry["counts"]["samples"]})
                free_device_memory(self.device)

    def many(self) -> None:
        runs = self.begin("many")
        with tempfile.TemporaryDirectory() as folder:
            capture, run = Path(folder) / "flight", RunFolder(Path(folder) / "run")
            script = EXAMPLES / "many_photos.py"
            subprocess.run([sys.executable, script, capture, "--photos", str(self.photos)], check=True)
            limit = ["--max-memory", "8GiB"] if self.device.type == "cuda" else []
            command = [sys.executable, "-m", "turbogs_plugin.cli", "train", str(capture), *limit]
            command += ["--device", self.device.type, *self.overrides]
            started = time.perf_counter()
            process = subprocess.Popen([*command, "--out", str(run.path)])
            peak = peak_of_processes(process)
            seconds, wall = time.perf_counter() - started, WallRecord.read(run.wall)
            result = {"photos": self.photos, "exit_code": process.returncode, "peak_bytes": peak, "seconds": seconds}
            if wall is not None:
                history = read_history(run.history)
                last = history[-1]
                result |= {"train_seconds": wall.train_seconds, "iterations": last.iteration, "psnr": last.psnr}
                result |= {"ssim": last.ssim, "gaussians": last.num_gaussians, "model": run.model.is_file()}
                result |= {"tensor_bytes": max(line.memory_bytes for line in history), "parts": wall.parts}
            self.add(runs, {"limit": limit[-1:], **result})

    def alone(self, capture: Path) -> None:
        runs = self.begin("alone")
        self.record["alone"]["provenance"] = asdict(provenance("cpu"))
        with tempfile.TemporaryDirectory() as folder:
            started = time.perf_counter()
            reconstruct(capture / "images", Path(folder) / "scene")
            seconds = time.perf_counter() - started
            model = pycolmap.Reconstruction(Path(folder) / "scene" / "sparse" / "0")
        found = {image.name: image.projection_center() for image in model.images.values() if image.has_pose}
        distances = distances_of_centers(found, published_centers(capture))
        photos = sum(1 for _ in (capture / "images").iterdir())
        result = {"photos": photos, "registered": len(found), "seconds": seconds}
        self.add(runs, result | {"median": float(np.median(distances)), "largest": float(distances.max())})

    def load(self, capture: Path) -> Scene:
        return load_scene(capture, self.factor)

    def compare(self, runs: list[dict[str, Any]], variants: dict[str, tuple[Scene, list[str]]]) -> dict[str, Trainer]:
        """Train each variant with each seed, the variants in turn.

        Args:
            variants: name -> capture, and changes of the configuration.

        Returns:
            Name -> what trained it with the last seed.
        """
        trainers: dict[str, Trainer] = {}
        for seed in range(self.seeds):
            for name, (scene, changes) in variants.items():
                trainers.pop(name, None)
                free_device_memory(self.device)
                run, trainers[name] = self.train(scene, [*changes, f"train.seed={seed}"], warm=seed == 0)
                size = scene.test.cameras.sizes[0].tolist()
                self.add(runs, {"scene": scene.name, "variant": name, "seed": seed, "size": size, **run})
        return trainers

    def train(self, scene: Scene, changes: list[str], warm: bool) -> tuple[dict[str, Any], Trainer]:
        """A whole training, as `turbogs train` makes it, and its errors, as `turbogs eval` gives them.

        Args:
            warm: train a few iterations before the clock starts, so that all code is loaded.
        """
        config = load_config("turbogs", [*self.overrides, *changes])
        config = make_plan(config, scene, self.device).apply(config)
        test = place_views(scene.test, self.device, config.train.photos_place)
        if warm:
            few = min(WARMUP_ITERATIONS[self.device.type], config.train.iterations)
            warm_up(config, scene, test, self.device, few)
        loop, _ = new_loop(config, scene, self.device)
        loop.run()
        trainer = loop.trainer
        trainer.require_finite()
        mean = evaluate(trainer.gaussians, test, trainer.look(test.names), aligned=True).mean
        run = {"seconds": loop.clock.seconds, "iterations": trainer.iteration, "gaussians": len(trainer.gaussians)}
        return run | {name: getattr(mean, name) for name in RAW_AND_ALIGNED}, trainer


def published_centers(capture: Path) -> dict[str, np.ndarray]:
    """Name of each photo of a ``transforms.json`` -> center of its camera [3]."""
    frames = json.loads((capture / "transforms.json").read_text())["frames"]
    return {Path(frame["file_path"]).name: np.array(frame["transform_matrix"])[:3, 3] for frame in frames}


def distances_of_centers(found: dict[str, np.ndarray], published: dict[str, np.ndarray]) -> np.ndarray:
    """How far each camera is from the published one, in shares of the mean distance of these from their middle, after
    the similarity that brings most cameras together.

    Args:
        found: name of a photo -> center of its camera [3].
        published: the same, of these photos at least.

    Returns:
        [F] in the order of `found`.
    """
    centers, true = np.array(list(found.values())), np.array([published[name] for name in found])
    radius = np.linalg.norm(true - true.mean(axis=0), axis=1).mean()
    ransac = pycolmap.RANSACOptions(max_error=0.02 * radius, random_seed=0)
    change = pycolmap.estimate_sim3d_robust(centers, true, ransac)["tgt_from_src"]
    return np.linalg.norm([change * center for center in centers] - true, axis=1) / radius


def mask_half(capture: Path) -> None:
    """Give each photo of a capture a mask that keeps its left half."""
    (capture / "masks").mkdir()
    for photo in (capture / "images").iterdir():
        with Image.open(photo) as image:
            mask = Image.new("L", image.size)
        mask.paste(255, (0, 0, mask.width // 2, mask.height))
        mask.save(capture / "masks" / f"{photo.stem}.png")


def peak_of_processes(process: subprocess.Popen) -> int:
    """Wait for a process. Bytes of main memory that it and its descendants had together at most; what several share
    counts once. Linux alone says so; elsewhere 0."""
    peak = 0
    while process.poll() is None:
        peak = max(peak, sum(map(proportional_bytes, family(process.pid))))
        time.sleep(BETWEEN_SAMPLES)
    return peak


def family(pid: int) -> list[int]:
    """A process and its descendants that are there now."""
    found = [pid]
    for children in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in text_of(children).split():
            found += family(int(child))
    return found


def proportional_bytes(pid: int) -> int:
    """Bytes of main memory of a process, what it shares divided by the number of those that do; 0 of one that ended."""
    lines = text_of(Path(f"/proc/{pid}/smaps_rollup")).splitlines()
    return sum(1024 * int(line.split()[1]) for line in lines if line.startswith("Pss:"))


def text_of(file: Path) -> str:
    try:
        return file.read_text()
    except OSError:  # the process ended meanwhile
        return ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("what", nargs="*", help="lenses, exposures, masks, many, alone; all where absent")
    parser.add_argument("--fox-raw", type=Path, help="a capture with a distorted lens")
    parser.add_argument("--caliterra", type=Path, help="a capture whose exposures differ")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--photos", type=int, default=3000, help="of the measurement with many")
    parser.add_argument("--factor", type=int, default=1)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--set", nargs="*", default=[], metavar="section.key=value", help="for a quick try")
    asked = parser.parse_intermixed_args()  # names may stand after options
    device = resolve_device(asked.device)
    all_of_it = Measurement(asked.out, device, asked.seeds, asked.factor, asked.photos, asked.set)
    fox, caliterra = (asked.fox_raw, "--fox-raw"), (asked.caliterra, "--caliterra")
    captures = {"lenses": fox, "exposures": caliterra, "masks": caliterra, "many": (None, ""), "alone": fox}
    for name in asked.what or captures:
        if name not in captures:
            parser.error(f"{name}: choose of {', '.join(captures)}")
        if captures[name][1] and captures[name][0] is None:
            parser.error(f"{name} needs {captures[name][1]} CAPTURE")
    failed = 0
    for name in asked.what or captures:
        started = time.perf_counter()
        try:
            getattr(all_of_it, name)(*filter(None, captures[name][:1]))
        except Exception:  # the others are measured all the same
            failed = 1
            traceback.print_exc()
        print(f"{name}: {time.perf_counter() - started:.0f} s", flush=True)
    sys.exit(failed)


if __name__ == "__main__":
    main()
