"""Configuration: dataclasses <- YAML <- overrides, strictly."""

import re

import pytest
from helpers.refusals import assert_refused

from turbogs_plugin.captures.transforms import read_frames
from turbogs_plugin.config.components import KINDS, strategy_class
from turbogs_plugin.config.configuration import (
    SECTION_CLASSES,
    apply_overrides,
    config_names,
    load_config,
    resolve,
    resolve_complete,
    settings_text,
)
from turbogs_plugin.config.sections import BudgetConfig, parse_bytes, parse_seconds
from turbogs_plugin.config.typed import settings_of
from turbogs_plugin.errors import InputError
from turbogs_plugin.files import read_text
from turbogs_plugin.strategies import TYPES
from turbogs_plugin.yaml_json import DEPTH_LIMIT, SIZE_LIMIT, parse_json, parse_yaml, yaml_text


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
    for kind in KINDS:
        config.build(kind)


@pytest.mark.parametrize("text", ["1e-4", "5e-1", "1", ".5", "1E-4", "0.25"])
def test_numbers_are_numbers(text):
    beta = load_config("turbogs", [f"maps.beta={text}"]).maps.beta
    assert beta == float(text) and isinstance(beta, float)


def test_yaml_over_dataclass_and_override_over_yaml(write):
    file = write("base: turbogs\ntrain: {iterations: 1e3, seed: 3}\nmaps: {beta: 0.9}\n")
    config = load_config(file, ["train.seed=5"])
    assert (config.train.iterations, config.train.seed, config.maps.beta) == (1000, 5, 0.9)
    assert config.train.sh_degree == 3


def test_another_type_starts_its_section_afresh_but_for_learning_rates():
    config = load_config("turbogs", ["schedule.pixel_budget=0.5", "schedule.type=fixed"])
    assert config.schedule == {"type": "fixed", "views": 3, "pixel_budget": 0.5}
    same = apply_overrides({"schedule": {"alpha": 2.0}}, ["schedule.type=sinusoidal"])
    assert same == {"schedule": {"alpha": 2.0, "type": "sinusoidal"}}
    config = load_config("turbogs", ["optimizer.type=sparse_adam", "optimizer.learning_rates.quats=2e-3"])
    rates = load_config("turbogs").optimizer["learning_rates"]
    assert config.optimizer["learning_rates"] == {**rates, "quats": 2e-3} != rates
    assert config.build("optimizer").learning_rates.quats == 2e-3


BAD_OVERRIDES = {
    "train.iteration=5": "train.iteration.*did you mean 'iterations'",
    "trian.iterations=5": "trian.*did you mean 'train'",
    "schedule.type=sinus": "sinus.*did you mean 'sinusoidal'.*fixed",
    "optimizer.learning_rates.mean=1": "learning_rates.mean.*did you mean 'means'",
    "schedule.min_views=20": "20.*max_views|max_views.*20",
    "optimizer.learning_rates.means=-1": "means.*-1",
    "optimizer.learning_rates.means=1e300": "means = 1e.300 is not valid.* at most 1e30",
    "train.refine_until=1e30": "train.refine_until: expected a whole number",
    "train.iterations=2147483648": "iterations.*2147483648",
    "train.iterations=many": "train.iterations.*whole number.*auto.*many",
    "maps.beta=fast": "maps.beta.*number",
    "train.evaluate_at=0.5": "train.evaluate_at.*list",
    "density.split=middle": "density.split.*sample.*long_axis",
    "budget.time=1000000h": "time.*at most 100h",
    "train..seed=1": "section.key=value",
    "demo": r"write --config demo \(in Python, config='demo'\)",
    "train.device=tpu": "device.*tpu.*cuda",
}


@pytest.mark.parametrize("override", BAD_OVERRIDES)
def test_a_bad_override_is_named(override):
    assert_refused(BAD_OVERRIDES[override], load_config, "turbogs", [override])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: !!python/object/apply:os.system ['true']", "tags are not allowed"),
        ("a: &x [1]\nb: *x", "anchors and aliases"),
        ("just text", "got the text"),
        ("", "one YAML document"),
        ("a: 1\n---\nb: 2", "one YAML document, found 2"),
        ("a: 1\nb: [1, 2\nc: 3", r"not valid YAML \(line 2\): .* close brackets and quotes"),
        ("train:\n\tseed: 1", r"not valid YAML \(line 2\): found a tab; .* indented alike by spaces"),
        ("maps: {beta: 1}\ntrain: {seed: 1}\ntrain: {seed: 2}", r"not valid YAML \(line 3\).*twice: keep one"),
        ("train: [1, 2]", r"train: expected keys and values, as \{KEY: VALUE\} .*, got \[1, 2\]"),
        ("density: [1]", "density: expected keys and values"),
        ("train: {seed: '5'}", "train.seed: expected a whole number, got '5': leave out its quotes"),
        ("a: " + "[" * (DEPTH_LIMIT + 1), "levels deep"),
        ("a: " + "x" * SIZE_LIMIT, "more than"),
        ("train: {seed: 2001-01-01}", "train.seed: expected a whole number, got '2001-01-01'"),
        ("base: mine.yaml", "circle"),
    ],
    ids=lambda text: text[:24],
)
def test_hostile_files_are_refused(write, text, message):
    assert_refused(message, load_config, write(text))


