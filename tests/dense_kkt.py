"""The implicit function theorem in dense linear algebra: an independent reference for `implicit_function`.

One KKT matrix of all unknowns, its derivatives by CasADi's AD of the whole program, numpy's LU.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.conditions.nlp import Inequalities, pack, transcribe


def derivative(problem, s0, psi, context, solution):
    """dw/d(psi, s_0, c) (n_w, n_psi + n_s + n_c) with the active set of `solution`, or smoothed with its barrier."""
    nlp = transcribe(problem)
    w, lam, mu = pack(solution.trajectory), solution.multipliers.dynamics.ravel(), solution.multipliers.path.ravel()
    symbols = [nlp.symbols[name] for name in ("w", "s0", "psi", "c")]
    parameters = ca.vertcat(*(symbols[i] for i in (2, 1, 3)))
    cost, defects, path = nlp.values(*symbols)
    slope = ca.gradient(cost + ca.dot(lam, defects) + ca.dot(mu, path), symbols[0])
    blocks = [ca.jacobian(x, y) for x in (slope, defects, path) for y in (symbols[0], parameters)]
    evaluate = ca.Function("blocks", symbols, [*map(ca.densify, blocks), path])
    H, H_p, A, A_p, G, G_p, h = map(np.array, evaluate(w, s0, psi, context))

    rows = Inequalities.at(nlp, w, h.ravel())
    forces = rows.forces(solution.multipliers, solution.barrier)
    C = np.vstack([rows.bounds.signs[:, None] * np.eye(len(w))[rows.bounds.entries], G])
    C_p = np.vstack([np.zeros((len(C) - len(G), H_p.shape[1])), G_p])
    if solution.barrier > 0:
        stiff = np.where(rows.equal, 0.0, solution.barrier / rows.slack**2)[:, None]
        H, H_p = H + C.T @ (stiff * C), H_p + C.T @ (stiff * C_p)
        C, C_p = C[:0], C_p[:0]
    else:
        C, C_p = C[forces > rows.slack], C_p[forces > rows.slack]
    m = len(A) + len(C)
    K = np.block([[H, A.T, C.T], [np.vstack([A, C]), np.zeros((m, m))]])
    return -np.linalg.solve(K, np.vstack([H_p, A_p, C_p]))[: len(w)]
