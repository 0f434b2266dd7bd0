"""The viewer on a GPU: its pictures are those of the reference."""

import numpy as np
import pytest
import torch
from helpers.framework_runs import tiny_capture, tiny_config

from turbogs_plugin.captures import load_scene
from turbogs_plugin.device import synchronize
from turbogs_plugin.engine.cuda import library as kernels
from turbogs_plugin.engine.rendering import splats_per_tile
from turbogs_plugin.plan import make_plan
from turbogs_plugin.scene.offload import place_views
from turbogs_plugin.train.run import new_loop
from turbogs_plugin.viewer.eye import Eye
from turbogs_plugin.viewer.pictures import Picture, Request, draw
from turbogs_plugin.viewer.subject import CaptureViews, DensityChange, Subject

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
def subjects(request, tmp_path_factory) -> tuple[Subject, Subject]:
    """A model at the end of its densification on a GPU, and the same with everything on the CPU."""
    capture = tiny_capture(tmp_path_factory.mktemp("viewer"))
    places = (f"train.maps_place={request.param}", f"train.photos_place={request.param}")
    config = tiny_config(capture, "train.device=cuda", "train.iterations=8", "train.refine_until=8", *places)
    scene = load_scene(capture)
    loop, _ = new_loop(make_plan(config, scene, CUDA).apply(config), scene, CUDA)
    trainer = loop.trainer
    trainer.observer = watcher = Watcher()
    loop.run()
    synchronize(CUDA)
    views = CaptureViews(trainer.views, place_views(scene.test, CUDA, request.param))
    here = Subject(trainer.gaussians, trainer.sh_degree, capture=views, maps=trainer.maps, step=trainer.now)
    here.samples, here.change = watcher.samples, watcher.change
    there = Subject(trainer.gaussians.map(torch.Tensor.cpu), trainer.sh_degree, capture=CaptureViews(*split(scene)))
    change = watcher.change
    there.change = DensityChange(change.iteration, change.added.cpu(), change.removed.map(torch.Tensor.cpu), 0, 0, 0)
    return here, there


def split(scene):
    return scene.train.to(CPU), scene.test.to(CPU)


@pytest.mark.parametrize("picture", [Picture.RENDER, Picture.CHANGES, Picture.COMPARE, Picture.PHOTO])
def test_pictures_are_those_of_the_reference(subjects, picture):
    here, there = subjects
    for view in (0, 3, 6):
        request = Request(picture, Eye.of_view(there.capture.train.cameras, view), view)
        found, expected = (draw(subject, request).astype(int) for subject in (here, there))
        assert found.std() > 5
        # A colour of the error's scale may jump with the last digit.
        differing = (np.abs(found - expected) > 2).mean()
        assert differing <= (0.01 if picture is Picture.COMPARE else 0.0)


@pytest.mark.parametrize("picture", list(Picture))
def test_every_picture_is_drawn(subjects, picture):
    here, there = subjects
    eye = Eye.of_view(there.capture.train.cameras, 2)
    found = draw(here, Request(picture, eye, 2))
    assert found.shape == (eye.height, eye.width, 3) and found.std() > 1


def test_splats_are_counted_as_on_the_cpu(subjects):
    here, there = subjects
    cameras = there.capture.train.cameras
    for view in range(len(cameras)):
        counts = splats_per_tile(here.gaussians, cameras.to(CUDA), view).cpu()
        expected = splats_per_tile(there.gaussians, cameras, view)
        assert expected.sum() > 100 and (counts - expected).abs().sum() <= 0.002 * expected.sum()
