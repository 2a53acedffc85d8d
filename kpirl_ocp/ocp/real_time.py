"""One real-time iteration as a function of numbers alone, to be generated as C for a controller.

It is what `Riccati(steps=1, barrier=tau)` does in a warm start: linearise, find the Newton step, and go along it as far
as slacks and multipliers stay positive. It needs no memory beside its arguments and calls nothing outside of it.
"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca

from kpirl_ocp.ocp.interior_point import BOUNDARY, CENTRE, newton_step, rows, selection
from kpirl_ocp.ocp.problem import OCP
from kpirl_ocp.ocp.stages import second, values

NAMES = ("S", "U", "Lambda", "y", "z", "nu")


@lru_cache(maxsize=64)
def real_time_step(problem: OCP) -> ca.Function:
    """(S, U, Lambda, y, z, nu, s0, psi, c, tau, rho) -> the next six, and the smallest pivot.

    S: (n_s, T+1). U: (n_u, T). Lambda: (n_s, T). y, z: (m,) slacks and multipliers of finite lower bounds of
    w = (s_1 .. s_T, u_0 .. u_{T-1}), finite upper bounds of w, and path constraints. nu: multipliers of entries of w
    whose bounds coincide.
    tau: barrier parameter. rho: regularisation; to be raised when the smallest pivot is not positive, for then the
    step is not one towards a minimum.
    """
    at, n_s, steps = rows(problem), problem.n_states, problem.horizon
    sizes = [(n_s, steps + 1), (problem.n_actions, steps), (n_s, steps), (at.n_inequalities, 1), (at.n_inequalities, 1)]
    iterate = [ca.MX.sym(name, *size) for name, size in zip(NAMES, [*sizes, (len(at.fixed), 1)], strict=True)]
    lengths = (n_s, problem.n_parameters, problem.n_context, 1, 1)
    s0, psi, context, tau, rho = (
        ca.MX.sym(name, length) for name, length in zip(("s0", "psi", "c", "tau", "rho"), lengths, strict=True)
    )
    S, U, costates, y, z, nu = iterate
    forces = ca.reshape(ca.vertsplit(z, [0, len(at.bounds), z.numel()])[1], problem.n_path, steps)
    _, defects, path, _, _, r, last, *matrices = second(problem)(S, U, psi, context, costates, forces)
    g, off = _constraints(problem, S, U, path)
    *step, pivots, _ = newton_step(problem)(r, last, defects, *matrices, g, off, s0 - S[:, 0], y, z, nu, tau, rho)

    share = ca.fmax(BOUNDARY, 1 - tau)
    primal, dual = _longest(y, step[3], share), _longest(z, step[4], share)
    moved = [x + (dual if x is z else primal) * dx for x, dx in zip(iterate, step, strict=True)]
    g, _ = _constraints(problem, moved[0], moved[1], values(problem)(moved[0], moved[1], psi, context)[2])
    moved[3] = ca.fmax(moved[3], -g)
    centred = tau / moved[3]
    moved[4] = ca.fmin(ca.fmax(moved[4], centred / CENTRE), centred * CENTRE)
    inputs, names = [*iterate, s0, psi, context, tau, rho], [*NAMES, "s0", "psi", "c", "tau", "rho"]
    outputs = [f"{name}_next" for name in NAMES] + ["smallest_pivot"]
    return ca.Function("real_time_step", inputs, [*moved, ca.mmin(pivots)], names, outputs)


def _constraints(problem: OCP, S: ca.MX, U: ca.MX, path: ca.MX) -> tuple[ca.MX, ca.MX]:
    """Values g (m,) of the inequalities, and what the fixed entries are off."""
    at, w = rows(problem), ca.vertcat(ca.vec(S[:, 1:]), ca.vec(U))
    bounds = selection(problem, at.entries, at.signs).T @ w - ca.DM(at.signs * at.bounds)
    fixed = selection(problem, at.fixed, 0 * at.values + 1).T @ w - ca.DM(at.values)
    return ca.vertcat(bounds, ca.vec(path)), fixed


def _longest(value: ca.MX, change: ca.MX, share: ca.MX) -> ca.MX:
    """The longest step in (0, 1] that keeps value + length * change at least (1 - share) value; value > 0."""
    return share / ca.fmax(share, ca.mmax(ca.vertcat(0, -change / value)))
