"""The cost of a trajectory and its first and second derivatives, stage by stage.

    l(s, u; psi, c, d) = l'(s, u; theta),    theta = coefficients(psi, c, d)

theta collects every part of the stage cost that does not depend on state or action: for the keypoint costs the row of
weights W = B g(Psi), the effort and the goal. It is computed once, however often the trajectory changes; derivatives
with respect to theta are summed up likewise, and pulled back to psi once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.statement.expressions import inputs_of


@dataclass(frozen=True, eq=False)
class StageCost:
    """One stage.

    coefficients: (psi, c, d) -> theta (n_theta,).
    first: (s, u, theta) -> l, l_s (n_s,), l_u (n_u,).
    second: (s, u, theta, ds, du) -> derivatives of m = l_s . ds + l_u . du by s (n_s,), u (n_u,), theta (n_theta,).
    hessian: (s, u, theta) -> l, its gradient (n_x,) and its second derivative (n_x, n_x), sparse, by x = (s, u).
    """

    coefficients: ca.Function
    first: ca.Function
    second: ca.Function
    hessian: ca.Function

    @classmethod
    def of(cls, cost: ca.Function) -> StageCost:
        """From a stage cost l(s, u, psi, c, d)."""
        s, u, psi, c, d = inputs_of(cost)
        kind = type(s)
        ds, du = kind.sym("ds", s.numel()), kind.sym("du", u.numel())
        value, names, parts = ca.extract_parametric(
            ca.densify(cost(s, u, psi, c, d)), ca.vertcat(psi, c, d), {"extract_trivial": True}
        )
        parts, names = ca.vertcat(kind(0, 1), *map(ca.vec, parts)), ca.vertcat(kind(0, 1), *map(ca.vec, names))
        theta = kind.sym("theta", names.numel())
        (value,) = ca.substitute([value], [names], [theta]) if theta.numel() else [value]
        slopes = [ca.densify(ca.gradient(value, x)) for x in (s, u)]
        slope = ca.vertcat(*slopes)
        hessian = ca.horzcat(*(ca.jacobian(slope, x) for x in (s, u)))
        change = ca.dot(slopes[0], ds) + ca.dot(slopes[1], du)
        return cls(
            coefficients=ca.Function("coefficients", [psi, c, d], [ca.densify(parts)]),
            first=ca.Function("first", [s, u, theta], [value, *slopes]),
            second=ca.Function(
                "second", [s, u, theta, ds, du], [ca.densify(ca.gradient(change, x)) for x in (s, u, theta)]
            ),
            hessian=ca.Function("hessian", [s, u, theta], ca.cse([value, slope, hessian])),
        )


class Coefficients(NamedTuple):
    """Coefficients theta for B trajectories: stages (n_theta, T B), last (n_theta_T, B)."""

    stages: ca.MX
    last: ca.MX


@dataclass(frozen=True, eq=False)
class TrajectoryCost:
    """The cost of B trajectories at once; columns are ordered by time, then by trajectory.

    S (n_s, (T+1) B), U (n_u, T B), psi (n_psi, B), c (n_c, B). All methods write expressions.
    """

    problem: OCP
    columns: int

    def coefficients(self, psi: ca.MX, context: ca.MX) -> Coefficients:
        """The coefficients theta of all stages."""
        T, B = self.problem.horizon, self.columns
        stages, last = coefficients_of(self.problem).map(B)(psi, context)
        if B == 1 or not stages.numel():
            return Coefficients(ca.reshape(stages, stages.size1() // T, T * B), last)
        return Coefficients(ca.horzcat(*ca.vertsplit(stages, stages.size1() // T)), last)

    def first(self, S: ca.MX, U: ca.MX, theta: Coefficients) -> tuple[ca.MX, ca.MX, ca.MX]:
        """J (1, B), dJ/dS and dJ/dU."""
        T, B = self.problem.horizon, self.columns
        running, final = stage_costs(self.problem)
        costs, by_s, by_u = running.first.map(T * B)(S[:, : T * B], U, theta.stages)
        last, by_last, _ = final.first.map(B)(S[:, T * B :], ca.MX(0, B), theta.last)
        return ca.sum2(ca.reshape(costs, B, T)).T + last, ca.horzcat(by_s, by_last), by_u

    def second(
        self, S: ca.MX, U: ca.MX, theta: Coefficients, dS: ca.MX, dU: ca.MX
    ) -> tuple[ca.MX, ca.MX, Coefficients]:
        """Derivatives of dJ/dS . dS + dJ/dU . dU by S, U and theta."""
        T, B = self.problem.horizon, self.columns
        running, final = stage_costs(self.problem)
        by_s, by_u, by_theta = running.second.map(T * B)(S[:, : T * B], U, theta.stages, dS[:, : T * B], dU)
        empty = ca.MX(0, B)
        by_last, _, by_theta_last = final.second.map(B)(S[:, T * B :], empty, theta.last, dS[:, T * B :], empty)
        return ca.horzcat(by_s, by_last), by_u, Coefficients(by_theta, by_theta_last)

    def first_along(self, S: ca.MX, U: ca.MX, theta: Coefficients, dtheta: Coefficients) -> tuple[ca.MX, ca.MX]:
        """Changes of dJ/dS and dJ/dU along dtheta."""
        T, B = self.problem.horizon, self.columns
        running, final = (_first_along(cost.first) for cost in stage_costs(self.problem))
        by_s, by_u = running.map(T * B)(S[:, : T * B], U, theta.stages, dtheta.stages)
        by_last, _ = final.map(B)(S[:, T * B :], ca.MX(0, B), theta.last, dtheta.last)
        return ca.horzcat(by_s, by_last), by_u


@lru_cache(maxsize=64)
def stage_costs(problem: OCP) -> tuple[StageCost, StageCost]:
    """The stage and the terminal cost, the latter as a stage without an action."""
    final = problem.terminal_cost
    s, psi, c, d = inputs_of(final)
    without_action = ca.Function("terminal_cost", [s, type(s).sym("u", 0), psi, c, d], [final(s, psi, c, d)])
    return StageCost.of(problem.stage_cost), StageCost.of(without_action)


@lru_cache(maxsize=64)
def _first_along(first: ca.Function) -> ca.Function:
    """(s, u, theta, dtheta) -> changes of l_s (n_s,) and l_u (n_u,)."""
    s, u, theta = inputs_of(first)
    dtheta = type(s).sym("dtheta", theta.numel())
    changes = [ca.densify(ca.jtimes(slope, theta, dtheta)) for slope in first(s, u, theta)[1:]]
    return ca.Function("first_along", [s, u, theta, dtheta], changes)


_LARGE = 5e6  # largest number of operations that are written out stage by stage
GROUP = 16  # stages in one function: compilers take more than twice the time for one of twice the length


@lru_cache(maxsize=64)
def coefficients_of(problem: OCP) -> ca.Function:
    """(psi, c) -> theta (n_theta T,) of all stages, theta_T (n_theta_T,).

    With the schedule's numbers in it, where that can be written out: most of them are zeros, and then a weight per step
    takes O(T) operations for all steps together.
    """
    T, schedule = problem.horizon, ca.DM(np.asarray(problem.schedule, float)).T  # (n_d, T+1)
    running, final = (cost.coefficients for cost in stage_costs(problem))
    psi, context = ca.MX.sym("psi", problem.n_parameters), ca.MX.sym("c", problem.n_context)
    if all(f.is_a("SXFunction") for f in (running, final)) and T * running.n_instructions() <= _LARGE:
        ends = [*range(0, T, GROUP), T]
        pieces = [_piece(running, schedule[:, begin:end]) for begin, end in pairwise(ends)]
        stages = ca.vertcat(*(piece(psi[used], context) for piece, used in pieces))
        piece, used = _piece(final, schedule[:, T])
        last = piece(psi[used], context)
    else:
        wide = ca.repmat(psi, 1, T), ca.repmat(context, 1, T), schedule[:, :T]
        stages, last = ca.vec(running.map(T)(*wide)), final(psi, context, schedule[:, T])
    return ca.Function("coefficients", [psi, context], [stages, last])


def _piece(coefficients: ca.Function, schedule: ca.DM) -> tuple[ca.Function, list[int]]:
    """(psi[used], c) -> theta of some stages, with the numbers (n_d, ..) of their schedule in it; and what is used."""
    psi, context = (ca.SX.sym(name, coefficients.size1_in(i)) for i, name in enumerate(("psi", "c")))
    stages = ca.vertcat(*(coefficients(psi, context, ca.sparsify(d)) for d in ca.horzsplit(schedule)))
    _, columns = ca.jacobian_sparsity(stages, psi).get_triplet()
    used = sorted(set(columns))
    return ca.Function("piece", [psi[used], context], ca.cse([stages])), used
