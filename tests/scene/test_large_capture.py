"""The synthetic capture of tests, and the way of one that does not fit, at a size that does."""

import numpy as np
import pytest
import torch
from helpers.synthetic_capture import synthetic_scene

from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.plan import make_plan
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.offload import place_views
from turbogs_plugin.train.evaluate import Look, evaluate
from turbogs_plugin.train.trainer import Trainer

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return synthetic_scene(10, 48, 32, CPU, gaussians=400)


def test_a_synthetic_scene_is_one_like_any_other(scene):
    assert (len(scene.train), len(scene.test)) == (8, 2)
    assert scene.train.photos.colors.shape == (8 * 48 * 32, 3) and scene.train.photos.colors.dtype == torch.uint8
    assert len(set(scene.train.names) | set(scene.test.names)) == 10
    assert len(scene.points) == len(scene.point_colors) == 100
    centers = scene.train.cameras.centers
    assert scene.extent == pytest.approx(1.1 * float((centers - centers.mean(dim=0)).norm(dim=1).max()))
    photos = scene.train.photos.colors.float().view(8, -1)
    assert float(photos.std()) > 10.0  # something is to be seen,
    assert min(float((photos[a] - photos[a - 1]).abs().mean()) for a in range(8)) > 2.0  # from every camera another
    again = synthetic_scene(10, 48, 32, CPU, gaussians=400)
    assert torch.equal(again.train.photos.colors, scene.train.photos.colors)


def test_it_trains_from_host_memory(scene):
    """The path of the capture that exceeds a GPU's limit: plan, windows, training, evaluation."""
    overrides = ["train.iterations=12", "schedule.max_views=2", "schedule.min_views=2", "train.sh_degree=0"]
    overrides += ["train.maps_place=host", "train.photos_place=host", "density.type=none"]
    asked = load_config("turbogs", overrides)
    config = make_plan(asked, scene, CPU).apply(asked)
    trainer = Trainer(config, scene, CPU)
    trainer.initialise_maps()
    first = trainer.maps.mean()
    test = place_views(scene.test, CPU, config.train.photos_place)
    before = evaluate(trainer.gaussians, test, Look(0, config.raster)).mean.psnr
    for _ in range(12):
        trainer.step()
    assert trainer.maps.mean() < first
    assert evaluate(trainer.gaussians, test, Look(0, config.raster)).mean.psnr > before
    assert trainer.maps.window_bytes == 4 * (4 * 48 * 32 + 1)
    assert trainer.views.photos.window_bytes == 3 * (4 * 48 * 32 + 1)
    assert np.array_equal(trainer.maps.offsets, trainer.views.photos.offsets)
