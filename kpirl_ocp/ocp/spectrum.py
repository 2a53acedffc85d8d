"""The Lanczos method: the outer eigenvalues of a symmetric operator from a few products."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.types import Array


def lanczos(operator: Callable[[ca.MX], ca.MX], start: ca.MX, products: int) -> list[ca.MX]:
    """Diagonal (k,) and what stands beside it (k,) in the tridiagonal form, and the basis (size, k); k <= products.

    The basis is orthogonalised twice, so that no eigenvalue appears as a ghost. All products are taken, whatever they
    give: `ritz` knows where to stop.
    """
    vectors: list[ca.MX] = []
    diagonal: list[ca.MX] = []
    beside: list[ca.MX] = []
    vector, length = start, ca.norm_2(start)
    for _ in range(min(products, start.numel())):
        vectors.append(vector / length)
        basis = ca.horzcat(*vectors)
        vector = operator(vectors[-1])
        diagonal.append(ca.dot(vectors[-1], vector))
        for _ in range(2):
            vector = vector - basis @ (vector.T @ basis).T
        length = ca.norm_2(vector)
        beside.append(length)
    return [
        ca.vertcat(ca.MX(0, 1), *diagonal),
        ca.vertcat(ca.MX(0, 1), *beside),
        ca.horzcat(ca.MX(start.numel(), 0), *vectors),
    ]


@lru_cache(maxsize=64)
def start(size: int) -> Array:
    """A vector that is random but always the same."""
    vector = np.random.default_rng(0).normal(size=size)
    vector.flags.writeable = False
    return vector


def ritz(diagonal: Array, beside: Array, basis: Array) -> tuple[Array, Array]:
    """Ritz values (k,) in ascending order and vectors (size, k) of length one; arrays as `lanczos` gives them, flat.

    The first and last values converge first. An invariant subspace ends the iteration: then the values are exact. NaN
    from the operator gives NaN values.
    """
    columns, scale = basis.reshape(len(diagonal), -1), 0.0
    for k in range(len(diagonal)):
        if not np.isfinite(diagonal[k]):
            return np.full(1, np.nan), np.full((columns.shape[1], 1), np.nan)
        scale = max(scale, abs(diagonal[k]))
        if beside[k] <= 1e-12 * scale:
            break
    k += 1
    values, vectors = np.linalg.eigh(np.diag(diagonal[:k]) + np.diag(beside[: k - 1], -1))  # reads the lower triangle
    return values, columns[:k].T @ vectors
