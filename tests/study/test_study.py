"""Ablations: the grid, statistics over seeds, and the summary."""

import functools
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from turbogs_plugin.config.configuration import Config, load_config
from turbogs_plugin.config.scaling import with_iterations
from turbogs_plugin.config.sections import WRITTEN_FOR
from turbogs_plugin.errors import InputError
from turbogs_plugin.study.grid import PACKAGE, Ablation, alike_at, load_ablation, variant_config
from turbogs_plugin.study.plots import OTHER_COLOR, draw_curves, draw_front, told_apart
from turbogs_plugin.study.results import CellResult, Study
from turbogs_plugin.study.statistics import Curve, Difference, Spread, pareto_front, seconds_to_reach
from turbogs_plugin.study.summary import VariantRow, summarise
from turbogs_plugin.train.history import Evaluation
from turbogs_plugin.yaml_json import packaged_names


def entry(iteration: int, seconds: float, psnr: float, count: int = 100) -> Evaluation:
    return Evaluation(iteration, seconds, psnr, 0.8, 0.1, count, 2**20)


def cell(variant: str, seed: int, *entries: Evaluation, scene: str = "fox") -> CellResult:
    config = load_config("turbogs", [f"train.seed={seed}", f"train.iterations={entries[-1].iteration}"])
    mapping = config.to_mapping()
    return CellResult(
        scene=scene, variant=variant, seed=seed, config=mapping, asked=mapping, history=list(entries), fps=100.0
    )


# The grid


@functools.cache
def configs(name: str) -> dict[str, Config]:
    """Variant -> configuration with seed 3, of a packaged ablation. Not to be changed."""
    ablation = load_ablation(name)
    return {variant: variant_config(ablation, variant, 3, (), None) for variant in ablation.variants}


@pytest.mark.parametrize("name", packaged_names(PACKAGE))
def test_every_packaged_ablation_resolves_and_its_variants_differ(name):
    texts = {variant: config.to_yaml() for variant, config in configs(name).items()}
    assert len(set(texts.values())) == len(texts)
    assert all("seed: 3" in text for text in texts.values())


def test_the_tables_of_the_paper_are_there():
    assert set(packaged_names(PACKAGE)) >= {
        "baselines",
        "bounds",
        "components",
        "departures",
        "paper_parts",
        "parts",
        "views",
        "hard_ratio",
        "schedule",
    }
    components = load_ablation("components")
    assert list(components.variants)[:5] == ["3dgs", "+err-sps", "+geo-vs", "+sparse-ncc", "+err-dp"]
    assert variant_config(components, "turbogs", 0, (), None).to_yaml() == load_config("turbogs").to_yaml()


@pytest.mark.parametrize("name", packaged_names(PACKAGE))
def test_what_a_variant_does_not_name_is_as_in_the_base(name):
    """A new type starts its section afresh: an option that both types have must not change unnoticed."""
    ablation = load_ablation(name)
    base = _flat(load_config(ablation.base, ["train.seed=3"]).to_mapping())
    for variant, overrides in ablation.variants.items():
        named = {override.partition("=")[0] for override in overrides}
        mapping = _flat(configs(name)[variant].to_mapping())
        changed = {key for key, value in mapping.items() if key in base and base[key] != value} - named
        assert changed <= DEFAULTS_THAT_DIFFER.get(variant, set()), variant


DEFAULTS_THAT_DIFFER = {
    "3dgs": {"optimizer.learning_rates.final_factor"},
    "fastgs": {"density.refine_every"},
}
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
    same = with_iterations(config, WRITTEN_FOR)
    assert same.train.iterations == WRITTEN_FOR, "a length asked for is not the plan's to change"
    same.train.iterations = config.train.iterations
    assert same.to_yaml() == before


def test_the_base_of_an_ablation_is_looked_for_beside_it(tmp_path, monkeypatch):
    (tmp_path / "mine.yaml").write_text("base: turbogs\ntrain: {sh_degree: 1}\n")
    (tmp_path / "ablation.yaml").write_text("title: Mine\nbase: mine.yaml\nvariants: {mine: []}\n")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert variant_config(load_ablation("../ablation.yaml"), "mine", 0, (), None).train.sh_degree == 1


