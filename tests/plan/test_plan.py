"""The plan: each decision on both sides of its criterion, what wins over it, and the configuration it leads to."""

import dataclasses
import json
import re

import numpy as np
import pytest
import torch
from helpers.framework_runs import TINY, stop_after

from turbogs_plugin.captures.load import load_scene
from turbogs_plugin.config.configuration import apply_overrides, config_names, load_config, resolve
from turbogs_plugin.config.sections import AUTO_SETTINGS
from turbogs_plugin.plan import SceneFacts
from turbogs_plugin.plan.decisions import RULES, plan_from_facts
from turbogs_plugin.plan.photo_gains import PhotoGains
from turbogs_plugin.report.run_report import write_report
from turbogs_plugin.study import cell as cell_module
from turbogs_plugin.study.results import StudyFolder
from turbogs_plugin.train import run
from turbogs_plugin.train.trainer import Trainer
from turbogs_plugin.yaml_json import parse_yaml

pytestmark = pytest.mark.usefixtures("plotted")

MIB = 2**20
FACTS = SceneFacts(
    train_views=100,
    direction_concentration=0.5,
    photo_bytes=100 * MIB,
    map_bytes=120 * MIB,
    device="cuda",
    device_bytes=1000 * MIB,
    host_bytes=8000 * MIB,
)
ALL_AUTO = tuple(f"train.{setting}=auto" for setting in RULES)


def facts(**changes) -> SceneFacts:
    return dataclasses.replace(FACTS, **changes)


def gains(spread: float, rest: float = 0.05, compared: int = 100) -> dict[str, PhotoGains]:
    return {"gains": PhotoGains(np.zeros((100, 3)), np.arange(100) < compared, spread, rest)}


def decision(setting: str, of: SceneFacts, *overrides: str):
    plan = plan_from_facts(of, load_config("turbogs", [f"train.{setting}=auto", *overrides]))
    return next(decision for decision in plan.decisions if decision.setting == setting)


ONE_VIEW = ("schedule.type=fixed", "schedule.views=1")

BOTH_SIDES = [
    ("backdrop", {"direction_concentration": 0.95}, (), True, "0.950 >= 0.95"),
    ("backdrop", {"direction_concentration": 0.9499}, (), False, "< 0.95"),
    ("backdrop", {"direction_concentration": 0.95}, ("density.max_gaussians=3000",), False, "leave no room"),
    ("backdrop", {"far_points": 6.0}, (), True, "6.0 scene sizes away >= 6"),
    ("backdrop", {"far_points": 5.9}, (), False, "5.9 scene sizes away < 6"),
    ("background", {"transparent": False}, (), "black", "opaque"),
    ("background", {"transparent": True}, (), "random", "transparent"),
    ("exposure", gains(0.1, 0.025), (), True, "before and after <= 0.25 of that"),
    ("exposure", gains(0.1, 0.026), (), False, "before and after > 0.25 of that"),
    ("exposure", gains(0.04, 0.0), (), False, "0.04 stops apart < 0.05"),
    ("exposure", gains(1.0, compared=49), (), False, "only 49 of 100 photos could be"),
    ("exposure", {"transparent": True, **gains(1.0)}, (), False, "transparent"),
    ("dropout", {"reprojection_error": 0.4}, (), 0.2, "points 0.40 pixels from where photos show them >= 0.4"),
    ("dropout", {"reprojection_error": 0.39}, (), 0.0, "points 0.39 pixels from where photos show them < 0.4"),
    ("dropout", {}, (), 0.0, "no reconstruction says how accurate the cameras are"),
    ("batch_for", {}, (), 1, "one process"),
    ("batch_for", {"processes": 2}, (), 2, "2 processes; a batch for 2 costs"),
    ("batch_for", {"processes": 4}, (), 2, "4 processes; a batch for 2 costs no error"),
    ("batch_for", {"processes": 2, "train_views": 19}, (), 1, "2 processes, but 2 times 10 views > 19"),
    ("batch_for", {"processes": 2, "train_views": 500}, ("schedule.max_views=65",), 1, "views > 128"),
    ("iterations", {"train_views": 100, "processes": 2}, ("train.batch_for=2",), 6000, "60 epochs"),
    ("iterations", {"train_views": 100, "processes": 2}, ("train.batch_for=auto",), 3000, "2 times the pixels"),
    ("iterations", {"train_views": 100}, ("train.epochs=75",), 7500, "75 epochs of 100 training views"),
    ("iterations", {"train_views": 600}, ("train.epochs=75", "pixel_sampler.type=dense"), 11100, "184 epochs"),
    ("iterations", {"train_views": 225}, (), 20300, "90 epochs of 225 training views"),
    ("iterations", {"train_views": 100}, (*ONE_VIEW, "schedule.pixel_budget=4"), 6000, "60 epochs"),
    ("iterations", {"train_views": 2625}, (), 30000, "take 806947; at most 30000, where a pixel is sampled 11.4"),
    ("iterations", {"train_views": 2625, "processes": 2}, ("train.batch_for=auto",), 15000, "sampled 11.4 times"),
    ("iterations", {"train_views": 20}, ("train.epochs=75",), 2000, "take fewer than 2000, the least"),
    ("iterations", {"train_views": 43, "processes": 2}, ("train.batch_for=auto",), 1500, "fewer than 1414, the"),
    ("pixels_place", {"device_bytes": 440 * MIB}, (), "device", "220 MiB <= 50% of 440 MiB"),
    ("pixels_place", {"device_bytes": 439 * MIB}, (), "host", "220 MiB > 50% of 439 MiB"),
    ("pixels_place", {"device": "cpu", "device_bytes": MIB}, (), "device", "the device is the CPU"),
    ("pixels_place", {"device": "cpu", "host_bytes": MIB}, (), "host", "120 MiB > 50% of 1 MiB free on"),
]


