"""The cap on Gaussians, and what a run takes of the device's memory."""

import json
from pathlib import Path

import numpy as np
import pytest

from turbogs_plugin.config.configuration import load_config, resolve
from turbogs_plugin.config.sections import parse_bytes
from turbogs_plugin.errors import InputError
from turbogs_plugin.plan.caps import FEWEST_GAUSSIANS, cap_of, chosen_points, growth_room, with_cap, without_growth
from turbogs_plugin.plan.memory import MemoryDemand, most_images


@pytest.mark.parametrize("kind", ["error_driven", "mcmc", "none"])
def test_a_cap_is_a_setting_of_the_density_control(kind):
    capped = with_cap(load_config("turbogs", [f"density.type={kind}"]), 5000)
    assert capped == load_config("turbogs", [f"density.type={kind}", "density.max_gaussians=5000"])
    assert capped.density["max_gaussians"] == cap_of(capped) == capped.build("density").max_gaussians == 5000
    assert resolve(capped.to_mapping()) == capped
    assert with_cap(capped, 7000).density["max_gaussians"] == 7000, "what is asked for last is set"
    still = without_growth(capped)
    assert (still.density, cap_of(still)) == ({"type": "none", "max_gaussians": 5000}, 5000)


def test_no_cap_is_0():
    free = load_config("turbogs")
    assert cap_of(free) == cap_of(without_growth(free)) == 0


@pytest.mark.parametrize(
    ("settings", "times"),
    [
        (["density.final_every=500"], 0.95**-2),
        (["density.final_every=200"], 0.95**-3),
        (["density.final_every=2000"], 1.0),
        (["density.final_keep=1"], 1.0),
        (["density.final_keep=0.1"], 2.0),
        (["density.final_keep=1e-300"], 2.0),
        (["density.type=mcmc"], 1.0),
        (["density.type=none"], 1.0),
    ],
)
def test_a_memory_budget_leaves_room_for_what_is_grown_beyond_the_cap(settings, times):
    config = load_config("turbogs", ["train.iterations=5000", "train.refine_until=3500", *settings])
    assert growth_room(config) == pytest.approx(times)


@pytest.mark.parametrize("kind", ["gsplat_default", "fastgs"])
def test_a_cap_that_nobody_would_keep_is_refused(turbogs, tmp_path, kind):
    config = load_config("turbogs", [f"density.type={kind}"])
    assert cap_of(config) == 0
    words = f"density.type {kind} keeps no cap on Gaussians: use one of error_driven, mcmc, none"
    with pytest.raises(InputError, match=words):
        with_cap(config, 10)
    options = [f"density.type={kind}", "--out", tmp_path / "run", "--max-gaussians", 10]
    code, _, err = turbogs("train", tmp_path, *options)
    assert code == 2 and words in err


def test_a_model_begins_with_points_from_the_first_to_the_last_that_leave_room():
    chosen = chosen_points(100, 30, 10)
    assert len(chosen) == 20 and (chosen[0], chosen[-1]) == (0, 99)
    assert set(np.diff(chosen)) == {5, 6}
    assert chosen_points(20, 30, 10) == chosen_points(20, 0, 10) == slice(None)
    with pytest.raises(InputError, match="leaves no room beside the 30"):
        chosen_points(20, 30, 30)


def demand(*overrides: str) -> MemoryDemand:
    config = load_config("turbogs", ["schedule.max_views=10", "train.sh_degree=3", *overrides])
    return MemoryDemand.of(config, np.full((200, 2), (3840, 2160)), np.full((25, 2), (3840, 2160)))


def test_memory_is_what_is_kept_and_what_is_done_with_it():
    resident, windows = (demand(f"train.pixels_place={place}") for place in ("device", "host"))
    assert resident.per_gaussian == windows.per_gaussian == 2 * (59 * 4 * 3 + 4 + 32) + 230 * 10
    assert resident.fixed - windows.fixed == (4 * (200 - 20) + 3 * (225 - 22)) * 8_294_400
    assert demand("train.sh_degree=0").per_gaussian == resident.per_gaussian - 2 * 45 * 12


def test_no_measured_peak_is_above_the_prediction():
    """Nor far below: the measured iterations have neither an event of density control nor an evaluation in them."""
    report = json.loads((Path(__file__).parents[2] / "docs/lab/step-h200.json").read_text())
    assert len(report["passes"]) >= 4
    for entry in report["passes"]:
        fixed = ("schedule.type=fixed", f"schedule.views={entry['views']}", "train.sh_degree=3")
        sizes = np.full((report["training_views"], 2), report["image_size"])
        memory = MemoryDemand.of(load_config("turbogs", fixed), train_sizes=sizes, test_sizes=sizes[:0])
        predicted = memory.fixed + memory.per_gaussian * entry["gaussians"]
        assert 1.0 <= predicted / entry["memory_bytes"]["peak"] <= 1.6


@pytest.mark.parametrize("limit", [2**33, 2**34])
def test_as_many_gaussians_as_fit(limit):
    memory = demand("train.pixels_place=host")
    count = memory.gaussians(limit)
    assert memory.fixed + count * memory.per_gaussian <= limit < memory.fixed + (count + 1) * memory.per_gaussian


def test_too_little_memory_says_how_much_would_do():
    memory = demand()
    with pytest.raises(InputError, match="leaves no room for a model") as refused:
        memory.gaussians(2**31)
    wanted = parse_bytes(str(refused.value).split(" take ")[1].split(" here")[0])
    assert memory.gaussians(wanted) >= FEWEST_GAUSSIANS


@pytest.mark.parametrize(
    ("changes", "images"),
    [
        (("pixel_sampler.multiple=1",), 1.0),
        ((), 1.25),  # ten views with 32 pixels of a tile for 25.6, or five with 64 for 51.2
        (("schedule.pixel_budget=0.5",), 1.25),
        (("pixel_sampler.unit=tile",), 1.0),
        (("pixel_sampler.type=random", "pixel_sampler.multiple=256"), 10.0),
    ],
)
def test_memory_is_for_the_most_pixels_of_an_iteration(changes, images):
    assert most_images(load_config("turbogs", changes), num_views=65) == images
