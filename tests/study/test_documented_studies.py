"""The studies in docs/results: their pages and plots are those that `make pages` makes of their results."""

import importlib
import json
import re
import sys
from pathlib import Path

import pytest

from turbogs_plugin.bench.viewer import ViewerRun
from turbogs_plugin.report.provenance import Provenance
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
sys.path.insert(0, str(DOCS))  # the scripts import their neighbours
goal_tables, make_pages, machine_tables, paper_tables, study_tables, sweep_tables, viewer_tables = map(
    importlib.import_module,
    ("goal_tables", "make_pages", "machine_tables", "paper_tables", "study_tables", "sweep_tables", "viewer_tables"),
)
PLACE = {"machine": "NVIDIA H200 (140 GiB)", "commit": "0123456789", "software": {"torch": "2.11.0"}}
NOT_IN_THE_REPOSITORY = {"report.html", "table.csv"}  # .gitignore has them: `make pages` leaves them here


def test_the_studies_are_there():
    assert {"baselines", "components", "parts", "views", "hard_ratio", "schedule"} <= {path.name for path in FOLDERS}


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_a_study_in_the_documentation_is_what_its_results_say(folder):
    study = StudyFolder(folder).read_study()
    summaries = summarise(study)
    assert (folder / "results.json").read_text() == study_to_json(study)
    page = (folder / "report.md").read_text()
    assert page == study_tables.study_page(folder.name), "the page is not that of these results: make pages"
    line = "".join(f"{block.markdown()}\n\n" for block in study_tables.other_commit(folder.name))
    assert page.replace(line, "") == to_markdown(study.ablation.title, report_blocks(study, summaries))
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
    assert machine_tables.solvers().endswith((DOCS / "results/numerics/solvers.md").read_text().strip())
    assert machine_tables.density_sums().endswith((DOCS / "results/numerics/statistics.md").read_text().strip())


def test_every_part_of_the_paper_has_its_row():
    ours = [part.ours for part in paper_tables.PARTS if part.ours]
    papers = [part.papers for part in paper_tables.PARTS if part.papers]
    others = {"paper-literal", "ssim", "ssim-given-cameras", "ssim-no-dropout"}
    for studies, named in ((paper_tables.OURS, ours), (["paper_parts"], papers)):
        known = [set(load_ablation(study).variants) for study in studies]
        assert all(any(set(pair) <= variants for variants in known) for pair in named), "both of a pair in one study"
        assert set.union(*known) - {name for pair in named for name in pair} <= others, "have tables of their own"
    assert {part.default for part in paper_tables.PARTS} == {"the paper's", "ours", ""}


def a_study(folder: Path, name: str, results: dict[str, tuple[float, ...]], commits: tuple[str, ...] = ()) -> None:
    """Results of a packaged ablation on every capture, variant -> final PSNRs of its seeds; seed -> its commit."""
    ablation, cells = load_ablation(name), []
    for capture in study_tables.CAPTURES:
        for variant, psnrs in results.items():
            asked = variant_config(ablation, variant, 0, (), None)
            config = asked.without_plan().to_mapping()
            for seed, psnr in enumerate(psnrs):
                history = [Evaluation(0, 0.1, 9.0, 0.2, 0.4, 90, 9), Evaluation(5, 3.0, 33.0, 0.9, 0.1, 900, 9)]
                history.append(Evaluation(9, 7.0, psnr, 0.9, 0.1, 1000, 9))
                where = {"scene": capture, "variant": variant, "seed": seed}
                if commits:
                    where["provenance"] = Provenance(**PLACE | {"commit": commits[seed]}, kernels="", day="2026-11-25")
                cells.append(
                    CellResult(**where, config=config, asked=asked.to_mapping(), cell_seconds=12.0, history=history)
                )
    study = StudyFolder(folder / "docs/results" / name)
    study.path.mkdir(parents=True)
    study.write_study(Study(ablation, cells))


