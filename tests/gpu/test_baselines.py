"""The baselines on a GPU: whole runs, with torch's fused Adam and gsplat's own operators."""

import pytest
import torch
from helpers.framework_runs import assert_iterations_wait_for_nothing
from helpers.raster_cases import GPU_ONLY

from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.train.run import train
from turbogs_plugin.train.trainer import Trainer

pytestmark = GPU_ONLY

OFTEN = ("density.refine_start_iter=9", "density.refine_every=10")
SOON = {"3dgs": OFTEN, "3dgs-as-shipped": OFTEN, "mcmc": (*OFTEN, "density.max_gaussians=2000")}


@pytest.mark.parametrize("name", SOON)
def test_baselines_train(capture, tmp_path, name):
    length = ("train.iterations=100", "train.refine_until=30", "train.sh_interval=50", "train.device=cuda")
    config = load_config(name, [*length, "train.evaluate_at=[0.5]", *SOON[name]])
    config.scene.path = str(capture)
    outcome = train(config, tmp_path / "run")
    assert outcome.history[-1].psnr > outcome.history[0].psnr
    assert outcome.history[-1].num_gaussians > outcome.history[0].num_gaussians


def test_a_baseline_waits_for_nothing_between_events(scene):
    config = load_config("3dgs", ["train.device=cuda", "density.refine_start_iter=1000"])
    assert_iterations_wait_for_nothing(Trainer(config.without_plan(), scene, torch.device("cuda")))