@pytest.mark.parametrize(("setting", "changes", "overrides", "value", "number"), BOTH_SIDES)
def test_the_number_that_decides(setting, changes, overrides, value, number):
    made = decision(setting, facts(**changes), *overrides)
    assert (made.value, made.made) == (value, "auto")
    assert number in made.reason and "0.0 scene sizes" not in made.reason


def test_every_setting_that_may_be_auto_has_both_sides_above():
    assert {case[0] for case in BOTH_SIDES} == set(RULES) == set(AUTO_SETTINGS)
    for setting in RULES:
        assert len({case[3] for case in BOTH_SIDES if case[0] == setting}) > 1, setting


SET = [
    ("backdrop", "false", {"direction_concentration": 1.0}, lambda config: config.train.backdrop is False),
    ("background", "white", {}, lambda config: config.train.background == "white"),
    ("exposure", "true", {}, lambda config: config.train.exposure is True),
    ("batch_for", "2", {"processes": 2}, lambda config: config.schedule["pixel_budget"] == 1.0),
    ("iterations", "700", {"train_views": 250}, lambda config: config.train.refine_until == 3500),
    ("pixels_place", "device", {"device_bytes": MIB}, lambda config: config.train.pixels_place == "device"),
]


@pytest.mark.parametrize(("setting", "value", "changes", "holds"), SET)
def test_what_is_set_wins_and_the_plan_says_so(setting, value, changes, holds):
    config = load_config("turbogs", [*ALL_AUTO, f"train.{setting}={value}"])
    plan = plan_from_facts(facts(**changes), config)
    line = next(line for line in plan.text().splitlines() if line.startswith(f"  train.{setting} "))
    assert line.split()[1:4] == [value, "set", "auto:"]
    assert holds(plan.apply(config))


@pytest.mark.parametrize("name", ["turbogs", "mcmc", "3dgs"])
def test_a_batch_for_more_processes_is_that_of_one_where_there_is_one(name):
    """With more, views and pixels grow by their number, learning rates by its root, moments forget after as many
    samples, and nothing else changes."""
    config = load_config(name, ["train.batch_for=auto", "train.iterations=700"])
    written = load_config(name, ["train.iterations=700"])
    alone = plan_from_facts(FACTS, config).apply(config)
    assert alone == plan_from_facts(FACTS, written).apply(written)
    two = plan_from_facts(facts(processes=2), config).apply(config).to_mapping()
    expected = alone.to_mapping()
    expected["train"]["batch_for"] = 2
    for key in {"min_views", "max_views", "views", "pixel_budget"} & set(expected["schedule"]):
        expected["schedule"][key] *= 2
    for key in {"beta1", "beta2"} & set(expected["optimizer"]):
        expected["optimizer"][key] **= 2
    for section in ("optimizer", "density"):
        if "learning_rates" in expected[section]:
            expected[section]["learning_rates"]["batch_scale"] *= 2**0.5
            expected[section]["learning_rates"]["written_for"] //= 2
    assert two == expected


