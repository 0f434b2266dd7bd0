"""Exposures on a GPU, and iterations with and without them, which wait for nothing."""

import pytest
import torch
from helpers.framework_runs import assert_iterations_wait_for_nothing, tiny_capture, tiny_config
from helpers.raster_cases import GPU_ONLY

from turbogs_plugin.captures import load_scene
from turbogs_plugin.train.loop import TrainingLoop
from turbogs_plugin.train.trainer import Trainer

pytestmark = GPU_ONLY

DEVICE = torch.device("cuda")
ALL_VIEWS = ("schedule.min_views=7", "schedule.max_views=7")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return load_scene(tiny_capture(tmp_path_factory.mktemp("exposures")))


@pytest.mark.parametrize(("exposure", "place"), [(False, "device"), (True, "device"), (True, "host")])
def test_iterations_between_events_wait_for_nothing(scene, exposure, place):
    overrides = (f"train.exposure={exposure}", "density.refine_from=1000", f"train.pixels_place={place}")
    config = tiny_config("capture", "train.device=cuda", *overrides)
    trainer = Trainer(config.without_plan(), scene, DEVICE)
    assert_iterations_wait_for_nothing(trainer)
    if exposure:
        assert trainer.exposures.offsets.any() and trainer.exposures.offsets.mean(dim=0).abs().max() < 1e-6


def test_a_whole_run_on_the_gpu_ends_near_that_of_the_reference(scene):
    exposures = []
    for device in ("cuda", "cpu"):
        config = tiny_config("capture", f"train.device={device}", "train.exposure=true", *ALL_VIEWS)
        trainer = Trainer(config.without_plan(), scene, torch.device(device))
        TrainingLoop(trainer).run()
        exposures.append(trainer.exposures)
    assert exposures[0].steps.tolist() == exposures[1].steps.tolist()
    assert exposures[0].offsets.any() and (exposures[0].offsets.cpu() - exposures[1].offsets).abs().max() < 0.03
