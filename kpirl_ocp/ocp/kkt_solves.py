"""Solves and products with the KKT system of `kpirl_ocp.ocp.sensitivity`, each one compiled function.

Inequalities are listed as in `Inequalities`; what belongs to some of them only is zero for the others. F, G, H and H_T
lie side by side as in `kpirl_ocp.ocp.stages`.
"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.kkt import bounded_entries, transcribe
from kpirl_ocp.ocp.problem import OCP
from kpirl_ocp.ocp.recursion import condense, factorise, substitute
from kpirl_ocp.ocp.spectrum import lanczos
from kpirl_ocp.ocp.stage_blocks import by_stage, path_product, selection, stiffen_stage
from kpirl_ocp.ocp.sweeps import along

PRODUCTS = 10  # Lanczos steps
FIRST_DIGITS = 5  # of them, where the first digits are enough


@lru_cache(maxsize=64)
def factor(problem: OCP) -> ca.Function:
    """(F, G, H, H_T, weights (n_ineq,)) -> `factorise` of H + rows' weights rows."""
    F, G, H, last = _matrices(problem)
    weights = ca.MX.sym("weights", _n_rows(problem))
    bounds, path = _split(problem, weights)
    B = _bounds(problem)
    stiff, stiff_last = by_stage(problem, (B * B) @ bounds)
    n_x, n_h, steps = problem.n_states + problem.n_actions, problem.n_path, problem.horizon
    H_stiff = stiffen_stage(n_x, n_h).map(steps)(H, G, stiff, path)
    outputs = factorise(problem)(F, H_stiff, last + ca.diag(stiff_last))
    return ca.Function("factor", [F, G, H, last, weights], list(outputs))


@lru_cache(maxsize=64)
def refine(problem: OCP) -> ca.Function:
    """One step of the method of multipliers towards the solution of

        (H + rows' sigma rows) w + A' lambda + C' mu = r,    A w = d,    C w = c,

    with the factors (F_0, G_0, P, W, Y, pivots) of a system nearby whose active rows are stiff with S.

    (F_0, G_0, P, W, Y, pivots, S, F, G, H, H_T, sigma, active (0 or 1), 1/units, r, d, c, and w, lambda, mu with the
    residuals of r, d, c that they leave) -> the last six after the step, and |r|, |d|, |c / units|, |w| of them.
    """
    n_w, n_d, n_c = (transcribe(problem).lower.size, problem.horizon * problem.n_states, _n_rows(problem))
    factors, (F, G, H, last) = _factors(problem), _matrices(problem)
    F_0, G_0, *_ = _matrices(problem)
    stiffness, sigma, active, scale = (ca.MX.sym(name, n_c) for name in ("S", "sigma", "active", "scale"))
    right = [ca.MX.sym(name, size) for name, size in (("r", n_w), ("d", n_d), ("c", n_c))]
    point = [ca.MX.sym(name, size) for name, size in (("w", n_w), ("lambda", n_d), ("mu", n_c))]
    off = [ca.MX.sym(name, size) for name, size in (("r_off", n_w), ("d_off", n_d), ("c_off", n_c))]

    pushed = off[0] + _transposed_rows(problem, G_0, stiffness * off[2])
    dw, dcostates = _back(problem, F_0, factors, pushed, off[1])
    w, costates = point[0] + dw, point[1] + dcostates
    forces = point[2] + stiffness * (_rows(problem, G_0, dw) - off[2])
    values = _rows(problem, G, w)
    x, end = by_stage(problem, w)
    product = _stagewise(problem, F, H, x, costates)
    balance = _flat(problem, product, last @ end) + _transposed_rows(problem, G, sigma * values + forces)
    balance[:n_d] -= costates
    arrived = _moved(problem, F, x) - w[:n_d]
    left = [right[0] - balance, right[1] - arrived, active * (right[2] - values)]
    norms = ca.vertcat(*(ca.norm_2(part) for part in (left[0], left[1], left[2] * scale, w)))
    inputs = [F_0, G_0, *factors, stiffness, F, G, H, last, sigma, active, scale, *right, *point, *off]
    return ca.Function("refine", inputs, [ca.densify(x) for x in (w, costates, forces, *left, norms)])


@lru_cache(maxsize=64)
def back(problem: OCP) -> ca.Function:
    """(F, P, W, Y, pivots, v (T n_u,)) -> w (n_w,) of the factorised system for r = (0, v)."""
    F, *_ = _matrices(problem)
    factors, v = _factors(problem), ca.MX.sym("v", problem.horizon * problem.n_actions)
    return ca.Function("back", [F, *factors, v], [_back_actions(problem, F, factors, v)])


