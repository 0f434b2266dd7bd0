"""The plan: each decision on both sides of its criterion, what wins over it, and the configuration it leads to."""

import dataclasses
import json
import signal

import pytest
import torch
from helpers.framework_runs import TINY, tiny_capture, tiny_config

from turbogs_plugin.config.configuration import PLANNED_SETTINGS, PlanConfig, config_names, load_config, resolve
from turbogs_plugin.config.yaml_text import parse_yaml
from turbogs_plugin.errors import InputError
from turbogs_plugin.plan import Plan, SceneFacts
from turbogs_plugin.plan.decisions import RULES
from turbogs_plugin.plan.plan import plan_from_facts
from turbogs_plugin.report.pages import write_report
from turbogs_plugin.train import run
from turbogs_plugin.train.trainer import Trainer

MIB = 2**20
FACTS = SceneFacts(
    scene="synthetic",
    train_views=100,
    test_views=10,
    smallest_photo=(600, 400),
    largest_photo=(900, 600),
    points=10_000,
    extent=3.0,
    baseline=0.1,
    flat_tiles=0.1,
    exposure_spread=0.05,
    direction_concentration=0.5,
    photo_bytes=100 * MIB,
    map_bytes=120 * MIB,
    model_bytes=10 * MIB,
    device="cuda",
    device_free_bytes=1000 * MIB,
    host_free_bytes=8000 * MIB,
)
AUTO = tuple(f"plan.{name}=auto" for name in RULES)


def facts(**changes) -> SceneFacts:
    return dataclasses.replace(FACTS, **changes)


def decision(name: str, of: SceneFacts, *overrides: str):
    plan = plan_from_facts(of, load_config("turbogs", [f"plan.{name}=auto", *overrides]))
    return next(decision for decision in plan.decisions if decision.name == name)


ONE_VIEW = ("schedule.type=fixed", "schedule.views=1")

BOTH_SIDES = [
    ("backdrop", {"direction_concentration": 0.95}, (), True, "0.950 >= 0.95"),
    ("backdrop", {"direction_concentration": 0.9499}, (), False, "< 0.95"),
    ("ncc", {"flat_tiles": 0.5}, (), False, "50.0% of tiles"),
    ("ncc", {"flat_tiles": 0.49}, (), True, "49.0% of tiles"),
    ("ncc", {"flat_tiles": 0.9}, ("loss.type=sparse_ssim",), "keep", "sparse_ssim"),
    ("views", {"train_views": 10}, (), "all", "10 training views <= at most 10"),
    ("views", {"train_views": 11}, (), "keep", "11 training views > at most 10"),
    ("views", {"train_views": 4}, ("schedule.type=fixed", "schedule.views=4"), "all", "4 training views <= at most 4"),
    ("sh_degree", {"train_views": 16}, (), 3, "16 coefficients <= 16"),
    ("sh_degree", {"train_views": 15}, (), 2, "16 coefficients of degree 3 > 15"),
    ("sh_degree", {"train_views": 3}, (), 0, "4 coefficients of degree 1 > 3"),
    ("sh_degree", {"direction_concentration": 0.96}, (), 1, "0.960 >= 0.95"),
    ("sh_degree", {"direction_concentration": 0.96}, ("train.sh_degree=0",), 0, "1 coefficients"),
    ("iterations", {"train_views": 100}, ("plan.looks=75",), 7500, "75 looks at each of 100 training views"),
    ("iterations", {"train_views": 43}, ("plan.looks=75",), 3300, "75 looks at each of 43 training views"),
    ("iterations", {"train_views": 100}, ("plan.looks=75", "schedule.pixel_budget=0.5"), 15000, "75 looks"),
    ("iterations", {"train_views": 600}, ("plan.looks=75", "pixel_sampler.type=dense"), 4500, "75 looks"),
    ("iterations", {"train_views": 100}, (*ONE_VIEW, "schedule.pixel_budget=4"), 6000, "60 looks"),
    ("iterations", {"train_views": 20}, ("plan.looks=75",), 2000, "fewer than 40% of 5000"),
    ("optimizer", {"device": "cpu"}, (), "sparse_adam", "5 to 10 % of an iteration"),
    ("optimizer", {"device": "cuda"}, (), "moment_lm", "within 7 %"),
    ("optimizer", {}, ("optimizer.type=adam",), "keep", "the optimizer is adam"),
    ("maps_on", {"device_free_bytes": 240 * MIB}, (), "device", "120 MiB <= 50% of 240 MiB free"),
    ("maps_on", {"device_free_bytes": 239 * MIB}, (), "host", "120 MiB > 50% of 239 MiB free"),
    ("maps_on", {"device_free_bytes": 240 * MIB}, ("plan.photos_on=device",), "host", "beside 100 MiB of photos"),
    ("maps_on", {"memory_limit": 239 * MIB}, (), "host", "239 MiB allowed"),
    ("maps_on", {"device": "cpu", "device_free_bytes": MIB}, (), "device", "the device is the CPU"),
    ("photos_on", {"device_free_bytes": 440 * MIB}, (), "device", "100 MiB beside 120 MiB of maps <= 50% of 440 MiB"),
    ("photos_on", {"device_free_bytes": 439 * MIB}, (), "host", "> 50% of 439 MiB free"),
    ("photos_on", {"device_free_bytes": 200 * MIB}, (), "device", "100 MiB <= 50% of 200 MiB free"),
    ("photos_on", {"device_free_bytes": 439 * MIB}, ("plan.maps_on=host",), "device", "100 MiB <= 50%"),
]


