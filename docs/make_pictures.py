"""Makes the pictures at the top of README.md from a run and its capture:

    python docs/make_pictures.py RUN VIEW [FOLDER]

VIEW is the number of a training view. ``render.jpg`` is the model of the run's newest checkpoint from there.
``overlays.jpg`` shows what the viewer of `turbogs train --viewer` shows of the middle of that view early in the run:
the error map, and the samples of an iteration. For this the run is trained again, in memory alone, up to the first
iteration after an eighth of it that samples the view. The model's render stands in for the photo behind the samples:
photos of captures stay out of this repository. ``pictures.json`` is what `make pages` writes below the pictures.

FOLDER is where the three go; where absent, docs/ and docs/results/.
"""

from __future__ import annotations

import io
import json
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image
from torch import Tensor

from turbogs_plugin.report.pictures import GAP
from turbogs_plugin.report.provenance import provenance
from turbogs_plugin.scene import Scene
from turbogs_plugin.train.history import read_history
from turbogs_plugin.train.inputs import open_scene, resolve_device
from turbogs_plugin.train.look import Look
from turbogs_plugin.train.loop import Listener, TrainingLoop
from turbogs_plugin.train.metrics import render_view
from turbogs_plugin.train.run import new_loop
from turbogs_plugin.train.saved_model import SavedModel, load_model
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import Color, Gaussians, PixelSamples, RowUpdate, Step
from turbogs_plugin.viewer.eye import Eye
from turbogs_plugin.viewer.pictures import Picture, Request, draw
from turbogs_plugin.viewer.subject import CaptureViews, Subject

DOCS = Path(__file__).resolve().parent
EARLY = 8
"""The overlays are of an eighth of the training: errors are still seen, and an iteration samples few pixels."""
PART = 3
"""The overlays show a part of the view of a third of its width and height, where a page shows single pixels."""
LARGEST_FILE = 300_000
"""Bytes of a picture."""
JPEG_QUALITIES = range(92, 40, -4)


@dataclass
class EarlyLook(Listener):
    """Stops a training at the first iteration after an eighth of it that samples a view, and keeps its samples."""

    trainer: Trainer
    view: int
    samples: PixelSamples | None = None

    def sampled(self, samples: PixelSamples) -> None:
        self.samples = samples

    def changing(self, gaussians: Gaussians, update: RowUpdate, step: Step) -> None:
        pass

    def advanced(self, loop: TrainingLoop) -> None:
        if EARLY * self.trainer.iteration >= self.trainer.iterations and self.view in self.samples.view_ids:
            loop.stop()


@dataclass
class Renders:
    """In the place of a capture's photos: what the model shows there."""

    trainer: Trainer

    def image(self, view_id: int, background: Color) -> Tensor:
        """[H, W, 3] float32, 0 .. 1."""
        trainer = self.trainer
        look = Look(trainer.sh_degree, trainer.config.raster, background)
        return render_view(trainer.gaussians, trainer.views, view_id, look)


def main() -> None:
    run, view = Path(sys.argv[1]), int(sys.argv[2])
    pictures = facts = Path(sys.argv[3]) if len(sys.argv) > 3 else DOCS
    facts = facts / "results" if len(sys.argv) <= 3 else facts
    facts.mkdir(exist_ok=True)
    model = load_model(run, resolve_device("auto"))
    device, scene = model.gaussians.device, open_scene(model.config, model.folder)
    last = read_history(model.folder.history)[-1]
    record = {
        "provenance": asdict(provenance(device.type)),
        "scene": scene.name,
        "view": view,
        "training_views": len(scene.train),
        "size": scene.train.cameras.sizes[view].tolist(),
        "factor": model.config.scene.factor,
        "iteration": model.iteration,
        "gaussians": len(model.gaussians),
        "psnr": last.psnr,
        "train_seconds": last.train_seconds,
    }
    _save(pictures / "render.jpg", _render(model, scene, view))
    pixels, early = _overlays(model, scene, view)
    _save(pictures / "overlays.jpg", pixels)
    text = json.dumps(record | {"early": early}, indent=1)
    (facts / "pictures.json").write_text(text + "\n")
    print(text)


def _render(model: SavedModel, scene: Scene, view: int) -> np.ndarray:
    subject = Subject(model.gaussians, model.sh_degree, settings=model.config.raster)
    return draw(subject, Request(Picture.RENDER, Eye.of_view(scene.train.cameras, view)))


def _overlays(model: SavedModel, scene: Scene, view: int) -> tuple[np.ndarray, dict[str, object]]:
    """[H, W, 3] uint8, error map and samples side by side; and what they are of."""
    loop = new_loop(model.config, scene, model.gaussians.device)
    trainer = loop.trainer
    trainer.observer = look = EarlyLook(trainer, view)
    loop.listeners = [look]
    loop.run()
    views = replace(trainer.views, photos=Renders(trainer))
    state = {"capture": CaptureViews(views, views), "maps": trainer.maps, "step": trainer.now}
    samples = look.samples
    subject = Subject(trainer.gaussians, trainer.sh_degree, settings=trainer.config.raster, samples=samples, **state)
    eye = Eye.of_view(trainer.views.cameras, view)
    rows, columns = _part((eye.width, eye.height))
    panels = [
        draw(subject, Request(picture, eye, view))[rows, columns] for picture in (Picture.ERRORS, Picture.SAMPLES)
    ]
    height, width = panels[0].shape[:2]
    gap = np.full((height, GAP, 3), 255, dtype=np.uint8)
    of_view = samples.view_of_slot() == samples.view_ids.index(view)
    return np.concatenate([panels[0], gap, panels[1]], axis=1), {
        "iteration": trainer.iteration,
        "gaussians": len(trainer.gaussians),
        "part": [width, height],
        "views": len(samples.view_ids),
        "share": float(samples.filled[of_view].sum()) / (eye.width * eye.height),
    }


def _part(size: tuple[int, int]) -> tuple[slice, slice]:
    """The rows and columns of the middle of a view of this (width, height)."""
    columns, rows = (slice((side - side // PART) // 2, (side + side // PART) // 2) for side in size)
    return rows, columns


def _save(path: Path, pixels: np.ndarray) -> None:
    """Write a JPEG, as good as fits into `LARGEST_FILE`."""
    for quality in JPEG_QUALITIES:
        buffer = io.BytesIO()
        Image.fromarray(pixels).save(buffer, "JPEG", quality=quality, subsampling=0)
        if buffer.tell() <= LARGEST_FILE:
            break
    path.write_bytes(buffer.getvalue())
    print(f"{path}  {pixels.shape[1]}x{pixels.shape[0]}, {buffer.tell():,} bytes at quality {quality}")


if __name__ == "__main__":
    main()