def test_what_is_not_measured_yet_says_so_until_it_is(tmp_path, monkeypatch):
    monkeypatch.setattr(study_tables, "ROOT", tmp_path)
    pairs = [pair for part in paper_tables.PARTS for pair in (part.ours, part.papers) if pair]
    assert paper_tables.paper_parts().count("not measured yet") == len(pairs)
    assert paper_tables.paper_whole().count("not measured yet") == 6 * 3
    a_study(tmp_path, "parts", {"turbogs": (31.0, 31.1), "geometry-views": (31.0, 31.1)})
    a_study(tmp_path, "departures", {"turbogs": (31.0, 31.1), "no-ncc": (31.5, 31.6)})
    a_study(tmp_path, "paper", {"turbogs-paper": (30.0, 30.1), "paper-literal": (8.0,)})
    a_study(tmp_path, "paper_parts", {"turbogs-paper": (30.0, 30.1), "random-views": (30.5,)})
    a_study(tmp_path, "baselines", {"3dgs": (30.3,)})
    lines = {line.split(" | ")[0]: line for line in paper_tables.paper_parts().splitlines()}
    (views,) = (line for line in lines.values() if "geometry-aware" in line)
    assert "fox: +0.00 ± 0.00 dB" in views and "as good<br>in the paper's: one seed" in views
    assert views.endswith("| ours; **should be the paper's** |") and "fox: -0.50 dB" in views
    everywhere = ", ".join(f"PSNR on {capture}" for capture in study_tables.CAPTURES)
    (ncc,) = (line for name, line in lines.items() if name.startswith("| NCC ("))
    assert ncc.endswith(
        f"| worse: {everywhere}<br>in the paper's: not measured yet | the paper's; **should be ours** |"
    )
    whole = paper_tables.paper_whole()
    assert whole.count("7.0 s, 30.30 dB, .900, 1k; best on the way 33.00 dB (1)") == 3 and whole.count("8.00 dB") == 3
    assert whole.count("-0.25 ± 0.05 dB, undecided") == 3 and whole.count("-2.95 ± 0.05 dB, beyond the bound") == 3
    row = study_tables.rows_of("paper")["fox"]["turbogs-paper"]
    assert paper_tables.within_bound(row, row, end=True) == "+0.00 ± 0.05 dB, within the bound"


def test_a_place_says_what_is_known():
    host = "NVIDIA H200 (140 GiB), Intel(R) Xeon(R) Processor, 32 cores"
    assert machine_tables.place(host, "0123456789", "2026-11-25") == "NVIDIA H200, 32 cores, commit 0123456, 2026-11-25"
    assert machine_tables.where({"provenance": PLACE}) == "NVIDIA H200, commit 0123456, torch 2.11.0"


def test_the_headline_has_the_wall_beside_the_training():
    assert (
        study_tables.result(4.12, 32.2, 0.893, 209e3, study_tables.duration(9.54))
        == "4.1 / 9.5 s, 32.20 dB, .893, 209k"
    )
    assert study_tables.result(74.0, 30.9, None, None, study_tables.duration(float("nan"))) == "74 / - s, 30.90 dB"


