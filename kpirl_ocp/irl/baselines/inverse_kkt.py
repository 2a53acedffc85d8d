"""Inverse KKT (Englert, Vien and Toussaint, 2017): weights under which the demonstration is most nearly stationary.

    min_psi  sum over demonstrations |dJ/du(u_demo; psi)|^2    subject to psi >= 0, sum psi = 1

The dynamics are eliminated, so that their multipliers do not appear. With psi = scale * direction, the least value of
|G psi|^2 + (sum psi - 1)^2 over the scale grows with |G direction|^2 alone, so non-negative least squares solve it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import nnls

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.baselines.demonstrated_conditions import conditions
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Demonstration


def inverse_kkt(problem: OCP, demonstrations: Sequence[Demonstration], actions: Sequence[Array]) -> Array:
    """psi (n_psi,), not negative, with sum one: only ratios of weights can be told from stationarity.

    Args:
        problem: without constraints; its cost is linear in psi and zero at psi = 0 (an effort weight is one of them).
        demonstrations: of which s0 and context count.
        actions: (T, n_u) of every demonstration.

    Raises:
        ProblemError: another problem, or demonstrations that are stationary under all weights.
    """
    found = conditions(problem, demonstrations, actions)
    if any(np.abs(one.gradient).max() > 1e-12 * np.abs(one.gradients).max() for one in found):
        raise ProblemError("inverse KKT needs a cost that is zero at psi = 0: learn the effort weight, too.")
    gradients = np.vstack([one.gradients for one in found])
    if not gradients.any():
        raise ProblemError("the demonstrations are stationary under all weights, and so tell nothing about them.")
    return simplex_least_squares(gradients)


def simplex_least_squares(matrix: Array) -> Array:
    """argmin |matrix psi|^2 over psi >= 0, sum psi = 1; columns are scaled to equal length on the way."""
    lengths = np.linalg.norm(matrix, axis=0)
    units = 1 / np.maximum(lengths, 1e-6 * lengths.max())
    units /= units.sum()
    size = np.abs(matrix * units).max()
    found, _ = nnls(np.vstack([matrix * units / size, units]), np.append(np.zeros(len(matrix)), 1.0))
    psi = found * units
    return psi / psi.sum()
