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

from kpirl_ocp.ocp.problem import OCP


@lru_cache(maxsize=64)
def factorise(problem: OCP) -> ca.Function:
    """(F, H, H_T (n_s, n_s)) -> P_1..P_T (n_s, n_s T), W (n_u, n_u T), Y (n_u, n_s T), pivots (n_u, T).

    A pivot that is zero makes everything before its stage infinite or NaN.
    """
    n_s, n_u, n_x, steps = _sizes(problem)
    P, F, H = ca.MX.sym("P", n_s, n_s), ca.MX.sym("F", n_s, n_x), ca.MX.sym("H", n_x, n_x)
    M = H + F.T @ (P @ F)
    W, pivots = _inverse_root(n_u)(M[n_s:, n_s:])
    Y = W @ M[n_s:, :n_s]
    before = M[:n_s, :n_s] - Y.T @ (ca.repmat(ca.sign(pivots), 1, n_s) * Y)
    stage = ca.Function("factor_stage", [P, F, H], [(before + before.T) / 2, W, Y, pivots])

    F, H, last = ca.MX.sym("F", n_s, n_x * steps), ca.MX.sym("H", n_x, n_x * steps), ca.MX.sym("H_T", n_s, n_s)
    P, W, Y, pivots = stage.mapaccum(steps)(last, _reversed(F, n_x), _reversed(H, n_x))
    P = _reversed(ca.horzcat(last, P[:, : n_s * (steps - 1)]), n_s)
    outputs = [P, _reversed(W, n_u), _reversed(Y, n_s), _reversed(pivots, 1)]
    return ca.Function("factorise", [F, H, last], outputs)


@lru_cache(maxsize=64)
def substitute(problem: OCP) -> ca.Function:
    """(F, P, W, Y, pivots, q (n_x, T), q_T (n_s,), d (n_s, T), s_0) -> s (n_s, T+1), u (n_u, T), lambda (n_s, T)."""
    n_s, n_u, n_x, steps = _sizes(problem)
    p, s = ca.MX.sym("p", n_s), ca.MX.sym("s", n_s)
    F, P = ca.MX.sym("F", n_s, n_x), ca.MX.sym("P", n_s, n_s)
    W, Y = ca.MX.sym("W", n_u, n_u), ca.MX.sym("Y", n_u, n_s)
    q, d, v, pivots = ca.MX.sym("q", n_x), ca.MX.sym("d", n_s), ca.MX.sym("v", n_u), ca.MX.sym("D", n_u)
    J = ca.sign(pivots)
    m = q + F.T @ (P @ d + p)
    w_m = W @ m[n_s:]
    backward = ca.Function("backward_stage", [p, F, P, W, Y, pivots, q, d], [m[:n_s] - Y.T @ (J * w_m), w_m])
    u = -(W.T @ (J * (Y @ s + v)))
    forward = ca.Function("forward_stage", [s, F, W, Y, pivots, v, d], [F @ ca.vertcat(s, u) + d, u])

    F, P = ca.MX.sym("F", n_s, n_x * steps), ca.MX.sym("P", n_s, n_s * steps)
    W, Y = ca.MX.sym("W", n_u, n_u * steps), ca.MX.sym("Y", n_u, n_s * steps)
    q, last, d = ca.MX.sym("q", n_x, steps), ca.MX.sym("q_T", n_s), ca.MX.sym("d", n_s, steps)
    pivots = ca.MX.sym("D", n_u, steps)
    widths = ((F, n_x), (P, n_s), (W, n_u), (Y, n_s), (pivots, 1), (q, 1), (d, 1))
    stages = [_reversed(x, width) for x, width in widths]
    p, v = backward.mapaccum(steps)(last, *stages)
    p = _reversed(ca.horzcat(last, p[:, : steps - 1]), 1)  # p_1 .. p_T
    after, u = forward.mapaccum(steps)(s, F, W, Y, pivots, _reversed(v, 1), d)
    outputs = [ca.horzcat(s, after), u, _stagewise_product(n_s, steps)(P, after) + p]
    return ca.Function("substitute", [F, P, W, Y, pivots, q, last, d, s], outputs)


def _sizes(problem: OCP) -> tuple[int, int, int, int]:
    """n_s, n_u, n_x and T."""
    n_s, n_u = problem.n_states, problem.n_actions
    return n_s, n_u, n_s + n_u, problem.horizon


def _stagewise_product(n: int, steps: int) -> ca.Function:
    """(P (n, n T), s (n, T)) -> the columns P_t s_t (n, T)."""
    P, s = ca.MX.sym("P", n, n), ca.MX.sym("s", n)
    return ca.Function("product", [P, s], [P @ s]).map(steps)


def _reversed(x: ca.MX, width: int) -> ca.MX:
    """The blocks of `width` columns in reversed order."""
    return _reversal(x.size1(), width, x.size2() // width)(x)


@lru_cache(maxsize=512)
def _reversal(rows: int, width: int, count: int) -> ca.Function:
    """Reversal in groups of groups: short C code, where a long list would keep the compiler busy."""
    x = ca.MX.sym("x", rows, width * count)
    group = 1 if count <= 10 else -(-count // 10)
    parts = ca.horzsplit(x, group * width)
    backwards = [part if group == 1 else _reversed(part, width) for part in reversed(parts)]
    return ca.Function(f"reversal_{count}", [x], [ca.horzcat(*backwards)])


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
    slope = H @ x + F.T @ lam
    backward = ca.Function("roll_back", [lam, F, H, x], [slope[:n_s], slope[n_s:]])

    F, H, last = ca.MX.sym("F", n_s, n_x * steps), ca.MX.sym("H", n_x, n_x * steps), ca.MX.sym("H_T", n_s, n_s)
    u = ca.MX.sym("u", n_u, steps)
    after = forward.mapaccum(steps)(ca.MX.zeros(n_s), F, u)
    x = ca.vertcat(ca.horzcat(ca.MX.zeros(n_s, 1), after[:, : steps - 1]), u)
    stages = [_reversed(part, width) for part, width in ((F, n_x), (H, n_x), (x, 1))]
    product = backward.mapaccum(steps)(last @ after[:, steps - 1], *stages)[1]
    return ca.Function("condense", [F, H, last, u], [_reversed(product, 1)])
