"""Maps and photos in host memory while a GPU trains: the bits of resident ones, and captures that do not fit."""

import copy
import gc

import pytest
import torch
from helpers.raster_cases import GPU_ONLY
from helpers.synthetic_capture import synthetic_scene

from turbogs_plugin.config.configuration import Config, load_config
from turbogs_plugin.error_maps import AGE_MAX
from turbogs_plugin.plan import make_plan
from turbogs_plugin.plan.memory import hold_to_limit, within_memory
from turbogs_plugin.scene import Scene
from turbogs_plugin.scene.offload import place_views
from turbogs_plugin.train.loop import TrainingLoop
from turbogs_plugin.train.metrics import evaluate
from turbogs_plugin.train.trainer import Trainer

pytestmark = GPU_ONLY

GPU = torch.device("cuda")
LIMIT = "6GiB"


@pytest.fixture(scope="module")
def scene() -> Scene:
    return synthetic_scene(24, 333, 215, GPU, gaussians=20_000)


def config_of(*overrides: str) -> Config:
    lengths = ("train.iterations=40", "train.refine_until=30", "train.sh_interval=8", "schedule.max_views=5")
    return load_config("turbogs", [*lengths, *overrides])


EVENTS = ("density.refine_from=5", "density.refine_every=10")
STILL = ("optimizer.type=sparse_adam", "optimizer.learning_rates.batch_scale=0", "density.type=none")
"""The model stands still, and its renders are the same to the bit. (Gradients are summed in any order on a GPU, so that
models that learn differ in their last bits.)"""


def trained(scene: Scene, place: str, iterations: int, *overrides: str) -> Trainer:
    config = config_of(f"train.pixels_place={place}", *overrides).without_plan()
    trainer = Trainer(config, scene, GPU)
    trainer.initialise_maps()
    run(trainer, iterations)
    return trainer


def run(trainer: Trainer, iterations: int) -> None:
    TrainingLoop(trainer).advance(trainer.iteration + iterations)


def assert_same_maps(a: Trainer, b: Trainer) -> None:
    left, right = (copy.deepcopy(trainer.maps.state_dict()) for trainer in (a, b))
    for name, value in left.items():
        same = torch.equal(value.cpu(), right[name].cpu()) if isinstance(value, torch.Tensor) else value == right[name]
        assert same, name


@pytest.mark.parametrize("unit", ["pixel", "tile"])
def test_maps_and_samples_are_those_of_resident_ones(scene, unit):
    unit_of = f"pixel_sampler.unit={unit}"
    resident, offloaded = (trained(scene, place, 30, unit_of, *STILL) for place in ("device", "host"))
    assert torch.equal(resident.gaussians.means, offloaded.gaussians.means)
    assert_same_maps(resident, offloaded)
    step = resident.now
    samples = [trainer.pixel_sampler.sample(trainer.maps, (7, 2, 11), 0.2, step) for trainer in (resident, offloaded)]
    assert torch.equal(samples[0].pixel_ids, samples[1].pixel_ids)
    pairs = zip((resident, offloaded), samples, strict=True)
    assert torch.equal(*(trainer.views.photos.at(drawn).colors() for trainer, drawn in pairs))
    assert (offloaded.maps.offsets == offloaded.views.photos.offsets).all()


def test_maps_follow_through_checkpoints_and_the_turn_of_the_stamps(scene):
    resident, offloaded = (trained(scene, place, 8, *STILL) for place in ("device", "host"))
    resumed = Trainer(offloaded.config, scene, GPU)
    resumed.load_state_dict(copy.deepcopy(offloaded.state_dict()))
    for trainer in (resident, offloaded, resumed):
        trainer.iteration = AGE_MAX + 20
        run(trainer, 8)
        assert trainer.maps.stamp_base == AGE_MAX + 20
    assert_same_maps(resident, offloaded)
    assert_same_maps(resident, resumed)


def test_iterations_that_do_nothing_leave_the_maps_alone(scene, monkeypatch):
    trainer = trained(scene, "host", 10, *EVENTS)
    before = copy.deepcopy(trainer.maps.state_dict())
    trainer.engine.workspace.status[1] = 1  # as after an overflow
    monkeypatch.setattr(trainer.engine.workspace, "take_lost", lambda wait=False: 0)  # the host does not know yet
    trainer.step()
    trainer.step()
    after = trainer.maps.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in ("errors", "stamps"))
    assert torch.equal(before["view_sums"], after["view_sums"])


def test_a_capture_larger_than_the_limit_trains_within_it():
    """200 photos of 3840x2160: 10 GB of maps and photos in 6 GiB, beside everything else."""
    scene = synthetic_scene(200, 3840, 2160, GPU, gaussians=207_360)
    torch.cuda.empty_cache()
    asked = config_of(f"budget.max_memory={LIMIT}", *EVENTS)
    limit = asked.budget.memory_bytes()
    sizes = scene.train.cameras.sizes.prod(axis=1).sum()
    assert 7 * sizes > 1.5 * limit
    try:
        plan = make_plan(asked, scene, GPU)
        config = within_memory(plan.apply(asked), scene)
        hold_to_limit(config, GPU)
        assert config.train.pixels_place == "host"
        with pytest.raises(torch.cuda.OutOfMemoryError):
            Trainer(config_of("train.pixels_place=device").without_plan(), scene, GPU)
        gc.collect()
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
        trainer = Trainer(config, scene, GPU)
        trainer.initialise_maps()
        first = trainer.maps.view_means().mean()
        run(trainer, 30)
        test = place_views(scene.test, GPU, "host")
        evaluate(trainer.gaussians, test, trainer.look(test.names))
        assert torch.cuda.max_memory_reserved() <= limit
        assert len(trainer.gaussians) <= config.density["max_gaussians"]
        trainer.maps._means.restart()
        assert trainer.maps.view_means().mean() < first
    finally:
        torch.cuda.set_per_process_memory_fraction(1.0)
