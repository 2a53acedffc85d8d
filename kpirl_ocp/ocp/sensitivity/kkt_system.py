"""The KKT system at a solution, stage by stage.

    H w + A' lambda + C' mu = r_w,    A w = r_d,    C w = r_c

H is the exact Hessian of the Lagrangian, A the Jacobian of the defects, C that of the active inequalities; all of them
are products over stages, so that nothing here is larger than T blocks. `factorisation` solves it.

Smoothed with a barrier parameter tau, every inequality g <= 0 leaves C and adds mu / slack grad g grad g^T to H
instead, with mu = tau / slack; only equalities (coinciding bounds) stay in C.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kpirl_ocp.ocp.codegen.numpy_calls import call
from kpirl_ocp.ocp.conditions.nlp import bound_multipliers, bound_rows, pack
from kpirl_ocp.ocp.conditions.stage_derivatives import by_time, second
from kpirl_ocp.ocp.problem.constraints import Inequalities
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.problem.scope import refuse_features
from kpirl_ocp.ocp.problem.solver import StageDerivatives
from kpirl_ocp.types import Array, Mask, Solution


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
        """The one that was solved.

        Raises ProblemError when a length does not fit the problem, and for features beyond bounds and path constraints.
        """
        refuse_features(problem, "the derivative of a solution", "FiniteDifference(Ipopt())")
        s0, psi, context = problem.inputs(solution.states[0], solution.psi, solution.context)
        return cls(problem, s0, psi, context, solution.barrier)

    def at(self, w: Array) -> tuple[Array, Array, Array, Array]:
        """The arguments (S, U, psi, c), flat, that functions of `stage_derivatives` begin with."""
        split = self.problem.horizon * self.problem.n_states
        return np.concatenate([self.s0, w[:split]]), w[split:], self.psi, self.context

    def arguments(self, point: PrimalDual) -> tuple[Array, ...]:
        """The arguments (S, U, psi, c, Lambda, M), flat, of functions with a Lagrangian."""
        return *self.at(point.w), point.costates, self.path_forces(point.forces)

    def path_forces(self, forces: Array) -> Array:
        """The entries (T n_h,) of the path constraints in a list over all inequalities."""
        return forces[len(forces) - self.problem.horizon * self.problem.n_path :]


@dataclass(frozen=True)
class PrimalDual:
    """A point of the program: w (n_w,), costates (T n_s,), and multipliers >= 0 of the inequalities (n_ineq,)."""

    w: Array
    costates: Array
    forces: Array


@dataclass(frozen=True)
class KKTSystem:
    """First and second derivatives at a point; the inequalities are listed as in `Inequalities`.

    F, G, H: transposed blocks (T, n_x, n_s), (T, n_x, n_h), (T, n_x, n_x) of `stages.second`. H_last: (n_s, n_s).
    slack: (n_ineq,) of the inequalities; their rows are the Jacobian of -slack.
    gradient: of J + lambda.defects + mu.path (n_w,). defects: (T n_s,).
    active: (n_ineq,) which rows are constraints. equal: (n_ineq,) which of them are equalities.
    stiffness: (n_ineq,) mu / slack of smoothed rows, zero for the others.
    """

    instance: Instance
    point: PrimalDual
    F: Array
    G: Array
    H: Array
    H_last: Array
    gradient: Array
    defects: Array
    slack: Array
    active: Mask
    equal: Mask
    stiffness: Array

    @property
    def finite(self) -> bool:
        """True if no derivative holds NaN or infinity."""
        parts = (self.F, self.G, self.H, self.H_last, self.gradient, self.stiffness)
        return all(np.isfinite(part).all() for part in parts)

    @cached_property
    def matrices(self) -> list[Array]:
        """F, G, H and H_T, flat."""
        return [self.F.ravel(), self.G.ravel(), self.H.ravel(), self.H_last.ravel()]

    @cached_property
    def only_actions(self) -> bool:
        """True if every active row bounds an action."""
        entries = bound_rows(self.instance.problem).entries
        bounds, path = self.active[: len(entries)], self.active[len(entries) :]
        return not path.any() and not (entries[bounds] < len(self.defects)).any()

    @cached_property
    def local_curvature(self) -> float:
        """The largest |curvature| of one action within its own and the next stage, |R_ii + (B' Q_next B)_ii|.

        What eigenvalues of the reduced Hessian are measured by. The largest eigenvalue of the condensed Hessian would
        be no measure: with unstable dynamics it grows like the square of what they make of an action by the end.
        """
        n_s = len(self.H_last)
        B = self.F[:, n_s:]  # (T, n_u, n_s)
        following = np.concatenate([self.H[1:, :n_s, :n_s], self.H_last[None]])
        own = np.diagonal(self.H[:, n_s:, n_s:], axis1=1, axis2=2)
        return float(np.abs(own + ((B @ following) * B).sum(axis=2)).max(initial=0.0))

    @cached_property
    def pushing(self) -> Array:
        """Multipliers (n_ineq,) of active and of smoothed inequalities, the latter tau / slack; zero for the others."""
        forces = np.where(self.active, self.point.forces, 0.0)
        if self.instance.barrier > 0:
            with np.errstate(divide="ignore"):
                forces = np.where(self.equal, forces, self.instance.barrier / self.slack)
        return forces

    @cached_property
    def newton(self) -> tuple[Array, Array, Array]:
        """The right-hand side (r_w, r_d, r_c) of a Newton step from w, the costates and `pushing`."""
        missing = self.pushing.copy()  # the gradient holds the path constraints' forces
        self.instance.path_forces(missing)[:] -= self.instance.path_forces(self.point.forces)
        unbalanced = self.gradient + self.times_transposed_rows(missing)
        return -unbalanced, -self.defects, np.where(self.active, self.slack, 0.0)

    def times_rows(self, w: Array) -> Array:
        """rows w (n_ineq,)."""
        bounds = bound_rows(self.instance.problem)
        entries, signs = bounds.entries, bounds.signs
        if not self.G.size:
            return signs * w[entries]
        x, _ = self.by_stage(w)
        return np.concatenate([signs * w[entries], (x[:, None, :] @ self.G).ravel()])

    def times_transposed_rows(self, forces: Array) -> Array:
        """rows' forces (n_w,)."""
        bounds = bound_rows(self.instance.problem)
        steps, n_s, (_, n_x, n_h) = len(self.H), len(self.H_last), self.G.shape
        n_bounds = len(bounds.entries)
        pushed = bounds.net_force(forces[:n_bounds], steps * n_x)
        if n_h:
            pushed += self.flat((self.G @ forces[n_bounds:].reshape(steps, n_h, 1))[:, :, 0], np.zeros(n_s))
        return pushed

    def by_stage(self, w: Array) -> tuple[Array, Array]:
        """x_t (T, n_x) with zeros for the given s_0, and s_T (n_s,), of w (n_w,)."""
        steps, n_s, n_x = len(self.H), len(self.H_last), self.H.shape[1]
        x = np.zeros((steps, n_x))
        states = w[: steps * n_s].reshape(steps, n_s)
        x[1:, :n_s], x[:, n_s:] = states[:-1], w[steps * n_s :].reshape(steps, -1)
        return x, states[-1]

    def flat(self, x: Array, last: Array) -> Array:
        """w (n_w,) of x_t (T, n_x), of which s_0 is dropped, and s_T (n_s,)."""
        n_s = len(last)
        return np.concatenate([x[1:, :n_s].ravel(), last, x[:, n_s:].ravel()])


def primal_dual(instance: Instance, solution: Solution) -> PrimalDual:
    """The point of a solution."""
    w = pack(solution.trajectory)
    known = solution.multipliers
    rows = Inequalities.at(bound_rows(instance.problem), w, np.zeros(0))  # g is not asked for, but its multipliers
    forces = rows.forces(bound_multipliers(known), known.path.ravel(), solution.barrier)
    return PrimalDual(w, known.dynamics.ravel(), forces)


def linearise(
    instance: Instance,
    point: PrimalDual,
    active: Mask | None = None,
    derivatives: StageDerivatives | None = None,
) -> KKTSystem:
    """Evaluate the KKT system at a point for an active set, by default the one that the point suggests.

    derivatives: at that point, where a solver ended with them.
    """
    problem = instance.problem
    if derivatives is None:
        _, defects, path, _, _, *others = call(problem, second)(*instance.arguments(point))
        derivatives = [defects, path, *others]
    defects, path, r, r_last, F, G, H, H_last = derivatives
    steps, n_s, n_x = problem.horizon, problem.n_states, problem.n_states + problem.n_actions
    G = G.reshape(steps, n_x, problem.n_path)
    rows = Inequalities.at(bound_rows(problem), point.w, path)
    stiffness = np.zeros(len(rows.equal))
    if instance.barrier > 0:
        with np.errstate(divide="ignore", invalid="ignore"):
            stiffness = np.where(rows.equal, 0.0, instance.barrier / rows.slack**2)
    return KKTSystem(
        instance=instance,
        point=point,
        F=F.reshape(steps, n_x, n_s),
        G=G,
        H=H.reshape(steps, n_x, n_x),
        H_last=H_last.reshape(n_s, n_s),
        gradient=by_time(problem, r, r_last)[n_s:],
        defects=defects,
        slack=rows.slack,
        active=_active(instance, rows, point.forces) if active is None else active,
        equal=rows.equal,
        stiffness=stiffness,
    )


def _active(instance: Instance, rows: Inequalities, forces: Array) -> Mask:
    """The active inequalities: multiplier above slack, or an equality.

    Comparing the two, rather than either with a threshold, follows mu * slack -> 0: an inactive row with a tiny
    multiplier stays inactive, an active row with a tiny slack stays active. In badly chosen units the guess may be
    wrong; `kpirl_ocp.ocp.sensitivity.nearby_tests` finds out.
    """
    active = rows.equal.copy() if instance.barrier > 0 else (forces > rows.slack) | rows.equal
    upper = slice(rows.bounds.n_lower, None)
    active[upper] &= ~rows.equal[upper]  # an equality is listed with its lower bound, and here again
    return active


def scatter(active: Mask, values: Array) -> Array:
    """Values of the active rows in a list over all inequalities, zero elsewhere."""
    result = np.zeros(len(active))
    result[active] = values
    return result
