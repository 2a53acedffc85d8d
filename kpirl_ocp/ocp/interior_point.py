"""One Newton step of a primal-dual interior-point method, condensed onto the stages and solved by the recursion.

Inequalities g(w) <= 0 (finite bounds on w = (s_1 .. s_T, u_0 .. u_{T-1}), then path constraints) have slacks y > 0 and
multipliers z > 0. The Newton step on the perturbed conditions

    grad L + G' z + E' nu = 0,   g + y = 0,   y z = tau,   w_fixed = b,   dynamics

eliminates y, z and nu, which leaves the linear-quadratic problem of `kpirl_ocp.ocp.recursion` with

    H + G' (z/y) G + E' E / delta + rho R,    gradient + G' (tau/y + z/y (g + y)) + E' (w_fixed - b) / delta.

R is the identity of the actions: enough of it makes the reduced Hessian positive, and states may go on to move far.
Entries fixed by coinciding bounds are equalities with a multiplier nu of their own, updated by the proximal step
nu + (w_fixed - b) / delta: exact where the method converges, and never singular.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from kpirl_ocp.ocp.problem import OCP
from kpirl_ocp.ocp.recursion import factorise, substitute
from kpirl_ocp.types import Array, Indices

PROXIMAL = 1e-9  # delta
BOUNDARY = 0.99  # smallest share of the way to the boundary that a step may go
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
    lower, upper = (np.concatenate([np.tile(s, problem.horizon), np.tile(u, problem.horizon)]) for s, u in pairs)
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
    steps, n_s, n_x = problem.horizon, problem.n_states, problem.n_states + problem.n_actions
    at = rows(problem)
    m_b, n_h = len(at.bounds), problem.n_path
    r, last = ca.MX.sym("r", n_x, steps), ca.MX.sym("r_T", n_s)
    defects, F, G = ca.MX.sym("d", n_s, steps), ca.MX.sym("F", n_s, n_x * steps), ca.MX.sym("G", n_h, n_x * steps)
    H, H_last = ca.MX.sym("H", n_x, n_x * steps), ca.MX.sym("H_T", n_s, n_s)
    g, off, gap = ca.MX.sym("g", at.n_inequalities), ca.MX.sym("off", len(at.fixed)), ca.MX.sym("gap", n_s)
    y, z, nu = ca.MX.sym("y", g.numel()), ca.MX.sym("z", g.numel()), ca.MX.sym("nu", off.numel())
    tau, rho = ca.MX.sym("tau"), ca.MX.sym("rho")

    weights = z / y
    force = tau / y + weights * (g + y)  # z after the step, before w moves
    split = [0, m_b, g.numel()]  # bounds, path constraints
    (force_b, force_h), (weights_b, weights_h) = ca.vertsplit(force, split), ca.vertsplit(weights, split)
    pushing = force_h - ca.vertsplit(z, split)[1]  # the gradient r holds the path constraints' z
    bounds, fixed = selection(problem, at.entries, at.signs), selection(problem, at.fixed, np.ones(len(at.fixed)))
    actions = ca.vertcat(ca.DM(steps * n_s, 1), ca.DM.ones(steps * problem.n_actions))
    push, push_last = by_stage(problem, bounds @ force_b + fixed @ (nu + off / PROXIMAL))
    stiff, stiff_last = by_stage(problem, (bounds * bounds) @ weights_b + ca.sum2(fixed) / PROXIMAL + rho * actions)
    path = (ca.reshape(x, n_h, steps) for x in (weights_h, pushing))
    condensed, slope = condense_stage(n_x, n_h).map(steps)(H, r + push, G, stiff, *path)

    P, W, Y, pivots = factorise(problem)(F, condensed, H_last + ca.diag(stiff_last))
    ds, du, dlam = substitute(problem)(F, P, W, Y, pivots, slope, last + push_last, defects, gap)
    dw = ca.vertcat(ca.vec(ds[:, 1:]), ca.vec(du))
    dg = ca.vertcat(bounds.T @ dw, ca.vec(path_product(n_h, n_x).map(steps)(G, ca.vertcat(ds[:, :steps], du))))
    step = [ds, du, dlam, -(g + y) - dg, force + weights * dg - z, (fixed.T @ dw + off) / PROXIMAL, pivots]
    step.append(_gains(n_s, problem.n_actions).map(steps)(W, Y, pivots))
    inputs = [r, last, defects, F, G, H, H_last, g, off, gap, y, z, nu, tau, rho]
    return ca.Function("newton_step", inputs, [ca.densify(x) for x in step])


def _gains(n_s: int, n_u: int) -> ca.Function:
    """(W, Y, pivots) of a stage -> K = -W' J Y."""
    W, Y, pivots = ca.MX.sym("W", n_u, n_u), ca.MX.sym("Y", n_u, n_s), ca.MX.sym("D", n_u)
    return ca.Function("gains", [W, Y, pivots], [-W.T @ (ca.repmat(ca.sign(pivots), 1, n_s) * Y)])


def condense_stage(n_x: int, n_h: int) -> ca.Function:
    """(H, r, G, stiffness of x, weights of h, force on h) -> H + diag(stiffness) + G' weights G, r + G' force."""
    H, G = ca.MX.sym("H", n_x, n_x), ca.MX.sym("G", n_h, n_x)
    r, stiffness = ca.MX.sym("r", n_x), ca.MX.sym("stiffness", n_x)
    weights, force = ca.MX.sym("weights", n_h), ca.MX.sym("force", n_h)
    condensed = ca.MX(H)
    condensed.nz[:: n_x + 1] = H.nz[:: n_x + 1] + stiffness
    outputs = [condensed, r]
    if n_h:
        outputs = [ca.mac(G.T, ca.repmat(weights, 1, n_x) * G, condensed), ca.mac(force.T, G, r.T).T]
    return ca.Function("condense", [H, r, G, stiffness, weights, force], outputs)


def path_product(rows: int, columns: int) -> ca.Function:
    """(G, x) -> G x, also when there is no row."""
    G, x = ca.MX.sym("G", rows, columns), ca.MX.sym("x", columns)
    return ca.Function("product", [G, x], [G @ x if rows else ca.MX(0, 1)])


def selection(problem: OCP, entries: Indices, signs: Array) -> ca.DM:
    """The sparse (n_w, m) matrix with one sign per column, in the row of its entry."""
    n_w = problem.horizon * (problem.n_states + problem.n_actions)
    if not len(entries):
        return ca.DM(n_w, 0)
    return ca.DM.triplet(entries.tolist(), list(range(len(entries))), ca.DM(signs), n_w, len(entries))


def by_stage(problem: OCP, w: ca.MX) -> tuple[ca.MX, ca.MX]:
    """w (n_w,) as columns x_t (n_x, T), with zeros for the given s_0, and s_T (n_s,)."""
    steps, n_s = problem.horizon, problem.n_states
    states = ca.horzcat(ca.MX.zeros(n_s, 1), ca.reshape(w[: steps * n_s], n_s, steps))
    return ca.vertcat(states[:, :steps], ca.reshape(w[steps * n_s :], problem.n_actions, steps)), states[:, steps]
