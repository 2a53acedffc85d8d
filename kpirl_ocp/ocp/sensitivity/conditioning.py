"""Outer eigenvalues of what belongs to a KKT system, by a few products each; see `kpirl_ocp.ocp.linear.lanczos`.

Lists of inequalities and matrices are those of `kpirl_ocp.ocp.linear.kkt_operators`.
"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.linear.lanczos import lanczos, magnitude, outermost
from kpirl_ocp.ocp.linear.riccati_recursion import condense, factor_symbols
from kpirl_ocp.ocp.linear.stage_operators import by_stage, flat, len_x, matrices
from kpirl_ocp.ocp.problem.columns import scan
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.ocp.sensitivity.kkt_operators import Stored, bound_columns, n_rows, rows, stiffened, transposed_rows

PRODUCTS = 5  # of a Lanczos process; more take another start
_FIRST_DIGITS = 3  # of them, where the first digits are enough
DEPENDENCE = 1e-11  # delta of `dependence_spectrum`: singular values are known to its square root


def condensed_scale(problem: OCP, F: ca.MX, H: ca.MX, last: ca.MX, start: ca.MX) -> ca.MX:
    """The largest |eigenvalue| of Z' H Z, to its first digits."""
    shape = problem.n_actions, problem.horizon

    def operator(u: ca.MX) -> ca.MX:
        return ca.vec(condense(problem)(F, H, last, ca.reshape(u, *shape)))

    diagonal, offdiagonal, _ = lanczos(operator, start, _FIRST_DIGITS)
    return magnitude(diagonal.numel())(diagonal, offdiagonal)


@lru_cache(maxsize=64)
def inverse_spectrum(problem: OCP) -> ca.Function:
    """(F, W, Y, pivots, start (T n_u,)) -> `largest_inverse`."""
    F, (_, *parts) = matrices(problem)[0], factor_symbols(problem)
    start = ca.MX.sym("start", problem.horizon * problem.n_actions)
    return ca.Function("inverse_spectrum", [F, *parts, start], largest_inverse(problem, F, parts, start))


def largest_inverse(problem: OCP, F: ca.MX, parts: list[ca.MX], start: ca.MX) -> list[ca.MX]:
    """The highest eigenvalue of the actions' part of the factorised inverse, or the lowest if a pivot is negative.

    And how far it is from one at most; its vector (T n_u,), from which to start again; and what the inverse makes of it
    (n_w,). parts: W, Y and pivots.
    """
    n = problem.horizon * problem.n_states
    reached: list[ca.MX] = []

    def operator(v: ca.MX) -> ca.MX:
        reached.append(_inverse(problem, F, parts, ca.vertcat(ca.MX.zeros(n), v)))
        return reached[-1][n:]

    diagonal, offdiagonal, basis = lanczos(operator, start, PRODUCTS)
    lowest = ca.sum1(ca.vec(parts[-1] < 0)) > 0
    value, error, coordinates = outermost(diagonal.numel())(diagonal, offdiagonal, lowest)
    return [value, error, basis @ coordinates, ca.horzcat(*reached) @ coordinates]


@lru_cache(maxsize=64)
def dependence_spectrum(problem: OCP) -> ca.Function:
    """(F, G, D (n_ineq,), start (n_ineq,)) -> value, error, vector (n_ineq,), from which to start again.

    The highest eigenvalue of (D C Z Z' C' D + delta)^{-1} as in `outermost`; D is 1 / length, or zero.

    Multipliers of the rows D C w = b with delta relaxation and cost |u|^2 / 2 are what this inverse makes of b: it is
    (1 - D C K C' D / delta) / delta with the inverse K of the effort and the relaxed rows, factorised.
    """
    F, G, *_ = matrices(problem)
    n_s, n_x = problem.n_states, len_x(problem)
    scale, start = ca.MX.sym("D", n_rows(problem)), ca.MX.sym("start", n_rows(problem))
    effort = ca.MX(ca.densify(ca.diag(ca.DM(np.arange(n_x) >= n_s))))
    _, *parts = stiffened(problem, F, G, effort, ca.MX.zeros(n_s, n_s), scale**2 / DEPENDENCE)
    operator = Stored(problem, F, G, ca.MX(0, 0), ca.MX(0, 0))

    def multipliers(b: ca.MX) -> ca.MX:
        w = _inverse(problem, F, parts, transposed_rows(problem, G, b * scale) / DEPENDENCE)
        return (b - rows(problem, operator, w) * scale) / DEPENDENCE

    diagonal, offdiagonal, basis = lanczos(multipliers, start, PRODUCTS)
    value, error, coordinates = outermost(diagonal.numel())(diagonal, offdiagonal, 0)
    return ca.Function("dependence_spectrum", [F, G, scale, start], [value, error, basis @ coordinates])


