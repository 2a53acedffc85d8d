"""A backward Riccati recursion that tells whether a Hessian is positive definite on the null space of the dynamics."""

from __future__ import annotations

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array

Places = list[Array]  # indices into w, one array for each stage


def least_pivot(problem: OCP, jacobian: ca.MX, hessian: ca.MX, weight: ca.MX) -> ca.MX:
    """The smallest pivot of a Hessian (n_w, n_w) plus a weight on the diagonal for actions and free entries of s_0.

    All pivots are positive exactly if the matrix is positive definite on the null space of the defects' Jacobian.

    hessian: block-diagonal, one block for each stage.
    """
    n_s, n_u, steps = problem.n_states, problem.n_actions, problem.horizon
    states, stages = _states(problem), _stages(problem)
    curvature, slopes = blocks(hessian, stages, stages), blocks(jacobian, states[:-1], stages)
    backwards = [ca.horzcat(*ca.horzsplit(wide, n_s + n_u)[::-1]) for wide in (curvature, slopes)]
    end = blocks(hessian, states[-1:], states[-1:])
    costs, pivots = _step(n_s, n_u).mapaccum(steps)(end, *backwards, ca.repmat(weight, 1, steps))
    free = np.flatnonzero(problem.free_start).tolist()
    first = costs[:, (steps - 1) * n_s :][free, free] + weight * ca.MX.eye(len(free))
    return ca.mmin(ca.horzcat(pivots, _eliminate(0, len(free))(first)[1]))


def costates(problem: OCP, jacobian: ca.MX, slope: ca.MX) -> ca.MX:
    """Multipliers (T n_s,) of the defects with which the Lagrangian's gradient by s_1 .. s_T vanishes.

    slope: (n_w,) gradient of the cost.
    """
    n_s, steps, states = problem.n_states, problem.horizon, _states(problem)
    by_state = ca.reshape(ca.densify(slope)[: (steps + 1) * n_s], n_s, steps + 1)
    if steps == 1:
        return by_state[:, 1]
    costate, slopes, cost = ca.MX.sym("costate", n_s), ca.MX.sym("slopes", n_s, n_s), ca.MX.sym("cost", n_s)
    step = ca.Function("adjoint", [costate, slopes, cost], [slopes.T @ costate + cost])
    order = slice(steps - 1, 0, -1)
    backwards = blocks(jacobian, states[order], states[order]), by_state[:, list(range(steps - 1, 0, -1))]
    found = ca.horzcat(by_state[:, steps], step.mapaccum(steps - 1)(by_state[:, steps], *backwards))
    return ca.vec(found[:, list(range(steps))[::-1]])


def blocks(matrix: ca.MX, rows: Places, columns: Places) -> ca.MX:
    """The dense blocks of a sparse matrix at these rows and columns, side by side."""
    grids = [np.meshgrid(r, c) for r, c in zip(rows, columns, strict=True)]
    r, c = (np.concatenate([grid[k].ravel() for grid in grids]) for k in (0, 1))
    pattern = ca.Sparsity.triplet(*matrix.shape, r.tolist(), c.tolist())
    stored = np.empty(len(r), int)
    stored[np.lexsort((r, c))] = np.arange(len(r))
    return ca.reshape(ca.project(matrix, pattern).nz[stored.tolist()], len(rows[0]), -1)


def _states(problem: OCP) -> Places:
    return list(np.arange((problem.horizon + 1) * problem.n_states).reshape(-1, problem.n_states))


def _stages(problem: OCP) -> Places:
    """Indices of (s_t, u_t) for t = 0 .. T-1."""
    states = _states(problem)
    actions = len(states) * problem.n_states + np.arange(problem.horizon * problem.n_actions)
    pairs = zip(states[:-1], actions.reshape(problem.horizon, -1), strict=True)
    return [np.concatenate(pair) for pair in pairs]


def _step(n_s: int, n_u: int) -> ca.Function:
    """(P of s_next, Hessian of (s, u), (f_s, f_u), weight) -> P of s, smallest pivot."""
    P, H = ca.MX.sym("P", n_s, n_s), ca.MX.sym("H", n_s + n_u, n_s + n_u)
    F, weight = ca.MX.sym("F", n_s, n_s + n_u), ca.MX.sym("weight")
    on_actions = ca.diag(np.repeat([0.0, 1.0], [n_s, n_u]))
    return ca.Function("back", [P, H, F, weight], _eliminate(n_s, n_u)(H + F.T @ P @ F + weight * on_actions))


def _eliminate(n_kept: int, n_gone: int) -> ca.Function:
    """A symmetric matrix -> the Schur complement (n_kept, n_kept) left by eliminating the last rows, smallest pivot."""
    n = n_kept + n_gone
    given = ca.SX.sym("M", n, n)
    M = [[given[i, j] for j in range(i + 1)] for i in range(n)]
    for k in range(n - 1, n_kept - 1, -1):
        for i in range(k):
            share = M[k][i] / M[k][k]
            for j in range(i + 1):
                M[i][j] -= share * M[k][j]
    kept = ca.SX(n_kept, n_kept)
    for i in range(n_kept):
        for j in range(i + 1):
            kept[i, j] = kept[j, i] = M[i][j]
    pivots = [M[k][k] for k in range(n_kept, n)]
    least = ca.mmin(ca.vertcat(*pivots)) if pivots else ca.SX.inf()
    return ca.Function("eliminate", [given], [ca.densify(kept), least])
