"""Gradient and Hessian of a cost in the actions, at demonstrated actions, for costs that are linear in psi.

    J(u; psi) = J_0(u) + sum_j psi_j J_j(u),    u = the demonstrated actions

Methods that take the demonstration for a (nearly) optimal motion need nothing else, and never plan.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Demonstration

_LINEAR = 1e-8  # relative tolerance of the test for linearity


@dataclass(frozen=True, eq=False)
class DemonstratedConditions:
    """Derivatives of one demonstration by its actions (n = T n_u numbers), as functions of psi.

    gradients: (n, n_psi) of the J_j. gradient: (n,) of J_0. hessians: (n_psi, n, n). hessian: (n, n).
    """

    gradients: Array
    gradient: Array
    hessians: Array
    hessian: Array

    @classmethod
    def at(cls, problem: OCP, demonstration: Demonstration, actions: Array) -> DemonstratedConditions:
        """Of actions (T, n_u), from the demonstration's start.

        Raises ProblemError for bounds and constraints, and if the cost is not linear in psi.
        """
        if problem.has_action_bounds or problem.has_state_constraints:
            raise ProblemError("this method handles no constraints but the dynamics: pass problem.unconstrained().")
        functions = _derivatives(problem)
        u = problem.as_actions(actions).ravel()
        points = np.vstack([np.zeros(problem.n_parameters), np.eye(problem.n_parameters)])
        values = [functions(u, demonstration.s0, psi, demonstration.context) for psi in points]
        slopes, curvatures = (np.array([dense(value[k]) for value in values]) for k in (0, 1))
        found = cls(
            gradients=(slopes[1:, :, 0] - slopes[0, :, 0]).T,
            gradient=slopes[0, :, 0],
            hessians=curvatures[1:] - curvatures[0],
            hessian=curvatures[0],
        )
        twice = dense(functions(u, demonstration.s0, 2.0 * np.ones(len(points) - 1), demonstration.context)[0])
        expected = found.gradient + 2 * found.gradients.sum(axis=1)
        if not np.allclose(twice[:, 0], expected, rtol=_LINEAR, atol=_LINEAR * np.abs(slopes).max()):
            raise ProblemError("this method needs a cost that is linear in psi: positivity='identity' for keypoints.")
        return found


def conditions(
    problem: OCP, demonstrations: Sequence[Demonstration], actions: Sequence[Array]
) -> list[DemonstratedConditions]:
    """Of every demonstration with its actions (T, n_u)."""
    if not demonstrations or len(demonstrations) != len(actions):
        raise ProblemError(f"{len(demonstrations)} demonstrations with {len(actions)} arrays of actions.")
    pairs = zip(demonstrations, actions, strict=True)
    return [DemonstratedConditions.at(problem, demonstration, taken) for demonstration, taken in pairs]


@lru_cache(maxsize=16)
def _derivatives(problem: OCP) -> ca.Function:
    """(u (T n_u,), s0, psi, c) -> gradient (n, 1) and Hessian (n, n) of the cost in u."""
    u = ca.MX.sym("u", problem.horizon * problem.n_actions)
    s0, psi = ca.MX.sym("s0", problem.n_states), ca.MX.sym("psi", problem.n_parameters)
    context = ca.MX.sym("c", problem.n_context)
    actions = ca.reshape(u, problem.n_actions, problem.horizon)
    cost = problem.cost(problem.rollout(s0, actions, psi, context), actions, psi, context)
    hessian, gradient = ca.hessian(cost, u)
    outputs = [ca.densify(gradient), ca.densify(hessian)]
    return ca.Function("derivatives", [u, s0, psi, context], outputs)