@lru_cache(maxsize=64)
def row_variances(problem: OCP) -> ca.Function:
    """(F, G) -> row . Cov . row (n_ineq,), where Cov is the covariance of w when u is white and s_0 given."""
    n_s, n_x, n_h, steps = problem.n_states, len_x(problem), problem.n_path, problem.horizon
    F, G, *_ = matrices(problem)
    S, F_t, G_t = ca.MX.sym("S", n_s, n_s), ca.MX.sym("F", n_s, n_x), ca.MX.sym("G", n_h, n_x)
    of_x = ca.MX(ca.densify(ca.diag(ca.DM(np.arange(n_x) >= n_s))))
    of_x[:n_s, :n_s] = S
    after = F_t @ of_x @ F_t.T
    path = ca.sum2((G_t @ of_x) * G_t) if n_h else ca.MX(0, 1)
    stage = ca.Function("variances", [S, F_t, G_t], [after, ca.diag(of_x), ca.densify(path)])
    after, diagonals, path = scan(stage, ca.MX.zeros(n_s, n_s), [F, G], steps)
    of_w = flat(problem, diagonals, ca.diag(after[:, -n_s:]))
    B = bound_columns(problem)
    return ca.Function("row_variances", [F, G], [ca.densify(ca.vertcat((B * B).T @ of_w, ca.vec(path)))])


def _inverse(problem: OCP, F: ca.MX, parts: list[ca.MX], right: ca.MX) -> ca.MX:
    """w (n_w,) of the factorised system for (r, 0): `substitute` without defects and without costates."""
    q, last = by_stage(problem, -right)
    _, v = scan(_backward(problem), last, [F, *parts, q], problem.horizon, backwards=True)
    states, actions = scan(_forward(problem), ca.MX.zeros(problem.n_states), [F, *parts, v], problem.horizon)
    return ca.vertcat(ca.vec(states), ca.vec(actions))


def _stage(problem: OCP) -> list[ca.MX]:
    """F, W, Y and D of a stage."""
    n_s, n_u = problem.n_states, problem.n_actions
    shapes = {"F": (n_s, n_s + n_u), "W": (n_u, n_u), "Y": (n_u, n_s), "D": (n_u, 1)}
    return [ca.MX.sym(name, *shape) for name, shape in shapes.items()]


@lru_cache(maxsize=64)
def _backward(problem: OCP) -> ca.Function:
    """p_{t+1}, F, W, Y, D, q -> p_t, v_t."""
    n_s = problem.n_states
    p, q, (F, W, Y, pivots) = ca.MX.sym("p", n_s), ca.MX.sym("q", len_x(problem)), _stage(problem)
    m = ca.mac(p.T, F, q.T).T
    v = W @ m[n_s:]
    before = m[:n_s] - ((ca.sign(pivots) * v).T @ Y).T
    return ca.Function("pull_back", [p, F, W, Y, pivots, q], [before, v])


@lru_cache(maxsize=64)
def _forward(problem: OCP) -> ca.Function:
    """s_t, F, W, Y, D, v -> s_{t+1}, u_t."""
    s, v, (F, W, Y, pivots) = ca.MX.sym("s", problem.n_states), ca.MX.sym("v", problem.n_actions), _stage(problem)
    u = -((ca.sign(pivots) * ca.mac(Y, s, v)).T @ W).T
    return ca.Function("roll_on", [s, F, W, Y, pivots, v], [F @ ca.vertcat(s, u), u])
