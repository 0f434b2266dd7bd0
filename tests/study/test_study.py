"""Studies: the cells of an ablation, statistics over seeds, and plots."""

import functools
import math
import re

import numpy as np
import pytest
from helpers.refusals import assert_refused

from turbogs_plugin.config.configuration import Config, load_config
from turbogs_plugin.config.scaling import with_iterations
from turbogs_plugin.config.sections import WRITTEN_FOR
from turbogs_plugin.errors import InputError
from turbogs_plugin.study.grid import PACKAGE, Ablation, load_ablation, variant_config
from turbogs_plugin.study.results import CellResult, Study, curve_and_final
from turbogs_plugin.study.statistics import Difference, Spread, mean_curve, seconds_to_reach, summarise
from turbogs_plugin.study.study_plots import draw_over_time
from turbogs_plugin.study.study_report import report_text
from turbogs_plugin.train.history import Evaluation
from turbogs_plugin.yaml_json import packaged_names


def entry(iteration: int, seconds: float, psnr: float, count: int = 100) -> Evaluation:
    return Evaluation(iteration, seconds, psnr, 0.8, 0.1, count, 2**20)


def cell(variant: str, seed: int, *entries: Evaluation, scene: str = "fox") -> CellResult:
    curve, final = curve_and_final(entries)
    return CellResult(scene=scene, variant=variant, seed=seed, settings={}, curve=curve, final=final)


@functools.cache
def configs(name: str) -> dict[str, Config]:
    """Variant -> configuration with seed 3, of a packaged ablation. Not to be changed."""
    ablation = load_ablation(name)
    return {variant: variant_config(ablation, variant, 3, (), None) for variant in ablation.variants}


@pytest.mark.parametrize("name", packaged_names(PACKAGE))
def test_every_packaged_ablation_resolves_and_its_variants_differ_in_what_they_name(name):
    """A new type starts its section afresh: an option that both types have must not change unnoticed."""
    ablation = load_ablation(name)
    assert "turbogs" not in ablation.variants or configs(name)["turbogs"] == load_config("turbogs", ["train.seed=3"])
    texts = {config.to_yaml() for config in configs(name).values()}
    assert len(texts) == len(ablation.variants) and all("seed: 3" in text for text in texts)
    base = _flat(load_config(ablation.base, ["train.seed=3"]).to_mapping())
    for variant, overrides in ablation.variants.items():
        named = {override.partition("=")[0] for override in overrides}
        mapping = _flat(configs(name)[variant].to_mapping())
        changed = {key for key, value in mapping.items() if key in base and base[key] != value} - named
        assert changed <= DEFAULTS_THAT_DIFFER.get(variant, set()), variant


DEFAULTS_THAT_DIFFER = {"3dgs": {"optimizer.learning_rates.final_factor"}}
"""A type's own values, where a variant is meant to have them."""


def _flat(mapping: dict, place: str = "") -> dict:
    result = {}
    for key, value in mapping.items():
        result |= _flat(value, f"{place}{key}.") if isinstance(value, dict) else {f"{place}{key}": value}
    return result


def test_another_length_scales_what_counts_iterations_and_nothing_else():
    config = load_config("turbogs")
    before = config.to_yaml()
    short = with_iterations(config, 500)
    assert config.to_yaml() == before
    assert (short.train.iterations, short.train.refine_until, short.train.sh_interval) == (500, 350, 30)
    changed = {key for key, value in short.density.items() if value != config.density[key]}
    assert changed == {"refine_from", "refine_every", "final_every", "opacity_decay"}
    assert (short.density["refine_from"], short.density["refine_every"], short.density["final_every"]) == (20, 10, 50)
    assert with_iterations(config, 50).density["refine_every"] == 10
    left = 1.0 - config.density["opacity_decay"]  # events that come sooner take less
    decays = {count: with_iterations(config, count).density["opacity_decay"] for count in (1000, 2500, 4000)}
    assert decays == {1000: pytest.approx(1.0 - left**0.4), 2500: 1.0 - left, 4000: 1.0 - left}
    there_and_back = with_iterations(with_iterations(config, 1000), 5000)
    assert there_and_back.density["opacity_decay"] == pytest.approx(1.0 - left)
    same = with_iterations(config, WRITTEN_FOR)
    assert same.train.iterations == WRITTEN_FOR, "a length asked for is not the plan's to change"
    same.train.iterations = config.train.iterations
    assert same.to_yaml() == before
    number = load_config("turbogs", ["train.iterations=1000"])
    assert number.train.refine_until == config.train.refine_until, "a number scales nothing"
    assert with_iterations(number, 500).train.refine_until == 1750