@lru_cache(maxsize=64)
def condensed_spectrum(problem: OCP) -> ca.Function:
    """(F, H, H_T, start (T n_u,)) -> `lanczos` of Z' H Z, to the first digits."""
    F, _, H, last = _matrices(problem)
    n_u, steps = problem.n_actions, problem.horizon
    start = ca.MX.sym("start", steps * n_u)

    def operator(u: ca.MX) -> ca.MX:
        return ca.vec(condense(problem)(F, H, last, ca.reshape(u, n_u, steps)))

    return ca.Function("condensed_spectrum", [F, H, last, start], lanczos(operator, start, FIRST_DIGITS))


@lru_cache(maxsize=64)
def inverse_spectrum(problem: OCP) -> ca.Function:
    """(F, P, W, Y, pivots, start (T n_u,)) -> `lanczos` of the actions' part of the inverse."""
    F, *_ = _matrices(problem)
    factors, n = _factors(problem), problem.horizon * problem.n_states
    start = ca.MX.sym("start", problem.horizon * problem.n_actions)
    outputs = lanczos(lambda v: _back_actions(problem, F, factors, v)[n:], start, PRODUCTS)
    return ca.Function("inverse_spectrum", [F, *factors, start], outputs)


@lru_cache(maxsize=64)
def dependence_spectrum(problem: OCP) -> ca.Function:
    """(F, G, P, W, Y, pivots, 1/lengths (n_ineq,), delta, start (n_ineq,)) -> `lanczos` of the relaxed multipliers.

    That is of (1 - D C K C' D / delta) / delta with the factorised inverse K and D = 1/lengths.
    """
    F, G, *_ = _matrices(problem)
    factors, n = _factors(problem), problem.horizon * problem.n_states
    scale, delta = ca.MX.sym("scale", _n_rows(problem)), ca.MX.sym("delta")
    start = ca.MX.sym("start", _n_rows(problem))

    def operator(b: ca.MX) -> ca.MX:
        pushed = _transposed_rows(problem, G, b * scale) / delta
        w, _ = _back(problem, F, factors, pushed, ca.MX.zeros(n))
        return (b - _rows(problem, G, w) * scale) / delta

    outputs = lanczos(operator, start, PRODUCTS)
    return ca.Function("dependence_spectrum", [F, G, *factors, scale, delta, start], outputs)


@lru_cache(maxsize=64)
def row_variances(problem: OCP) -> ca.Function:
    """(F, G) -> row . Cov . row (n_ineq,), where Cov is the covariance of w when u is white and s_0 given."""
    n_s, n_u, steps = problem.n_states, problem.n_actions, problem.horizon
    n_x, n_h = n_s + n_u, problem.n_path
    F, G, *_ = _matrices(problem)
    S, F_t, G_t = ca.MX.sym("S", n_s, n_s), ca.MX.sym("F", n_s, n_x), ca.MX.sym("G", n_h, n_x)
    of_x = ca.MX(ca.DM(np.diag(np.r_[np.zeros(n_s), np.ones(n_u)])))
    of_x[:n_s, :n_s] = S
    after = F_t @ of_x @ F_t.T
    path = ca.sum2((G_t @ of_x) * G_t) if n_h else ca.MX(0, 1)
    stage = ca.Function("variances", [S, F_t, G_t], [after, ca.diag(of_x), ca.densify(path)])
    after, diagonals, path = along(stage, ca.MX.zeros(n_s, n_s), [F, G], steps)
    of_w = _flat(problem, diagonals, ca.diag(after[:, -n_s:]))
    B = _bounds(problem)
    return ca.Function("row_variances", [F, G], [ca.densify(ca.vertcat((B * B).T @ of_w, ca.vec(path)))])


def _matrices(problem: OCP) -> tuple[ca.MX, ca.MX, ca.MX, ca.MX]:
    """Symbols for F, G, H and H_T."""
    n_s, n_x, steps = problem.n_states, problem.n_states + problem.n_actions, problem.horizon
    shapes = {"F": (n_s, n_x * steps), "G": (problem.n_path, n_x * steps), "H": (n_x, n_x * steps), "H_T": (n_s, n_s)}
    F, G, H, last = (ca.MX.sym(name, *shape) for name, shape in shapes.items())
    return F, G, H, last


