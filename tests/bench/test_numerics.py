"""docs/lab/numerics.py, which measures solvers and statistics against exact results."""

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from helpers.exact_solver import solve_exactly
from helpers.statistics_errors import CASES


@pytest.fixture(scope="module")
def numerics() -> Iterator[ModuleType]:
    spec = importlib.util.spec_from_file_location("lab_numerics", Path(__file__).parents[2] / "docs/lab/numerics.py")
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, spec.name, module)  # where dataclasses look up their types
        spec.loader.exec_module(module)
        yield module


def test_the_exact_solution_solves_the_system(numerics):
    problem = numerics.make_problem(numerics.FAMILIES[2], views=3, count=50, seed=0)
    rows, damping, rhs = (value.double().numpy().astype(np.longdouble) for value in problem)
    solution = solve_exactly(*problem) / np.sqrt(damping)
    left = np.einsum("kni,knj,nj->ni", rows, rows, solution) + damping * solution
    bound = 1e-12 * np.sqrt(damping) * np.linalg.norm(rhs / np.sqrt(damping), axis=1)[:, None]
    assert (np.abs(left - rhs) <= bound).all()


def test_the_tables_of_the_page_are_made(numerics, tmp_path, monkeypatch):
    for name, value in (("SYSTEMS", 20), ("BATCH", 100), ("REPEATS", 1), ("CASES", CASES[:1])):
        monkeypatch.setattr(numerics, name, value)
    monkeypatch.setattr("helpers.statistics_errors.LOOKS", 40)
    page = tmp_path / "page.md"
    page.write_text("a\n<!-- made: solvers -->\nold\n<!-- end -->\nb\n<!-- made: density_sums -->\n<!-- end -->\nc\n")
    numerics.main(page)
    text = page.read_text()
    assert text.count("<!-- end -->") == 2 and text[0] + text[-2] == "ac" and "old" not in text and "\nb\n" in text
    assert text.count("all fail") >= 2, "raw Cholesky beside endless rows"
    assert text.count("\n| 3 |") == len(numerics.FAMILIES) + 1 and "| window of 40 looks |" in text
    assert page.with_suffix(".png").stat().st_size > 5000
