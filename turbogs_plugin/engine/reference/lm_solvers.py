"""Small damped least-squares systems, many at once: ``(sum_k g_k g_k^T + diag(d)) x = b``.

All functions have one signature, ``solve(rows, damping, rhs) -> x``:

- rows: [K, n, D] the g_k; damping: [n, D] the d > 0; rhs: [n, D] the b; x: [n, D].

For the blocks of Moment-LM (D = 10 and 4) `reference/update.py` uses `solve_low_rank`, and the CUDA kernel
(`csrc/optimizer/moment_lm.cuh`) does what `solve_scaled_cholesky` does. Both first scale the system by d^(-1/2) on both
sides. It becomes I + (something positive semi-definite), whose eigenvalues are >= 1. Its condition depends only on the
length of the scaled rows, which can be bounded: no damping is lost in rounding beside long rows, no square overflows.
"""

from __future__ import annotations

import torch
from torch import Tensor

ROW_LIMIT = 100.0
"""Longest scaled row. A row of length l multiplies the step along itself by 1 / (1 + l^2). At this limit that is a ten
thousandth, nearly nothing, while the condition number stays below 1 + K * 1e4, which float32 can handle. If rows of
that length span many directions and are almost linearly dependent, cutting them changes the answer (it damps less)."""


def scaled_rows(rows: Tensor, damping: Tensor) -> Tensor:
    """[K, n, D]: g_k / sqrt(d), cut to length `ROW_LIMIT`. Finite input gives no overflow and no NaN: the
    direction is divided by its largest entry before anything is squared."""
    direction = rows * torch.rsqrt(damping)
    largest = direction.abs().amax(dim=-1, keepdim=True)  # [K, n, 1]
    unit = direction / largest.clamp(min=torch.finfo(rows.dtype).tiny)  # entries within -1 .. 1
    unit_norm = unit.square().sum(dim=-1, keepdim=True).sqrt().clamp(min=torch.finfo(rows.dtype).tiny)
    length = (largest * unit_norm).clamp(max=ROW_LIMIT)  # an overflow ends at the limit
    return unit * (length / unit_norm)


def solve_scaled_cholesky(rows: Tensor, damping: Tensor, rhs: Tensor) -> Tensor:
    """Cholesky of the scaled system, D x D, as in the CUDA kernel."""
    scale = torch.rsqrt(damping)
    scaled = scaled_rows(rows, damping)
    matrix = torch.einsum("kni,knj->ijn", scaled, scaled)
    return scale * _solve_identity_plus(matrix, (rhs * scale).T).T


def solve_low_rank(rows: Tensor, damping: Tensor, rhs: Tensor) -> Tensor:
    """Woodbury's form, a K x K system: cheaper than D x D where there are fewer rows than parameters."""
    scale = torch.rsqrt(damping)
    scaled = scaled_rows(rows, damping)
    scaled_rhs = rhs * scale
    gram = torch.einsum("kni,lni->kln", scaled, scaled)
    projected = torch.einsum("kni,ni->kn", scaled, scaled_rhs)
    coefficients = _solve_identity_plus(gram, projected)  # [K, n]
    return scale * (scaled_rhs - torch.einsum("kn,kni->ni", coefficients, scaled))


def _solve_identity_plus(matrix: Tensor, rhs: Tensor) -> Tensor:
    """Solve (I + matrix) x = rhs for n systems at once.

    Args:
        matrix: [D, D, n] positive semi-definite, with a trace below about 1e6 in float32: the exact pivots are >= 1,
            and rounding must not take them to zero. The batch lies last, so that each of the D^3 / 6 steps below
            is one pass over contiguous memory.
        rhs: [D, n].
    """
    size = len(matrix)
    inverse_diagonal: list[Tensor] = []
    factor: list[list[Tensor]] = []  # factor[i][j], j < i, of L with I + matrix = L L^T
    forward: list[Tensor] = []  # L y = rhs
    for i in range(size):
        row: list[Tensor] = []
        for j in range(i):
            value = matrix[i, j].clone()
            for k in range(j):
                value.addcmul_(row[k], factor[j][k], value=-1)
            row.append(value.mul_(inverse_diagonal[j]))
        pivot, target = matrix[i, i] + 1, rhs[i].clone()
        for k in range(i):
            pivot.addcmul_(row[k], row[k], value=-1)
            target.addcmul_(row[k], forward[k], value=-1)
        inverse_diagonal.append(pivot.rsqrt_())
        forward.append(target.mul_(inverse_diagonal[i]))
        factor.append(row)
    solution = forward  # L^T x = y, in place from the last entry
    for i in reversed(range(size)):
        for k in range(i + 1, size):
            solution[i].addcmul_(factor[k][i], solution[k], value=-1)
        solution[i].mul_(inverse_diagonal[i])
    return torch.stack(solution)
