"""The Lanczos method: the outer eigenvalues of a symmetric operator from a few products."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kpirl_ocp.types import Array


def lanczos(operator: Callable[[Array], Array], size: int, products: int) -> tuple[Array, Array]:
    """Ritz values (k,) in ascending order and vectors (size, k) of length one, k <= products.

    The start is random but always the same; the basis is orthogonalised twice, so that no eigenvalue appears as a
    ghost. The first and last values converge first. NaN from the operator gives NaN values.
    """
    basis = np.zeros((min(products, size), size))
    diagonal, beside = [], []
    vector = np.random.default_rng(0).normal(size=size)
    length = np.linalg.norm(vector)
    for k in range(len(basis)):
        basis[k] = vector / length
        vector = operator(basis[k])
        if not np.isfinite(vector).all():
            return np.full(1, np.nan), np.full((size, 1), np.nan)
        diagonal.append(basis[k] @ vector)
        for _ in range(2):
            vector = vector - basis[: k + 1].T @ (basis[: k + 1] @ vector)
        length = np.linalg.norm(vector)
        if length <= 1e-12 * np.abs(diagonal).max():  # an invariant subspace: the values are exact
            break
        beside.append(length)
    k = len(diagonal)
    values, vectors = np.linalg.eigh(np.diag(diagonal) + np.diag(beside[: k - 1], -1))  # reads the lower triangle
    return values, basis[:k].T @ vectors
