"""Errors on stiff and extreme cases against exact results: python docs/lab/numerics.py [PAGE]

Measures the solvers of moment-damped LM and density control's statistics on this CPU, within minutes, and writes their
tables into PAGE, docs/lab/numerics.md where absent, between ``<!-- made: solvers -->`` or ``<!-- made: density_sums
-->`` and ``<!-- end -->``; and the plot of error against time, numerics.png beside the page.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))  # the cases are those that the tests hold

from helpers.exact_solver import solve_exactly  # noqa: E402
from helpers.statistics_errors import CASES, SUMS, StatisticsErrors, measure_case, measure_window  # noqa: E402

from turbogs_plugin.bench.timing import measure  # noqa: E402
from turbogs_plugin.engine.reference import lm_solvers  # noqa: E402
from turbogs_plugin.report.provenance import hardware  # noqa: E402
from turbogs_plugin.report.tables import table  # noqa: E402

CPU = torch.device("cpu")
Problem = tuple[Tensor, Tensor, Tensor]
"""rows [K, n, D], damping [n, D], rhs [n, D], as the solvers take them."""


def solve_raw_cholesky(rows: Tensor, damping: Tensor, rhs: Tensor) -> Tensor:
    """Cholesky of the system as printed in the paper, unscaled; NaN if a pivot fails or products overflow."""
    matrix = torch.einsum("kni,knj->nij", rows, rows) + torch.diag_embed(damping)
    factor, failed = torch.linalg.cholesky_ex(matrix)
    solution = torch.cholesky_solve(rhs.unsqueeze(-1), factor).squeeze(-1)
    return torch.where((failed == 0).unsqueeze(-1), solution, torch.nan)


SOLVERS: dict[str, Callable[[Tensor, Tensor, Tensor], Tensor]] = {
    "raw Cholesky, float32": solve_raw_cholesky,
    "scaled Cholesky, float32": lm_solvers.solve_scaled_cholesky,
    "low rank, float32": lm_solvers.solve_low_rank,
    "scaled Cholesky, float64": lambda *system: lm_solvers.solve_scaled_cholesky(*(part.double() for part in system)),
}
COLORS = ("#b3261e", "#1f5fa8", "#2e7d32", "#6d6d6d")

VIEWS = (3, 10)
"""Numbers of rows K that are measured."""

SIZE = 10
"""Size D of the systems: that of the geometry block, the larger of the two."""

SYSTEMS, BATCH, REPEATS = 2000, 100_000, 5
"""Systems of a family whose error is measured; systems solved at once, and how often, to measure the time."""

FAILED_ERROR = 1.0  # a solution of a larger error is worth less than no step at all, as one that is not finite


@dataclass(frozen=True)
class Stiffness:
    """A family of systems.

    Args:
        name: for tables.
        length: of the scaled rows g_k / sqrt(d): 1 + K length^2 is the condition number after scaling.
        decades: range of the damping within a block: the condition number before scaling.
        size: of damping and right side; rows have its root.
        parallel: whether the rows of a system are one row, K times.
    """

    name: str
    length: float
    decades: float
    size: float = 1.0
    parallel: bool = False


FAMILIES = (
    Stiffness("mild: rows 1, damping over 1 decade", 1.0, 1.0),
    Stiffness("rows 30, 16 decades", 30.0, 16.0),
    Stiffness("rows 30, 30 decades", 30.0, 30.0),
    Stiffness("rows 90, parallel, 16 decades", 90.0, 16.0, parallel=True),
    Stiffness("rows 1e4, 16 decades", 1e4, 16.0),
    Stiffness("rows 1e6, parallel, 16 decades", 1e6, 16.0, parallel=True),
    Stiffness("rows 5, 4 decades, gradients of 1e-25", 5.0, 4.0, size=1e-25),
    Stiffness("rows 5, 4 decades, gradients of 1e25", 5.0, 4.0, size=1e25),
)


def make_problem(family: Stiffness, views: int, count: int, seed: int) -> Problem:
    """Random systems of a family, float32."""
    generator = torch.Generator().manual_seed(seed)
    normal = partial(torch.randn, generator=generator, dtype=torch.float64)
    exponents = torch.rand(count, SIZE, generator=generator, dtype=torch.float64) - 0.5
    damping = 10 ** (family.decades * exponents)
    directions = normal(1, count, SIZE).expand(views, -1, -1) if family.parallel else normal(views, count, SIZE)
    rows = family.length * directions / directions.norm(dim=-1, keepdim=True) * damping.sqrt()
    rhs = normal(count, SIZE) * damping.sqrt()
    return (rows * family.size**0.5).float(), (damping * family.size).float(), (rhs * family.size).float()


def scaled_errors(solution: Tensor, exact: np.ndarray, problem: Problem) -> np.ndarray:
    """[n] distance of each solution from the exact one, over the length of the step without rows; inf where the
    solution is not finite."""
    root = problem[1].double().numpy() ** 0.5
    with np.errstate(invalid="ignore"):
        distance = np.linalg.norm(solution.double().numpy() * root - exact.astype(np.float64), axis=-1)
    step = np.linalg.norm(problem[2].double().numpy() / root, axis=-1)
    return np.where(np.isfinite(distance), distance / step, np.inf)


@dataclass(frozen=True)
class SolverErrors:
    """One solver on one family with K = `views` rows.

    Args:
        largest: largest error (`scaled_errors`) of the systems that did not fail; 0 where all failed.
        failed: share of the systems with an error beyond `FAILED_ERROR`.
    """

    solver: str
    family: str
    views: int
    largest: float
    failed: float

    def text(self) -> str:
        if self.failed == 1:
            return "all fail"
        share = "< 0.1" if self.failed < 5e-4 else f"{100 * self.failed:.1f}"
        return f"{self.largest:.0e}" + (f" ({share} % fail)" if self.failed else "")


Times = dict[tuple[str, int], float]
"""(solver, K) -> nanoseconds a system. The solvers have no branches: they take as long on every family."""


def measure_solvers() -> tuple[list[SolverErrors], Times]:
    """Errors of all solvers on all families, and their times."""
    results, times = [], {}
    for views in VIEWS:
        many = make_problem(FAMILIES[0], views, BATCH, seed=0)
        for name, solve in SOLVERS.items():
            times[name, views] = 1e6 * measure(partial(solve, *many), REPEATS, CPU)["median_ms"] / BATCH
        for seed, family in enumerate(FAMILIES):
            problem = make_problem(family, views, SYSTEMS, seed)
            exact = solve_exactly(*problem)
            for name, solve in SOLVERS.items():
                errors = scaled_errors(solve(*problem), exact, problem)
                good = errors[errors <= FAILED_ERROR]
                largest = float(good.max(initial=0.0))
                results.append(SolverErrors(name, family.name, views, largest, 1 - len(good) / len(errors)))
    return results, times


def solvers_table(results: Sequence[SolverErrors], times: Times) -> str:
    rows = []
    for views in VIEWS:
        for family in FAMILIES:
            own = (result.text() for result in results if (result.views, result.family) == (views, family.name))
            rows.append([str(views), family.name, *own])
    rows += [[str(views), "time a system", *(f"{times[name, views]:.0f} ns" for name in SOLVERS)] for views in VIEWS]
    return table(("rows K", f"systems of {SIZE} x {SIZE}", *SOLVERS), rows)


def statistics_table(results: Sequence[StatisticsErrors]) -> str:
    head = ("statistics", "weights", "absolute gradients", "squares", "one's, median", "one's, worst", "5 % exchanged")
    rows = []
    for result in results:
        errors = (*(result.errors[name] for name in SUMS), result.median_square, result.worst_square)
        rows.append((result.case, *(f"{error:.0e}" for error in errors), f"{100 * result.exchanged:.0f} %"))
    return table(head, rows)


def plot(results: Sequence[SolverErrors], times: Times) -> Figure:
    """Largest error of every family against time, a panel for each K; a solver that fails somewhere has a cross."""
    figure = Figure(figsize=(5.4 * len(VIEWS), 4.6), layout="constrained")
    for axes, views in zip(figure.subplots(1, len(VIEWS), sharey=True), VIEWS, strict=True):
        for name, color in zip(SOLVERS, COLORS, strict=True):
            own = [result for result in results if (result.views, result.solver) == (views, name)]
            errors = [result.largest for result in own if result.failed < 1]
            axes.plot([times[name, views]] * len(errors), errors, "o", color=color, label=name)
            if any(result.failed for result in own):
                axes.plot([times[name, views]], [10.0], "x", color=color)
        axes.set(yscale="log", title=f"{views} rows", xlabel="nanoseconds a system")
    figure.axes[0].set_ylabel("largest error, in lengths of Adam's step")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(SOLVERS))
    return figure


def main(page: Path) -> None:
    text, (results, times) = page.read_text(encoding="utf-8"), measure_solvers()
    statistics = [*(measure_case(case, CPU) for case in CASES), measure_window(CPU)]
    made = {"solvers": solvers_table(results, times), "density_sums": statistics_table(statistics)}
    where = f"{hardware('cpu')}, {torch.get_num_threads()} thread, torch {torch.__version__}."
    for name, rows in made.items():
        block = re.compile(rf"(?<=<!-- made: {name} -->\n).*?(?=<!-- end -->)", re.DOTALL)
        text = block.sub(f"\n{where}\n\n{rows}\n\n", text)
    plot(results, times).savefig(page.with_suffix(".png"))
    page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if sys.argv[1:] else Path(__file__).with_suffix(".md"))
