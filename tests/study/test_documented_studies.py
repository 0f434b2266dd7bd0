"""The studies in docs/results: their pages and plots are those that `make pages` makes of their results."""

import importlib.util
import json
import re
import sys
from pathlib import Path

import pytest

from turbogs_plugin.bench.viewer import ViewerRun
from turbogs_plugin.study.document import to_markdown
from turbogs_plugin.study.folder import StudyFolder
from turbogs_plugin.study.grid import load_ablation, variant_config
from turbogs_plugin.study.pages import report_blocks
from turbogs_plugin.study.plots import PLOTS, plot_digest, shown_digest
from turbogs_plugin.study.results import CellResult, Study
from turbogs_plugin.study.results_file import study_to_json
from turbogs_plugin.study.summary import summarise
from turbogs_plugin.train.history import Evaluation

DOCS = Path(__file__).parents[2] / "docs"
FOLDERS = sorted(path.parent for path in DOCS.glob("results/*/results.json"))
sys.path.insert(0, str(DOCS))  # make_pages.py imports its neighbour
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


def test_every_part_of_the_paper_has_its_row():
    pairs = {"parts": [part.ours for part in make_pages.PARTS]}
    pairs["paper_parts"] = [part.papers for part in make_pages.PARTS if part.papers]
    for study, named in pairs.items():
        variants = {variant for pair in named for variant in pair}
        known = set(load_ablation(study).variants)
        assert known - variants <= {"paper-literal"} and variants <= known, "paper-literal has its own table"
    assert {part.default for part in make_pages.PARTS} == {"the paper's", "ours", ""}


def a_study(folder: Path, name: str, results: dict[str, tuple[float, ...]]) -> None:
    """Results of a packaged ablation on every capture, variant -> final PSNRs of its seeds."""
    ablation, cells = load_ablation(name), []
    for capture in make_pages.CAPTURES:
        for variant, psnrs in results.items():
            config = variant_config(ablation, variant, 0, (), None).without_plan().to_mapping()
            for seed, psnr in enumerate(psnrs):
                history = [Evaluation(0, 0.1, 9.0, 0.2, 0.4, 90, 9), Evaluation(5, 3.0, 33.0, 0.9, 0.1, 900, 9)]
                history.append(Evaluation(9, 7.0, psnr, 0.9, 0.1, 1000, 9))
                where = {"scene": capture, "variant": variant, "seed": seed}
                cells.append(CellResult(**where, config=config, asked=config, cell_seconds=12.0, history=history))
    study = StudyFolder(folder / "docs/results" / name)
    study.path.mkdir(parents=True)
    study.write_study(Study(ablation, cells))


def test_what_is_not_measured_yet_says_so_until_it_is(tmp_path, monkeypatch):
    monkeypatch.setattr(make_pages, "ROOT", tmp_path)
    assert make_pages.paper_parts().count("not measured yet") == len(make_pages.PARTS) + sum(
        part.papers is not None for part in make_pages.PARTS
    )
    assert make_pages.paper_whole().count("not measured yet") == 6 * 3
    a_study(tmp_path, "parts", {"turbogs": (31.0, 31.1), "geometry-views": (31.0, 31.1), "no-ncc": (31.5, 31.6)})
    a_study(tmp_path, "paper_parts", {"turbogs-paper": (30.0, 30.1), "random-views": (30.5,), "paper-literal": (8.0,)})
    a_study(tmp_path, "baselines", {"3dgs": (30.3,)})
    lines = {line.split(" | ")[0]: line for line in make_pages.paper_parts().splitlines()}
    (views,) = (line for line in lines.values() if "geometry-aware" in line)
    assert "fox: +0.00 ± 0.00 dB" in views and "as good<br>in the paper's: one seed" in views
    assert views.endswith("| ours; **should be the paper's** |") and "fox: -0.50 dB" in views
    everywhere = ", ".join(f"PSNR on {capture}" for capture in make_pages.CAPTURES)
    (ncc,) = (line for name, line in lines.items() if name.startswith("| NCC ("))
    assert ncc.endswith(
        f"| worse: {everywhere}<br>in the paper's: not measured yet | the paper's; **should be ours** |"
    )
    whole = make_pages.paper_whole()
    assert whole.count("7.0 s, 30.30 dB, .900, 1k; best on the way 33.00 dB (1)") == 3 and whole.count("8.00 dB") == 3
    assert whole.count("-0.25 dB, within the bound") == 3 and whole.count("-2.95 dB, beyond the bound") == 3


def test_the_headline_has_the_wall_beside_the_training():
    assert make_pages.result(4.12, 32.2, 0.893, 209e3, make_pages.duration(9.54)) == "4.1 / 9.5 s, 32.20 dB, .893, 209k"
    assert make_pages.result(74.0, 30.9, None, None, make_pages.duration(float("nan"))) == "74 / - s, 30.90 dB"


def test_what_a_viewer_costs_is_a_row_for_each_capture(tmp_path):
    assert make_pages.machine_tables.viewer(tmp_path) == "Not measured yet."
    seconds = {"without": 1.0, "nobody looks": 1.0, "client": 1.25}
    runs = [ViewerRun(way, 500, value, gaussians=209_400) for way, value in seconds.items()]
    runs[2].frame_rate, runs[2].width = 24.04, 640
    text = json.dumps({"scene": "fox", "runs": [vars(run) for run in runs]})
    (tmp_path / "viewer-fox.json").write_text(text)
    row = make_pages.machine_tables.viewer(tmp_path).splitlines()[-1]
    assert row == "| fox | 209k | 500 | +0.0 % [+0.0, +0.0] | -20.0 % [-20.0, -20.0] | 24.0 | 640 |"


def test_a_number_changed_by_hand_is_found():
    text = make_pages.PAGES[0].read_text()
    (psnr,) = re.findall(r"\*\*turbogs\*\* \| [\d.]+ / [\d.-]+ s, ([\d.]+) dB", text)
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
    lines = make_pages.machine_tables.dropin(tmp_path / "dropin.json").splitlines()
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
    assert make_pages.machine_tables.dropin(tmp_path / "none.json") == "Not measured yet."