def test_the_base_of_an_ablation_is_looked_for_beside_it(tmp_path, monkeypatch):
    (tmp_path / "mine.yaml").write_text("base: turbogs\ntrain: {sh_degree: 1}\n")
    (tmp_path / "ablation.yaml").write_text("title: Mine\nbase: mine.yaml\nvariants: {mine: []}\n")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert variant_config(load_ablation("../ablation.yaml"), "mine", 0, (), None).train.sh_degree == 1


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("title: x\nvariants: {}", "at least one"),
        ("title: x\nvariants: {a/b: []}", "a/b"),
        ("title: x\nvariants: {full: []}\nbaseline: ful", "did you mean 'full'"),
        ("variants: {a: []}", "title"),
        ("title: [x", "ablation '"),
        ("title: x\nvariants: {a: []}\nnotes: {true: b}", "expected text, got True"),
        ("title: x\nvariants: {a: train.seed=1}", "list"),
    ],
)
def test_a_bad_ablation_is_refused(tmp_path, text, word):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    assert_refused(re.escape(word), load_ablation, str(path))


def test_a_variant_that_does_not_resolve_is_named():
    ablation = Ablation("x", {"good": [], "bad": ["loss.nonsense=1"], "seeded": ["train.seed =1"]})
    for name, words in (("bad", "nonsense"), ("seeded", "train.seed is given by --seeds")):
        assert_refused(f"variant '{name}'.*{words}", variant_config, ablation, name, 0, (), None)


def test_a_number_of_steps_and_a_time_budget_exclude_each_other():
    for own, of_all in ((["budget.time=6s"], ()), ([], ("budget.time=6s",))):
        ablation = Ablation("x", {"timed": own})
        assert variant_config(ablation, "timed", 0, of_all, None).budget.time == "6s"
        with pytest.raises(InputError, match=r"variant 'timed': --steps 4 and the time budget 6s .*: leave one out"):
            variant_config(ablation, "timed", 0, of_all, 4)


def test_spreads_and_unpaired_differences():
    first = Spread.of([30.0, 30.2])
    assert (first.mean, first.standard_error, first.count) == (pytest.approx(30.1), pytest.approx(0.1), 2)
    assert math.isnan(Spread.of([1.0, math.nan]).mean) and math.isnan(Spread.of([1.0]).standard_error)
    assert math.isnan(Spread.of([]).mean)
    apart = Difference.of([30.5, 30.7, 30.6], [30.0, 30.2, 30.1])
    assert (apart.mean, apart.standard_error) == (pytest.approx(0.5), pytest.approx(math.sqrt(2 * 0.01 / 3)))
    assert apart.clear is True
    assert Difference.of([30.1, 31.1, 32.1], [30.0, 31.0, 32.0]).clear is False, "though each seed differs by .1"
    assert Difference.of([31.0, 31.0, 31.0], [30.0, 30.0, 30.0]).clear is True
    assert Difference.of([31.0, 31.1], [30.0, 30.2, 30.1]).clear is None, "two seeds"
    assert Difference.of([31.0], [30.0]).mean == 1.0
    assert math.isnan(Difference.of([31.0], []).mean)


def test_welch_s_degrees_of_freedom_follow_the_spreads():
    """One noisy group of three beside a steady one has two degrees of freedom: 4.3 standard errors are needed."""
    steady, noisy = [0.0, 1e-6, -1e-6], [-1.0, 0.0, 1.0]
    error = 1.0 / math.sqrt(3)
    for errors, clear in ((4.2, False), (4.4, True)):
        assert Difference.of([value + errors * error for value in noisy], steady).clear is clear


