"""The studies in docs/results: their pages and plots are those that `make pages` makes of their results."""

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
NOT_IN_THE_REPOSITORY = {"report.html", "table.csv"}  # .gitignore has them: `make pages` leaves them here


def test_the_studies_are_there():
    assert {"components", "replacements", "optimizer", "views", "hard_ratio", "schedule"} <= {
        folder.name for folder in FOLDERS
    }


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


def test_the_documentation_keeps_summaries_and_no_runs():
    files = [path for path in DOCS.rglob("*") if path.is_file() and path.name not in NOT_IN_THE_REPOSITORY]
    assert max(path.stat().st_size for path in files) < 512 * 1024
    assert sum(path.stat().st_size for path in files if path.name == "results.json") < 1024 * 1024
    assert not [path for path in files if path.suffix in (".jsonl", ".ply", ".pt")]