def _factors(problem: OCP) -> list[ca.MX]:
    """Symbols for P, W, Y and the pivots."""
    n_s, n_u, steps = problem.n_states, problem.n_actions, problem.horizon
    shapes = {"P": (n_s, n_s * steps), "W": (n_u, n_u * steps), "Y": (n_u, n_s * steps), "pivots": (n_u, steps)}
    return [ca.MX.sym(name, *shape) for name, shape in shapes.items()]


def _n_rows(problem: OCP) -> int:
    return len(bounded_entries(problem)[0]) + problem.horizon * problem.n_path


def _bounds(problem: OCP) -> ca.DM:
    """The transposed rows of the bounds (n_w, n_bounds)."""
    return selection(problem, *bounded_entries(problem))


def _split(problem: OCP, values: ca.MX) -> tuple[ca.MX, ca.MX]:
    """Of the bounds (n_bounds,), and of the path constraints (n_h, T)."""
    bounds, path = ca.vertsplit(values, [0, len(bounded_entries(problem)[0]), values.numel()])
    return bounds, ca.reshape(path, problem.n_path, problem.horizon)


def _rows(problem: OCP, G: ca.MX, w: ca.MX) -> ca.MX:
    """rows w (n_ineq,)."""
    n_h, n_x = problem.n_path, problem.n_states + problem.n_actions
    path = path_product(n_h, n_x).map(problem.horizon)(G, by_stage(problem, w)[0])
    return ca.densify(ca.vertcat(_bounds(problem).T @ w, ca.vec(path)))


def _transposed_rows(problem: OCP, G: ca.MX, forces: ca.MX) -> ca.MX:
    """rows' forces (n_w,)."""
    bounds, path = _split(problem, forces)
    pushed = _bounds(problem) @ bounds
    if problem.n_path:
        force, G_t = ca.MX.sym("force", problem.n_path), ca.MX.sym("G", problem.n_path, G.size2() // problem.horizon)
        pull = ca.Function("pull", [G_t, force], [(force.T @ G_t).T]).map(problem.horizon)
        pushed = pushed + _flat(problem, pull(G, path), ca.MX.zeros(problem.n_states))
    return ca.densify(pushed)


def _stagewise(problem: OCP, F: ca.MX, H: ca.MX, x: ca.MX, costates: ca.MX) -> ca.MX:
    """H_t x_t + F_t' lambda_t (n_x, T)."""
    n_s, n_x = problem.n_states, problem.n_states + problem.n_actions
    F_t, H_t, x_t, costate = (
        ca.MX.sym("F", n_s, n_x),
        ca.MX.sym("H", n_x, n_x),
        ca.MX.sym("x", n_x),
        ca.MX.sym("lambda", n_s),
    )
    stage = ca.Function("balance", [F_t, H_t, x_t, costate], [ca.mac(costate.T, F_t, x_t.T @ H_t).T])
    return stage.map(problem.horizon)(F, H, x, ca.reshape(costates, n_s, problem.horizon))


def _moved(problem: OCP, F: ca.MX, x: ca.MX) -> ca.MX:
    """F_t x_t (T n_s,)."""
    n_s, n_x = problem.n_states, problem.n_states + problem.n_actions
    return ca.vec(path_product(n_s, n_x).map(problem.horizon)(F, x))


def _flat(problem: OCP, x: ca.MX, last: ca.MX) -> ca.MX:
    """w (n_w,) of x_t (n_x, T), of which s_0 is dropped, and s_T (n_s,)."""
    n_s = problem.n_states
    return ca.vertcat(ca.vec(x[:n_s, 1:]), last, ca.vec(x[n_s:, :]))


def _back(problem: OCP, F: ca.MX, factors: list[ca.MX], right: ca.MX, defects: ca.MX) -> tuple[ca.MX, ca.MX]:
    """w and lambda of the factorised system for (r, d)."""
    n_s, steps = problem.n_states, problem.horizon
    q, last = by_stage(problem, -right)
    d = ca.reshape(-defects, n_s, steps)
    states, actions, costates = substitute(problem)(F, *factors, q, last, d, ca.MX.zeros(n_s))
    return ca.vertcat(ca.vec(states[:, 1:]), ca.vec(actions)), ca.vec(costates)


def _back_actions(problem: OCP, F: ca.MX, factors: list[ca.MX], v: ca.MX) -> ca.MX:
    n = problem.horizon * problem.n_states
    return _back(problem, F, factors, ca.vertcat(ca.MX.zeros(n), v), ca.MX.zeros(n))[0]


ALL = (factor, refine, back, condensed_spectrum, inverse_spectrum, dependence_spectrum, row_variances)
"""To be compiled together: they have the recursion in common."""
