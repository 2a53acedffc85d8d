"""Kinks of the loss, of the observation, and of the problem in psi, which no derivative at a point shows.

CasADi's derivative of |x| at 0 is 0, and that of a step function is 0 everywhere. Kinks are found only by evaluating to
both sides of a point.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.irl.hypergradients.loss import Loss
from kpirl_ocp.ocp.interior_point.library import all_finite
from kpirl_ocp.ocp.problem.layout import by_stage
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.sensitivity.certificate import KINK
from kpirl_ocp.ocp.sensitivity.evidence import LossOfPlan, parameter_jump
from kpirl_ocp.types import Array, Solution

LOSS_KINK = "The loss or the observation sits on a kink at this plan: use smooth ones (squares, softplus, tanh)."
PARAMETER_KINK = "Costs, constraints or dynamics have a kink or a jump at these parameters: use smooth ones."


class LossAt:
    """A loss at a plan, and its gradient.

    value: of the loss. slopes: (n_w,) gradient by the plan, S, then U.
    """

    def __init__(self, problem: OCP, loss: Loss, data: Array, x: Array) -> None:
        """data: (n_data, T+1) of the demonstration. x: the plan (n_w,) in the order of time."""
        self._loss = LossOfPlan(problem, _loss_and_slopes(loss), data.T, x)
        self.value, self.slopes = self._loss.value, self._loss.slopes

    def kinks(self, along: Array | None = None) -> list[str]:
        """One failure message if the loss is not smooth at the plan, else none.

        It is tested in a random direction, and along a given move (n_w,) of the plan.
        """
        if not (math.isfinite(self.value) and all_finite(self.slopes)):
            return []
        smooth = self._loss.kink <= KINK and (along is None or not along.any() or self._loss.kink_along(along) <= KINK)
        return [] if smooth else [LOSS_KINK]


def parameter_kinks(problem: OCP, solution: Solution) -> list[str]:
    """One failure message if derivatives of stage functions by psi jump at a plan, else none."""
    x = by_stage(solution.states, solution.actions)
    if not np.isfinite(x).all() or parameter_jump(problem, x, solution.psi, solution.context) <= KINK:
        return []
    return [PARAMETER_KINK]


def kinks_at(problem: OCP, loss: Loss, data: Array, solution: Solution) -> list[str]:
    """Failure messages if the loss, or a stage function of psi, is not smooth at a plan.

    data: (n_data, T+1) of the loss.
    """
    plan = by_stage(solution.states, solution.actions)
    return LossAt(problem, loss, data, plan).kinks() + parameter_kinks(problem, solution)


@lru_cache(maxsize=64)
def _loss_and_slopes(loss: Loss) -> Callable[[OCP], ca.Function]:
    """problem -> (S (n_s, T+1), U (n_u, T), data (n_data, T+1)) -> L, dL/dS (n_s, T+1), dL/dU (n_u, T)."""

    def build(problem: OCP) -> ca.Function:
        function = loss(problem)
        states, actions, data = (ca.MX.sym("x", *function.size_in(i)) for i in range(3))
        value = function(states, actions, data)
        outputs = [value, ca.gradient(value, states), ca.gradient(value, actions)]
        return ca.Function("loss_and_slopes", [states, actions, data], [ca.densify(x) for x in outputs])

    return build