def test_what_counts_iterations_is_written_for_the_length_that_is_set_or_else_the_base():
    auto, number = load_config("turbogs"), load_config("turbogs", ["train.iterations=1000"])
    assert (auto.train.written_iterations, number.train.written_iterations) == (5000, 1000)
    assert number.train.refine_until == auto.train.refine_until, "a number scales nothing"
    assert with_iterations(auto, 500).train.refine_until == 350
    assert with_iterations(number, 500).train.refine_until == 1750
    assert with_iterations(with_iterations(auto, 500), 250).train.refine_until == 175


def test_events_that_come_sooner_take_less_of_the_opacities():
    config = load_config("turbogs")
    left = 1.0 - config.density["opacity_decay"]
    decays = {count: with_iterations(config, count).density["opacity_decay"] for count in (1000, 2500, 4000)}
    assert decays == {1000: pytest.approx(1.0 - left**0.4), 2500: 1.0 - left, 4000: 1.0 - left}
    there_and_back = with_iterations(with_iterations(config, 1000), 5000)
    assert there_and_back.density["opacity_decay"] == pytest.approx(1.0 - left)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("title: x\nvariants: {}", "at least one"),
        ("title: x\nvariants: {a/b: []}", "a/b"),
        ("title: x\nvariants: {..: []}", ".."),
        ("title: x\nvariants: {full: []}\nbaseline: ful", "did you mean 'full'"),
        ("title: x\nvariant: {a: []}", "variants"),
        ("variants: {a: []}", "title"),
        ("title: x\nvariants: {1: []}", "name 1 is not text: put it in quotes, '1'"),
        ("title: x\nvariants: {a: []}\nnotes: {true: b}", "name True is not text"),
        ("title: x\nvariants: {a: train.seed=1}", "list"),
    ],
)
def test_a_bad_ablation_is_refused(tmp_path, text, word):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=re.escape(word)):
        load_ablation(str(path))


def test_a_variant_that_does_not_resolve_is_named():
    ablation = Ablation("x", {"good": [], "bad": ["loss.nonsense=1"]})
    with pytest.raises(InputError, match=r"variant 'bad'.*nonsense"):
        variant_config(ablation, "bad", 0, (), None)


@pytest.mark.parametrize(("own", "of_all"), [(["budget.time=6s"], ()), ([], ("budget.time=6s",))])
def test_a_number_of_steps_and_a_time_budget_exclude_each_other(own, of_all):
    ablation = Ablation("x", {"timed": own})
    assert variant_config(ablation, "timed", 0, of_all, None).budget.time == "6s"
    with pytest.raises(InputError, match=r"variant 'timed': --steps 4 and the time budget 6s .*: leave one out"):
        variant_config(ablation, "timed", 0, of_all, 4)


def test_a_common_length_leaves_out_what_it_makes_a_copy():
    ablation = load_ablation("leave_out")
    alike = {"epochs-50": "nothing", "epochs-75": "nothing"}
    assert alike_at(ablation, list(ablation.variants), (), 1000) == alike
    assert alike_at(ablation, ["nothing", "sh-2", "epochs-75"], (), 1000) == {"epochs-75": "nothing"}
    assert alike_at(load_ablation("batch"), ["x2-same-rates", "x2-longer"], (), 1000) == {"x2-longer": "x2-same-rates"}
    departures = load_ablation("departures")
    assert alike_at(departures, list(departures.variants), (), 1000) == {"iterations-5000": "turbogs"}
    for name in set(packaged_names(PACKAGE)) - {"leave_out", "batch", "departures"}:
        assert alike_at(load_ablation(name), list(load_ablation(name).variants), (), 1000) == {}
    same = Ablation(
        "x", {"long": ["train.iterations=5000"], "a": [], "b": [], "last": ["train.epochs=5"]}, baseline="a"
    )
    assert alike_at(same, list(same.variants), (), 1000) == {"long": "a", "last": "a"}


# Statistics


def test_spreads_and_differences():
    first = Spread.of([30.0, 30.2])
    assert (first.mean, first.low, first.high, first.count) == (pytest.approx(30.1), 30.0, 30.2, 2)
    assert math.isnan(Spread.of([1.0, math.nan]).mean)
    five = Difference.of([0.1, 0.2, 0.3, 0.2, 0.2])
    assert (five.mean, five.standard_error) == (pytest.approx(0.2), pytest.approx(0.1 / math.sqrt(10)))
    assert five.clear is True and Difference.of([-0.1, 0.2, 0.3, 0.2, -0.2]).clear is False
    assert Difference.of([0.3]).clear is None and math.isnan(Difference.of([]).mean)


