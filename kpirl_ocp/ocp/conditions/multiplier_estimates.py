"""Least-squares estimates of the multipliers at a plan, for solvers whose own do not fit the plan that they reached.

    min |grad_w J + A' lambda + N' mu|^2 + |slack mu|^2     over lambda, and over mu >= 0

with the Jacobians A of the live equalities and N of the inequalities, each as -slack <= 0, the bounds first. These are
residuals that `audit` measures, so that no active set has to be guessed. Equalities take what lies in the range of A';
what is orthogonal to it is left to mu, by non-negative least squares (Lawson and Hanson, 1974, chapter 23).
"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.conditions.program import transcribe
from kpirl_ocp.ocp.problem.constraints import BoundRows, Inequalities
from kpirl_ocp.ocp.problem.guards import dense
from kpirl_ocp.ocp.problem.layout import given, limits, pack, unpack_multipliers
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Multipliers, Trajectory

_NEAR = 0.1  # multipliers are zero where the slack is larger: their product, which has to be small, shows them
# Weight that keeps multipliers of dependent equalities finite, relative to the largest slope squared.
_DEPENDENT = 1e-12


def estimate_multipliers(problem: OCP, psi: Array, context: Array, trajectory: Trajectory) -> Multipliers | None:
    """The multipliers of least KKT residuals at a trajectory; whether they are small is for `audit` to say.

    None where a derivative is not finite, or where the active sets of the least squares go round in circles.
    """
    w, bounds, decided = pack(trajectory), BoundRows.of(*limits(problem)), np.flatnonzero(~given(problem)).tolist()
    slope, A, g, g_w = _slopes(problem)(w, psi, context)
    slack = Inequalities.at(bounds, w, dense(g).ravel()).slack
    near = np.flatnonzero(slack <= _NEAR)
    normals = ca.vertcat(_sides(bounds, len(w)), g_w)[near.tolist(), :]
    columns, slopes = ca.horzcat(slope, normals.T)[decided, :], A.T[decided, :]
    if not (columns.is_regular() and slopes.is_regular()):
        return None
    taken = _least_squares(slopes, columns)
    found = _non_negative(dense(columns - slopes @ taken), slack[near])
    if found is None:
        return None
    mu = np.zeros(len(slack))
    mu[near] = found
    forces, of_rows = np.split(mu, [len(bounds.entries)])
    lam = -dense(taken) @ np.append(1.0, found)
    return unpack_multipliers(problem, bounds.net_force(forces, len(w)), lam, of_rows)


def _non_negative(columns: Array, slack: Array) -> Array | None:
    """mu >= 0 (k,) of least |columns (1, mu)|^2 + |slack mu|^2, for columns (n, 1 + k); None without an end."""
    from scipy.optimize import nnls

    if not len(slack):  # for which scipy's ends the process
        return slack
    try:
        return np.asarray(nnls(np.vstack([columns[:, 1:], np.diag(slack)]), np.append(-columns[:, 0], 0 * slack))[0])
    except RuntimeError:  # too many iterations
        return None


def _least_squares(slopes: ca.DM, columns: ca.DM) -> ca.DM:
    """y (n_live, k) of least |columns - A' y|^2 for A' (n, n_live), columns (n, k); with one refinement."""
    n, m = slopes.shape
    weight = _DEPENDENT * max(1.0, float(ca.norm_inf(slopes))) ** 2
    system = ca.blockcat([[ca.DM.eye(n), slopes], [slopes.T, -weight * ca.DM.eye(m)]])

    def solve(right: ca.DM) -> ca.DM:
        return ca.solve(system, ca.vertcat(right, ca.DM(m, right.size2())), "qr")[n:, :]

    found = solve(columns)
    return found + solve(columns - slopes @ found)


def _sides(bounds: BoundRows, n_w: int) -> ca.DM:
    """The Jacobian (n_bounds, n_w) of -slack of the bounds."""
    n = len(bounds.entries)
    return ca.DM.triplet(list(range(n)), bounds.entries.tolist(), ca.DM(bounds.signs), n, n_w)


@lru_cache(maxsize=64)
def _slopes(problem: OCP) -> ca.Function:
    """(w, psi, c) -> grad J (n_w, 1), the Jacobian of the live g_E, g_I (n_ineq, 1), and its Jacobian."""
    program = transcribe(problem)
    objective, _, g = program.values(*program.symbols)
    w, n = program.symbols[0], program.n_equalities
    slopes = ca.jacobian(program.rows, w)
    return ca.Function("slopes", program.symbols, [ca.gradient(objective, w), slopes[:n, :], g, slopes[n:, :]])