def test_the_headline_says_how_many_seeds_and_where_and_when_ours_had_the_others_psnr(tmp_path, monkeypatch):
    monkeypatch.setattr(study_tables, "ROOT", tmp_path)
    monkeypatch.setattr(machine_tables, "WALL", tmp_path / "wall.json")
    a_study(tmp_path, "sizes", {"turbogs": (31.0, 32.0)})
    a_study(tmp_path, "baselines", {"3dgs": (30.3,)})
    (tmp_path / "wall.json").write_text(
        json.dumps({"turbogs": {"fox": {"provenance": PLACE, "median": {"seconds": 12.3}}}})
    )
    rows = [
        {"method": "Slow", "capture": "fox", "seconds": 50, "psnr": 21.0, "ssim": 0.9, "gaussians": 500},
        {"method": "Slow", "capture": "caliterra", "seconds": 50, "psnr": 33.0, "ssim": None, "gaussians": None},
        {"method": "Best", "capture": "fox", "seconds": 60, "psnr": 34.0, "ssim": 0.9, "gaussians": 4000},
    ]
    peers = {"measured": "another day", "beyond_training": {}, "rows": rows}
    (tmp_path / "docs/results/peers.json").write_text(json.dumps(peers))
    lines = {line.split(" | ")[0].strip("| "): line for line in study_tables.headline().splitlines()}
    ours = "31.50 [31.00, 32.00] dB, .900, 1k (2)"
    assert f"| 7.0 / 12 s, {ours} | 7.0 / - s, {ours} |" in lines["**turbogs**"]
    assert "30.30 dB, .900, 1k |" in next(line for name, line in lines.items() if "gsplat's strategy" in name)
    ahead = {line.split(" | ")[0].strip("| "): line for line in study_tables.ahead().splitlines()}
    # 9 dB at .1 s and 33 at 3 s: 21 dB at 1.55 s.
    assert ahead["Slow"].startswith("| Slow | 1.6 s, 32 times sooner, x 2.0 N | 3.0 s, 17 times sooner |")
    assert ahead["Best"].startswith("| Best | reached by 0 of 2 seeds, x 0.2 N |")
    monkeypatch.setattr(study_tables, "CAPS", {"turbogs": "fox"})
    assert study_tables.at_their_size().splitlines()[2:] == []  # 1000 of ours are not 500 or 4000
    rows[0]["gaussians"] = 1010
    (tmp_path / "docs/results/peers.json").write_text(json.dumps(peers))
    same = "| Slow | 1k: +10.50 dB, +0.0000, 7.1 times sooner (2) |  |  |"
    assert study_tables.at_their_size().splitlines()[2:] == [same]
    rows[0]["gaussians"] = 500
    (tmp_path / "docs/results/peers.json").write_text(json.dumps(peers))
    # Ours: 31.50 dB, .900, 1000.
    assert study_tables.behind().splitlines()[2:] == [
        "| Slow, fox | .900, .900 SSIM | 0.50 |",
        "| Slow, caliterra | 33.00, 31.50 dB |  |",
        "| Best, fox | 34.00, 31.50 dB | 4.00 |",
    ]
    sources = study_tables.headline_sources()
    assert "| **turbogs** | not recorded |" in sources and "| the others | another day |" in sources
    assert "| whole command of **turbogs** | NVIDIA H200, commit 0123456, torch 2.11.0 |" in sources


