"""The studies in docs/results: their pages and plots are those that `make pages` makes of their results."""

import importlib.util
import json
import re
from pathlib import Path

import pytest

from turbogs_plugin.study.document import to_markdown
from turbogs_plugin.study.folder import StudyFolder
from turbogs_plugin.study.pages import report_blocks
from turbogs_plugin.study.plots import PLOTS, plot_digest, shown_digest
from turbogs_plugin.study.results_file import study_to_json
from turbogs_plugin.study.summary import summarise

DOCS = Path(__file__).parents[2] / "docs"
FOLDERS = sorted(path.parent for path in DOCS.glob("results/*/results.json"))
SPEC = importlib.util.spec_from_file_location("make_pages", DOCS / "make_pages.py")
make_pages = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(make_pages)
NOT_IN_THE_REPOSITORY = {"report.html", "table.csv"}  # .gitignore has them: `make pages` leaves them here


def test_the_studies_are_there():
    assert {"baselines", "components", "parts", "views", "hard_ratio", "schedule"} <= {path.name for path in FOLDERS}


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_a_study_in_the_documentation_is_what_its_results_say(folder):
    study = StudyFolder(folder).read_study()
    summaries = summarise(study)
    assert (folder / "results.json").read_text() == study_to_json(study)
    page = to_markdown(study.ablation.title, report_blocks(study, summaries))
    assert (folder / "report.md").read_text() == page, "the page is not that of these results: make pages"
    shown = {f"{summary.scene}-{plot.name}.png": plot_digest(summary) for summary in summaries for plot in PLOTS}
    for name, digest in shown.items():
        assert shown_digest(folder / name) == digest, f"{name} does not show these results: make pages"
    files = {path.name for path in folder.iterdir()} - NOT_IN_THE_REPOSITORY
    assert files == {"results.json", "report.md", *shown}


def test_the_tables_in_the_pages_are_those_of_the_results():
    """`make pages` would change nothing; and every table that it can make stands somewhere."""
    texts = [page.read_text() for page in make_pages.PAGES]
    assert [make_pages.filled(text) for text in texts] == texts, "make pages"
    assert shown_digest(make_pages.PICTURE) == make_pages.picture_digest(), "make pages"
    assert {name for text in texts for _, name, _ in make_pages.BLOCK.findall(text)} == set(make_pages.TABLES)


def test_a_number_changed_by_hand_is_found():
    text = make_pages.PAGES[0].read_text()
    (psnr,) = re.findall(r"\*\*turbogs\*\* \| [\d.]+ s, ([\d.]+) dB", text)
    assert make_pages.filled(text.replace(psnr, "33.99")) == text


def test_the_documentation_keeps_summaries_and_no_runs():
    files = [path for path in DOCS.rglob("*") if path.is_file() and path.name not in NOT_IN_THE_REPOSITORY]
    assert max(path.stat().st_size for path in files) < 512 * 1024
    assert sum(path.stat().st_size for path in files if path.name == "results.json") < 1024 * 1024
    assert not [path for path in files if path.suffix in (".jsonl", ".ply", ".pt")]


def trainer_run(variant: str, *marks: tuple[float, float], scene: str = "fox") -> dict:
    """A run of gsplat's trainer, with (seconds, PSNR) of each mark."""
    ends = [
        {"step": 1000 * number, "seconds": seconds, "psnr": psnr, "ssim": 0.875, "gaussians": 123_456}
        for number, (seconds, psnr) in enumerate(marks, start=1)
    ]
    return {"scene": scene, "variant": variant, "marks": ends}


def test_the_table_of_swaps_reads_both_runs_at_the_earlier_end(tmp_path):
    runs = [
        trainer_run("stock", (10, 28), (20, 30), (40, 31)),
        trainer_run("density", (8, 28), (16, 30), (30, 31)),
        trainer_run("lm", (20, 29), (60, 32)),
        trainer_run("sparse", (1, 20), (5, 30)),
        {"scene": "fox", "variant": "errors", "error": "out of memory"},
        trainer_run("density", (8, 28), scene="caliterra"),
    ]
    (tmp_path / "dropin.json").write_text(json.dumps({"device": "H200", "runs": runs}))
    lines = make_pages.dropin(tmp_path / "dropin.json").splitlines()
    cells = {tuple(line.strip("| ").split(" | ")[:2]): line.strip("| ").split(" | ")[2:] for line in lines[2:]}
    assert len(lines) == 2 + 5
    # Stock at 30 s is halfway between 30 and 31 dB.
    assert cells["fox", "density control"] == [
        *("3000", "30.0", "31.00", "0.8750", "123k"),
        "+0.50 dB: 31.00 for 30.50 at 30 s",
    ]
    assert cells["fox", "and Moment-LM"][-1] == "-0.50 dB: 30.50 for 31.00 at 40 s"
    assert cells["fox", "stock"] == ["3000", "40.0", "31.00", "0.8750", "123k"]
    assert cells["fox", "sparse pixels, 4 views"] == ["2000", "5.0", "30.00", "0.8750", "123k"]  # stock: none yet
    assert cells["caliterra", "density control"] == ["1000", "8.0", "28.00", "0.8750", "123k"]
    assert make_pages.dropin(tmp_path / "none.json") == "Not measured yet."