@pytest.mark.parametrize(
    ("name", "changes"),
    [*((name, {}) for name in config_names()), ("turbogs", {"train_views": 5, "direction_concentration": 1.0})],
)
def test_plan_configuration_yaml_and_back(name, changes):
    config = load_config(name, ALL_AUTO)
    plan = plan_from_facts(facts(**changes), config)
    planned = plan.apply(config)
    assert config == load_config(name, ALL_AUTO), "the configuration asked for stays as it is"
    assert resolve(parse_yaml(planned.to_yaml(), name)) == planned
    assert "auto" not in planned.to_yaml().replace("device: auto", ""), "nothing is left to decide"
    assert plan_from_facts(FACTS, planned).apply(planned) == planned


@pytest.mark.parametrize("name", ["3dgs", "3dgs-as-shipped", "mcmc", "turbogs-paper"])
def test_the_baselines_leave_nothing_out(name):
    """A plan decides where their photos and maps are, and the background by the kind of photos, and that alone."""
    config = load_config(name)
    planned = plan_from_facts(facts(train_views=2, direction_concentration=1.0), config).apply(config)
    assert (config.train.pixels_place, config.train.background) == ("auto", "auto")
    config.train.pixels_place, config.train.background = "device", "black"
    assert planned == config


@pytest.mark.parametrize("setting", RULES)
def test_nothing_is_built_or_trained_by_what_is_left_to_a_plan(setting, capture):
    config = load_config("turbogs").without_plan()
    config.require_decided()
    undecided = resolve(apply_overrides(config.to_mapping(), [f"train.{setting}=auto"]))
    with pytest.raises(RuntimeError, match=rf"^train.{setting}: auto"):
        Trainer(undecided, load_scene(capture), torch.device("cpu"))
    assert undecided.without_plan() == config


def test_the_verb_prints_the_plan_of_a_capture(turbogs, capture):
    code, out, err = turbogs("plan", capture, *ALL_AUTO, "--device", "cpu")
    assert code == 0 and err.count("\n") == 2
    assert err.startswith("COLMAP reconstruction") and "6 of 7 training cameras refined" in err
    lines = {line.split()[0]: line.split()[1:3] for line in out.splitlines() if line.startswith("  train.")}
    assert lines.keys() == {f"train.{setting}" for setting in RULES} and lines["train.iterations"] == ["2000", "auto"]


def test_a_planned_run_tells_its_plan_and_does_not_plan_again(turbogs, capture, tmp_path, monkeypatch):
    stopped = tmp_path / "stopped"
    decided = [option for option in ALL_AUTO if option != "train.iterations=auto"]  # 2000 would take minutes
    stop_after(monkeypatch, 7)
    code, _, err = turbogs("train", capture, *TINY, *decided, "--out", stopped, "--device", "cpu")
    assert code == 130 and re.search(r"train.exposure +false +auto", err)
    monkeypatch.undo()
    config = run.RunFolder(stopped).read_config()
    assert (config.train.backdrop, config.train.exposure, config.train.batch_for) == (False, False, 1)
    assert re.search(r"train.exposure +false +auto", (stopped / "plan.txt").read_text())
    monkeypatch.setattr(run, "make_plan", None)  # a resumed run must not plan again
    run.resume(stopped, write_report)
    assert "of 7 photos could be compared" in (stopped / "report.md").read_text()


def test_a_study_plans_each_cell(turbogs, capture, tmp_path, monkeypatch):
    """Where pixels are changes no result."""
    changes = {"nothing": [], "all-views": ["schedule.type=fixed", "schedule.views=100000"]}
    changes |= {"no-ncc": ["loss.type=charbonnier"], "host-pixels": ["train.pixels_place=host"]}
    (tmp_path / "study.yaml").write_text(json.dumps({"title": "left out", "variants": changes}))
    monkeypatch.setattr(cell_module, "warm_up", lambda *arguments: None)
    options = ["--steps", 4, "train.device=cpu", "--scene", capture, "--out", tmp_path / "study"]
    code, _, err = turbogs("ablate", tmp_path / "study.yaml", "train.evaluate_at=[]", *options)
    assert code == 0, err
    cells = {cell.variant: cell for cell in StudyFolder(tmp_path / "study").read_study().results}
    measures = ("psnr", "worst_psnr", "ssim", "l1", "gaussians")
    final = {name: [cell.final.get(measure) for measure in measures] for name, cell in cells.items()}
    assert set(final) == set(changes)
    assert final["host-pixels"] == final["nothing"]
    assert len({final[name][0] for name in ("nothing", "all-views", "no-ncc")}) == 3
    cell = cells["nothing"]
    assert cell.planned["train.pixels_place"] == "device" and not [key for key in cell.planned if "optimizer" in key]
    assert cell.settings["train.pixels_place"] == "auto", "what was asked for is kept, so that a call can go on"