@pytest.mark.parametrize("text", ["", "{", "[" * 200_000, "9" * 5000])
def test_what_is_no_json_is_refused(text):
    assert_refused(r"'a\.json' is not valid JSON", parse_json, text, "'a.json'")


@pytest.mark.parametrize("read", [read_frames, read_text])
def test_a_json_file_is_refused_before_it_is_read(tmp_path, read):
    with open(tmp_path / "a.json", "wb") as file:
        file.truncate(2**42)  # which no memory has
    assert_refused(r"a\.json has more than 64 MiB: take out what is not needed", read, tmp_path / "a.json")


def test_a_base_is_looked_for_beside_its_file(write, tmp_path, monkeypatch):
    for seed, folder in ((7, "common"), (8, "elsewhere/common")):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "seed.yaml").write_text(f"base: turbogs\ntrain: {{seed: {seed}}}\n")
    monkeypatch.chdir(tmp_path / "elsewhere")
    config = load_config(write("base: common/seed.yaml\nmaps: {beta: 0.9}\n"))
    assert (config.train.seed, config.maps.beta) == (7, 0.9)
    assert_refused("unknown config 'turbgos': did you mean 'turbogs'", load_config, write("base: turbgos\n"))


@pytest.mark.parametrize("text", ["runs/try #2/model.ply", "#2/model.ply", "'runs/try #2/model.ply'"])
def test_an_override_is_taken_whole(text):
    assert apply_overrides({}, [f"train.init={text}"]) == {"train": {"init": text.strip("'")}}


@pytest.mark.parametrize("path", ["1e3", "0x10", "null", "2001-01-01", "a: b", "${oc.env:HOME}", "#1"])
def test_a_text_is_read_back_as_it_was(path):
    assert parse_yaml(yaml_text({"path": path}), "config") == {"path": path}


def test_missing_and_binary_files_are_refused(tmp_path):
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    for name, message in (("absent.yaml", "No such file"), ("binary.yaml", "UTF-8")):
        assert_refused(message, load_config, str(tmp_path / name))


def test_the_configuration_of_a_run_is_complete():
    mapping = load_config("demo").without_plan().to_mapping()
    assert resolve_complete(mapping, "config.yaml", decided=True).to_mapping() == mapping
    del mapping["density"]["split"]
    undecided = load_config("turbogs").to_mapping()
    assert resolve_complete(undecided, "config.yaml").to_mapping() == undecided
    for given in (mapping, undecided):
        with pytest.raises(InputError, match=r"config\.yaml' lacks settings"):
            resolve_complete(given, "config.yaml", decided=True, built=True)


def test_bands_open_on_their_schedule():
    train = load_config("turbogs", ["train.sh_interval=10", "train.sh_degree=2"]).train
    assert [train.sh_degree_at(iteration) for iteration in (0, 9, 10, 19, 20, 1000)] == [0, 0, 1, 1, 2, 2]


def test_amounts():
    memory = {"2GiB": 2**31, "1.5 gib": 3 * 2**29, "1500MB": 1500 * 10**6, "4096": 4096, "7kib": 7168}
    assert {text: parse_bytes(text) for text in memory} == memory
    times = {"20s": 20, "2m": 120, "1.5 h": 5400, "0.5": 0.5, "3min": 180}
    assert {text: parse_seconds(text) for text in times} == times
    assert load_config("turbogs", ["budget.time=20", "budget.max_memory=4096"]).budget == BudgetConfig("4096", "20.0")


@pytest.mark.parametrize("text", ["", "GiB", "-2GiB", "2 apples", "0", "1e9", "2GiB 3", "inf", "nan", "9" * 400])
def test_no_amounts(text):
    for parse in (parse_bytes, parse_seconds):
        assert_refused("is no amount of", parse, text)


@pytest.mark.parametrize("name", config_names())
def test_the_list_of_settings_is_a_configuration_and_says_what_each_means(name):
    mapping, text = load_config(name).to_mapping(), settings_text(load_config(name))
    assert parse_yaml(text, name) == mapping
    said = "\n".join(line for line in text.splitlines() if line.startswith("#"))
    for section in mapping.values():
        nested = section.get("learning_rates") or {}
        absent = {key for key in {*section, *nested} - {"type", "learning_rates"} if not re.search(rf"\b{key}\b", said)}
        assert not absent


def test_at_most_90_settings_besides_learning_rates():
    """Over the types of all sections; a setting that types inherit from one another counts once."""
    classes = [strategy_class(kind, name) for kind, types in TYPES.items() for name in types]
    found = set()
    for cls in (*SECTION_CLASSES.values(), *classes):
        owners = [(owner, vars(owner).get("__annotations__", ())) for owner in reversed(cls.__mro__)]
        for name in set(settings_of(cls)) - {"learning_rates"}:
            found.add((next(owner for owner, names in owners if name in names), name))
    assert len(found) <= 90