def columns(*rows: tuple[int, float, float]) -> dict[str, list[float]]:
    return curve_and_final([entry(*row) for row in rows])[0]


def test_time_to_a_psnr_is_linear_between_evaluations():
    curve = columns((0, 0.5, 10.0), (10, 2.5, 20.0), (20, 4.5, 18.0), (30, 6.5, 24.0))
    assert seconds_to_reach(curve, 9.0) == 0.5
    assert seconds_to_reach(curve, 15.0) == pytest.approx(1.5)
    assert seconds_to_reach(curve, 19.0) == pytest.approx(2.3)
    assert seconds_to_reach(curve, 21.0) == pytest.approx(5.5)
    assert seconds_to_reach(curve, 24.1) == math.inf


def test_a_mean_curve_pairs_evaluations_in_their_order_and_the_ends():
    first = columns((0, 0.0, 10.0), (9, 2.0, 20.0), (17, 4.0, 21.0))
    second = columns((0, 0.0, 12.0), (10, 2.0, 22.0), (19, 4.0, 25.0))
    (seconds, values), (_, errors) = mean_curve([first, second], "psnr")
    np.testing.assert_allclose([seconds, values, errors], [[0, 2, 4], [11, 21, 23], [1, 1, 2]])
    longer = columns((0, 0.0, 12.0), (10, 2.0, 22.0), (15, 3.0, 22.5), (19, 4.0, 25.0))
    np.testing.assert_allclose(mean_curve([first, longer], "psnr")[0], [[0, 2, 4], [11, 21, 23]])
    np.testing.assert_array_equal(mean_curve([first], "psnr")[1], np.zeros((2, 3)))


def test_a_summary_of_known_numbers():
    ends = [("base", 10.0, 30.0, 1000), ("base", 12.0, 30.2, 1200), *[("fast", 5.0, 31.0, 100)] * 3]
    ends += [("slow", 20.0, 30.1, 100), ("slow", 20.0, 20.0, 100)]
    cells = [cell(name, seed, entry(0, 0.0, 10.0), entry(100, *end)) for seed, (name, *end) in enumerate(ends)]
    study = Study(Ablation("x", {"base": [], "fast": [], "slow": []}), cells)
    (summary,) = summarise(study)
    base, fast, slow = summary.rows
    assert (base.spread("seconds").mean, base.spread("gaussians").mean) == (11.0, 1100.0)
    assert fast.difference("psnr").mean == pytest.approx(0.9) and fast.ratio("seconds") == pytest.approx(5.0 / 11.0)
    assert fast.difference("psnr").standard_error == pytest.approx(0.1)
    of_base = (10.0 * 10 / 20.0 + 12.0 * 10 / 20.2) / 2
    assert np.mean(base.seconds_to(20.0)) == pytest.approx(of_base) and base.ratio_to(20.0) == pytest.approx(1.0)
    assert fast.ratio_to(20.0) == pytest.approx(5.0 * 10 / 21.0 / of_base)
    assert [np.isfinite(slow.seconds_to(target)).sum() for target in (20.0, 30.5)] == [2, 0]
    assert math.isnan(fast.ratio_to(30.5)), "the baseline never got there"
    assert all(math.isnan(row.ratio_to(9.0)) for row in summary.rows) and summary.targets == [29.0, 29.5, 30.0]
    lines = report_text(study, [summary]).splitlines()
    assert [line.startswith("| base |") for line in lines if "+" in line] == [False, False], "not with itself"


def test_a_capture_without_the_baseline_is_compared_with_nothing():
    cells = [cell("base", 0, entry(1, 1.0, 30.0)), cell("other", 0, entry(1, 1.0, 31.0), scene="h")]
    study = Study(Ablation("x", {"base": [], "other": []}), cells)
    fox, h = summarise(study)
    assert (fox.baseline, h.baseline) == ("base", "")
    assert "nan" not in report_text(study, [fox, h])
    assert len(draw_over_time([fox, h] * 13).axes) == 2 * 24