def test_a_difference_is_taken_seed_by_seed_of_the_seeds_that_both_have():
    """The baseline's third seed is an accident that the variant never had: it counts for neither."""
    values = {"base": {0: 30.0, 1: 34.0, 2: 10.0}, "other": {1: 34.5, 0: 30.5, 7: 99.0}}
    cells = [cell(name, seed, entry(1, 1.0, psnr)) for name, of in values.items() for seed, psnr in of.items()]
    (summary,) = summarise(Study(Ablation("x", {"base": [], "other": []}), cells))
    assert summary.rows[1].difference("psnr") == Difference(0.5, 0.0, 2)


def test_time_to_a_psnr_is_linear_between_evaluations():
    history = [entry(0, 0.5, 10.0), entry(10, 2.5, 20.0), entry(20, 4.5, 18.0), entry(30, 6.5, 24.0)]
    assert seconds_to_reach(history, 9.0) == 0.5
    assert seconds_to_reach(history, 15.0) == pytest.approx(1.5)
    assert seconds_to_reach(history, 19.0) == pytest.approx(2.3)
    assert seconds_to_reach(history, 21.0) == pytest.approx(5.5)
    assert seconds_to_reach(history, 24.1) == math.inf


def test_a_curve_pairs_common_iterations_and_the_ends():
    early = [entry(0, 0.0, 10.0), entry(10, 2.0, 20.0), entry(17, 3.0, 21.0)]
    late = [entry(0, 1.0, 12.0), entry(8, 3.0, 16.0), entry(10, 4.0, 22.0), entry(19, 5.0, 25.0)]
    curve = Curve.of([early, late], "psnr")
    np.testing.assert_allclose(curve.seconds, [0.5, 3.0, 4.0])
    np.testing.assert_allclose([curve.mean, curve.low, curve.high], [[11, 21, 23], [10, 20, 21], [12, 22, 25]])


def test_a_curve_of_runs_by_time_pairs_evaluations_in_their_order():
    first = [entry(0, 0.0, 10.0), entry(9, 2.0, 20.0), entry(17, 4.0, 21.0)]
    second = [entry(0, 0.0, 12.0), entry(10, 2.0, 22.0), entry(19, 4.0, 25.0)]
    curve = Curve.of([first, second], "psnr")
    np.testing.assert_allclose(curve.seconds, [0.0, 2.0, 4.0])
    np.testing.assert_allclose([curve.mean, curve.low, curve.high], [[11, 21, 23], [10, 20, 21], [12, 22, 25]])


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), min_size=1, max_size=12))
def test_the_front_is_what_nothing_beats(points):
    front = pareto_front([(float(x), float(y)) for x, y in points])
    for (seconds, quality), on_front in zip(points, front, strict=True):
        beaten = any(x <= seconds and y >= quality and (x < seconds or y > quality) for x, y in points)
        assert on_front is not beaten


def test_nan_is_not_on_the_front():
    assert pareto_front([(1.0, math.nan), (2.0, 20.0)]) == [False, True]


