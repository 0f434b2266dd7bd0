"""Numerical stability: error against time of the solvers of moment-damped LM, on mild and stiff systems."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from turbogs_plugin.bench.clocks import measure
from turbogs_plugin.bench.statistics import write_record
from turbogs_plugin.engine.reference import lm_solvers
from turbogs_plugin.files import write_atomically, write_text_atomically
from turbogs_plugin.report.curves import STYLE
from turbogs_plugin.report.tables import table

Problem = tuple[Tensor, Tensor, Tensor, Tensor]
"""rows [K, n, D], weights [K, n], damping [n, D], rhs [n, D], as the solvers take them."""

SOLVERS: dict[str, Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]] = {
    "raw Cholesky, float32": lm_solvers.solve_raw_cholesky,
    "scaled Cholesky, float32": lm_solvers.solve_scaled_cholesky,
    "low rank, float32": lm_solvers.solve_low_rank,
    "scaled Cholesky, float64": lm_solvers.solve_float64,
}
COLORS = ("#b3261e", "#1f5fa8", "#2e7d32", "#6d6d6d")

VIEWS = (3, 10)
"""The values of K that are measured."""

SIZE = 10
"""D, the size of the systems: that of the geometry block, the larger of the two."""

SYSTEMS = 2000
"""How many systems of each family are solved to measure the error."""

BATCH = 100_000
"""How many systems are solved at once to measure the time."""

REPEATS = 5
"""How often the time is measured; the median counts."""

FAILED_ERROR = 1.0
"""A solution that is not finite, or further off than this, is worth less than no step at all."""


@dataclass(frozen=True)
class Stiffness:
    """A family of systems.

    Args:
        name: for tables.
        length: of the scaled rows sqrt(c_k) g_k / sqrt(d): 1 + K length^2 is the condition number after scaling.
        decades: that the damping spans within a block: the condition number before scaling.
        size: of the loss, and with it of gradients, damping and right side.
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


@dataclass(frozen=True)
class SolverResult:
    """One solver on one family.

    Args:
        solver, family: names.
        views: K.
        median_error, max_error: distance from the exact solution over the length of the step without rows, both in the
            scaled unknown; over the systems that did not fail, NaN where all failed.
        failed: share of the systems whose solution is not finite or is off by more than `FAILED_ERROR`.
        nanoseconds: a system, when a hundred thousand are solved at once.
    """

    solver: str
    family: str
    views: int
    median_error: float
    max_error: float
    failed: float
    nanoseconds: float


