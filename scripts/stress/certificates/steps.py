"""The loss after gradient steps as a function of psi: whether it is smooth, and its slopes.

All of it is measured by taking the steps again at other psi, without the package's derivatives and certificates.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.polynomial import chebyshev

from kpirl_ocp import GradientDescent, Status
from kpirl_ocp.errors import ProblemError
from kpirl_ocp.irl.hypergradients.loss import data_of
from kpirl_ocp.ocp.solvers.gradient_descent import check_constraints
from stress.certificates.case import TOLERANCE, Case
from stress.certificates.distances import DUE

_DEGREE, _NODES = 20, np.cos(np.pi * np.arange(33) / 32)
_LEFT, _ROUNDING = 1e-6, 1e-13  # of a series: of what varies, and of the largest value


def steps_for(case: Case) -> GradientDescent:
    """A hundred steps of length 0.1, projected onto bounds of actions where there are some."""
    return GradientDescent(steps=100, step_size=0.1, project=case.problem.has_action_bounds)


def is_stated(case: Case) -> bool:
    """Whether gradient descent takes the problem: of constraints it honours constant bounds of actions alone."""
    try:
        check_constraints(case.problem, case.problem.has_action_bounds)
    except ProblemError:
        return False
    return True


def is_smooth(case: Case, solver: GradientDescent) -> bool:
    """Whether the steps end below where they began, and the loss after them is smooth within DUE of psi.

    Smooth: along every parameter its Chebyshev series has come to an end at half of its degree. Of a kink anywhere
    within, coefficients fall like 1 / k^2 only.
    """
    value = _loss_after(case, solver)
    plan = _plan(case, solver, case.psi)
    if plan.status in (Status.DIVERGED, Status.NOT_FINITE):
        return False
    sides = DUE * np.diag(np.maximum(1e-3, np.abs(case.psi)))
    return all(_ends(np.array([value(case.psi + x * side) for x in _NODES])) for side in sides)


def _ends(values: np.ndarray) -> bool:
    if not np.isfinite(values).all():
        return False
    off = values - values.mean()
    series = chebyshev.chebfit(_NODES, off, _DEGREE)
    left = max(np.abs(series[_DEGREE // 2 :]).max(), np.abs(off - chebyshev.chebval(_NODES, series)).max())
    return bool(left <= max(_LEFT * np.ptp(values), _ROUNDING * np.abs(values).max()))


def is_slope_of_the_steps(case: Case, gradient: np.ndarray, solver: GradientDescent) -> bool:
    """Whether a gradient (n_psi,) is the slope to both sides of what gradient descent makes of psi, at one small step.

    Steps that end before the minimum have a derivative of their own, which is what is certified of them. The shortest
    step was added when one certified case had been counted as wrong without it: of that case it is no evidence.
    """
    value = _loss_after(case, solver)
    centre, unit = value(case.psi), np.maximum(1e-3, np.abs(case.psi))
    return any(_agree(value, centre, case.psi, h * unit, gradient) for h in (1e-4, 1e-5, 1e-6, 1e-7, 1e-8))


def _plan(case: Case, solver: GradientDescent, psi: np.ndarray):
    return solver.solve(case.problem, case.demonstration.s0, psi, case.demonstration.context, case.guess)


def _loss_after(case: Case, solver: GradientDescent) -> Callable[[np.ndarray], float]:
    """psi -> the loss."""
    loss, data = case.loss(case.problem), data_of(case.loss, case.problem, case.demonstration)

    def value(psi: np.ndarray) -> float:
        plan = _plan(case, solver, psi)
        return float(loss(plan.states.T, plan.actions.T, data))

    return value


def _agree(
    value: Callable[[np.ndarray], float], centre: float, psi: np.ndarray, steps: np.ndarray, gradient: np.ndarray
) -> bool:
    sides = [
        [sign * (value(psi + sign * step) - centre) / step.sum() for step in np.diag(steps)] for sign in (1.0, -1.0)
    ]
    bound = TOLERANCE * (np.abs(gradient) + np.abs(gradient).max()) + 1e-14 * abs(centre) / steps + 1e-12
    return bool((np.abs(np.array(sides) - gradient) <= bound).all())
