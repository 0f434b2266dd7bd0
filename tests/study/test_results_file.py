"""`results.json`: what is written is read again, small and to the letter; reports are made from it alone."""

import csv
import json
import math
import re
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.errors import InputError
from turbogs_plugin.report.provenance import Provenance
from turbogs_plugin.study.difference import common_configuration, difference, flattened, nested, restored
from turbogs_plugin.study.document import Picture, to_markdown
from turbogs_plugin.study.folder import StudyFolder
from turbogs_plugin.study.grid import Ablation, CellKey
from turbogs_plugin.study.pages import report_blocks
from turbogs_plugin.study.results import CellResult, Failure, Study
from turbogs_plugin.study.results_file import study_from_json, study_to_json
from turbogs_plugin.study.statistics import crossing_gap
from turbogs_plugin.study.summary import summarise
from turbogs_plugin.train.history import Evaluation

HERE = Provenance("a machine", {"torch": "2"}, "none", "abc")
ABLATION = Ablation("Two", {"base": [], "other": ["loss.type=charbonnier"]}, notes={"other": "no | NCC"})


def result(variant: str, seed: int, scene: str = "fox", **changes) -> CellResult:
    config = load_config("turbogs", [*ABLATION.variants[variant], f"train.seed={seed}"])
    config.scene.path = f"/somewhere/{scene}"
    history = [
        Evaluation(0, 0.1, 9.5, math.nan, 0.2, 50, 2**20),
        Evaluation(26, 2.5, 30.125 + seed, 0.9, 0.02, 90, 2**21),
    ]
    known = {"fps": 100.5, "peak_bytes": 2**21, "warmup_iterations": 20, "provenance": HERE, "capture": "c0ffee"}
    mapping = config.to_mapping()
    known |= {"config": mapping, "asked": mapping | {"maps": {"beta": 0.25}}, "history": history}
    return CellResult(scene=scene, variant=variant, seed=seed, **(known | changes))


def study() -> Study:
    results = [result(variant, seed) for variant in ABLATION.variants for seed in (0, 1)]
    elsewhere = replace(HERE, machine="another machine")
    results[3] = replace(results[3], provenance=elsewhere, warmup_iterations=7, lpips=0.25, capture="")
    results[2] = replace(results[2], flip=0.125, cell_seconds=7.25)  # the others are older than these
    results.append(result("base", 0, "h", provenance=None, resolved=False, capture="beef"))
    results[4].asked = results[4].config
    results[4].history[1].worst_psnr = 25.5
    return Study(ABLATION, results, [Failure(CellKey("h", "other", 1), "it broke")], [29.5])


@pytest.fixture
def folder(tmp_path) -> StudyFolder:
    folder = StudyFolder(tmp_path / "study")
    folder.write_study(study())
    return folder


def test_a_study_is_read_as_it_was_written(folder):
    again = folder.read_study()
    assert (again.ablation, again.failures, again.targets) == (ABLATION, study().failures, [29.5])
    configs = [(entry.config, entry.asked) for entry in again.results]
    wanted = [(entry.config, entry.asked) for entry in study().results]
    assert json.dumps(configs, sort_keys=True) == json.dumps(wanted, sort_keys=True).replace("/somewhere/", "")
    for entry, original in zip(again.results, study().results, strict=True):
        original.history = [replace(evaluation, memory_bytes=0) for evaluation in original.history]  # `LEFT_OUT`
        assert repr(replace(entry, config={}, asked={})) == repr(replace(original, config={}, asked={}))


def test_what_is_written_again_is_the_same_to_the_letter(folder):
    text = folder.file.read_text()
    folder.write_study(study_from_json(folder.file))
    assert folder.file.read_text() == text


def test_what_cells_share_is_written_once(folder):
    text = folder.file.read_text()
    for once in ("a machine", "another machine", "c0ffee", "mixed"):
        assert text.count(f'"{once}"') + text.count(f'.{once}"') == 1, once
    cells = json.loads(text)["cells"]
    assert "warmup_iterations" not in cells[0] and cells[3]["warmup_iterations"] == 7 and cells[3]["capture"] == ""
    common = json.loads(text)["common"]
    assert "config" not in cells[0] and "asked" not in cells[0] and common["asked"] == {"maps.beta": 0.25}
    assert cells[1]["config"] == {"train.seed": 1} and cells[4]["resolved"] is False
    assert "worst_psnr" not in cells[0]["history"] and cells[4]["history"]["worst_psnr"] == 25.5
    assert len(text) < 12_000


