"""README's picture: a test view after some seconds of training, by gsplat's own simple_trainer and by `turbogs train`.

    python examples/simple_trainer/picture.py --host .hosts/1.5.3 --scene PATH/caliterra --out docs/seconds.jpg

Both train on this machine's GPU, one after the other, with photos on the GPU and without exposures; each clock counts
training alone. A training that has ended shows its end. OUT's .json has seconds, steps and PSNR of every picture.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from compare import HERE, TRAINER, require_host
from PIL import Image, ImageDraw, ImageFont

from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.engine.render import render_image
from turbogs_plugin.train.loop import Listener, TrainingLoop
from turbogs_plugin.train.run import train
from turbogs_plugin.train.session import RunSession

BAR = 26
"""Pixels above a picture, for its text."""


@dataclass
class Options:
    """
    Args:
        host: a copy of gsplat's repository, with examples/simple_trainer.py of 1.5.3.
        scene: a folder with images/ and sparse/0/; every 8th photo is a test photo, for both.
        out: the picture, a .jpg.
        seconds: of training, a column each.
        view: number of the test view.
        width: of a picture, pixels.
        overrides: of `turbogs train`.
    """

    host: Path
    scene: Path
    out: Path
    seconds: tuple[int, ...] = (1, 3, 10)
    view: int = 0
    width: int = 400
    overrides: tuple[str, ...] = ()


@dataclass
class Taken:
    image: Image.Image
    seconds: float  # of training
    step: int
    psnr: float  # of this view, dB
    ended: bool = False


class Pictures(Listener):
    """Takes pictures of a test view as they fall due, off the clock."""

    def __init__(self, session: RunSession, options: Options, taken: list[Taken]) -> None:
        self.session, self.options, self.taken = session, options, taken

    def begun(self, loop: TrainingLoop) -> None:
        self.zero = time.perf_counter() - loop.clock.seconds

    def advanced(self, loop: TrainingLoop) -> None:
        due = self.options.seconds[len(self.taken) :]
        if due and not loop.finished and time.perf_counter() - self.zero >= due[0]:
            stopped = time.perf_counter()
            with loop.clock.stopped():
                self.take()
            self.zero += time.perf_counter() - stopped

    def take(self) -> None:
        trainer, view, views = self.session.trainer, self.options.view, self.session.test
        truth = views.photos.image(view)  # [H, W, 3]
        colors = render_image(trainer.gaussians, views.cameras, view, sh_degree=trainer.sh_degree).colors.clamp(0, 1)
        psnr = -10 * float((colors - truth).square().mean().log10())
        image = Image.fromarray((255 * colors).round().byte().cpu().numpy())
        ended = self.session.loop.finished
        self.taken.append(Taken(image, self.session.loop.clock.seconds, trainer.iteration, psnr, ended))


def by_turbogs(options: Options, folder: Path) -> list[Taken]:
    overrides = ("train.exposure=false", "train.evaluate_at=[]", *options.overrides)
    config = load_config("turbogs", (f"scene.path={options.scene}", *overrides))
    taken: list[Taken] = []
    pictures: list[Pictures] = []

    def listener(session: RunSession) -> Listener:
        pictures.append(Pictures(session, options, taken))
        return pictures[0]

    train(config, folder / "run", watch=[listener])
    while len(taken) < len(options.seconds):
        pictures[0].take()
    return taken


def by_gsplat(options: Options, folder: Path) -> list[Taken]:
    record = folder / "record.json"
    words = " ".join(map(str, (options.view, *options.seconds)))
    paths = [options.host.resolve(), options.host.resolve() / "examples", *filter(None, sys.path)]
    environment = {**os.environ, "MEASURED_PICTURES": words, "PYTHONPATH": os.pathsep.join(map(str, paths))}
    command = [sys.executable, HERE / "measured.py", options.host / TRAINER, record, "default", "--disable_viewer"]
    command += ["--disable_video", "--data_dir", options.scene, "--data_factor", "1", "--result_dir", folder]
    subprocess.run([str(part) for part in command], env=environment, check=True)
    return [
        Taken(Image.open(folder / f"record_{each.pop('mark')}.png"), **each)
        for each in json.loads(record.read_text())["pictures"]
    ]


def strip(rows: dict[str, list[Taken]], width: int) -> Image.Image:
    """A row of pictures a program, its name, seconds and PSNR above each."""
    first = next(iter(rows.values()))
    height = round(width * first[0].image.height / first[0].image.width)
    whole = Image.new("RGB", (len(first) * width, len(rows) * (height + BAR)), "white")
    draw, font = ImageDraw.Draw(whole), ImageFont.load_default(size=17)
    for row, (name, taken) in enumerate(rows.items()):
        for column, each in enumerate(taken):
            left, top = column * width, row * (height + BAR)
            text = f"{name}: {each.seconds:.1f} s{', its end' if each.ended else ''}, {each.psnr:.1f} dB"
            draw.text((left + 4, top + 3), text, fill="black", font=font)
            whole.paste(each.image.resize((width, height), Image.Resampling.LANCZOS), (left, top + BAR))
    return whole


def main(options: Options) -> None:
    require_host(options.host)
    with tempfile.TemporaryDirectory() as name:
        rows = {"gsplat": by_gsplat(options, Path(name)), "turbogs": by_turbogs(options, Path(name))}
        strip(rows, options.width).save(options.out, quality=82)
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"
    record = {
        name: [{key: value for key, value in vars(each).items() if key != "image"} for each in taken]
        for name, taken in rows.items()
    }
    options.out.with_suffix(".json").write_text(json.dumps({"device": device, "view": options.view, **record}) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options))
