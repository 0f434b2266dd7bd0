"""The one command that compares the solvers of moment-damped LM."""

import json

import numpy as np
import torch

from turbogs_plugin.bench import numerics
from turbogs_plugin.bench.numerics import FAMILIES, SOLVERS, make_problem, scaled_errors, solve_exactly


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