def test_numbers_have_the_digits_that_a_reader_can_use(folder):
    exact = result("base", 0)
    exact.history[1] = Evaluation(26, 2.123456789, 30.123456789, 0.8123456789, 0.0123456789, 90, 2**21)
    folder.write_study(Study(ABLATION, [exact]))
    (read,) = folder.read_study().results
    assert repr(read.final) == repr(Evaluation(26, 2.123457, 30.12346, 0.8123457, 0.0123457, 90))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"format": 1}, r"results.json' is of format 1: this version of TurboGS reads format 2"),
        ({"format": None}, "format"),
        ({"cells": 3}, r"results.json.cells: expected a list"),
        ({"surplus": 3}, r"unknown key '.*results.json.surplus'"),
        ({"ablation": {"title": "x", "variants": {}}}, "variants: at least one is needed"),
    ],
)
def test_a_file_that_is_wrong_is_refused_by_name(folder, changes, words):
    folder.file.write_text(json.dumps(json.loads(folder.file.read_text()) | changes))
    with pytest.raises(InputError, match=words):
        folder.read_study()


@pytest.mark.parametrize(
    ("history", "words"),
    [
        ({"psnr": [1.0]}, "columns of one length"),
        ({"pnsr": [1.0, 2.0]}, "unknown key .*did you mean 'psnr'"),
        ({"iteration": [0, 1.5]}, r"history.iteration\[1\]: expected a whole number"),
        ({"iteration": [0, None]}, r"history.iteration\[1\]: expected a whole number"),
        ({"ssim": [0.5, "x"]}, r"history.ssim\[1\]: expected a number"),
        ({"ssim": 0.5}, r"history.ssim: expected a list"),
    ],
)
def test_a_history_that_is_wrong_is_refused_by_its_place(folder, history, words):
    document = json.loads(folder.file.read_text())
    document["cells"][1]["history"] |= history
    folder.file.write_text(json.dumps(document))
    with pytest.raises(InputError, match=rf"results.json.cells\[1\].*{words}|{words}"):
        folder.read_study()


def test_a_history_without_a_column_that_every_one_has_is_refused(folder):
    document = json.loads(folder.file.read_text())
    del document["cells"][1]["history"]["psnr"]
    folder.file.write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"cells\[1\].history: key 'psnr' is missing"):
        folder.read_study()


# Differences of configurations

VALUES = st.sampled_from([0, 0.0, 1, 1.0, True, False, None, "", "x", [], [1, 2.0], {}, {"a.b": 1}])
CONFIGURATIONS = st.dictionaries(
    st.sampled_from(["loss", "density", "plan"]),
    st.dictionaries(
        st.sampled_from(["type", "rate", "until"]),
        VALUES | st.dictionaries(st.sampled_from(["means", "sh0"]), VALUES, min_size=1),
        min_size=1,
    ),
    min_size=1,
)


def exactly(mapping: dict) -> str:
    return json.dumps(mapping, sort_keys=True)  # 1, 1.0 and true are equal in Python


@given(st.lists(CONFIGURATIONS, min_size=1, max_size=4))
def test_every_configuration_is_restored_from_its_difference(configs):
    flats = [flattened(config) for config in configs]
    common = common_configuration(flats)
    for config, flat in zip(configs, flats, strict=True):
        changes = json.loads(json.dumps(difference(common, flat)))
        assert exactly(nested(restored(common, changes))) == exactly(config)
        assert not difference(flat, flat)


def test_the_common_configuration_is_what_most_have():
    flats = [{"a.x": 1, "a.y": 1}, {"a.x": 2, "a.z": 1}, {"a.x": 2, "a.z": 1, "a.y": 1}]
    assert common_configuration(flats) == {"a.x": 2, "a.y": 1, "a.z": 1}
    assert difference(common_configuration(flats), flats[0]) == {"a.x": 1, "absent": ["a.z"]}


# Folders


def test_a_cell_that_is_not_in_the_results_yet_is_not_lost(folder):
    new = result("other", 1, "h")
    folder.write(new)
    read = folder.read_study()
    assert new.key in {entry.key for entry in read.results} and not read.failures
    folder.write_study(read)
    (folder.cells / new.key.file).unlink()
    assert len(folder.read_study().results) == 6


def test_a_failure_is_known_until_its_cell_is_there(folder):
    folder.write(Failure(CellKey("h", "base", 1), "no luck"))
    assert [failure.reason for failure in folder.read_study().failures] == ["it broke", "no luck"]
    folder.write(result("base", 1, "h"))
    assert [failure.reason for failure in folder.read_study().failures] == ["it broke"]


def contents(folder: StudyFolder) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.path.iterdir()}


def test_a_second_report_changes_nothing(turbogs, folder, monkeypatch):
    code, printed, _ = turbogs("report", folder.path)
    assert code == 0 and "report.html" in printed
    before = contents(folder)
    assert set(before) == {"results.json", "report.md", "report.html", "table.csv"} | {
        f"{scene}-{plot}.png" for scene in ("fox", "h") for plot in ("curves", "pareto", "gaussians")
    }
    assert b"s to 29.5 dB" in before["report.md"], "the targets of the last report"
    assert sum(map(len, before.values())) < 1_000_000
    monkeypatch.setattr(Figure, "savefig", lambda *_, **__: pytest.fail("a plot of the same data was drawn again"))
    assert turbogs("report", folder.path)[0] == 0 and contents(folder) == before
    assert turbogs("report", folder.path, "--psnr", "30")[0] == 0
    after = contents(folder)
    assert b"s to 30.0 dB" in after["report.md"] and after["fox-curves.png"] == before["fox-curves.png"]