def test_what_is_of_another_commit_than_ours_is_stale(tmp_path, monkeypatch):
    monkeypatch.setattr(study_tables, "ROOT", tmp_path)
    monkeypatch.setattr(machine_tables, "WALL", tmp_path / "wall.json")
    a_study(tmp_path, "baselines", {"3dgs": (30.3,)}, ("aaaaaaa",))
    (tmp_path / "docs/results/peers.json").write_text(json.dumps({"measured": "another day"}))
    walls = ({"provenance": PLACE | {"commit": commit}} for commit in ("aaaaaaabbb", "0123456789ab"))
    by_capture = dict(zip(study_tables.CAPTURES, walls, strict=False))
    (tmp_path / "wall.json").write_text(json.dumps({"turbogs": by_capture}))
    # Without a commit of ours there is none to compare with.
    assert "stale" not in study_tables.headline_sources() and study_tables.other_commit("baselines") == []
    a_study(tmp_path, "sizes", {"turbogs": (31.0,) * 3, "ssim": (31.0,)}, ("0123456789", "0123456-modified", "0123456"))
    a_study(tmp_path, "parts", {"turbogs": (31.0, 31.1)}, ("0123456aaa", ""))
    a_study(tmp_path, "departures", {"turbogs": (31.0,)}, ("aaaaaaa",))
    study_tables.read_study.cache_clear()
    lines = dict(line.strip("| ").split(" | ") for line in study_tables.headline_sources().splitlines() if "|" in line)
    ours = "NVIDIA H200, commit 0123456, 2026-11-25"
    assert lines["turbogs-ssim"] == ours
    assert lines["**turbogs**"] == f"{ours}; NVIDIA H200, commit 0123456-modified, 2026-11-25 (stale)"
    (full,) = (where for name, where in lines.items() if name.startswith("3DGS"))
    assert full == "NVIDIA H200, commit aaaaaaa, 2026-11-25 (stale)"
    wall = "NVIDIA H200, commit aaaaaaa, torch 2.11.0 (stale); NVIDIA H200, commit 0123456, torch 2.11.0"
    assert lines["whole command of **turbogs**"] == wall and lines["the others"] == "another day"
    line = "Stale: 3 of 3 cells of `baselines` were measured at commit aaaaaaa; README's `turbogs` at 0123456."
    assert study_tables.stale("baselines") == [*study_tables.other_settings("baselines"), line]
    assert study_tables.stale("parts") == study_tables.other_settings("parts")
    assert study_tables.changes("baselines").endswith(f"\n\n{line}")
    (told,) = (found for found in paper_tables.paper_parts().split("\n\n") if "measured at" in found)
    assert told.startswith("Stale: 3 of 3 cells of `departures` were measured at commit aaaaaaa; ")
    head = study_tables.study_page("baselines").partition("\n## ")[0]
    assert head.endswith(f"\n\n{line}\n")
    assert "were measured at" not in study_tables.study_page("parts") and study_tables.mark("") == ""
    part = "Stale: 3 of 12 cells of `sizes` were measured at commit 0123456-modified; README's"
    assert part in study_tables.study_page("sizes")


NUMBER = re.compile(r"\d\.\d+ dB\b|\d (?:ms|us)\b|(?<![\d.])0?\.\d{4}\b")
"""A number that only a run can give: decibels, milliseconds, SSIM."""

MARKS = ("<!-- made: ", "measured once, by hand")

RULES = {
    "docs/scaling.md": "predictions, which tests/distributed/test_predictions.py compares with their model",
    "docs/paper.md## What each part is worth": "what counts as a difference",
    "docs/paper.md## The whole of it": "the bound",
}
"""Pages and sections whose numbers are no measurements, and what they are."""


