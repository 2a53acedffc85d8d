"""Second derivatives of a multilayer perceptron at many points side by side.

With A_l = da_l/dx, the adjoint eta_l of h_l and w_l = sigma_l''(a_l) eta_l,

    d^2 (eta . y)/dx^2 = sum_l A_l' diag(w_l) A_l.

A_1 = W_1 is the same everywhere. Its term is linear in w_1, so that the lower triangles for all points are one product
with the constant products of pairs of columns of W_1: half the arithmetic, at the rate of a matrix-matrix product. At
a single point, reading that table would take longer than computing the term as it stands.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.models.activations import Slopes
from kpirl_ocp.ocp.models.mlp import MLP, jacobian, scale_rows, times
from kpirl_ocp.types import Array

Parts = Sequence["ca.MX | None"]


def prepare(mlp: MLP, slopes: Sequence[Slopes], adjoint: ca.MX) -> list[ca.MX | None]:
    """The arguments of `second` at B points, for adjoint (n_out, B); None for those without numbers.

    They are the lower triangle of the first layer's term (all of it for B = 1), sigma_1' .. sigma_L' and w_2 .. w_L.
    """
    weights = _weights(mlp, slopes, adjoint)
    low = None if weights[0] is None else _first_term(mlp.weights[0], weights[0])
    return [low, *(slope.first for slope in slopes), *weights[1:]]


def second(mlp: MLP, prepared: Parts) -> tuple[ca.MX, ca.MX]:
    """dy/dx (n_out, n_in) and d^2 (adjoint . y)/dx^2 (n_in, n_in) at one point.

    Layers without curvature add nothing; if no layer has any, the Hessian is structurally zero.
    """
    n, layers = mlp.n_in, len(mlp.weights)
    low, firsts, weights = prepared[0], prepared[1 : layers + 1], prepared[layers + 1 :]
    if low is None and all(weight is None for weight in weights):
        return jacobian(mlp, [Slopes(first, None) for first in firsts]), ca.MX(n, n)
    total = ca.MX.zeros(n, n) if low is None else _whole(low, n)
    columns = ca.MX(ca.DM(mlp.weights[0].T))  # A_l'
    for weight, first, curvature in zip(mlp.weights[1:], firsts[:-1], weights, strict=True):
        columns = columns @ scale_rows(first, ca.MX(ca.DM(weight.T)))
        if curvature is not None:
            total = ca.mac(columns, scale_rows(curvature, columns.T), total)
    return scale_rows(firsts[-1], columns.T), total


def _weights(mlp: MLP, slopes: Sequence[Slopes], adjoint: ca.MX) -> list[ca.MX | None]:
    """w_l (n_l, B) of every layer; None where there is no curvature."""
    weights: list[ca.MX | None] = []
    for weight, slope in zip(reversed(mlp.weights), reversed(slopes), strict=True):
        weights.insert(0, None if slope.second is None else slope.second * adjoint)
        adjoint = ca.DM(weight.T) @ times(slope.first, adjoint)
    return weights


def _first_term(weight: Array, factors: ca.MX) -> ca.MX:
    """W' diag(w) W of W (n_1, n) and w (n_1, B): its lower triangle (n (n + 1) / 2, B), or all of it for B = 1."""
    if factors.size2() > 1:
        return ca.DM(_pairs(weight)) @ factors
    return ca.vec(ca.DM(weight.T) @ scale_rows(factors, ca.MX(ca.DM(weight))))


def _whole(entries: ca.MX, n: int) -> ca.MX:
    """The matrix (n, n) of `_first_term`."""
    return ca.reshape(entries if entries.numel() == n * n else entries.nz[_mirrored(n)], n, n)


def _pairs(weight: Array) -> Array:
    """W_ki W_kj for i >= j (n (n + 1) / 2, n_1), of W (n_1, n)."""
    i, j = np.tril_indices(weight.shape[1])
    return (weight[:, i] * weight[:, j]).T


def _mirrored(n: int) -> list[int]:
    """For every entry of a symmetric matrix (n, n), column by column, its index in the lower triangle."""
    where = np.zeros((n, n), int)
    where[np.tril_indices(n)] = np.arange(n * (n + 1) // 2)
    return np.maximum(where, where.T).ravel().tolist()
