"""Maximum-entropy IRL with a Laplace approximation (Levine and Koltun, 2012, equation 4).

Under p(u | psi) ~ exp(-J(u; psi)), expanded to second order around the demonstrated actions,

    -log p(u_demo | psi) = 1/2 g^T H^-1 g - 1/2 log det H + const,    g = dJ/du, H = d^2J/du^2 at u_demo.

Its minimum also sets the scale of the cost, which says how exactly the demonstrator follows it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.baselines.demonstrated_conditions import DemonstratedConditions, conditions
from kpirl_ocp.irl.learning.optimisers import LBFGS, Point
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Demonstration

_STEPS = 200
_RANGE = 100.0  # of log psi; beyond it numbers overflow


def max_entropy(
    problem: OCP, demonstrations: Sequence[Demonstration], actions: Sequence[Array], psi0: ArrayLike
) -> Array:
    """psi (n_psi,), positive, of the highest approximate likelihood, by L-BFGS on its logarithm from psi0 > 0.

    Args:
        problem: without constraints; its cost is linear in psi.
        demonstrations: of which s0 and context count.
        actions: (T, n_u) of every demonstration.
        psi0: (n_psi,).

    Raises:
        ProblemError: another problem, or a Hessian that is not positive definite at psi0.
    """
    found, start = conditions(problem, demonstrations, actions), np.asarray(psi0, float)
    if not (start > 0).all():
        raise ProblemError(f"psi0 must be positive, got {start}.")

    def evaluate(log_psi: Array) -> Point:
        if np.abs(log_psi).max() > _RANGE:
            return Point(log_psi, np.inf, np.full(len(start), np.nan))
        psi = np.exp(log_psi)
        terms = [negative_log_likelihood(one, psi) for one in found]
        values, slopes = zip(*terms, strict=True)
        return Point(log_psi, float(np.mean(values)), psi * np.mean(slopes, axis=0))

    optimiser, point = LBFGS(tolerance=1e-10), evaluate(np.log(start))
    if not np.isfinite(point.loss):
        raise ProblemError("the cost is not convex around a demonstration: raise psi0's effort weight.")
    memory = optimiser.start(point)
    for _ in range(_STEPS):
        previous = point
        point, memory = optimiser.step(evaluate, point, memory)
        if point is previous:
            break
    return np.exp(point.psi)


def negative_log_likelihood(one: DemonstratedConditions, psi: Array) -> tuple[float, Array]:
    """Value and gradient (n_psi,); infinite where H is not positive definite."""
    g = one.gradient + one.gradients @ psi
    H = one.hessian + np.tensordot(psi, one.hessians, 1)
    try:
        factor = np.linalg.cholesky(H)
    except np.linalg.LinAlgError:
        return np.inf, np.full(len(psi), np.nan)
    inverse = np.linalg.inv(H)
    step = inverse @ g
    value = 0.5 * g @ step - np.log(np.diag(factor)).sum()
    bent = np.einsum("jab,ab->j", one.hessians, np.outer(step, step) + inverse)
    return float(value), one.gradients.T @ step - 0.5 * bent