@pytest.mark.parametrize(("name", "changes", "overrides", "value", "number"), BOTH_SIDES)
def test_the_number_that_decides(name, changes, overrides, value, number):
    made = decision(name, facts(**changes), *overrides)
    assert (made.value, made.made) == (value, "auto")
    assert number in made.reason


def test_every_decision_has_both_sides_above():
    assert {case[0] for case in BOTH_SIDES} == set(RULES)
    assert set(RULES) == {field.name for field in dataclasses.fields(PlanConfig)} - {"looks"}
    for name in RULES:
        assert len({case[3] for case in BOTH_SIDES if case[0] == name}) > 1, name


FORCED = [
    ("backdrop", "true", {}, lambda config: config.train.backdrop is True),
    ("backdrop", "false", {"direction_concentration": 1.0}, lambda config: config.train.backdrop is False),
    ("ncc", "false", {}, lambda config: config.loss == {"type": "charbonnier", "epsilon": 1e-3}),
    ("ncc", "true", {"flat_tiles": 1.0}, lambda config: config.loss == load_config("turbogs").loss),
    ("views", "all", {"train_views": 50}, lambda config: config.schedule["views"] == 50),
    ("sh_degree", "3", {"train_views": 3}, lambda config: config.train.sh_degree == 3),
    ("iterations", "700", {"train_views": 250}, lambda config: config.train.refine_until == 490),
    ("optimizer", "moment_lm", {}, lambda config: config.optimizer == load_config("turbogs").optimizer),
    ("optimizer", "sparse_adam", {}, lambda config: config.optimizer["type"] == "sparse_adam"),
    ("maps_on", "host", {}, lambda config: config.plan.maps_on == "host"),
    ("maps_on", "device", {"device_free_bytes": MIB}, lambda config: config.plan.maps_on == "device"),
    ("photos_on", "host", {}, lambda config: config.plan.photos_on == "host"),
    ("photos_on", "device", {"device_free_bytes": MIB}, lambda config: config.plan.photos_on == "device"),
]


@pytest.mark.parametrize(("name", "value", "changes", "holds"), FORCED)
def test_a_forced_decision_wins_and_says_so(name, value, changes, holds):
    config = load_config("turbogs", [*AUTO, f"plan.{name}={value}"])
    plan = plan_from_facts(facts(**changes), config)
    line = next(line for line in plan.text().splitlines() if line.startswith(f"  {name} "))
    assert line.split()[1:3] == [value, "forced"]
    assert holds(plan.apply(config))


def test_ncc_can_be_forced_onto_a_loss_without_it():
    config = load_config("turbogs", ["loss.type=charbonnier", "loss.epsilon=0.01", "plan.ncc=true"])
    loss = plan_from_facts(FACTS, config).apply(config).loss
    assert (loss["type"], loss["epsilon"]) == ("charbonnier_ncc", 0.01)


def test_all_views_leave_nothing_to_select():
    config = load_config(
        "turbogs", ["plan.views=auto", "schedule.pixel_budget=0.5", "view_sampler.type=geometry_aware"]
    )
    assert config.plan.views == "auto"  # said in the same layer
    planned = plan_from_facts(facts(train_views=7), config).apply(config)
    assert planned.schedule == {"type": "fixed", "views": 7, "pixel_budget": 0.5}
    assert planned.view_sampler == {"type": "random"}


