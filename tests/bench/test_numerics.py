"""The one command that measures solvers and statistics against exact results."""

import json

import numpy as np
import torch

from turbogs_plugin.bench import numerics, statistics
from turbogs_plugin.bench.numerics import FAMILIES, SOLVERS, make_problem, scaled_errors, solve_exactly
from turbogs_plugin.bench.statistics import CASES, compared
from turbogs_plugin.types import GaussianStats


def test_the_exact_solution_solves_the_system():
    problem = make_problem(FAMILIES[2], views=3, count=50, seed=0)
    rows, weights, damping, rhs = (value.double().numpy().astype(np.longdouble) for value in problem)
    solution = solve_exactly(problem) / np.sqrt(damping)
    left = np.einsum("kn,kni,knj,nj->ni", weights, rows, rows, solution) + damping * solution
    assert (
        np.abs(left - rhs) <= 1e-12 * np.sqrt(damping) * np.linalg.norm(rhs / np.sqrt(damping), axis=1)[:, None]
    ).all()


def test_an_error_is_that_of_the_scaled_unknown():
    problem = make_problem(FAMILIES[1], views=3, count=5, seed=0)
    exact = solve_exactly(problem)
    root = problem[2].double().sqrt()
    exact_solution = torch.from_numpy(exact.astype(np.float64)) / root
    step = (problem[3].double() / root).norm(dim=1)
    off = exact_solution.clone()
    off[:, 3] += 0.25 * step / root[:, 3]
    off[4] = torch.nan
    np.testing.assert_allclose(scaled_errors(off, exact, problem), [0.25] * 4 + [np.inf], rtol=1e-6)


def test_everything_is_measured_and_written(turbogs, tmp_path, monkeypatch):
    for name, value in (("SYSTEMS", 20), ("BATCH", 100), ("REPEATS", 1)):
        monkeypatch.setattr(numerics, name, value)
    monkeypatch.setattr(statistics, "LOOKS", 40)
    monkeypatch.setattr(statistics, "CASES", CASES[:2])
    code, out, _ = turbogs("bench", "numerics", "--out", tmp_path / "new", "--device", "cpu")
    record = json.loads((tmp_path / "new" / "solvers.json").read_text())
    assert code == 0 and "all fail" in out and str(tmp_path / "new") in out
    assert len(record["results"]) == 2 * len(FAMILIES) * len(SOLVERS)
    assert all(result["nanoseconds"] > 0 for result in record["results"])
    worst = {name: max(r["failed"] for r in record["results"] if r["solver"] == name) for name in SOLVERS}
    assert worst["raw Cholesky, float32"] > 0.9
    assert max(share for name, share in worst.items() if not name.startswith("raw")) == 0
    assert (tmp_path / "new" / "solvers.png").stat().st_size > 5000
    assert (tmp_path / "new" / "solvers.md").read_text().count("\n") == 2 + 2 * len(FAMILIES) + 2
    record = json.loads((tmp_path / "new" / "statistics.json").read_text())
    assert [result["case"] for result in record["results"]] == [
        *(case.name for case in CASES[:2]),
        "window of 40 looks",
    ]
    assert all(0 < error < 0.01 for result in record["results"] for error in result["errors"].values())
    assert (tmp_path / "new" / "statistics.md").read_text() in out


def test_errors_of_statistics_are_those_that_were_made():
    exact = GaussianStats.zeros(100, "cpu").map(torch.Tensor.double)
    for value in vars(exact).values():
        value[:80] = torch.arange(1.0, 81.0)  # the others have no sum, so a turnover does not take them
    given = exact.map(torch.clone)
    given.weight_sums *= 1.25
    given.square_sums[[0, 40]] = given.square_sums[[40, 0]]
    result = compared("swapped", given, exact)
    assert result.errors["weight_sums"] == 0.25 and result.errors["absgrad_sums"] == 0.0
    assert result.median_square == 0.0 and result.worst_square == 40.0
    assert result.exchanged == 0.25  # one of four
