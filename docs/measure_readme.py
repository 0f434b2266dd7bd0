"""Measures what README and docs/results/README.md show of ours, on a machine with a GPU, and puts it into docs/;
`make results` calls it:

    python docs/measure_readme.py OUT FOX CALITERRA SNOWMIKU [STAGE ...] [--within 9m]

The captures are folders of these names. What is measured lies in OUT/COMMIT, the commit of the sources, and is not
measured again. A piece of work that would not end within the time is not begun; then the exit code is 3, and the same
call goes on. Where nothing is missing, the call copies what the stages made into docs/, and `make pages` makes tables
and plots of it. It changes no file of the repository before, so that all is of one commit. The stages:

    sizes         README's rows of `turbogs`, `turbogs-ssim` and `turbogs-small`
    wall          `turbogs bench wall` of the same three, capture by capture
    pictures      README's first two pictures, of a run on caliterra
    demo          README's picture of `make demo`, on the CPU
    pixels        a network without Gaussians, by examples/pixels_on_an_mlp.py; wants no GPU
    paper         README's row of `turbogs-paper`; the printed update
    paper_parts   each part changed alone in `turbogs-paper`
    baselines     3DGS, MCMC and the votes of many views at full length
    studies       the tables of docs/results/README.md, which docs/paper.md has, too
    paper_tables  the paper's tables
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import monotonic

import torch
from study_tables import CAPTURES, OURS, ROOT, captures_of
from turbogs_plugin.config.units import parse_seconds

from turbogs_plugin.files import write_atomically
from turbogs_plugin.report.provenance import COMMIT_VARIABLE, MODIFIED, source_commit
from turbogs_plugin.study.grid import load_ablation
from turbogs_plugin.study.workers import UNFINISHED

PAGES_SECONDS = 60
"""What `make pages` takes at most, after the last stage."""
TURBOGS = ("-m", "turbogs_plugin.cli")
Scenes = Mapping[str, Path]
"""Capture -> its folder."""
Words = Sequence[str | Path]
"""Of a command, after `python`."""


@dataclass(frozen=True)
class Piece:
    """Work that is done as a whole.

    Args:
        seconds: the most that it takes on an H100 or H200.
        made: the file or the folder that it makes, in OUT/COMMIT; where that is there, the work is done.
        commands: (captures, where to write, a folder that is thrown away) -> what is called.
    """

    seconds: int
    made: str
    commands: Callable[[Scenes, Path, Path], list[Words]]

    def measure(self, scenes: Scenes, folder: Path, left: float) -> int:
        """The exit code; `UNFINISHED` where the `left` seconds are too few. `folder` is OUT/COMMIT."""
        path = folder / self.made
        if path.exists():
            return 0
        if left < self.seconds:
            return UNFINISHED
        print(f"{self.made}, {left:.0f} s are left", flush=True)
        part = path.with_name(f"part-{path.name}")
        shutil.rmtree(part, ignore_errors=True)  # of a call that was killed; a file is written over
        part.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as scratch:
            if any(run(words) for words in self.commands(scenes, part, Path(scratch))):
                return 1
        part.rename(path)
        return 0


@dataclass(frozen=True)
class Sweep:
    """One or more ablations in OUT/COMMIT/studies; `turbogs ablate` trains the cells that are missing.

    Args:
        seconds: the most that a cell takes on an H100 or H200.
        names: of the ablations. Of several, each takes from those before it what they have in common.
        seeds: of each variant.
        captures: on which all are trained.
        only: of the one ablation, these variants and the baseline; all where absent.
    """

    seconds: int
    names: Sequence[str]
    seeds: int = 5
    captures: Sequence[str] = CAPTURES
    only: Sequence[str] = ()

    def measure(self, scenes: Scenes, folder: Path, left: float) -> int:
        """As `Piece.measure`."""
        if left < self.seconds + 1:
            return UNFINISHED
        print(f"{', '.join((*self.names, *self.only))}, {left:.0f} s are left", flush=True)
        words = [*TURBOGS, "ablate", *self.names, "--seeds", *map(str, range(self.seeds))]
        for capture in self.captures:
            words += ["--scene", scenes[capture]]
        words += ["--only", *self.only] if self.only else []
        gpus = torch.cuda.device_count()
        words += ["--gpus", ",".join(map(str, range(gpus)))] if gpus > 1 else []
        out = folder / "studies"
        out = out if len(self.names) > 1 else out / self.names[0]  # of several, each has a folder in it
        return run([*words, "--within", f"{left - self.seconds:.0f}s", "--out", out])


def run(words: Words) -> int:
    """The exit code of a Python process with these words."""
    return subprocess.run([sys.executable, *words], cwd=ROOT).returncode


def time_wall(variant: str, capture: str, scenes: Scenes, file: Path, scratch: Path) -> list[Words]:
    """`variant`: of the ablation `sizes`. `turbogs`, whose seconds have a table of their own, runs three times."""
    runs = ["--repeats", "3" if variant == "turbogs" else "1"]
    changes = load_ablation("sizes").variants[variant]
    return [[*TURBOGS, "bench", "wall", *changes, "--scene", scenes[capture], *runs, "--out", file]]


def make_pictures(capture: str, view: int, scenes: Scenes, folder: Path, scratch: Path) -> list[Words]:
    """`view`: number of a training view."""
    trained = scratch / "run"
    train = [*TURBOGS, "train", scenes[capture], "--out", trained]
    return [train, ["docs/make_pictures.py", trained, str(view), folder]]


def draw_demo(scenes: Scenes, file: Path, scratch: Path) -> list[Words]:
    """As `make demo` does."""
    capture, trained = scratch / "capture", scratch / "run"
    train = [*TURBOGS, "train", capture, "--out", trained, "--config", "demo", "--device", "cpu"]
    return [[*TURBOGS, "demo", capture], train, ["docs/demo_picture.py", trained, file]]


def learn_photo(chosen: Callable[[Scenes], Words], scenes: Scenes, folder: Path, scratch: Path) -> list[Words]:
    files = ["--figure", folder / "figure.png", "--results", folder / "psnr.json"]
    return [["examples/pixels_on_an_mlp.py", *chosen(scenes), *files]]


PHOTOS: dict[str, Callable[[Scenes], Words]] = {
    "synthetic": lambda scenes: [],
    "fox": lambda scenes: ["--photo", scenes["fox"] / "images/0001.jpg"],
    "caliterra": lambda scenes: ["--photo", scenes["caliterra"] / "images/IMG_9354.jpg"],
}
"""What a network learns."""

SHOWN = {variant: captures_of(variant) for study, variant, _ in OURS if study == "sizes"}
"""Variant of the ablation `sizes` -> the captures that README has it of."""

STAGES: dict[str, Sequence[Piece | Sweep]] = {
    "sizes": [
        Sweep(60, ["sizes"], captures=[capture], only=[name for name, captures in SHOWN.items() if capture in captures])
        for capture in CAPTURES
    ],
    "wall": [
        Piece(60, f"wall/{variant}-{capture}.json", partial(time_wall, variant, capture))
        for variant, captures in SHOWN.items()
        for capture in captures
    ],
    "pictures": [Piece(60, "pictures", partial(make_pictures, "caliterra", 44))],
    "demo": [Piece(120, "demo.png", draw_demo)],
    "pixels": [Piece(120, f"pixels/{name}", partial(learn_photo, chosen)) for name, chosen in PHOTOS.items()],
    "paper": [Sweep(150, ["paper"])],  # the printed update diverges, and is slow
    "paper_parts": [Sweep(60, ["paper_parts"])],
    "baselines": [Sweep(210, ["baselines"], seeds=1)],
    "studies": [Sweep(60, ["sizes", "parts", "departures", "density_departures", "bounds", "cameras"])],
    "paper_tables": [
        Sweep(60, ["sizes", "components", "views", "hard_ratio", "schedule"], seeds=2, captures=["caliterra"])
    ],
}


def files_of(stage: str, folder: Path) -> dict[str, bytes]:
    """File in docs/ -> its content, of a stage that is done in `folder`, OUT/COMMIT."""
    if stage == "wall":
        walls = {
            variant: {capture: read(folder / f"wall/{variant}-{capture}.json") for capture in captures}
            for variant, captures in SHOWN.items()
        }
        return {"results/h200/wall.json": as_json(walls)}
    if stage == "pictures":
        places = ("render.jpg", "overlays.jpg", "results/pictures.json")
        return {place: (folder / "pictures" / Path(place).name).read_bytes() for place in places}
    if stage == "demo":
        return {"demo.png": (folder / "demo.png").read_bytes()}
    if stage == "pixels":
        known = {photo: ways for name in PHOTOS for photo, ways in read(folder / f"pixels/{name}/psnr.json").items()}
        figure = (folder / "pixels/synthetic/figure.png").read_bytes()
        return {"results/pixels_on_an_mlp.json": as_json(known), "pixels_on_an_mlp.png": figure}
    places = {f"{name}/results.json" for sweep in STAGES[stage] for name in sweep.names}
    return {f"results/{place}": (folder / "studies" / place).read_bytes() for place in sorted(places)}


def read(file: Path) -> dict:
    return json.loads(file.read_text(encoding="utf-8"))


def as_json(record: dict) -> bytes:
    return f"{json.dumps(record, indent=1)}\n".encode()


def measure(folder: Path, docs: Path, scenes: Scenes, stages: Sequence[str], within: float) -> int:
    """The exit code: 0 where all is in `docs`, `UNFINISHED` where time was over, 1 where work failed.

    Args:
        folder: OUT/COMMIT.
        within: seconds from now on.
    """
    end, failed = monotonic() + within, []
    for stage in stages:
        for work in STAGES[stage]:
            code = work.measure(scenes, folder, end - monotonic())
            if code == UNFINISHED:
                return unfinished()
            if code:
                failed.append(stage)
    if failed:
        print(f"failed: {', '.join(dict.fromkeys(failed))}; the same call tries it again", file=sys.stderr)
        return 1
    if end - monotonic() < PAGES_SECONDS:
        return unfinished()
    for name, content in [file for stage in stages for file in files_of(stage, folder).items()]:
        write_atomically(docs / name, lambda file, content=content: file.write(content))
    return 0


def unfinished() -> int:
    print("the time is over and not all is done: call it again", file=sys.stderr)
    return UNFINISHED


def main(words: Sequence[str] | None = None) -> int:
    """The exit code of `measure`; 2 and a line where words, captures or sources are not what is needed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("captures", type=Path, nargs=3)
    parser.add_argument("stages", nargs="*", metavar="stage", help="all where absent")
    parser.add_argument("--within", type=parse_seconds, default="9m")
    options = parser.parse_args(words)
    scenes = {path.resolve().name: path.resolve() for path in options.captures}
    stages, commit = options.stages or list(STAGES), source_commit()
    if scenes.keys() != set(CAPTURES):
        parser.error(f"README is of {', '.join(CAPTURES)}: folders of these names are needed, got {', '.join(scenes)}")
    if unknown := set(stages) - set(STAGES):
        parser.error(f"no stage {', '.join(unknown)}: {', '.join(STAGES)}")
    least = 60 + max(work.seconds for stage in stages for work in STAGES[stage])
    if options.within < least:
        parser.error(f"--within: at least {least}s, or the longest piece of work would never begin")
    if not commit or commit.endswith(MODIFIED):
        parser.error(f"the sources are not those of a commit: commit them, or name theirs by {COMMIT_VARIABLE}")
    return measure(options.out.resolve() / commit, ROOT / "docs", scenes, stages, options.within)


if __name__ == "__main__":
    sys.exit(main())