def test_the_other_optimizer_keeps_the_learning_rates():
    config = load_config("turbogs", ["plan.optimizer=auto", "optimizer.learning_rates.batch_scale=2.5"])
    planned = plan_from_facts(facts(device="cpu"), config).apply(config)
    assert planned.optimizer["type"] == "sparse_adam"
    assert planned.optimizer["learning_rates"] == config.optimizer["learning_rates"]
    planned.build("optimizer")


@pytest.mark.parametrize("name", config_names())
@pytest.mark.parametrize("changes", [{}, {"train_views": 5, "direction_concentration": 1.0, "flat_tiles": 0.9}])
def test_plan_configuration_yaml_and_back(name, changes):
    config = load_config(name, AUTO)
    plan = plan_from_facts(facts(**changes), config)
    planned = plan.apply(config)
    assert config == load_config(name, AUTO), "the configuration asked for stays as it is"
    assert resolve(parse_yaml(planned.to_yaml(), name)) == planned
    assert plan_from_facts(FACTS, planned).apply(planned) == planned, "nothing is left to decide"
    assert Plan.from_json(plan.to_json()) == plan


@pytest.mark.parametrize("name", ["3dgs", "3dgs-as-shipped", "mcmc", "fastgs", "turbogs-paper"])
def test_the_baselines_leave_nothing_out(name):
    config = load_config(name)
    planned = plan_from_facts(facts(train_views=2, direction_concentration=1.0, flat_tiles=1.0), config).apply(config)
    assert {**planned.to_mapping(), "plan": None} == {**config.to_mapping(), "plan": None}


PLANNED = [(name, setting) for name, settings in PLANNED_SETTINGS.items() for setting in settings]
A_VALUE = {
    "train.backdrop": "true",
    "train.sh_degree": "2",
    "train.iterations": "700",
    "loss.type": "charbonnier",
    "loss.ncc_weight": "0.3",
    "loss.structure": "contrast",
    "loss.gate": "true",
    "schedule.type": "linear",
    "schedule.min_views": "2",
    "schedule.max_views": "12",
    "view_sampler.type": "geometry_aware",
    "optimizer.type": "sparse_adam",
    "optimizer.units": "paper",
    "optimizer.rows": "summed",
    "optimizer.curvature": "0.5",
    "optimizer.max_step": "0.0",
    "schedule.views": "3",
}


@pytest.mark.parametrize(("name", "setting"), PLANNED)
def test_what_one_says_oneself_no_plan_changes(tmp_path, name, setting):
    fixed = "  type: fixed\n" if setting == "schedule.views" else ""
    base = tmp_path / "base.yaml"
    planned = ", ".join(f"{decision}: auto" for decision in PLANNED_SETTINGS)
    base.write_text(f"base: turbogs\nplan: {{{planned}}}\n")
    section, _, key = setting.partition(".")
    upper = tmp_path / "upper.yaml"
    upper.write_text(f"base: {base}\n{section}:\n{fixed}  {key}: {A_VALUE[setting]}\n")
    override = [f"{setting}={A_VALUE[setting]}", *(["schedule.type=fixed"] if fixed else [])]
    for config in (load_config(str(base), override), load_config(str(upper))):
        kept = {field.name for field in dataclasses.fields(PlanConfig) if getattr(config.plan, field.name) == "keep"}
        assert kept == {name}


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("plan.backdrop=maybe", ["plan.backdrop", "true or false", "'auto'", "'keep'"]),
        ("plan.sh_degree=4", ["sh_degree", "4", "0 .. 3"]),
        ("plan.views=3", ["plan.views", "'all'"]),
        ("plan.maps_on=disk", ["plan.maps_on", "'device'", "'host'"]),
        ("plan.maps=host", ["did you mean 'maps_on'?"]),
    ],
)
def test_a_decision_that_cannot_be_forced_is_named(override, words):
    with pytest.raises(InputError) as error:
        load_config("turbogs", [override])
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"facts": {}, "decisions": []}', "{"])
def test_a_text_that_is_no_plan_is_refused(text):
    with pytest.raises(InputError, match="plan"):
        Plan.from_json(text)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return tiny_capture(tmp_path_factory.mktemp("plan"))


