"""The KKT system at a solution, stage by stage.

    H w + A' lambda + C' mu = r_w,    A w = r_d,    C w = r_c

H is the exact Hessian of the Lagrangian, A the Jacobian of the defects, C that of the active inequalities; all of them
are products over stages, so that nothing here is larger than T blocks. `kpirl_ocp.ocp.factorisation` solves it.

Smoothed with a barrier parameter tau, every inequality g <= 0 leaves C and adds mu / slack grad g grad g^T to H
instead, with mu = tau / slack; only equalities (coinciding bounds) stay in C.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import scipy.sparse

from kpirl_ocp.ocp.calls import call
from kpirl_ocp.ocp.kkt import NLP, Inequalities, pack, transcribe
from kpirl_ocp.ocp.problem import OCP
from kpirl_ocp.ocp.stages import by_time, first, second, values
from kpirl_ocp.types import Array, Indices, Mask, Solution


@dataclass(frozen=True)
class Instance:
    """A problem with its numbers: s0 (n_s,), psi (n_psi,), context (n_c,), and barrier tau >= 0."""

    problem: OCP
    s0: Array
    psi: Array
    context: Array
    barrier: float = 0.0

    @property
    def nlp(self) -> NLP:
        """The problem as a nonlinear program."""
        return transcribe(self.problem)

    def at(self, w: Array) -> tuple[Array, Array, Array, Array]:
        """The arguments (S, U, psi, c), flat, that functions of `kpirl_ocp.ocp.stages` begin with."""
        split = self.problem.horizon * self.problem.n_states
        return np.concatenate([self.s0, w[:split]]), w[split:], self.psi, self.context

    def path_forces(self, forces: Array) -> Array:
        """The entries (T n_h,) of the path constraints in a list over all inequalities."""
        return forces[len(forces) - self.problem.horizon * self.problem.n_path :]

    def gradient(self, point: PrimalDual) -> Array:
        """Gradient (n_w,) of J + lambda.defects + mu.path."""
        outputs = call(self.problem, first)(*self.at(point.w), point.costates, self.path_forces(point.forces))
        return by_time(self.problem, outputs[5], outputs[6])[self.problem.n_states :]


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
    rows: Jacobian of the inequalities' values -slack (n_ineq, n_w), sparse. slack: (n_ineq,).
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
    rows: scipy.sparse.csr_matrix
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
    def constraints(self) -> scipy.sparse.csr_matrix:
        """C (n_active, n_w)."""
        return self.rows[np.flatnonzero(self.active)]

    @cached_property
    def transposed_constraints(self) -> scipy.sparse.csc_matrix:
        """C' (n_w, n_active)."""
        return self.constraints.T

    @cached_property
    def transposed_rows(self) -> scipy.sparse.csc_matrix:
        """(n_w, n_ineq)."""
        return self.rows.T

    @cached_property
    def only_actions(self) -> bool:
        """True if every active row bounds an action."""
        first = len(self.active) - self.G.shape[0] * self.G.shape[2]  # path constraint
        return not self.active[first:].any() and not (self.constraints.indices < len(self.defects)).any()

    def with_rows(self, H: Array, H_last: Array, weights: Array) -> tuple[Array, Array]:
        """H + rows' diag(weights) rows, as blocks (T, n_x, n_x) and (n_s, n_s); weights (n_ineq,)."""
        (steps, _, n_h), n_x = self.G.shape, H.shape[1]
        split = len(weights) - steps * n_h
        bounds, path = weights[:split], weights[split:].reshape(steps, 1, n_h)
        diagonal, last = self.by_stage(self._add_bounds(bounds))
        result = H + (self.G * path) @ self.G.transpose(0, 2, 1) if n_h else H.copy()
        result[:, np.arange(n_x), np.arange(n_x)] += diagonal
        return result, H_last + np.diag(last)

    def _add_bounds(self, weights: Array) -> Array:
        """Sum (n_w,) of the weights of all bounds on an entry of w."""
        return np.bincount(self.rows.indices[: len(weights)], weights, self.rows.shape[1]).astype(float)

    def row_variances(self, covariance: Array, last: Array) -> Array:
        """row . Cov . row (n_ineq,) for covariances of x_t (T, n_x, n_x) and of s_T (n_s, n_s)."""
        split = len(self.active) - self.G.shape[0] * self.G.shape[2]
        variances = self.flat(np.diagonal(covariance, axis1=1, axis2=2), np.diag(last))
        path = np.einsum("tih,tij,tjh->th", self.G, covariance, self.G)
        return np.concatenate([variances[self.rows.indices[:split]], path.ravel()])

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

    def times_hessian(self, w: Array) -> Array:
        """H w (n_w,), without stiffness."""
        x, last = self.by_stage(w)
        return self.flat((self.H @ x[:, :, None])[:, :, 0], self.H_last @ last)

    def times_jacobian(self, w: Array) -> Array:
        """A w (T n_s,)."""
        x, _ = self.by_stage(w)
        return (x[:, None, :] @ self.F).ravel() - w[: len(self.defects)]

    def times_transposed_jacobian(self, costates: Array) -> Array:
        """A' lambda (n_w,)."""
        n_s = len(self.H_last)
        product = self.flat((self.F @ costates.reshape(-1, n_s, 1))[:, :, 0], np.zeros(n_s))
        product[: len(costates)] -= costates
        return product

    def times_stiff_hessian(self, w: Array) -> Array:
        """(H + rows' stiffness rows) w (n_w,)."""
        if self.instance.barrier == 0:
            return self.times_hessian(w)
        return self.times_hessian(w) + self.transposed_rows @ (self.stiffness * (self.rows @ w))


