"""The viewer on a GPU: its pictures are those of the reference."""

import numpy as np
import pytest
import torch
from helpers.framework_runs import tiny_capture, tiny_config

from turbogs_plugin.captures import load_scene
from turbogs_plugin.device import synchronize
from turbogs_plugin.engine.cuda import library as kernels
from turbogs_plugin.plan import make_plan
from turbogs_plugin.scene.offload import place_views
from turbogs_plugin.train.run import new_loop
from turbogs_plugin.types import RowUpdate
from turbogs_plugin.viewer.camera import ViewerCamera
from turbogs_plugin.viewer.model_state import CaptureViews, DensityChange, ModelState
from turbogs_plugin.viewer.pictures import Picture, Request, draw

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not kernels.available(), reason="needs a GPU and the kernels"),
]
CUDA, CPU = torch.device("cuda"), torch.device("cpu")


class Watcher:
    """Keeps what a training tells."""

    samples = change = None

    def sampled(self, samples) -> None:
        self.samples = samples

    def changing(self, gaussians, update, step) -> None:
        self.change = DensityChange.of(gaussians, update, step.iteration)


@pytest.fixture(scope="module", params=["device", "host"])
def subjects(request, tmp_path_factory) -> tuple[ModelState, ModelState]:
    """A model at the end of its densification on a GPU, and the same with everything on the CPU."""
    capture = tiny_capture(tmp_path_factory.mktemp("viewer"))
    places = (f"train.maps_place={request.param}", f"train.photos_place={request.param}")
    config = tiny_config(capture, "train.device=cuda", "train.iterations=8", "train.refine_until=8", *places)
    scene = load_scene(capture)
    loop = new_loop(make_plan(config, scene, CUDA).apply(config), scene, CUDA)
    trainer = loop.trainer
    trainer.observer = watcher = Watcher()
    loop.run()
    synchronize(CUDA)
    views = CaptureViews(trainer.views, place_views(scene.test, CUDA, request.param))
    here = ModelState(trainer.gaussians, trainer.sh_degree, capture=views, maps=trainer.maps, step=trainer.now)
    here.samples, here.change = watcher.samples, watcher.change
    there = ModelState(trainer.gaussians.map(torch.Tensor.cpu), trainer.sh_degree, capture=CaptureViews(*split(scene)))
    change = watcher.change
    update = RowUpdate(change.update.source.cpu(), change.update.fresh.cpu(), {})
    there.change = DensityChange(change.iteration, update, change.removed.map(torch.Tensor.cpu))
    return here, there


def split(scene):
    return scene.train.to(CPU), scene.test.to(CPU)


@pytest.mark.parametrize("picture", [Picture.RENDER, Picture.CHANGES, Picture.COMPARE])
def test_pictures_are_those_of_the_reference(subjects, picture):
    here, there = subjects
    for view in (0, 3, 6):
        request = Request(picture, ViewerCamera.of_view(there.capture.train.cameras, view), view)
        found, expected = (draw(subject, request).astype(int) for subject in (here, there))
        assert found.std() > 5
        # A colour of the error's scale may jump with the last digit.
        differing = (np.abs(found - expected) > 2).mean()
        assert differing <= (0.01 if picture is Picture.COMPARE else 0.0)


@pytest.mark.parametrize("picture", list(Picture))
def test_every_picture_is_drawn(subjects, picture):
    here, there = subjects
    eye = ViewerCamera.of_view(there.capture.train.cameras, 2)
    found = draw(here, Request(picture, eye, 2))
    assert found.shape == (eye.height, eye.width, 3) and found.std() > 1
