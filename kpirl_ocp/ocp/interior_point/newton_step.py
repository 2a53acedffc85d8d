"""One Newton step of a primal-dual interior-point method, condensed onto the stages and solved by the recursion.

Inequalities g(w) <= 0 (finite bounds on w = (s_1 .. s_T, u_0 .. u_{T-1}), then path constraints) have slacks y > 0 and
multipliers z > 0. The Newton step on the perturbed conditions

    grad L + G' z + E' nu = 0,   g + y = 0,   y z = tau,   w_fixed = b,   dynamics

eliminates y, z and nu, which leaves the linear-quadratic problem of `kpirl_ocp.ocp.linear.riccati_recursion` with

    H + G' (z/y) G + E' E / delta + rho R,    gradient + G' (tau/y + z/y (g + y)) + E' (w_fixed - b) / delta.

A second step with the same factors corrects for the product dy dz that this leaves out (Mehrotra, 1992).

R is the identity of the actions: enough of it makes the reduced Hessian positive, and states may go on to move far.
Entries fixed by coinciding bounds are equalities with a multiplier nu of their own, updated by the proximal step
nu + (w_fixed - b) / delta: exact where the method converges, and never singular.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.linear.riccati_recursion import factor_symbols, factorise, substitute
from kpirl_ocp.ocp.linear.stage_operators import by_stage, path_product, push_stage, selection, stiffen_stage
from kpirl_ocp.ocp.problem.ocp import OCP
from kpirl_ocp.types import Array, Indices

PROXIMAL = 1e-9  # delta
BOUNDARY = 0.99  # share of the way to the boundary that a step of slacks may go; of multipliers, the smallest share
CORRECTED = 0.5  # length of the first step from which the second order is believed
CENTRE = 1e10  # slack * multiplier stays within this factor of tau


@dataclass(frozen=True)
class Rows:
    """The constraints of a problem other than its dynamics, as indices into w (n_w,).

    lower, upper: bounded entries. fixed: entries whose bounds coincide. bounds: (m_b,) of lower, then upper.
    values: (n_fixed,) of the fixed entries. n_path: T n_h.
    """

    lower: Indices
    upper: Indices
    fixed: Indices
    bounds: Array
    values: Array
    n_path: int

    @cached_property
    def signs(self) -> Array:
        """(m_b,) of the bounded entry in its constraint: -1 for lower, 1 for upper bounds."""
        return np.repeat([-1.0, 1.0], [len(self.lower), len(self.upper)])

    @cached_property
    def entries(self) -> Indices:
        """(m_b,) of w that the bounds are about."""
        return np.concatenate([self.lower, self.upper])

    @property
    def n_inequalities(self) -> int:
        """m, without the fixed entries."""
        return len(self.bounds) + self.n_path

    def evaluate(self, w: Array, path: Array) -> Array:
        """g (m,) at w (n_w,) with path constraints (T n_h,)."""
        return np.concatenate([self.signs * (w[self.entries] - self.bounds), path])

    def push(self, forces: Array, fixing: Array, n_w: int) -> Array:
        """Gradient (n_w,) of z . g over the bounds, and of nu . w_fixed."""
        net = np.zeros(n_w)
        net[self.lower] -= forces[: len(self.lower)]
        net[self.upper] += forces[len(self.lower) : len(self.bounds)]
        net[self.fixed] += fixing
        return net


@lru_cache(maxsize=64)
def rows(problem: OCP) -> Rows:
    """Sort the bounds of a problem into inequalities and fixed entries."""
    pairs = zip(problem.state_bounds, problem.action_bounds, strict=True)
    lower, upper = (np.concatenate([np.asarray(s)[1:].ravel(), np.asarray(u).ravel()]) for s, u in pairs)
    fixed = lower == upper
    low, high = (np.flatnonzero(np.isfinite(bound) & ~fixed) for bound in (lower, upper))
    return Rows(
        lower=low,
        upper=high,
        fixed=np.flatnonzero(fixed),
        bounds=np.concatenate([lower[low], upper[high]]),
        values=lower[fixed],
        n_path=problem.horizon * problem.n_path,
    )


@lru_cache(maxsize=64)
def newton_step(problem: OCP) -> ca.Function:
    """The step (ds (n_s, T+1), du (n_u, T), dlambda (n_s, T), dy (m,), dz (m,), dnu), pivots (n_u, T), gains K.

    Of (r, r_T, defects, F, G, H, H_T) of `stages.second`, g (m,), the violation of fixed entries, the gap in s_0,
    y, z, nu, tau and rho. K (n_u, n_s T) is the feedback du_t = ... + K_t ds_t.
    """
    inputs, tau, rho = _symbols(problem), ca.MX.sym("tau"), ca.MX.sym("rho")
    *_, y, _, _ = inputs
    factors = _factors(problem, inputs, rho)
    step = _solve(problem)(*inputs, *factors, ca.repmat(tau, y.numel(), 1))
    return ca.Function("newton_step", [*inputs, tau, rho], [*step, factors[-1], _gains(problem, factors)])


@lru_cache(maxsize=64)
def corrected_step(problem: OCP) -> ca.Function:
    """The step towards a tau that it chooses itself, corrected to second order (Mehrotra, 1992).

    A first step (da), towards tau = least, shows how small mu = y.z / m can become while y and z stay positive. Then

        tau = mu (mu_a / mu)^3 within [least, most],      y z + z dy + y dz = tau - dy_a dz_a

    with the same factors. The correction supposes that most of the first step can be taken, and is left out where it
    can not. Inputs as for `newton_step` without rho, with least and most in the place of tau; its outputs, and tau.
    """
    inputs, least, most = _symbols(problem), ca.MX.sym("least"), ca.MX.sym("most")
    *_, y, z, _ = inputs
    factors, m = _factors(problem, inputs, ca.MX(0)), y.numel()
    tau, target = least, ca.MX(0, 1)
    if m:
        *_, dy, dz, _ = _solve(problem)(*inputs, *factors, ca.repmat(least, m, 1))
        primal, dual = _longest(y, dy), _longest(z, dz)
        mu, mu_first = ca.dot(y, z) / m, ca.dot(y + primal * dy, z + dual * dz) / m
        tau = ca.fmax(least, ca.fmin(most, mu * (mu_first / mu) ** 3))
        target = tau - (ca.fmin(primal, dual) > CORRECTED) * dy * dz
    step = _solve(problem)(*inputs, *factors, target)
    outputs = [*step, factors[-1], _gains(problem, factors), tau]
    return ca.Function("corrected_step", [*inputs, least, most], outputs)


def _symbols(problem: OCP) -> list[ca.MX]:
    """r, r_T, defects, F, G, H, H_T, g, off, gap, y, z, nu."""
    steps, n_s, n_x, n_h = problem.horizon, problem.n_states, problem.n_states + problem.n_actions, problem.n_path
    m, n_fixed = rows(problem).n_inequalities, len(rows(problem).fixed)
    shapes = {"r": (n_x, steps), "r_T": (n_s,), "d": (n_s, steps), "F": (n_s, n_x * steps), "G": (n_h, n_x * steps)}
    shapes |= {"H": (n_x, n_x * steps), "H_T": (n_s, n_s), "g": (m,), "off": (n_fixed,), "gap": (n_s,)}
    shapes |= {"y": (m,), "z": (m,), "nu": (n_fixed,)}
    return [ca.MX.sym(name, *shape) for name, shape in shapes.items()]


def _factors(problem: OCP, inputs: list[ca.MX], rho: ca.MX) -> tuple[ca.MX, ...]:
    """P, W, Y and pivots of the condensed Hessian."""
    _, _, _, F, G, H, H_last, _, _, _, y, z, _ = inputs
    steps, n_s, n_x = problem.horizon, problem.n_states, problem.n_states + problem.n_actions
    bounds, fixed = _selections(problem)
    weights, weights_path = _split(problem, z / y)
    actions = ca.vertcat(ca.DM(steps * n_s, 1), ca.DM.ones(steps * problem.n_actions))
    stiff, stiff_last = by_stage(problem, (bounds * bounds) @ weights + ca.sum2(fixed) / PROXIMAL + rho * actions)
    condensed = stiffen_stage(n_x, problem.n_path).map(steps)(H, G, stiff, weights_path)
    return factorise(problem)(F, condensed, H_last + ca.diag(stiff_last))


@lru_cache(maxsize=64)
def _solve(problem: OCP) -> ca.Function:
    """(r .. nu of `_symbols`, P, W, Y, pivots, target of y z (m,)) -> ds, du, dlambda, dy, dz, dnu."""
    inputs, factors = _symbols(problem), factor_symbols(problem)
    r, last, defects, F, G, _, _, g, off, gap, y, z, nu = inputs
    steps, n_h, n_x = problem.horizon, problem.n_path, problem.n_states + problem.n_actions
    target = ca.MX.sym("target", y.numel())

    weights = z / y
    force = target / y + weights * (g + y)  # z after the step, before w moves
    push, push_path = _split(problem, force)
    _, pushed = _split(problem, z)  # by the path constraints, which r knows already
    bounds, fixed = _selections(problem)
    push, push_last = by_stage(problem, bounds @ push + fixed @ (nu + off / PROXIMAL))
    slope = push_stage(n_h, n_x).map(steps)(r + push, G, push_path - pushed)

    ds, du, dlam = substitute(problem)(F, *factors, slope, last + push_last, defects, gap)
    dw = ca.vertcat(ca.vec(ds[:, 1:]), ca.vec(du))
    dg = ca.vertcat(bounds.T @ dw, ca.vec(path_product(n_h, n_x).map(steps)(G, ca.vertcat(ds[:, :steps], du))))
    step = [ds, du, dlam, -(g + y) - dg, force + weights * dg - z, (fixed.T @ dw + off) / PROXIMAL]
    return ca.Function("solve", [*inputs, *factors, target], [ca.densify(x) for x in step])


def _longest(value: ca.MX, change: ca.MX) -> ca.MX:
    """The longest step in (0, 1] that keeps value + length * change from becoming negative; value > 0."""
    return 1 / ca.fmax(1, ca.mmax(-change / value))


def _selections(problem: OCP) -> tuple[ca.DM, ca.DM]:
    """The transposed rows of the bounds (n_w, m_b), and those of the fixed entries."""
    at = rows(problem)
    return selection(problem, at.entries, at.signs), selection(problem, at.fixed, np.ones(len(at.fixed)))


def _split(problem: OCP, values: ca.MX) -> tuple[ca.MX, ca.MX]:
    """Of the bounds (m_b,), and of the path constraints (n_h, T)."""
    bounds, path = ca.vertsplit(values, [0, len(rows(problem).bounds), values.numel()])
    return bounds, ca.reshape(path, problem.n_path, problem.horizon)


def _gains(problem: OCP, factors: tuple[ca.MX, ...]) -> ca.MX:
    """K = -W' J Y of all stages (n_u, n_s T)."""
    n_s, n_u, (_, *parts) = problem.n_states, problem.n_actions, factors
    W, Y, pivots = ca.MX.sym("W", n_u, n_u), ca.MX.sym("Y", n_u, n_s), ca.MX.sym("D", n_u)
    stage = ca.Function("gains", [W, Y, pivots], [-W.T @ (ca.repmat(ca.sign(pivots), 1, n_s) * Y)])
    return stage.map(problem.horizon)(*parts)