def primal_dual(instance: Instance, solution: Solution) -> tuple[PrimalDual, Mask]:
    """The point of a solution, and its active inequalities: multiplier above slack, or an equality.

    Comparing the two, rather than either with a threshold, follows mu * slack -> 0: an inactive row with a tiny
    multiplier stays inactive, an active row with a tiny slack stays active. In badly chosen units the guess may be
    wrong; `kpirl_ocp.ocp.probe` finds out.
    """
    w = pack(solution.trajectory)
    rows = Inequalities.at(instance.nlp, w, call(instance.problem, values)(*instance.at(w))[2])
    forces = rows.forces(solution.multipliers, solution.barrier)
    duplicate = rows.equal & (np.arange(len(rows.equal)) >= len(rows.lower))  # the upper side of an equality
    active = rows.equal if solution.barrier > 0 else (forces > rows.slack) | rows.equal
    return PrimalDual(w, solution.multipliers.dynamics.ravel(), forces), active & ~duplicate


def linearise(instance: Instance, point: PrimalDual, active: Mask) -> KKTSystem:
    """Evaluate the KKT system at a point for a given active set."""
    problem, mu = instance.problem, instance.path_forces(point.forces)
    outputs = call(problem, second)(*instance.at(point.w), point.costates, mu)
    _, defects, path, _, _, r, r_last, F, G, H, H_last = outputs
    steps, n_s, n_x = problem.horizon, problem.n_states, problem.n_states + problem.n_actions
    G = G.reshape(steps, n_x, problem.n_path)
    rows = Inequalities.at(instance.nlp, point.w, path)
    smoothed = ~rows.equal if instance.barrier > 0 else np.zeros(len(rows.equal), bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        stiffness = np.where(smoothed, instance.barrier / rows.slack**2, 0.0)
    return KKTSystem(
        instance=instance,
        point=point,
        F=F.reshape(steps, n_x, n_s),
        G=G,
        H=H.reshape(steps, n_x, n_x),
        H_last=H_last.reshape(n_s, n_s),
        rows=rows.jacobian(_path_jacobian(problem, G)),
        gradient=by_time(problem, r, r_last)[n_s:],
        defects=defects,
        slack=rows.slack,
        active=active,
        equal=rows.equal,
        stiffness=stiffness,
    )


def _path_jacobian(problem: OCP, G: Array) -> scipy.sparse.csr_matrix:
    """Jacobian of the path constraints (T n_h, n_w) from its transposed blocks (T, n_x, n_h)."""
    kept, columns, starts = _path_pattern(problem)
    values = G.transpose(0, 2, 1).ravel()[kept]
    shape = (len(starts) - 1, problem.horizon * (problem.n_states + problem.n_actions))
    return scipy.sparse.csr_matrix((values, columns, starts), shape)


@lru_cache(maxsize=64)
def _path_pattern(problem: OCP) -> tuple[Indices, Indices, Indices]:
    """Which entries of the blocks (T, n_h, n_x) are in the Jacobian, their columns in w, and where its rows start."""
    steps, n_s, n_u = problem.horizon, problem.n_states, problem.n_actions
    columns = np.full((steps, n_s + n_u), -1)  # where x_t is in w; s_0 is not
    columns[1:, :n_s] = np.arange((steps - 1) * n_s).reshape(steps - 1, n_s)
    columns[:, n_s:] = steps * n_s + np.arange(steps * n_u).reshape(steps, n_u)
    by_row = np.repeat(columns, problem.n_path, axis=0)  # (T n_h, n_x)
    starts = np.concatenate([[0], np.cumsum((by_row >= 0).sum(axis=1))])
    kept = np.flatnonzero(by_row.ravel() >= 0)
    return kept, by_row.ravel()[kept], starts


def scatter(active: Mask, values: Array) -> Array:
    """Values of the active rows in a list over all inequalities, zero elsewhere."""
    result = np.zeros(len(active))
    result[active] = values
    return result