def test_a_summary_of_known_numbers():
    study = Study(
        Ablation("x", {"base": [], "fast": [], "slow": []}),
        [
            cell("base", 0, entry(0, 0.0, 10.0), entry(100, 10.0, 30.0, 1000)),
            cell("base", 1, entry(0, 0.0, 10.0), entry(100, 12.0, 30.2, 1200)),
            cell("fast", 0, entry(0, 0.0, 10.0), entry(100, 5.0, 31.0)),
            cell("fast", 1, entry(0, 0.0, 10.0), entry(100, 5.0, 31.0)),
            cell("slow", 0, entry(0, 0.0, 10.0), entry(100, 20.0, 30.1)),
            cell("slow", 1, entry(0, 0.0, 10.0), entry(100, 20.0, 20.0)),
        ],
    )
    (summary,) = summarise(replace(study, targets=[20.0, 30.5]))
    base, fast, slow = summary.rows
    assert (base.seconds.mean, base.spread("gaussians").mean) == (11.0, 1100.0)
    assert fast.difference("psnr").mean == pytest.approx(0.9) and fast.ratio("seconds") == pytest.approx(5.0 / 11.0)
    assert fast.difference("psnr").standard_error == pytest.approx(0.1)  # 1.0 and 0.8
    assert fast.difference("psnr").clear is False  # two seeds say little: 12.7 standard errors are needed
    assert slow.difference("seconds") == Difference(9.0, 1.0, 2)
    assert [row.on_front for row in summary.rows] == [False, True, False]
    of_base = (10.0 * 10 / 20.0 + 12.0 * 10 / 20.2) / 2
    assert np.mean(base.seconds_to(20.0)) == pytest.approx(of_base) and base.ratio_to(20.0) == pytest.approx(1.0)
    assert fast.ratio_to(20.0) == pytest.approx(5.0 * 10 / 21.0 / of_base)
    assert [np.isfinite(slow.seconds_to(target)).sum() for target in (20.0, 30.5)] == [2, 0]
    assert math.isnan(fast.ratio_to(30.5))  # the baseline never got there
    (begun,) = summarise(replace(study, targets=[9.0]))
    assert [(np.isfinite(row.seconds_to(9.0)).sum(), math.isnan(row.ratio_to(9.0))) for row in begun.rows] == [
        (2, True)
    ] * 3
    (default,) = summarise(study)
    assert default.targets == [29.0, 29.5, 30.0]


def test_ratios_are_over_the_seeds_that_both_have():
    """A baseline of more seeds than the variant, one of which is slow and large, changes nothing."""
    cells = [
        cell("base", 0, entry(0, 0.0, 10.0), entry(100, 10.0, 30.0, 1000)),
        cell("base", 1, entry(0, 0.0, 10.0), entry(100, 70.0, 30.0, 7000)),
        cell("other", 2, entry(0, 0.0, 10.0), entry(100, 99.0, 30.0, 9000)),
        cell("other", 0, entry(0, 0.0, 10.0), entry(100, 5.0, 30.0, 2000)),
    ]
    (summary,) = summarise(Study(Ablation("x", {"base": [], "other": []}), cells, targets=[20.0]))
    other = summary.rows[1]
    assert (other.ratio("seconds"), other.ratio("gaussians")) == (0.5, 2.0)
    assert other.ratio_to(20.0) == 0.5 and other.difference("seconds").count == 1
    assert math.isnan(VariantRow("lone", cells[:1], []).ratio("seconds"))


def test_a_variant_that_failed_does_not_set_the_scale_of_the_plots():
    results = {"good": 31.0, "fair": 24.0, "lost": 9.5, "unknown": math.nan}
    cells = [cell(name, 0, entry(0, 0.0, 5.0), entry(100, 10.0, psnr)) for name, psnr in results.items()]
    (summary,) = summarise(Study(Ablation("x", {name: [] for name in results}), cells, targets=[20.0]))
    shown, words = told_apart(summary)
    assert [row.name for row in shown] == ["good", "fair", "unknown"]
    assert words == "Not in the plot: lost (9.5 dB in 10.0 s)"


@pytest.mark.parametrize(("count", "grey"), [(10, 0), (11, 9)])
def test_of_many_variants_the_baseline_and_the_front_stand_out(count, grey):
    names = [f"v{number}" for number in range(count)]
    cells = [cell(name, 0, entry(0, 0.0, 20.0), entry(100, 10.0 + n, 30.0 - n / 10)) for n, name in enumerate(names)]
    study = Study(Ablation("x", {name: [] for name in names}, baseline="v5"), cells, targets=[20.0])
    (summary,) = summarise(study)
    figure = draw_curves(summary)
    for axes in figure.axes:
        lines = axes.get_lines()
        assert [line.get_color() for line in lines[:grey]] == [OTHER_COLOR] * grey
        named = [line.get_label() for line in lines[grey:]]
        assert named == (["v0", "v5"] if grey else names)
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == ([f"{grey} others", "v0", "v5"] if grey else names)


def test_names_of_points_are_kept_clear_of_what_is_behind():
    cells = [cell(name, 0, entry(0, 0.0, 20.0), entry(100, 10.0, 30.0)) for name in ("a", "b")]
    (summary,) = summarise(Study(Ablation("x", {"a": [], "b": []}), cells, targets=[20.0]))
    texts = draw_front(summary).axes[0].texts
    assert [text.get_text() for text in texts] == ["a", "b"] and all(text.get_path_effects() for text in texts)