@pytest.mark.usefixtures("plotted")  # the files hold a digest of what they show
def test_a_plot_of_other_data_or_a_broken_one_is_drawn_again(turbogs, folder):
    assert turbogs("report", folder.path)[0] == 0
    before = contents(folder)
    (folder.path / "h-pareto.png").write_bytes(b"not a picture")
    changed = study()
    changed.results[0].history[1].psnr += 1.0
    folder.write_study(changed)
    assert turbogs("report", folder.path)[0] == 0
    after = contents(folder)
    assert {name for name in after if after[name] != before[name] and name.endswith("png")} == {
        "fox-curves.png",
        "fox-pareto.png",
        "fox-gaussians.png",
    }


@pytest.mark.usefixtures("plotted")
def test_flip_and_the_seconds_of_a_cell_are_shown_where_a_cell_has_them(turbogs, folder):
    assert turbogs("report", folder.path)[0] == 0
    fox, h = (folder.path / "report.md").read_text().split("\n## h\n")
    assert "| load, train, evaluate in s |" in fox and "| FLIP |" in fox and "Imports and warm-up are not" in fox
    assert "| load, train, evaluate in s |" not in h and "| FLIP |" not in h and "FLIP was not computed" not in fox
    (line,) = re.findall(r"\| other \|.*dB.*|\| other \| .* 30\..*", fox)
    assert line.count("| - |") == 1 and "| not computed | not computed |" in line, "a mean over some seeds is none"
    whole = study()
    for result in whole.results[:4]:
        result.flip, result.cell_seconds = 0.125 + result.seed / 100, 7.0 + result.seed
    folder.write_study(whole)
    assert turbogs("report", folder.path)[0] == 0
    fox = (folder.path / "report.md").read_text().split("\n## h\n")[0]
    assert fox.count("| 7.5 [7.0, 8.0] |") == 2 and fox.count("| 0.1300 [0.1250, 0.1350] |") == 2
    rows = list(csv.DictReader((folder.path / "table.csv").open()))
    assert [(row["flip_mean"], row["cell_seconds_mean"]) for row in rows] == [("0.13", "7.5")] * 2 + [("", "")]
    assert "wall_seconds_mean" not in rows[0]
    for result in whole.results:
        result.flip = math.nan
    folder.write_study(whole)
    assert turbogs("report", folder.path)[0] == 0
    page = (folder.path / "report.md").read_text()
    assert "FLIP was not computed" in page and "| FLIP |" not in page


@pytest.mark.usefixtures("plotted")
def test_a_page_says_how_far_apart_the_marks_about_a_crossing_are(turbogs, folder):
    assert turbogs("report", folder.path)[0] == 0
    assert "on either side of a crossing are 2.40 [2.40, 2.40] s of" in (folder.path / "report.md").read_text()
    history = [Evaluation(n, float(s), p, 0.9, 0.1, 9, 9) for n, s, p in ((0, 0, 10), (1, 2, 20), (2, 5, 30))]
    assert [crossing_gap(history, psnr) for psnr in (15.0, 20.0, 20.5)] == [2.0, 2.0, 3.0]
    assert math.isnan(crossing_gap(history, 9.0)) and math.isnan(crossing_gap(history, 31.0))


@pytest.mark.usefixtures("plotted")
def test_a_merge_keeps_what_its_folder_has(turbogs, folder, tmp_path):
    part = StudyFolder(tmp_path / "part")
    part.write_study(Study(ABLATION, [result("base", 7)]))
    assert turbogs("ablate", "--merge", part.path, "--out", folder.path)[0] == 0
    assert [entry.seed for entry in folder.read_study().of("fox", "base")] == [0, 1, 7]
    assert not folder.cells.exists()


def test_a_study_of_one_cell_says_all_of_it():
    text = study_to_json(Study(ABLATION, [result("other", 3)]))
    document = json.loads(text)
    assert document["config"]["train.seed"] == 3 and "config" not in document["cells"][0]


def test_a_variant_that_shares_no_seed_with_the_baseline_is_not_compared():
    apart = Study(ABLATION, [result("base", 0), result("other", 1)])
    page = to_markdown("Apart", report_blocks(apart, summarise(apart)))
    assert "| other |" in page and "nan" not in page


def test_a_picture_of_a_capture_with_a_space_in_its_name_is_a_link_in_markdown():
    assert Picture("my scene (2)-curves.png", "my scene").markdown() == "![my scene](my%20scene%20%282%29-curves.png)"
