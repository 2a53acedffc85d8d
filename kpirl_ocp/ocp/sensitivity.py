"""The KKT system at a solution, and its adjoint solve.

    H wbar + A^T lambar + C^T mubar = r,    A wbar = 0,    C wbar = 0

H is the exact Hessian of the Lagrangian, A = (A_s, A_u) the Jacobian of the defects, C that of the active inequalities.
Condensing removes the dynamics: wbar = Z x with Z = (-A_s^{-1} A_u, I), a small dense system in the actions remains,
and its null space of C shows the second-order condition and the constraint qualification.

Smoothed with a barrier parameter tau every inequality stays, with mu_i slack_i = tau: C then holds all rows, H becomes
H + C^T diag(mu / slack) C, nothing is constrained, and mubar = diag(mu / slack) C wbar.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg

from kpirl_ocp.ocp.kkt import Inequalities, pack, transcribe
from kpirl_ocp.ocp.problem import OCP
from kpirl_ocp.types import Array, Indices, Mask, Solution


@dataclass(frozen=True)
class KKTSystem:
    """The matrices at a solution; w = (states, actions) with n_w entries.

    hessian: H (n_w, n_w) sparse. defects: A (T n_s, n_w) sparse.
    rows: C (n_rows, n_w), the inequalities that count.
    stiffness: (n_rows,) mu / slack when smoothed; None when the rows are active constraints.
    counted: (n_ineq,) bool, which inequalities the rows are: finite lower bounds of w, finite upper bounds, path.
    path_rows: which of the T n_h path constraints are among them; they are the last of the rows.
    n_path: T n_h.
    margin: smallest max(multiplier, slack) over the inequalities; infinite without any, or when smoothed.
    """

    hessian: scipy.sparse.csc_matrix
    defects: scipy.sparse.csc_matrix
    rows: Array
    stiffness: Array | None
    counted: Mask
    path_rows: Indices
    n_path: int
    margin: float

    @property
    def finite(self) -> bool:
        """True if no matrix holds NaN or infinity."""
        return all(np.isfinite(values).all() for values in (self.hessian.data, self.defects.data, self.rows))


@dataclass(frozen=True)
class Adjoint:
    """Solution of the adjoint system, and what was measured on the way.

    w: wbar (n_w,). dynamics: lambar (T n_s,). path: mubar of all path constraints (T n_h,), zero where not active.
    curvature: smallest eigenvalue of the reduced Hessian over the largest |eigenvalue| of the condensed Hessian.
    qualification: smallest singular value of the active rows of unit length in the actions; infinite without any.
    residual: of the linear system, relative to r.
    """

    w: Array
    dynamics: Array
    path: Array
    curvature: float
    qualification: float
    residual: float

    @classmethod
    def undefined(cls, right: Array, n_states: int, n_path: int) -> Adjoint:
        """NaN throughout: the system itself is not finite."""
        w, dynamics, path = (np.full(n, np.nan) for n in (len(right), n_states, n_path))
        return cls(w, dynamics, path, curvature=np.nan, qualification=np.nan, residual=np.nan)


def linearise(problem: OCP, psi: Array, context: Array, solution: Solution) -> KKTSystem:
    """Evaluate the KKT system; a row is active when its multiplier exceeds its slack (or it is an equality).

    Comparing the two, rather than either with a threshold, follows mu * slack -> 0: an inactive row with a tiny
    multiplier stays inactive, an active row with a tiny slack stays active.
    """
    nlp, w = transcribe(problem), pack(solution.trajectory)
    point = (w, solution.states[0], psi, context)
    multipliers = solution.multipliers
    matrices = nlp.second(*point, multipliers.dynamics.ravel(), multipliers.path.ravel())
    hessian, defects, path_jacobian = (matrix.sparse() for matrix in matrices)
    path = np.array(nlp.values(*point)[2]).ravel()
    inequalities = Inequalities.at(nlp, w, path, multipliers, solution.barrier)
    counted, stiffness, margin = _active(inequalities) if solution.barrier == 0 else _stiff(inequalities)
    return KKTSystem(
        hessian=hessian,
        defects=defects,
        rows=inequalities.jacobian(path_jacobian.toarray())[counted],
        stiffness=stiffness,
        counted=counted,
        path_rows=np.flatnonzero(counted[len(counted) - len(path) :]),
        n_path=len(path),
        margin=margin,
    )


def _active(inequalities: Inequalities) -> tuple[Mask, None, float]:
    """Active rows, no stiffness, and the strict-complementarity margin."""
    slack, multiplier, equal = inequalities.slack, inequalities.multiplier, inequalities.equal
    duplicate = equal & (np.arange(len(equal)) >= len(inequalities.rows_lower))  # the upper side of an equality
    margin = np.min(np.maximum(multiplier, slack)[~equal], initial=np.inf)
    return ((multiplier > slack) | equal) & ~duplicate, None, float(margin)


def _stiff(inequalities: Inequalities) -> tuple[Mask, Array, float]:
    """All rows, their stiffness mu / slack, and no margin to keep: the smoothed problem has no active set."""
    with np.errstate(divide="ignore", invalid="ignore"):
        stiffness = inequalities.multiplier / inequalities.slack
    return np.ones(len(stiffness), bool), stiffness, np.inf


def solve_adjoint(system: KKTSystem, right: Array, n_states: int) -> Adjoint:
    """Solve for r = right (n_w,); n_states = T n_s is how many of the entries of w are states.

    A singular reduced Hessian divides by zero: the result then holds infinities or NaN, and `curvature` says why.
    """
    state_factor = scipy.sparse.linalg.splu(system.defects[:, :n_states].tocsc())
    basis = _null_space_of_dynamics(system, state_factor, n_states)  # Z (n_w, T n_u)
    condensed = basis.T @ (system.hessian @ basis)
    rows = system.rows @ basis
    if system.stiffness is not None:
        condensed = condensed + rows.T @ (system.stiffness[:, None] * rows)
        rows = rows[:0]
    free, qualification = _null_space(rows)
    x, curvature = _solve_on(free, condensed, basis.T @ right)
    w = basis @ x
    if system.stiffness is not None:
        force = system.stiffness * (system.rows @ w)
    else:
        force = np.linalg.lstsq(rows.T, basis.T @ right - condensed @ x, rcond=None)[0]
    unbalanced = right - system.hessian @ w - system.rows.T @ force
    path = np.zeros(system.n_path)
    path[system.path_rows] = force[len(force) - len(system.path_rows) :]
    dynamics = state_factor.solve(unbalanced[:n_states], trans="T")
    return Adjoint(
        w=w,
        dynamics=dynamics,
        path=path,
        curvature=curvature,
        qualification=qualification,
        residual=_ratio(unbalanced - system.defects.T @ dynamics, right),
    )


def _null_space_of_dynamics(system: KKTSystem, state_factor: scipy.sparse.linalg.SuperLU, n_states: int) -> Array:
    """Z = (-A_s^{-1} A_u, I): how states follow the actions along the linearised dynamics."""
    by_actions = system.defects[:, n_states:].toarray()
    return np.vstack([-state_factor.solve(by_actions), np.eye(by_actions.shape[1])])


def _null_space(rows: Array) -> tuple[Array, float]:
    """Orthonormal null space of the rows, and the smallest singular value of the rows scaled to length one."""
    if not len(rows):
        return np.eye(rows.shape[1]), np.inf
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    unit = rows / np.where(lengths > 0, lengths, 1.0)
    _, singular, right = scipy.linalg.svd(unit)
    rank = int((singular > 1e-12).sum())
    return right[rank:].T, float(singular.min()) if len(rows) <= rows.shape[1] else 0.0


def _solve_on(free: Array, matrix: Array, right: Array) -> tuple[Array, float]:
    """Solve the symmetric system on the subspace `free`, and give the smallest relative eigenvalue there."""
    if not free.shape[1]:
        return np.zeros(len(right)), np.inf
    scale = np.abs(scipy.linalg.eigvalsh(matrix)).max()
    values, vectors = scipy.linalg.eigh(free.T @ matrix @ free)
    with np.errstate(divide="ignore", invalid="ignore"):
        x = free @ (vectors @ ((vectors.T @ (free.T @ right)) / values))
    return x, float(values.min() / scale) if scale > 0 else 0.0


def _ratio(part: Array, whole: Array) -> float:
    size = np.linalg.norm(whole)
    return float(np.linalg.norm(part) / size) if size > 0 else float(np.linalg.norm(part))
