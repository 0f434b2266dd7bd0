"""Configuration: dataclasses <- YAML <- overrides, strictly."""

from pathlib import Path

import pytest

from turbogs_plugin.config.configuration import apply_overrides, config_names, load_config, registry, resolve
from turbogs_plugin.config.yaml_text import DEPTH_LIMIT, SIZE_LIMIT, parse_yaml
from turbogs_plugin.errors import InputError
from turbogs_plugin.study.grid import load_ablation

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def write(tmp_path):
    def write(text: str, name: str = "mine.yaml") -> str:
        (tmp_path / name).write_text(text)
        return str(tmp_path / name)

    return write


@pytest.mark.parametrize("name", config_names())
def test_packaged_configurations_are_complete_and_round_trip(name):
    config = load_config(name)
    assert resolve(parse_yaml(config.to_yaml(), name)) == config
    for kind in registry.KINDS:
        config.build(kind)


def test_the_names_of_the_issue_are_packaged():
    assert {"turbogs", "turbogs-big", "turbogs-ssim", "turbogs-paper", "demo"} <= set(config_names())


def test_the_table_of_the_paper():
    fast, big = load_config("turbogs"), load_config("turbogs-big")
    assert (fast.train.base_iterations, fast.train.refine_until) == (5000, 3500)
    assert (big.train.base_iterations, big.train.refine_until) == (8000, 6000)
    for config in (fast, big):
        assert config.schedule["type"] == "sinusoidal"
        assert (config.schedule["min_views"], config.schedule["max_views"], config.schedule["alpha"]) == (3, 10, 3.0)
        assert config.maps.beta == 0.4


@pytest.mark.parametrize("ablation", ["sizes", "cameras"])
def test_turbogs_ssim_is_what_was_measured_under_another_name(ablation):
    measured = load_config("turbogs", load_ablation(ablation).variants["ssim"])
    assert load_config("turbogs-ssim") == measured


@pytest.mark.parametrize(
    ("text", "value"), [("1e-4", 1e-4), ("5e-1", 0.5), ("1", 1.0), (".5", 0.5), ("1E-4", 1e-4), ("0.25", 0.25)]
)
def test_numbers_are_numbers(text, value):
    beta = load_config("turbogs", [f"maps.beta={text}"]).maps.beta
    assert beta == value and isinstance(beta, float)


def test_a_whole_number_may_be_written_with_an_exponent():
    assert load_config("turbogs", ["train.iterations=1e3"]).train.iterations == 1000


def test_yaml_over_dataclass_and_override_over_yaml(write):
    file = write("base: turbogs\ntrain: {iterations: 10, seed: 3}\nmaps: {beta: 0.9}\n")
    config = load_config(file, ["train.seed=5"])
    assert (config.train.iterations, config.train.seed, config.maps.beta) == (10, 5, 0.9)
    assert config.train.sh_degree == 3


def test_another_type_starts_its_section_afresh():
    config = load_config("turbogs", ["schedule.pixel_budget=0.5", "schedule.type=fixed"])
    assert config.schedule == {"type": "fixed", "views": 3, "pixel_budget": 0.5}
    same = apply_overrides({"schedule": {"alpha": 2.0}}, ["schedule.type=sinusoidal"])
    assert same == {"schedule": {"alpha": 2.0, "type": "sinusoidal"}}


def test_nested_dataclasses_of_a_strategy():
    config = load_config("turbogs", ["optimizer.learning_rates.batch_scale=1"])
    assert config.optimizer["learning_rates"]["batch_scale"] == 1.0
    assert config.build("optimizer").learning_rates.batch_scale == 1.0


BAD_OVERRIDES = [
    ("train.iteration=5", ["train.iteration", "did you mean 'iterations'?"]),
    ("trian.iterations=5", ["trian", "did you mean 'train'?"]),
    ("schedule.min_view=5", ["schedule.min_view", "did you mean 'min_views'?"]),
    ("schedule.type=sinus", ["sinus", "did you mean 'sinusoidal'?", "fixed"]),
    ("optimizer.learning_rates.mean=1", ["learning_rates.mean", "did you mean 'means'?"]),
    ("schedule.min_views=20", ["max_views", "10", "20"]),
    ("optimizer.learning_rates.means=-1", ["means", "-1"]),
    ("train.iterations=0", ["iterations", "0"]),
    ("train.iterations=many", ["train.iterations", "whole number", "many"]),
    ("train.iterations=1.5", ["train.iterations", "whole number"]),
    ("train.iterations=true", ["train.iterations", "whole number"]),
    ("maps.beta=fast", ["maps.beta", "number"]),
    ("maps.beta=.nan", ["maps.beta", "number"]),
    ("maps.beta=2", ["beta", "2"]),
    ("train.evaluate_at=0.5", ["train.evaluate_at", "list"]),
    ("train.evaluate_at=[0.5, 2]", ["evaluate_at", "2"]),
    ("train=5", ["section.key=value"]),
    ("train.iterations", ["section.key=value"]),
    ("train..seed=1", ["section.key=value"]),
    ("train.seed.x=1", ["train.seed"]),
    ("train.device=tpu", ["device", "tpu", "cuda"]),
    ("scene.factor=0", ["factor", "0"]),
    ("scene.test_every=1", ["test_every", "1"]),
    ("train.seed=1\nother: 2", ["more than one value"]),
]


