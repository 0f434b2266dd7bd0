"""`turbogs report RUN RUN`: runs side by side, as a study."""

from collections.abc import Sequence
from pathlib import Path

import pytest
from helpers.framework_runs import TINY
from helpers.refusals import assert_refused

from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.config.scaling import with_iterations
from turbogs_plugin.study.results import StudyFolder
from turbogs_plugin.study.runs import study_of_runs
from turbogs_plugin.train.history import Evaluation, append_evaluation

pytestmark = pytest.mark.usefixtures("plotted")


def a_run(folder: Path, iterations: int, *overrides: str, fitted: Sequence[str] = ()) -> Path:
    """What a report reads of a run. `fitted`: settings that a budget changed, besides the number of iterations."""
    folder.mkdir()
    (folder / "asked.yaml").write_text(load_config("turbogs", overrides).to_yaml())
    resolved = with_iterations(load_config("turbogs", [*overrides, *fitted]).without_plan(), iterations)
    (folder / "config.yaml").write_text(resolved.to_yaml())
    (folder / "model.ply").touch()
    append_evaluation(folder / "history.jsonl", Evaluation(iterations, 20.0, 30.0, 0.8, 0.1, 100, 2**20))
    return folder


def test_runs_are_reported_side_by_side(turbogs, capture, tmp_path):
    runs = {"a": ["train.seed=0"], "b": ["train.seed=1"], "c": ["pixel_sampler.type=random"]}
    quick = [setting for setting in TINY if "iterations" not in setting] + ["train.iterations=3"]
    for name, overrides in runs.items():
        arguments = ["train", capture, "--out", tmp_path / name, "--device", "cpu", *quick, *overrides]
        assert turbogs(*arguments)[0] == 0
    paths, out = [tmp_path / name for name in runs], tmp_path / "report"
    code, printed, _ = turbogs("report", *paths, "--out", out)
    assert code == 0 and str(out / "report.md") in printed
    results = StudyFolder(out).read_study().results
    assert [(result.variant, result.seed) for result in results] == [("a", 0), ("a", 1), ("c", 0)]
    assert all(result.final["wall_seconds"] > result.final["seconds"] for result in results)
    page = (out / "report.md").read_text()
    assert "pixel_sampler.type=random" in page and "not recorded" in page and "| whole command in s |" in page
    assert turbogs("report", *paths, "--out", out)[0] == 2, "a folder that is not new"
    assert turbogs("report", out)[0] == 0 and (out / "report.md").read_text() == page


def test_a_run_of_the_settings_and_seed_of_another_is_refused(tmp_path):
    first, second = (a_run(tmp_path / name, 30) for name in ("x", "y"))
    for other in (second, tmp_path / "y" / ".." / "x"):
        assert_refused(r"has the settings and the seed of '.*/x': .* another train.seed", study_of_runs, [first, other])


def test_a_stopped_run_is_refused(tmp_path):
    run = a_run(tmp_path / "run", 30)
    (run / "model.ply").unlink()
    assert_refused(r"/run' is not finished .* turbogs train --resume ", study_of_runs, [run])
    (run / "model.ply").touch()  # as an export from its checkpoint leaves one
    longer = with_iterations(load_config("turbogs").without_plan(), 60)
    (run / "config.yaml").write_text(longer.to_yaml())
    assert_refused("is not finished", study_of_runs, [run])


def test_captures_that_share_a_name_are_kept_apart(tmp_path):
    others = {"same": "/a/fox", "b": "/b/fox", "half": "/a/fox scene.factor=2"}
    runs = [
        a_run(tmp_path / name, 30, f"train.seed={seed}", *f"scene.path={place}".split())
        for seed, (name, place) in enumerate({"x": "/a/fox", **others}.items())
    ]
    study = study_of_runs(runs)
    assert [result.scene for result in study.results] == ["fox", "fox", "fox-2", "fox-3"]
    assert list(study.ablation.variants) == ["x"]


def test_runs_that_were_asked_the_same_are_seeds_whatever_plan_and_budgets_made_of_it(tmp_path):
    """Lengths, pixels and caps that a time budget fits to each seed are no variants of their own."""

    def run(name: str, seed: int, iterations: int, *overrides: str, fitted: Sequence[str] = ()) -> Path:
        return a_run(tmp_path / name, iterations, f"train.seed={seed}", *overrides, fitted=fitted)

    capped = ("density.max_gaussians=9000",)
    runs = [
        run("a", 0, 2600, "budget.time=20s"),
        run("b", 1, 2471, "budget.time=20s", fitted=["schedule.pixel_budget=1.5"]),
        run("c", 2, 1500, "budget.time=20s", fitted=capped),
        run("capped", 0, 1500, "budget.time=20s", *capped),
        run("longer", 0, 2600, "budget.time=30s"),
        run("free", 0, 2600),
        run("free-2", 1, 2471),
    ]
    study = study_of_runs(runs)
    assert {name: len(study.of("run", name)) for name in study.ablation.variants} == {
        "a": 3, "capped": 1, "longer": 1, "free": 2,
    }  # fmt: skip
    assert study.ablation.variants["longer"] == ["budget.time=30s"]
    (tmp_path / "a" / "asked.yaml").unlink()
    assert_refused(r"asked\.yaml", study_of_runs, runs)
