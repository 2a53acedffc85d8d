"""The implicit function theorem in dense linear algebra: an independent reference for `sensitivity`.

One KKT matrix of all unknowns, its derivatives by CasADi's AD of the whole program, numpy's LU.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.conditions.program import transcribe
from kpirl_ocp.ocp.problem.constraints import BoundRows, Inequalities
from kpirl_ocp.ocp.problem.layout import (
    bound_multipliers,
    equality_multipliers,
    given,
    inequality_multipliers,
    limits,
    pack,
)


def derivative(problem, solution):
    """d(free s_0, s_1 .. s_T, u_0 .. u_{T-1})/d(psi, s_0, c), with the active set of `solution`, or smoothed.

    Columns of s_0 (n_s) that belong to free entries are zero.
    """
    program, multipliers, fixed = transcribe(problem), solution.multipliers, given(problem)
    w, nu = pack(solution.trajectory), bound_multipliers(multipliers)
    lam, mu = equality_multipliers(multipliers), inequality_multipliers(multipliers)
    cost, g_E, g_I = program.values(*program.symbols)
    slope = ca.gradient(cost + ca.dot(lam, g_E) + ca.dot(mu, g_I), program.symbols[0])
    blocks = [ca.jacobian(x, y) for x in (slope, g_E, g_I) for y in program.symbols]
    evaluate = ca.Function("blocks", program.symbols, [*map(ca.densify, blocks), g_I])
    *blocks, g = map(np.array, evaluate(w, solution.psi, solution.context))

    start = np.arange(len(w)) < problem.n_states

    def split(by_w, by_psi, by_context):
        """Columns of the unknowns, and those of psi, s_0 and c."""
        return by_w[:, ~fixed], np.hstack([by_psi, by_w[:, start] * fixed[start], by_context])

    (H, H_p), (A, A_p), (G, G_p) = (split(*blocks[i : i + 3]) for i in (0, 3, 6))
    A, A_p = A[program.live], A_p[program.live]
    H, H_p = H[~fixed], H_p[~fixed]
    rows = Inequalities.at(BoundRows.of(*limits(problem)), w, g.ravel())
    forces = rows.forces(nu, mu, solution.barrier)
    C = np.vstack([(rows.bounds.signs[:, None] * np.eye(len(w))[rows.bounds.entries])[:, ~fixed], G])
    C_p = np.vstack([np.zeros((len(C) - len(G), H_p.shape[1])), G_p])
    if solution.barrier > 0:
        stiff = np.where(rows.equal, 0.0, solution.barrier / rows.slack**2)[:, None]
        H, H_p = H + C.T @ (stiff * C), H_p + C.T @ (stiff * C_p)
        C, C_p = C[:0], C_p[:0]
    else:
        C, C_p = C[forces > rows.slack], C_p[forces > rows.slack]
    m = len(A) + len(C)
    K = np.block([[H, A.T, C.T], [np.vstack([A, C]), np.zeros((m, m))]])
    return -np.linalg.solve(K, np.vstack([H_p, A_p, C_p]))[: len(H)]


def unknowns(problem, states, actions):
    """(free s_0, s_1 .. s_T, u_0 .. u_{T-1}) of a trajectory or slopes, in the order of the rows of `derivative`."""
    return np.concatenate([states[0][problem.free_start], states[1:].ravel(), actions.ravel()])