@pytest.mark.parametrize(("override", "words"), BAD_OVERRIDES, ids=[override for override, _ in BAD_OVERRIDES])
def test_a_bad_override_is_named(override, words):
    with pytest.raises(InputError) as error:
        load_config("turbogs", [override])
    for word in words:
        assert word in str(error.value)


def test_an_unknown_name_lists_the_known():
    with pytest.raises(InputError, match=r"did you mean 'turbogs'\?.*turbogs-big"):
        load_config("turbo")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: !!python/object/apply:os.system ['true']", "tags are not allowed"),
        ("a: !custom 1", "tags are not allowed"),
        ("a: &x [1]\nb: *x", "anchors and aliases"),
        ("- 1\n- 2", "got a list"),
        ("just text", "got the text"),
        ("", "one YAML document"),
        ("a: 1\n---\nb: 2", "one YAML document, found 2"),
        ("a: [1, 2", "not valid YAML"),
        ("train: {seed: 1}\ntrain: {seed: 2}", "not valid YAML"),
        ("a: " + "[" * (DEPTH_LIMIT + 1), "levels deep"),
        ("a: " + "x" * SIZE_LIMIT, "more than"),
        ("train: 5", "train: expected a mapping"),
        ("schedule: [1]", "schedule: expected a mapping"),
        ("base: mine.yaml", "mine"),
    ],
    ids=lambda text: text[:24],
)
def test_hostile_files_are_refused(write, text, message):
    with pytest.raises(InputError, match=message):
        load_config(write(text))


def test_a_base_is_looked_for_beside_its_file(write, tmp_path, monkeypatch):
    (tmp_path / "common").mkdir()
    (tmp_path / "common/seed.yaml").write_text("base: turbogs\ntrain: {seed: 7}\n")
    file = write("base: common/seed.yaml\nmaps: {beta: 0.9}\n")
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / "common").mkdir(parents=True)
    (elsewhere / "common/seed.yaml").write_text("base: turbogs\ntrain: {seed: 8}\n")
    monkeypatch.chdir(elsewhere)
    config = load_config(file)
    assert (config.train.seed, config.maps.beta) == (7, 0.9)
    with pytest.raises(InputError, match="unknown config 'turbgos': did you mean 'turbogs'"):
        load_config(write("base: turbgos\n"))


@pytest.mark.parametrize("text", ["runs/try #2/model.ply", "#2/model.ply", "'runs/try #2/model.ply'"])
def test_an_override_is_taken_whole(text):
    assert apply_overrides({}, [f"train.init={text}"]) == {"train": {"init": text.strip("'")}}


def test_a_circle_of_bases_is_refused(write, tmp_path):
    file = write(f"base: {tmp_path / 'mine.yaml'}\n")
    with pytest.raises(InputError, match="circle"):
        load_config(file)


def test_missing_and_binary_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="No such file"):
        load_config(str(tmp_path / "absent.yaml"))
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="UTF-8"):
        load_config(str(tmp_path / "binary.yaml"))


def test_environment_variables_do_not_leak_into_a_config(monkeypatch):
    monkeypatch.setenv("SECRET", "leaked")
    assert load_config("turbogs", ["scene.path=${oc.env:SECRET}"]).scene.path == "${oc.env:SECRET}"


def test_bands_open_on_their_schedule():
    train = load_config("turbogs", ["train.sh_interval=10", "train.sh_degree=2"]).train
    assert [train.sh_degree_at(iteration) for iteration in (0, 9, 10, 19, 20, 1000)] == [0, 0, 1, 1, 2, 2]


def test_the_start_and_the_end_are_always_evaluated():
    train = load_config("turbogs", ["train.iterations=10", "train.evaluate_at=[0.01, 0.5]"]).train
    assert train.evaluation_iterations() == {0, 1, 5, 10}
