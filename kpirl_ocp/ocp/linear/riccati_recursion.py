"""The Riccati recursion: solve a linear-quadratic problem over T stages in O(T) time and memory.

    minimise  sum_t  1/2 x_t' H_t x_t + q_t' x_t  +  1/2 s_T' H_T s_T + q_T' s_T,      x_t = (s_t, u_t)
    subject to  s_{t+1} = F_t x_t + d_t,   s_0 given

With the value function 1/2 s' P_t s + p_t' s of the stages from t on, backwards from P_T = H_T, p_T = q_T:

    M = H_t + F_t' P_{t+1} F_t,    m = q_t + F_t' (P_{t+1} d_t + p_{t+1})
    M_uu = L D L',   W = |D|^{-1/2} L^{-1},   Y = W M_us,    v = W m_u,   J = sign(D)
    P_t = M_ss - Y' J Y,   p_t = m_s - Y' J v

and forwards u_t = -W' J (Y s_t + v), with the costate lambda_t = P_{t+1} s_{t+1} + p_{t+1} of s_{t+1} = ... .
There are as many negative pivots in all D as the Hessian along the dynamics has negative eigenvalues: it has a
minimum exactly when all are positive. Otherwise the same formulas lead to its stationary point.

Only the dimensions of a problem matter here. Matrices of all stages lie side by side, F is (n_s, n_x T) and H is
(n_x, n_x T); vectors are columns.
"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca

from kpirl_ocp.ocp.problem.columns import scan
from kpirl_ocp.ocp.problem.ocp import OCP


@lru_cache(maxsize=64)
def factorise(problem: OCP) -> ca.Function:
    """(F, H, H_T (n_s, n_s)) -> P_1..P_T (n_s, n_s T), W (n_u, n_u T), Y (n_u, n_s T), pivots (n_u, T).

    A pivot that is zero makes everything before its stage infinite or NaN.
    """
    n_s, n_u, n_x, steps = _sizes(problem)
    P, F, H = ca.MX.sym("P", n_s, n_s), ca.MX.sym("F", n_s, n_x), ca.MX.sym("H", n_x, n_x)
    M = ca.mac(F.T, P @ F, H)
    W, pivots = _inverse_root(n_u)(M[n_s:, n_s:])
    Y = W @ M[n_s:, :n_s]
    before = M[:n_s, :n_s] - Y.T @ (ca.repmat(ca.sign(pivots), 1, n_s) * Y)
    stage = ca.Function("factor_stage", [P, F, H], [(before + before.T) / 2, W, Y, pivots])

    F, H, last = ca.MX.sym("F", n_s, n_x * steps), ca.MX.sym("H", n_x, n_x * steps), ca.MX.sym("H_T", n_s, n_s)
    P, W, Y, pivots = scan(stage, last, [F, H], steps, backwards=True)
    return ca.Function("factorise", [F, H, last], [ca.horzcat(P[:, n_s:], last), W, Y, pivots])


@lru_cache(maxsize=64)
def substitute(problem: OCP) -> ca.Function:
    """(F, P, W, Y, pivots, q (n_x, T), q_T (n_s,), d (n_s, T), s_0) -> s (n_s, T+1), u (n_u, T), lambda (n_s, T).

    Vectors stand on the left of what is transposed: x' A needs no A'.
    """
    n_s, n_u, n_x, steps = _sizes(problem)
    p, s = ca.MX.sym("p", n_s), ca.MX.sym("s", n_s)
    F, P = ca.MX.sym("F", n_s, n_x), ca.MX.sym("P", n_s, n_s)
    W, Y = ca.MX.sym("W", n_u, n_u), ca.MX.sym("Y", n_u, n_s)
    q, d, v, pivots = ca.MX.sym("q", n_x), ca.MX.sym("d", n_s), ca.MX.sym("v", n_u), ca.MX.sym("D", n_u)
    J = ca.sign(pivots)
    m = ca.mac(ca.mac(P, d, p).T, F, q.T).T
    w_m = W @ m[n_s:]
    before = m[:n_s] - ((J * w_m).T @ Y).T
    backward = ca.Function("backward_stage", [p, F, P, W, Y, pivots, q, d], [before, w_m])
    u = -((J * ca.mac(Y, s, v)).T @ W).T
    after = ca.mac(F, ca.vertcat(s, u), d)
    forward = ca.Function("forward_stage", [s, F, P, W, Y, pivots, v, d, p], [after, u, ca.mac(P, after, p)])

    F, P = ca.MX.sym("F", n_s, n_x * steps), ca.MX.sym("P", n_s, n_s * steps)
    W, Y = ca.MX.sym("W", n_u, n_u * steps), ca.MX.sym("Y", n_u, n_s * steps)
    q, last, d = ca.MX.sym("q", n_x, steps), ca.MX.sym("q_T", n_s), ca.MX.sym("d", n_s, steps)
    pivots = ca.MX.sym("D", n_u, steps)
    p, v = scan(backward, last, [F, P, W, Y, pivots, q, d], steps, backwards=True)
    p = ca.horzcat(p[:, 1:], last)  # p_1 .. p_T
    states, u, costates = scan(forward, s, [F, P, W, Y, pivots, v, d, p], steps)
    return ca.Function("substitute", [F, P, W, Y, pivots, q, last, d, s], [ca.horzcat(s, states), u, costates])


def factor_symbols(problem: OCP) -> list[ca.MX]:
    """P, W, Y and pivots."""
    n_s, n_u, _, steps = _sizes(problem)
    shapes = {"P": (n_s, n_s * steps), "W": (n_u, n_u * steps), "Y": (n_u, n_s * steps), "pivots": (n_u, steps)}
    return [ca.MX.sym(name, *shape) for name, shape in shapes.items()]


def _sizes(problem: OCP) -> tuple[int, int, int, int]:
    """n_s, n_u, n_x and T."""
    n_s, n_u = problem.n_states, problem.n_actions
    return n_s, n_u, n_s + n_u, problem.horizon


@lru_cache(maxsize=64)
def _inverse_root(n: int) -> ca.Function:
    """M (n, n), its lower triangle -> W = |D|^{-1/2} L^{-1} and the pivots, the diagonal of D (n,), of M = L D L'."""
    M = ca.SX.sym("M", n, n)
    L = ca.SX.eye(n)
    d: list[ca.SX] = []
    for j in range(n):
        d.append(M[j, j] - sum((L[j, k] ** 2 * d[k] for k in range(j)), ca.SX(0)))
        for i in range(j + 1, n):
            L[i, j] = (M[i, j] - sum((L[i, k] * L[j, k] * d[k] for k in range(j)), ca.SX(0))) / d[j]
    inverse = ca.SX.eye(n)  # of L
    for i in range(n):
        for j in range(i):
            inverse[i, j] = -sum((L[i, k] * inverse[k, j] for k in range(j, i)), ca.SX(0))
    pivots = ca.vertcat(*d)
    return ca.Function("inverse_root", [M], [ca.densify(ca.diag(1 / ca.sqrt(ca.fabs(pivots))) @ inverse), pivots])