def make_problem(family: Stiffness, views: int, count: int, seed: int) -> Problem:
    """Random systems of a family, float32."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    exponents = torch.rand(count, SIZE, generator=generator, dtype=torch.float64) - 0.5
    damping = 10 ** (family.decades * exponents)
    directions = normal(1, count, SIZE).expand(views, -1, -1) if family.parallel else normal(views, count, SIZE)
    rows = family.length * directions / directions.norm(dim=-1, keepdim=True) * damping.sqrt()
    rhs = normal(count, SIZE) * damping.sqrt()
    weights = torch.full((views, count), 1 / family.size, dtype=torch.float64)
    problem = (rows * family.size, weights, damping * family.size, rhs * family.size)
    return tuple(value.float() for value in problem)


def solve_exactly(problem: Problem) -> np.ndarray:
    """[n, D] longdouble: the scaled unknown sqrt(d) x, by Gauss-Jordan elimination in extended precision, every row at
    its full length."""
    rows, weights, damping, rhs = (value.double().numpy().astype(np.longdouble) for value in problem)
    scale = 1 / np.sqrt(damping)
    scaled = rows * scale * np.sqrt(weights)[..., None]
    identity = np.broadcast_to(np.eye(SIZE, dtype=np.longdouble), (len(rhs), SIZE, SIZE))
    augmented = np.concatenate([identity + np.einsum("kni,knj->nij", scaled, scaled), (rhs * scale)[..., None]], axis=2)
    for column in range(SIZE):  # no pivoting: the matrix is positive definite
        augmented[:, column] /= augmented[:, column, column, None]
        for row in range(SIZE):
            if row != column:
                augmented[:, row] -= augmented[:, row, column, None] * augmented[:, column]
    return augmented[:, :, SIZE]


def scaled_errors(solution: Tensor, exact: np.ndarray, problem: Problem) -> np.ndarray:
    """[n] distance of each solution from the exact one, over the length of the step without rows; inf where the
    solution is not finite."""
    root = problem[2].double().numpy() ** 0.5
    solution = solution.double().cpu().numpy()
    with np.errstate(invalid="ignore"):
        distance = np.linalg.norm(solution * root - exact.astype(np.float64), axis=-1)
    step = np.linalg.norm(problem[3].double().numpy() / root, axis=-1)
    return np.where(np.isfinite(distance), distance / step, np.inf)


def bench_solvers(out: Path, device: torch.device) -> list[SolverResult]:
    """Measure all solvers on all families, and write ``solvers.json`` (every number and the machine), ``solvers.md``
    (the table) and ``solvers.png``.

    Args:
        out: folder for the three files; made where absent.
        device: where the solvers run.
    """
    results = []
    for views in VIEWS:
        # Branch-free solvers take the same time on every family.
        many = [value.to(device) for value in make_problem(FAMILIES[0], views, BATCH, seed=0)]
        measured = {name: measure(partial(solve, *many), REPEATS, device) for name, solve in SOLVERS.items()}
        times = {name: 1e6 * took["median_ms"] / BATCH for name, took in measured.items()}
        for seed, family in enumerate(FAMILIES):
            problem = make_problem(family, views, SYSTEMS, seed)
            exact = solve_exactly(problem)
            for name, solve in SOLVERS.items():
                errors = scaled_errors(solve(*(value.to(device) for value in problem)), exact, problem)
                good = errors[errors <= FAILED_ERROR]
                median, largest = (float(np.median(good)), float(good.max())) if len(good) else (math.nan, math.nan)
                failed = 1 - len(good) / len(errors)
                results.append(SolverResult(name, family.name, views, median, largest, failed, times[name]))
    settings = {"systems": SYSTEMS, "batch": BATCH, "repeats": REPEATS, "size": SIZE}
    write_record(out / "solvers.json", settings, results, device)
    write_text_atomically(out / "solvers.md", solvers_table(results) + "\n")
    write_atomically(out / "solvers.png", lambda file: _plot(results).savefig(file, format="png"))
    return results


def solvers_table(results: list[SolverResult]) -> str:
    """A Markdown table of results."""

    def cell(result: SolverResult) -> str:
        if result.failed == 1:
            return "all fail"
        share = "< 0.1" if result.failed < 5e-4 else f"{100 * result.failed:.1f}"
        return f"{result.max_error:.0e}" + (f" ({share} % fail)" if result.failed else "")

    def of(views: int, family: Stiffness) -> list[SolverResult]:
        return [result for result in results if (result.views, result.family) == (views, family.name)]

    rows = [(k, family.name, *(cell(result) for result in of(k, family))) for k in VIEWS for family in FAMILIES]
    for k in VIEWS:
        rows.append((k, "time a system", *(f"{result.nanoseconds:.0f} ns" for result in of(k, FAMILIES[0]))))
    return table(("rows K", "systems of 10 x 10", *SOLVERS), rows)


def _plot(results: list[SolverResult]) -> Figure:
    """Largest error of every family against time, a panel for each K. Hollow: rows beyond `lm_solvers.ROW_LIMIT`."""
    lengths = {family.name: family.length for family in FAMILIES}
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(5.4 * len(VIEWS), 4.6), layout="constrained")
        for axes, k in zip(figure.subplots(1, len(VIEWS), sharey=True), VIEWS, strict=True):
            for name, color in zip(SOLVERS, COLORS, strict=True):
                own = [result for result in results if result.views == k and result.solver == name]
                time_ns = own[0].nanoseconds
                for result in own:
                    if result.failed < 1:
                        within = lengths[result.family] <= lm_solvers.ROW_LIMIT
                        axes.plot(time_ns, result.max_error, "o", color=color, fillstyle="full" if within else "none")
                axes.plot([], [], "o", color=color, label=name)
                failing = sum(result.failed > 0 for result in own)
                if failing:
                    axes.plot([time_ns], [10.0], "x", color=color, markersize=9, markeredgewidth=2)
                    note = f"fails in {failing} of {len(own)} families"
                    axes.annotate(
                        note, (time_ns, 10.0), (0, 8), textcoords="offset points", color=color, fontsize=9, ha="center"
                    )
            axes.set(yscale="log", title=f"{k} rows", xlabel="nanoseconds a system")
            axes.margins(x=0.2)
            axes.set_xlim(left=0)
        figure.axes[0].set_ylabel("largest error, in lengths of Adam's step")
        figure.axes[0].plot(
            [], [], "o", color="black", fillstyle="none", label=f"rows beyond {lm_solvers.ROW_LIMIT:.0f}, cut there"
        )
        figure.legend(*figure.axes[0].get_legend_handles_labels(), fontsize=9, loc="outside lower center", ncols=3)
    return figure
