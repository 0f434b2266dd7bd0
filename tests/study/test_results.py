"""`results.json` and the cells' own files: what is written is read again, plain and small."""

import json
import math
import re
from dataclasses import replace

import pytest
from helpers.refusals import assert_refused
from hypothesis import given
from hypothesis import strategies as st

from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.report.provenance import Provenance
from turbogs_plugin.study import results
from turbogs_plugin.study.grid import Ablation, CellKey
from turbogs_plugin.study.results import CellResult, Study, StudyFolder, curve_and_final, flat_settings
from turbogs_plugin.train.history import Evaluation

HERE = Provenance("a machine", {"torch": "2"}, "none", "abc")
ABLATION = Ablation("Two", {"base": [], "other": ["loss.type=charbonnier"]}, notes={"other": "no | NCC"})


def result(variant: str, seed: int, scene: str = "fox", **changed) -> CellResult:
    config = load_config("turbogs", [*ABLATION.variants[variant], f"train.seed={seed}"])
    config.scene.path = f"/somewhere/{scene}"
    history = [
        Evaluation(0, 0.125, 9.5, math.nan, 0.25, 50, 2**20),
        Evaluation(26, 2.5, 30.125 + seed, 0.9, 0.02, 90, 2**21, refined_psnr=30.5),
    ]
    curve, final = curve_and_final(history)
    known = {"provenance": HERE, "capture": "c0ffee", "settings": flat_settings(config.to_mapping())}
    known |= {"planned": {"train.iterations": 26}, "curve": curve, "final": {**final, "fps": 100.5}}
    return CellResult(scene=scene, variant=variant, seed=seed, **(known | changed))


def study() -> Study:
    cells = [result(variant, seed) for variant in ABLATION.variants for seed in (0, 1)]
    cells[3] = replace(cells[3], provenance=replace(HERE, machine="another"), capture="")
    return Study(ABLATION, [*cells, result("base", 0, "h", provenance=None, lpips_reason="no weights")])


@pytest.fixture
def folder(tmp_path) -> StudyFolder:
    folder = StudyFolder(tmp_path / "study")
    folder.write_study(study())
    return folder


def test_a_study_is_read_as_it_was_written(folder):
    again = folder.read_study()
    assert repr(again) == repr(study())
    text = folder.file.read_text()
    folder.write_study(again)
    assert folder.file.read_text() == text


def test_the_file_is_plain_and_says_once_what_cells_share(folder):
    text = folder.file.read_text()
    document = json.loads(text)
    first, second, third = document["cells"][:3]
    assert text.count("a machine") == text.count("pixel_sampler.type") == 1
    assert document["settings"]["scene.path"] == "fox", "where a capture lies is no part of a result"
    assert (first["settings"], second["settings"]) == ({}, {"train.seed": 1})
    assert third["settings"]["loss.type"] == "charbonnier" and third["settings"]["loss.ncc_weight"] is None
    assert second["final"] == first["final"] | {"psnr": 31.125} and first["final"]["refined_psnr"] == 30.5
    assert first["curve"]["psnr"] == [9.5, 30.125] and first["curve"]["ssim"] == [None, 0.9]
    assert len(text) < 10_000


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"format": 2}, "results.json' is of format 2: this version reads format 3"),
        ({"cells": 3}, "results.json' does not hold results of a study"),
        ({"variants": {}}, "variants: at least one is needed"),
        ({"cells": [{"scene": "fox"}]}, "results.json' does not hold results of a study"),
    ],
)
def test_a_file_that_is_wrong_is_refused_by_name(folder, changed, words):
    folder.file.write_text(json.dumps(json.loads(folder.file.read_text()) | changed))
    assert_refused(re.escape(words), folder.read_study)


@pytest.mark.parametrize("changed", [{"scene": 7}, {"curve": dict.fromkeys(results.CURVE, "")}, {"final": {"x": 1e99}}])
def test_a_cell_of_another_value_is_refused_by_name(folder, changed):
    document = json.loads(folder.file.read_text())
    document["cells"][1] |= changed
    folder.file.write_text(json.dumps(document))
    assert_refused("does not hold results of a study", folder.read_study)


VALUES = st.sampled_from([0, 1.5, True, "", "x", [], [1, 2.0]])
FLAT = st.dictionaries(st.sampled_from(["loss.type", "loss.rate", "density.until", "plan.x"]), VALUES)


@given(FLAT, FLAT)
def test_settings_are_restored_from_their_changes(common, own):
    changed = json.loads(json.dumps(results.changes(common, own)))
    assert results.with_changes(common, changed) == own and results.changes(own, own) == {}


def test_a_cell_that_is_not_in_the_results_yet_is_not_lost(folder):
    new = result("other", 1, "h")
    folder.write(new)
    read = folder.read_study()
    assert read.results[-1] == new
    folder.write_study(read)
    (folder.cells / new.key.file).unlink()
    assert len(folder.read_study().results) == 6


def test_a_claimed_cell_is_one_s_alone(tmp_path):
    first, second = StudyFolder(tmp_path), StudyFolder(tmp_path)
    key, other = CellKey("fox", "a.b[1]", 3), CellKey("fox", "a.b[1]", 31)
    with first.claimed(key) as mine, second.claimed(key) as taken, second.claimed(other) as free:
        assert (mine, taken, free) == (True, False, True)
