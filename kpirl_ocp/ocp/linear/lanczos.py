"""The Lanczos method: the outer eigenvalues of a symmetric operator from a few products; as expressions."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from itertools import combinations

import casadi as ca
import numpy as np

from kpirl_ocp.types import Array

_SWEEPS = 6  # of Jacobi's method, each of which in the end doubles the digits


def lanczos(operator: Callable[[ca.MX], ca.MX], start: ca.MX, products: int) -> tuple[ca.MX, ca.MX, ca.MX]:
    """Diagonal (k,) and off-diagonal (k,) of the tridiagonal form, and the basis (size, k); k <= products.

    The basis is orthogonalised twice, so that no eigenvalue appears as a ghost. All products are taken, whatever they
    give: an invariant subspace ends the process, and `outermost` and `magnitude` leave out what comes after it.
    """
    vectors: list[ca.MX] = []
    diagonal: list[ca.MX] = []
    offdiagonal: list[ca.MX] = []
    vector, length = start, ca.norm_2(start)
    for _ in range(min(products, start.numel())):
        vectors.append(ca.if_else(length == 0, 0, vector / length))
        basis = ca.horzcat(*vectors)
        vector = operator(vectors[-1])
        diagonal.append(ca.dot(vectors[-1], vector))
        for _ in range(2):
            vector = vector - basis @ (vector.T @ basis).T
        length = ca.norm_2(vector)
        offdiagonal.append(length)
    return (
        ca.vertcat(ca.MX(0, 1), *diagonal),
        ca.vertcat(ca.MX(0, 1), *offdiagonal),
        ca.horzcat(ca.MX(start.numel(), 0), *vectors),
    )


@lru_cache(maxsize=64)
def start(size: int) -> Array:
    """A vector that is random but always the same."""
    vector = np.random.default_rng(0).normal(size=size)
    vector.flags.writeable = False
    return vector


@lru_cache(maxsize=64)
def magnitude(size: int) -> ca.Function:
    """(diagonal (k,), offdiagonal (k,)) of `lanczos` -> the largest |Ritz value|. NaN stays NaN."""
    inputs = [ca.MX.sym("diagonal", size), ca.MX.sym("offdiagonal", size)]
    form, *_ = _tridiagonal(size)(*inputs)
    values, _ = _diagonalised(form)
    return ca.Function("magnitude", inputs, [_largest(size)(ca.fabs(values), ca.MX.ones(size))[0]])


@lru_cache(maxsize=64)
def outermost(size: int) -> ca.Function:
    """(diagonal (k,), offdiagonal (k,), lowest (0 or 1)) of `lanczos` -> value, error, coordinates (k,).

    The lowest or the highest Ritz value, how far it is from an eigenvalue at most, and its vector in the basis. NaN
    stays NaN, and is the value of an operator without dimensions.
    """
    inputs = [ca.MX.sym("diagonal", size), ca.MX.sym("offdiagonal", size), ca.MX.sym("lowest")]
    if not size:
        return ca.Function("outermost", inputs, [ca.MX(np.nan), ca.MX(np.nan), ca.MX(0, 1)])
    form, going, last = _tridiagonal(size)(*inputs[:2])
    values, vectors = _diagonalised(form)
    sign = 1 - 2 * inputs[2]
    value, where = _largest(size)(sign * values, going)
    coordinates = vectors @ where
    error = ca.dot(ca.if_else(last, inputs[1], 0), ca.fabs(coordinates))
    return ca.Function("outermost", inputs, [sign * value, error, coordinates])


@lru_cache(maxsize=64)
def _tridiagonal(size: int) -> ca.Function:
    """(diagonal, offdiagonal) -> the matrix (k, k), going (k,), last (k,).

    The matrix is zero after the end of the process; going is 1 up to there, and last is 1 there.
    """
    diagonal, offdiagonal = ca.SX.sym("diagonal", size), ca.SX.sym("offdiagonal", size)
    form, scale, going = ca.SX(ca.DM.zeros(size, size)), ca.fabs(diagonal[0]), [ca.SX(1)]
    form[0, 0] = diagonal[0]
    for k in range(1, size):
        going.append(ca.logic_and(going[-1], offdiagonal[k - 1] > 1e-12 * scale))
        scale = ca.if_else(ca.fabs(diagonal[k]) > scale, ca.fabs(diagonal[k]), scale)
        form[k, k] = ca.if_else(going[k], diagonal[k], 0)
        form[k, k - 1] = form[k - 1, k] = ca.if_else(going[k], offdiagonal[k - 1], 0)
    last = ca.vertcat(*going) - ca.vertcat(*going[1:], 0)
    outputs = [form, ca.vertcat(*going), last]
    return ca.Function("tridiagonal", [diagonal, offdiagonal], [ca.densify(x) for x in outputs])


def _diagonalised(form: ca.MX) -> tuple[ca.MX, ca.MX]:
    """Eigenvalues (k,), in no order, and vectors (k, k) of a symmetric matrix, by Jacobi's method."""
    vectors: ca.MX = ca.MX(ca.DM(np.eye(form.size1())))
    for _ in range(_SWEEPS):
        form, vectors = _sweep(form.size1())(form, vectors)
    return ca.diag(form), vectors


@lru_cache(maxsize=64)
def _sweep(size: int) -> ca.Function:
    """(A, V) -> J' A J, V J, with a rotation J for every off-diagonal entry, which it turns to zero."""
    A, V = first = ca.SX.sym("A", size, size), ca.SX.sym("V", size, size)
    for p, q in combinations(range(size), 2):
        ratio = (A[q, q] - A[p, p]) / (2 * A[p, q])
        tangent = ca.if_else(ratio < 0, -1, 1) / (ca.fabs(ratio) + ca.sqrt(1 + ratio**2))
        tangent = ca.if_else(A[p, q] == 0, 0, tangent)
        cosine = 1 / ca.sqrt(1 + tangent**2)
        J = ca.SX.eye(size)
        J[p, p] = J[q, q] = cosine
        J[p, q], J[q, p] = tangent * cosine, -tangent * cosine
        A, V = J.T @ A @ J, V @ J
    return ca.Function("sweep", first, [ca.densify(A), ca.densify(V)])


@lru_cache(maxsize=64)
def _largest(size: int) -> ca.Function:
    """(values (k,), allowed (k,), of which the first is) -> the largest value that is allowed, and 1 at its place."""
    values, allowed = ca.SX.sym("values", size), ca.SX.sym("allowed", size)
    units = ca.DM(np.eye(size))
    value, where = values[0], ca.SX(ca.densify(units[:, 0]))
    for k in range(1, size):
        larger = ca.logic_and(allowed[k], values[k] > value)
        value, where = ca.if_else(larger, values[k], value), ca.if_else(larger, units[:, k], where)
    return ca.Function("largest", [values, allowed], [value, ca.densify(where)])