@lru_cache(maxsize=64)
def condense(problem: OCP) -> ca.Function:
    """(F, H, H_T, u (n_u, T)) -> Z' H Z u (n_u, T), where Z u = (s, u) follows the dynamics from s_0 = 0."""
    n_s, n_u, n_x, steps = _sizes(problem)
    s, u, lam = ca.MX.sym("s", n_s), ca.MX.sym("u", n_u), ca.MX.sym("lambda", n_s)
    F, H, x = ca.MX.sym("F", n_s, n_x), ca.MX.sym("H", n_x, n_x), ca.MX.sym("x", n_x)
    forward = ca.Function("roll", [s, F, u], [F @ ca.vertcat(s, u)])
    slope = ca.mac(lam.T, F, x.T @ H).T
    backward = ca.Function("roll_back", [lam, F, H, x], [slope[:n_s], slope[n_s:]])

    F, H, last = ca.MX.sym("F", n_s, n_x * steps), ca.MX.sym("H", n_x, n_x * steps), ca.MX.sym("H_T", n_s, n_s)
    u = ca.MX.sym("u", n_u, steps)
    (after,) = scan(forward, ca.MX.zeros(n_s), [F, u], steps)
    x = ca.vertcat(ca.horzcat(ca.MX.zeros(n_s, 1), after[:, : steps - 1]), u)
    product = scan(backward, last @ after[:, steps - 1], [F, H, x], steps, backwards=True)[1]
    return ca.Function("condense", [F, H, last, u], [product])