def unmarked(page: Path, name: str) -> list[str]:
    """Sections of a page with a number of a run, without a table made of results and without saying how it was
    measured; what the page's head says holds for all of it, and its last section may sum up its tables."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    head, *sections = re.split(r"^(?=##+ )", text, flags=re.MULTILINE)
    if "measured once, by hand" in " ".join(head.lower().split()) or name in RULES:
        return []
    if MARKS[0] in text and sections and sections[-1].startswith("## What they say\n"):
        sections.pop()
    found = []
    for section in (head, *sections):
        title = section.partition("\n")[0]
        if NUMBER.search(section) and not any(mark in " ".join(section.lower().split()) for mark in MARKS):
            found += [] if name + title in RULES else [f"{name}: {title}: {NUMBER.search(section)[0]}"]
    return found


def test_a_number_of_a_run_is_made_of_results_or_says_how_it_was_measured():
    pages = [DOCS.parent / "README.md", *(path for path in DOCS.rglob("*.md") if path.name != "report.md")]
    assert len(pages) > 20
    assert [line for page in pages for line in unmarked(page, str(page.relative_to(DOCS.parent)))] == []


def test_a_number_without_a_mark_is_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "# Page\n\nIt has 31.20 dB.\n\n## Times\n\nMeasured once,\nby hand: 2 ms.\n\n## More\n\nSSIM .8912\n"
    )
    assert unmarked(page, "page.md") == ["page.md: # Page: 1.20 dB", "page.md: ## More: .8912"]
    page.write_text("# Page\n\nAll was measured once, by hand.\n\n## More\n\n3 ms\n")
    assert unmarked(page, "page.md") == []


def test_what_a_viewer_costs_is_a_row_for_each_capture(tmp_path):
    assert viewer_tables.viewer(tmp_path) == "Not measured yet."
    seconds = {"without": 1.0, "nobody looks": 1.0, "client": 1.25}
    runs = [ViewerRun(way, 500, value, gaussians=209_400) for way, value in seconds.items()]
    runs[2].frame_rate, runs[2].width = 24.04, 640
    text = json.dumps({"scene": "fox", "provenance": PLACE, "runs": [vars(run) for run in runs]})
    (tmp_path / "viewer-fox.json").write_text(text)
    lines = viewer_tables.viewer(tmp_path).splitlines()
    assert lines[0] == "NVIDIA H200, commit 0123456, torch 2.11.0."
    assert lines[-1] == "| fox | 500 | 209k | 500 | +0.0 % [+0.0, +0.0] | -20.0 % [-20.0, -20.0] | 24.0 | 640 |"


def test_exports_are_a_row_for_each_format(tmp_path):
    change = {"before": 33.853, "after": 33.752, "worst_loss": 0.25}
    whole = {"bytes": 31_900_000, "gaussians": 200_000, "seconds": 3.21, "change": change}
    won = {"before": 33.853, "after": 33.8531, "worst_loss": 0.0}
    exports = {"splat": whole | {"gaussians": 325_000}, "html": whole | {"change": won}}
    film = {"path": "orbit", "frames": 600, "bytes": 9_950_000, "seconds": 8.04}
    record = {"scene": "caliterra", "gaussians": 325_000, "held_bytes": 76_700_000, "film": film, "provenance": PLACE}
    assert viewer_tables.exports(tmp_path / "exports.json") == "Not measured yet."
    (tmp_path / "exports.json").write_text(json.dumps(record | {"exports": exports}))
    made = viewer_tables.exports(tmp_path / "exports.json")
    assert made.splitlines()[-2:] == [
        "| splat | 31.9 | all | 33.85 | 0.101 | 0.250 | 3.2 |",
        "| html | 31.9 | 200,000 | 33.85 | 0.000 | 0.000 | 3.2 |",
    ]
    assert "325,000 Gaussians, 76.7 MB" in made and "600 frames, took 8.0 s and has 9.9 MB" in " ".join(made.split())


def test_captions_are_of_the_pictures_record(tmp_path, monkeypatch):
    """Without one they stay as they are."""
    file = tmp_path / "pictures.json"
    assert viewer_tables.render_caption(file) is None and viewer_tables.overlays_caption(file) is None
    early = {"iteration": 2503, "part": [400, 300], "share": 0.217}
    record = {"provenance": PLACE, "scene": "caliterra", "factor": 1, "view": 44, "training_views": 66, "psnr": 33.853}
    record |= {"iteration": 5000, "gaussians": 325_123, "train_seconds": 5.94}
    file.write_text(json.dumps(record))
    assert viewer_tables.overlays_caption(file) is None
    file.write_text(json.dumps(record | {"early": early}))
    caption, overlays = (
        " ".join(made(file).split()) for made in (viewer_tables.render_caption, viewer_tables.overlays_caption)
    )
    assert "caliterra, a capture by a drone (CC0), from" in caption and "325,123 Gaussians, 5000 iterations" in caption
    assert "5.9 s of training on one NVIDIA H200; 33.85 dB" in caption and "--factor" not in caption
    assert (
        overlays.startswith("*The 400x300 pixels") and "after 2503 iterations" in overlays and "the 22 % of" in overlays
    )
    text = "<!-- made: render caption -->\n\nas it was\n\n<!-- end -->\n"
    monkeypatch.setitem(make_pages.TABLES, "render caption", lambda: None)
    assert make_pages.filled(text) == text


def test_a_goal_says_what_is_missing_of_it():
    row = study_tables.rows_of("sizes")["fox"]["turbogs"]
    mean = row.psnr.mean
    least, measured, missing = goal_tables.error("psnr", mean + 0.25, row, 2, " dB")
    assert (least, missing) == (f"{mean + 0.25:.2f} dB", ".25 dB")
    assert measured.startswith(f"{mean:.2f} ± .") and measured.endswith(" dB")
    assert goal_tables.error("psnr", mean - 0.25, row, 2, " dB")[2] == ""
    assert goal_tables.most(4.0, 5.5, "{:.1f} s".format) == ("4.0 s", "5.5 s", "1.5 s")
    assert goal_tables.most(4.0, 3.5, "{:.1f} s".format) == ("4.0 s", "3.5 s", "")
    litegs, fastgs = (
        goal for goal in goal_tables.all_goals() if (goal.capture, goal.variant) == ("caliterra", "cap-157k")
    )
    assert litegs[3:6] == pytest.approx((33.43, 0.92, 4.25)) and fastgs[3:6] == pytest.approx((33.12, 0.921, 4.55))
    gained = sweep_tables.difference_of("thirtieth", "small_94k", "34 epochs", "fox", "psnr")
    assert gained.count == 10 and gained.mean == pytest.approx(0.03, abs=0.005)


def test_a_number_changed_by_hand_is_found():
    text = make_pages.PAGES[0].read_text()
    row = r"\*\*turbogs\*\* \| [\d.]+ / [\d.°-]+ s, ([\d.]+) \[([\d.]+), ([\d.]+)\] dB"
    (found,) = re.finditer(row, text)
    for place in map(found.span, (1, 2, 3)):  # the mean, the lowest, the highest
        changed = f"{text[: place[0]]}33.99{text[place[1] :]}"
        assert changed != text and make_pages.filled(changed) == text


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
    (tmp_path / "dropin.json").write_text(json.dumps({"device": "H200", "date": "2026-11-22", "runs": runs}))
    first, _, *lines = machine_tables.dropin(tmp_path).splitlines()
    assert first == "H200, 2026-11-22:"
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
    assert machine_tables.dropin(tmp_path / "none") == "Not measured yet."


def test_runs_of_another_day_are_compared_with_its_own_stock(tmp_path):
    for day, psnr in ((1, 30), (2, 28)):
        runs = [trainer_run("stock", (10, psnr)), trainer_run("sparse", (10, 31))]
        record = {"device": "H200", "date": f"2026-11-0{day}", "runs": runs}
        (tmp_path / f"dropin-{day}.json").write_text(json.dumps(record))
    page = machine_tables.dropin(tmp_path)
    assert page.index("2026-11-01:") < page.index("+1.00 dB") < page.index("2026-11-02:") < page.index("+3.00 dB")


def test_a_variant_whose_ablation_has_other_settings_today_is_stale(tmp_path, monkeypatch):
    monkeypatch.setattr(study_tables, "ROOT", tmp_path)
    a_study(tmp_path, "sizes", {"turbogs": (31.0,), "ssim": (31.0,)}, ("0123456",))
    study_tables.read_study.cache_clear()
    today = load_ablation("sizes")
    monkeypatch.setattr(study_tables, "load_ablation", lambda name: today)
    assert study_tables.other_variant("sizes", "ssim", "turbogs-ssim") == []
    for overrides in today.variants.values():
        overrides.append("loss.epsilon=0.5")
    (line,) = study_tables.other_variant("sizes", "ssim", "turbogs-ssim")
    assert line == "Stale: turbogs-ssim has other settings now. Then: loss.epsilon 0.001 (now 0.5)."
    assert study_tables.other_variant("sizes", "cap-67k", "not measured") == []
    assert study_tables.other_variant("sizes", "turbogs", "the baseline, of which `other_settings` tells") == []


@pytest.mark.parametrize("page", sorted([*DOCS.parent.glob("*.md"), *DOCS.rglob("*.md")]), ids=lambda page: page.name)
def test_links_of_pages_lead_to_what_is_there(page):
    named = re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text())
    assert not [name for name in named if "://" not in name and not (page.parent / name).exists()]
