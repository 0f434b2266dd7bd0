"""The batched solvers of small damped systems, against extended precision."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.exact_solver import solve_exactly

from turbogs_plugin.engine.reference.lm_solvers import ROW_LIMIT, scaled_rows, solve_low_rank, solve_scaled_cholesky

STABLE = [solve_scaled_cholesky, solve_low_rank]


def systems(views: int, size: int, decades: float, length: float, seed: int = 0, count: int = 40, dtype=torch.float64):
    """Systems whose damping spans `decades` orders of magnitude and whose scaled rows have about this length."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64) * 2 - 1

    damping = 10 ** (decades * 0.5 * uniform(count, size))
    rows = uniform(views, count, size) * damping.sqrt() * length
    rhs = uniform(count, size) * damping.sqrt()
    return tuple(value.to(dtype) for value in (rows, damping, rhs))


def scaled_error(solution, expected, damping, rhs) -> float:
    """Largest error of the scaled unknown, over the length of the step without rows."""
    root = damping.double().numpy() ** 0.5
    error = np.linalg.norm(solution.double().numpy() * root - expected.astype(float), axis=-1)
    return float((error / np.linalg.norm(rhs.double().numpy() / root, axis=-1)).max())


@pytest.mark.parametrize("views", [1, 3, 10])
@pytest.mark.parametrize("solve", STABLE)
@pytest.mark.parametrize("decades", [8, 16, 30])
def test_stiff_in_float32(views, solve, decades):
    """Condition numbers to 1e30 of the unscaled system cost nothing: only the scaled one's counts, 1e4 here."""
    problem = systems(views, 10, decades=decades, length=30, dtype=torch.float32)
    assert scaled_error(solve(*problem), solve_exactly(*problem), *problem[1:]) < 2e-3


@pytest.mark.parametrize("solve", STABLE)
@pytest.mark.parametrize("case", ["damping below rounding", "overflow"])
def test_where_cholesky_without_scaling_fails(case, solve):
    """Rows so long that 1 + |u|^2 rounds to |u|^2, and gradients whose squares leave float32."""
    if case == "overflow":
        rows, damping, rhs = systems(3, 10, decades=4, length=5, dtype=torch.float32)
        problem, tolerance = (rows * 1e18, damping * 1e36, rhs * 1e18), 1e-4
    else:
        problem, tolerance = systems(3, 10, decades=16, length=1e6, dtype=torch.float32), 1e-2  # cut at ROW_LIMIT
    assert scaled_error(solve(*problem), solve_exactly(*problem), *problem[1:]) < tolerance


@pytest.mark.parametrize("solve", STABLE)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_extremes_stay_finite(solve, dtype):
    """Rows and damping at the ends of what the optimizer can hand over, in every combination."""
    rows = torch.tensor([0.0, 1e-38, 1e-17, 1.0, 1e17], dtype=dtype)
    damping = torch.tensor([1e-20, 1e-4, 1.0, 1e23, 1e36], dtype=dtype)
    rhs = torch.tensor([0.0, 1e-30, 1e18], dtype=dtype)
    first, second, d1, d2, b = torch.meshgrid(rows, rows, damping, damping, rhs, indexing="ij")
    row = torch.stack([first, second, first], dim=-1).reshape(1, -1, 3).repeat(5, 1, 1)
    solution = solve(
        row, torch.stack([d1, d2, d2], dim=-1).reshape(-1, 3), torch.stack([b, -b, b], dim=-1).reshape(-1, 3)
    )
    assert torch.isfinite(solution).all()
    lengths = scaled_rows(row, torch.full_like(row[0], 1e-20)).norm(dim=-1)  # of the longest, the square overflows
    assert (lengths <= 1.001 * ROW_LIMIT).all() and (lengths[row.amax(dim=-1) > 1e16] > 0.999 * ROW_LIMIT).all()


@pytest.mark.parametrize("views", [1, 10, 32])
@pytest.mark.parametrize("solve", STABLE)
def test_worst_condition_that_the_limit_admits(views, solve):
    """Endless rows, all parallel, or all but parallel: cut at the limit, they leave every pivot positive in float32."""
    generator = torch.Generator().manual_seed(views)
    rows = torch.randn(1, 500, 10, generator=generator).repeat(views, 1, 1)
    rows[:, 250:] += 1e-3 * torch.randn(views, 250, 10, generator=generator)
    rows *= ROW_LIMIT / rows.norm(dim=-1, keepdim=True)  # the longest that need no cut, so that the answer is known
    damping = torch.ones(500, 10)
    rhs = torch.randn(500, 10, generator=generator)
    problem = rows, damping, rhs
    bound = 3 * torch.finfo(torch.float32).eps * views * ROW_LIMIT**2  # rounding times condition
    assert scaled_error(solve(*problem), solve_exactly(*problem), damping, rhs) < bound
    endless = solve(rows * 1e12, damping, rhs)
    assert torch.isfinite(endless).all()
    assert (endless.norm(dim=-1) <= (1 + bound) * rhs.norm(dim=-1)).all()
