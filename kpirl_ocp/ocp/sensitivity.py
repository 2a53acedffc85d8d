"""The KKT system at a point, factorised once and solved for any right-hand side.

    H w + A^T lambda + C^T mu = r_w,    A w = r_d,    C w = r_c

H is the exact Hessian of the Lagrangian, A = (A_s, A_u) the Jacobian of the defects, C that of the active inequalities.
Condensing removes the dynamics: w = w_p + Z y with Z = (-A_s^{-1} A_u, I) leaves a small dense system in the actions,
and the null space of C Z shows the second-order condition and the constraint qualification.

Smoothed with a barrier parameter tau, every inequality g <= 0 leaves C and adds mu / slack grad g grad g^T to H
instead, with mu = tau / slack; only equalities (coinciding bounds) stay in C.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg

from kpirl_ocp.ocp.kkt import NLP, Inequalities, pack, transcribe
from kpirl_ocp.ocp.problem import OCP
from kpirl_ocp.types import Array, Mask, Solution

_RANK = 1e-12  # singular values of rows of length one below this are zero


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
        """The arguments (w, s0, psi, c) that functions of `NLP` begin with."""
        return w, self.s0, self.psi, self.context

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

    hessian: of J + lambda.defects + mu.path (n_w, n_w). jacobian: of the defects (T n_s, n_w).
    rows: Jacobian of the inequalities' values -slack (n_ineq, n_w). slack: (n_ineq,).
    gradient: of J + lambda.defects (n_w,). defects: (T n_s,).
    active: (n_ineq,) which rows are constraints. equal: (n_ineq,) which of them are equalities.
    stiffness: (n_ineq,) mu / slack of smoothed rows, zero for the others.
    """

    point: PrimalDual
    hessian: scipy.sparse.csc_matrix
    jacobian: scipy.sparse.csc_matrix
    rows: Array
    gradient: Array
    defects: Array
    slack: Array
    active: Mask
    equal: Mask
    stiffness: Array

    @property
    def finite(self) -> bool:
        """True if no derivative holds NaN or infinity."""
        parts = (self.hessian.data, self.jacobian.data, self.rows, self.gradient, self.stiffness)
        return all(np.isfinite(part).all() for part in parts)

    @property
    def n_defects(self) -> int:
        """T n_s, which is also how many entries of w are states."""
        return len(self.defects)


def primal_dual(instance: Instance, solution: Solution) -> tuple[PrimalDual, Mask]:
    """The point of a solution, and its active inequalities: multiplier above slack, or an equality.

    Comparing the two, rather than either with a threshold, follows mu * slack -> 0: an inactive row with a tiny
    multiplier stays inactive, an active row with a tiny slack stays active. In badly chosen units the guess may be
    wrong; `kpirl_ocp.ocp.probe` finds out.
    """
    w = pack(solution.trajectory)
    path = np.array(instance.nlp.values(*instance.at(w))[2]).ravel()
    rows = Inequalities.at(instance.nlp, w, path)
    forces = rows.forces(solution.multipliers, solution.barrier)
    duplicate = rows.equal & (np.arange(len(rows.equal)) >= len(rows.lower))  # the upper side of an equality
    active = rows.equal if solution.barrier > 0 else (forces > rows.slack) | rows.equal
    return PrimalDual(w, solution.multipliers.dynamics.ravel(), forces), active & ~duplicate


