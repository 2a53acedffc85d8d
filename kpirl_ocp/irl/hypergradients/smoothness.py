"""Kinks of the map from psi to the loss that its gradient does not see: of the loss, the observation, and in psi.

CasADi's derivative of |x| at 0 is 0, of a step everywhere: only values beside a point tell.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.irl.hypergradients.loss import Loss
from kpirl_ocp.ocp.codegen.numpy_calls import call
from kpirl_ocp.ocp.problem.layout import by_stage, split
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.sensitivity.certificate import KINK
from kpirl_ocp.ocp.sensitivity.kkt_system import sizes_of
from kpirl_ocp.ocp.sensitivity.nearby_tests import kink_of_loss, parameter_jump
from kpirl_ocp.ocp.sensitivity.rows import rows_of
from kpirl_ocp.types import Array, Solution, Trajectory

LOSS_KINK = "The loss or the observation sits on a kink at this plan: use smooth ones (squares, softplus, tanh)."
PARAMETER_KINK = "Costs, constraints or dynamics have a kink or a jump at these parameters: use smooth ones."


class LossAt:
    """A loss for one demonstration, whose data (n_data, T+1) are given."""

    def __init__(self, problem: OCP, loss: Loss, data: Array) -> None:
        self._problem, self._data = problem, data.T
        self._evaluate = call(problem, _loss_and_slopes(loss))

    def __call__(self, x: Array) -> Array:
        """The loss and its slopes (n_w,) at x (n_w,), in one array."""
        problem = self._problem
        states, actions = split(x, problem.horizon, problem.n_states, problem.n_actions)
        value, by_states, by_actions = self._evaluate(states, actions, self._data)
        return np.concatenate([value, by_stage(by_states.reshape(states.shape), by_actions.reshape(actions.shape))])

    def kinks(self, plan: Trajectory) -> list[str]:
        """A sentence if the loss is not smooth at a plan. A given s_0 does not move with psi."""
        problem, x = self._problem, by_stage(plan.states, plan.actions)
        sizes = sizes_of(rows_of(problem), x).copy()
        sizes[: problem.n_states] *= problem.free_start
        if not np.isfinite(self(x)).all() or kink_of_loss(self, x, sizes) <= KINK:
            return []
        return [LOSS_KINK]


def parameter_kinks(problem: OCP, solution: Solution) -> list[str]:
    """A sentence if derivatives of stage functions by psi jump at a plan, whatever the adjoint makes of them."""
    x = by_stage(solution.states, solution.actions)
    if not np.isfinite(x).all() or parameter_jump(problem, x, solution.psi, solution.context) <= KINK:
        return []
    return [PARAMETER_KINK]


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
