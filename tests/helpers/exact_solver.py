"""Damped systems solved in extended precision: the truth for the solvers, in tests and in docs/lab/numerics.py."""

import numpy as np
from torch import Tensor


def solve_exactly(rows: Tensor, damping: Tensor, rhs: Tensor) -> np.ndarray:
    """[n, D] longdouble: the scaled unknown sqrt(d) x, by Gauss-Jordan elimination, every row at its full length.

    Args:
        rows, damping, rhs: [K, n, D], [n, D], [n, D], as the solvers take them.
    """
    rows, damping, rhs = (v.double().numpy().astype(np.longdouble) for v in (rows, damping, rhs))
    scale, size = 1 / np.sqrt(damping), damping.shape[1]
    scaled = rows * scale
    identity = np.broadcast_to(np.eye(size, dtype=np.longdouble), (len(rhs), size, size))
    augmented = np.concatenate([identity + np.einsum("kni,knj->nij", scaled, scaled), (rhs * scale)[..., None]], axis=2)
    for column in range(size):  # no pivoting: the matrix is positive definite
        augmented[:, column] /= augmented[:, column, column, None]
        for row in range(size):
            if row != column:
                augmented[:, row] -= augmented[:, row, column, None] * augmented[:, column]
    return augmented[:, :, size]