def linearise(instance: Instance, point: PrimalDual, active: Mask) -> KKTSystem:
    """Evaluate the KKT system at a point for a given active set."""
    nlp, arguments, mu = instance.nlp, instance.at(point.w), instance.path_forces(point.forces)
    hessian, jacobian, path_jacobian = (matrix.sparse() for matrix in nlp.second(*arguments, point.costates, mu))
    _, defects, path = (np.array(value).ravel() for value in nlp.values(*arguments))
    gradient = np.array(nlp.first(*arguments, point.costates, np.zeros_like(mu))[1]).ravel()
    rows = Inequalities.at(nlp, point.w, path)
    smoothed = ~rows.equal if instance.barrier > 0 else np.zeros(len(rows.equal), bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        stiffness = np.where(smoothed, instance.barrier / rows.slack**2, 0.0)
    return KKTSystem(
        point=point,
        hessian=hessian,
        jacobian=jacobian,
        rows=rows.jacobian(path_jacobian.toarray()),
        gradient=gradient,
        defects=defects,
        slack=rows.slack,
        active=active,
        equal=rows.equal,
        stiffness=stiffness,
    )


class Factorisation:
    """The factors of a KKT system.

    curvature: smallest eigenvalue of the reduced Hessian over the largest |eigenvalue| of the condensed one; infinite
        when the active constraints leave no freedom. softest: (n_w,) the direction of that eigenvalue, of length one.
    qualification: smallest singular value of the active rows in the actions, scaled to length one; infinite without.
    """

    def __init__(self, system: KKTSystem) -> None:
        n = system.n_defects
        self._system = system
        self._states = scipy.sparse.linalg.splu(system.jacobian[:, :n].tocsc())
        by_actions = system.jacobian[:, n:].toarray()
        self._basis = np.vstack([-self._states.solve(by_actions), np.eye(by_actions.shape[1])])  # Z
        self._active = system.rows[system.active]
        self._reduced_rows = self._active @ self._basis
        self._condensed = self._basis.T @ self._times_hessian(self._basis)
        self._free, self.qualification = _null_space(self._reduced_rows)
        self._values, self._vectors = scipy.linalg.eigh(self._free.T @ self._condensed @ self._free)
        scale = np.abs(scipy.linalg.eigvalsh(self._basis.T @ (system.hessian @ self._basis))).max()
        self.curvature = np.inf
        self.softest = np.zeros(len(system.gradient))
        if len(self._values):
            self.curvature = float(self._values[0] / scale) if scale > 0 else 0.0
            direction = self._basis @ (self._free @ self._vectors[:, 0])
            self.softest = direction / np.linalg.norm(direction)

    def solve(self, right: Array, defects: Array, active: Array) -> tuple[Array, Array, Array, float]:
        """w, lambda and mu of the active rows for (r_w, r_d, r_c), and the relative residual of the first row.

        A singular reduced Hessian divides by zero: infinities and NaN come out, and `curvature` says why.
        """
        n = self._system.n_defects
        start = np.concatenate([self._states.solve(defects), np.zeros(len(right) - n)])  # A w_p = r_d
        reduced = self._basis.T @ (right - self._times_hessian(start))
        step = np.linalg.lstsq(self._reduced_rows, active - self._active @ start, rcond=None)[0]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            slopes = self._vectors.T @ (self._free.T @ (reduced - self._condensed @ step))
            y = step + self._free @ (self._vectors @ (slopes / self._values))
            w = start + self._basis @ y
            forces = np.zeros(len(self._active))
            if len(forces) and np.isfinite(y).all():
                forces = np.linalg.lstsq(self._reduced_rows.T, reduced - self._condensed @ y, rcond=None)[0]
            unbalanced = right - self._times_hessian(w) - self._active.T @ forces
            costates = self._states.solve(unbalanced[:n], trans="T")
            error = np.linalg.norm(unbalanced - self._system.jacobian.T @ costates)
        return w, costates, forces, float(error / (np.linalg.norm(right) or 1.0))

    def _times_hessian(self, w: Array) -> Array:
        """(H + rows^T stiffness rows) w, for one column or many."""
        rows, stiffness = self._system.rows, self._system.stiffness
        return self._system.hessian @ w + rows.T @ ((stiffness * (rows @ w).T).T)


def _null_space(rows: Array) -> tuple[Array, float]:
    """Orthonormal null space of the rows, and the smallest singular value of the rows scaled to length one."""
    if not len(rows):
        return np.eye(rows.shape[1]), np.inf
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    _, singular, right = scipy.linalg.svd(rows / np.where(lengths > 0, lengths, 1.0))
    rank = int((singular > _RANK).sum())
    return right[rank:].T, float(singular.min()) if len(rows) <= rows.shape[1] else 0.0


def scatter(active: Mask, values: Array) -> Array:
    """Values of the active rows in a list over all inequalities, zero elsewhere."""
    result = np.zeros(len(active))
    result[active] = values
    return result