def test_the_verb_prints_the_plan_of_a_capture(turbogs, capture):
    code, out, err = turbogs("plan", capture, *AUTO, "--device", "cpu")
    assert code == 0 and err == ""
    lines = {line.split()[0]: line.split()[1:3] for line in out.splitlines() if line.split()[0] in RULES}
    assert lines == {
        "backdrop": ["false", "auto"],
        "ncc": ["true", "auto"],
        "views": ["all", "auto"],
        "sh_degree": ["1", "auto"],
        "iterations": ["2000", "auto"],
        "optimizer": ["sparse_adam", "auto"],
        "maps_on": ["device", "auto"],
        "photos_on": ["device", "auto"],
    }
    for fact in ("7 + 1 views of 48x40 pixels", "MiB free on the CPU"):
        assert fact in " ".join(out.split())
    code, out, err = turbogs("plan", capture.parent / "absent")
    assert code == 2 and "no such scene" in err


def test_a_planned_run_tells_its_plan_and_resumes_bit_for_bit(turbogs, capture, tmp_path, monkeypatch):
    # What the plan decides must not be among the overrides' own settings.
    short = [option for option in TINY if not option.startswith(("schedule", "train.sh_degree"))]
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    decided = [option for option in AUTO if option != "plan.iterations=auto"]  # 2000 would take minutes
    code, _, err = turbogs("train", capture, *short, *decided, "--out", whole, "--device", "cpu")
    assert code == 0 and "sparse_adam  auto" in err
    page = (whole / "report.md").read_text()
    assert "## Plan" in page and "7 training views <= at most 10 an iteration" in page
    config = run.RunFolder(whole).read_config()
    assert (config.schedule["type"], config.train.sh_degree, config.optimizer["type"]) == ("fixed", 1, "sparse_adam")
    assert json.loads((whole / "plan.json").read_text())["decisions"][0]["name"] == "backdrop"

    step = Trainer.step

    def interrupted(trainer):
        step(trainer)
        if trainer.iteration == 7:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Trainer, "step", interrupted)
    assert turbogs("train", capture, *short, *decided, "--out", stopped, "--device", "cpu")[0] == 130
    monkeypatch.undo()
    monkeypatch.setattr(run, "make_plan", None)  # a resumed run must not plan again
    run.resume(stopped, write_report)
    states = [torch.load(folder / "checkpoints" / "iteration-000014.pt")["trainer"] for folder in (whole, stopped)]
    for name, tensor in states[0]["gaussians"].items():
        assert torch.equal(tensor, states[1]["gaussians"][name]), name
    assert torch.equal(states[0]["maps"]["errors"], states[1]["maps"]["errors"])
    assert (stopped / "config.yaml").read_text() == (whole / "config.yaml").read_text()
    assert "## Plan" in (stopped / "report.md").read_text()


def test_a_spoiled_plan_is_named_and_a_missing_one_is_not_missed(capture, tmp_path):
    folder = run.RunFolder(tmp_path / "run")
    run.train(tiny_config(capture, "train.iterations=2", "train.evaluate_at=[]"), folder.path)
    folder.plan.write_text("{")
    with pytest.raises(InputError, match=r"plan\.json"):
        run.resume(folder.path)
    folder.plan.unlink()
    run.resume(folder.path, write_report)
    assert "holds no plan" in folder.report.read_text()


def test_the_ablation_of_leave_outs_plans_each_cell(turbogs, capture, tmp_path):
    """Forced both ways, and by the plan; where things are changes no result."""
    variants = ["plan", "all-views", "no-ncc", "host-maps", "host-photos"]
    options = ["--steps", 4, "--device", "cpu", "--scene", capture, "--out", tmp_path / "study"]
    code, _, err = turbogs("ablate", "leave_out", "train.evaluate_at=[]", *options, "--only", *variants)
    assert code == 0, err
    cells = {path.stem.partition("--")[0]: json.loads(path.read_text()) for path in tmp_path.rglob("*--seed0.json")}
    psnr = {name: cell["history"][-1]["psnr"] for name, cell in cells.items()}
    assert set(psnr) == {"nothing", *variants}
    assert psnr["host-maps"] == psnr["host-photos"] == psnr["nothing"]
    assert len({psnr[name] for name in ("nothing", "plan", "all-views", "no-ncc")}) == 4
    assert cells["plan"]["asked"]["plan"]["optimizer"] == "auto", "so that a call can go on"
    assert cells["plan"]["config"]["plan"]["optimizer"] == "keep" and "optimizer" not in cells["nothing"]["asked"]
