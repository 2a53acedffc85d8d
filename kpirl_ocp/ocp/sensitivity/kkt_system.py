"""The KKT system at a solution, stage by stage.

    H x + A' lambda + C' mu = r,    A x = d,    C x = c

Unknowns are in the order of time, x = (s_0, u_0, s_1, .., s_T). H is the exact Hessian of the Lagrangian, A the
Jacobian of the defects, C that of equalities and active inequalities; all of them are products over stages.
`factorisation` solves it.

Smoothed with a barrier parameter tau, every inequality g <= 0 leaves C and adds mu / slack grad g grad g^T to H
instead, with mu = tau / slack; only equalities stay in C.

No unit counts: entries of x are compared with the largest size of their kind over the horizon, forces with the others
that they are in balance with, and decisions by the curvature that each has on its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kpirl_ocp.ocp.interior_point.core import borrow_core
from kpirl_ocp.ocp.problem.constraints import Inequalities
from kpirl_ocp.ocp.problem.layout import by_stage
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.solver import StageDerivatives, StageValues
from kpirl_ocp.ocp.sensitivity.linear_system import LinearSystem
from kpirl_ocp.ocp.sensitivity.rows import Rows, rows_of
from kpirl_ocp.types import Array, Mask, Solution

_NOTHING = 1e-9  # an entry of x that is smaller everywhere has no size of its own
_LEAST = 1e-12  # share of the largest curvature, in units of the cost, below which a decision has none of its own


@dataclass(frozen=True)
class Instance:
    """A problem with its numbers: s0 (n_s,), psi (n_psi,), context (n_c,), and barrier tau >= 0."""

    problem: OCP
    s0: Array
    psi: Array
    context: Array
    barrier: float = 0.0

    @classmethod
    def of(cls, problem: OCP, solution: Solution) -> Instance:
        """The one that was solved. Raises ProblemError when a length does not fit the problem."""
        s0, psi, context = problem.inputs(solution.states[0], solution.psi, solution.context)
        return cls(problem, s0, psi, context, solution.barrier)

    @property
    def rows(self) -> Rows:
        """The constraints but the dynamics."""
        return rows_of(self.problem)

    def values(self, point: PrimalDual) -> StageValues:
        """Constraints and the gradient of the Lagrangian at a point."""
        with borrow_core(self.problem) as core:
            return core.values_at(self.s0, self.psi, self.context, self._arguments(point))

    def derivatives(self, point: PrimalDual) -> StageDerivatives:
        """And second derivatives."""
        with borrow_core(self.problem) as core:
            return core.derivatives_at(self.s0, self.psi, self.context, self._arguments(point))

    def _arguments(self, point: PrimalDual) -> list[Array]:
        return [point.x, point.costates, *self.rows.split(point.forces)[1:]]


@dataclass(frozen=True)
class PrimalDual:
    """A point of the program: x (n_w,), costates (T n_s,), and multipliers of the rows (n_rows,)."""

    x: Array
    costates: Array
    forces: Array

    def plus(self, other: PrimalDual, factor: float = 1.0) -> PrimalDual:
        """This point moved along another."""
        pairs = ((self.x, other.x), (self.costates, other.costates), (self.forces, other.forces))
        return PrimalDual(*(one + factor * move for one, move in pairs))


@dataclass(frozen=True)
class KKTSystem:
    """First and second derivatives at a point; rows are listed as in `Rows`.

    linear: the linear algebra of these derivatives.
    slack: (n_rows,) of the inequalities; of equalities minus their value. Rows are the Jacobian of -slack.
    active: (n_rows,) which rows are constraints.
    stiffness: (n_rows,) mu / slack of smoothed rows, zero for the others.
    """

    instance: Instance
    point: PrimalDual
    derivatives: StageDerivatives
    linear: LinearSystem
    slack: Array
    active: Mask
    stiffness: Array

    @property
    def finite(self) -> bool:
        """True if no derivative holds NaN or infinity."""
        d = self.derivatives
        parts = (d.F, d.G, d.E, d.H, d.gradient, self.stiffness, self.point.x)
        return all(np.isfinite(part).all() for part in parts)

    @property
    def sizes(self) -> Array:
        """(n_w,) the largest absolute value of each entry of x over the horizon, finite bounds included."""
        return self.linear.sizes

    @property
    def curvature(self) -> Array:
        """(n_w,) an upper bound of the curvature of each entry of x within its own and the next stage."""
        return self.linear.curvature

    @cached_property
    def roots(self) -> Array:
        """(n_decisions,) of the curvature of each decision by itself, the largest over the horizon."""
        rows = self.instance.rows
        energy = self.curvature * self.sizes**2  # in the unit of the cost
        most = energy.max(initial=0.0)
        own = rows.largest_of_kind(energy)[rows.decisions]
        own = np.where(own > _LEAST * most, own, most or 1.0)
        return np.sqrt(own) / self.sizes[rows.decisions]

    @cached_property
    def pushing(self) -> Array:
        """Multipliers (n_rows,) of active and of smoothed rows, the latter tau / slack; zero for the others."""
        forces = np.where(self.active, self.point.forces, 0.0)
        if self.instance.barrier > 0:
            with np.errstate(divide="ignore"):
                forces = np.where(self.instance.rows.inequality, self.instance.barrier / self.slack, forces)
        return forces

    @cached_property
    def newton(self) -> list[Array]:
        """The right-hand side (r, d, c, s_0) of a Newton step from x, the costates and `pushing`."""
        instance, d = self.instance, self.derivatives
        missing = self.pushing.copy()  # the gradient holds the forces of path constraints and equalities
        missing[instance.rows.n_bounds :] -= self.point.forces[instance.rows.n_bounds :]
        unbalanced = d.gradient + self.linear.transposed_times(missing)
        return [-unbalanced, -d.defects, np.where(self.active, self.slack, 0.0), np.zeros(len(instance.s0))]

    @cached_property
    def successor_sizes(self) -> Array:
        """(T n_s,) the sizes of s_1 .. s_T."""
        n_s = len(self.instance.s0)
        return np.tile(self.sizes[-n_s:], self.instance.problem.horizon)

    def defects_along(self, x: Array) -> Array:
        """F_t x_t - s_{t+1} (T n_s,)."""
        n_s, n_x = len(self.instance.s0), self.instance.rows.n_x
        stages = x[:-n_s].reshape(-1, n_x)
        F = self.derivatives.F.reshape(-1, n_x, n_s)
        return ((stages[:, None, :] @ F)[:, 0] - np.vstack([stages[1:, :n_s], x[-n_s:]])).ravel()

    @property
    def constraint_sizes(self) -> Array:
        """Sizes that slacks of h, g_T, e and e_T are compared with; 1 for rows that nothing moves."""
        sizes = self.linear.row_sizes[self.instance.rows.n_bounds :]
        return np.where(sizes > 0, sizes, 1.0)

    def margins(self, forces: Array, slack: Array) -> Array:
        """(n_rows,) relative forces of active and relative slacks of inactive rows."""
        pushing = self.linear.relative_forces(forces, self.point.costates)
        return np.where(self.active, pushing, self.linear.relative_slacks(slack))


def primal_dual(instance: Instance, solution: Solution) -> PrimalDual:
    """The point of a solution."""
    known, rows = solution.multipliers, instance.rows
    x = by_stage(solution.states, solution.actions)
    listed = Inequalities.at(rows.bounds, x, np.zeros(0))  # g is not asked for, but its multipliers
    mu = np.concatenate([known.path.ravel(), known.terminal])
    nu = np.concatenate([known.path_equality.ravel(), known.terminal_equality])
    forces = listed.forces(by_stage(known.state, known.action), mu, solution.barrier)
    return PrimalDual(x, known.dynamics.ravel(), np.concatenate([forces, nu]))


def linearise(
    instance: Instance,
    point: PrimalDual,
    active: Mask | None = None,
    derivatives: StageDerivatives | None = None,
) -> KKTSystem:
    """Evaluate the KKT system at a point for an active set, by default the one that the point suggests.

    derivatives: at that point, where a solver ended with them.
    """
    rows = instance.rows
    d = derivatives or instance.derivatives(point)
    slack = np.concatenate([rows.bounds.slack(point.x), -d.path, -d.equality])
    stiffness = np.zeros(len(slack))
    if instance.barrier > 0:
        with np.errstate(divide="ignore", invalid="ignore"):
            stiffness = np.where(rows.inequality, instance.barrier / slack**2, 0.0)
    linear = LinearSystem(rows, d, sizes_of(rows, point.x))
    if active is None:
        active = rows.equality if instance.barrier > 0 else _active(rows, linear, point, slack)
    linear.select(active, stiffness)
    return KKTSystem(instance, point, d, linear, slack, active, stiffness)


def sizes_of(rows: Rows, x: Array) -> Array:
    """(n_w,) see `KKTSystem.sizes`."""
    largest = rows.largest_of_kind(np.maximum(np.abs(x), rows.largest_bound))
    return np.where(largest > _NOTHING, largest, 1.0)


def _active(rows: Rows, linear: LinearSystem, point: PrimalDual, slack: Array) -> Mask:
    """The active rows: equalities, and inequalities whose multiplier is above their slack, both relative.

    Comparing the two, rather than either with a threshold, follows mu * slack -> 0: an inactive row with a tiny
    multiplier stays inactive, an active row with a tiny slack stays active. Near a change of the active set the guess
    may be wrong; `kpirl_ocp.ocp.sensitivity.nearby_tests` finds out.
    """
    pushing = linear.relative_forces(point.forces, point.costates)
    return np.where(rows.inequality, (pushing > 0) & (pushing > linear.relative_slacks(slack)), rows.equality)
