"""Makes the pictures at the top of README.md from a run and its capture:

    python docs/make_pictures.py RUN VIEW

VIEW is the number of a training view. `docs/render.jpg` is the model of the run's newest checkpoint from there.
`docs/overlays.jpg` shows what the viewer of `turbogs train --viewer` shows of that view: the error map, and the samples
of an iteration. Training goes on from the checkpoint, in memory alone, until an iteration samples the view. The model's
render stands in for the photo behind the samples: photos of captures stay out of this repository.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image
from torch import Tensor

from turbogs_plugin.report.pictures import GAP
from turbogs_plugin.train.checkpoint import latest_checkpoint, load_checkpoint
from turbogs_plugin.train.evaluate import render_view
from turbogs_plugin.train.folder import RunFolder
from turbogs_plugin.train.loop import TrainingLoop
from turbogs_plugin.train.pace import pace_of
from turbogs_plugin.train.run import RunSession, open_scene, resolve_device
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.types import Gaussians, PixelSamples, RowUpdate, Step
from turbogs_plugin.viewer.eye import Eye
from turbogs_plugin.viewer.pictures import Picture, Request, draw
from turbogs_plugin.viewer.subject import CaptureViews, Subject

FOLDER = Path(__file__).resolve().parent
WIDTH = 800
"""Pixels of the render, about as wide as a page shows it."""
JPEG_QUALITY = 88
MOST_ITERATIONS = 500


@dataclass
class Observer:
    """Keeps the samples of the last iteration."""

    samples: PixelSamples | None = None

    def sampled(self, samples: PixelSamples) -> None:
        self.samples = samples

    def changing(self, gaussians: Gaussians, update: RowUpdate, step: Step) -> None:
        pass


@dataclass
class Renders:
    """In the place of a capture's photos: what the model shows there."""

    trainer: Trainer

    def image(self, view_id: int) -> Tensor:
        """[H, W, 3] float32, 0 .. 1."""
        trainer = self.trainer
        return render_view(trainer.gaussians, trainer.views, view_id, trainer.sh_degree, trainer.config.raster)


def main() -> None:
    folder, view = RunFolder(Path(sys.argv[1])), int(sys.argv[2])
    config = folder.read_config()
    scene = open_scene(config, folder)
    trainer = Trainer(config, scene, resolve_device(config.train.device), resuming=True)
    session = RunSession(folder, None, scene, TrainingLoop(trainer, pace_of(config)))
    checkpoint = latest_checkpoint(folder.checkpoints)
    session.load_state_dict(load_checkpoint(checkpoint), str(checkpoint))

    eye = Eye.of_view(trainer.views.cameras, view)
    large = replace(eye, width=WIDTH, height=round(WIDTH * eye.height / eye.width))
    _save("render.jpg", draw(_subject(trainer), Request(Picture.RENDER, large)))

    trainer.observer = observer = Observer()
    for _ in range(MOST_ITERATIONS):
        trainer.step()
        if view in observer.samples.view_ids:
            break
    subject = _subject(trainer, observer.samples)
    panels = [draw(subject, Request(picture, eye, view)) for picture in (Picture.ERRORS, Picture.SAMPLES)]
    gap = np.full((eye.height, GAP, 3), 255, dtype=np.uint8)
    _save("overlays.jpg", np.concatenate([panels[0], gap, panels[1]], axis=1))
    own = observer.samples.view_of_slot() == observer.samples.view_ids.index(view)
    share = float(observer.samples.filled[own].sum()) / (eye.width * eye.height)
    print(
        f"{scene.name}, {trainer.views.names[view]}: iteration {trainer.iteration}, "
        f"{len(trainer.gaussians)} Gaussians, {100 * share:.0f} % of the view's pixels sampled"
    )


def _subject(trainer: Trainer, samples: PixelSamples | None = None) -> Subject:
    views = replace(trainer.views, photos=Renders(trainer))
    capture = CaptureViews(views, views)
    settings = trainer.config.raster
    state = {"capture": capture, "maps": trainer.maps, "step": trainer.now, "samples": samples}
    return Subject(trainer.gaussians, trainer.sh_degree, settings=settings, **state)


def _save(name: str, pixels: np.ndarray) -> None:
    Image.fromarray(pixels).save(FOLDER / name, quality=JPEG_QUALITY, subsampling=0)
    print(f"{name}  {(FOLDER / name).stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
