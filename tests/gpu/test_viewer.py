"""The viewer on a GPU: its pictures are those of the reference."""

import numpy as np
import pytest
import torch
from helpers.framework_runs import tiny_capture, tiny_config
from helpers.raster_cases import GPU_ONLY

from turbogs_plugin.captures import load_scene
from turbogs_plugin.device import synchronize
from turbogs_plugin.engine.render_pass import DEFAULT_SETTINGS
from turbogs_plugin.plan import make_plan
from turbogs_plugin.scene.offload import place_views
from turbogs_plugin.train.look import Look
from turbogs_plugin.train.run import new_loop
from turbogs_plugin.viewer.camera import ViewerCamera
from turbogs_plugin.viewer.pictures import CaptureViews, ModelState, Picture, draw

pytestmark = GPU_ONLY
CUDA, CPU = torch.device("cuda"), torch.device("cpu")


@pytest.fixture(scope="module", params=["device", "host"])
def subjects(request, tmp_path_factory) -> tuple[ModelState, ModelState]:
    """A model at the end of its densification on a GPU, and the same with everything on the CPU."""
    capture = tiny_capture(tmp_path_factory.mktemp("viewer"))
    place = f"train.pixels_place={request.param}"
    config = tiny_config(capture, "train.device=cuda", "train.iterations=8", "train.refine_until=8", place)
    scene = load_scene(capture)
    loop = new_loop(make_plan(config, scene, CUDA).apply(config), scene, CUDA)
    trainer = loop.trainer
    loop.run()
    synchronize(CUDA)
    views = CaptureViews(trainer.views, place_views(scene.test, CUDA, request.param))
    look = Look(trainer.sh_degree, DEFAULT_SETTINGS)
    on_cpu = CaptureViews(scene.train.to(CPU), scene.test.to(CPU))
    here = ModelState(trainer.gaussians, look, views)
    return here, ModelState(trainer.gaussians.map(torch.Tensor.cpu), look, on_cpu)


@pytest.mark.parametrize("picture", [Picture.RENDER, Picture.COMPARE])
def test_pictures_are_those_of_the_reference(subjects, picture):
    here, there = subjects
    for view in (0, 3, 6):
        camera = ViewerCamera.of_view(there.capture.train.cameras, view)
        found, expected = (draw(subject, picture, camera, view)[0].astype(int) for subject in (here, there))
        assert found.std() > 5
        # A colour of the error's scale may jump with the last digit.
        differing = (np.abs(found - expected) > 2).mean()
        assert differing <= (0.01 if picture is Picture.COMPARE else 0.0)
