"""Products with the second derivatives of the Lagrangian at a trajectory, for all stages at once, without matrices.

With L_t = l + lambda_t . f + mu_t . h as in `stage_derivatives`, these are the changes of grad L_t, f and h along
(dx, dlambda, dmu):

    H_t dx_t + F_t' dlambda_t + G_t' dmu_t,    F_t dx_t,    G_t dx_t.

They cost a few times what a gradient does, where the matrix H_t costs n_x times that.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import casadi as ca

from kpirl_ocp.ocp.conditions.stage_derivatives import (
    linearise_dynamics,
    pairing,
    pairing_gradient,
    stage_arguments,
    stage_gradient,
    symbols,
)
from kpirl_ocp.ocp.linear.stage_operators import by_stage, flat, len_x, matrices, path_product
from kpirl_ocp.ocp.problem.linearised_dynamics import LinearisedDynamics
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.trajectory_cost import Coefficients, TrajectoryCost


@dataclass(frozen=True, eq=False)
class Lagrangian:
    """The Lagrangian at S (n_s, T+1), U (n_u, T), psi, c, Lambda (n_s, T) and M (n_h, T)."""

    problem: OCP
    states: ca.MX
    actions: ca.MX
    psi: ca.MX
    context: ca.MX
    costates: ca.MX
    forces: ca.MX

    @cached_property
    def path_values(self) -> ca.MX:
        """h (n_h, T)."""
        return self.problem.path(self.states, self.actions, self.psi, self.context)

    def slope(self) -> ca.MX:
        """Gradient (n_w,) of J + lambda . f + mu . h; the successors' - lambda, which is constant, is left out."""
        by_states, by_actions = self._cost.first(self.states, self.actions, self._theta)[1:]
        slope = ca.vertcat(by_states[:, :-1], by_actions) + self._dynamics.Ft_lambda
        if self.problem.path_constraint is not None:
            path = stage_gradient(self.problem.path_constraint).map(self.problem.horizon)
            slope += path(*self._arguments, self.forces)
        return flat(self.problem, slope, by_states[:, -1])

    def path(self, x: ca.MX) -> ca.MX:
        """G_t x_t (n_h, T)."""
        if self.problem.path_constraint is None:
            return ca.MX(0, self.problem.horizon)
        return _path_push(self.problem.path_constraint).map(self.problem.horizon)(*self._arguments, x)

    def balance(self, x: ca.MX, last: ca.MX, costates: ca.MX, forces: ca.MX) -> tuple[ca.MX, ca.MX]:
        """H_t x_t + F_t' dlambda_t + G_t' dmu_t (n_x, T), and H_T s_T (n_s,)."""
        n_s, steps = self.problem.n_states, self.problem.horizon
        dS = ca.horzcat(x[:n_s, :], last)
        by_states, by_actions, _ = self._cost.second(self.states, self.actions, self._theta, dS, x[n_s:, :])
        balance = ca.vertcat(by_states[:, :-1], by_actions) + self._dynamics.Ft_lambda_tangent(x, costates)
        if self.problem.path_constraint is not None:
            path = _path_pull(self.problem.path_constraint).map(steps)
            balance += path(*self._arguments, self.forces, x, forces)
        return balance, by_states[:, -1]

    def F_times(self, x: ca.MX) -> ca.MX:
        """F_t x_t (n_s, T)."""
        return self._dynamics.F_times(x)

    @cached_property
    def _dynamics(self) -> LinearisedDynamics:
        return linearise_dynamics(self.problem, self.states, self.actions, self.psi, self.costates)

    @cached_property
    def _cost(self) -> TrajectoryCost:
        return TrajectoryCost(self.problem, 1)

    @cached_property
    def _theta(self) -> Coefficients:
        return self._cost.coefficients(self.psi, self.context)

    @cached_property
    def _arguments(self) -> list[ca.MX]:
        return stage_arguments(self.problem, self.states, self.actions, self.psi, self.context)


@lru_cache(maxsize=64)
def kink(problem: OCP) -> ca.Function:
    """(S, U, psi, c, Lambda, M, H, H_T, dw (n_w,), h) -> |d| and |d - H dw|.

    d: the central difference quotient of the Lagrangian's gradient along dw, h dw to either side.
    """
    (states, actions, *others), (*_, H, last) = at, _ = symbols(problem), matrices(problem)
    dw, h = ca.MX.sym("dw", problem.horizon * len_x(problem)), ca.MX.sym("h")
    x, end = by_stage(problem, dw)
    dS, dU = ca.horzcat(x[: problem.n_states, :], end), x[problem.n_states :, :]
    right, left = (Lagrangian(problem, states + k * dS, actions + k * dU, *others).slope() for k in (h, -h))
    difference = (right - left) / (2 * h)
    n_x = len_x(problem)
    product = flat(problem, path_product(n_x, n_x).map(problem.horizon)(H, x), last @ end)
    outputs = [ca.norm_2(difference), ca.norm_2(difference - product)]
    return ca.Function("kink", [*at, H, last, dw, h], [ca.vertcat(*outputs)])


def _path_push(path: ca.Function) -> ca.Function:
    """(s, u, psi, c, d, x) -> G x."""
    inputs, _, value = pairing(path)
    x = type(value).sym("x", inputs[0].numel() + inputs[1].numel())
    change = ca.jtimes(value, ca.vertcat(*inputs[:2]), x)
    return ca.Function("path_push", [*inputs, x], [ca.densify(change)])


def _path_pull(path: ca.Function) -> ca.Function:
    """(s, u, psi, c, d, mu, x, dmu) -> (mu . h)'' x + G' dmu."""
    inputs, mu, value = pairing(path)
    s, u = inputs[:2]
    x, dmu = (type(value).sym(name, size) for name, size in (("x", s.numel() + u.numel()), ("dmu", mu.numel())))
    changes = ca.jtimes(pairing_gradient(inputs, mu, value), ca.vertcat(s, u, mu), ca.vertcat(x, dmu))
    return ca.Function("path_pull", [*inputs, mu, x, dmu], [ca.densify(changes)])
