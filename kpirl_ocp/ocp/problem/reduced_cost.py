"""The cost as a function of the actions alone, J(u) = cost(rollout(s0, u), u), with gradient and Hessian products.

    dJ/du = r + f_u^T lambda                                     one rollout and one adjoint pass
    H du  = the tangent of dJ/du along (dS, du)                  one tangent and one more adjoint pass

The second also gives, at no further cost, d(du . dJ/du) with respect to the parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import casadi as ca

from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.trajectory_cost import Coefficients, TrajectoryCost
from kpirl_ocp.ocp.problem.trajectory_passes import Adjoint, Memory, Rollout, TrajectoryPasses


class Linearisation(NamedTuple):
    """The cost at given actions: J (1, B), dJ/dU (n_u, T B), the rollout and the adjoint with its costates."""

    value: ca.MX
    gradient: ca.MX
    rollout: Rollout
    adjoint: Adjoint


class Product(NamedTuple):
    """H dU (n_u, T B), and the derivatives of dU . dJ/dU by theta, and by psi through the dynamics alone."""

    by_actions: ca.MX
    by_coefficients: Coefficients
    by_parameters: ca.MX


@dataclass(frozen=True, eq=False)
class ReducedCost:
    """J of B trajectories side by side, as expressions; see `trajectory_passes` for the order of columns."""

    problem: OCP
    columns: int = 1
    cost: TrajectoryCost = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "cost", TrajectoryCost(self.problem, self.columns))

    @cached_property
    def passes(self) -> TrajectoryPasses:
        """The forward and adjoint passes of the dynamics."""
        return self.problem.dynamics_derivatives.passes(self.problem.horizon, self.columns)

    def linearise(self, s0: ca.MX, actions: ca.MX, psi: ca.MX, theta: Coefficients) -> Linearisation:
        """The cost and its gradient at actions (n_u, T B)."""
        rollout = self.passes.rollout(s0, actions, psi)
        value, by_states, by_actions = self.cost.first(rollout.states, actions, theta)
        adjoint = self.passes.adjoint(rollout, psi, by_states)
        return Linearisation(value, by_actions + adjoint.by_actions, rollout, adjoint)

    def hessian_product(self, rollout: Rollout, memory: Memory, psi: ca.MX, theta: Coefficients, dU: ca.MX) -> Product:
        """The product for a direction dU (n_u, T B), at a rollout and with the memory of its adjoint."""
        dS = self.passes.tangent(rollout, psi, dU)
        by_states, by_actions, by_theta = self.cost.second(rollout.states, rollout.actions, theta, dS.states, dU)
        adjoint = self.passes.adjoint_tangent(rollout, psi, memory, dS, dU, by_states)
        return Product(by_actions + adjoint.by_actions, by_theta, adjoint.by_parameters)


def reduced_symbols(problem: OCP, columns: int = 1) -> tuple[ca.MX, ca.MX, ca.MX, ca.MX]:
    """Symbols U (n_u, T B), s0 (n_s, B), psi (n_psi, B) and c (n_c, B)."""
    return (
        ca.MX.sym("U", problem.n_actions, problem.horizon * columns),
        ca.MX.sym("s0", problem.n_states, columns),
        ca.MX.sym("psi", problem.n_parameters, columns),
        ca.MX.sym("c", problem.n_context, columns),
    )
