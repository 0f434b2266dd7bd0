"""docs/sweep_tables.py: the tables of a round of sweeps are made of its cells, and every cell stands in one."""

import importlib
import json
import sys
from pathlib import Path

import pytest
import yaml

from turbogs_plugin.errors import InputError
from turbogs_plugin.study.folder import StudyFolder
from turbogs_plugin.study.grid import load_ablation
from turbogs_plugin.study.results import CellResult, Study
from turbogs_plugin.train.history import Evaluation

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))
sweep_tables = importlib.import_module("sweep_tables")


def a_cell(variant: str, scene: str, seed: int, psnr: float, **more) -> dict:
    """A cell of the study "s" that ends at this PSNR, at an SSIM of .9 and 94,400 Gaussians."""
    end = {"psnr": [9.0, psnr], "ssim": [0.2, 0.9], "num_gaussians": [9, 94_400]}
    return {"study": "s", "variant": variant, "scene": scene, "seed": seed, "overrides": []} | end | more


def a_round(folder: Path, cells: list[dict], **layout) -> Path:
    (folder / "new.json").write_text(json.dumps(cells))
    captures = {"fox": "fox, 94k", "caliterra": "caliterra"}
    (folder / "new.yaml").write_text(
        yaml.safe_dump({"tables": {"all": {"captures": captures} | layout}}, sort_keys=False)
    )
    return folder


CELLS = [
    a_cell("base", "fox", 0, 31.0, train_seconds=[0.1, 5.0]),
    a_cell("base", "fox", 1, 32.0, train_seconds=[0.1, 6.0]),
    a_cell("other", "fox", 1, 32.5, ssim=[0.1, 0.912]),
    a_cell("other", "fox", 2, 40.0),
    a_cell("other", "caliterra", 0, 33.0, extra={"train_psnr": 39.0}),
]


def test_a_row_is_compared_over_the_seeds_that_both_have(tmp_path):
    layout = {"rows": {"the base": ["s base"], "another": ["s other"]}, "against": "the base"}
    a_round(tmp_path, CELLS, **layout, extra={"train_psnr": "training views"})
    head, _, base, other = sweep_tables.tables_of("new", tmp_path)["all"].splitlines()
    assert head == "|  | fox, 94k | caliterra |" and sweep_tables.names(tmp_path) == ["new all"]
    assert base == "| the base | 5.5 s, 31.50 [31.00, 32.00] dB, .9000, 94k (2) |  |"
    assert other == (
        "| another | 36.25 [32.50, 40.00] dB, .9060, 94k; +0.50 dB, +0.0120 (2) | "
        "33.00 dB, .9000, 94k, training views 39.00 dB (1) |"
    )


def test_a_difference_over_seeds_has_its_standard_error(tmp_path):
    cells = [
        a_cell(name, "fox", seed, 30.0 + gain * (seed + 1))
        for name, gain in (("base", 0), ("other", 0.1))
        for seed in (0, 1)
    ]
    a_round(tmp_path, cells, rows={"a": ["s base"], "b": ["s other"]}, against="a")
    assert "; +0.15 ± 0.05 dB, +0.0000 ± 0.0000 (2) |" in sweep_tables.tables_of("new", tmp_path)["all"]


def test_the_others_numbers_are_quoted(tmp_path):
    method = "FastGS 44e02a5, 30,000 iterations"
    a_round(tmp_path, CELLS, rows={"all": ["s base"], "more": ["s other"]}, quoted={"FastGS": {"fox": method}})
    assert "| FastGS | 31.63 dB, .888, 67k |  |" in sweep_tables.tables_of("new", tmp_path)["all"]


@pytest.mark.parametrize(
    ("cells", "layout", "said"),
    [
        (CELLS, {"rows": {"a": ["s base"]}}, "cells in no table: s other; give them a row"),
        (CELLS[:2], {"rows": {"a": ["s base", "s bases"]}}, "'a': no cell is called 's bases', did you mean 's base'?"),
        (CELLS[:1] * 2, {"rows": {"a": ["s base"]}}, "seed 0 of fox is there twice"),
        (CELLS[:1], {"rows": {"a": ["s base"]}, "against": "b"}, "no row is called 'b'"),
        ([CELLS[0] | {"psnrs": []}], {"rows": {"a": ["s base"]}}, "psnrs"),
    ],
)
def test_a_round_whose_rows_and_cells_disagree_is_refused(tmp_path, cells, layout, said):
    with pytest.raises(InputError) as error:
        sweep_tables.tables_of("new", a_round(tmp_path, cells, **layout))
    assert said in str(error.value)


def test_cells_are_gathered_from_studies(tmp_path):
    ablation = load_ablation("sizes")
    history = [Evaluation(0, 0.123, 9.0, 0.2, 0.4, 90, 9), Evaluation(9, 7.0, 31.23456, 0.9123456, 0.1, 1000, 9)]
    cells = [CellResult(scene="fox", variant="cap-57k", seed=3, config={}, asked={}, cell_seconds=9.0, history=history)]
    study = StudyFolder(tmp_path / "study")
    study.path.mkdir()
    study.write_study(Study(ablation, cells))
    file = sweep_tables.gather("new", {"a": study.path / "results.json"}, tmp_path)
    (cell,) = sweep_tables.read_cells(file)
    assert (cell.name, cell.scene, cell.seed) == ("a cap-57k", "fox", 3)
    assert cell.overrides == ablation.variants["cap-57k"] != []
    assert (cell.psnr, cell.ssim, cell.num_gaussians) == ([9.0, 31.235], [0.2, 0.91235], [90, 1000])
    assert cell.train_seconds == [0.12, 7.0]


def test_every_round_has_its_page_and_its_cells():
    names = sweep_tables.rounds()
    assert {"first", "second", "third", "fourth", "tenth"} <= set(names)
    files = {path.name for path in sweep_tables.FOLDER.iterdir()}
    assert files == {f"{name}.{ending}" for name in names for ending in ("json", "yaml", "md")}
